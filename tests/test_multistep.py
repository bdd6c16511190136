"""Symmetric multistep methods."""

from fractions import Fraction
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, henon_heiles, pendulum, solve

import diffrax_presym as dps
from diffrax_presym._scheme._multistep_tables import (
    exact_coefficients,
    multistep_table,
    RHO,
)


ORDERS = (8, 10, 12)


def driven(t, q, args):
    """A potential that depends on time, and on a parameter."""
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.cos(t) * q[0] * q[1] / 10


def system(damping):
    mass = dps.QuadraticKinetic(jnp.array([1.0, 2.0]))
    return dps.ConformalHamiltonian(mass, driven, damping)


LAWS = {
    "none": None,
    "constant": dps.ConstantDamping(0.2),
    "excitation": dps.ConstantDamping(-0.1),
    "logarithmic": dps.LogDamping(1.5, 2.0),
    "mixed": [dps.LogDamping(0.4), dps.PowerDamping(0.2, 0.7)],
}
Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.2, 0.4]))
ONE = jnp.array(1.0)
# An integrator of another kind, whose order does not depend on the law.
EXACT = dps.SofroniouSpaletta(10)


# Coefficients


@pytest.mark.parametrize("rho", RHO.values(), ids=map(str, RHO))
def test_conditions_of_order(rho):
    # For x = t^q: sum alpha_j j^q = q (q - 1) sum beta_j j^(q - 2), exactly.
    _, forces = exact_coefficients(rho)
    alpha = [Fraction(x) for x in (*rho, *rho[-2::-1])]
    beta = [Fraction(0), *forces, Fraction(0)]
    order = len(alpha) - 1
    assert alpha == alpha[::-1] and beta == beta[::-1]

    def defect(q):
        left = sum(a * Fraction(j) ** q for j, a in enumerate(alpha))
        right = sum(b * Fraction(j) ** max(q - 2, 0) for j, b in enumerate(beta))
        return left - q * (q - 1) * right

    assert all(defect(q) == 0 for q in range(order + 2))
    assert defect(order + 2) != 0
    # All roots but the double one at 1 are simple and on the unit circle.
    roots = np.roots(multistep_table(rho).kicks)
    assert np.allclose(np.abs(roots), 1, atol=1e-10)
    assert np.min(np.abs(roots - 1)) > 0.1
    assert np.min(np.abs(roots[:, None] - roots) + 2 * np.eye(order - 2)) > 0.02


# Order


CASES = [(order, "logarithmic") for order in ORDERS]
CASES += [(8, law) for law in LAWS if law != "logarithmic"]


def ends(*args, **options) -> Any:
    """What a solve saves, by default the final state."""
    return solve(*args, **options).ys


def largest(x, y):
    pairs = zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True)
    return max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs)


@pytest.mark.parametrize("order, law", CASES)
def test_order(order, law):
    hamiltonian, solver = system(LAWS[law]), dps.SymmetricMultistep(order)
    assert solver.order(None) == order
    exact = ends(hamiltonian, EXACT, 1.0, 13.0, 0.05, Y0, ONE)
    counts = (128, 200)
    errors = [
        largest(ends(hamiltonian, solver, 1.0, 13.0, 12 / n, Y0, ONE), exact)
        for n in counts
    ]
    measured = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert measured > order - 2
    assert errors[0] < 1e-7 and errors[1] < 3e-9


@pytest.mark.slow
def test_backwards_in_time_and_any_mass():
    mass = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    damping = dps.LogDamping(1.0, 3.0)
    for kinetic in (dps.QuadraticKinetic(mass), dps.QuadraticKinetic(3.0)):
        hamiltonian = dps.ConformalHamiltonian(kinetic, henon_heiles, damping)
        y0 = jax.tree.map(lambda x: x / 4, Y0)
        args = hamiltonian, dps.SymmetricMultistep(8), 10.0, 4.0, -0.05, y0
        exact = ends(hamiltonian, EXACT, *args[2:])
        assert_close(ends(*args), exact, 1e-9)


def test_first_steps_after_a_singularity_are_those_of_the_other_scheme():
    hamiltonian = system(dps.LogDamping(3.0))
    y0 = Y0[0], jnp.zeros(2)
    end = lambda solver: ends(hamiltonian, solver, 0.0, 20.0, 0.1, y0, ONE)
    assert_close(end(dps.SymmetricMultistep(10)), end(dps.BlanesCasasRKN8()), 1e-9)


# One evaluation per step


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
        solve(*args, adjoint=dps.FixedStepAdjoint())
        jax.effects_barrier()
        numbers.append(len(count))
    assert numbers[1] - numbers[0] == 40


# Steps that are not equal


def test_a_change_of_the_step_starts_again():
    hamiltonian, solver = system(LAWS["constant"]), dps.SymmetricMultistep(10)
    ts = jnp.concatenate([jnp.linspace(0.0, 3, 31), 3 + jnp.linspace(0, 2, 41)[1:]])
    term, controller = hamiltonian, dfx.StepTo(ts)
    args = term, solver, 0.0, 5.0, None, Y0, ONE
    end = dfx.diffeqsolve(*args, stepsize_controller=controller).ys
    exact = ends(hamiltonian, EXACT, 0.0, 5.0, 0.05, Y0, ONE)
    assert_close(end, exact, 1e-9)
    # With a history that is not recomputed, the error would be of the order of one.
    uneven = ends(hamiltonian, solver, 0.0, 5.0, 0.107, Y0, ONE)
    assert_close(uneven, exact, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [lambda x: x, dps.Compensated])
def test_a_change_of_the_step_is_not_undone(wrap):
    """What is known of the steps before it is dropped, so that reversal is refused."""
    term = system(LAWS["constant"])
    solver = wrap(dps.SymmetricMultistep(8))
    # So short that the error of the states alone does not show it.
    ts = jnp.concatenate([jnp.linspace(0.0, 2, 41), 2 + jnp.linspace(0, 2, 21)[1:]])
    saveat = dfx.SaveAt(t1=True, solver_state=True)

    @eqx.filter_jit
    def run(x, adjoint, ts, y=Y0, state=None) -> Any:
        return dfx.diffeqsolve(
            *(term, solver, ts[0], ts[-1], None, jax.tree.map(lambda y: x * y, y)),
            args=ONE,
            solver_state=state,
            saveat=saveat,
            stepsize_controller=dfx.StepTo(ts),
            adjoint=adjoint,
            max_steps=64,
        )

    def loss(x, adjoint, *args):
        return jnp.sum(run(x, adjoint, *args).ys[0] ** 2)

    fixed, reversible = dps.FixedStepAdjoint("checkpoints"), dps.FixedStepAdjoint()
    slope = jax.grad(loss)(ONE, fixed, ts)
    up, down = (loss(x, fixed, ts) for x in (ONE + 1e-5, ONE - 1e-5))
    assert_close(slope, (up - down) / 2e-5, 1e-8)
    with pytest.raises(RuntimeError, match="without its history"):
        jax.block_until_ready(jax.grad(loss)(ONE, reversible, ts))
    # A change before the solve, which goes on with equal steps, does not matter.
    sol = run(ONE, fixed, ts)
    end = jax.tree.map(lambda y: y[-1], sol.ys)
    rest = 4 + jnp.linspace(0, 2, 21), end, sol.solver_state
    exact = jax.grad(loss)(ONE, fixed, *rest)
    assert_close(jax.grad(loss)(ONE, reversible, *rest), exact, 1e-10)


def test_a_jump_starts_again():
    def pushed(t, q, args):
        return pendulum(t, q, args) - jnp.where(t < args, 0, 1.0) * jnp.sum(q)

    kinetic = dps.QuadraticKinetic()
    hamiltonian = dps.ConformalHamiltonian(kinetic, pushed, dps.ConstantDamping(0.1))
    solver, term = dps.SymmetricMultistep(8), hamiltonian
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
    half = last(ends(hamiltonian, EXACT, 0.0, 2.0, 0.05, Y0, before))
    exact = last(ends(hamiltonian, EXACT, 2.0, 4.0, 0.05, half, after))
    assert_close(walk(Y0, True), exact, 1e-8)
    assert largest(walk(Y0, False), exact) > 1e-3


@pytest.mark.slow
def test_events():
    hamiltonian, solver = system(LAWS["constant"]), dps.SymmetricMultistep(8)
    cond = lambda t, y, args, **kwargs: y[0][0]
    event = dfx.Event(cond, optx.Newton(1e-11, 1e-11))
    sol: Any = solve(hamiltonian, solver, 0.0, 9.0, 0.05, Y0, ONE, event=event)
    assert sol.result == dfx.RESULTS.event_occurred
    end = ends(hamiltonian, EXACT, 0.0, sol.ts[-1], 0.05, Y0, ONE)
    assert abs(float(end[0][-1, 0])) < 1e-9
    assert_close(sol.ys, end, 1e-8)


# Everything else


@pytest.mark.slow
@pytest.mark.parametrize("law", ("none", pytest.param("mixed", marks=pytest.mark.slow)))
def test_between_steps_the_error_is_that_at_steps(law):
    hamiltonian, solver = system(LAWS[law]), dps.SymmetricMultistep(12)
    saveat = dfx.SaveAt(ts=jnp.linspace(1.0, 6.0, 1 + 160))
    args = 1.0, 6.0, 0.125, Y0, ONE
    options = dict(saveat=saveat, adjoint=dps.FixedStepAdjoint())
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


@pytest.mark.slow
def test_vmap():
    solver = dps.SymmetricMultistep(8)

    def end(scale, t0, gamma):
        y0 = jax.tree.map(lambda x: scale * x, Y0)
        one = system(dps.LogDamping(gamma, 2.0))
        # Some in the batch are at the start while others are not.
        return ends(one, solver, t0, 4.0, 0.1, y0, ONE)

    inputs = jnp.array([0.5, 1.0]), jnp.array([0.0, 1.5]), jnp.array([1.5, 0.7])
    batch = jax.vmap(end)(*inputs)
    for i in range(2):
        one = end(*(x[i] for x in inputs))
        assert_close(jax.tree.map(lambda x, i=i: x[i], batch), one, 1e-13)


def energy_error(order, eccentricity, per_orbit, orbits):
    """The largest energy error of Kepler's problem in each tenth of the time."""
    kinetic = dps.QuadraticKinetic()
    potential = lambda t, q, args: -1 / jnp.sqrt(jnp.sum(q**2))
    hamiltonian = dps.MechanicalSystem(kinetic, potential)
    e = eccentricity
    y0 = jnp.array([1 - e, 0.0]), jnp.array([0.0, np.sqrt((1 + e) / (1 - e))])
    solver, h = dps.SymmetricMultistep(order), 2 * np.pi / per_orbit
    ts = jnp.linspace(0, 2 * np.pi * orbits, 10 * orbits + 1)
    saveat = dfx.SaveAt(ts=ts, fn=lambda t, y, args: hamiltonian.energy(t, *y))
    options = dict(saveat=saveat, max_steps=None, adjoint=dps.FixedStepAdjoint())
    energies = ends(hamiltonian, solver, 0.0, ts[-1], h, y0, **options)
    return np.max(np.abs(np.reshape(energies[1:] + 0.5, (10, -1))), axis=1)


@pytest.mark.parametrize("order", ORDERS)
def test_energy_does_not_drift(order):
    errors = energy_error(order, 0.2, 113, 200)
    assert errors[0] < {8: 3e-8, 10: 3e-9, 12: 3e-9}[order]
    assert errors[-1] < 2 * errors[0] + 1e-13


# Bad input


def test_bad_input():
    order: Any
    for order in (7, 9, 14, 8.0, True):
        with pytest.raises(ValueError, match="8, 10 or 12"):
            dps.SymmetricMultistep(order)
    with pytest.raises(ValueError, match="TunedRKN6"):
        dps.SymmetricMultistep(4)
    own = dps.SymmetricMultistep(8)
    relativistic = dps.ConformalHamiltonian(
        dps.RelativisticKinetic(), pendulum, dps.ConstantDamping(0.1)
    )
    for hamiltonian in (relativistic, dps.Hamiltonian(lambda t, q, p, args: p @ p)):
        with pytest.raises(ValueError, match="a known mass"):
            solve(hamiltonian, own, 0.0, 1.0, 0.1, Y0)
    with pytest.raises(ValueError, match="unequal steps"):
        solve(system(None), dps.Suzuki4(own), 0.0, 1.0, 0.1, Y0, ONE)
    with pytest.raises((ValueError, RuntimeError), match="error estimate"):
        controller = dfx.PIDController(rtol=1e-6, atol=1e-6)
        args = system(None), own, 0.0, 1.0, 0.1, Y0, ONE
        solve(*args, stepsize_controller=controller)
