"""Structure: contraction of the symplectic form, and symmetry."""

import dataclasses
from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import paper
import pytest
from helpers import (
    ANY,
    assert_close,
    CARRIES,
    each,
    few,
    flat,
    henon_heiles,
    IMPLICIT,
    mixed_energy,
    Scheme,
    SCHEMES,
    step,
    trajectory,
    WAYS,
)
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


# The schemes with two copies, which are symplectic in the doubled phase space.
AUGMENTED = [scheme for scheme in SCHEMES if scheme.kind in ANY]
NAMED = {scheme.name: scheme for scheme in SCHEMES}

Q0, P0 = jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4])


def swinging(t, q, args):
    return (1 + jnp.sin(t) / 4) * henon_heiles(t, q, args)


def swinging_kinetic(t, p, args):
    return (1 + jnp.cos(t) / 3) * jnp.sqrt(1 + p[0] ** 2 + 2 * p[1] ** 2 + p[0] * p[1])


def swinging_energy(t, q, p, args):
    return (1 + jnp.sin(t) / 4) * mixed_energy(t, q, p, args)


# Damping law, and its eta(t) in NumPy
DAMPINGS = {
    "mixed": (
        [dps.LogDamping(2.0), dps.PowerDamping(0.5, 0.3)],
        lambda t: 2 * np.log(t) + 0.5 * t**0.3,
    ),
    "none": (None, lambda t: 0 * t),
    "constant": (dps.ConstantDamping(0.7), lambda t: 0.7 * t),
    "exciting": (dps.ConstantDamping(-0.7), lambda t: -0.7 * t),
    "logarithmic": (dps.LogDamping(3.0), lambda t: 3 * np.log(t)),
    # Its rate changes sign within the step used below.
    "callable": (lambda t: 3 * (t - 2.05) ** 2, lambda t: 3 * (t - 2.05) ** 2),
}
MASS = jnp.array([[2.0, 0.3], [0.3, 1.0]])


def damped(kinetic, damping):
    return dps.MechanicalSystem(kinetic, swinging, damping)


def quadratic(damping):
    return damped(dps.QuadraticKinetic(MASS), damping)


UNEQUAL = dps.DissipativeHamiltonian(
    dps.QuadraticKinetic(MASS), swinging, dps.LogDamping(2.0), dps.ConstantDamping(0.4)
)


# The one-step Jacobian J satisfies J^T Omega J = exp(eta(t0) - eta(t1)) Omega.

T0, T1 = jnp.array(2.0), jnp.array(2.1)


def canonical_form(n, copies=1):
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    return np.kron(np.eye(copies), form)


def doubled_step(hamiltonian, solver, t0, t1, y, copy):
    """One step of the whole state of an augmented scheme."""
    (q, _), (_, p_copy) = y, copy
    field = hamiltonian.velocity(t0, q, p_copy), hamiltonian.force(t0, q, p_copy)
    carry = copy, field
    y, _, _, carry, _ = solver.step(hamiltonian, t0, t1, y, None, carry, False)
    # The first leaves are the copy.
    return y, jtu.tree_leaves(carry)[:2]


@eqx.filter_jit
def jacobian(hamiltonian, solver, t0, t1, *state):
    flat_state, unravel = ravel_pytree(state)

    def flat_step(x):
        state = unravel(x)
        if len(state) == 2:
            return flat(doubled_step(hamiltonian, solver, t0, t1, *state))
        return flat(step(hamiltonian, solver, t0, t1, *state)[0])

    return jax.jacfwd(flat_step)(flat_state)


def structure_defect(hamiltonian, scheme, contraction):
    y = (Q0, P0)
    # Different copies, as in the middle of a solve.
    copy = (Q0 + 0.01, P0 - 0.02)
    state = (y, copy) if scheme.kind == "augmented" else (y,)
    J = np.asarray(jacobian(hamiltonian, scheme.solver, T0, T1, *state))
    form = canonical_form(2, len(state))
    return np.max(np.abs(J.T @ form @ J - contraction * form))


def contraction(eta):
    return float(np.exp(eta(T0) - eta(T1)))


@pytest.mark.parametrize("case", DAMPINGS)
@each(CARRIES)
def test_form_contracts_with_the_damping(scheme: Scheme, case):
    law, eta = DAMPINGS[case]
    assert structure_defect(quadratic(law), scheme, contraction(eta)) < 1e-13


@each()
def test_form_contracts_under_unequal_damping(scheme: Scheme):
    # The log scale is eta2.
    assert structure_defect(UNEQUAL, scheme, np.exp(-0.4 * 0.1)) < 1e-13


@each(kinds=("frozen", *ANY))
def test_form_contracts_for_any_kinetic_energy(scheme: Scheme):
    law, eta = DAMPINGS["logarithmic"]
    hamiltonian = damped(swinging_kinetic, law)
    assert structure_defect(hamiltonian, scheme, contraction(eta)) < 1e-13


@pytest.mark.slow
@each([*IMPLICIT, *AUGMENTED])
def test_form_contracts_for_nonseparable_energies(scheme: Scheme):
    law, eta = DAMPINGS["logarithmic"]
    hamiltonian = dps.Hamiltonian(swinging_energy, law)
    # An implicit scheme is symplectic to the tolerance of its root finder.
    tolerance = 1e-9 if scheme in IMPLICIT else 1e-13
    assert structure_defect(hamiltonian, scheme, contraction(eta)) < tolerance


def test_a_runge_kutta_method_does_not_contract_the_form():
    # The test can fail.
    law, eta = DAMPINGS["constant"]
    heun = Scheme("heun", dfx.Heun(scan_kind="bounded"), 2, 2)
    assert structure_defect(quadratic(law), heun, contraction(eta)) > 1e-6


# Symmetry: a step of -h is the inverse of a step of h.


@eqx.filter_jit
def there_and_back(hamiltonian, there, back, t0, t1, y):
    term = hamiltonian
    start = there.init(term, t0, t1, y, None)
    y, _, _, carry, _ = there.step(term, t0, t1, y, None, start, False)
    y, _, _, carry, _ = back.step(term, t1, t0, y, None, carry, False)
    return (y, carry), start


@each()
def test_symmetry_is_as_claimed(scheme: Scheme):
    assert scheme.solver.is_symmetric == scheme.symmetric


def check_symmetry(hamiltonian, there, back, tolerance):
    y = (Q0, P0)
    (y2, carry), start = there_and_back(hamiltonian, there, back, T0, T1, y)
    assert_close(y2, y, tolerance)
    if not isinstance(there, dps.PresymplecticGauss):
        # Which carries the slopes of the last step, to begin an iteration.
        assert_close(carry, start, tolerance)


@pytest.mark.parametrize(
    "hamiltonian", [quadratic(dps.LogDamping(3.0)), UNEQUAL], ids=["equal", "unequal"]
)
@each(symmetric=True)
def test_a_step_backwards_undoes_a_step(scheme: Scheme, hamiltonian):
    check_symmetry(hamiltonian, scheme.solver, scheme.solver, 2e-14)


@pytest.mark.slow
@each([*IMPLICIT, *AUGMENTED], symmetric=True)
def test_a_step_backwards_undoes_a_nonseparable_step(scheme: Scheme):
    hamiltonian = dps.Hamiltonian(swinging_energy, dps.LogDamping(3.0))
    tolerance = 1e-10 if scheme in IMPLICIT else 2e-14
    check_symmetry(hamiltonian, scheme.solver, scheme.solver, tolerance)


@pytest.mark.parametrize("first, second", ["AB", "BA"])
def test_the_two_euler_methods_undo_each_other(first, second):
    hamiltonian = quadratic(dps.LogDamping(3.0))
    there, back = NAMED[f"euler_{first}"].solver, NAMED[f"euler_{second}"].solver
    check_symmetry(hamiltonian, there, back, 2e-14)


# The mechanical momentum is an exact change of variables: agreement with the paper.


@dataclasses.dataclass
class Canonical:
    """Hand-written derivatives of a Hamiltonian in the canonical momentum."""

    velocity: Callable
    slope: Callable
    eta: Callable


def swinging_slope(t, q):
    slope = q + np.array([2 * q[0] * q[1], q[0] ** 2 - q[1] ** 2])
    return (1 + np.sin(t) / 4) * slope


PAIRS = {
    "logarithmic": (
        quadratic(dps.LogDamping(3.0)),
        Canonical(
            lambda t, q, P: t**-3.0 * np.linalg.solve(np.asarray(MASS), P),
            lambda t, q, P: t**3.0 * swinging_slope(t, q),
            lambda t: 3 * np.log(t),
        ),
    ),
    "unequal": (
        UNEQUAL,
        Canonical(
            lambda t, q, P: t**-2.0 * np.linalg.solve(np.asarray(MASS), P),
            lambda t, q, P: np.exp(0.4 * t) * swinging_slope(t, q),
            lambda t: 0.4 * t,
        ),
    ),
}
ENTANGLED = (
    dps.Hamiltonian(swinging_energy, dps.LogDamping(3.0)),
    Canonical(
        lambda t, q, P: (1 + np.sin(t) / 4) * (1 + q @ q) * P / t**3,
        lambda t, q, P: (1 + np.sin(t) / 4) * (t**3 + P @ P / t**3) * q,
        lambda t: 3 * np.log(t),
    ),
)


def check_canonical(scheme: Scheme, hamiltonian, H, tolerance):
    t0, h, steps = float(T0), 1 / 16, 32
    y = (np.asarray(Q0), np.exp(H.eta(t0)) * np.asarray(P0))
    y = y * 2 if scheme.kind == "augmented" else y
    expected = []
    for i in range(steps + 1):
        t = t0 + i * h
        expected.append((y[0], np.exp(-H.eta(t)) * y[1]))
        y = paper.SCHEMES[scheme.name](H, t, h, *y)
    q = np.array([q for q, _ in expected])
    p = np.array([p for _, p in expected])
    t1 = t0 + steps * h
    _, *solution = trajectory(hamiltonian, scheme.solver, t0, t1, h, (Q0, P0))
    assert_close(solution, [q, p], tolerance)


@pytest.mark.slow
@few(PAIRS, [scheme for scheme in WAYS if scheme.name in paper.SCHEMES])
def test_solution_is_the_paper_s_in_canonical_momentum(scheme: Scheme, case):
    hamiltonian, H = PAIRS[case]
    check_canonical(scheme, hamiltonian, H, 1e-12)


@pytest.mark.slow
@each(AUGMENTED)
def test_nonseparable_solution_is_the_paper_s(scheme: Scheme):
    hamiltonian, H = ENTANGLED
    check_canonical(scheme, hamiltonian, H, 1e-12)
