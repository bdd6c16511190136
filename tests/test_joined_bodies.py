# pyright: reportArgumentType=false
"""Rigid bodies joined by ball joints: beside SciPy on a plane pendulum in angles."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
G, RATE, HALF = 9.81, 0.2, 0.5  # gravity, friction, the centres below the upper joints
DRY = 0.8  # largest torque of friction between the bodies
MASS = np.array([1.0, 0.7])
INERTIA = np.array([[0.3, 0.5, 0.2], [0.2, 0.4, 0.1]])


def joints(t, q, args):
    """The upper end of the first body is at the origin, that of the second at the
    lower end of the first."""
    arms = HALF * dps.rotation_matrix(q[1])[..., 2]
    upper, lower = q[0] + arms, q[0] - arms
    return jnp.concatenate([upper[0], upper[1] - lower[0]])


DAMPING = dps.ConstantDamping(RATE)


def dry(t, q, v, args):
    """Smoothed dry friction of the second joint: a torque between the bodies."""
    turn, omega = dps.rotation_matrix(q[1]), v[1]
    spin = jnp.einsum("nij,nj->ni", turn, omega)
    between = DRY * jnp.tanh(2 * (spin[0] - spin[1]))
    torque = jnp.einsum("nji,nj->ni", turn, jnp.stack([-between, between]))
    return jnp.zeros_like(v[0]), torque


def pendulum(friction=DAMPING, force=None):
    weight = lambda t, q, args: G * jnp.sum(MASS * q[0][:, 2])
    bodies = dps.Euclidean(MASS[:, None]), dps.Attitude(INERTIA)
    free = dps.ManifoldSystem(bodies, weight, friction, force=force)
    return dps.ConstrainedSystem(free, joints)


def in_plane(angles, speeds):
    """The state in which the bodies turn about the second axis."""
    zero, axis = np.zeros(2), np.array([0.0, 1.0, 0.0])
    turn = [np.cos(angles / 2), zero, np.sin(angles / 2), zero]
    arms = -HALF * np.stack([np.sin(angles), zero, np.cos(angles)], axis=-1)
    x = np.stack([arms[0], 2 * arms[0] + arms[1]])
    rims = [np.cross(w * axis, arm) for w, arm in zip(speeds, arms, strict=True)]
    v = np.stack([rims[0], 2 * rims[0] + rims[1]])
    spin = INERTIA * speeds[:, None] * axis
    return (jnp.array(x), jnp.stack(turn, axis=-1)), (MASS[:, None] * v, spin)


START = np.array([1.0, 0.3, 0.5, -1.0])


def field(t, y, dry=0.0):
    angles, speeds = y[:2], y[2:]
    (m, n), (a, b), c = MASS, INERTIA[:, 1], HALF
    both, apart = 2 * n * c**2, angles[0] - angles[1]
    M = np.diag([a + (m + 4 * n) * c**2, b + n * c**2])
    M[0, 1] = M[1, 0] = both * np.cos(apart)
    turning = both * np.sin(apart) * speeds[::-1] ** 2 * np.array([-1, 1])
    weights = G * c * np.array([m + 2 * n, n]) * np.sin(angles)
    joint = dry * np.tanh(2 * (speeds[0] - speeds[1])) * np.array([-1, 1])
    # Friction at a rate, of the momenta of the angles.
    forces = turning - weights + joint
    return np.concatenate([speeds, np.linalg.solve(M, forces) - RATE * speeds])


SOLVERS = [
    (None, dps.Strang(), 2, 0.05),
    (None, dps.Suzuki4(dps.Strang()), 4, 0.1),
    pytest.param(None, dps.BlanesMoan4(), 4, 0.1, marks=pytest.mark.slow),
    (dry, dps.Strang(), 2, 0.05),
    pytest.param(dry, dps.Suzuki4(dps.Strang()), 4, 0.1, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("force, solver, order, dt0", SOLVERS)
def test_order(force, solver, order, dt0):
    system, y0 = pendulum(force=force), in_plane(START[:2], START[2:])
    assert system.violation(0.0, *y0) < 1e-15
    options: Any = {"rtol": 1e-12, "atol": 1e-12}
    rates = lambda t, y: field(t, y, DRY if force else 0.0)
    y1 = scipy.integrate.solve_ivp(rates, (0, 2), START, "DOP853", **options).y[:, -1]
    exact = in_plane(y1[:2], y1[2:])

    @jax.jit
    def error(dt0):
        y = diffeqsolve(
            *(system, solver, 0.0, 2.0, dt0, y0),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        ).ys
        y = jax.tree.map(lambda x: x[-1], y)
        errors = jax.tree.map(lambda x, y: jnp.max(jnp.abs(x - y)), y, exact)
        return max_of(errors), system.violation(2.0, *y)

    max_of = lambda x: jnp.max(jnp.stack(jax.tree.leaves(x)))
    errors, off = np.array([error(dt0 / 2**k) for k in range(3)]).T
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders[-1], order, atol=0.2)
    assert np.max(off) < 1e-14


def test_friction_by_a_function_of_time():
    y0, ends = in_plane(START[:2], START[2:]), []
    for friction in (DAMPING, lambda t: RATE * t):
        ys = diffeqsolve(
            *(pendulum(friction), dps.Suzuki4(dps.Strang()), 0.0, 0.5, 0.1, y0),
            adjoint=dps.FixedStepAdjoint(),
        ).ys
        ends.append(jax.tree.leaves(ys))
    for x, y in zip(*ends, strict=True):
        np.testing.assert_allclose(y, x, atol=1e-14)


def in_space():
    """A start out of the plane."""
    system = pendulum()
    (x, q), (p, spin) = in_plane(START[:2], START[2:])
    moved = (x, q + 0.2 * np.eye(4)[[1, 1]]), (p + 0.3, spin + 0.2)
    return system, system.project(0.0, moved)


def test_a_step_is_undone():
    system, y0 = in_space()
    assert system.violation(0.0, *y0) < 1e-14
    solver = dps.Suzuki4(dps.Strang())

    @jax.jit
    def step(t0, t1, y, carry):
        return solver.step(system, t0, t1, y, None, carry, False)

    y1, _, _, carry, _ = step(0.0, 0.1, y0, solver.init(system, 0.0, 0.1, y0, None))
    y2, *_ = step(0.1, 0.0, y1, carry)
    assert jnp.max(jnp.abs(y1[0][1] - y0[0][1])) > 0.01
    for x, y in zip(jax.tree.leaves(y0), jax.tree.leaves(y2), strict=True):
        np.testing.assert_allclose(y, x, atol=1e-14)


@pytest.mark.slow  # It takes a minute to compile.
def test_gradient():
    system, y0 = in_space()

    @jax.jit
    def loss(x):
        (q, a), (p, spin) = y0
        start = system.project(0.0, ((q, a), (x[0] * p, spin)))
        ys = diffeqsolve(
            *(pendulum(dps.ConstantDamping(x[1])), dps.Strang(), 0.0, 1.0, 0.1, start),
            saveat=dfx.SaveAt(ts=jnp.array([0.33, 1.0])),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        ).ys
        return sum(jnp.sum(y**3 + y) for y in jax.tree.leaves(ys))

    x, h = jnp.array([1.1, 0.9]), 1e-5
    wanted = [(loss(x + h * e) - loss(x - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.grad(loss)(x), wanted, rtol=1e-8, atol=1e-8)


def test_other_systems_are_refused():
    system = dps.Hamiltonian(lambda t, q, p, args: jnp.sum(p**2) / 2)
    with pytest.raises(ValueError, match="or a `ManifoldSystem`, but got Hamiltonian"):
        dps.ConstrainedSystem(system, joints)


@pytest.mark.parametrize("law", ["place", "drag"])
def test_power_lost_is_that_of_the_bodies_alone(law):
    """Of angular velocities, not of the rates of change of quaternions."""
    rates = lambda t, q, args: (jnp.array(0.3), jnp.array(0.2))
    friction = dps.Drag(0.3) if law == "drag" else dps.ViscousDamping(rates)
    system = pendulum(friction)
    y = in_plane(np.array([0.4, -0.3]), np.array([0.7, 1.1]))
    v = np.asarray(y[1][0]) / MASS[:, None], np.asarray(y[1][1]) / INERTIA
    if law == "drag":
        wanted = 0.3 * sum(np.sum(np.linalg.norm(x, axis=-1) ** 3) for x in v)
    else:
        wanted = 0.3 * np.sum(v[0] ** 2) + 0.2 * np.sum(v[1] ** 2)
    many = jax.tree.map(lambda x: jnp.asarray(x)[None], y)
    for each in (system, system.system):
        (found,) = dps.diagnostics.power_lost(each, jnp.zeros(1), many)
        assert found == pytest.approx(wanted, rel=1e-13)
