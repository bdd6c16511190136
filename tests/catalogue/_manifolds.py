"""Systems whose states are on manifolds. Initial states are projected by them."""

import jax.numpy as jnp
import numpy as np
import scipy.spatial

import diffrax_presym as dps

from ._system import ANY, constrained, manifold, mechanical, NYSTROM, System


def _reaction(slopes, inverse, change, force):
    """The force and that of constraints with some slopes, by momenta, and the change of
    their rates without forces."""
    both = slopes @ inverse
    multipliers = np.linalg.solve(both @ slopes.T, both @ force + change)
    return force - slopes.T @ multipliers


def _rods(t, q, args):
    """Two rods, of which the first becomes longer."""
    square = lambda x: jnp.sum(x**2)
    return jnp.stack([square(q[0]) - t**3 / 10, square(q[1] - q[0])]) - 1


def _rods_potential(t, q, args):
    return (1 + jnp.cos(t) / 2) * (q[0, 1] + 3 * q[1, 1] / 2)


def _rods_force(t, q, p):
    return -(1 + np.cos(t) / 2) * np.array([0, 1, 0, 1.5])


def _rods_react(t, q, p, force):
    inverse = np.linalg.inv(_MASSES)
    (a, b), (u, v) = q.reshape(2, 2), (inverse @ p).reshape(2, 2)
    slopes = 2 * np.array([[*a, 0, 0], [*(a - b), *(b - a)]])
    change = np.array([2 * u @ u - 0.6 * t, 2 * (v - u) @ (v - u)])
    return _reaction(slopes, inverse, change, force)


def _upright(q):
    """The vertical, along the axes of a body."""
    w, x, y, z = q
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)])


def _top(t, q, args):
    x, y, z = dps.rotation_matrix(q)[2]
    return (1 + jnp.sin(t) / 5) * (z + 0.4 * x * y)


def _top_velocity(t, q, p, eta):
    (w, *u), v = q, p / _INERTIA / 2
    return np.concatenate([[-np.dot(u, v)], w * v + np.cross(u, v)])


def _top_force(t, q, p):
    u = _upright(q)
    slope = (1 + np.sin(t) / 5) * np.array([0.4 * u[1], 0.4 * u[0], 1])
    return np.cross(p, p / _INERTIA) + np.cross(u, slope)


def _joint(t, q, args):
    """Where a body hangs."""
    arm = jnp.asarray(_ARM, q[0].dtype)
    return q[0] + dps.rotation_matrix(q[1]) @ arm


def _hanging_potential(t, q, args):
    return (1 + jnp.cos(t) / 2) * (2 * q[0][2] + q[0][0] ** 2)


def _hanging_velocity(t, q, p, eta):
    return np.concatenate([p[:3] / 2, _top_velocity(t, q[3:], p[3:], eta)])


def _hanging_force(t, q, p):
    pull = -(1 + np.cos(t) / 2) * np.array([2 * q[0], 0, 2])
    return np.concatenate([pull, np.cross(p[3:], p[3:] / _INERTIA)])


def _hanging_react(t, q, p, force):
    last, omega = np.append(q[4:], q[3]), p[3:] / _INERTIA  # as SciPy has quaternions
    R = scipy.spatial.transform.Rotation.from_quat(last).as_matrix()
    turns = [R @ np.cross(e, _ARM) for e in np.eye(3)]
    slopes = np.concatenate([np.eye(3), np.stack(turns, axis=1)], axis=1)
    change = R @ np.cross(omega, np.cross(omega, _ARM))
    return _reaction(slopes, np.linalg.inv(_FLOATING), change, force)


def _form(t, q, args):
    return (1 + jnp.cos(t) / 2) * (q[0] ** 2 + q[1] * q[2] - q[2]) / 2


def _form_force(t, q, p):
    slope = np.array([2 * q[0], q[2], q[1] - 1])
    return -(1 + np.cos(t) / 2) * slope / 2


def _form_react(t, q, p, force):
    return force - (q @ force + p @ p) * q


_MASSES = np.diag([1.0, 1.0, 1.5, 1.5])
_INERTIA, _ARM = np.array([1.0, 1.5, 2.5]), np.array([0.3, -0.2, 0.5])
_FLOATING = np.diag([2.0, 2.0, 2.0, *_INERTIA])
_VECTOR, _SPIN = np.array([0.6, 0.3, -0.8]), np.array([0.3, -0.8, 0.6])
_TURNED = np.array([0.9, 0.3, -0.2, 0.1])
_FOLDED = np.array([[1.0, 0.3], [1.5, -0.6]]), np.array([[0.4, 0.5], [0.2, -0.4]])
_two_masses = dps.QuadraticKinetic(np.array([[1.0], [1.5]]))
_floating = manifold((dps.Euclidean(2.0), dps.Attitude(_INERTIA)), _hanging_potential)

MANIFOLDS = [
    System(
        *("rods", constrained(mechanical(_two_masses, _rods_potential), _rods)),
        *(_rods_force, _FOLDED, _MASSES),
        offers=ANY,
        bodies=True,
        constrained=True,
        react=_rods_react,
    ),
    System(
        *("rigid body", manifold(dps.Attitude(_INERTIA), _top)),
        *(_top_force, (_TURNED, _SPIN), np.diag(_INERTIA), _top_velocity),
        offers=NYSTROM,
        bodies=True,
        constrained=True,
    ),
    System(
        *("hanging body", constrained(_floating, _joint), _hanging_force),
        *(((-_ARM, _TURNED), (_SPIN, _SPIN)), _FLOATING, _hanging_velocity),
        offers=ANY,
        bodies=True,
        constrained=True,
        slow=True,
        react=_hanging_react,
    ),
    System(
        *("sphere", manifold(dps.Sphere(), _form), _form_force, (_VECTOR, _SPIN), None),
        velocity=lambda t, q, p, eta: p,
        offers=NYSTROM,
        takes="tangential",
        bodies=True,
        constrained=True,
        react=_form_react,
    ),
]
