"""Results of the paper's experiments, against independent computations."""

import itertools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_presym as dps
from examples.paper import (
    _ising as ising,
    boltzmann_machine as machine,
    phase_diagram as phase,
)
from examples.paper._common import Nesterov


@pytest.fixture(autouse=True)
def as_user():
    """The examples are written for the default settings of JAX."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def system(gamma):
    damping = dps.ConstantDamping(gamma)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), phase.potential, damping)


@pytest.mark.slow
@pytest.mark.parametrize("temperature", [0.8, 2.2, 2.4, 4.0])
def test_partition_function_by_enumeration(temperature):
    """On both sides of the critical temperature, where a term changes its sign."""
    spins = np.array(list(itertools.product((-1, 1), repeat=16)), np.int8)
    energies = np.asarray(ising.energy(jnp.asarray(spins).reshape(-1, 4, 4)), float)
    weights = np.exp(-(energies + 32) / temperature)
    mean = np.average(energies, weights=weights)
    variance = np.average((energies - mean) ** 2, weights=weights)
    energy, heat_capacity = ising.exact(temperature, 4)
    np.testing.assert_allclose(energy, mean / 16, rtol=1e-9)
    np.testing.assert_allclose(heat_capacity, variance / temperature**2 / 16, rtol=1e-7)
    log_z = np.log(np.sum(weights)) + 32 / temperature
    np.testing.assert_allclose(ising.log_partition(1 / temperature, 4), log_z)


@pytest.mark.slow
def test_metropolis_draws_from_the_ensemble():
    temperatures = jnp.array([1.5, 2.3, 4.0])
    spins = ising.metropolis(jax.random.key(0), temperatures, 4, 200, 20, 100, 10)
    assert spins.shape == (3, 4000, 4, 4)
    for temperature, lattices in zip(temperatures, spins, strict=True):
        exact = ising.exact(temperature, 4)
        found = ising.estimates(ising.energy(lattices), temperature, 4)
        np.testing.assert_allclose(found, exact, rtol=0.05)
        assert abs(float(jnp.mean(lattices.astype(float)))) < 0.1


@pytest.mark.parametrize("name", phase.METHODS)
@pytest.mark.parametrize("gamma", [0.3, 1.0])
def test_limits_of_stability(name, gamma):
    """Trace and determinant are those of a step, which is unstable above the limit."""
    solver, method = phase.METHODS[name]
    fastest = jnp.array([3.0])
    found = phase.largest_step(method, gamma, np.asarray(fastest))
    limit = found if np.isfinite(found) else 1.5
    term, radii = system(gamma), []
    for h in (0.9 * limit, 1.01 * limit):
        t0, t1 = jnp.asarray(0.0), jnp.asarray(h)

        def step(y, t0=t0, t1=t1):
            carry = solver.init(term, t0, t1, y, fastest)
            return solver.step(term, t0, t1, y, fastest, carry, False)[0]

        blocks = jax.jacobian(step)((jnp.zeros(1), jnp.zeros(1)))
        matrix = np.block([[np.asarray(x) for x in row] for row in blocks])
        trace, det = method(gamma, h, h**2 * np.asarray(fastest))
        np.testing.assert_allclose(np.trace(matrix), trace[0], rtol=1e-10)
        np.testing.assert_allclose(np.linalg.det(matrix), np.max(det), rtol=1e-9)
        radii.append(np.max(np.abs(np.linalg.eigvals(matrix))))
    assert radii[0] < 1
    assert (radii[1] > 1) == np.isfinite(found)


def test_nesterov_by_hand():
    """And the heavy ball method, which is Euler's method, momentum first."""
    M = np.diag([1.0, 2.0])
    gamma, h = 0.7, 0.3
    mu = np.exp(-gamma * h)

    def by_package(solver):
        y0 = jnp.ones(2), jnp.zeros(2)
        sol = dfx.diffeqsolve(
            *(system(gamma), solver, 0.0, 20 * h, h, y0, jnp.diagonal(M)),
            saveat=dfx.SaveAt(steps=True),
            max_steps=20,
        )
        assert sol.ys is not None
        return np.asarray(sol.ys[0])

    q, p = np.ones(2), np.zeros(2)
    ball, before = np.ones(2), np.ones(2)
    nesterov, heavy_ball = [], []
    for _ in range(20):
        p = mu * p - h * M @ (q + h * mu * p)
        q = q + h * p
        nesterov.append(q)
        ball, before = ball + mu * (ball - before) - h**2 * M @ ball, ball
        heavy_ball.append(ball)
    np.testing.assert_allclose(by_package(Nesterov()), nesterov, atol=1e-12)
    euler = by_package(dps.PresymplecticEuler())
    np.testing.assert_allclose(euler, heavy_ball, atol=1e-12)


def test_modes_are_the_matrix():
    """Gradient norms agree in the original and in the modal coordinates."""
    key = jax.random.key(3)
    eigenvalues, q0 = phase.modes(key, 16, 20)
    A = np.asarray(jax.random.normal(key, (16, 20)))
    M = A.T @ A / 20
    q, p, modes_q, modes_p = np.ones(20), np.zeros(20), np.asarray(q0), np.zeros(20)
    for _ in range(10):
        p = p - 0.3 * M @ q
        q = q + 0.3 * p
        modes_p = modes_p - 0.3 * np.asarray(eigenvalues) * modes_q
        modes_q = modes_q + 0.3 * modes_p
    assert np.sum(np.asarray(eigenvalues) < 1e-10) == 4
    norms = np.linalg.norm(M @ q), np.linalg.norm(eigenvalues * modes_q)
    np.testing.assert_allclose(*norms)


@pytest.mark.slow
def test_machine_is_trained_by_the_scaled_leapfrog():
    """The scaled updates of the paper, with one random gradient per step."""
    key = jax.random.key(5)
    batches = jax.random.bernoulli(key, 0.3, (2, 3, machine.BATCH, 64))
    data = machine.Data(batches.astype(jnp.float32), key, 2.5e-2)
    q0 = machine.initial(key, 2)
    term, solver, h = machine.METHODS["leapfrog"]
    losses, trained = machine.train(term, solver, q0, data, 2, 1)
    assert losses.shape == (2, 2)

    mu = 0.98
    add = lambda x, c, y: jax.tree.map(lambda x, y: x + c * y, x, y)
    scale = lambda c, x: jax.tree.map(lambda x: c * x, x)
    # `force` includes the step size.
    force = jax.jit(lambda step, q: scale(1 / h, machine.force(step, q, data)))
    q, p = q0, scale(0.0, q0)
    slope = force(0.0, q)
    for step in range(6):
        p = scale(mu, add(p, h / 2, slope))
        q = add(q, h * np.cosh(np.log(mu)), p)
        slope = force(step + 1.0, q)
        p = add(scale(mu, p), h / 2, slope)
    for name in q:
        assert trained[name].dtype == jnp.float32
        np.testing.assert_allclose(trained[name], q[name], atol=2e-4)


def test_contrastive_divergence_follows_the_likelihood():
    """For samples of the model itself, the mean gradient vanishes."""
    key = jax.random.key(6)
    q = jax.tree.map(lambda x: x[0], machine.initial(key, 1))
    start = jax.random.bernoulli(key, 0.5, (1000, 64)).astype(jnp.float32)

    def step(visible, key):
        return machine.gibbs(q, visible, machine.uniforms(key, visible)), None

    keys = jax.random.split(key, 101)
    visible, _ = jax.lax.scan(step, start, keys[1:])
    direction = jax.jit(machine.ascent)
    at_rest = direction(q, visible, machine.uniforms(keys[0], visible))["visible"]
    at_start = direction(q, start, machine.uniforms(keys[0], start))["visible"]
    assert jnp.linalg.norm(at_rest) < 0.2 * jnp.linalg.norm(at_start)
