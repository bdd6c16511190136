"""The loop over steps known beforehand, against that of Diffrax."""

import math
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from helpers import assert_close

import diffrax_presym as dps
from diffrax_presym import _loop
from diffrax_presym._scan import equations
from diffrax_presym._solver import _extension, _splitting


DIFFRAX = dfx.RecursiveCheckpointAdjoint()
OURS = dps.ReversibleAdjoint(), dps.FixedStepAdjoint()
T0, T1 = 0.3, 2.5


def potential(t, q, args):
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.sin(t) * q[0]


SYSTEM = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(), potential, dps.LogDamping(2.0, shift=0.1)
)


def energy(t, y, args):
    q, p = y
    return {"energy": jnp.sum(p**2) / 2 + potential(t, q, args), "t": t}


@eqx.filter_jit
def solve(adjoint, solver, saveat, t0=T0, t1=T1, dt0: Any = 0.1, dtype=None, **kwargs):
    cast = lambda x: jnp.asarray(x, float if dtype is None else dtype)
    options: dict[str, Any] = {"max_steps": 64} | kwargs
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(SYSTEM),
        solver,
        cast(t0),
        cast(t1),
        None if dt0 is None else cast(dt0),
        (cast([1.0, 0.5]), cast([0.0, 0.3])),
        args=cast(1.3),
        adjoint=adjoint,
        saveat=saveat,
        **options,
    )


def recorded(sol):
    """All that a user can see of a solution."""
    dense = None
    if sol.interpolation is not None:
        ts = jnp.linspace(sol.t0, sol.t1, 7)
        dense = jax.vmap(sol.evaluate)(ts)
    stats = sol.stats["num_steps"], sol.stats["num_accepted_steps"]
    states = sol.solver_state, sol.controller_state
    return sol.ts, sol.ys, dense, states, stats, sol.t0, sol.t1


def check(solver, saveat, tolerance=1e-12, **kwargs):
    theirs = solve(DIFFRAX, solver, saveat, **kwargs)
    for adjoint in OURS:
        sol = solve(adjoint, solver, saveat, **kwargs)
        assert sol.result == theirs.result
        # The rows that are not saved are infinite in both.
        ours, exact = (jtu.tree_leaves(recorded(x)) for x in (sol, theirs))
        for a, b in zip(ours, exact, strict=True):
            assert jnp.shape(a) == jnp.shape(b)
            assert jnp.result_type(a) == jnp.result_type(b) or a.dtype.kind == "i"
            np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
            keep = np.isfinite(a)
            assert_close(np.asarray(a)[keep], np.asarray(b)[keep], tolerance)


def random_sub(rng, t0, t1):
    """What to save, by chance."""
    # Some coincide with steps, with each other, or with the ends.
    low, high = min(t0, t1), max(t0, t1)
    special = [t0, t1, *np.linspace(t0, t1, 23)[[3, 3, 10]]]
    ts = rng.choice([*special, *rng.uniform(low, high, 5)], 6)
    kind = rng.integers(1, 8)
    return dfx.SubSaveAt(
        ts=jnp.sort(ts)[:: 1 if t1 >= t0 else -1] if kind & 1 else None,
        steps=int(rng.integers(1, 6)) if kind & 2 else 0,
        t1=bool(kind & 4),
        t0=bool(rng.integers(2)),
        fn=energy if rng.integers(2) else dfx.SubSaveAt(t1=True).fn,
    )


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(i, marks=pytest.mark.slow) for i in range(2, 24))]
)
def test_whatever_is_saved(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    t0, t1 = (T0, T1) if rng.integers(2) else (T1, T0)
    dt0 = (t1 - t0) / 22 if rng.integers(2) else np.sign(t1 - t0) * 0.09
    subs = [random_sub(rng, t0, t1) for _ in range(rng.integers(1, 3))]
    saveat = dfx.SaveAt(subs=subs[0] if len(subs) == 1 else subs)
    max_steps = int(rng.choice([23, 64]))
    # As for large states, whose outputs between steps are computed one by one, and for
    # forces that take long, by the continuous extension, in the loop and after it.
    place = rng.integers(4)
    large, extended, kept = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 1)][place]
    monkeypatch.setattr(_loop, "_LARGE", 0 if large else 10**6)
    monkeypatch.setattr(_loop, "_LARGE_EXTENDED", 10**6 if kept else 0)
    monkeypatch.setattr(_extension, "_OVERHEAD", 0 if extended else math.inf)
    # Steps so short that interpolation is almost right to rounding.
    kwargs = dict(t0=t0, t1=t1, dt0=dt0, max_steps=max_steps, throw=False)
    check(dps.BlanesMoanRKN6(), saveat, 1e-9 if extended else 1e-10, **kwargs)
    jax.clear_caches()


def test_what_is_saved_is_not_scattered():
    # On a CPU a scatter of 200 rows takes as long as a short solve.
    ts = jnp.linspace(T0, T1, 30)
    for saveat in (
        dfx.SaveAt(t0=True, t1=True, ts=ts),
        dfx.SaveAt(t0=True, t1=True, steps=2),
    ):
        saved = lambda dt0, saveat=saveat: recorded(
            solve(OURS[0], dps.TunedRKN6(), saveat, dt0=dt0)
        )[:2]
        eqns = equations(jax.make_jaxpr(saved)(0.1).eqns)
        assert not [x for x in eqns if x.primitive.name.startswith("scatter")]


SAVEAT = dfx.SaveAt(t0=True, t1=True, steps=3, ts=jnp.array([0.5, 0.5, 0.9, 2.4]))


def test_too_many_steps():
    for max_steps in (1, 7):
        kwargs: Any = dict(max_steps=max_steps, throw=False)
        check(dps.PresymplecticLeapfrog(), SAVEAT, 1e-3, **kwargs)
    with pytest.raises(Exception, match="maximum number of solver steps"):
        sol = solve(OURS[0], dps.PresymplecticLeapfrog(), SAVEAT, max_steps=7)
        jax.block_until_ready(sol.ys)


def funnel(t, q, args):
    return jnp.sum(jnp.sqrt(q))


@eqx.filter_jit
def run_into_funnel(adjoint, solver, saveat, q):
    system = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), funnel, dps.ConstantDamping(0.1)
    )
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(system),
        solver,
        *(T0, T1, 0.1, (q, jnp.zeros(1))),
        saveat=saveat,
        adjoint=adjoint,
        throw=False,
        max_steps=64,
    )


FAILING = {
    # Times in each step, also in the one that fails.
    "all": dfx.SaveAt(ts=jnp.linspace(T0, T1, 45), steps=2, t1=True),
    "steps": dfx.SaveAt(t0=True, steps=1),
    "times": dfx.SaveAt(ts=jnp.linspace(T0, T1, 45)),
}


@pytest.mark.parametrize("saved", FAILING)
def test_a_batch_in_which_solves_fail(saved):
    """Each as alone in Diffrax's loop, with as many rows."""
    solver = dps.Checked(dps.PresymplecticLeapfrog())
    run: Any = run_into_funnel
    of = lambda adjoint: lambda q: run(adjoint, solver, FAILING[saved], q)
    # The first fails earlier than the second, the last does not.
    qs = jnp.array([[0.3], [1.0], [9.0]])
    visible = lambda sol: (sol.result == dfx.RESULTS.successful, sol.ts, sol.ys)
    went_well, times, states = jax.vmap(lambda q: visible(of(OURS[0])(q)))(qs)
    numbers = jnp.sum(jnp.isfinite(times), axis=1)
    assert 1 < numbers[0] < numbers[1] < numbers[2]
    for k, q in enumerate(qs):
        one, theirs = (of(adjoint)(q) for adjoint in (OURS[0], DIFFRAX))
        failed = theirs.result != dfx.RESULTS.successful
        assert failed == (k < 2) != went_well[k] and one.result == theirs.result
        np.testing.assert_allclose(one.ts, theirs.ts, rtol=1e-15)
        np.testing.assert_allclose(times[k], one.ts, rtol=1e-15)
        for batch, a, b in zip(states, one.ys, theirs.ys, strict=True):
            np.testing.assert_allclose(batch[k], a, rtol=1e-13)
            np.testing.assert_array_equal(np.isinf(a), np.isinf(b))
            # Between steps they differ by the interpolation, which is not a number in
            # the step that fails.
            known = np.isfinite(b)
            np.testing.assert_allclose(a[known], b[known], atol=0.02)


@pytest.mark.parametrize(
    "solver", [dps.Checked(dps.PresymplecticLeapfrog()), dps.PresymplecticGauss(2)]
)
def test_a_batch_of_solves_that_may_fail_stops_at_the_same_steps(solver, monkeypatch):
    """Otherwise the rows of all solves would be copied at each of the steps."""
    monkeypatch.setattr(_extension, "_OVERHEAD", 0)
    number = 37
    saveat = dfx.SaveAt(ts=jnp.linspace(T0, T1, number))
    batch = jax.vmap(lambda q: run_into_funnel(OURS[0], solver, saveat, q).ys)
    jax.clear_caches()
    eqns = jax.make_jaxpr(batch)(jnp.ones((3, 1))).eqns
    loops = [
        x.params["body_jaxpr"] for x in equations(eqns) if "body_jaxpr" in x.params
    ]
    assert loops
    stored = [
        x.invars[1].aval.shape
        for x in equations([y for loop in loops for y in loop.eqns])
        if x.primitive.name == "scatter" and number in x.outvars[0].aval.shape
    ]
    # Each at one index, not at one for each solve.
    assert stored and all(len(shape) == 1 for shape in stored)


@pytest.mark.parametrize(
    "t0, t1, dt0", [(T0, T1, 0.09), (T1, T0, -0.09), (T0, T0, 0.1)]
)
def test_single_precision_and_zero_length(t0, t1, dt0):
    ts = jnp.linspace(t0, t1, 4, dtype=jnp.float32)
    saveat = dfx.SaveAt(t0=True, t1=True, steps=2, ts=ts)
    kwargs: Any = dict(t0=t0, t1=t1, dt0=dt0, dtype=jnp.float32)
    check(dps.BlanesMoanRKN4(), saveat, 3e-5, **kwargs)


def test_prescribed_steps_and_solver_state():
    steps = jnp.array([T0, 0.35, 0.5, 0.9, 1.3, 1.9, T1])
    saveat = dfx.SaveAt(
        steps=2, t1=True, solver_state=True, controller_state=True, made_jump=True
    )
    controller = dfx.StepTo(steps)
    check(dps.PresymplecticLeapfrog(), saveat, dt0=None, stepsize_controller=controller)
    check(dps.PresymplecticLeapfrog(), saveat)


@pytest.mark.parametrize("large", [0, 10**6], ids=["one by one", "at once"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_times_that_are_steps_but_for_rounding(dtype, large, monkeypatch):
    """They are not computed by shorter steps, which would be as expensive as steps."""
    monkeypatch.setattr(_loop, "_LARGE", large)
    n, every, forces = 40, 2, []
    times = np.linspace(T0, T1, n // every + 1, dtype=dtype)
    ends = dtype(T0) + dtype(T1 - T0) * (np.arange(n + 1, dtype=dtype) / n)
    assert not np.isin(times, ends).all()

    def force(t, q, args):
        jax.debug.callback(lambda: forces.append(1))
        return -jnp.sin(q)

    @jax.jit
    def run(ts):
        saveat = dfx.SaveAt(t0=ts is None, steps=every if ts is None else 0, ts=ts)
        return dfx.diffeqsolve(
            dps.HamiltonianTerm(dps.VectorField(lambda t, p, args: p, force)),
            dps.PresymplecticYoshida4("position"),
            *(dtype(T0), dtype(T1), dtype((T1 - T0) / n)),
            (jnp.ones(2, dtype), jnp.zeros(2, dtype)),
            saveat=saveat,
            adjoint=OURS[1],
            max_steps=n,
        ).ys

    at_steps = jax.block_until_ready(run(None))
    jax.effects_barrier()
    evaluations = len(forces)
    at_times = jax.block_until_ready(run(jnp.asarray(times)))
    jax.effects_barrier()
    assert evaluations >= 3 * n and len(forces) == 2 * evaluations
    for a, b in zip(at_times, at_steps, strict=True):
        np.testing.assert_array_equal(a, b[: len(times)])


@pytest.mark.parametrize("large", [0, 10**6], ids=["one by one", "at once"])
def test_times_close_to_steps_are_not_these_steps(large, monkeypatch):
    """Rounding is that of the time itself, also if steps are of very unequal size."""
    monkeypatch.setattr(_loop, "_LARGE", large)
    grid = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 15)])
    ts = np.asarray(grid[1:-1] * (1 + 1e-4), np.float32)
    grid = np.asarray(grid, np.float32)
    # Uniform motion, of which every scheme is exact.
    uniform = dps.VectorField(lambda t, p, args: p, lambda t, q, args: 0 * q)
    sol: Any = dfx.diffeqsolve(
        dps.HamiltonianTerm(uniform),
        dps.PresymplecticLeapfrog(),
        *(grid[0], grid[-1], None),
        (jnp.zeros(1, "float32"), jnp.ones(1, "float32")),
        stepsize_controller=dfx.StepTo(jnp.asarray(grid)),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        adjoint=OURS[1],
    )
    np.testing.assert_allclose(sol.ys[0][:, 0], ts, rtol=1e-6)


def test_dense_output():
    check(dps.BlanesMoanRKN4(), dfx.SaveAt(dense=True, t1=True), max_steps=30)


def test_a_progress_meter(capfd):
    meter: Any = dfx.TextProgressMeter(minimum_increase=0.5)
    saveat = dfx.SaveAt(t1=True)
    sol = solve(OURS[0], dps.PresymplecticLeapfrog(), saveat, progress_meter=meter)
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    assert "100.00%" in capfd.readouterr().out


# Between steps


def pendulum(t, q, args):
    return 1 - jnp.cos(q)


PENDULUM = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(), pendulum, dps.ConstantDamping(0.05)
)


def errors_of(adjoint, solver, dt0, reference):
    """The largest errors at steps, and between them."""
    ts = jnp.linspace(0.0, 8.0, reference[0].shape[0])
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(PENDULUM),
        solver,
        *(0.0, 8.0, dt0, (jnp.asarray(2.0), jnp.asarray(0.3))),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=adjoint,
    )
    error = jnp.abs(jnp.stack(jtu.tree_map(jnp.subtract, sol.ys, reference)))
    return jnp.max(error[:, :: round(8 * dt0)]), jnp.max(error)


@pytest.fixture(scope="module")
def reference():
    ts = jnp.linspace(0.0, 8.0, 65)
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(PENDULUM),
        dfx.Dopri8(),
        *(0.0, 8.0, None, (jnp.asarray(2.0), jnp.asarray(0.3))),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.StepTo(jnp.linspace(0.0, 8.0, 65 * 8 - 7)),
    ).ys


@pytest.mark.parametrize(
    "solver, dt0",
    [
        (dps.PresymplecticLeapfrog(), 0.25),
        (dps.BlanesMoanRKN4(), 1.0),
        (dps.TunedRKN6(), 1.0),
        pytest.param(dps.TunedRKN6(), 2.0, marks=pytest.mark.slow),
        pytest.param(dps.Suzuki4(), 0.5, marks=pytest.mark.slow),
        pytest.param(dps.BlanesCasasRKN8(), 1.0, marks=pytest.mark.slow),
        pytest.param(dps.SofroniouSpaletta10(), 2.0, marks=pytest.mark.slow),
        pytest.param(dps.PresymplecticGauss(4), 1.0, marks=pytest.mark.slow),
        pytest.param(dps.PresymplecticCoupled(4), 0.25, marks=pytest.mark.slow),
    ],
    ids=lambda x: type(x).__name__,
)
@pytest.mark.parametrize("loop", ["diffrax", "ours", "extension"])
def test_the_error_between_steps_is_that_at_steps(
    solver, dt0, loop, reference, monkeypatch
):
    if loop == "extension":
        monkeypatch.setattr(_extension, "_OVERHEAD", 0)
        kinds = _splitting.AbstractSplitting, dps.PresymplecticGauss
        if not isinstance(solver, kinds):
            pytest.skip("no extension")
    adjoint = DIFFRAX if loop == "diffrax" else OURS[0]
    at_steps, anywhere = errors_of(adjoint, solver, dt0, reference)
    assert 1e-12 < anywhere < 3 * at_steps


def test_friction_that_is_infinite_at_the_start():
    system = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), lambda t, q, args: q**2 / 2, dps.LogDamping(3.0)
    )
    ts = jnp.array([0.0, 1e-3, 0.1, 0.2, 0.31, 1.0])

    def run(adjoint, q) -> Any:
        return dfx.diffeqsolve(
            dps.HamiltonianTerm(system),
            dps.BlanesMoanRKN4(),
            *(0.0, 1.0, 0.1, (q, jnp.zeros(()))),
            saveat=dfx.SaveAt(ts=ts),
            adjoint=adjoint,
        ).ys

    # q = 2 J_1(t) / t, of which the first terms suffice.
    q = 1 - ts**2 / 8 + ts**4 / 192 - ts**6 / 9216
    p = -ts / 4 + ts**3 / 48 - ts**5 / 1536 + ts**7 / 92160
    one = jnp.asarray(np.float64(1.0))
    assert_close(run(DIFFRAX, one), (q, p), 3e-6)
    for adjoint in OURS:
        assert_close(run(adjoint, one), (q, p), 3e-6)
        # The equation is linear.
        slope = jax.jacrev(lambda q, adjoint=adjoint: run(adjoint, q)[0])(one)
        assert_close(slope, q, 3e-6)


def test_a_potential_called_on_the_host():
    def force(q):
        return np.asarray(-np.sin(q), q.dtype)

    def run(adjoint, q0):
        system = dps.VectorField(
            lambda t, p, args: p,
            lambda t, q, args: jax.pure_callback(force, q, q),
            dps.ConstantDamping(0.1),
        )
        return dfx.diffeqsolve(
            dps.HamiltonianTerm(system),
            dps.PresymplecticLeapfrog(),
            *(0.0, 1.0, 0.01, (q0, jnp.zeros(1))),
            saveat=dfx.SaveAt(ts=jnp.array([0.111, 0.555])),
            adjoint=adjoint,
        ).ys

    assert_close(run(OURS[0], jnp.ones(1)), run(DIFFRAX, jnp.ones(1)), 1e-6)


# Batches


def test_nothing_but_states_is_batched():
    """Under `vmap` the steps of a gradient are counted once for all trajectories."""
    saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 7))

    def loss(q):
        sol: Any = dfx.diffeqsolve(
            dps.HamiltonianTerm(PENDULUM),
            dps.PresymplecticLeapfrog(),
            *(0.0, 2.0, 0.1, (q, 0 * q)),
            saveat=saveat,
            adjoint=OURS[0],
        )
        return sum(jnp.sum(y**2) for y in sol.ys)

    q = jnp.linspace(0.5, 2.0, 5)
    jaxpr = jax.make_jaxpr(jax.vmap(jax.grad(loss)))(q)
    loops = [e for e in equations(jaxpr.eqns) if e.primitive.name == "while"]
    assert loops
    for loop in loops:
        # A batched condition makes every number in the loop batched.
        (out,) = loop.params["cond_jaxpr"].out_avals
        assert out.shape == ()
        counters = [x for x in loop.params["body_jaxpr"].out_avals if x.dtype == int]
        assert all(x.shape == () for x in counters)
    together = jax.vmap(jax.grad(loss))(q)
    assert_close(together[3], jax.grad(loss)(q[3]), 1e-13)
