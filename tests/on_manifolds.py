"""Systems of rigid bodies, on spheres, of orthonormal matrices and of rods, and their
solutions by SciPy on the equations in rotation matrices or with multipliers."""

from functools import cache
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.spatial

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
rng = np.random.default_rng(0)
INERTIA = np.array([1.0, 1.5, 2.5])
DAMPERS = np.array([[0.3, 0.1, 0.0], [-0.1, 0.2, 0.0], [0.0, 0.1, 0.4]])
ARM = np.array([0.3, 0.4, 0.2])
Q = rng.standard_normal(4)
L = np.array([0.3, -0.8, 0.6])
FORM = np.diag([1.0, 2.0, 3.0, 5.0]) + 0.2
MATRIX = rng.standard_normal((4, 2))
SQUARE = rng.standard_normal((3, 3))
FIELD = np.array([[0, 1, 0, 0.5], [-1, 0, 0.2, 0], [0, -0.2, 0, 1], [-0.5, 0, -1, 0]])


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def matrix(q):
    """The rotation of a quaternion by SciPy, which has the real part last."""
    last = np.concatenate([q[1:], q[:1]])
    return scipy.spatial.transform.Rotation.from_quat(last).as_matrix()


def body_rates(R, p, slope, gamma):
    """Of the equations in matrices: with the derivative of the potential by them."""
    omega = p / INERTIA
    torque = [-np.sum(slope * (R @ hat(e))) for e in np.eye(3)]
    return R @ hat(omega), np.cross(p, omega) + torque - gamma @ p


def gravity(t):
    return 1 + 0.2 * np.sin(t)


def top_potential(t, q, args):
    return (1 + 0.2 * jnp.sin(t)) * dps.rotation_matrix(q)[2, 2]


def top_field(gamma, torque=lambda R, omega: 0.0):
    def field(t, y):
        R, p = y[:9].reshape(3, 3), y[9:]
        slope = np.zeros((3, 3))
        slope[2, 2] = gravity(t)
        rates = gamma(t) if callable(gamma) else gamma
        dR, dp = body_rates(R, p, slope, rates)
        return np.concatenate([np.ravel(dR), dp + torque(R, p / INERTIA)])

    return field


def tilt(t, q, args):
    """The coefficient of friction of a top that touches a fluid."""
    return 1 + dps.rotation_matrix(q)[2, 2]


def control(t, q, omega, args):
    """Turns the axis upright, by wheels of limited torque."""
    up = dps.rotation_matrix(q)[2]
    zero = jnp.zeros_like(up[0])
    return jnp.tanh(jnp.stack([up[1], -up[0], zero]) - omega**3)


def control_in_numpy(R, omega):
    return np.tanh([R[2, 1], -R[2, 0], 0] - omega**3)


def drag_at_the_arm(t, q, v, args):
    """Drag by the speed squared of a sail off the centre."""
    (_, attitude), (v, omega) = q, v
    R, arm = dps.rotation_matrix(attitude), ARM.astype(v.dtype)
    at = v + R @ jnp.cross(omega, arm)
    force = -jnp.linalg.norm(at) * at
    return force, jnp.cross(arm, R.T @ force)


def floating_potential(t, q, args):
    x, attitude = q
    return jnp.sum((x + dps.rotation_matrix(attitude) @ ARM.astype(x.dtype)) ** 2)


def floating_field(drag):
    def field(t, y):
        x, R, px, p = y[:3], y[3:12].reshape(3, 3), y[12:15], y[15:]
        tip = x + R @ ARM
        dR, dp = body_rates(R, p, 2 * np.outer(tip, ARM), 0.3 * np.eye(3))
        at = px / 2 + R @ np.cross(p / INERTIA, ARM)
        force = -drag * np.linalg.norm(at) * at
        dp += np.cross(ARM, R.T @ force)
        return np.concatenate([px / 2, np.ravel(dR), -2 * tip - 0.1 * px + force, dp])

    return field


def turned(p):
    """A magnetic force, and one that limits the speed."""
    return FIELD @ p - (1 + np.sum(p**2)) * p


def orthonormal(gamma, slope, shape, other=lambda q, p: 0.0):
    def field(t, y):
        q, p = (x.reshape(shape) for x in np.split(y, 2))
        force = other(q, p) - slope(q)
        both = q.T @ force
        tangential = force - q @ (both + both.T) / 2
        rates = p, tangential - gamma(t) * p - q @ (p.T @ p)
        return np.concatenate([np.ravel(x) for x in rates])

    return field


def form(t, q, args):
    return jnp.sum(q * (FORM @ q)) / 2


def trace(t, q, args):
    return jnp.sum(q * SQUARE)


class LogScale(eqx.Module):
    part: float = 1.0

    def __call__(self, t):
        return self.part * (0.5 * t + jnp.sin(t))


# The system, a state near one of it, and its equations in NumPy.
CASES = {
    "top": (
        dps.ManifoldSystem(
            dps.Attitude(INERTIA), top_potential, dps.ViscousDamping(DAMPERS)
        ),
        *((Q, L), top_field(DAMPERS / INERTIA)),
    ),
    "top, one rate": (
        dps.ManifoldSystem(
            dps.Attitude(INERTIA), top_potential, dps.ConstantDamping(0.3)
        ),
        *((Q, L), top_field(0.3 * np.eye(3))),
    ),
    "top, rate of time": (
        dps.ManifoldSystem(dps.Attitude(INERTIA), top_potential, LogScale()),
        *((Q, L), top_field(lambda t: (0.5 + np.cos(t)) * np.eye(3))),
    ),
    "floating body": (
        dps.ManifoldSystem(
            (dps.Euclidean(2.0), dps.Attitude(INERTIA)),
            *(floating_potential, dps.ConstantDamping((0.1, 0.3))),
        ),
        *(((np.ones(3), Q), (L, 2 * L)), floating_field(0.0)),
    ),
    "floating body, drag": (
        dps.ManifoldSystem(
            (dps.Euclidean(2.0), dps.Attitude(INERTIA)),
            *(floating_potential, dps.ConstantDamping((0.1, 0.3))),
            force=drag_at_the_arm,
        ),
        *(((np.ones(3), Q), (L, 2 * L)), floating_field(1.0)),
    ),
    "top, place": (
        dps.ManifoldSystem(
            dps.Attitude(INERTIA), top_potential, dps.ViscousDamping(tilt)
        ),
        *((Q, L), top_field(0.0 * DAMPERS, lambda R, w: -(1 + R[2, 2]) * w)),
    ),
    "top, matrix and place": (
        dps.ManifoldSystem(
            *(dps.Attitude(INERTIA), top_potential),
            [dps.ViscousDamping(DAMPERS), dps.ViscousDamping(tilt)],
        ),
        *((Q, L), top_field(DAMPERS / INERTIA, lambda R, w: -(1 + R[2, 2]) * w)),
    ),
    "top, rates of time": (
        dps.ManifoldSystem(
            *(dps.Attitude(INERTIA), top_potential),
            dps.LogDamping(np.arange(3.0), 1.0),
        ),
        *((Q, L), top_field(lambda t: np.diag(np.arange(3.0)) / (1 + t))),
    ),
    "top, drag": (
        dps.ManifoldSystem(dps.Attitude(INERTIA), top_potential, dps.Drag(0.4)),
        *((Q, L), top_field(0.0 * DAMPERS, lambda R, w: -0.4 * np.linalg.norm(w) * w)),
    ),
    "top, controlled": (
        dps.ManifoldSystem(
            *(dps.Attitude(INERTIA), top_potential, dps.ViscousDamping(DAMPERS)),
            force=control,
        ),
        *((Q, L), top_field(DAMPERS / INERTIA, control_in_numpy)),
    ),
    "sphere, place": (
        dps.ManifoldSystem(
            *(dps.Sphere(), form),
            dps.PositionDamping(lambda t, q, args: 0.3 + q[0] ** 2),
        ),
        (MATRIX[:, 0], MATRIX[:, 1]),
        orthonormal(
            *(lambda t: 0.3, lambda q: FORM @ q, (4, 1)),
            lambda q, p: -(q[0, 0] ** 2) * p,
        ),
    ),
    "Stiefel, force": (
        dps.ManifoldSystem(
            *(dps.Stiefel(), form, dps.ConstantDamping(0.2)),
            force=lambda t, q, v, args: FIELD @ v - (1 + jnp.sum(v**2)) * v,
        ),
        (MATRIX, MATRIX[::-1]),
        orthonormal(
            *(lambda t: 0.2, lambda q: FORM @ q, (4, 2)), lambda q, p: turned(p)
        ),
    ),
    "sphere": (
        dps.ManifoldSystem(dps.Sphere(), form, dps.LogDamping(3.0, 1.0)),
        (MATRIX[:, 0], MATRIX[:, 1]),
        orthonormal(lambda t: 3 / (1 + t), lambda q: FORM @ q, (4, 1)),
    ),
    "sphere, rate of time": (
        dps.ManifoldSystem(dps.Sphere(), form, LogScale()),
        (MATRIX[:, 0], MATRIX[:, 1]),
        orthonormal(lambda t: 0.5 + np.cos(t), lambda q: FORM @ q, (4, 1)),
    ),
    "Stiefel": (
        dps.ManifoldSystem(dps.Stiefel(), form, dps.ConstantDamping(0.2)),
        (MATRIX, MATRIX[::-1]),
        orthonormal(lambda t: 0.2, lambda q: FORM @ q, (4, 2)),
    ),
    "rotations": (
        dps.ManifoldSystem(dps.Stiefel(), trace, dps.ConstantDamping(0.2)),
        (np.eye(3) + 0.2 * SQUARE, SQUARE.T),
        orthonormal(lambda t: 0.2, lambda q: SQUARE, (3, 3)),
    ),
}
# Those whose kicks are by a force of the place alone.
DRIFTS = [
    *("top, one rate", "top, rate of time", "floating body", "rotations"),
    *("sphere", "sphere, rate of time", "Stiefel"),
]


def start(case):
    system, y0, _ = CASES[case]
    return system.project(0.0, jax.tree.map(jnp.asarray, y0))


def flat(case, y):
    """A state as the equations in NumPy have it: quaternions as matrices."""
    q, p = jax.tree.map(np.asarray, y)
    if "top" in case:
        q = matrix(q)
    if "floating body" in case:
        q = q[0], matrix(q[1])
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves((q, p))])


@cache
def exact(case):
    return by_scipy(CASES[case][2], flat(case, start(case)), 2.0)


def bobs(angles):
    """The places of the bobs of a chain of rods of length one."""
    rods = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    return jnp.asarray(np.cumsum(rods, axis=0))


def links(t, q, args):
    """The constraints of such a chain."""
    each = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0)
    return jnp.sum(each**2, axis=1) - 1


def by_scipy(field, y0, t1):
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(field, (0, t1), y0, **options).y[:, -1]


def end(system, solver, y0, t1, steps, **options):
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None} | options
    args = (system, solver, 0.0, t1, t1 / steps, y0)
    ys = jax.jit(lambda: diffeqsolve(*args, **options).ys)()
    return jax.tree.map(lambda y: y[-1], ys)


def end_as_vector(*args, **options):
    y = end(*args, **options)
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(y)])
