"""State-dependent steps: reversible, positive, and without energy drift."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close

import diffrax_presym as dps
from diffrax_presym._results import STEP_DENSITY_INVALID, STEP_DENSITY_MISSED


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


control = dps.StepDensityController


def MOVING(t, y, args):
    return (2 + jnp.sin(t)) * (jnp.sum(y[0] ** 2) + 0.1)


CONTROL, STEPS = control(0.05, DISTANCE), dfx.SaveAt(t0=True, steps=True)


@eqx.filter_jit
def solve(controller, solver, t0, t1, y0, system=KEPLER, **kwargs) -> Any:
    options: dict[str, Any] = dict(dt0=None, max_steps=2000, throw=False) | kwargs
    return dfx.diffeqsolve(
        *(system, solver, jnp.asarray(t0), jnp.asarray(t1)),
        y0=y0,
        stepsize_controller=controller,
        **options,
    )


def last(ys):
    return jax.tree.map(lambda y: y[-1], ys)


def succeeds(sol):
    return sol.result == dfx.RESULTS.successful


def conic(a, low, x):
    """Time, position and velocity on an ellipse or, with a negative semi-major axis, a
    hyperbola of this pericentre, by the eccentric anomaly; on a parabola, `a = inf`, by
    the tangent of half of the true one."""
    if a == np.inf:
        t, rate = (2 * low**3) ** 0.5 * (x + x**3 / 3), (2 * low) ** -0.5 / (1 + x**2)
        return t, (low * (1 - x**2), 2 * low * x), (-2 * x * rate, 2 * rate)
    # Without cancellation at the pericentre.
    sin, cos = (np.sin, np.cos) if a > 0 else (np.sinh, np.cosh)
    sign, a, gap, versed = np.sign(a), abs(a), low / abs(a), 2 * sin(x / 2) ** 2
    e = 1 - sign * gap
    b, rate = a * (gap * (1 + e)) ** 0.5, a**-1.5 / (gap + e * versed)
    t = a**1.5 * sign * (x - e * sin(x))
    return t, (low - a * versed, b * sin(x)), (-a * sin(x) * rate, b * cos(x) * rate)


# Semi-major axis, pericentre, and the anomalies of start and end.
ELLIPSES = [
    (1.0, low, start, start + 7.0)
    for low in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
    for start in (-np.pi, 0.0, 2.0, -0.3)
]
FLYBYS = [(np.inf, 1e-3, -50.0, 30.0), (-1.0, 1e-3, -2.0, 1.5), (-0.1, 0.1, -3.0, 3.0)]
EPSILONS = np.array([0.3, 0.2, 0.1, 0.05, 0.02, 0.01])


OWN = dps.FixedStepAdjoint()
DRAGGED = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -args / jnp.linalg.norm(q),
    dps.LogDamping(1.0, shift=20.0),
)


def saved(adjoint, solver=None, density=DISTANCE, sign=1, e=0.6, **kwargs):
    """An orbit with friction from its apocentre, at 30 times, as a function of what it
    depends on."""
    ts = sign * jnp.linspace(0.1, 9.0, 30)

    def states(epsilon, mass, p0):
        q0 = jnp.array([1 + e, 0.0])
        p0 = p0 * jnp.array([0.1, 1.0]) * ((1 - e) / (1 + e)) ** 0.5
        run = partial(solve, control(epsilon, density), solver or dps.BlanesMoanRKN6())
        y0, saveat = (q0, p0), dfx.SaveAt(ts=ts, t1=True)
        options = dict(args=mass, adjoint=adjoint, saveat=saveat) | kwargs
        return run(0.0, ts[-1], y0, DRAGGED, **options)

    return states


AT = jnp.array(0.2), jnp.array(1.0), jnp.array([1.0, 0.9])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "solver",
    [
        LEAPFROG,
        dps.TunedRKN6(),
        dps.BlanesMoan4(),
        dps.PresymplecticGauss(3),
        dps.Compensated(dps.BlanesMoanRKN4()),
    ],
)
def test_the_loop_of_the_package_takes_the_steps_of_diffrax(solver, sign):
    run = lambda adjoint: saved(adjoint, solver, sign=sign)(*AT)
    ours, theirs = map(run, (OWN, dfx.RecursiveCheckpointAdjoint()))
    assert succeeds(ours) and int(ours.stats["num_steps"]) > 30
    assert ours.stats["num_steps"] == theirs.stats["num_steps"]
    assert_close(last(ours.ys), last(theirs.ys), 1e-12)
    # Between steps each is of the order of the scheme, with errors of its own.
    order = solver.order(None)
    assert_close(ours.ys, theirs.ys, {2: 1e-2, 4: 1e-3, 6: 1e-5}[order])


@pytest.mark.variants(1)
@pytest.mark.parametrize(
    "adjoint",
    [
        OWN,
        dps.FixedStepAdjoint(checkpoints=0),
        dps.FixedStepAdjoint(checkpoints=5),
        dps.FixedStepAdjoint("checkpoints"),
    ],
)
@pytest.mark.parametrize("density", [DISTANCE, DRAGGED])
def test_gradients_in_the_loop_of_the_package(adjoint, density):
    """Of the discrete solution, with the dependence of the steps on the states: those
    of Diffrax through the same steps, and central differences."""

    def loss(*args, adjoint=adjoint):
        ys = saved(adjoint, density=density)(*args).ys
        return jnp.sum(jnp.sin(ys[0])) + jnp.sum(ys[1] ** 2)

    got = jax.grad(loss, argnums=(0, 1, 2))(*AT)
    at_ends = lambda *args, adjoint=adjoint: jnp.sum(
        last(saved(adjoint, density=density)(*args).ys)[0]
    )
    theirs = partial(at_ends, adjoint=dfx.RecursiveCheckpointAdjoint())
    gradient = lambda fn: jax.grad(fn, argnums=(0, 1, 2))(*AT)
    assert_close(gradient(at_ends), gradient(theirs), 1e-6)
    loss = jax.jit(loss)
    for i, x in enumerate(AT):
        for k in range(x.size):
            h = 1e-5 * jnp.zeros(x.size).at[k].set(1.0).reshape(x.shape)
            up, down = (
                loss(*[y + s * h if i == j else y for j, y in enumerate(AT)])
                for s in (1.0, -1.0)
            )
            assert_close(jnp.ravel(got[i])[k], (up - down) / 2e-5, 1e-5)


def test_gradients_of_orbits_of_different_eccentricity():
    def loss(e, adjoint=OWN):
        sol = saved(adjoint, e=e, throw=True)(*AT)
        return jnp.sum(sol.ys[0] ** 2), sol.stats["num_steps"]

    es = jnp.linspace(0.0, 0.95, 16)
    batch = jax.vmap(jax.value_and_grad(loss, has_aux=True))
    (values, steps), gradients = batch(es)
    assert len(set(np.asarray(steps).tolist())) > 8
    for i in (0, 7, 15):
        (value, _), gradient = jax.value_and_grad(loss, has_aux=True)(es[i])
        assert_close((values[i], gradients[i]), (value, gradient), 1e-8)


def test_gradients_of_many_steps_take_constant_memory():
    controller = control(0.01, DISTANCE)

    def end(p, max_steps):
        sol = solve(
            *(controller, LEAPFROG, 0.0, 500.0, (Y0[0], p * Y0[1])),
            **{"adjoint": OWN, "max_steps": max_steps, "throw": True},
        )
        return jnp.sum(sol.ys[0]), sol.stats["num_steps"]

    program = jax.jit(jax.value_and_grad(end, has_aux=True), static_argnums=1)
    compiled = program.lower(jnp.array(1.0), None).compile()
    memory: Any = compiled.memory_analysis()
    assert memory.temp_size_in_bytes < 1e5
    (_, steps), gradient = compiled(jnp.array(1.0))
    assert steps > 40_000
    h = 1e-7
    up, down = (end(jnp.array(1.0 + x), None)[0] for x in (h, -h))
    assert_close(gradient, (up - down) / (2 * h), 1e-4)


def test_a_step_for_a_tolerance():
    ts = jnp.linspace(0.0, 9.0, 31)

    @eqx.filter_jit
    def run(epsilon):
        return dfx.diffeqsolve(
            *(DRAGGED, dps.TunedRKN6(), 0.0, 9.0, None, Y0),
            args=1.0,
            stepsize_controller=control(epsilon, DRAGGED),
            saveat=dfx.SaveAt(ts=ts),
            adjoint=OWN,
            max_steps=None,
        )

    step = dps.choose_step(run, 0.0, 9.0, rtol=1e-7, atol=1e-7)
    sol: Any = run(step.dt0)
    assert step.steps == sol.stats["num_steps"] and not step.on_grid
    vf = jax.jit(lambda t, y: jnp.concatenate(DRAGGED.vf(t, (y[:2], y[2:]), 1.0)))
    exact = scipy.integrate.solve_ivp(
        *(vf, (0, 9), np.concatenate(Y0), "DOP853", np.asarray(ts)),
        rtol=1e-12,
        atol=1e-12,
    )
    error = np.abs(np.hstack(sol.ys) - exact.y.T) / (1e-7 + 1e-7 * np.abs(exact.y.T))
    assert 0.05 < np.max(error) < 1.5


def test_the_time_scale_of_a_system():
    scale = lambda system, q: control(1.0, system).density(0.0, (q, 0 * q), 1.0)
    potential = lambda t, q, args: args * jnp.sum(jnp.array([1.0, 25.0]) * q**2) / 2
    springs = dps.MechanicalSystem(dps.QuadraticKinetic(2.0), potential)
    assert_close(scale(springs, jnp.ones(2)), (0.5**2 + 12.5**2) ** -0.25, 1e-12)
    q = jnp.array([0.3, 0.4])
    assert_close(scale(DRAGGED, 4 * q) / scale(DRAGGED, q), 8.0, 1e-12)
    assert_close(scale(DRAGGED, q), 5**-0.25 * 0.5**1.5, 1e-12)


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


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_close_encounters_are_right_or_fail(dtype, backwards):
    orbits = ELLIPSES + FLYBYS
    starts, ends = ([conic(a, low, x[i]) for a, low, *x in orbits] for i in (0, 1))
    low = np.array([orbit[1] for orbit in orbits])[:, None]
    # Solves in time from zero, in either direction of time.
    starts, ends = (ends, starts) if backwards else (starts, ends)
    array = lambda points, i: np.array([x[i] for x in points])
    t1 = array(ends, 0) - array(starts, 0)
    y0 = array(starts, 1), array(starts, 2)
    cast = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)

    def one(epsilon, t1, y0):
        run = partial(solve, control(epsilon, DISTANCE), dps.BlanesMoanRKN6())
        sol = run(0 * t1, t1, y0, max_steps=4000)
        return last(sol.ys)[0], succeeds(sol), sol.stats["num_steps"]

    batch = jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, 0))
    q, good, steps = map(np.asarray, batch(*cast((EPSILONS, t1, y0))))
    error = np.linalg.norm(q - array(ends, 1)[:, None], axis=-1)
    # Of order six, relative to the potential at the start; and of rounding, relative to
    # the kinetic energy at the pericentre.
    distance = np.linalg.norm(array(starts, 1), axis=-1)[:, None]
    scale = np.maximum(np.linalg.norm(array(ends, 2), axis=-1), 1)[:, None]
    bound = 1e-4 / distance * (EPSILONS / 0.3) ** 6
    bound += 50 * np.finfo(dtype).eps / low * steps**0.5
    assert np.all(error[good] <= (bound * scale)[good])
    # Where the clock resolves the steps, none fails, but for a flyby so fast that the
    # distance changes too much over a step.
    resolved = EPSILONS * low**1.5 > 8 * np.finfo(dtype).eps * np.abs(t1)[:, None]
    assert resolved[-1, 0] and not good[-1, 0]
    resolved[-1, 0] = False
    assert np.all(good[resolved]) and np.all(steps < 40 / EPSILONS)


def test_three_bodies_from_rest():
    masses, q0 = np.array([3.0, 4, 5]), np.array([[1.0, 3], [-2, -1], [1, -1]])

    def slope(t, y):
        q = y[:6].reshape(3, 2)
        apart = q - q[:, None]
        cubes = np.linalg.norm(apart + np.eye(3)[..., None], axis=-1) ** 3
        return np.append(y[6:], np.einsum("j,ijk,ij->ik", masses, apart, 1 / cubes))

    exact = scipy.integrate.solve_ivp(
        *(slope, (0, 10.0), np.append(q0, np.zeros(6)), "DOP853"),
        rtol=1e-12,
        atol=1e-12,
    ).y[:6, -1]
    distances = lambda q: jnp.linalg.norm(q - jnp.roll(q, 1, axis=0), axis=1)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(jnp.array(np.outer(masses, np.ones(2)))),
        lambda t, q, args: -jnp.sum(jnp.array([15.0, 12, 20]) / distances(q)),
    )
    density = lambda t, y, args: jnp.sum(distances(y[0]) ** -3) ** -0.5

    def one(epsilon):
        y0 = jnp.array(q0), jnp.zeros((3, 2))
        controller, solver = control(epsilon, density), dps.BlanesMoanRKN6()
        sol = solve(controller, solver, 0.0, 10.0, y0, system)
        return last(sol.ys)[0], succeeds(sol)

    q, good = map(np.asarray, jax.vmap(one)(jnp.array([0.8, 0.4, 0.2, 0.1, 0.05])))
    assert list(good) == [False, False, True, True, True]
    errors = np.max(np.abs(q[2:].reshape(3, 6) - exact), axis=1)
    assert np.all(errors < np.array([5e-3, 1e-5, 1e-7]))


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


def test_backwards_in_time_is_the_same_motion():
    controller = control(0.02, MOVING)
    solver = dps.BlanesCasasRKN8()
    end = solve(controller, solver, 1.0, 3.0, Y0)
    start = solve(controller, solver, 3.0, 1.0, last(end.ys))
    assert_close(last(start.ys), Y0, 1e-7)
    # The same steps for the time-reversed system.
    mirrored = control(0.02, lambda t, y, args: MOVING(-t, y, args))
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


def test_a_density_without_a_rate_at_the_start():
    # The norm has no derivative at zero.
    density = lambda t, y, args: 1 / (1 + jnp.linalg.norm(y[0]))
    rest = jnp.zeros(2), Y0[1]
    spring = lambda t, q, args: jnp.sum(q**2) / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
    sol = solve(control(0.05, density), LEAPFROG, 0.0, 1.0, rest, system)
    assert succeeds(sol)
    assert_close(last(sol.ys)[0], Y0[1] * np.sin(1.0), 1e-3)


WRONG: Any = 1.0
vector = lambda t, y, args: y[0]


@pytest.mark.variants(4)
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: control(-0.1, DISTANCE), "epsilon"),
        (lambda: control(0.1, WRONG), "density"),
        (lambda: solve(CONTROL, LEAPFROG, 0.0, 1.0, Y0, dt0=0.1), "dt0=None"),
        (lambda: solve(control(0.1, vector), LEAPFROG, 0.0, 1.0, Y0), "real scalar"),
        (lambda: saved(OWN, saveat=STEPS)(*AT), "`SaveAt.steps=...."),
        (
            lambda: solve(CONTROL, dps.SymmetricMultistep(), 0.0, 1.0, Y0, adjoint=OWN),
            "equal steps",
        ),
    ],
)
def test_bad_input_says_what_to_write(make, message):
    with pytest.raises(ValueError, match=message):
        make()
