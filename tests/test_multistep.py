"""Symmetric multistep methods: history, rounding, stability and what is refused."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, henon_heiles, pendulum, solve

import diffrax_presym as dps
from diffrax_presym._results import MULTISTEP_UNSTABLE, OTHER_HISTORY


FIXED = dps.FixedStepAdjoint()


def driven(t, q, args):
    """A potential that depends on time, and on a parameter."""
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.cos(t) * q[0] * q[1] / 10


def system(rate):
    mass = dps.QuadraticKinetic(jnp.array([1.0, 2.0]))
    friction = None if rate is None else dps.ConstantDamping(rate)
    return dps.MechanicalSystem(mass, driven, friction)


Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.2, 0.4]))
ONE = jnp.array(1.0)
# An integrator of another kind.
EXACT = dps.SofroniouSpaletta(10)


def ends(*args, **options) -> Any:
    """What a solve saves, by default the final state."""
    return solve(*args, **options).ys


def largest(x, y):
    pairs = zip(*map(jax.device_get, map(jax.tree.leaves, (x, y))), strict=True)
    return max(float(np.max(np.abs(a - b))) for a, b in pairs)


@pytest.mark.parametrize("wrap", [lambda x: x, dps.Compensated])
def test_rounding(wrap):
    """Of many steps, in single precision."""
    dtype, solver = jnp.float32, wrap(dps.SymmetricMultistep(8))
    y0 = jax.tree.map(lambda y: y.astype(dtype), Y0)
    times = map(dtype, (0.0, 20.0, 20 / 2000))
    args = *times, y0, ONE.astype(dtype)
    options: dict = dict(adjoint=FIXED, max_steps=2001)
    exact = ends(system(0.1), EXACT, 0.0, 20.0, 0.05, Y0, ONE)
    error = largest(ends(system(0.1), solver, *args, **options), exact)
    assert error < (2e-7 if isinstance(solver, dps.Compensated) else 1e-5)


def test_rounding_far_from_the_origin():
    """The start takes differences of positions, in single precision."""
    spring = lambda t, q, args: jnp.sum((q - 1000) ** 2) / 2
    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
    y0 = jnp.full(1, 1000, jnp.float32), jnp.ones(1, jnp.float32)
    times = map(jnp.float32, (0.0, 2.0, 0.02))
    _, p = ends(hamiltonian, dps.SymmetricMultistep(8), *times, y0, adjoint=FIXED)
    assert abs(float(p[-1, 0]) - np.cos(2.0)) < 3e-4


def test_a_step_that_changes_slowly():
    """In single precision a change may be as small as the rounding of times."""
    ts = jnp.float32(100 + np.cumsum(np.r_[0, 0.1 * 1.0005 ** np.arange(400)]))
    y0 = jax.tree.map(jnp.float32, Y0)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), henon_heiles)
    y0 = jax.tree.map(lambda y: y / 4, y0)
    solve = lambda solver: dfx.diffeqsolve(
        *(system, solver, ts[0], ts[-1], None, y0),
        stepsize_controller=dfx.StepTo(ts),
        adjoint=FIXED,
    )
    both = [solve(x).ys for x in (dps.SymmetricMultistep(8), dps.BlanesCasasRKN8())]
    assert largest(*both) < 1e-3


@pytest.mark.parametrize("adjoint", [FIXED, dfx.RecursiveCheckpointAdjoint()])
def test_kinks_at_equal_distances(adjoint):
    """Steps of one length all along, but the history ends at each kink."""
    times = jnp.arange(9.0)
    forces = jnp.array([0.0, 1, -1, 2, 0, -2, 1, 0, 1])
    force = lambda t, q, args: jnp.interp(t, times, forces) - jnp.sin(q)
    term = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(force))
    options: dict = dict(stepsize_controller=dps.StepsBetween(times), adjoint=adjoint)
    run = lambda solver: dfx.diffeqsolve(term, solver, 0.0, 8.0, 0.05, Y0, **options)
    if adjoint is FIXED:
        with pytest.raises(ValueError, match="the history of"):
            run(dps.SymmetricMultistep())
    else:
        assert_close(run(dps.SymmetricMultistep()).ys, run(EXACT).ys, 1e-8)


def test_integer_times():
    """In a step by hand."""
    solver, term = dps.SymmetricMultistep(), system(0.1)

    def step(t0, t1):
        carry = solver.init(term, t0, t1, Y0, ONE)
        return solver.step(term, t0, t1, Y0, ONE, carry, made_jump=False)[0]

    assert_close(step(0, 1), step(0.0, 1.0), 1e-15)


def test_what_one_step_does_not_show():
    args = 0.0, 0.1, Y0, ONE
    with pytest.raises(ValueError, match="not symplectic"):
        dps.diagnostics.structure_defect(system(0.1), dps.SymmetricMultistep(), *args)


def test_one_evaluation_per_step():
    count = []

    def counted(t, q, args):
        jax.debug.callback(lambda: count.append(1))
        return -jnp.sin(q)

    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(counted))
    numbers = []
    for n in (20, 60):
        count.clear()
        # Not the loop of Diffrax, which prepares dense output in every step.
        args = hamiltonian, dps.SymmetricMultistep(8), 0.0, 0.05 * n, 0.05, Y0
        solve(*args, adjoint=FIXED)
        jax.effects_barrier()
        numbers.append(len(count))
    assert numbers[1] - numbers[0] == 40


def test_a_change_of_the_step_starts_again():
    hamiltonian, solver = system(0.2), dps.SymmetricMultistep(10)
    ts = jnp.concatenate([jnp.linspace(0.0, 3, 31), 3 + jnp.linspace(0, 2, 41)[1:]])
    exact = ends(hamiltonian, EXACT, 0.0, 5.0, 0.05, Y0, ONE)

    @eqx.filter_jit
    def run(x, adjoint) -> Any:
        y0 = jax.tree.map(lambda y: x * y, Y0)
        args = hamiltonian, solver, 0.0, 5.0, None, y0, ONE
        controller = dfx.StepTo(ts)
        return dfx.diffeqsolve(*args, stepsize_controller=controller, adjoint=adjoint)

    assert_close(run(1.0, FIXED).ys, exact, 1e-9)
    # With a history that is not recomputed, the error would be of the order of one.
    uneven = ends(hamiltonian, solver, 0.0, 5.0, 0.107, Y0, ONE)
    assert_close(uneven, exact, 1e-9)
    # The gradient is taken by checkpoints.
    loss = lambda x, adjoint: jnp.sum(run(x, adjoint).ys[0] ** 2)
    slope = jax.grad(loss)(ONE, FIXED)
    up, down = (loss(x, FIXED) for x in (ONE + 1e-5, ONE - 1e-5))
    assert_close(slope, (up - down) / 2e-5, 1e-8)
    with pytest.raises(ValueError, match="no known inverse"):
        jax.grad(loss)(ONE, dps.FixedStepAdjoint("reversal"))


def test_steps_of_one_length_but_for_rounding():
    """Each of 400 given times is rounded; all but the first steps are of the method."""
    count, ts = [], jnp.linspace(1000.0, 980.0, 401)

    def counted(t, q, args):
        jax.debug.callback(lambda: count.append(1))
        return -jnp.sin(q)

    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(counted))
    args = hamiltonian, dps.SymmetricMultistep(8), ts[0], ts[-1], None, Y0
    dfx.diffeqsolve(*args, stepsize_controller=dfx.StepTo(ts), adjoint=FIXED)
    jax.effects_barrier()
    assert len(count) <= 7 * 20 + 400


def test_a_jump_starts_again():
    def pushed(t, q, args):
        return pendulum(t, q, args) - jnp.where(t < args, 0, 1.0) * jnp.sum(q)

    rate = dps.ConstantDamping(0.1)
    term = dps.MechanicalSystem(dps.QuadraticKinetic(), pushed, rate)
    solver = dps.SymmetricMultistep(8)
    h, before, after = 0.1, jnp.array(9.0), jnp.array(0.0)

    @jax.jit
    def walk(y, jump):
        def one(state, i):
            y, carry = state
            t, made = i * h, jump & (i == 20)
            args = jnp.where(i < 20, before, after)
            y, _, _, carry, _ = solver.step(term, t, t + h, y, args, carry, made)
            return (y, carry), None

        start = y, solver.init(term, jnp.asarray(0.0), jnp.asarray(h), y, before)
        return jax.lax.scan(one, start, jnp.arange(40).astype(float))[0][0]

    last = lambda ys: jax.tree.map(lambda x: x[-1], ys)
    half = last(ends(term, EXACT, 0.0, 2.0, 0.05, Y0, before))
    exact = last(ends(term, EXACT, 2.0, 4.0, 0.05, half, after))
    assert_close(walk(Y0, True), exact, 1e-8)
    assert largest(walk(Y0, False), exact) > 1e-3


@pytest.mark.slow
def test_between_steps_the_error_is_that_at_steps():
    hamiltonian, solver = system(0.2), dps.SymmetricMultistep(10)
    saveat = dfx.SaveAt(ts=jnp.linspace(1.0, 6.0, 1 + 160))
    args = 1.0, 6.0, 0.125, Y0, ONE
    options = dict(saveat=saveat, adjoint=FIXED)
    exact = ends(hamiltonian, EXACT, *args, **options)
    ys = ends(hamiltonian, solver, *args, **options)
    for y, true in zip(ys, exact, strict=True):
        errors = np.max(np.abs(y - true), axis=1)
        assert np.max(errors) < 1.5 * np.max(errors[::4]) < 1e-6
    # The same from the interpolation of Diffrax, exact at both ends.
    slow = ends(hamiltonian, solver, *args, saveat=saveat)
    assert_close(slow, ys, 1e-7)
    both = dfx.SaveAt(dense=True, steps=True)
    dense: Any = solve(hamiltonian, solver, *args, saveat=both)
    at_ends = jax.vmap(dense.evaluate)(dense.ts[:40])
    assert_close(at_ends, jax.tree.map(lambda x: x[:40], dense.ys), 1e-12)


def test_vmap():
    """Some in the batch are at the start while others are not."""
    solver = dps.SymmetricMultistep(8)

    def end(scale, t0, rate):
        y0 = jax.tree.map(lambda x: scale * x, Y0)
        return ends(system(rate), solver, t0, 4.0, 0.1, y0, ONE)

    inputs = jnp.array([0.5, 1.0]), jnp.array([0.0, 1.5]), jnp.array([0.5, 0.2])
    batch = jax.vmap(end)(*inputs)
    for i in range(2):
        one = end(*(x[i] for x in inputs))
        assert_close(jax.tree.map(lambda x, i=i: x[i], batch), one, 1e-13)


@pytest.mark.parametrize("order", [8, 10])
def test_energy_does_not_drift(order):
    """On an orbit of Kepler's problem."""
    potential = lambda t, q, args: -1 / jnp.sqrt(jnp.sum(q**2))
    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    e, orbits = 0.2, 200
    y0 = jnp.array([1 - e, 0.0]), jnp.array([0.0, np.sqrt((1 + e) / (1 - e))])
    ts = jnp.linspace(0, 2 * np.pi * orbits, 10 * orbits + 1)
    saveat = dfx.SaveAt(ts=ts, fn=lambda t, y, args: hamiltonian.energy(t, *y))
    args = hamiltonian, dps.SymmetricMultistep(order), 0.0, ts[-1], 2 * np.pi / 113, y0
    energies = ends(*args, saveat=saveat, max_steps=None, adjoint=FIXED)
    # The largest error in each tenth of the time.
    errors = np.max(np.abs(np.reshape(energies[1:] + 0.5, (10, -1))), axis=1)
    assert errors[0] < {8: 3e-8, 10: 3e-9}[order]
    assert errors[-1] < 2 * errors[0] + 1e-13


@pytest.mark.parametrize("adjoint", [FIXED, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("order, limit", [(8, 0.63), (10, 0.48)])
def test_instability_is_reported(order, limit, adjoint):
    """Of the fastest of three oscillators; and where no force acts nothing is."""
    solver, y0 = dps.SymmetricMultistep(order), (jnp.ones(3), jnp.zeros(3))

    def run(omega, n=400.0):
        spring = dps.QuadraticPotential(jnp.array([omega, 0.1, 0.0]) ** 2)
        term = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
        options: dict = dict(adjoint=adjoint, throw=False)
        return solve(term, solver, 0.0, n, 1.0, y0, **options)

    for omega in (0.0, limit - 0.01):
        sol: Any = run(omega)
        assert sol.result == dfx.RESULTS.successful
        assert abs(float(sol.ys[0][-1, 0]) - np.cos(omega * 400)) < 0.03
    for omega in (limit + 0.02, 0.8, 1.5):
        assert run(omega).result == MULTISTEP_UNSTABLE
    assert run(3.0).result != dfx.RESULTS.successful


@pytest.mark.parametrize("adjoint", [FIXED, dfx.RecursiveCheckpointAdjoint()])
def test_the_history_of_another_solution(adjoint):
    solver, term = dps.SymmetricMultistep(), system(0.1)
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    options: dict = dict(saveat=saveat, adjoint=adjoint, throw=False)
    half = solve(term, solver, 0.0, 2.0, 0.1, Y0, ONE, **options)
    y = jax.tree.map(lambda x: x[-1], half.ys)
    options |= dict(solver_state=half.solver_state)
    rest = solve(term, solver, 2.0, 4.0, 0.1, y, ONE, **options)
    exact = ends(term, EXACT, 0.0, 4.0, 0.05, Y0, ONE)
    assert_close(rest.ys, exact, 1e-8)
    rest = solve(term, solver, 2.0, 4.0, 0.1, (y[0], y[1] + 1e-3), ONE, **options)
    assert rest.result == OTHER_HISTORY


def test_a_force_that_passes_through_zero():
    """In Diffrax's loop each step is checked, at long steps that are stable."""
    rate, y0 = dps.ConstantDamping(0.1), (jnp.ones(1), jnp.zeros(1))
    term = dps.MechanicalSystem(dps.QuadraticKinetic(), pendulum, rate)
    ys = ends(term, dps.SymmetricMultistep(), 0.0, 100.0, 0.5, y0)
    assert_close(ys, ends(term, EXACT, 0.0, 100.0, 0.1, y0), 1e-3)


@pytest.mark.parametrize("heavy", [1.0, 1e2, 1e6])
def test_a_light_body_that_is_ejected(heavy):
    """Beside a heavy one, whose steps are short enough."""
    mass = jnp.array([1.0, heavy])
    attraction = lambda t, q, args: -jnp.sum(mass / jnp.linalg.norm(q, axis=1))
    term = dps.MechanicalSystem(dps.QuadraticKinetic(mass[:, None]), attraction)
    v = jnp.array([[0.0, 1.5**0.5], [0.0, 0.3**0.5]])
    y0 = term.from_velocity(0.0, (jnp.array([[0.8, 0.0], [4.0, 0.0]]), v))
    for steps, good in ((24, False), (60, True)):
        times = 0.0, 200 * np.pi, 2 * np.pi / steps
        sol: Any = solve(
            *(term, dps.SymmetricMultistep(8), *times, y0),
            **dict(adjoint=FIXED, max_steps=None, throw=False),
        )
        assert (sol.result == MULTISTEP_UNSTABLE) != good
        assert (jnp.linalg.norm(sol.ys[0][-1, 0]) < 1.3) == good


def test_bad_input():
    order: Any
    for order in (4, 9, 12, 8.0, True):
        with pytest.raises(ValueError, match="8 or 10"):
            dps.SymmetricMultistep(order)
    own, kinetic = dps.SymmetricMultistep(8), dps.QuadraticKinetic()
    for hamiltonian in (
        dps.MechanicalSystem(dps.RelativisticKinetic(), pendulum),
        dps.MechanicalSystem(kinetic, pendulum, dps.LogDamping(3.0, 1.0)),
        dps.MechanicalSystem(kinetic, pendulum, dps.ViscousDamping(jnp.eye(2))),
        dps.Hamiltonian(lambda t, q, p, args: p @ p),
    ):
        with pytest.raises(ValueError, match="a constant mass and at most one rate"):
            solve(hamiltonian, own, 0.0, 1.0, 0.1, Y0)
    with pytest.raises(ValueError, match="unequal steps"):
        solve(system(None), dps.Suzuki4(own), 0.0, 1.0, 0.1, Y0, ONE)
    with pytest.raises((ValueError, RuntimeError), match="error estimate"):
        controller = dfx.PIDController(rtol=1e-6, atol=1e-6)
        args = system(None), own, 0.0, 1.0, 0.1, Y0, ONE
        solve(*args, stepsize_controller=controller)
