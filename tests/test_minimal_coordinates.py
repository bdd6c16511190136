"""Constrained systems beside the same in coordinates that need no constraint."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
from on_manifolds import bobs, by_scipy, end_as_vector as end, links

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
G = 9.81


def test_spherical_pendulum_beside_its_angles():
    gamma = 0.3
    free = dps.MechanicalSystem(
        *(dps.QuadraticKinetic(2.0), lambda t, q, args: 2 * G * q[2]),
        dps.ConstantDamping(gamma),
    )
    system = dps.ConstrainedSystem(free, lambda t, q, args: q @ q - 1)

    def field(t, y):  # from the lowest point, and around
        theta, _, dtheta, dphi = y
        s, c = np.sin(theta), np.cos(theta)
        return np.array(
            [
                *(dtheta, dphi, s * c * dphi**2 - G * s - gamma * dtheta),
                -2 * c / s * dtheta * dphi - gamma * dphi,
            ]
        )

    def cartesian(y):
        (s, t), (c, d), (dtheta, dphi) = np.sin(y[:2]), np.cos(y[:2]), y[2:]
        q = np.array([s * d, s * t, -c])
        v = dtheta * np.array([c * d, c * t, s]) + dphi * np.array([-s * t, s * d, 0])
        return np.concatenate([q, 2 * v])

    first = np.array([1.2, 0.3, 0.4, 1.5])
    y0 = tuple(map(jnp.asarray, np.split(cartesian(first), 2)))
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, 3.0, 150)
    np.testing.assert_allclose(y, cartesian(by_scipy(field, first, 3.0)), atol=1e-11)


def test_bead_on_a_turning_wire():
    omega = 1.3
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0.0 * q[0])
    wire = lambda t, q, args: jnp.cos(omega * t) * q[1] - jnp.sin(omega * t) * q[0]
    system = dps.ConstrainedSystem(free, wire)
    y0 = jnp.array([0.5, 0.0]), jnp.array([0.0, 0.5 * omega])
    t = 2.0
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, t, 40)
    r, dr = 0.5 * np.cosh(omega * t), 0.5 * omega * np.sinh(omega * t)
    along = np.array([np.cos(omega * t), np.sin(omega * t)])
    across = omega * np.array([-along[1], along[0]])
    wanted = np.concatenate([r * along, dr * along + r * across])
    np.testing.assert_allclose(y, wanted, atol=1e-10)
    assert system.violation(t, *map(jnp.asarray, np.split(y, 2))) < 5e-15


def test_double_pendulum_beside_its_angles():
    free = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: G * jnp.sum(q[:, 1])
    )
    system = dps.ConstrainedSystem(free, links)

    def field(t, y):
        a, b, da, db = y
        s, c = np.sin(a - b), np.cos(a - b)
        force = [-s * db**2 - 2 * G * np.sin(a), s * da**2 - G * np.sin(b)]
        return np.array([da, db, *np.linalg.solve([[2, c], [c, 1]], force)])

    first = np.array([2.0, 2.5])
    y0 = bobs(first), jnp.zeros((2, 2))
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, 1.5, 200)
    angles = by_scipy(field, np.array([*first, 0, 0]), 1.5)[:2]
    np.testing.assert_allclose(y[:4], np.ravel(bobs(angles)), atol=1e-10)
