"""Structure: contraction of the symplectic form, symmetry, and the paper's schemes."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import paper
import pytest
from catalogue import each, PATHS, pick, Scheme, SCHEMES
from catalogue._system import ALL, LINEAR, SPLIT
from helpers import (
    assert_close,
    flat,
    harmonic,
    henon_heiles,
    mixed_energy,
    step,
    substeps,
    trajectory,
)
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


Q0, P0 = jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4])
T0, T1 = jnp.array(2.0), jnp.array(2.1)
MASS = jnp.array([[2.0, 0.3], [0.3, 1.0]])


def swinging(t, q, args):
    return (1 + jnp.sin(t) / 4) * henon_heiles(t, q, args)


def swinging_kinetic(t, p, args):
    return (1 + jnp.cos(t) / 3) * jnp.sqrt(1 + p[0] ** 2 + 2 * p[1] ** 2 + p[0] * p[1])


def swinging_energy(t, q, p, args):
    return (1 + jnp.sin(t) / 4) * mixed_energy(t, q, p, args)


def damped(damping, kinetic: Any = None, potential: Any = swinging):
    kinetic = dps.QuadraticKinetic(MASS) if kinetic is None else kinetic
    return dps.MechanicalSystem(kinetic, potential, damping)


LOG, SPRINGS = dps.LogDamping(3.0), dps.QuadraticPotential(MASS)
UNEQUAL = dps.DissipativeHamiltonian(
    dps.QuadraticKinetic(MASS), swinging, dps.LogDamping(2.0), dps.ConstantDamping(0.4)
)
# System, its eta(t) in NumPy (of `UNEQUAL` eta2), and the splits that it offers.
CASES = {
    "two laws": (
        damped([dps.LogDamping(2.0), dps.PowerDamping(0.5, 0.3)]),
        *(lambda t: 2 * np.log(t) + 0.5 * t**0.3, ALL),
    ),
    "none": (damped(None), lambda t: 0 * t, ALL),
    "constant": (damped(dps.ConstantDamping(0.7)), lambda t: 0.7 * t, ALL),
    "exciting": (damped(dps.ConstantDamping(-0.7)), lambda t: -0.7 * t, ALL),
    # Its rate changes sign within the step used below.
    "callable": (
        damped(lambda t: 3 * (t - 2.05) ** 2),
        *(lambda t: 3 * (t - 2.05) ** 2, ALL),
    ),
    "unequal": (UNEQUAL, lambda t: 0.4 * t, ALL),
    "any T": (damped(LOG, swinging_kinetic), lambda t: 3 * np.log(t), SPLIT),
    "any T, springs": (
        damped(LOG, swinging_kinetic, SPRINGS),
        *(lambda t: 3 * np.log(t), ALL),
    ),
    "linear": (
        damped(dps.ConstantDamping(0.3), None, SPRINGS),
        *(lambda t: 0.3 * t, LINEAR),
    ),
    "any energy": (
        dps.Hamiltonian(swinging_energy, LOG),
        *(lambda t: 3 * np.log(t), frozenset()),
    ),
}


def tried():
    """Each scheme with a case that it takes; each case with one scheme of each path."""
    paths = [*PATHS, *pick("TunedLinear8", "midpoint")]
    for scheme in SCHEMES:
        taken = [x for x in CASES if scheme.needs in (None, *CASES[x][2])]
        if scheme.needs != "shared":  # A multistep method has no such step.
            yield from itertools.product(
                [scheme], taken if scheme in paths else taken[:1]
            )


# Contraction: J of one step satisfies J^T Omega J = exp(eta(t0) - eta(t1)) Omega. That
# of the schemes with two copies is symplectic in the doubled phase space.


def doubled_step(system, solver, t0, t1, y, copy):
    """One step of the whole state of an augmented scheme."""
    (q, _), (_, p_copy) = y, copy
    field = system.velocity(t0, q, p_copy), system.force(t0, q, p_copy)
    y, _, _, carry, _ = solver.step(system, t0, t1, y, None, (copy, field), False)
    # The first leaves are the copy.
    return y, jtu.tree_leaves(carry)[:2]


@eqx.filter_jit
def jacobian(system, solver, *state):
    flat_state, unravel = ravel_pytree(state)

    def flat_step(x):
        state = unravel(x)
        if len(state) == 2:
            return flat(doubled_step(system, solver, T0, T1, *state))
        return flat(step(system, solver, T0, T1, *state)[0])

    return jax.jacfwd(flat_step)(flat_state)


def structure_defect(scheme: Scheme, case: str):
    system, eta, _ = CASES[case]
    # Different copies, as in the middle of a solve.
    copies = ((Q0, P0), (Q0 + 0.01, P0 - 0.02))[: 2 if "Tao" in scheme.name else 1]
    J = np.asarray(jacobian(system, scheme.solver, *copies))
    form = np.kron(np.eye(len(copies)), np.kron([[0, 1], [-1, 0]], np.eye(2)))
    return np.max(np.abs(J.T @ form @ J - np.exp(eta(T0) - eta(T1)) * form))


def is_iterated(scheme: Scheme) -> bool:
    return isinstance(scheme.solver, dps.PresymplecticGauss)


@pytest.mark.variants(8)
@pytest.mark.parametrize("scheme, case", list(tried()), ids=str)
def test_form_contracts_with_the_damping(scheme: Scheme, case):
    assert structure_defect(scheme, case) < (1e-9 if is_iterated(scheme) else 1e-13)


def test_a_runge_kutta_method_does_not_contract_the_form():
    # The test can fail.
    heun = Scheme("Heun", lambda: dfx.Heun(scan_kind="bounded"), 2, None)
    assert structure_defect(heun, "constant") > 1e-6


# Symmetry: a step of -h is the inverse of a step of h.


@eqx.filter_jit
def there_and_back(term, there, back, y):
    start = there.init(term, T0, T1, y, None)
    y, _, _, carry, _ = there.step(term, T0, T1, y, None, start, False)
    y, _, _, carry, _ = back.step(term, T1, T0, y, None, carry, False)
    return (y, carry), start


def check_symmetry(scheme, case, back=None):
    there, back = scheme.solver, scheme.solver if back is None else back
    (y, carry), start = there_and_back(CASES[case][0], there, back, (Q0, P0))
    assert_close(y, (Q0, P0), 1e-10 if is_iterated(scheme) else 5e-14)
    if not is_iterated(scheme):
        # Which carries the slopes of the last step, to begin an iteration.
        assert_close(carry, start, 5e-14)


@each()
def test_symmetry_is_as_claimed(scheme: Scheme):
    assert scheme.solver.is_symmetric == scheme.symmetric


@pytest.mark.variants(8)
@pytest.mark.parametrize(
    "scheme, case", [x for x in tried() if x[0].symmetric], ids=str
)
def test_a_step_backwards_undoes_a_step(scheme: Scheme, case):
    check_symmetry(scheme, case)


@each(pick("Euler", "Euler, position first"))
def test_the_two_euler_methods_undo_each_other(scheme: Scheme):
    (back,) = {"Euler", "Euler, position first"} - {scheme.name}
    check_symmetry(scheme, "two laws", pick(back)[0].solver)


def test_energy_does_not_drift_in_1e5_steps():
    # The step is a power of two, so times are exact. The error is bounded by that of
    # the scheme throughout; rounding errors are far smaller.
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic)
    solver = substeps(dps.PresymplecticLeapfrog(), 50)
    y0 = jnp.ones(1), jnp.zeros(1)
    _, q, p = trajectory(system, solver, 0.0, 12500.0, 6.25, y0)
    error = np.abs((q**2 + p**2) / 2 - 0.5)
    assert error.max() < 0.125**2 / 4
    assert error[-200:].max() < 1.01 * error[:200].max()
    # The modified energy, which the leapfrog preserves to rounding.
    kept = p**2 + q**2 * (1 - 0.125**2 / 4)
    assert np.abs(kept - kept[0]).max() < 1e-13


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


BY_HAND = {
    "logarithmic": (
        damped(LOG),
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
    "any energy": (
        CASES["any energy"][0],
        Canonical(
            lambda t, q, P: (1 + np.sin(t) / 4) * (1 + q @ q) * P / t**3,
            lambda t, q, P: (1 + np.sin(t) / 4) * (t**3 + P @ P / t**3) * q,
            lambda t: 3 * np.log(t),
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme, case",
    [
        *itertools.product(pick(*paper.SCHEMES), ["logarithmic", "unequal"]),
        *itertools.product(pick("Tao", "Tao 4"), ["any energy"]),
    ],
    ids=str,
)
def test_solution_is_the_paper_s_in_canonical_momentum(scheme: Scheme, case):
    system, H = BY_HAND[case]
    t0, h, steps = float(T0), 1 / 16, 32
    y = (np.asarray(Q0), np.exp(H.eta(t0)) * np.asarray(P0))
    y = y * 2 if "Tao" in scheme.name else y
    expected = []
    for i in range(steps + 1):
        t = t0 + i * h
        expected.append((y[0], np.exp(-H.eta(t)) * y[1]))
        y = paper.SCHEMES[scheme.name](H, t, h, *y)
    q, p = map(np.array, zip(*expected, strict=True))
    t1 = t0 + steps * h
    _, *solution = trajectory(system, scheme.solver, t0, t1, h, (Q0, P0))
    assert_close(solution, [q, p], 1e-12)
