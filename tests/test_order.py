"""Every scheme converges to the exact solution with the claimed order."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special
from helpers import few, harmonic, reference, Scheme, SCHEMES, trajectory

import diffrax_presym as dps


# Ratios of less than two, as a scheme of order 8 soon reaches rounding errors.
STEPS = [*range(2, 11), *(n * 2**k for k in range(6) for n in (12, 14, 16, 20))]


def measured_order(error, plateau):
    """The slope over the three smallest steps with errors above rounding."""
    steps, errors = [], []
    for n in STEPS:
        size = error(n)
        if size < plateau:
            break
        steps.append(n)
        errors.append(size)
    assert len(steps) >= 3
    return -np.polyfit(np.log(steps[-3:]), np.log(errors[-3:]), 1)[0]


# The two oscillators of the paper, with known solutions. Errors are the largest errors
# of the canonical Hamiltonian over all steps.


def damped(t, gamma=0.2, q0=10):
    """Equation (sol_const), with the canonical momentum."""
    omega = np.sqrt(4 - gamma**2)
    cos, sin = np.cos(omega * t / 2), np.sin(omega * t / 2)
    q = q0 * np.exp(-t * gamma / 2) * (cos + gamma / omega * sin)
    return q, -2 * q0 / omega * np.exp(t * gamma / 2) * sin


def decaying(t, gamma=3, q0=1):
    """Equation (sol_dec), with the canonical momentum."""
    J, Y = scipy.special.jv, scipy.special.yv
    minus, plus, s = (gamma - 1) / 2, (gamma + 1) / 2, t + 1
    q = s**-minus * (J(plus, 1) * Y(minus, s) - Y(plus, 1) * J(minus, s))
    P = s**plus * (Y(plus, 1) * J(plus, s) - J(plus, 1) * Y(plus, s))
    return q0 * np.pi / 2 * q, q0 * np.pi / 2 * P


# Exact solution, eta(t), damping, q(0), level of rounding errors in float64
OSCILLATORS = {
    "damped": (damped, lambda t: 0.2 * t, dps.ConstantDamping(0.2), 10.0, 3e-12),
    "decaying": (
        decaying,
        lambda t: 3 * np.log(t + 1),
        dps.LogDamping(3.0, shift=1.0),
        1.0,
        1e-13,
    ),
}


def oscillator_error(oscillator: str, scheme: Scheme, h):
    exact, eta, damping, q0, _ = OSCILLATORS[oscillator]
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, damping)
    y0 = (jnp.array([q0]), jnp.array([0.0]))

    def canonical(t, q, P):
        return np.exp(-eta(t)) * P**2 / 2 + np.exp(eta(t)) * q**2 / 2

    t, q, p = trajectory(system, scheme.solver, 0.0, 10.0, h, y0)
    numerical = canonical(t, q[:, 0], np.exp(eta(t)) * p[:, 0])
    return np.max(np.abs(numerical - canonical(t, *exact(t))))


@few(OSCILLATORS, [s for s in SCHEMES if s.name in reference("damped")])
def test_oscillator_errors_are_those_of_the_reference(scheme: Scheme, case):
    expected = np.array(reference(case)[scheme.name])
    steps = reference(case)["h"]
    errors = [oscillator_error(case, scheme, h) for h in steps]
    rounding = OSCILLATORS[case][-1]
    np.testing.assert_allclose(errors, expected, rtol=5e-4, atol=5 * rounding)


@few(OSCILLATORS, SCHEMES)
def test_order_on_oscillators(scheme: Scheme, case):
    # At least eight steps per period.
    error = lambda n: oscillator_error(case, scheme, 10 / (4 * n))
    order = measured_order(error, 10 * OSCILLATORS[case][-1])
    assert abs(order - scheme.order) < 0.15


def test_yoshida_by_its_name():
    assert eqx.tree_equal(dps.PresymplecticYoshida4(), dps.SuzukiYoshida(4))
    with pytest.raises(ValueError, match="symmetric"):
        dps.PresymplecticYoshida4(dps.PresymplecticEuler())
