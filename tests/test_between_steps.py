"""Values between steps, from the ends of several: error, gradient, and where not."""

from typing import Any

import diffrax as dfx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import equations

import diffrax_presym as dps
from diffrax_presym._results import FRICTION_TOO_STRONG


T1, GAMMA = 20.0, 0.02
TS = np.linspace(0.0, T1, 161)
Y0 = jnp.array([1.5, -0.5]), jnp.array([0.0, 0.4])
RKN4, RKN8, GAUSS = dps.BlanesMoanRKN4(), dps.BlanesCasasRKN8(), dps.PresymplecticGauss


def potential(t, q, args):
    push = 0.3 * jnp.cos(1.2 * t) * q[0]
    return -jnp.sum(jnp.cos(q)) + 0.25 * (q[0] - q[1]) ** 2 - push


def system_of(gamma):
    friction = dps.ConstantDamping(gamma)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)


def exact(gamma, ts, y0=Y0):
    def slope(t, y):
        q, p = y[:2], y[2:]
        pull = 0.5 * (q[0] - q[1]) * np.array([1.0, -1.0])
        push = np.array([0.3 * np.cos(1.2 * t), 0.0])
        return np.concatenate([p, -np.sin(q) - pull + push - gamma * p])

    options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}
    start = np.concatenate([np.asarray(x) for x in y0])
    ends = float(ts[0]), float(ts[-1])
    y = scipy.integrate.solve_ivp(slope, ends, start, t_eval=ts, **options).y
    return y[:2].T, y[2:].T


def solve(solver, n, ts=TS, gamma=GAMMA, y0=Y0, **options):
    given = {"saveat": dfx.SaveAt(ts=jnp.asarray(ts)), "max_steps": 4096}
    given |= {"adjoint": dps.FixedStepAdjoint(), "throw": False}
    t0, t1 = (0.0, T1) if ts[0] < ts[-1] else (T1, 0.0)
    dt0 = None if "stepsize_controller" in options and n is None else (t1 - t0) / n
    return dfx.diffeqsolve(
        *(system_of(gamma), solver, t0, t1, dt0, y0), **(given | options)
    )


def errors(ys, right, at):
    """The largest at steps, and at all times, of positions and of momenta."""
    each = [
        np.max(np.abs(np.asarray(y) - x), axis=1)
        for y, x in zip(ys, right, strict=True)
    ]
    return [(np.max(x[at]), np.max(x)) for x in each]


# The steps with which each has an error of about 1e-3, and half of them.
SOLVERS = [
    (RKN4, 20),
    (dps.BlanesMoan4(), 32),
    (dps.Suzuki4(), 40),
    (dps.BlanesMoan6(), 20),
    (dps.SofroniouSpaletta(8), 40),
    (RKN8, 40),
    (GAUSS(2), 32),
    (GAUSS(4), 40),
    (dps.SymmetricMultistep(8), 80),
    (dps.Compensated(RKN4), 20),
]


@pytest.mark.parametrize("solver, n", SOLVERS)
@pytest.mark.parametrize("finer", [1, 2])
def test_the_error_between_steps_is_that_at_steps(solver, n, finer):
    right, n = exact(GAMMA, TS), n * finer
    sol = solve(solver, n)
    assert sol.stats["interpolated"] and sol.stats["num_steps"] == n
    at = slice(None, None, 160 // n) if 160 % n == 0 else np.arange(0, 161, 8)
    for here, all_times in errors(sol.ys, right, at):
        assert all_times <= 2 * here < 0.1


@pytest.mark.parametrize("solver", [RKN4, dps.BlanesMoan6()])
def test_backwards_and_by_prescribed_steps(solver):
    end = tuple(jnp.asarray(x[-1]) for x in exact(GAMMA, TS))
    ends = T1 * (np.arange(41) / 40 + 0.02 * np.sin(2 * np.pi * np.arange(41) / 40))
    steps = {"stepsize_controller": dfx.StepTo(jnp.asarray(ends)), "dt0": None}
    back = solve(solver, 40, TS[::-1], y0=end)
    there = solve(solver, None, stepsize_controller=steps["stepsize_controller"])
    for sol, ts in ((back, TS[::-1]), (there, TS)):
        assert sol.stats["interpolated"]
        right = exact(GAMMA, TS)
        right = [x[::-1] for x in right] if ts is not TS else right
        for here, all_times in errors(sol.ys, right, np.arange(0, 161, 4)):
            assert all_times <= 3 * here < 1e-3


def test_never_across_a_kink():
    knots, values = np.array([0.0, 4.3, 9.1, T1]), np.array([0.0, 1.0, -1.0, 0.5])
    force = lambda t, q, args: jnp.interp(t, knots, values) - q
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(force))
    y0 = jnp.zeros(1), jnp.zeros(1)

    def run(ts, dt0) -> Any:
        return dfx.diffeqsolve(
            *(system, RKN8, 0.0, T1, dt0, y0),
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dps.StepsBetween(knots),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        )

    sol = run(TS, 0.5)
    assert sol.stats["interpolated"]
    # Spans of two, two and three steps, and of one, one and two: too few.
    assert run(TS, 4.0).stats["interpolated"] == np.sum(TS > knots[2])
    assert not run(TS, 6.0).stats["interpolated"]
    fine = run(TS, T1 / 1600)
    assert np.stack(sol.ys) == pytest.approx(np.stack(fine.ys), abs=1e-9)


@pytest.mark.variants(4)
@pytest.mark.parametrize("gamma", [0.4, 2.9, 4.0, 400.0])
def test_strong_friction_takes_shorter_steps(gamma):
    sol = solve(RKN4, 40, gamma=gamma)
    assert bool(sol.stats["interpolated"]) == (gamma < 3)
    if gamma == 400.0:
        assert sol.result == FRICTION_TOO_STRONG
        return
    right = exact(gamma, TS)
    for here, all_times in errors(sol.ys, right, slice(None, None, 4)):
        assert all_times <= 10 * here


def test_few_steps_and_schemes_of_order_two_take_shorter_steps():
    assert not solve(RKN4, 2).stats["interpolated"]
    assert solve(RKN4, 3).stats["interpolated"]
    assert not solve(dps.PresymplecticLeapfrog(), 40).stats["interpolated"]


def test_values_at_the_ends_of_steps_cost_no_evaluation():
    calls = []

    def force(t, q, args):
        jax.debug.callback(lambda: calls.append(1))
        return -jnp.sin(q)

    system = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(force))

    def evaluations(ts) -> Any:
        calls.clear()
        sol: Any = dfx.diffeqsolve(
            *(system, RKN4, 0.0, T1, T1 / 40, (Y0[0] + 0.5, Y0[1])),
            saveat=dfx.SaveAt(ts=ts) if len(ts) else dfx.SaveAt(steps=True),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=40,
        )
        jax.block_until_ready(sol.ys)
        jax.effects_barrier()
        return len(calls), np.stack(sol.ys)

    alone, steps = evaluations(TS[:0])
    at_ends, ys = evaluations(TS[4::8])
    assert np.array_equal(ys, steps[:, ::2]) and at_ends == alone
    assert evaluations(TS[4::3])[0] > at_ends


GRADIENTS = [
    (RKN4, 40, {}),
    (RKN8, 40, {}),
    (dps.TunedRKN6(), 40, {"adjoint": dps.FixedStepAdjoint("checkpoints")}),
    (GAUSS(3), 40, {}),
    (RKN4, None, {"stepsize_controller": dfx.StepTo(jnp.linspace(0, T1, 41) ** 1)}),
    (dps.SymmetricMultistep(8), 160, {}),
    (RKN4, 40, {"saveat": "gaps"}),
    (RKN4, 40, {"saveat": "both"}),
    (RKN4, 40, {"stepsize_controller": dps.StepsBetween(np.array([4.0, 9.1]))}),
]


@pytest.mark.parametrize("solver, n, options", GRADIENTS)
def test_gradients_are_central_differences(solver, n, options):
    ts = jnp.asarray(TS[::5]) + 0.01 * jnp.where(jnp.arange(33) < 32, 1.0, 0.0)
    square = lambda t, y, args: y[0] ** 2 * jnp.cos(t) + y[1]
    saveat: Any = dfx.SaveAt(ts=ts, fn=square)
    if options.get("saveat") == "gaps":
        saveat = dfx.SaveAt(ts=ts.at[jnp.array([0, 3, 4, 32])].set(jnp.nan), fn=square)
    elif options.get("saveat") == "both":
        sub = dfx.SubSaveAt(ts=ts, fn=square)
        saveat = dfx.SaveAt(subs=[sub, dfx.SubSaveAt(ts=ts[::2], t0=True, steps=True)])
    options = {k: v for k, v in options.items() if k != "saveat"}

    @jax.jit
    def loss(x):
        y0 = Y0[0] + x[0], Y0[1]
        sol: Any = solve(solver, n, gamma=x[1], y0=y0, saveat=saveat, **options)
        ys = jax.flatten_util.ravel_pytree(sol.ys)[0]
        weights = jnp.cos(jnp.arange(ys.size, dtype=float))
        return jnp.sum(jnp.where(jnp.isfinite(ys), ys, 0.0) * weights)

    x, h = jnp.array([0.1, GAMMA]), 1e-5
    got = np.asarray(jax.jit(jax.grad(loss))(x))
    for i in range(2):
        e = h * jnp.eye(2)[i]
        difference = (loss(x + e) - loss(x - e)) / (2 * h)
        assert got[i] == pytest.approx(float(difference), rel=1e-6)


def _selected(jaxpr):
    """The shapes of what is selected anywhere in a program."""
    for equation in equations(jaxpr):
        if equation.primitive.name == "select_n":
            yield from (x.aval.shape for x in equation.outvars)


QUARTIC = dps.MechanicalSystem(
    dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q**4) / 4
)


@pytest.mark.parametrize("own", ["start", "times", "step"])
@pytest.mark.parametrize("varies", [False, True])
def test_a_batch_copies_nothing_that_was_saved(varies, own):
    members, number = 5, 37

    def saved(p, size, ts):
        control = dps.StepDensityController(size, QUARTIC)
        ys = dfx.diffeqsolve(
            *(QUARTIC, dps.BlanesMoanRKN4(), 0.0, 3.0, None if varies else size),
            (jnp.ones(2), p),
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=control if varies else dfx.ConstantStepSize(),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
            throw=False,
        ).ys
        assert ys is not None
        return ys[0]

    start = jnp.arange(2.0 * members).reshape(members, 2) / 4
    size, ts = jnp.array(0.1), jnp.linspace(0.1, 2.9, number)
    if own == "times":
        ts = jnp.sort(jax.random.uniform(jax.random.key(0), (members, number)) * 3)
    if own == "step":
        size = jnp.linspace(0.06, 0.1, members)
    each = start, size, ts
    axes = tuple(0 if x.shape[:1] == (members,) else None for x in each)
    program = jax.make_jaxpr(jax.vmap(saved, axes))(*each)
    shapes = list(_selected(program.jaxpr))
    assert len(shapes) > 10
    # After the loop rows that were not reached are filled, once.
    assert shapes.count((members, number, 2)) <= 4
    member = lambda i: [
        x if axis is None else x[i] for x, axis in zip(each, axes, strict=True)
    ]
    one_by_one = jnp.stack([saved(*member(i)) for i in range(members)])
    np.testing.assert_allclose(jax.vmap(saved, axes)(*each), one_by_one, rtol=1e-12)


@pytest.mark.variants(3)
@pytest.mark.parametrize("solver", [RKN4, dps.Strang()])
@pytest.mark.parametrize("kinks", [False, True])
@pytest.mark.parametrize("axes", ["inner", "outer", "both"])
def test_members_of_nested_batches_are_those_alone(solver, kinks, axes):
    """The times, the start or both in the inner, the outer or both batches."""
    more: Any = {}
    if kinks:
        times = jnp.array([0.21, 0.5]) * T1
        more = {"stepsize_controller": dps.StepsBetween(times)}
    shape = {"inner": (1, 3), "outer": (2, 1), "both": (2, 3)}[axes]
    ts = jnp.sort(jax.random.uniform(jax.random.key(1), (*shape, 9)) * T1)
    ts = jnp.broadcast_to(ts, (2, 3, 9))
    gammas = jnp.array([[0.05], [0.3]]) * jnp.ones((2, 3))

    def loss(gamma, ts):
        ys: Any = solve(solver, 40, gamma=gamma, saveat=dfx.SaveAt(ts=ts), **more).ys
        return jnp.sum(ys[0] ** 2 + jnp.cos(ts)[:, None] * ys[1]), ys

    run = jax.value_and_grad(loss, has_aux=True)
    if axes == "inner":
        batched = jax.vmap(lambda g: jax.vmap(lambda t: run(g, t))(ts[0]))(gammas[:, 0])
    elif axes == "outer":
        inner = jax.vmap(run, (0, None))
        batched = jax.vmap(inner)(gammas, ts[:, 0])
    else:
        batched = jax.vmap(jax.vmap(run))(gammas, ts)
    (_, ys), slopes = batched
    alone = jax.jit(run)
    for i, j in np.ndindex(2, 3):
        (_, wanted), slope = alone(gammas[i, j], ts[i, j])
        got = np.stack([y[i, j] for y in ys])
        np.testing.assert_allclose(got, np.stack(wanted), 1e-11, 1e-12)
        np.testing.assert_allclose(slopes[i, j], slope, 1e-9)


@pytest.mark.parametrize("gradient", ["reversal", "checkpoints"])
def test_a_gradient_of_a_batch_with_a_member_that_fails(gradient):
    """The rows of a member that failed are not visited on the way back."""

    def loss(stiffness):
        well = lambda t, q, args: stiffness * jnp.sum(q**2) / 2
        law = dps.ConstantDamping(0.3)
        sol: Any = dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), well, law),
            *(GAUSS(4), 0.0, 4.0, 0.2, (jnp.ones(1), jnp.ones(1))),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 9)),
            adjoint=dps.FixedStepAdjoint(gradient),
            **{"throw": False, "max_steps": 20},
        )
        return jnp.sum(sol.ys[0] ** 2), sol.result == dfx.RESULTS.successful

    slope = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))
    got, successful = slope(jnp.array([1.0, 1e4, 1.2]))
    assert successful.tolist() == [True, False, True]
    for i, stiffness in ((0, 1.0), (2, 1.2)):
        alone, _ = jax.jit(jax.grad(loss, has_aux=True))(stiffness)
        assert got[i] == pytest.approx(float(alone), rel=1e-10)


@pytest.mark.parametrize("solver", [RKN4, dps.Strang()])
def test_hessian(solver):
    """Of which only derivatives are a batch, not the values."""

    def loss(x):
        sol: Any = solve(solver, 40, y0=(x, Y0[1]))
        return jnp.sum(sol.ys[0][:, 0] ** 2)

    slope, h = jax.jit(jax.grad(loss)), 1e-5
    rows = [(slope(Y0[0] + e) - slope(Y0[0] - e)) / (2 * h) for e in h * jnp.eye(2)]
    got = jax.jit(jax.hessian(loss))(Y0[0])
    assert np.asarray(got) == pytest.approx(np.stack(rows), rel=1e-5, abs=1e-6)
