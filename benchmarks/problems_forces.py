"""Five motions with a force of the velocity that is no law of friction.

Each is written twice: with the package, and in bare NumPy for SciPy. `number` is that
of the bodies, or of the straight pieces of a coil.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.integrate
from jax.scipy.special import erf
from scipy.special import erf as erf_numpy

import diffrax_presym as dps


class Forced(NamedTuple):
    name: str
    system: Any
    y0: tuple[np.ndarray, np.ndarray]
    t1: float
    field: Callable  # velocity and all forces, of t, q, p, in NumPy

    def exact(self, t1=None):
        """The end of the solve, by SciPy."""
        shape = self.y0[0].shape

        def slope(t, y):
            v, force = self.field(t, *y.reshape(2, *shape))
            return np.stack([v, force]).ravel()

        t1 = self.t1 if t1 is None else t1
        solution = scipy.integrate.solve_ivp(
            slope, (0, t1), np.ravel(self.y0), "DOP853", rtol=1e-13, atol=1e-13
        )
        return solution.y[:, -1].reshape(2, *shape)


def _pairs(q, slope):
    """The sum over the others of `slope(r^2)` times the distance."""
    d = q[:, None] - q
    return np.sum(slope(np.sum(d**2, axis=-1))[..., None] * d, axis=1)


def _spread(number, dimensions, seed=0):
    return np.random.default_rng(seed).normal(size=(number, dimensions))


def clusters(number=24):
    """Clusters in a galaxy with a halo of circular velocity 1, by Chandrasekhar's
    formula: its density is 1 / (r^2 + 0.04), its dispersion 1 / sqrt(2)."""
    mass, x = 2e-3, _spread(number, 3)
    attraction = dps.pairwise_potential(
        lambda t, r, args: -mass / jnp.sqrt(r**2 + 0.01)
    )

    def potential(t, q, args):
        halo = jnp.sum(jnp.log(jnp.sum(q**2, axis=-1) + 0.04)) / 2
        return halo + attraction(t, q, args)

    def friction(t, q, v, args):
        square = jnp.sum(v**2, axis=-1, keepdims=True) + 1e-8
        speed = jnp.sqrt(square)
        slower = erf(speed) - 2 / np.sqrt(np.pi) * speed * jnp.exp(-square)
        density = 1 / (jnp.sum(q**2, axis=-1, keepdims=True) + 0.04)
        return -0.05 * density * slower / (square * speed) * v

    def field(t, q, v):
        square = np.sum(v**2, axis=-1, keepdims=True) + 1e-8
        slower = erf_numpy(np.sqrt(square))
        slower -= 2 / np.sqrt(np.pi) * np.sqrt(square) * np.exp(-square)
        density = 1 / (np.sum(q**2, axis=-1, keepdims=True) + 0.04)
        pulled = _pairs(q, lambda r2: -mass / (r2 + 0.01) ** 1.5)
        friction = 0.05 * density * slower / square**1.5 * v
        return v, -density * q + pulled - friction

    kinetic = dps.QuadraticKinetic()
    system = dps.MechanicalSystem(kinetic, potential, force=friction)
    y0 = x, 0.7 * _spread(number, 3, 1)
    return Forced("dynamical friction", system, y0, 10.0, field)


def planets(number=12):
    """Planets around a star, whose gas damps their eccentricities, along the radius."""
    mass, rate = 1e-5, 0.02
    attraction = dps.pairwise_potential(
        lambda t, r, args: -mass / jnp.sqrt(r**2 + 1e-4)
    )

    def potential(t, q, args):
        star = -jnp.sum(1 / jnp.sqrt(jnp.sum(q**2, axis=-1)))
        return star + attraction(t, q, args)

    def gas(t, q, v, args):
        along, square = (jnp.sum(q * x, axis=-1, keepdims=True) for x in (v, q))
        return -2 * rate * along / square * q

    def field(t, q, v):
        along, square = (np.sum(q * x, axis=-1, keepdims=True) for x in (v, q))
        pulled = _pairs(q, lambda r2: -mass / (r2 + 1e-4) ** 1.5)
        return v, -q / square**1.5 + pulled - 2 * rate * along / square * q

    radius, angle = 1.2 ** np.arange(number), 2.4 * np.arange(number)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    across = np.stack([-np.sin(angle), np.cos(angle), 0.05 + 0 * angle], axis=-1)
    y0 = radius[:, None] * around, 1.1 / np.sqrt(radius)[:, None] * across
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, force=gas)
    return Forced("eccentricity damping", system, y0, 40.0, field)


def drones(number=24):
    """Drones that avoid each other, each with a PD controller along its own circle."""
    mass, gain, damping = 1.5, 4.0, 1.0
    phase = 2 * np.pi * np.arange(number) / number
    repulsion = dps.pairwise_potential(lambda t, r, args: 0.2 * jnp.exp(-(r**2)))

    def motors(t, q, v, args):
        circle = jnp.stack([jnp.cos(t + phase), jnp.sin(2 * t + phase)], axis=-1)
        speed = jnp.stack([-jnp.sin(t + phase), 2 * jnp.cos(2 * t + phase)], axis=-1)
        return gain * (2 * circle - q) + damping * (2 * speed - v)

    def field(t, q, p):
        circle = np.stack([np.cos(t + phase), np.sin(2 * t + phase)], axis=-1)
        speed = np.stack([-np.sin(t + phase), 2 * np.cos(2 * t + phase)], axis=-1)
        pushed = _pairs(q, lambda r2: 0.4 * np.exp(-r2))
        motors = gain * (2 * circle - q) + damping * (2 * speed - p / mass)
        return p / mass, pushed + motors

    y0 = _spread(number, 2), np.zeros((number, 2))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(mass), repulsion, force=motors)
    return Forced("PD controller", system, y0, 10.0, field)


def pucks(number=24):
    """Pucks on a belt that moves, pushed by each other and drawn to the middle, with
    Coulomb friction that is smoothed."""
    repulsion = dps.pairwise_potential(lambda t, r, args: jnp.exp(-(r**2)))
    belt, strength, width = np.array([0.3, 0.0]), 0.1, 0.2

    def potential(t, q, args):
        return jnp.sum(q**2) / 2 + repulsion(t, q, args)

    def friction(t, q, v, args):
        return -strength * jnp.tanh((v - belt) / width)

    def field(t, q, v):
        pushed = _pairs(q, lambda r2: 2 * np.exp(-r2))
        return v, -q + pushed - strength * np.tanh((v - belt) / width)

    y0 = _spread(number, 2), np.zeros((number, 2))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, force=friction)
    return Forced("tanh friction", system, y0, 8.0, field)


def _coils(number):
    """The middles of the pieces of two rings, and their directions."""
    angle = 2 * np.pi * np.arange(number) / number
    ring = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], axis=-1)
    piece = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=-1)
    shift = np.array([0.0, 0.0, 2.0])
    places = np.concatenate([ring - shift, ring + shift])
    return places, np.tile(piece, (2, 1)) * 30 / number


def charge(number=100):
    """A relativistic charge between two coils, in a magnetic bottle."""
    places, pieces = _coils(number)
    c = 2.0

    def potential(t, q, args):
        return 0.1 * q[2] ** 2 - 0.05 * q[0]

    def lorentz(t, q, v, args):
        d = q - places
        distance = jnp.sqrt(jnp.sum(d**2, axis=-1, keepdims=True))
        return jnp.cross(v, jnp.sum(jnp.cross(pieces, d) / distance**3, axis=0))

    def field(t, q, p):
        v = c * p / np.sqrt(p @ p + c**2)
        d = q - places
        distance = np.sqrt(np.sum(d**2, axis=-1, keepdims=True))
        magnetic = np.sum(np.cross(pieces, d) / distance**3, axis=0)
        return v, np.array([0.05, 0.0, -0.2 * q[2]]) + np.cross(v, magnetic)

    y0 = np.array([0.5, 0.0, 0.3]), np.array([0.0, 1.5, 0.5])
    kinetic = dps.RelativisticKinetic(mass=1.0, speed=c)
    system = dps.MechanicalSystem(kinetic, potential, force=lorentz)
    return Forced("charge in B(q)", system, y0, 20.0, field)


FORCES = [clusters, planets, drones, pucks, charge]
