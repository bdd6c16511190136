"""Hamiltonians agree with their formulas: derivatives, momenta, vector fields."""

from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, drift, henon_heiles, mixed_energy

import diffrax_presym as dps


T, Q, P = jnp.array(1.3), jnp.array([0.3, -0.7]), jnp.array([0.9, 0.4])
MASS = jnp.array([[2.0, 0.3], [0.3, 1.0]])
ARGS = jnp.array(1.7)


def potential(t, q, args):
    return args * (1 + jnp.sin(t) / 4) * henon_heiles(t, q, None)


def kinetic(t, p, args):
    return args * jnp.sum(p**4) / 4 + jnp.cos(t) * p[0] * p[1]


def energy(t, q, p, args):
    return args * (1 + jnp.sin(t) / 4) * mixed_energy(t, q, p, None)


def canonical_kinetic(t, q, P, args):
    return args * (1 + q[0] ** 2) * jnp.sum(P**2) / 2 + jnp.sin(t) * q[1] * P[0]


def eta1(t):
    return jnp.log(t + 0.5)


LOG, CONSTANT = dps.LogDamping(3.0, shift=0.5), dps.ConstantDamping(0.7)
QUADRATIC, RELATIVISTIC = dps.QuadraticKinetic(MASS), dps.RelativisticKinetic(1.5, 2.0)


# Hamiltonian, and H(t, q, P) as in the paper.


def quadratic(P):
    return P @ jnp.linalg.solve(MASS, P) / 2


def relativistic(P):
    return 2.0 * jnp.sqrt(P @ P + 3.0**2)


def conformal(T, eta):
    """Equation (new_ham_time)."""
    return lambda t, q, P: (
        jnp.exp(eta(t)) * (T(t, jnp.exp(-eta(t)) * P) + potential(t, q, ARGS))
    )


def dissipative(T, eta1, eta2):
    """Equation (gen_ham)."""
    return lambda t, q, P: (
        jnp.exp(-eta1(t)) * T(t, q, P) + jnp.exp(eta2(t)) * potential(t, q, ARGS)
    )


def log(t):
    return 3 * jnp.log(t + 0.5)


def constant(t):
    return 0.7 * t


def dissipative_energy(t, q, p, args):
    kinetic = canonical_kinetic(t, q, jnp.exp(constant(t)) * p, args)
    return jnp.exp(-log(t) - constant(t)) * kinetic + potential(t, q, args)


HAMILTONIANS = {
    "separable, quadratic T": (
        dps.MechanicalSystem(QUADRATIC, potential),
        lambda t, q, P: quadratic(P) + potential(t, q, ARGS),
    ),
    "nonseparable": (dps.Hamiltonian(energy), lambda t, q, P: energy(t, q, P, ARGS)),
    "conformal, quadratic T": (
        dps.MechanicalSystem(QUADRATIC, potential, LOG),
        conformal(lambda t, p: quadratic(p), log),
    ),
    "conformal, relativistic T": (
        dps.MechanicalSystem(RELATIVISTIC, potential, CONSTANT),
        conformal(lambda t, p: relativistic(p), constant),
    ),
    "conformal, any T": (
        dps.MechanicalSystem(kinetic, potential, eta1),
        conformal(lambda t, p: kinetic(t, p, ARGS), eta1),
    ),
    "conformal, nonseparable": (
        dps.Hamiltonian(energy, LOG),
        lambda t, q, P: jnp.exp(log(t)) * energy(t, q, jnp.exp(-log(t)) * P, ARGS),
    ),
    "dissipative, quadratic T": (
        dps.DissipativeHamiltonian(QUADRATIC, potential, eta1, LOG),
        dissipative(lambda t, q, P: quadratic(P), eta1, log),
    ),
    "dissipative, relativistic T": (
        dps.DissipativeHamiltonian(RELATIVISTIC, potential, eta1, CONSTANT),
        dissipative(lambda t, q, P: relativistic(P), eta1, constant),
    ),
    "dissipative, any T": (
        dps.DissipativeHamiltonian(kinetic, potential, LOG, CONSTANT),
        dissipative(lambda t, q, P: kinetic(t, P, ARGS), log, constant),
    ),
    "dissipative, nonseparable": (
        dps.Hamiltonian(dissipative_energy, CONSTANT),
        dissipative(lambda t, q, P: canonical_kinetic(t, q, P, ARGS), log, constant),
    ),
}
each = pytest.mark.parametrize(
    "hamiltonian, H", HAMILTONIANS.values(), ids=HAMILTONIANS
)


@each
def test_canonical_is_the_hamiltonian_of_the_paper(hamiltonian, H):
    canonical = hamiltonian.to_canonical(T, P)
    scale = jnp.exp(hamiltonian.log_scale(T))
    assert_close(canonical, scale * P, 1e-15)
    assert_close(hamiltonian.from_canonical(T, canonical), P, 1e-15)
    value = H(T, Q, canonical)
    assert_close(hamiltonian.canonical(T, Q, P, ARGS), value, 1e-14)
    assert_close(scale * hamiltonian.energy(T, Q, P, ARGS), value, 1e-14)


@each
def test_vector_field_is_hamilton_s_equations(hamiltonian, H):
    canonical = hamiltonian.to_canonical(T, P)
    dq, dP = jax.grad(H, 2)(T, Q, canonical), -jax.grad(H, 1)(T, Q, canonical)
    # Including the time dependence of the momentum transformation.
    _, dp = jax.jvp(hamiltonian.from_canonical, (T, canonical), (jnp.ones_like(T), dP))
    field = hamiltonian.vf(T, (Q, P), ARGS)
    assert_close(field, (dq, dp), 1e-13)


# Damping laws.

# Law, and eta(t) to fifty digits
LAWS = {
    "constant": (CONSTANT, lambda t: Decimal("0.7") * t),
    "negative": (dps.ConstantDamping(-0.7), lambda t: Decimal("-0.7") * t),
    "logarithmic": (dps.LogDamping(3.0), lambda t: 3 * t.ln()),
    "shifted": (LOG, lambda t: 3 * (t + Decimal("0.5")).ln()),
}
laws = pytest.mark.parametrize("law, eta", LAWS.values(), ids=LAWS)


@laws
@pytest.mark.parametrize("h", [0.25, -0.25, 2.0**-10])
@pytest.mark.parametrize(
    "dtype, tolerance", [(jnp.float32, 1e-6), (jnp.float64, 1e-14)]
)
def test_increments_are_exact_at_late_times(law, eta, h, dtype, tolerance):
    # In `float32` a difference of two values of eta would have no correct digit.
    t, h = jnp.array(1e4, dtype), jnp.array(h, dtype)
    increment = law.increment(t, h)
    assert increment.dtype == dtype
    t, h = Decimal(float(t)), Decimal(float(h))
    with localcontext() as context:
        context.prec = 50
        expected = float(eta(t + h) - eta(t))
    np.testing.assert_allclose(increment, expected, tolerance)


@pytest.mark.variants(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_relativistic_drift_through_friction_that_stops_it(dtype):
    p = jnp.array([0.3, -0.4], dtype)

    def moved(gamma):
        damping = dps.ConstantDamping(gamma)
        system = dps.MechanicalSystem(RELATIVISTIC, potential, damping)
        start = jnp.zeros((), dtype)
        q, _ = drift(system, start, jnp.ones((), dtype), jnp.zeros_like(p), p)
        return q

    # The momentum decays before the first quadrature node.
    gamma = jnp.array(1e4, dtype)
    np.testing.assert_allclose(moved(gamma), 0.0, atol=1e-15)
    np.testing.assert_allclose(jax.jacrev(moved)(gamma), 0.0, atol=1e-15)
    # Against the closed form, if there are enough nodes.
    mass, speed = float(RELATIVISTIC.mass), float(RELATIVISTIC.speed)
    sizes = 0.5 * np.array([1, np.exp(-0.5)]) / (mass * speed)
    travelled = speed / 0.5 * -np.diff(np.arcsinh(sizes))
    exact = travelled * np.asarray(p) / 0.5
    gamma = jnp.array(0.5, dtype)
    np.testing.assert_allclose(moved(gamma), exact, rtol=1e-6)
