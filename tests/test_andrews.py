"""Andrews' squeezing mechanism: seven joined bodies in the plane, a spring and a
torque, beside its published solution.

The mechanism and its data: E. Hairer and G. Wanner, Solving Ordinary Differential
Equations II, section VII.7; the solution: problem `andrews` of F. Mazzia and C.
Magherini, Test Set for Initial Value Problem Solvers, release 2.4, 2008. There seven
angles are the coordinates, with a mass matrix that depends on them and six constraints.
Here the coordinates are the centre of mass and the angle of each body: the mass is
constant, and ten joints are twenty constraints.
"""

from functools import cache
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
T1 = 0.03
MASS = np.array([0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498])
INERTIA = 1e-7 * np.array([21.94, 4.41, 52.55, 5.667, 116.9, 5.667, 191.2])
WEIGHTS = np.stack([MASS, MASS, INERTIA], axis=1)
A, B, C = np.array([[-69.34, -2.27], [-36.35, 32.73], [14, 72]]) / 1000
FIXED = np.stack([0 * A, B, A, A])  # first joints of every second body
# Of each body, along the direction of its angle and across it from the first joint: the
# second joint and the centre of mass; and of the third, the end of the spring.
JOINT = np.array([[7, 0], [-28, 0], [0, -35], [0, -20], [40, 0], [20, 0], [0, -40]])
JOINT = JOINT / 1000
CENTRE = np.array([[0.92, 0], [-11.5, 0], [10.43, -18.74], [0, -5.79], [23.08, 9.16]])
CENTRE = np.concatenate([CENTRE, [[5.79, 0], [4.49, -12.28]]]) / 1000
SPRING = np.tile([0.02, -0.018], (7, 1))

# beta, Theta, gamma, Phi, delta, Omega, epsilon: at t = 0 and T1, and the rates at T1.
ANGLES = np.array(
    [
        [-0.0617138900142764496, 15.81077119629904, 1139.920302151208],
        [0.0, -15.75637105984298, -1424.379294994111],
        [0.4552798191630703803, 0.04082224013073101, 11.03291221937134],
        [0.2226683901658858847, -0.5347301163226948, 19.29337464421385],
        [0.4873649795438425502, 0.5244099658805304, 0.5735699284790808],
        [-0.2226683901658858847, 0.5347301163226948, -19.29337464421385],
        [1.2305474445498211925, 1.048080741042263, 0.3231791658026955],
    ]
)
ANGLES[1::2] += ANGLES[[0, 4, 6]]  # published relative to the body next to it
START, END, RATES = ANGLES.T


def turned(angles, points):
    (x, y), (c, s) = points.T, (jnp.cos(angles), jnp.sin(angles))
    return jnp.stack([c * x - s * y, s * x + c * y], axis=1)


def joints(t, q, args):
    place = lambda points: q[:, :2] + turned(q[:, 2], points - CENTRE)
    first, second = place(0 * JOINT), place(JOINT)
    fixed = first[::2] - FIXED
    pairs = second[jnp.array([0, 4, 6])] - first[1::2]
    common = second[jnp.array([2, 3, 5])] - second[1:2]
    return jnp.concatenate([fixed, pairs, common])


def potential(t, q, args):
    end = q[:, :2] + turned(q[:, 2], SPRING - CENTRE)
    length = jnp.linalg.norm(end[2] - C)
    return 4530.0 * (length - 0.07785) ** 2 / 2 - 0.033 * q[0, 2]


FREE = dps.MechanicalSystem(dps.QuadraticKinetic(WEIGHTS), potential)
SYSTEM = dps.ConstrainedSystem(FREE, joints)


def bodies(angles):
    """The positions for which only the joints between second ends are open."""
    ends = turned(angles, JOINT)
    first = jnp.asarray(FIXED[[0, 0, 1, 2, 2, 3, 3]])
    first = first.at[1::2].add(ends[jnp.array([0, 4, 6])])
    return jnp.concatenate([first + turned(angles, CENTRE), angles[:, None]], axis=1)


@jax.jit
def accelerations(angles, v):
    """Of the angles, and the multipliers, from the equations in angles."""
    open_joints = lambda angles: jnp.ravel(joints(0.0, bodies(angles), None)[-3:])
    rate = lambda f: lambda angles: jax.jvp(f, (angles,), (v,))[1]
    J, G = jax.jacfwd(bodies)(angles), jax.jacfwd(open_joints)(angles)
    force = -jax.grad(potential, 1)(0.0, bodies(angles), None)
    force = force - WEIGHTS * rate(rate(bodies))(angles)
    M = jnp.einsum("ijk,ij,ijl->kl", J, WEIGHTS, J)
    matrix = jnp.block([[M, G.T], [G, jnp.zeros((6, 6))]])
    both = [jnp.einsum("ijk,ij->k", J, force), -rate(rate(open_joints))(angles)]
    return jnp.linalg.solve(matrix, jnp.concatenate(both))


@cache
def exact():
    field = lambda t, y: np.concatenate([y[7:], accelerations(y[:7], y[7:])[:7]])
    y0 = np.concatenate([START, np.zeros(7)])
    options: Any = {"rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(field, (0, T1), y0, "DOP853", **options).y[:, -1]


def test_the_equations_are_the_published_ones():
    # Accelerations of the first angles, and multipliers, of the other sign.
    first = [14222.4439199541, 14222.4439199541 - 10666.8329399656, *np.zeros(5)]
    first += [-98.5668703962410, 6.12268834425567, *np.zeros(4)]
    found = accelerations(START, np.zeros(7))
    np.testing.assert_allclose(found, first, rtol=1e-11, atol=1e-8)
    # The published solution is off by 1.1e-9, as shorter steps here and there agree.
    np.testing.assert_allclose(exact()[:7], END, atol=2e-9)
    np.testing.assert_allclose(exact()[7:], RATES, atol=1e-6)


SOLVERS = [
    (dps.Strang(), 2, 2000, 1e-4),
    (dps.Suzuki4(dps.Strang()), 4, 1000, 6e-9),
    pytest.param(dps.BlanesMoan4(), 4, 1000, 1e-10, marks=pytest.mark.slow),
    pytest.param(
        dps.SofroniouSpaletta(6, dps.Strang()), 6, 400, 5e-11, marks=pytest.mark.slow
    ),
]


@pytest.mark.parametrize("solver, order, steps, most", SOLVERS)
def test_order(solver, order, steps, most):
    y0 = bodies(START), jnp.zeros((7, 3))
    assert SYSTEM.violation(0.0, *y0) < 1e-15

    @jax.jit
    def solve(dt0):
        ys = diffeqsolve(
            *(SYSTEM, solver, 0.0, T1, dt0, y0),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        ).ys
        return jax.tree.map(lambda y: y[-1], ys)

    errors = []
    for n in (steps // 2, steps):
        q, p = solve(T1 / n)
        state = np.concatenate([q[:, 2], 1e-3 * p[:, 2] / INERTIA])
        wanted = exact() * np.repeat([1, 1e-3], 7)
        errors.append(np.max(np.abs(state - wanted)))
        assert SYSTEM.violation(T1, q, p) < 1e-14
    assert errors[-1] < most
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), order, atol=0.2)
