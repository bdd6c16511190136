"""State-dependent steps: reversible, positive, and without energy drift."""

from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close
from variable import (
    control,
    DISTANCE,
    KEPLER,
    last,
    LEAPFROG,
    PERIOD,
    solve,
    succeeds,
    Y0,
)

import diffrax_presym as dps
from diffrax_presym._results import STEP_DENSITY_INVALID, STEP_DENSITY_MISSED


def ARCLENGTH(t, y, args):
    slope = KEPLER.vf(t, y, args)
    return sum(jnp.sum(x**2) for x in slope) ** -0.5


def MOVING(t, y, args):
    return (2 + jnp.sin(t)) * (jnp.sum(y[0] ** 2) + 0.1)


CONTROL, STEPS = control(0.05, DISTANCE), dfx.SaveAt(t0=True, steps=True)


def test_the_time_scale_of_a_system():
    scale = lambda system, q: control(1.0, system).density(0.0, (q, 0 * q), 1.0)
    potential = lambda t, q, args: args * jnp.sum(jnp.array([1.0, 25.0]) * q**2) / 2
    springs = dps.MechanicalSystem(dps.QuadraticKinetic(2.0), potential)
    assert_close(scale(springs, jnp.ones(2)), (0.5**2 + 12.5**2) ** -0.25, 1e-12)
    q = jnp.array([0.3, 0.4])
    assert_close(scale(KEPLER, 4 * q) / scale(KEPLER, q), 8.0, 1e-12)
    assert_close(scale(KEPLER, q), 5**-0.25 * 0.5**1.5, 1e-12)


def test_the_time_scale_where_the_velocity_depends_on_positions():
    # Kepler in polar coordinates: the acceleration of the distance has L^2 / r^3.
    mass = lambda r: jnp.array([1.0, 0.0]) + jnp.array([0.0, 1.0]) * r**2
    energy = lambda t, q, p, args: jnp.sum(p**2 / mass(q[0])) / 2 - 1 / q[0]
    moved = lambda t, q, args: jnp.diag(mass(q[0]))
    height = lambda t, q, args: -1 / q[0]
    q, (radial, L) = jnp.array([1.2, 0.3]), (0.4, 0.9)
    r = 1.2
    # Of r'' = L^2 / r^3 - 1 / r^2 and angle'' = -2 L r' / r^3, with the derivatives
    # by r at constant momenta.
    slopes = 2 / r**3 - 3 * L**2 / r**4, 6 * L * radial / r**4
    for system in (dps.Hamiltonian(energy), dps.LagrangianSystem(moved, height)):
        found = control(1.0, system).density(0.0, (q, jnp.array([radial, L])), None)
        assert_close(found, sum(x**2 for x in slopes) ** -0.25, 1e-12)


# Where the force has no slope, at inflections of the potential: with the position at
# which the motion starts, at rest.
INFLECTIONS = {
    "pendulum": (lambda q: -jnp.cos(q), 2.5),
    "pendulum that turns there": (lambda q: -jnp.cos(q), np.pi / 2),
    "Morse": (lambda q: (1 - jnp.exp(-q)) ** 2, 2.0),
    "double well": (lambda q: q**4 / 4 - q**2 / 2, 1.6),
    "quartic": (lambda q: q**4 / 4, 1.0),
}


@pytest.mark.parametrize("epsilon", [0.3, 0.05])
@pytest.mark.parametrize("name", INFLECTIONS)
def test_one_position_passes_inflections_of_its_potential(name, epsilon):
    potential, start = INFLECTIONS[name]
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(potential(q))
    )
    own: dict[str, Any] = dict(system=system, adjoint=dps.FixedStepAdjoint())
    y0 = jnp.array([start]), jnp.zeros(1)
    sol = solve(control(epsilon, system), dps.TunedRKN6(), 0.0, 20.0, y0, **own)
    assert succeeds(sol)
    force = jax.jit(jax.grad(lambda x: -potential(x)))
    rhs = lambda t, y: [y[1], float(force(y[0]))]
    options: dict[str, Any] = dict(rtol=1e-11, atol=1e-11)
    exact = scipy.integrate.solve_ivp(rhs, (0, 20), (start, 0), "DOP853", **options)
    assert_close(
        np.ravel(last(sol.ys)), exact.y[:, -1], 1e-8 if epsilon > 0.1 else 1e-9
    )


@pytest.mark.parametrize("time", [1e-10, 1e10])
def test_the_time_scale_does_not_overflow_in_single_precision(time):
    q, T = jnp.array([1.0, 0.0], jnp.float32), jnp.float32(time)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: -1 / jnp.linalg.norm(q) / T / T
    )
    found = control(1.0, system).density(jnp.float32(0), (q, q), None)
    assert_close(found / T, 5**-0.25, 1e-6)


@pytest.mark.parametrize("bodies, space", [(3, 2), (7, 2), (50, 3)])
def test_the_time_scale_of_many_bodies_is_an_estimate(bodies, space):
    i, j = np.triu_indices(bodies, 1)
    potential = lambda t, q, args: -jnp.sum(1 / jnp.linalg.norm(q[i] - q[j], axis=-1))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    estimate = control(1.0, system).density
    rng = np.random.default_rng(bodies)
    q = rng.standard_normal((40, bodies, space))
    # In half of the states two bodies are close.
    q[::2, 1] = q[::2, 0] + 0.02 * rng.standard_normal((20, space))

    @jax.vmap
    def ratio(q):
        J = jax.hessian(potential, 1)(0.0, q, None)
        return estimate(0.0, (q, 0 * q), None) * jnp.sum(J**2) ** 0.25

    ratios = ratio(jnp.asarray(q))
    assert 0.75 < np.min(ratios) < 0.999 and 1.001 < np.max(ratios) < 1.4


ALL = dfx.SaveAt(t0=True, steps=True, controller_state=True)


@pytest.mark.parametrize("density, sign", [(ARCLENGTH, 1), (MOVING, -1)])
def test_a_solve_goes_back_the_way_it_came_and_past_its_start(density, sign):
    controller, n = control(0.05, density), 150
    # Not at an end of the orbit, where the density has no rate.
    y0 = last(solve(CONTROL, LEAPFROG, 0.0, 0.7, Y0).ys)
    run = partial(solve, controller, LEAPFROG, saveat=ALL)
    there, before = (run(0.5, s * 1e3, y0, max_steps=n) for s in (sign, -sign))
    t, y = there.ts[-1], last(there.ys)
    state = controller.reverse(t, y, None, there.controller_state)
    back = run(
        *(t, -sign * 1e3, y),
        max_steps=2 * n,
        dt0=-sign * controller.step_size(state),
        controller_state=state,
    )
    ts = np.append(there.ts[::-1], before.ts[1:])
    assert np.ptp(np.diff(ts)) > 1e-2
    assert_close(back.ts, ts, 1e-9)
    join = lambda y, z: np.concatenate([y[::-1], z[1:]])
    assert_close(back.ys, jax.tree.map(join, there.ys, before.ys), 1e-9)


class Naive(dps.StepDensityController):
    """A control that is not reversible: the density at the start of the step."""

    def adapt_step_size(self, t0, t1, y0, y1, args, error, order, state):
        h = self.epsilon * self.density(t1, y1, args)
        return True, t1, t1 + h, False, state, dfx.RESULTS.successful


def energy_means(controller):
    """Mean energy errors over the first and over the last tenth of 500 orbits."""
    run = partial(solve, saveat=STEPS, max_steps=50000)
    sol = run(controller, LEAPFROG, 0.0, 500 * PERIOD, Y0)
    q, p = (np.asarray(y)[np.isfinite(sol.ts)] for y in sol.ys)
    error = np.sum(p**2, axis=1) / 2 - 1 / np.linalg.norm(q, axis=1) + 0.5
    part = len(error) // 10
    return np.mean(error[:part]), np.mean(error[-part:]), np.max(np.abs(error))


def test_the_energy_of_an_eccentric_orbit_does_not_drift():
    first, last, largest = energy_means(control(0.1, DISTANCE))
    assert abs(last - first) < 0.05 * largest and largest < 0.02
    # The reversibility of the control is required, not only the density.
    naive: Any = Naive
    first, last, _ = energy_means(naive(0.1, DISTANCE))
    assert abs(last - first) > 0.05


def test_steps_follow_the_density():
    sol = solve(CONTROL, dps.BlanesMoanRKN4(), 0.0, 1e3, Y0, saveat=STEPS)
    sigma = np.asarray(jax.vmap(lambda q: DISTANCE(0.0, (q, q), None))(sol.ys[0]))
    steps = np.diff(sol.ts)
    ratio = steps / (0.05 * np.sqrt(sigma[1:] * sigma[:-1]))
    assert steps.max() / steps.min() > 50
    assert np.all(np.abs(np.log(ratio)) < 0.02)


def test_the_same_in_any_solver_of_diffrax():
    solvers = dps.BlanesCasasRKN8(), dfx.Dopri8()
    ours, theirs = (solve(CONTROL, s, 0.0, PERIOD, Y0).ys for s in solvers)
    assert_close(ours, theirs, 1e-6)


def test_gradients_through_the_steps():
    def loss(epsilon, power, q0):
        controller = control(epsilon, lambda t, y, args: jnp.linalg.norm(y[0]) ** power)
        sol = solve(controller, LEAPFROG, 0.0, 4.0, (q0, Y0[1]))
        return jnp.sum(sol.ys[0] ** 2 + sol.ys[1])

    at = [jnp.array(0.1), jnp.array(1.4), Y0[0]]
    gradient = jax.grad(loss, argnums=(0, 1, 2))(*at)
    for i, g in enumerate(gradient):
        up, down = (
            loss(*[x + h * (i == j) for j, x in enumerate(at)]) for h in (1e-6, -1e-6)
        )
        assert_close(jnp.sum(g), (up - down) / 2e-6, 1e-5)


def test_many_at_once():
    def end(epsilon, e):
        y0 = jnp.stack([1 - e, 0.0 * e]), jnp.stack([0 * e, ((1 + e) / (1 - e)) ** 0.5])
        sol = solve(control(epsilon, DISTANCE), LEAPFROG, 0.0, PERIOD, y0)
        return sol.ys, sol.stats["num_steps"]

    epsilons, es = jnp.array([0.05, 0.1, 0.1]), jnp.array([0.5, 0.5, 0.8])
    ys, steps = jax.vmap(end)(epsilons, es)
    assert len(set(np.asarray(steps).tolist())) > 1
    for i in range(3):
        alone, n = end(epsilons[i], es[i])
        assert_close((ys[0][i], ys[1][i]), alone, 1e-12)
        assert int(n) == int(steps[i])


def test_single_precision_stays_single():
    single = lambda tree: jax.tree.map(lambda x: x.astype(jnp.float32), tree)
    saveat = dfx.SaveAt(t1=True, controller_state=True)
    span = jnp.float32(0), jnp.float32(PERIOD)
    sol = solve(CONTROL, LEAPFROG, *span, single(Y0), saveat=saveat)
    assert sol.controller_state.dtype == sol.ys[0].dtype == jnp.float32
    double = solve(CONTROL, LEAPFROG, 0.0, PERIOD, Y0)
    assert_close(sol.ys, double.ys, 1e-3)


def test_a_solve_can_be_continued():
    saveat = dfx.SaveAt(steps=True, controller_state=True)
    run = partial(solve, CONTROL, LEAPFROG, saveat=saveat)
    whole = run(0.0, 1e3, Y0, max_steps=100)
    half = run(0.0, 1e3, Y0, max_steps=50)
    rest = run(
        *(half.ts[-1], 1e3, last(half.ys)),
        max_steps=50,
        dt0=CONTROL.step_size(half.controller_state),
        controller_state=half.controller_state,
    )
    assert_close(rest.ys, jax.tree.map(lambda y: y[50:], whole.ys), 1e-12)


def test_a_step_that_vanishes_is_a_failure():
    # Steps shrink towards the time two, and never reach it.
    controller = control(0.1, lambda t, y, args: jnp.maximum(2.0 - t, 1e-30))
    sol = solve(controller, LEAPFROG, 0.0, 3.0, Y0)
    assert sol.result == dfx.RESULTS.dt_min_reached and sol.ts[-1] < 2.0 + 1e-9


@pytest.mark.parametrize("solver", [LEAPFROG, dfx.Dopri8()])
def test_a_density_that_cannot_be_followed_is_a_failure(solver):
    density = lambda t, y, args: jnp.where(t < args[0], 1.0, args[1]) + args[2] * t
    run = partial(solve, control(0.01, density), solver, 0.0, 1.0, Y0)
    result = lambda *args: run(args=jnp.array(args)).result
    for value in (0.0, -1.0, jnp.nan, jnp.inf):
        assert result(0.5, value, 0) == result(0, value, 0) == STEP_DENSITY_INVALID
    # The next step would be four times too long, and the last one was.
    for value, missed in (1.7, False), (1.8, True), (0.26, False), (0.24, True):
        found = result(0.5, value, 0)
        assert found == (STEP_DENSITY_MISSED if missed else dfx.RESULTS.successful)
    # By its rate, at the start.
    assert result(0.5, 1, 200) == result(0.5, 1, -200) == STEP_DENSITY_MISSED
    assert "Reduce `epsilon`" in dfx.RESULTS[STEP_DENSITY_MISSED]
    assert "`density`" in dfx.RESULTS[STEP_DENSITY_INVALID]
    # A system without positions has no time scale.
    spring = lambda t, q, args: jnp.sum(q**2) / 2
    nothing = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
    found = solve(
        control(0.1, nothing), solver, 0.0, 1.0, (jnp.zeros(0), jnp.zeros(0)), nothing
    )
    assert found.result == STEP_DENSITY_INVALID


def test_a_density_without_a_rate_at_the_start():
    # The norm has no derivative at zero.
    density = lambda t, y, args: 1 / (1 + jnp.linalg.norm(y[0]))
    rest = jnp.zeros(2), Y0[1]
    spring = lambda t, q, args: jnp.sum(q**2) / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
    sol = solve(control(0.05, density), LEAPFROG, 0.0, 1.0, rest, system)
    assert succeeds(sol)
    assert_close(last(sol.ys)[0], Y0[1] * np.sin(1.0), 1e-3)


@pytest.mark.variants(1)
@pytest.mark.parametrize("throw", [False, True])
def test_epsilon_is_found_in_any_unit_of_time(throw):
    def chosen(unit, **first):
        orbit = dps.MechanicalSystem(
            dps.QuadraticKinetic(),
            lambda t, q, args: -(unit**-2) / jnp.linalg.norm(q),
        )
        run = lambda epsilon: solve(
            *(control(epsilon, orbit), dps.TunedRKN6(), 0.0, 4 * PERIOD * unit),
            *((Y0[0], Y0[1] / unit), orbit),
            saveat=dfx.SaveAt(t1=True, fn=lambda t, y, args: y[0]),
            adjoint=dps.FixedStepAdjoint(),
            throw=throw,
        )
        tolerances = {"rtol": 1e-5, "atol": 1e-5, "max_steps": 5000}
        return dps.choose_step(run, 0.0, 4 * PERIOD * unit, **tolerances, **first)

    one, *others = [chosen(unit, first=1.0) for unit in (1.0, 1e-6, 1e7)]
    assert one.error <= 1 and 50 < one.steps < 500
    assert all(x.steps == one.steps for x in others)
    # By the span, which may be far more units long than there are steps allowed.
    by_span = chosen(100.0)
    assert by_span.error <= 1 and abs(by_span.steps - one.steps) < 0.3 * one.steps
    with pytest.raises(RuntimeError, match=r"`epsilon` was too large.*first=1.0"):
        chosen(1e7)


def by_own_loop(solver, **options):
    adjoint = dps.FixedStepAdjoint()
    return solve(CONTROL, solver, 0.0, 1.0, Y0, adjoint=adjoint, **options)


WRONG: Any = 1.0
BOTH = dfx.SaveAt(ts=jnp.ones(1), steps=True)
vector = lambda t, y, args: y[0]


@pytest.mark.variants(4)
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: control(-0.1, DISTANCE), "epsilon"),
        (lambda: control(0.1, WRONG), "density"),
        (
            lambda: solve(control(jnp.ones(2), DISTANCE), LEAPFROG, 0.0, 1.0, Y0),
            r"must be a number, but got the shape \(2,\)",
        ),
        (lambda: solve(CONTROL, LEAPFROG, 0.0, 1.0, Y0, dt0=0.1), "dt0=None"),
        (lambda: solve(control(0.1, vector), LEAPFROG, 0.0, 1.0, Y0), "real scalar"),
        (lambda: by_own_loop(LEAPFROG, saveat=BOTH), "times and steps in one.*subs="),
        (lambda: by_own_loop(dps.SymmetricMultistep()), "equal steps"),
    ],
)
def test_bad_input_says_what_to_write(make, message):
    with pytest.raises(ValueError, match=message):
        make()
