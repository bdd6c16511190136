"""Events: when they happen, how that depends on parameters, and how to go on."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, each, flat, oscillator, pendulum, Scheme, SCHEMES

import diffrax_presym as dps


GAMMA = 0.2
FINDER = optx.Newton(1e-13, 1e-13)


def system(gamma=GAMMA):
    return dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), pendulum, dps.ConstantDamping(gamma)
    )


def through_the_bottom(t, y, args, **kwargs):
    return y[0]


def past_the_bottom(t, y, args, **kwargs):
    return y[0] < 0


def swing(solver, dt0, cond_fn=through_the_bottom, gamma=GAMMA, q0=1.5, **kwargs):
    """A pendulum let go, until the event or t = 10."""
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(system(gamma)),
        solver,
        t0=jnp.array(0.0),
        t1=jnp.array(10.0),
        dt0=jnp.asarray(dt0),
        y0=(jnp.asarray(q0), jnp.array(0.0)),
        event=dfx.Event(cond_fn, FINDER),
        **kwargs,
    )


def last(sol):
    return jax.tree.map(lambda x: x[-1], (sol.ts, *sol.ys))


@pytest.fixture(scope="module")
def exact():
    return last(swing(dfx.Dopri8(), 1e-3, max_steps=None))


@pytest.mark.parametrize(
    "solver, order",
    [
        (dps.PresymplecticLeapfrog(), 2),
        (dps.PresymplecticLeapfrog("position"), 2),
        (dps.PresymplecticTao(5.0), 2),
        (dps.BlanesMoanRKN4(), 4),
        (dps.BlanesMoanRKN6(), 6),
    ],
)
def test_event_is_as_accurate_as_dense_output(solver, order, exact):
    # Steps that meet the event at odd points, so that it is not at the end of one.
    errors = []
    for h in (0.31, 0.31 / 4):
        t, q, p = last(swing(solver, h))
        assert abs(q) < 1e-12
        errors.append(max(abs(t - exact[0]), abs(p - exact[2])))
    assert abs(np.log2(errors[0] / errors[1]) / 2 - order) < 0.5


def test_boolean_event_ends_with_the_step(exact):
    sol = swing(dps.PresymplecticLeapfrog(), 0.125, past_the_bottom)
    t, q, _ = last(sol)
    assert q < 0
    assert t == np.ceil(exact[0] / 0.125) * 0.125
    assert sol.result == dfx.RESULTS.event_occurred


@pytest.mark.parametrize("adjoint", [dfx.DirectAdjoint(), None])
@pytest.mark.parametrize("solver", [dps.PresymplecticLeapfrog(), dps.BlanesMoanRKN6()])
def test_event_time_is_differentiable(solver, adjoint):
    adjoint = dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint

    def time(x):
        gamma, q0 = x
        sol = swing(solver, 0.1, gamma=gamma, q0=q0, adjoint=adjoint, max_steps=128)
        return last(sol)[0]

    x, e = jnp.array([GAMMA, 1.5]), 1e-5
    gradient = jax.grad(time)(x)
    for i in range(2):
        step = e * jnp.eye(2)[i]
        assert abs(gradient[i] - (time(x + step) - time(x - step)) / (2 * e)) < 1e-7


def restart(sol, solver, **kwargs):
    """From the event to t = 4."""
    t, q, p = last(sol)
    again = dfx.diffeqsolve(
        dps.HamiltonianTerm(system()),
        solver,
        t0=t,
        t1=jnp.array(4.0),
        dt0=jnp.array(0.01),
        y0=(q, p),
        **kwargs,
    )
    return jax.tree.map(lambda y: y[-1], again.ys)


@pytest.fixture(scope="module")
def stopped():
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    return swing(dps.PresymplecticLeapfrog(), 0.31, saveat=saveat)


def test_saved_solver_state_belongs_to_the_end_of_the_step(stopped):
    t, q, p = last(stopped)
    force_here = system().force(t, q, p)
    assert abs(stopped.solver_state - force_here) > 1e-3


def test_a_restart_from_the_state_alone_is_fresh(stopped):
    solver = dps.PresymplecticLeapfrog()
    t, q, p = last(stopped)
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(system()),
        dfx.Dopri8(),
        t0=t,
        t1=jnp.array(4.0),
        dt0=jnp.array(0.01),
        y0=(q, p),
    )
    fresh = restart(stopped, solver)
    assert_close(fresh, jax.tree.map(lambda y: y[-1], sol.ys), 2e-5)
    # Carrying the stale force on is wrong, and saying that a jump was made mends it.
    state = stopped.solver_state
    jumped = restart(stopped, solver, solver_state=state, made_jump=jnp.array(True))
    assert_close(jumped, fresh, 1e-14)
    stale = restart(stopped, solver, solver_state=state)
    assert abs(stale[0] - fresh[0]) > 1e-5


# What holds for every scheme

OMEGA = np.sqrt(1 - GAMMA**2 / 4)
# Where the damped oscillator, let go at rest, first is at zero.
FIRST_ZERO = (np.pi - np.arctan2(2 * OMEGA, GAMMA)) / OMEGA


@eqx.filter_jit
def oscillate(solver, t1, dt0):
    return dfx.diffeqsolve(
        *(dps.HamiltonianTerm(oscillator(GAMMA)), solver, jnp.zeros_like(t1), t1, dt0),
        y0=(jnp.array(1.0), jnp.array(0.0)),
        event=dfx.Event(through_the_bottom, FINDER),
        saveat=dfx.SaveAt(t1=True, solver_state=True),
        max_steps=64,
    )


# With a coupling that goes with the step, the copies are in another phase of their turn
# at each step size: the error is of second order, but no smooth function of the step.
SMOOTH = [scheme for scheme in SCHEMES if scheme.name != "tao"]


@each(SMOOTH)
def test_order_of_the_event_time_of_every_scheme(scheme: Scheme):
    errors = []
    # The event at the same point of a step each time, or the error would jump about.
    steps = np.array([5, 10, 20]) + 0.37
    for n in steps:
        sol = oscillate(scheme.solver, jnp.array(3.0), jnp.array(FIRST_ZERO / n))
        t, q, _ = last(sol)
        assert abs(q) < 1e-12
        errors.append(abs(t - FIRST_ZERO))
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order > min(scheme.order, 6 if scheme.order > 4 else 4) - 0.5


CARRYING = [
    scheme
    for scheme in SCHEMES
    if scheme.name in ("leapfrog_AB", "suzuki_yoshida_4", "substeps", "tao", "tao_4")
]


@each(CARRYING)
def test_after_an_event_a_stale_solver_state_needs_made_jump(scheme: Scheme):
    sol = oscillate(scheme.solver, jnp.array(3.0), jnp.array(0.25))
    t, *y = last(sol)

    @eqx.filter_jit
    def go_on(**kwargs):
        term = dps.HamiltonianTerm(oscillator(GAMMA))
        span = (t, t + 1, jnp.array(0.25))
        return dfx.diffeqsolve(term, scheme.solver, *span, tuple(y), **kwargs).ys

    fresh = go_on()
    jumped = go_on(solver_state=sol.solver_state, made_jump=jnp.array(True))
    assert_close(jumped, fresh, 1e-14)
    stale = go_on(solver_state=sol.solver_state)
    assert np.max(np.abs(flat(stale) - flat(fresh))) > 1e-4


# Several at once


def far(t, y, args, **kwargs):
    return jnp.abs(y[0]) > 100


def turning(t, y, args, **kwargs):
    return y[1]


def test_which_event_it_was():
    solver = dps.PresymplecticLeapfrog()
    events = {"far": far, "bottom": through_the_bottom}
    sol = swing(solver, 0.1, events)
    assert sol.event_mask == {"far": False, "bottom": True}


def test_no_event_at_all():
    sol = swing(dps.PresymplecticLeapfrog(), 0.1, far)
    assert sol.result == dfx.RESULTS.successful
    assert sol.event_mask == False  # noqa: E712
    assert last(sol)[0] == 10.0


@pytest.mark.parametrize("upwards", [True, False])
def test_the_direction_of_an_event(upwards):
    # The oscillator crosses zero downwards first, and upwards half a period later.
    sol = dfx.diffeqsolve(
        *(dps.HamiltonianTerm(oscillator(GAMMA)), dps.BlanesMoanRKN6()),
        t0=0.0,
        t1=10.0,
        dt0=0.125,
        y0=(jnp.array(1.0), jnp.array(0.0)),
        event=dfx.Event(through_the_bottom, FINDER, direction=upwards),
    )
    expected = FIRST_ZERO + (np.pi / OMEGA if upwards else 0)
    assert abs(last(sol)[0] - expected) < 1e-7


def test_events_backwards_in_time():
    # From a zero back to the turning point before it, where the oscillator was let go.
    w, e = OMEGA, np.exp(-GAMMA * FIRST_ZERO / 2)
    y = (jnp.array(0.0), jnp.array(-e * np.sin(w * FIRST_ZERO) / w))
    sol = dfx.diffeqsolve(
        *(dps.HamiltonianTerm(oscillator(GAMMA)), dps.BlanesMoanRKN6()),
        t0=FIRST_ZERO,
        t1=-1.0,
        dt0=-0.125,
        y0=y,
        event=dfx.Event(turning, FINDER),
    )
    t, q, _ = last(sol)
    assert abs(t) < 1e-7 and abs(q - 1) < 1e-7


def test_events_under_vmap():
    solver, q0 = dps.PresymplecticLeapfrog(), jnp.array([0.5, 1.5, 2.5])
    time = lambda q0: last(swing(solver, 0.1, q0=q0))[0]
    together = jax.jit(jax.vmap(time))(q0)
    assert np.all(np.diff(together) > 0.1)  # the further up the later
    for t, q in zip(together, q0, strict=True):
        assert abs(t - time(q)) < 1e-13
