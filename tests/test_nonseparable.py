"""Energies that are neither separable nor split: two copies, or implicit steps."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, flat, mixed_energy, solve, trajectory
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


MIXED = dps.Hamiltonian(mixed_energy)
DAMPED = dps.ConformalHamiltonian(
    energy=mixed_energy, damping=dps.ConstantDamping(0.05)
)
START = (jnp.array([-3.0]), jnp.array([0.0]))
FINDER = optx.Newton(rtol=1e-12, atol=1e-12)


# Tao's benchmark


def energy_errors(solver, dt0):
    """The largest error of the energy in the first and the last quarter of a solve."""
    _, q, p = trajectory(MIXED, solver, 0.0, 100.0, dt0, START)
    errors = np.abs((1 + q[:, 0] ** 2) * (1 + p[:, 0] ** 2) / 2 - 5)
    quarter = len(errors) // 4
    return np.max(errors[:quarter]), np.max(errors[-quarter:])


@pytest.mark.slow
def test_energy_errors_do_not_grow():
    for solver, dt0 in [
        (dps.PresymplecticTao(), 1 / 40),
        (dps.PresymplecticCoupled(), 1 / 40),
        (dps.PresymplecticCoupled(4), 1 / 10),
    ]:
        first, last = energy_errors(solver, dt0)
        assert last < 1.2 * first


def test_free_copies_are_more_accurate_at_equal_cost():
    tao = energy_errors(dps.PresymplecticTao(), 1 / 40)[1]
    assert 5 * energy_errors(dps.PresymplecticCoupled(), 1 / 40)[1] < tao
    # With a coupling of 10, which is optimal.
    tao_4 = energy_errors(dps.Suzuki4(dps.PresymplecticTao(10.0)), 1 / 20)[1]
    coupled_4 = energy_errors(dps.PresymplecticCoupled(4), 1 / 20 * 11 / 15)[1]
    assert 100 * coupled_4 < tao_4


@pytest.mark.parametrize("order", [2, 4])
def test_copies_that_pass_zero_have_not_parted(order):
    # From rest, to which the momentum returns with an error larger than itself.
    sol = solve(MIXED, dps.PresymplecticCoupled(order), 0.0, 50.0, 1 / 20, START)
    assert sol.result == dfx.RESULTS.successful


STRETCH = 40.0


def stretched_energy(t, q, p, args):
    return mixed_energy(t, q / STRETCH, p * STRETCH, args)


def test_scale_undoes_units():
    y0 = (STRETCH * START[0], START[1] / STRETCH)
    solver = dps.PresymplecticCoupled(4, scale=STRETCH**2)
    stretched = dps.Hamiltonian(stretched_energy)
    sol: Any = solve(stretched, solver, 0.0, 10.0, 1 / 8, y0)
    q, p = sol.ys
    plain = solve(MIXED, dps.PresymplecticCoupled(4), 0.0, 10.0, 1 / 8, START).ys
    assert_close((q / STRETCH, p * STRETCH), plain, 1e-10)


# Friction over long times


def canonical_energy(t, q, P, args):
    return DAMPED.canonical(t, q, DAMPED.from_canonical(t, P))


@pytest.mark.parametrize(
    "solver, dt0",
    [(dps.PresymplecticTao(), 1 / 16), (dps.PresymplecticCoupled(4, scale=1.5), 1 / 8)],
)
def test_damped_motion_stays_finite_and_conformal(solver, dt0):
    sol = solve(DAMPED, solver, 0.0, 1000.0, dt0, START, max_steps=None)
    assert sol.result == dfx.RESULTS.successful
    # At small amplitude the system is the oscillator, with the same decay.
    assert np.log(np.max(np.abs(flat(sol.ys)))) == pytest.approx(-25, abs=1.5)
    n = 2

    @jax.jit
    def jacobian(x):
        state, unravel = ravel_pytree((sol.ys, sol.ys))

        def doubled(x):
            (q, p), copy = unravel(x)
            carry = copy
            if isinstance(solver, dps.PresymplecticTao):
                t0 = jnp.array(1000.0)
                at = (t0, q, copy[1])
                carry = copy, (DAMPED.velocity(*at), DAMPED.force(*at))
            y, _, _, carry, _ = solver.step(
                DAMPED,
                *(jnp.array(1000.0), jnp.array(1000.0 + dt0), (q, p), None),
                *(carry, False),
            )
            return jnp.concatenate([flat(y), flat(jax.tree.leaves(carry)[:2])])

        return jax.jacfwd(doubled)(state + x)

    J = np.asarray(jacobian(jnp.zeros(4)))
    form = np.kron(np.eye(n), [[0, 1], [-1, 0]])
    assert np.max(np.abs(J.T @ form @ J - np.exp(-0.05 * dt0) * form)) < 1e-14


def test_a_coupling_of_canonical_momenta_fails():
    # Without mechanical momenta, the solve fails with an unsuccessful result.
    sol = solve(
        *(dps.Hamiltonian(canonical_energy), dps.PresymplecticTao(5.0)),
        *(0.0, 1000.0, 1 / 16, START),
        throw=False,
        max_steps=None,
    )
    assert sol.result != dfx.RESULTS.successful


# Structure. The projected scheme is not symplectic; uncoupled copies are.

T0, H0 = jnp.array(0.5), 1 / 16
WAVY = dps.ConformalHamiltonian(energy=mixed_energy, damping=dps.LogDamping(2.0))
Y0 = (jnp.array([0.5, -0.3]), jnp.array([0.2, 0.4]))


# Implicit schemes


# Errors and failures

NOTHING: Any = None


def cost(t, q, args):
    return jnp.sum((q - jnp.array([0.1, 0.3])) ** 2)


ENTROPIC = dps.BregmanHamiltonian(dps.EntropyMirror(), cost, dps.PolynomialScaling(2.0))
ANY = {
    "tao": dps.PresymplecticTao(),
    "coupled": dps.PresymplecticCoupled(4),
    "midpoint": dps.PresymplecticGauss(1, FINDER),
    "leapfrog": dps.PresymplecticLeapfrog("momentum", FINDER),
}


@pytest.mark.parametrize("name", ANY)
def test_outside_of_the_domain_is_a_result(name):
    y0 = (jnp.array([-0.3, 0.5]), jnp.zeros(2))
    sol = solve(ENTROPIC, ANY[name], 1.0, 2.0, 1 / 8, y0, throw=False)
    assert sol.result != dfx.RESULTS.successful


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tao", "coupled", "midpoint"])
def test_every_scheme_finds_bregman_motion(name):
    y0 = (jnp.array([0.3, 0.5]), jnp.array([0.1, -0.2]))
    exact = solve(ENTROPIC, dps.BlanesMoan6(), 1.0, 2.0, 1 / 16, y0).ys
    end = solve(ENTROPIC, ANY[name], 1.0, 2.0, 1 / 64, y0).ys
    assert_close(end, exact, 2e-4)
