"""State-dependent steps: reversible, positive, and without energy drift."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import diffrax_presym as dps


E = 0.9
Y0 = (jnp.array([1 - E, 0.0]), jnp.array([0.0, ((1 + E) / (1 - E)) ** 0.5]))
PERIOD = 2 * np.pi


def attraction(t, q, args):
    return -1 / jnp.linalg.norm(q)


KEPLER = dps.MechanicalSystem(dps.QuadraticKinetic(), attraction)
LEAPFROG = dps.PresymplecticLeapfrog()


def DISTANCE(t, y, args):
    return jnp.linalg.norm(y[0]) ** 1.5


def ARCLENGTH(t, y, args):
    slope = KEPLER.vf(t, y, args)
    return sum(jnp.sum(x**2) for x in slope) ** -0.5


control = partial(dps.StepDensityController, KEPLER)
CONTROL, STEPS = control(0.05, DISTANCE), dfx.SaveAt(t0=True, steps=True)


@eqx.filter_jit
def solve(controller, solver, t0, t1, y0, **kwargs) -> Any:
    options: dict[str, Any] = dict(dt0=None, max_steps=2000, throw=False) | kwargs
    return dfx.diffeqsolve(
        *(controller.system, solver, jnp.asarray(t0), jnp.asarray(t1)),
        y0=y0,
        stepsize_controller=controller,
        **options,
    )


def last(ys):
    return jax.tree.map(lambda y: y[-1], ys)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, density",
    [
        (dps.BlanesMoanRKN6(), DISTANCE),
        (LEAPFROG, ARCLENGTH),
        (LEAPFROG, lambda t, y, args: jnp.sum(y[0] ** 2) + 0.1),
    ],
)
def test_a_solve_goes_back_the_way_it_came(solver, density):
    controller = control(0.05, density)
    steps = 300
    saveat = dfx.SaveAt(t0=True, steps=True, controller_state=True)
    there = solve(controller, solver, 0.0, 1e3, Y0, saveat=saveat, max_steps=steps)
    end = last(there.ys)
    state = controller.reverse(there.ts[-1], end, None, there.controller_state)
    back = solve(
        *(controller, solver, there.ts[-1], 0.0, end),
        saveat=saveat,
        dt0=-controller.step_size(state),
        controller_state=state,
    )
    # Rounding may leave a last step of length zero.
    assert int(back.stats["num_steps"]) in (steps, steps + 1)
    ts = np.asarray(there.ts)
    assert np.ptp(np.diff(ts)) > 1e-2
    assert np.max(np.abs(ts - np.asarray(back.ts)[steps::-1])) < 1e-9
    assert_close(there.ys, jax.tree.map(lambda y: y[steps::-1], back.ys), 1e-9)


class Naive(dps.StepDensityController):
    """A control that is not reversible: the density at the start of the step."""

    def adapt_step_size(self, t0, t1, y0, y1, args, error, order, state):
        h = self.epsilon * self.density(t1, y1, args)
        return True, t1, t1 + h, False, state, dfx.RESULTS.successful


def energy_means(controller):
    """Mean energy errors over the first and over the last tenth of 150 orbits."""
    options = dict(saveat=STEPS, max_steps=16384)
    sol = solve(controller, LEAPFROG, 0.0, 150 * PERIOD, Y0, **options)
    q, p = (np.asarray(y)[np.isfinite(sol.ts)] for y in sol.ys)
    error = np.sum(p**2, axis=1) / 2 - 1 / np.linalg.norm(q, axis=1) + 0.5
    part = len(error) // 10
    return np.mean(error[:part]), np.mean(error[-part:]), np.max(np.abs(error))


def test_the_energy_of_an_eccentric_orbit_does_not_drift():
    first, last, largest = energy_means(control(0.1, DISTANCE))
    assert abs(last - first) < 0.05 * largest and largest < 0.02
    # The reversibility of the control is required, not only the density.
    naive: Any = Naive
    first, last, _ = energy_means(naive(KEPLER, 0.1, DISTANCE))
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


def test_backwards_in_time_is_the_same_motion():
    def density(t, y, args):
        return (2 + jnp.sin(t)) * jnp.sum(y[0] ** 2)

    controller = control(0.02, density)
    solver = dps.BlanesCasasRKN8()
    end = solve(controller, solver, 1.0, 3.0, Y0)
    start = solve(controller, solver, 3.0, 1.0, last(end.ys))
    assert_close(last(start.ys), Y0, 1e-7)
    # The same steps for the time-reversed system.
    mirrored = control(0.02, lambda t, y, args: density(-t, y, args))
    back = solve(mirrored, solver, -1.0, -3.0, (Y0[0], -Y0[1]))
    assert_close(back.ys[0], end.ys[0], 1e-11)
    assert int(back.stats["num_steps"]) == int(end.stats["num_steps"])


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
    controller = control(0.1, lambda t, y, args: jnp.maximum(2.0 - t, 0.0))
    sol = solve(controller, LEAPFROG, 0.0, 3.0, Y0)
    failed = dfx.RESULTS.dt_min_reached, dfx.RESULTS.max_steps_reached
    assert sol.result in failed
    zero = control(0.1, lambda t, y, args: 0 * t)
    sol = solve(zero, LEAPFROG, 0.0, 3.0, Y0)
    assert sol.result != dfx.RESULTS.successful


WRONG: Any = 1.0
vector = lambda t, y, args: y[0]


@pytest.mark.variants(5)
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: control(-0.1, DISTANCE), "epsilon"),
        (lambda: control(0.1, WRONG), "density"),
        (lambda: dps.StepDensityController(WRONG, 0.1, DISTANCE), "needs the system"),
        (lambda: solve(CONTROL, LEAPFROG, 0.0, 1.0, Y0, dt0=0.1), "dt0=None"),
        (lambda: solve(control(0.1, vector), LEAPFROG, 0.0, 1.0, Y0), "real scalar"),
    ],
)
def test_bad_input_says_what_to_write(make, message):
    with pytest.raises(ValueError, match=message):
        make()
