"""Events: their times, derivatives of these, and continuation after events."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, flat, oscillator, pendulum

import diffrax_presym as dps


GAMMA = 0.2
FINDER = optx.Newton(1e-13, 1e-13)


def system(gamma=GAMMA):
    return dps.MechanicalSystem(
        dps.QuadraticKinetic(), pendulum, dps.ConstantDamping(gamma)
    )


def through_the_bottom(t, y, args, **kwargs):
    return y[0]


def past_the_bottom(t, y, args, **kwargs):
    return y[0] < 0


def turning(t, y, args, **kwargs):
    return y[1]


def swing(solver, dt0, gamma=GAMMA, q0=1.5, **kwargs):
    """A pendulum released at rest, until the event or t = 10."""
    return dfx.diffeqsolve(
        system(gamma),
        solver,
        t0=jnp.array(0.0),
        t1=jnp.array(10.0),
        dt0=jnp.asarray(dt0),
        y0=(jnp.asarray(q0), jnp.array(0.0)),
        event=dfx.Event(through_the_bottom, FINDER),
        **kwargs,
    )


def last(sol):
    return jax.tree.map(lambda x: x[-1], (sol.ts, *sol.ys))


OMEGA = np.sqrt(1 - GAMMA**2 / 4)
# The first zero of the damped oscillator, released at rest.
FIRST_ZERO = (np.pi - np.arctan2(2 * OMEGA, GAMMA)) / OMEGA
SLOWED = np.exp(-GAMMA * FIRST_ZERO / 2) * np.sin(OMEGA * FIRST_ZERO) / OMEGA
RELEASED, AT_ZERO = (jax.tree.map(jnp.array, y) for y in ((1.0, 0.0), (0.0, -SLOWED)))


@pytest.mark.parametrize(
    "t0, t1, y0, event, expected",
    [
        (0.0, 10.0, RELEASED, through_the_bottom, FIRST_ZERO),
        (FIRST_ZERO, -1.0, AT_ZERO, turning, 0.0),
    ],
    ids=["forwards", "backwards"],
)
def test_the_time_of_an_event(t0, t1, y0, event, expected):
    sol = dfx.diffeqsolve(
        *(oscillator(GAMMA), dps.BlanesMoanRKN6(), t0, t1),
        dt0=0.125 * np.sign(t1 - t0),
        y0=y0,
        event=dfx.Event(event, FINDER),
    )
    assert abs(last(sol)[0] - expected) < 1e-7


# Continuation, for each kind of solver state: the force of a nested scheme, that of a
# splitting, a copy.

GOING_ON = {
    "Yoshida": dps.SuzukiYoshida(4),
    "splitting": dps.BlanesMoanRKN4(),
    "Tao": dps.PresymplecticTao(5.0),
}


@eqx.filter_jit
def _let_go(solver, t0, t1, y0, solver_state, made_jump, event):
    return dfx.diffeqsolve(
        *(system(), solver, t0, t1, jnp.array(0.125), y0),
        solver_state=solver_state,
        made_jump=made_jump,
        event=event,
        saveat=dfx.SaveAt(t0=True, steps=True, solver_state=True),
        max_steps=64,
    )


def let_go(solver, t0, t1, y0, event=None, solver_state=None, made_jump=False):
    if solver_state is None:
        term = system()
        solver_state = solver.init(term, t0, t1, y0, None)
    # An array, to compile once for both values.
    return _let_go(solver, t0, t1, y0, solver_state, jnp.array(made_jump), event)


def every(sol):
    """All saved times and states."""
    saved = np.isfinite(sol.ts)
    return jax.tree.map(lambda x: x[saved], (sol.ts, *sol.ys))


def ending(sol):
    return jax.tree.map(lambda x: x[-1], every(sol))


START = jnp.array(0.0), jnp.array(4.0), (jnp.array(1.5), jnp.array(0.0))


@pytest.mark.variants(1)
@pytest.mark.parametrize("solver", GOING_ON.values(), ids=GOING_ON)
def test_where_a_solver_state_belongs(solver):
    whole = let_go(solver, *START)
    # A boolean event is at the end of its step, to which the solver state belongs, so a
    # continuation is bitwise equal to a single solve.
    stopped = let_go(solver, *START, event=dfx.Event(past_the_bottom))
    t, *y = ending(stopped)
    rest = let_go(solver, t, START[1], tuple(y), solver_state=stopped.solver_state)
    n = len(every(stopped)[0])
    assert_close(every(rest), jax.tree.map(lambda x: x[n - 1 :], every(whole)), 0)

    # With a root finder, the event is inside the step, but the solver state still
    # belongs to its end.
    event = dfx.Event(through_the_bottom, FINDER)
    within = let_go(solver, *START, event=event)
    assert_close(within.solver_state, stopped.solver_state, 1e-14)
    assert ending(within)[0] < t
    t, *y = ending(within)
    fresh = let_go(solver, t, START[1], tuple(y))
    carry = within.solver_state
    stale = let_go(solver, t, START[1], tuple(y), solver_state=carry)
    assert np.max(np.abs(flat(ending(stale)) - flat(ending(fresh)))) > 1e-4
    # With `made_jump` the solver state is recomputed.
    renewed = let_go(solver, t, START[1], tuple(y), solver_state=carry, made_jump=True)
    assert_close(ending(renewed), ending(fresh), 1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, adjoint",
    [
        (dps.PresymplecticLeapfrog(), dfx.DirectAdjoint()),
        (dps.BlanesMoanRKN6(), dfx.RecursiveCheckpointAdjoint()),
        (dps.PresymplecticTao(5.0), dfx.ForwardMode()),
    ],
)
def test_event_time_is_differentiable(solver, adjoint):
    def time(x):
        options = {"adjoint": adjoint, "max_steps": 128}
        return last(swing(solver, 0.1, gamma=x[0], q0=x[1], **options))[0]

    x, e = jnp.array([GAMMA, 1.5]), 1e-5
    slope = jax.jacfwd if isinstance(adjoint, dfx.ForwardMode) else jax.grad
    found, time = slope(time)(x), jax.jit(time)
    wanted = [(time(x + e * d) - time(x - e * d)) / (2 * e) for d in np.eye(2)]
    np.testing.assert_allclose(found, wanted, atol=1e-7)
    assert abs(found[0]) > 0.1


# Steps that vary

PLANET = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -1 / jnp.linalg.norm(q + jnp.array([0.0, 0.1])),
)


def above_the_floor(t, y, args, **kwargs):
    return y[0][1]


@eqx.filter_jit
def fly(t0, t1, y0, event=True, **kwargs):
    """Above a floor at a tenth of the height of the start, by variable steps."""
    floor = dfx.Event(above_the_floor, FINDER, direction=False) if event else None
    options: Any = {"dt0": None} | kwargs
    return dfx.diffeqsolve(
        *(PLANET, dps.BlanesMoanRKN6(), t0, t1),
        y0=y0,
        stepsize_controller=dps.StepDensityController(0.05, PLANET),
        event=floor,
        saveat=dfx.SaveAt(t0=True, steps=True),
        max_steps=256,
        **options,
    )


def test_variable_steps_are_reversible_between_events():
    """Ten flights, each begun anew where the one before it ends: from its last step
    each goes back to its start by the same steps, and no flight loses energy."""
    t, y, energies = jnp.array(0.0), (jnp.array([0.0, 1.0]), jnp.array([0.2, 0.0])), []
    for _ in range(10):
        sol: Any = fly(t, t + 20.0, y)
        assert sol.result == dfx.RESULTS.event_occurred
        ts, *ys = every(sol)
        h = np.diff(ts)[:-1]  # The last one ends at the event, inside of a step.
        assert h.max() > 3 * h.min() and len(h) > 20
        end = tuple(jnp.asarray(x[-2]) for x in ys)
        state, dt0 = jnp.asarray(1 / h[-1]), -jnp.asarray(h[-1])
        back = fly(ts[-2], t, end, False, dt0=dt0, controller_state=state)
        rows = every(back)
        # By rounding of the time, the start may be missed by a last step of no length.
        assert len(rows[0]) - len(ts[:-1]) in (0, 1)
        there = jax.tree.map(lambda x: x[-2::-1], (ts, *ys))
        assert_close([x[: len(h)] for x in rows], [x[:-1] for x in there], 1e-9)
        assert_close([x[-1] for x in rows], [x[-1] for x in there], 1e-9)
        q, p = (jnp.asarray(x[-1]) for x in ys)
        energies.append(float(PLANET.energy(0.0, q, p)))
        t, y = jnp.asarray(ts[-1]), (q, p * jnp.array([1.0, -1.0]))
    assert np.ptp(energies) < 1e-6


# An event in the second of 4 and of 7 steps; in the first of both; and at the start.
@pytest.mark.parametrize("at, t1", [(1.4, 5.2), (0.01, 5.0), (0.0, 5.0)])
def test_a_step_for_an_event_in_the_first_steps(at, t1):
    past = lambda t, y, args, **kwargs: t - at

    @jax.jit
    def solve(dt0):
        y0 = jnp.ones(1), jnp.zeros(1)
        event = dfx.Event(past if at else lambda t, y, args, **kwargs: t >= 0, FINDER)
        return dfx.diffeqsolve(
            *(system(), dps.PresymplecticLeapfrog(), 0.0, t1, dt0, y0), event=event
        )

    choose = lambda: dps.choose_step(solve, 0.0, t1, rtol=1e-6, atol=1e-6)
    if at:
        assert choose().error <= 1
        return
    with pytest.raises(ValueError, match="or an event ends it at once"):
        choose()
