"""The errors of the paper's schemes are those of an independent implementation. Orders
are tested by `test_pairs.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from helpers import harmonic, reference, trajectory

import diffrax_presym as dps


SCHEMES = {
    "euler_A": dps.PresymplecticEuler("momentum"),
    "euler_B": dps.PresymplecticEuler("position"),
    "leapfrog_AB": dps.PresymplecticLeapfrog("momentum"),
    "leapfrog_BA": dps.PresymplecticLeapfrog("position"),
    "suzuki_yoshida_4": dps.PresymplecticYoshida4(),
    "suzuki_yoshida_6": dps.SuzukiYoshida(6),
    "suzuki_yoshida_8": dps.SuzukiYoshida(8),
}

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
LOG = dps.LogDamping(3.0, shift=1.0)
OSCILLATORS = {
    "damped": (damped, lambda t: 0.2 * t, dps.ConstantDamping(0.2), 10.0, 3e-12),
    "decaying": (decaying, lambda t: 3 * np.log(t + 1), LOG, 1.0, 1e-13),
}


@pytest.mark.variants(4)
@pytest.mark.parametrize("case", OSCILLATORS)
@pytest.mark.parametrize("name", SCHEMES)
def test_oscillator_errors_are_those_of_the_reference(name, case):
    exact, eta, damping, q0, rounding = OSCILLATORS[case]
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, damping)
    y0 = (jnp.array([q0]), jnp.array([0.0]))

    def canonical(t, q, P):
        return np.exp(-eta(t)) * P**2 / 2 + np.exp(eta(t)) * q**2 / 2

    errors = []
    for h in reference(case)["h"]:
        t, q, p = trajectory(system, SCHEMES[name], 0.0, 10.0, h, y0)
        numerical = canonical(t, q[:, 0], np.exp(eta(t)) * p[:, 0])
        errors.append(np.max(np.abs(numerical - canonical(t, *exact(t)))))
    expected = np.array(reference(case)[name])
    np.testing.assert_allclose(errors, expected, rtol=5e-4, atol=5 * rounding)
