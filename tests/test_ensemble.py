"""Ensembles split over devices and processes: equal results, and no communication."""

import contextlib
import os
import pathlib
import signal
import subprocess
import sys

import pytest


EXAMPLE = pathlib.Path(__file__).parent.parent / "examples" / "ensemble.py"
FREE = {"constant steps", "adaptive steps, in shard_map", "an event, in shard_map"}
IN_EACH_STEP = {"constant steps, an event", "adaptive steps"}


def run(tmp_path, *options, limit):
    """The exit code and output of the example; all its processes are terminated."""
    # The example does not inherit the JAX settings of this process.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("XLA_")}
    environment |= {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "Agg"}
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLE), "--quick", *options],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        output, errors = process.communicate(timeout=limit)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return process.returncode, output, errors


def reports(output):
    """The report of each process: `(difference, communication)`."""
    lines = [line for line in output.splitlines() if line.startswith("process ")]
    found = []
    for line in sorted(lines):
        _, equality, communication = line.split(";")
        verdict = equality.rpartition(": ")[2]
        difference = 0.0 if verdict == "bitwise equal" else float(verdict.split()[-1])
        found.append((difference, communication.rpartition(": ")[2]))
    return found


@pytest.mark.slow
def test_over_devices(tmp_path):
    code, output, errors = run(tmp_path, "--devices", "8", limit=200)
    assert code == 0, errors
    assert (tmp_path / "ensemble.png").stat().st_size > 0
    assert "over 8 x cpu in 1 process(es), 512 on each device" in output
    ((difference, communication),) = reports(output)
    # Bitwise equal in our runs; compilers may round remainders of vectors differently.
    assert difference < 1e-9
    assert communication == "none"
    table = output.split("Communication in the compiled program")[1]
    rows = {line[2:36].strip(): line[36:] for line in table.splitlines()[1:]}
    assert {name for name in rows if rows[name] == "none"} >= FREE
    # The search finds collective operations where they are expected.
    assert {name for name in rows if "in each step" in rows[name]} == IN_EACH_STEP
    at_saved = {name for name in rows if "at each saved time" in rows[name]}
    assert at_saved == {"constant steps, SaveAt(ts=...)"}


@pytest.mark.slow
def test_over_processes(tmp_path):
    code, output, errors = run(tmp_path, "--processes", "2", limit=200)
    assert code == 0, errors
    assert (tmp_path / "ensemble.png").stat().st_size > 0
    assert "over 2 x cpu in 2 process(es), 2048 on each device" in output
    found = reports(output)
    assert len(found) == 2
    for difference, communication in found:
        assert difference < 1e-9
        assert communication == "none"


def test_processes_end_at_the_limit(tmp_path):
    options = "--processes", "2", "--timeout", "0.5"
    # It returns only when all processes that could write to its output have ended.
    code, output, _ = run(tmp_path, *options, limit=100)
    assert code == 1
    assert "Figure" not in output


def test_an_import_leaves_devices_to_be_chosen():
    code = (
        "import diffrax_presym, jax; jax.config.update('jax_num_cpu_devices', 2); "
        "assert jax.device_count() == 2"
    )
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
