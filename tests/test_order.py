"""Every scheme converges to the exact solution with the claimed order."""

import functools

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special
from helpers import (
    ANY,
    each,
    few,
    flat,
    harmonic,
    IMPLICIT,
    pendulum,
    reference,
    Scheme,
    SCHEMES,
    solve,
    trajectory,
    WAYS,
)

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
    system = dps.ConformalHamiltonian(dps.QuadraticKinetic(), harmonic, damping)
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


def test_yoshida_is_the_first_of_the_suzuki_yoshida_family():
    assert dps.PresymplecticYoshida4().weights == dps.SuzukiYoshida(4).weights


@few(OSCILLATORS, SCHEMES)
def test_order_on_oscillators(scheme: Scheme, case):
    # At least eight steps per period.
    error = lambda n: oscillator_error(case, scheme, 10 / (4 * n))
    order = measured_order(error, 10 * OSCILLATORS[case][-1])
    assert abs(order - scheme.order) < 0.15


# Oscillators may super-converge, so the order is also measured on nonlinear systems.
# The reference is from SciPy, for Hamilton's equations in the canonical momentum, with
# hand-written derivatives.


def driven_potential(t, q, args):
    wave = 1 + jnp.cos(t) / 2
    return wave * jnp.sum(1 - jnp.cos(q)) + q[0] ** 2 * q[1] / 2


def driven_force(t, q):
    wave = 1 + np.cos(t) / 2
    return -wave * np.sin(q) - np.array([q[0] * q[1], q[0] ** 2 / 2])


def driven_kinetic(t, p, args):
    return (1 + jnp.sin(2 * t) / 3) * jnp.sqrt(1 + jnp.sum(p**2))


def entangled(t, q, p, args):
    return (1 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) * (1 + jnp.sin(t) / 4) / 2


def wavy_damping(t):
    return 0.1 * t + 0.2 * jnp.sin(t)


def pendulum_field(t, q, P):
    eta = 0.3 * t
    return np.exp(-eta) * P, -np.exp(eta) * np.sin(q)


def driven_quadratic_field(t, q, P):
    eta2 = 0.1 * t + 0.2 * np.sin(t)
    return P / (t + 2) / 1.5, np.exp(eta2) * driven_force(t, q)


def driven_field(t, q, P):
    scale = np.exp(0.2 * t)
    p = P / scale
    velocity = (1 + np.sin(2 * t) / 3) * p / np.sqrt(1 + p @ p)
    return velocity, scale * driven_force(t, q)


def entangled_field(t, q, P):
    scale = t + 1
    p, wave = P / scale, 1 + np.sin(t) / 4
    return wave * (1 + q @ q) * p, -scale * wave * (1 + p @ p) * q


# Hamiltonian, hand-written derivatives, eta(t)
SYSTEMS = {
    "damped pendulum": (
        dps.ConformalHamiltonian(
            dps.QuadraticKinetic(), pendulum, dps.ConstantDamping(0.3)
        ),
        pendulum_field,
        lambda t: 0.3 * t,
    ),
    "driven, quadratic T": (
        dps.DissipativeHamiltonian(
            dps.QuadraticKinetic(1.5),
            driven_potential,
            eta1=dps.LogDamping(1.0, shift=2.0),
            eta2=wavy_damping,
        ),
        driven_quadratic_field,
        lambda t: 0.1 * t + 0.2 * np.sin(t),
    ),
    "driven": (
        dps.ConformalHamiltonian(
            driven_kinetic, driven_potential, dps.ConstantDamping(0.2)
        ),
        driven_field,
        lambda t: 0.2 * t,
    ),
    "nonseparable": (
        dps.ConformalHamiltonian(energy=entangled, damping=dps.LogDamping(1, shift=1)),
        entangled_field,
        lambda t: np.log(t + 1),
    ),
}
T1 = 2.0
Q0, P0 = np.array([1.0, 0.4]), np.array([0.2, -0.5])


@functools.cache
def truth(system):
    _, field, eta = SYSTEMS[system]
    sol = scipy.integrate.solve_ivp(
        lambda t, y: np.concatenate(field(t, y[:2], y[2:])),
        (0, T1),
        np.concatenate([Q0, np.exp(eta(0)) * P0]),
        method="DOP853",
        rtol=3e-14,
        atol=1e-15,
    )
    return np.concatenate([sol.y[:2, -1], np.exp(-eta(T1)) * sol.y[2:, -1]])


def check_order(scheme: Scheme, system):
    y0 = (jnp.array(Q0), jnp.array(P0))

    def error(n):
        hamiltonian = SYSTEMS[system][0]
        sol = solve(hamiltonian, scheme.solver, 0.0, T1, T1 / n, y0, throw=False)
        # The root finder fails for the largest steps.
        solved = sol.result == dfx.RESULTS.successful
        return np.max(np.abs(flat(sol.ys) - truth(system))) if solved else np.inf

    order = measured_order(error, 2e-13)
    assert abs(order - scheme.order) < 0.2


@few(["driven, quadratic T", "damped pendulum"], WAYS)
def test_order_on_quadratic_kinetic_energies(scheme: Scheme, case):
    check_order(scheme, case)


@pytest.mark.slow
@each([scheme for scheme in WAYS if scheme.kind != "split"])
def test_order_where_both_energies_depend_on_time(scheme: Scheme):
    check_order(scheme, "driven")


@pytest.mark.slow
@each([*IMPLICIT, *(scheme for scheme in SCHEMES if scheme.kind in ANY)])
def test_order_on_nonseparable_energies(scheme: Scheme):
    check_order(scheme, "nonseparable")
