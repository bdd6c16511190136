"""Energies that are neither separable nor split: two copies, or implicit steps."""

from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import flat, mixed_energy, solve, trajectory
from jax.test_util import check_grads

import diffrax_presym as dps
from diffrax_presym import _results


MIXED = dps.Hamiltonian(mixed_energy)
DAMPED = dps.Hamiltonian(mixed_energy, dps.ConstantDamping(0.05))
START = (jnp.array([-3.0]), jnp.array([0.0]))


# Tao's benchmark


def energy_errors(solver, dt0):
    """The largest error of the energy in the first and the last quarter of a solve."""
    _, q, p = trajectory(MIXED, solver, 0.0, 100.0, dt0, START)
    errors = np.abs((1 + q[:, 0] ** 2) * (1 + p[:, 0] ** 2) / 2 - 5)
    quarter = len(errors) // 4
    return np.max(errors[:quarter]), np.max(errors[-quarter:])


@pytest.mark.slow
def test_energy_errors_do_not_grow():
    schemes = (dps.PresymplecticTao(), 1 / 40), (dps.PresymplecticGauss(2), 1 / 10)
    for solver, dt0 in schemes:
        first, last = energy_errors(solver, dt0)
        assert last < 1.2 * first


# Friction over long times


def test_damped_motion_stays_finite():
    sol = solve(
        *(DAMPED, dps.PresymplecticTao(), 0.0, 1000.0, 1 / 16, START), max_steps=None
    )
    assert sol.result == dfx.RESULTS.successful
    # At small amplitude the system is the oscillator, with the same decay.
    assert np.log(np.max(np.abs(flat(sol.ys)))) == pytest.approx(-25, abs=1.5)


# Masses that depend on positions


MASSES = {
    "indefinite": lambda t, q, args: jnp.array([[1.0, 2.0], [2.0, 1.0]]),
    "positive at first": lambda t, q, args: jnp.eye(2) * (0.5 - t),
    "positive at the stages": lambda t, q, args: jnp.eye(2) * jnp.sign(0.99 - t),
    "not symmetric": lambda t, q, args: jnp.array([[2.0, 0.1], [0.3, 1.0]]),
}


# One for each way of factorisation.
SIZES = 2, 6, 20


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("mass", MASSES.values(), ids=MASSES)
def test_a_mass_matrix_that_is_not_positive_and_symmetric_is_a_result(mass, n):
    larger = lambda *at: jax.scipy.linalg.block_diag(mass(*at), jnp.eye(n - 2))
    system = dps.LagrangianSystem(larger, lambda t, q, args: jnp.sum(q**2) / 2)
    y0 = jnp.ones(n), jnp.ones(n)
    sol = solve(system, dps.PresymplecticGauss(2), 0.0, 1.0, 0.1, y0, throw=False)
    if mass in (MASSES["not symmetric"], MASSES["positive at the stages"]):
        assert sol.result == _results.ENERGY_NOT_DEFINED
    else:
        assert sol.result != dfx.RESULTS.successful


@pytest.mark.variants(1)
@pytest.mark.parametrize("n", SIZES)
def test_velocities_and_their_derivatives(n):
    x = np.random.default_rng(n).standard_normal((n + 3, n))
    mass = lambda t, q, args: x.T @ (jnp.cos(q[0]) * x) + jnp.diag(3 + jnp.sin(q))
    system = dps.LagrangianSystem(mass, lambda t, q, args: jnp.zeros(()))
    y = jnp.linspace(0.1, 0.5, n), jnp.linspace(0.2, 1.0, n)
    velocity = partial(system.velocity, 0.0)
    expected = np.linalg.solve(mass(0.0, *y), y[1])
    assert velocity(*y) == pytest.approx(expected, rel=1e-12)
    check_grads(velocity, y, order=2, rtol=1e-6, atol=1e-6)


def test_gradient_of_a_chain_of_six_links():
    below = 6.0 - np.maximum(*np.indices((6, 6)))
    mass = lambda t, q, args: below * jnp.cos(q[:, None] - q[None])
    height = lambda t, q, args: -9.81 * jnp.dot(below[0], jnp.cos(q))
    arm = dps.LagrangianSystem(mass, height, dps.ViscousDamping(0.1))

    def end(q):
        options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None}
        gauss = dps.PresymplecticGauss(3)
        return solve(arm, gauss, 0.0, 0.5, 0.05, (q, jnp.zeros(6)), **options).ys

    check_grads(end, (jnp.linspace(0.1, 1.0, 6),), 1, ["rev"], atol=1e-6, rtol=1e-6)
