# pyright: reportOptionalOperand=false, reportOptionalMemberAccess=false
"""Forces with jumps and kinks: `choose_step` says so, and `StepsBetween` ends steps
there."""

import itertools
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from choosing import choose, cosine, RKN6, solve_of, system_of, Y0
from helpers import flat

import diffrax_presym as dps


RKN4 = dps.BlanesMoanRKN4()
KNOTS, PUSH = np.array([0.0, 1.3, 4.0, 7.7, 10.0]), np.array([0.0, 2.0, -1.0, 1.5, 0.0])


# A force of -1 that jumps to +1: whether a step sees it early or late is chance.


def after_a_jump(a):
    """The state at the time 2, from one and 0.3."""
    b = 2 - a
    return np.array([1.6 - a**2 / 2 - a * b + b**2 / 2, 0.3 - a + b])


JUMPS = np.random.default_rng(7).uniform(0.05, 1.95, 100)
OTHERS = dps.Strang(), dps.BlanesMoanRKN4(), dps.BlanesCasasRKN8()


@pytest.mark.variants(7)  # marked below
@pytest.mark.parametrize(
    "solver, jumps",
    [
        (dps.PresymplecticLeapfrog(), [0.9953608518777141, *JUMPS[:8]]),
        (RKN6, [1.3071239464485345, 0.777, *JUMPS[:8]]),
        *(
            pytest.param(solver, JUMPS, marks=pytest.mark.slow)
            for solver in (*OTHERS, dps.PresymplecticLeapfrog(), RKN6)
        ),
    ],
)
def test_jumps_inside_of_a_step_have_a_note(solver, jumps):
    system = system_of(lambda t, q, a: jnp.sum(q) * jnp.where(t < a, 1.0, -1.0), 0.0)

    @jax.jit
    def solve(dt0, a):
        y0 = jnp.array([1.0]), jnp.array([0.3])
        options: dict[str, Any] = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None}
        return dfx.diffeqsolve(system, solver, 0.0, 2.0, dt0, y0, a, **options)

    for a, tolerance in itertools.product(jumps, (1e-3, 1e-4, 1e-5)):
        at = lambda h, a=a: solve(h, a)
        try:
            step = dps.choose_step(at, 0.0, 2.0, rtol=tolerance, atol=tolerance)
        except RuntimeError as error:
            assert "no regular convergence" in str(error) or "needs" in str(error)
            continue
        exact = after_a_jump(a)
        error = np.abs(flat(solve(step.dt0, a).ys) - exact)
        if np.max(error / (1 + np.abs(exact))) > 2 * tolerance:
            assert not step.smooth and "StepsBetween" in str(step)


# `StepsBetween`, with a force from a table.

TABLE = system_of(
    lambda t, q, push: cosine(t, q, None) - jnp.interp(t, KNOTS, push) * jnp.sum(q)
)
BETWEEN = {"stepsize_controller": dps.StepsBetween(KNOTS[::-1])}


def by_scipy(t0, t1, y, knots=KNOTS, push=PUSH):
    """The state at `t1`, from knot to knot."""

    def rhs(t, y):
        q, p = np.split(y, 2)
        return np.append(p, np.interp(t, knots, push) - np.sin(q) - 0.1 * p)

    inner = [t for t in knots if min(t0, t1) < t < max(t0, t1)]
    for span in itertools.pairwise([t0, *(inner if t0 < t1 else inner[::-1]), t1]):
        sol = scipy.integrate.solve_ivp(rhs, span, y, "DOP853", rtol=1e-13, atol=1e-13)
        y = sol.y[:, -1]
    return y


@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), dfx.DirectAdjoint()])
@pytest.mark.parametrize("t0, t1", [(0.5, 9.0), (9.0, 0.5)])
def test_steps_between_kinks_keep_the_order(adjoint, t0, t1):
    options = {"args": jnp.asarray(PUSH), "adjoint": adjoint} | BETWEEN
    solve = solve_of(TABLE, RKN4, t0, t1, Y0, **options)
    exact = by_scipy(t0, t1, np.concatenate(Y0))
    sols = [solve(h if t0 < t1 else -h) for h in (0.2, 0.05)]
    ends = [np.concatenate([y[-1] for y in sol.ys]) for sol in sols]
    errors = [np.max(np.abs(end - exact)) for end in ends]
    assert errors[1] < 1e-7 and errors[0] / errors[1] > 4**3.5
    # Four, 14, 19 and seven steps.
    assert sols[0].stats["num_steps"] == 44


@pytest.mark.parametrize("t0, t1", [(0.0, 3.0), (3.0, 0.0)])
def test_values_between_kinks_that_a_force_finds_by_rounding(t0, t1):
    """To this force the time before a knot may be the knot."""
    spacing, table = 0.1, np.random.default_rng(0).normal(size=31)

    def push(t):
        left = jnp.clip(jnp.floor(t / spacing), 0, len(table) - 2)
        first, second = (jnp.asarray(table)[left.astype(int) + k] for k in (0, 1))
        return first + (t / spacing - left) * (second - first)

    potential = lambda t, q, args: cosine(t, q, None) - push(t) * jnp.sum(q)
    knots, ts = spacing * np.arange(len(table)), np.linspace(t0, t1, 48)
    sol = dfx.diffeqsolve(
        *(system_of(potential), RKN6, t0, t1, np.sign(t1 - t0) * spacing / 4, Y0),
        stepsize_controller=dps.StepsBetween(knots),
        adjoint=dps.FixedStepAdjoint(),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
    )
    assert sol.stats["interpolated"] > 40 and sol.ys is not None
    exact = [np.concatenate(Y0)]
    for first, last in itertools.pairwise(ts):
        exact.append(by_scipy(first, last, exact[-1], knots, table))
    values = np.concatenate([np.asarray(y) for y in sol.ys], axis=1)
    assert np.max(np.abs(values - exact)) < 1e-10


def test_a_kink_at_the_start_is_none():
    """Nothing is asked of a force before it, where this one is not defined."""
    potential = lambda t, q, args: jnp.sum(q**2) / 2 - (t - 1) ** 2.5 * jnp.sum(q)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    saveat = dfx.SaveAt(ts=jnp.array([1.03, 1.17, 1.4]))
    solve = lambda times: dfx.diffeqsolve(
        *(system, RKN4, 1.0, 2.0, 0.05, (jnp.ones(1), jnp.zeros(1))),
        stepsize_controller=dps.StepsBetween(jnp.array(times)),
        adjoint=dps.FixedStepAdjoint(),
        saveat=saveat,
    )
    with_start, without = solve([1.0, 1.5]), solve([1.5])
    assert with_start.result == dfx.RESULTS.successful
    assert eqx.tree_equal(with_start.ys, without.ys, rtol=1e-13)


@pytest.mark.slow
def test_steps_between_kinks_are_chosen_and_differentiated():
    options: dict[str, Any] = {"ts": jnp.array([2.0, 9.0])} | BETWEEN
    problem = TABLE, RKN4, 0.0, 10.0, Y0, 1e-7
    push = jnp.asarray(PUSH)
    step = choose(*problem, args=push, **options)
    assert step.order > 3.5 and "StepsBetween" not in str(step)

    def end(push):
        sol = solve_of(*problem[:-1], args=push, **options)(step.dt0)
        return jnp.sum(sol.ys[0] ** 2)

    along = jnp.array([0.3, -0.2, 0.5, 0.1, -0.4])
    difference = (end(push + 1e-5 * along) - end(push - 1e-5 * along)) / 2e-5
    assert jax.grad(end)(push) @ along == pytest.approx(float(difference), rel=1e-7)


# A force that jumps at the end of a step. Only the stages of triple jumps go beyond.
ORDERS = [
    (dps.BlanesMoan4(), 3.5, np.inf),
    (dps.BlanesMoan6(), 5, np.inf),
    (dps.BlanesMoanRKN6(), 5, np.inf),
    (dps.PresymplecticGauss(3), 5, np.inf),
    (dps.PresymplecticLeapfrog("position"), 1.8, np.inf),
    (RKN6, 5, np.inf),
    (RKN4, 3.5, np.inf),
    (dps.Strang(), 1.8, np.inf),
    (dps.Suzuki4(dps.Strang()), 3.5, np.inf),
    (dps.PresymplecticLeapfrog(), 1.8, np.inf),
    (dps.PresymplecticTao(3.0), 1.8, np.inf),
    (dps.SuzukiYoshida(4, dps.Strang()), 0.7, 2.0),
]


@pytest.mark.variants(len(ORDERS))
@pytest.mark.parametrize("solver, least, most", ORDERS)
def test_steps_that_end_where_a_force_jumps(solver, least, most):
    jump, t1 = 0.9, 2.0
    push = lambda t: jnp.where(t < jump, 1.0, -1.5)
    system = system_of(
        lambda t, q, args: cosine(t, q, None) - push(t) * jnp.sum(q), 0.0
    )
    between = {"stepsize_controller": dps.StepsBetween(np.array([jump]))}
    solve = solve_of(system, solver, 0.0, t1, Y0, **between)
    y = np.concatenate(Y0)
    for force, span in ((1.0, (0.0, jump)), (-1.5, (jump, t1))):
        rhs = lambda t, y, force=force: [*y[2:], *(force - np.sin(y[:2]))]
        y = scipy.integrate.solve_ivp(rhs, span, y, "DOP853", rtol=1e-13, atol=1e-13)
        y = y.y[:, -1]
    ends = [np.concatenate([x[-1] for x in solve(h).ys]) for h in (0.3, 0.15)]
    first, second = (np.max(np.abs(end - y)) for end in ends)
    assert least < np.log2(first / second) < most


LAWS = None, lambda t: 0.1 + 0.05 * jnp.sin(t), dps.ViscousDamping(np.eye(2) + 0.3)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("solver", [solver for solver, *_ in ORDERS])
def test_times_at_which_steps_end_anyway_change_nothing(solver, law):
    system, found = dps.MechanicalSystem(dps.QuadraticKinetic(), cosine, law), []
    for options in ({}, {"stepsize_controller": dps.StepsBetween(jnp.arange(1.0, 3))}):

        def end(y0, options=options):
            args: Any = system, solver, 0.0, 3.0, 0.1, y0
            adjoint = dps.FixedStepAdjoint(checkpoints=4)
            sol: Any = dfx.diffeqsolve(*args, adjoint=adjoint, **options)
            return jnp.sum(jnp.cos(sol.ys[0]) * sol.ys[1]), sol.ys

        found.append(flat(jax.jit(jax.value_and_grad(end, has_aux=True))(Y0)))
    np.testing.assert_allclose(*found, rtol=1e-10)


# To this function of time the time before a jump is after it.
early = lambda t, jump: t * (1 + 3e-16) >= jump


@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), dfx.DirectAdjoint()])
@pytest.mark.parametrize("ends", [(0.0, 3.0), (3.0, 0.0)])
@pytest.mark.parametrize(
    "above, solver, limit",
    [
        *((above, RKN6, 1e-12) for above in (jnp.greater, jnp.greater_equal)),
        (jnp.greater, dps.BlanesMoan4(), 1e-7),
        (early, dps.BlanesMoanRKN6(), 1e-12),
    ],
)
def test_values_beside_a_jump(adjoint, ends, above, solver, limit):
    """Whichever of the two values the force has at the time of the jump itself."""
    jumps, (t0, t1) = (1.0, 2.0), ends

    def potential(t, q, args):
        on = above(t, jumps[0]) & ~above(t, jumps[1])
        return jnp.sum(q**2) / 2 - jnp.sum(q) * jnp.where(on, 1.0, 0.0)

    near = [time + side for time in jumps for side in (-1e-3, -1e-6, 0.0, 1e-6, 1e-3)]
    ts = np.sort([*np.linspace(0.0, 3.0, 301), *near])[:: 1 if t0 < t1 else -1]

    def exact(t, x=0.0, v=1.0):
        begin, pull = t0, 0.0
        for end in (*(jumps if t0 < t1 else jumps[::-1]), t1):
            past = abs(t - t0) > abs(end - t0)
            angle, away = (end if past else t) - begin, x - pull
            x = pull + away * np.cos(angle) + v * np.sin(angle)
            v = v * np.cos(angle) - away * np.sin(angle)
            if not past:
                break
            begin, pull = end, 1.0 - pull
        return x, v

    sol: Any = dfx.diffeqsolve(
        dps.MechanicalSystem(dps.QuadraticKinetic(), potential),
        *(solver, t0, t1, 0.1 if t0 < t1 else -0.1, (jnp.zeros(1), jnp.ones(1))),
        stepsize_controller=dps.StepsBetween(jnp.array(jumps)),
        adjoint=adjoint,
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
    )
    right = np.array([exact(t) for t in ts])
    assert np.max(np.abs(np.concatenate(sol.ys, axis=1) - right)) < limit


@pytest.mark.parametrize(
    "solver", [RKN6, dps.Compensated(RKN4), dps.PresymplecticTao(3.0), dps.Strang()]
)
@pytest.mark.parametrize("above", [jnp.greater, jnp.greater_equal])
def test_gradients_of_values_beside_a_jump(solver, above):
    """The same by all ways back through the steps, and central differences."""
    jumps, ts = jnp.array([0.7, 1.6]), jnp.linspace(0.0, 2.3, 24)

    def potential(t, q, height):
        on = above(t, jumps[0]) & ~above(t, jumps[1])
        return cosine(t, q, None) - height * jnp.sum(q) * jnp.where(on, 1.0, -0.5)

    system = system_of(potential, 0.1)

    def loss(height, y0, adjoint):
        sol: Any = dfx.diffeqsolve(
            *(system, solver, 0.0, 2.3, 0.12, y0, height),
            stepsize_controller=dps.StepsBetween(jumps),
            saveat=dfx.SaveAt(ts=ts),
            adjoint=adjoint,
            max_steps=64,
        )
        weights = jnp.cos(jnp.arange(24.0))[:, None]
        return sum(jnp.sum(weights * y**2) for y in sol.ys)

    own, found = [("reversal", 2), ("reversal", None), ("checkpoints", 3)], []
    for adjoint in (*(dps.FixedStepAdjoint(*x) for x in own), dfx.DirectAdjoint()):
        slopes = jax.jit(jax.grad(partial(loss, adjoint=adjoint), (0, 1)))
        found.append(flat(slopes(0.8, Y0)))
    value = jax.jit(partial(loss, y0=Y0, adjoint=dps.FixedStepAdjoint()))
    difference = (value(0.8 + 1e-5) - value(0.8 - 1e-5)) / 2e-5
    assert found[0][0] == pytest.approx(float(difference), rel=1e-8)
    np.testing.assert_allclose(found[1:3], [found[0]] * 2, rtol=1e-10)
    if not isinstance(solver, dps.PresymplecticTao):  # whose copies start anew there
        # Between steps Diffrax's loop interpolates otherwise.
        np.testing.assert_allclose(found[3], found[0], rtol=1e-2)


# Spans of one and two steps between others, at the ends and within.
SHORT = np.array([[0.03, 2.0, 2.01, 2.18, 5.0], [3.0, 3.0, 3.05, 3.06, 5.95]])


def test_only_values_in_spans_of_few_steps_are_shorter_steps():
    y0, ts = Y0, np.linspace(0.0, 6.0, 181)
    system = system_of(lambda t, q, args: cosine(t, q, None), 0.1)

    def solve(y0, times):
        sol: Any = dfx.diffeqsolve(
            *(system, dps.BlanesMoanRKN6(), 0.0, 6.0, 0.1, y0),
            stepsize_controller=dps.StepsBetween(times),
            adjoint=dps.FixedStepAdjoint(),
            saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        )
        weights = jnp.cos(jnp.arange(181.0))[:, None]
        return sum(jnp.sum(weights * y**2) for y in sol.ys), (sol.ys, sol.stats)

    exact = [np.concatenate(y0)]
    for first, last in itertools.pairwise(ts):
        exact.append(by_scipy(first, last, exact[-1], *np.zeros((2, 1))))
    slopes, both = [], jax.jit(jax.value_and_grad(solve, has_aux=True))
    for times in SHORT:
        (_, (ys, stats)), slope = both(y0, jnp.asarray(times))
        values = np.concatenate(ys, axis=1)
        assert np.max(np.abs(values - exact)) < 1e-10
        # As many as there are in steps of 0.1 or more, but a few.
        assert 170 <= stats["interpolated"] <= 181
        slopes.append(flat(slope))
    value = lambda q: float(both((q, y0[1]), jnp.asarray(SHORT[0]))[0][0])
    difference = (value(y0[0] + 1e-5) - value(y0[0] - 1e-5)) / 2e-5
    size = len(np.ravel(y0[0]))
    assert np.sum(slopes[0][:size]) == pytest.approx(difference, rel=1e-7)
    # In a batch a value may be interpolated in some members alone.
    batch = jnp.array([[1.0, 2.0, 3.0, 4.0, 5.0], *SHORT])
    (_, (ys, _)), slope = jax.jit(jax.vmap(both, (None, 0)))(y0, batch)
    for i, times in enumerate(batch):
        (_, (alone, _)), one = both(y0, times)
        np.testing.assert_allclose(ys[0][i], alone[0], rtol=1e-12, atol=1e-14)
        of_member = flat(jax.tree.map(lambda x, i=i: x[i], slope))
        np.testing.assert_allclose(of_member, flat(one), rtol=1e-10)
