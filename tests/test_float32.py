"""Single precision: no overflow and no promotion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from helpers import (
    ANY,
    CARRIES,
    each,
    harmonic,
    IMPLICIT,
    mixed_energy,
    Scheme,
    SCHEMES,
    solve,
    WAYS,
)

import diffrax_presym as dps


AUGMENTED = [scheme for scheme in SCHEMES if scheme.kind in ANY]


# Canonical momentum overflows in `float32` at a log scale of 88.

LATE = {
    "constant": dps.MechanicalSystem(
        dps.QuadraticKinetic(), harmonic, dps.ConstantDamping(1.0)
    ),
    "equal": dps.DissipativeHamiltonian(
        dps.QuadraticKinetic(),
        harmonic,
        dps.ConstantDamping(1.0),
        dps.ConstantDamping(1.0),
    ),
    "logarithmic": dps.MechanicalSystem(
        dps.QuadraticKinetic(), harmonic, dps.LogDamping(3.0, shift=1.0)
    ),
    "relativistic": dps.MechanicalSystem(
        dps.RelativisticKinetic(), harmonic, dps.ConstantDamping(1.0)
    ),
}


def check_late_times(scheme, hamiltonian, t1):
    y0 = (jnp.array([1.0, -2.0], jnp.float32), jnp.array([0.5, 0.0], jnp.float32))
    t0, t1, dt0 = (jnp.array(t, jnp.float32) for t in (0.0, t1, 0.1))
    sol = solve(hamiltonian, scheme.solver, t0, t1, dt0, y0, max_steps=None)
    for leaf in jtu.tree_leaves(sol.ys):
        assert leaf.dtype == jnp.float32
        # Not only finite, but at the minimum.
        assert np.all(np.abs(leaf) < 1e-4)


@each(CARRIES)
def test_no_overflow_at_a_log_scale_of_ten_thousand(scheme: Scheme):
    check_late_times(scheme, LATE["constant"], 1e4)


@pytest.mark.parametrize("system", ["equal", "logarithmic", "relativistic"])
@each([scheme for scheme in SCHEMES if scheme.name in ("leapfrog_AB", "tao")])
def test_no_overflow_in_other_systems(scheme: Scheme, system):
    check_late_times(scheme, LATE[system], 1e4)


# The outputs of a step have the precision of the state. `diffeqsolve` would silently
# cast `y`, so single steps are tested: parameters are doubles, time and state are not.


def cosine(t, q, args):
    leaves = jtu.tree_leaves(q)
    return sum(jnp.sum(1 - jnp.cos(x)).astype(jnp.float32) for x in leaves)


def soft_kinetic(t, p, args):
    return jnp.sum(jnp.sqrt(1 + p**2))


# Not Python numbers, as weak types would not be promoted.
HALF, ONE, TWO, THREE = map(np.float64, (0.5, 1.0, 2.0, 3.0))
DAMPING = dps.LogDamping(THREE, shift=ONE)
SYSTEMS = {
    "undamped": dps.MechanicalSystem(dps.QuadraticKinetic(TWO), harmonic),
    "constant": dps.MechanicalSystem(
        dps.QuadraticKinetic(jnp.array([1.0, 2.0])), harmonic, dps.ConstantDamping(HALF)
    ),
    "matrix": dps.MechanicalSystem(
        dps.QuadraticKinetic(jnp.diag(jnp.array([1.0, 2.0]))), harmonic, DAMPING
    ),
    "mixed": dps.MechanicalSystem(
        dps.QuadraticKinetic(TWO),
        harmonic,
        [dps.LogDamping(ONE), dps.PowerDamping(ONE, HALF)],
    ),
    "callable": dps.MechanicalSystem(
        dps.QuadraticKinetic(TWO), harmonic, lambda t: jnp.sin(t)
    ),
    "unequal": dps.DissipativeHamiltonian(
        dps.QuadraticKinetic(TWO), harmonic, DAMPING, dps.ConstantDamping(HALF)
    ),
    "relativistic": dps.MechanicalSystem(
        dps.RelativisticKinetic(ONE, TWO), harmonic, DAMPING
    ),
    "any T": dps.MechanicalSystem(soft_kinetic, harmonic, DAMPING),
    "nonseparable": dps.Hamiltonian(mixed_energy, DAMPING),
}
NEEDS = {
    "relativistic": ("frozen", "split", *ANY),
    "any T": ("frozen", "split", *ANY),
    "nonseparable": ANY,
}


def step_dtypes(hamiltonian, solver, y, time=jnp.float32):
    """The dtypes of all outputs of a step, without compiling it."""
    term = hamiltonian
    t = jax.ShapeDtypeStruct((), time)

    def step(t0, t1, y):
        carry = solver.init(term, t0, t1, y, None)
        y1, _, dense_info, new_carry, _ = solver.step(
            term, t0, t1, y, None, carry, made_jump=False
        )
        dense = solver.interpolation_cls(t0=t0, t1=t1, **dense_info).evaluate(t0)
        return y1, carry, new_carry, dense_info, dense

    out = eqx.filter_eval_shape(step, t, t, y)
    return jtu.tree_map(lambda x: x.dtype, out)


def check_dtypes(hamiltonian, solver, y, **kwargs):
    y1, carry, new_carry, dense_info, dense = step_dtypes(
        hamiltonian, solver, y, **kwargs
    )
    expected = jtu.tree_map(lambda x: x.dtype, y)
    assert y1 == expected and dense == expected
    assert new_carry == carry
    inner = dense_info.pop("inner", ())
    for values in (*dense_info.values(), *inner):
        assert values == expected
    return carry


@pytest.mark.parametrize("system", SYSTEMS)
@each(WAYS)
def test_float32_in_float32_inside_the_step(scheme: Scheme, system):
    if scheme.kind not in NEEDS.get(system, (scheme.kind,)):
        return
    leaf = jax.ShapeDtypeStruct((2,), jnp.float32)
    carry = check_dtypes(SYSTEMS[system], scheme.solver, (leaf, leaf))
    assert all(dtype == jnp.float32 for dtype in jtu.tree_leaves(carry))


@each(IMPLICIT)
def test_float32_in_float32_inside_an_implicit_step(scheme: Scheme):
    leaf = jax.ShapeDtypeStruct((2,), jnp.float32)
    check_dtypes(SYSTEMS["nonseparable"], scheme.solver, (leaf, leaf))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.float64])
@each(WAYS)
def test_states_of_other_precision_than_time(scheme: Scheme, dtype):
    leaf = jax.ShapeDtypeStruct((2,), dtype)
    check_dtypes(SYSTEMS["constant"], scheme.solver, (leaf, leaf))


MIXED = {
    "half": jnp.array([0.5, 1.0], jnp.bfloat16),
    "single": jnp.array(1.0, jnp.float32),
    "double": jnp.array([[1.0], [2.0]], jnp.float64),
}
MIXED_SYSTEMS = {
    "undamped": dps.MechanicalSystem(dps.QuadraticKinetic(TWO), cosine),
    "constant": dps.MechanicalSystem(
        dps.QuadraticKinetic(TWO), cosine, dps.ConstantDamping(HALF)
    ),
    "unequal": dps.DissipativeHamiltonian(
        dps.QuadraticKinetic(TWO), cosine, DAMPING, dps.ConstantDamping(HALF)
    ),
}


@pytest.mark.parametrize("system", MIXED_SYSTEMS)
@each(WAYS)
def test_leaves_of_different_precision(scheme: Scheme, system):
    check_dtypes(MIXED_SYSTEMS[system], scheme.solver, (MIXED, MIXED))


def test_each_leaf_is_as_accurate_as_its_precision_allows():
    hamiltonian, solver = MIXED_SYSTEMS["constant"], dps.PresymplecticLeapfrog()
    double = jtu.tree_map(lambda x: x.astype(jnp.float64), MIXED)
    run = lambda y0: solve(hamiltonian, solver, 0.0, 1.0, 0.125, (y0, y0)).ys
    mixed, exact = run(MIXED), run(double)
    for x, y in zip(jtu.tree_leaves(mixed), jtu.tree_leaves(exact), strict=True):
        assert np.max(np.abs(x.astype(jnp.float64) - y)) < 20 * jnp.finfo(x.dtype).eps
