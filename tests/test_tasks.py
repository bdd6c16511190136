"""Everyday tasks, each with a check that shares no code with the package."""

import pathlib
import runpy
import sys

import jax
import pytest


TASKS = pathlib.Path(__file__).parents[1] / "examples" / "tasks"


@pytest.mark.parametrize("name", sorted(x.stem for x in TASKS.glob("*.py")))
def test_task(name, capfd, monkeypatch):
    settings = dict(jax.config.values)
    changed = (
        "jax_enable_x64",
        "jax_numpy_dtype_promotion",
        "jax_numpy_rank_promotion",
    )
    try:
        for setting, value in zip(changed, (False, "standard", "allow"), strict=True):
            jax.config.update(setting, value)
        monkeypatch.setattr(sys, "argv", [f"{name}.py"])
        runpy.run_path(str(TASKS / f"{name}.py"), run_name="__main__")
    finally:
        for setting in changed:
            jax.config.update(setting, settings[setting])
    assert capfd.readouterr().out
