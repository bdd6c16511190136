"""Potentials of pairs of particles: values, forces, coincidence, and periodic boxes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import diffrax_presym as dps


@pytest.mark.slow
def test_pairwise_potential():
    masses, q = jnp.array([1.0, 2.0, 0.5, 3.0]), jnp.arange(12.0).reshape(4, 3) ** 1.3
    i, j = np.triu_indices(4, 1)

    def by_index(t, q, args):
        r = jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2, axis=1))
        return args * jnp.sum(masses[i] * masses[j] * (1 + t) / r**2)

    fn = lambda t, r, args: args * (1 + t) / r**2
    potential = dps.pairwise_potential(fn, masses)
    args = jnp.array(0.3), q, jnp.array(2.0)
    for order in (lambda f: f, lambda f: jax.grad(f, argnums=(0, 1, 2))):
        assert_close(order(potential)(*args), order(by_index)(*args), 1e-14)
    second = lambda f: jax.hessian(f, argnums=1)(*args)
    assert_close(second(potential), second(by_index), 1e-13)
    # Its force has no scattered additions, which are slow.
    assert "scatter" not in str(jax.make_jaxpr(jax.grad(potential, argnums=1))(*args))
    unit = dps.pairwise_potential(fn)
    distances = jnp.linalg.norm(q[i] - q[j], axis=1)
    assert_close(unit(*args), jnp.sum(fn(0.3, distances, 2.0)), 1e-14)


def test_numpy_states():
    gravity = dps.pairwise_potential(lambda t, r, args: -1 / r)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), gravity, lambda t: 0.1 * t)
    q, p = np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])
    assert_close(system.energy(0.0, q, p), 0.0, 1e-15)
    force = np.array([[0.25, 0.0], [-0.25, 0.0]])
    assert_close(system.force(0.0, q, p), force, 1e-15)
    assert_close(system.vf(0.0, (q, p), None), (p, force - 0.1 * p), 1e-15)


@pytest.mark.parametrize("box", [2.0, np.array([2.0, 3.0])])
def test_pairs_in_a_periodic_box(box):
    q = np.array([[0.1, 0.2], [1.9, 2.9], [1.2, 1.3], [-3.2, 7.45]])
    potential = dps.pairwise_potential(lambda t, r, args: jnp.exp(-(r**2)), box=box)
    cells = np.array([[i, j] for i in range(-6, 7) for j in range(-6, 7)]) * box

    def nearest(q):
        pairs = [q[i] - q[j] for i in range(4) for j in range(i)]
        squares = [min(np.sum((d + cells) ** 2, axis=1)) for d in pairs]
        return np.sum(np.exp(-np.array(squares)))

    assert_close(potential(0.0, jnp.asarray(q), None), nearest(q), 1e-14)
    force = jax.grad(lambda q: potential(0.0, q, None))(jnp.asarray(q))
    units = 1e-5 * np.eye(8).reshape(8, 4, 2)
    wanted = [(nearest(q + e) - nearest(q - e)) / 2e-5 for e in units]
    assert_close(force, jnp.asarray(wanted).reshape(4, 2), 1e-9)
    for moved in (q + 0.77, q + cells[30], q - cells[7] * np.arange(4)[:, None]):
        assert_close(potential(0.0, jnp.asarray(moved), None), nearest(q), 1e-14)


def test_two_particles_at_one_place():
    potential = dps.pairwise_potential(lambda t, r, args: -1 / jnp.sqrt(1 + r**2))
    q = jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    force = jax.grad(lambda q: potential(0.0, q, None))(q)
    assert np.all(np.isfinite(force))


def test_an_energy_that_is_infinite_at_the_distance_one():
    energy = lambda t, r, c: c / (r**2 - 1) ** 2
    potential = dps.pairwise_potential(energy)
    q = jnp.array([[0.0, 0.0], [2.0, 0.0]])
    slope = jax.grad(lambda c: potential(0.0, q, c))(2.0)
    np.testing.assert_allclose(slope, 1 / 9)
