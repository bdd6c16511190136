# pyright: reportCallIssue=false
"""Systems of which the force or the velocity jumps at a time, each written twice."""

import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps

from ._system import energy, JUMP, MASS, mechanical, PLANE, SPLIT, System, TWO


def _push(t):
    return jnp.where(t > JUMP, -0.9, 0.7)


def _push_numpy(t):
    return -0.9 if t > JUMP else 0.7


def _potential(t, q, args):
    """Of all positions, with a force on some of them that jumps."""
    some = q[0]
    return jnp.sum(q**2) / 2 - jnp.sum(jnp.cos(q)) - _push(t) * jnp.sum(some + some**2)


def _force(first):
    def force(t, q, p):
        push = np.where(np.arange(len(q)) < first, 1 + 2 * q, 0)
        return -q - np.sin(q) + _push_numpy(t) * push

    return force


def _kinetic(t, p, args):
    return _push(t) * jnp.sum(jnp.sqrt(1 + p**2))


def _velocity(t, q, p, eta):
    return _push_numpy(t) * p / np.sqrt(1 + p**2)


def _smooth(t, q, args):
    return (1 + jnp.cos(t) / 2) * (q[0] - q[1]) ** 2


def _smooth_force(t, q, p):
    return (1 + np.cos(t) / 2) * 2 * (q[0] - q[1]) * np.array([-1, 1])


def _mixed(t, q, p, args):
    return (1 + q @ q) * (1 + p @ p) / 2 + _push(t) * q[0] * p[1]


def _mixed_velocity(t, q, p, eta):
    return (1 + q @ q) * p + _push_numpy(t) * np.array([0, q[0]])


def _mixed_force(t, q, p):
    return -(1 + p @ p) * q - _push_numpy(t) * np.array([p[1], 0])


_BODIES = np.array([[1.0], [1.5]])

JUMPING = [
    System(
        *("jumping force", mechanical(dps.QuadraticKinetic(MASS), _potential)),
        *(_force(1), TWO, MASS),
        jumps=True,
    ),
    System(
        "bodies, jumping force",
        mechanical(dps.QuadraticKinetic(_BODIES), _potential),
        *(_force(2), PLANE, np.diag([1.0, 1.0, 1.5, 1.5])),
        bodies=True,
        jumps=True,
    ),
    System(
        *("any T that jumps", mechanical(_kinetic, _smooth), _smooth_force, TWO, None),
        velocity=_velocity,
        offers=SPLIT,
        takes="velocities",
        jumps=True,
    ),
    System(
        *("jumping energy", energy(_mixed), _mixed_force, TWO, None, _mixed_velocity),
        offers=frozenset(),
        takes="rates",
        jumps=True,
    ),
]
