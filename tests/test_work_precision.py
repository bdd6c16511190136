"""`work_precision`: what it reports is what a solve with that solver does."""

import builtins

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import diffrax_presym as dps
from diffrax_presym.diagnostics import work_precision
from diffrax_presym.diagnostics._count import counted, Counter


PENDULUM = dps.HamiltonianTerm(
    dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        lambda t, q, args: -args * jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(0.1),
    )
)
MIXED = dps.HamiltonianTerm(
    dps.Hamiltonian(lambda t, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2)
)
RELATIVISTIC = dps.HamiltonianTerm(
    dps.SeparableHamiltonian(dps.RelativisticKinetic(), dps.QuadraticPotential())
)
Y0 = jnp.array([1.5, 0.5]), jnp.array([0.0, 0.3])
GRAVITY, TS = jnp.array(1.2), jnp.linspace(0.0, 10.0, 21)
SOLVERS = {
    "tuned": dps.TunedRKN6(),
    "Tsit5": dfx.Tsit5(),
}


@pytest.fixture(scope="module")
def result():
    return work_precision(
        *(PENDULUM, 0.0, 10.0, Y0),
        rtol=1e-5,
        atol=1e-6,
        ts=TS,
        args=GRAVITY,
        solvers=SOLVERS,
        decades=1,
        repeats=2,
    )


def test_all_solvers_reach_all_tolerances(result):
    names = {"tuned", "Tsit5", "Tsit5, adaptive"}
    assert not result.left_out
    for rtol in (1e-4, 1e-5, 1e-6):
        runs = [run for run in result.runs if run.rtol == pytest.approx(rtol)]
        assert {run.solver for run in runs} == names
        for run in runs:
            assert 0 < run.error <= 1.05 * rtol and run.seconds > 0


def test_the_error_is_that_of_the_solve(result):
    (run,) = (
        run
        for run in result.runs
        if run.solver == "tuned" and run.rtol == pytest.approx(1e-5)
    )
    saveat = dfx.SaveAt(ts=TS)
    solve = lambda solver, dt0, **options: dfx.diffeqsolve(
        *(PENDULUM, solver, 0.0, 10.0, dt0, Y0, GRAVITY), saveat=saveat, **options
    )
    sol = solve(SOLVERS["tuned"], 10.0 / run.steps)
    controller = dfx.ClipStepSizeController(dfx.PIDController(1e-12, 1e-12), step_ts=TS)
    exact = solve(dfx.Dopri8(), None, stepsize_controller=controller)
    scaled = lambda y, x: ((y - x) / (1e-1 + abs(x))) ** 2
    squares = jnp.concatenate(jax.tree.map(scaled, sol.ys, exact.ys), axis=1)
    error = jnp.max(jnp.sqrt(jnp.mean(squares, axis=1)))
    # The reference has an error too, small against the tolerance.
    assert run.error == pytest.approx(float(error), rel=0.2)


def test_evaluations(result):
    for run in result.runs:
        per_step = run.evaluations / run.steps
        # Per step of the solve and, for ours, per saved time.
        least, most = {
            "tuned": (14, 14 * (1 + len(TS) / run.steps) + 1),
            "Tsit5": (6, 6.1),
            "Tsit5, adaptive": (6, 6.5),
        }[run.solver]
        assert least <= per_step <= most


def test_what_is_printed_and_drawn(result, capsys):
    print(result)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"fastest to 1e-05: {result.fastest}"
    fastest = min(
        (run for run in result.runs if run.rtol == 1e-5), key=lambda run: run.seconds
    )
    header = lines.index(next(x for x in lines if x.startswith("to an error of 1e-05")))
    first = lines[header + 1]
    assert first.startswith(fastest.solver) and str(fastest.evaluations) in first
    (ax,) = result.figure().axes
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert "error" in ax.get_xlabel() and "microseconds" in ax.get_ylabel()
    drawn = {line.get_label(): line for line in ax.get_lines()}
    assert len(drawn["tuned"].get_xdata()) == 3


def test_without_matplotlib(result, monkeypatch):
    given = builtins.__import__

    def missing(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return given(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        result.figure()


def test_solvers_that_are_left_out(capsys):
    result = work_precision(
        *(MIXED, 1.0, 0.0, Y0),
        rtol=1e-5,
        solvers={
            "copies": dps.PresymplecticCoupled(4),
            "splitting": dps.TunedRKN6(),
            "low order": dps.PresymplecticTao(),
        },
        decades=0,
        repeats=1,
        max_steps=500,
    )
    assert result.fastest == "copies"
    assert "PresymplecticCoupled" in result.left_out["splitting"]
    assert "more than 500 steps" in result.left_out["low order at 1e-05"]
    assert "not measured: splitting" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("term, known", [(RELATIVISTIC, "TunedRKN6"), (MIXED, "Gauss")])
def test_the_solvers_by_default(term, known):
    result = work_precision(term, 0.0, 3.0, Y0, rtol=1e-4, decades=0, repeats=1)
    names = {run.solver for run in result.runs}
    assert any(known in name for name in names)
    assert {"Tsit5, adaptive", "Dopri8, adaptive", "Dopri8"} <= names
    assert any("Coupled" in name for name in names) == (term is MIXED)


@pytest.mark.parametrize(
    "changes, error, message",
    [
        ({"term": dfx.ODETerm(lambda t, y, args: y)}, ValueError, "HamiltonianTerm"),
        ({"rtol": 0.0}, ValueError, "must be positive, but got 0.0"),
        ({"ts": jnp.array([3.0, 2.0])}, ValueError, "work_precision.* must be sorted"),
        pytest.param(
            *({"rtol": 1e-15}, RuntimeError, "no reference solution"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *({"rtol": 1e-9, "max_steps": 40}, RuntimeError, "No solver reaches"),
            marks=pytest.mark.slow,
        ),
        ({"solvers": {"rkn": dps.TunedRKN6()}}, ValueError, "rkn: .*Coupled"),
    ],
)
def test_bad_input(changes, error, message):
    given = {
        **{"term": MIXED, "t0": 0.0, "t1": 1.0, "y0": Y0, "rtol": 1e-3},
        **{"decades": 0, "solvers": {"copies": dps.PresymplecticCoupled()}},
    }
    with pytest.raises(error, match=message):
        work_precision(**given | changes)


@pytest.mark.parametrize(
    "term, solver, per_step",
    [
        (PENDULUM, dps.PresymplecticLeapfrog(), 1),
        (PENDULUM, dps.BlanesMoan4(), 6),
        (RELATIVISTIC, dps.TunedRKN6(), 14),
        (MIXED, dps.PresymplecticCoupled(2), 3),
        (MIXED, dfx.Tsit5(), 6),
    ],
)
def test_counted_forces(term, solver, per_step):
    counter = Counter()
    counting = dps.HamiltonianTerm(counted(term.hamiltonian, counter))

    @eqx.filter_jit
    def solve(term):
        return dfx.diffeqsolve(term, solver, 0.0, 1.0, 1 / 8, Y0, GRAVITY).ys

    ys = solve(counting)
    jax.block_until_ready(ys)
    assert per_step * 8 <= counter.count <= per_step * 8 + 1
    assert eqx.tree_equal(ys, solve(term), rtol=1e-14)
    # Several at once.
    before, counter.count = counter.count, 0
    batch = lambda scale: jax.tree.map(lambda y: scale * y, Y0)
    many = jax.vmap(
        lambda scale: (
            dfx.diffeqsolve(counting, solver, 0.0, 1.0, 1 / 8, batch(scale), GRAVITY).ys
        )
    )
    jax.block_until_ready(many(jnp.array([1.0, 0.5, 0.2])))
    assert counter.count == 3 * before
