"""Energies that are neither separable nor split: two copies, or implicit steps."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, flat, mixed_energy, solve, step, trajectory
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


def test_copies_that_resonate_part():
    # The difference is rotated by pi, which at best exchanges the copies.
    angles = [np.pi / 2, np.pi]
    distances, results = [], []
    for angle in angles:
        solver = dps.PresymplecticCoupled(angle=angle)
        saveat = dfx.SaveAt(t1=True, solver_state=True)
        options: Any = dict(saveat=saveat, throw=False)
        sol: Any = solve(MIXED, solver, 0.0, 50.0, 1 / 20, START, **options)
        distances.append(float(solver.distance(sol.ys, sol.solver_state)))
        results.append(sol.result)
    assert 0 < 5 * distances[0] < distances[1]
    assert results[0] == dfx.RESULTS.successful
    assert results[1] == dfx.RESULTS.nonlinear_divergence


@pytest.mark.parametrize("order", [2, 4])
def test_copies_that_pass_zero_have_not_parted(order):
    # From rest, to which the momentum returns with an error larger than itself.
    for solver in (dps.PresymplecticCoupled(order), dps.PresymplecticProjected(order)):
        sol = solve(MIXED, solver, 0.0, 50.0, 1 / 20, START)
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


def test_distance_of_the_copies_is_known():
    solver = dps.PresymplecticTao()
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    sol: Any = solve(MIXED, solver, 0.0, 1.0, 1 / 64, START, saveat=saveat)
    y = jax.tree.map(lambda x: x[-1], sol.ys)
    copy, _ = sol.solver_state
    expected = np.max(np.abs(flat(y) - flat(copy)))
    assert_close(solver.distance(y, sol.solver_state), expected, 0)
    assert 0 < expected < 0.01


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
                dps.HamiltonianTerm(DAMPED),
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


def projection_defect(h):
    solver = dps.PresymplecticProjected(4)
    start, unravel = ravel_pytree(Y0)
    fn = lambda x: flat(step(WAVY, solver, T0, T0 + h, unravel(x))[0])
    J = np.asarray(jax.jacfwd(fn)(start))
    form = np.kron([[0, 1], [-1, 0]], np.eye(2))
    return np.max(np.abs(J.T @ form @ J - float((T0 / (T0 + h)) ** 2) * form))


def test_order_of_the_projection():
    exact = flat(solve(WAVY, dps.PresymplecticCoupled(6), 1.0, 2.0, 1 / 64, Y0).ys)
    solver, errors = dps.PresymplecticProjected(4), []
    for n in (16, 24):
        end = flat(solve(WAVY, solver, 1.0, 2.0, 1 / n, Y0).ys)
        errors.append(np.max(np.abs(end - exact)))
    assert abs(np.log(errors[0] / errors[1]) / np.log(1.5) - 4) < 0.3
    assert not solver.is_symmetric


def test_defect_of_the_projection_is_of_higher_order():
    defects = [projection_defect(h) for h in (1 / 8, 1 / 12)]
    slope = np.log(defects[0] / defects[1]) / np.log(1.5)
    assert defects[1] > 1e-12 and slope > 5.5


# Implicit schemes


def spin(t, q, p, args):
    """A nonseparable energy with rotational symmetry."""
    return (1 + jnp.sum(q**2)) * jnp.sum(p**2) / 2 + jnp.sum(q**2) ** 2


def test_midpoint_keeps_angular_momentum():
    solver = dps.PresymplecticMidpoint(FINDER)
    _, q, p = trajectory(dps.Hamiltonian(spin), solver, 0.0, 5.0, 1 / 8, Y0)
    momentum = q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]
    assert np.ptp(momentum) < 1e-11
    assert np.ptp(q) > 0.5


def test_a_midpoint_that_is_not_found_is_a_result():
    solver = dps.PresymplecticMidpoint(FINDER, root_find_max_steps=2)
    sol = solve(MIXED, solver, 0.0, 1.0, 1 / 4, START, throw=False)
    assert sol.result == dfx.RESULTS.nonlinear_max_steps_reached
    assert sol.stats["num_steps"] == 1


# Errors and failures

NOTHING: Any = None


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: dps.PresymplecticCoupled(3), "2, 4, 6, 8 or 10"),
        (lambda: dps.PresymplecticProjected(5), "2, 4, 6, 8 or 10"),
        (lambda: dps.PresymplecticCoupled(angle=NOTHING), "real number"),
        (lambda: dps.PresymplecticCoupled(scale=-1.0), "positive"),
        (lambda: dps.Suzuki4(dps.PresymplecticCoupled()), "composes its own stages"),
        (lambda: dps.Suzuki4(dps.PresymplecticProjected()), "symmetric"),
        (lambda: dps.PresymplecticMidpoint(NOTHING), "root finder"),
    ],
)
def test_bad_solvers_are_an_error(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def cost(t, q, args):
    return jnp.sum((q - jnp.array([0.1, 0.3])) ** 2)


ENTROPIC = dps.BregmanHamiltonian(dps.EntropyMirror(), cost, dps.PolynomialScaling(2.0))
ANY = {
    "tao": dps.PresymplecticTao(),
    "coupled": dps.PresymplecticCoupled(4),
    "projected": dps.PresymplecticProjected(4),
    "midpoint": dps.PresymplecticMidpoint(FINDER),
    "leapfrog": dps.PresymplecticLeapfrog("momentum", FINDER),
}


@pytest.mark.parametrize("name", ANY)
def test_outside_of_the_domain_is_a_result(name):
    y0 = (jnp.array([-0.3, 0.5]), jnp.zeros(2))
    sol = solve(ENTROPIC, ANY[name], 1.0, 2.0, 1 / 8, y0, throw=False)
    assert sol.result != dfx.RESULTS.successful


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tao", "coupled", "projected", "midpoint"])
def test_every_scheme_finds_bregman_motion(name):
    y0 = (jnp.array([0.3, 0.5]), jnp.array([0.1, -0.2]))
    exact = solve(ENTROPIC, dps.BlanesMoan6(), 1.0, 2.0, 1 / 16, y0).ys
    end = solve(ENTROPIC, ANY[name], 1.0, 2.0, 1 / 64, y0).ys
    assert_close(end, exact, 2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coupled", "projected"])
def test_gradients_of_mirror_maps_and_scalings(name):
    y0 = (jnp.array([0.3, 0.5]), jnp.array([0.1, -0.2]))

    def loss(theta):
        shape, c, C = theta
        H = dps.BregmanHamiltonian(
            dps.HyperbolicMirror(shape), cost, dps.PolynomialScaling(c, C)
        )
        sol = dfx.diffeqsolve(
            dps.HamiltonianTerm(H), ANY[name], 1.0, 2.0, 0.125, y0, max_steps=16
        )
        assert sol.ys is not None
        return jnp.sum(jnp.sin(flat(sol.ys)))

    theta = jnp.array([0.6, 2.5, 0.6])
    both = jax.jit(jax.value_and_grad(loss))
    gradient = both(theta)[1]
    assert np.all(np.abs(gradient) > 1e-3)
    for i, e in enumerate(1e-5 * np.eye(3)):
        difference = (both(theta + e)[0] - both(theta - e)[0]) / 2e-5
        assert abs(gradient[i] - difference) < 1e-7
