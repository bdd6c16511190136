"""Quadratic potentials and linear forces, and the schemes that exploit them."""

from fractions import Fraction
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import assert_close, pendulum, solve, step

import diffrax_presym as dps


RKN = [dps.BlanesMoanRKN4(), dps.BlanesMoanRKN6(), dps.BlanesCasasRKN8()]
each_rkn = pytest.mark.parametrize("solver", RKN, ids=lambda s: type(s).__name__)
Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.3, -0.7]))
MATRIX = jnp.array([[2.0, -1.0], [-1.0, 3.0]])


def end(*args):
    """The final state of a solve."""
    return jax.tree.map(lambda y: y[-1], solve(*args).ys)


def check_structure_and_symmetry(system, solver, t0, t1):
    t0, t1 = jnp.array(t0), jnp.array(t1)
    assert dps.diagnostics.structure_defect(system, solver, t0, t1, Y0) < 1e-13
    end = step(system, solver, t0, t1, Y0)[0]
    assert_close(step(system, solver, t1, t0, end)[0], Y0, 1e-14)


# Forms of the stiffness.


def diagonal(q):
    return jnp.array([2.0, 3.0]) * q


STIFFNESSES: dict[str, tuple[Any, Any]] = {
    "none": (None, lambda q: q),
    "number": (2.0, lambda q: 2 * q),
    "negative": (-1, lambda q: -q),
    "vector": (jnp.array([2.0, 3.0]), diagonal),
    "matrix": (MATRIX, lambda q: MATRIX @ q),
    "operator": (
        lx.MatrixLinearOperator(MATRIX, lx.symmetric_tag),
        lambda q: MATRIX @ q,
    ),
}


@pytest.mark.parametrize("stiffness, product", STIFFNESSES.values(), ids=STIFFNESSES)
def test_stiffnesses(stiffness, product):
    q, p = Y0
    potential = dps.QuadraticPotential(stiffness)
    system = dps.MechanicalSystem(dps.RelativisticKinetic(), potential)
    t = jnp.array(0.0)
    assert_close(potential(t, q), jnp.dot(q, product(q)) / 2, 1e-15)
    assert_close(system.force(t, q, p), -product(q), 1e-15)
    assert_close(jax.grad(potential, argnums=1)(t, q, None), product(q), 1e-15)


# Exchanged roles of positions and momenta.


def quartic(t, p, args):
    return jnp.sum(p**4) / 4 + (1 + jnp.sin(t) / 3) * jnp.sum(p**2) / 2


def swapped(damping, kinetic: Any = quartic):
    return dps.MechanicalSystem(kinetic, dps.QuadraticPotential(MATRIX), damping)


@each_rkn
def test_swapped_roles_keep_structure_and_symmetry(solver):
    check_structure_and_symmetry(swapped(dps.LogDamping(1.0)), solver, 1.0, 1.3)


def test_swapped_roles_from_the_start_of_friction_that_is_infinite_there():
    system = swapped(dps.LogDamping(3.0), dps.RelativisticKinetic())
    y0 = (Y0[0], jnp.zeros(2))
    rough, fine = (
        solve(system, dps.BlanesMoanRKN6(), 0.0, 2.0, h, y0).ys for h in (0.1, 0.05)
    )
    assert_close(rough, fine, 1e-9)


def test_refusal_names_the_quadratic_potential():
    system = dps.MechanicalSystem(dps.RelativisticKinetic(), pendulum, None)
    with pytest.raises(ValueError, match="`QuadraticPotential\\(stiffness\\)`"):
        solve(system, dps.BlanesMoanRKN6(), 0.0, 1.0, 0.1, Y0)


# Linear forces.

LINEAR = dps.TunedLinear8()


def _series(fractions, kick_first, degree):
    """A step of an oscillator as exact polynomials in step size times frequency."""
    one, zero = [Fraction(1)], [Fraction(0)]
    rows = [[one, zero], [zero, one]]
    for i, fraction in enumerate(fractions):
        kick = (i % 2 == 0) == kick_first
        to, source, sign = (1, 0, -1) if kick else (0, 1, 1)
        length = sign * Fraction(fraction)
        for column in (0, 1):
            moved = [Fraction(0), *(length * x for x in rows[source][column])]
            old = rows[to][column]
            size = max(len(old), len(moved))
            pad = lambda x, size=size: [*x, *[Fraction(0)] * (size - len(x))]
            rows[to][column] = [
                x + y for x, y in zip(pad(old), pad(moved), strict=True)
            ]
    return [[float(x) for x in entry[:degree]] for row in rows for entry in row]


def test_a_step_of_an_oscillator_is_its_rotation_to_eighth_order():
    tableau = LINEAR.tableau
    degree, factorial = 9, 1.0
    cos, sin = np.zeros(degree), np.zeros(degree)
    for k in range(degree):
        factorial *= max(k, 1)
        (cos, sin)[k % 2][k] = (-1) ** (k // 2) / factorial
    series = _series(tableau.fractions, tableau.kick_first, degree)
    for computed, exact in zip(series, (cos, sin, -sin, cos), strict=True):
        padded = [*computed, *[0.0] * (degree - len(computed))]
        assert np.max(np.abs(padded - exact)) < 1e-15


@pytest.mark.parametrize("gamma", [0.0, 0.5, 5.0, -0.1])
def test_long_steps_of_a_linear_system(gamma):
    # Frequencies up to the claimed limit for an error of 1e-9 per step.
    omega = jnp.linspace(0.1, 3.6, 50)
    damping = dps.ConstantDamping(gamma)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), dps.QuadraticPotential(omega**2), damping
    )
    y0 = jnp.ones(50), jnp.zeros(50)
    shifted = np.sqrt(np.asarray(omega, complex) ** 2 - gamma**2 / 4)
    steps = 4
    ys = end(system, LINEAR, 0.0, float(steps), 1.0, y0)
    decay, phase = np.exp(-gamma * steps / 2), shifted * steps
    q = decay * (np.cos(phase) + gamma / 2 / shifted * np.sin(phase)).real
    p = -decay * (np.asarray(omega) ** 2 / shifted * np.sin(phase)).real
    size = np.maximum(1, np.abs(q)) if gamma < 0 else np.max(np.abs(q))
    assert np.max(np.abs(ys[0] - q) / size) < steps * 4e-9
    assert np.max(np.abs(ys[1] - p) / size) < steps * 4e-9 * 3.6


MASSES: dict[str, Any] = {
    "number": 2.0,
    "vector": jnp.array([1.0, 3.0]),
    "matrix": jnp.array([[2.0, 0.5], [0.5, 1.0]]),
    "operator": lx.DiagonalLinearOperator(jnp.array([1.0, 3.0])),
}


@pytest.mark.parametrize("mass", MASSES.values(), ids=MASSES)
def test_masses_of_linear_systems(mass):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(mass),
        dps.QuadraticPotential(MATRIX),
        dps.ConstantDamping(0.8),
    )
    expected = solve(system, dfx.Dopri8(), 0.0, 6.0, 1e-2, Y0).ys
    assert_close(solve(system, LINEAR, 0.0, 6.0, 1.0, Y0).ys, expected, 1e-10)


def linear(damping):
    return dps.MechanicalSystem(
        dps.QuadraticKinetic(jnp.array([1.0, 3.0])),
        dps.QuadraticPotential(MATRIX),
        damping,
    )


@pytest.mark.parametrize(
    "damping", [None, dps.ConstantDamping(0.3)], ids=["none", "constant"]
)
def test_linear_steps_keep_structure_and_symmetry(damping):
    check_structure_and_symmetry(linear(damping), LINEAR, 1.0, 1.6)
