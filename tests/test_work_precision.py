"""`work_precision` and the figures: what they report is what the solves do."""

import builtins

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import diffrax_presym as dps
from diffrax_presym.diagnostics import (
    plot_convergence,
    plot_energy,
    plot_phase,
    plot_work_precision,
    work_precision,
)


matplotlib.use("Agg")

SYSTEM = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: jnp.sum(q**2) / 2,
    friction=dps.ConstantDamping(0.2),
)
Y0 = jnp.array([1.0, 0.5]), jnp.array([0.0, 0.3])
TS = jnp.linspace(0.0, 10.0, 21)


def solve_by(solver, **options):
    return jax.jit(
        lambda dt0: dfx.diffeqsolve(
            *(SYSTEM, solver, 0.0, 10.0, dt0, Y0),
            **{"saveat": dfx.SaveAt(ts=TS), "max_steps": None, "throw": False}
            | options,
        )
    )


@jax.jit
def adaptive(rtol):
    return dfx.diffeqsolve(
        *(SYSTEM, dfx.Dopri8(), 0.0, 10.0, None, Y0),
        saveat=dfx.SaveAt(ts=TS),
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=rtol),
    )


TUNED = solve_by(dps.TunedRKN6(), adjoint=dps.FixedStepAdjoint())


def exact(t):
    """The damped oscillator, by its characteristic roots."""
    w = np.sqrt(1 - 0.01)
    q, p = (np.asarray(y)[None] for y in Y0)
    t = np.asarray(t)[:, None]
    return np.exp(-0.1 * t) * (q * np.cos(w * t) + (p + 0.1 * q) / w * np.sin(w * t))


def wrong(dt0):
    """Converges, and to something else."""
    sol = TUNED(dt0)
    ys = jax.tree.map(lambda y: 1.001 * y, sol.ys)
    return dfx.Solution(**{**vars(sol), "ys": ys})


@pytest.fixture(scope="module")
def result():
    solves = {"tuned": TUNED, "Tsit5": solve_by(dfx.Tsit5()), "wrong": wrong}
    return work_precision(
        *(solves, 0.0, 10.0),
        rtol=1e-6,
        atol=1e-6,
        adaptive={"Dopri8, adaptive": adaptive},
        decades=1,
        repeats=2,
    )


def test_errors_are_those_of_the_solves(result):
    for run in result.runs:
        if run.name == "tuned":
            sol = TUNED(run.setting)
            q = exact(TS)
            error = np.max(np.abs(sol.ys[0] - q) / (1e-6 + 1e-6 * np.abs(q)))
            # The reference has an error too, and momenta have others.
            assert error <= 1.1 * run.error + 0.02
            assert run.error < 10 * error + 0.1


def test_what_converges_to_something_else_is_not_the_fastest(result):
    assert result.reference != "wrong"
    names = {run.name for run in result.runs if run.error <= 1}
    assert names == {"tuned", "Tsit5", "Dopri8, adaptive"}
    assert result.fastest().name in names
    assert result.fastest().error <= 1
    with pytest.raises(ValueError, match="No solve has an error"):
        result.fastest(1e-9)


def test_what_is_printed_and_drawn(result):
    lines = str(result).splitlines()
    assert len(lines) == len(result.runs) + 3
    assert lines[-1] == "never near the tolerance: wrong"
    axes = plot_work_precision(result)
    labels = {line.get_label() for line in axes.get_lines()}
    assert labels == {run.name for run in result.runs}
    assert axes.get_xscale() == axes.get_yscale() == "log"


def test_figures():
    sol = TUNED(0.5)
    above, below = plot_energy(SYSTEM, sol)
    energies = above.get_lines()[0].get_ydata()
    np.testing.assert_allclose(energies[0], 0.5 * 1.34, rtol=1e-12)
    assert np.max(np.abs(below.get_lines()[0].get_ydata())) < 1e-5
    axes = plot_phase(sol)
    drawn = np.stack([line.get_xdata() for line in axes.get_lines()], axis=1)
    np.testing.assert_allclose(drawn, sol.ys[0])
    measured, slope = plot_convergence(
        solve_by(dps.BlanesMoanRKN4()), 0.0, 10.0, 4, solves=4
    ).get_lines()
    steps, errors = measured.get_data()
    fitted = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(fitted - 4) < 0.3
    x, y = slope.get_data()
    np.testing.assert_allclose(np.diff(np.log(y)) / np.diff(np.log(x)), 4.0)


def test_a_figure_is_of_one_solution():
    batch = jax.vmap(TUNED)(jnp.array([0.5, 0.25]))
    for draw in (plot_phase, lambda sol: plot_energy(SYSTEM, sol)):
        with pytest.raises(ValueError, match="saved times of one solution"):
            draw(batch)


def test_without_matplotlib(monkeypatch):
    given = builtins.__import__

    def missing(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return given(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        plot_phase(TUNED(0.5))


@pytest.mark.parametrize(
    "solves, options, error, message",
    [
        ({}, {}, ValueError, "at least one solve"),
        ({"a": solve_by(dps.Strang())}, {"rtol": 0.0, "atol": 0.0}, ValueError, "pos"),
        ({"a": lambda dt0: dt0}, {}, ValueError, "diffrax.Solution"),
        ({"a": solve_by(dps.Strang())}, {"max_steps": 40}, RuntimeError, "No solve"),
    ],
)
def test_bad_input(solves, options, error, message):
    given = {"rtol": 1e-6, "atol": 1e-6} | options
    with pytest.raises(error, match=message):
        work_precision(solves, 0.0, 10.0, **given)


def test_solves_that_save_other_times_are_refused():
    """Their values would be broadcast, and one of them be missing from the table."""
    end = solve_by(dps.TunedRKN6(), saveat=dfx.SaveAt(t1=True))
    with pytest.raises(ValueError, match="must save the same"):
        work_precision({"end": end, "all": TUNED}, 0.0, 10.0, rtol=1e-4, atol=1e-4)


def test_a_solve_that_is_never_near_the_tolerance_is_named():
    few = solve_by(dps.PresymplecticLeapfrog(), max_steps=8)
    result = work_precision(
        {"tuned": TUNED, "few": few}, 0.0, 10.0, rtol=1e-4, atol=1e-4, decades=1
    )
    assert {run.name for run in result.runs} == {"tuned"}
    assert result.missing == ("few",) and "tolerance: few" in str(result)
