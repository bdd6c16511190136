"""Single precision: no overflow and no promotion."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from catalogue import each, PATHS, pick, Scheme, STATES
from choosing import RKN6, solve_of, system_of
from helpers import harmonic, mixed_energy, solve

import diffrax_presym as dps


UNIT = dps.QuadraticKinetic()

# Canonical momentum overflows in `float32` at a log scale of 88.

ONE_RATE = dps.ConstantDamping(1.0)
LATE = {
    "constant": dps.MechanicalSystem(UNIT, harmonic, ONE_RATE),
    "equal": dps.DissipativeHamiltonian(UNIT, harmonic, ONE_RATE, ONE_RATE),
    "logarithmic": dps.MechanicalSystem(UNIT, harmonic, dps.LogDamping(3.0, shift=1.0)),
    "relativistic": dps.MechanicalSystem(dps.RelativisticKinetic(), harmonic, ONE_RATE),
}


@pytest.mark.variants(4)
@pytest.mark.parametrize("system", LATE)
@each([*STATES, *pick("leapfrog", "Tao")])
def test_no_overflow_at_a_log_scale_of_ten_thousand(scheme: Scheme, system):
    y0 = (jnp.array([1.0, -2.0], jnp.float32), jnp.array([0.5, 0.0], jnp.float32))
    t0, t1, dt0 = (jnp.array(t, jnp.float32) for t in (0.0, 1e4, 0.1))
    sol = solve(LATE[system], scheme.solver, t0, t1, dt0, y0, max_steps=None)
    for leaf in jtu.tree_leaves(sol.ys):
        assert leaf.dtype == jnp.float32
        # Not only finite, but at the minimum.
        assert np.all(np.abs(leaf) < 1e-4)


def test_excitation_grows_until_overflow_is_physical():
    y0 = jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32)
    system = dps.MechanicalSystem(UNIT, harmonic, dps.ConstantDamping(-1.0))
    leapfrog, results = dps.PresymplecticLeapfrog(), []
    for t1 in (100.0, 250.0):
        t0, t1, dt0 = map(jnp.float32, (0.0, t1, 0.05))
        results.append(solve(system, leapfrog, t0, t1, dt0, y0, throw=False).result)
    # exp(50) is finite in float32, and exp(125) is not.
    assert results[0] == dfx.RESULTS.successful
    assert results[1] == dfx.RESULTS.nonfinite  # pyright: ignore


def test_values_between_steps_at_late_times():
    ts = jnp.float32(1e5) + jnp.linspace(0.0, 16.0, 65, dtype=jnp.float32)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.QuadraticPotential())
    y0 = jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32)
    sol: Any = dfx.diffeqsolve(
        *(system, dps.BlanesMoanRKN4(), ts[0], ts[-1], jnp.float32(0.4), y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
    )
    assert sol.stats["interpolated"] and sol.ys[0].dtype == jnp.float32
    assert sol.ts.dtype == jnp.float32
    # Times are multiples of 2^-7 there.
    t = np.asarray(ts, float) - 1e5
    assert np.asarray(sol.ys[0][:, 0]) == pytest.approx(np.cos(t), abs=0.01)


@pytest.mark.parametrize("atol", [1e-3, 1e-4])
def test_a_step_chosen_where_more_steps_add_rounding_alone(atol):
    """The fewest that reach the tolerance, as in double precision."""
    single = lambda x: jnp.asarray(x, jnp.float32)
    q0, t0 = single(np.linspace(1.0, 15.0, 8)), float(np.float32(np.log(0.02)))
    system = system_of(lambda t, q, args: -jnp.sum(jnp.cos(q)), single(0.5))
    ts = single(np.log(np.linspace(0.1, 1.0, 10)))
    solve = solve_of(system, RKN6, single(t0), single(0.0), (q0, 0 * q0), ts=ts)
    cast = lambda dt0: solve(single(dt0))
    assert dps.choose_step(cast, t0, 0.0, rtol=0.0, atol=atol).steps <= 3


# The outputs of a step have the precision of the state. `diffeqsolve` would silently
# cast `y`, so single steps are tested: parameters are doubles, time and state are not.


def cosine(t, q, args):
    leaves = jtu.tree_leaves(q)
    return sum(jnp.sum(1 - jnp.cos(x)).astype(jnp.float32) for x in leaves)


def soft_kinetic(t, p, args):
    return jnp.sum(jnp.sqrt(1 + p**2))


# Not Python numbers, as weak types would not be promoted.
HALF, ONE, TWO, THREE = map(np.float64, (0.5, 1.0, 2.0, 3.0))
LOG, RATE = dps.LogDamping(THREE, shift=ONE), dps.ConstantDamping(HALF)
MASS, MASSES = dps.QuadraticKinetic(TWO), jnp.array([1.0, 2.0])
MECHANICAL = {
    "undamped": (MASS, harmonic),
    "constant": (dps.QuadraticKinetic(MASSES), harmonic, RATE),
    "matrix": (dps.QuadraticKinetic(jnp.diag(MASSES)), harmonic, LOG),
    "two laws": (MASS, harmonic, [dps.LogDamping(ONE), dps.PowerDamping(ONE, HALF)]),
    "callable": (MASS, harmonic, lambda t: jnp.sin(t)),
    "relativistic": (dps.RelativisticKinetic(ONE, TWO), harmonic, LOG),
    "any T": (soft_kinetic, harmonic, LOG),
}
SYSTEMS: dict[str, Any] = {
    name: dps.MechanicalSystem(*parts) for name, parts in MECHANICAL.items()
}
SYSTEMS |= {
    "unequal": dps.DissipativeHamiltonian(MASS, harmonic, LOG, RATE),
    "any energy": dps.Hamiltonian(mixed_energy, LOG),
}
REFUSED = {"nystrom": {"any energy", "any T", "relativistic"}, None: set()}
SINGLE = [
    (scheme, name)
    for scheme in [*PATHS, *pick("midpoint")]
    for name in SYSTEMS
    if name not in REFUSED.get(scheme.needs, {"any energy"})
]


def check_dtypes(system, solver, y):
    """Of all outputs of a step, without compiling it."""
    t = jax.ShapeDtypeStruct((), jnp.float32)

    def step(t0, t1, y):
        carry = solver.init(system, t0, t1, y, None)
        y1, _, dense_info, new_carry, _ = solver.step(
            system, t0, t1, y, None, carry, made_jump=False
        )
        dense = solver.interpolation_cls(t0=t0, t1=t1, **dense_info).evaluate(t0)
        return y1, carry, new_carry, dense_info, dense

    out = eqx.filter_eval_shape(step, t, t, y)
    y1, carry, new_carry, dense_info, dense = jtu.tree_map(lambda x: x.dtype, out)
    expected = jtu.tree_map(lambda x: x.dtype, y)
    assert y1 == expected and dense == expected
    assert new_carry == carry
    inner = dense_info.pop("inner", ())
    for values in (*dense_info.values(), *inner):
        assert values == expected
    return carry


@pytest.mark.variants(8)
@pytest.mark.parametrize("scheme, system", SINGLE, ids=str)
def test_float32_in_float32_inside_the_step(scheme: Scheme, system):
    leaf = jax.ShapeDtypeStruct((2,), jnp.float32)
    carry = check_dtypes(SYSTEMS[system], scheme.solver, (leaf, leaf))
    if not scheme.implicit:
        assert all(dtype == jnp.float32 for dtype in jtu.tree_leaves(carry))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.float64])
@each(PATHS)
def test_states_of_other_precision_than_time(scheme: Scheme, dtype):
    leaf = jax.ShapeDtypeStruct((2,), dtype)
    check_dtypes(SYSTEMS["constant"], scheme.solver, (leaf, leaf))


MIXED = {
    "half": jnp.array([0.5, 1.0], jnp.bfloat16),
    "single": jnp.array(1.0, jnp.float32),
    "double": jnp.array([[1.0], [2.0]], jnp.float64),
}
MIXED_SYSTEMS = {
    "undamped": dps.MechanicalSystem(MASS, cosine),
    "constant": dps.MechanicalSystem(MASS, cosine, RATE),
    "unequal": dps.DissipativeHamiltonian(MASS, cosine, LOG, RATE),
}


@pytest.mark.parametrize("system", MIXED_SYSTEMS)
@each(PATHS)
def test_leaves_of_different_precision(scheme: Scheme, system):
    check_dtypes(MIXED_SYSTEMS[system], scheme.solver, (MIXED, MIXED))


def test_each_leaf_is_as_accurate_as_its_precision_allows():
    system, solver = MIXED_SYSTEMS["constant"], dps.PresymplecticLeapfrog()
    double = jtu.tree_map(lambda x: x.astype(jnp.float64), MIXED)
    run = lambda y0: solve(system, solver, 0.0, 1.0, 0.125, (y0, y0)).ys
    mixed, exact = run(MIXED), run(double)
    for x, y in zip(jtu.tree_leaves(mixed), jtu.tree_leaves(exact), strict=True):
        assert np.max(np.abs(x.astype(jnp.float64) - y)) < 20 * jnp.finfo(x.dtype).eps


def test_a_step_for_values_that_are_saved_in_single_precision():
    """Which agree to all digits long before the solution is that accurate."""
    swing = dps.MechanicalSystem(UNIT, lambda t, q, args: -jnp.sum(jnp.cos(q)))

    def solve(save):
        single = dfx.SubSaveAt(t1=True, fn=lambda t, y, args: save(y[0]))
        return jax.jit(
            lambda dt0: dfx.diffeqsolve(
                *(swing, dps.TunedRKN6(), 0.0, 7.0, dt0, (jnp.ones(1), jnp.zeros(1))),
                saveat=dfx.SaveAt(subs=single),
            )
        )

    choose = lambda save, tol: dps.choose_step(
        solve(save), 0.0, 7.0, rtol=tol, atol=tol
    )
    with pytest.raises(RuntimeError, match="tolerance in float32, to which the solve"):
        choose(jnp.float32, 1e-8)
    assert choose(jnp.float32, 1e-4).error <= 1
    with pytest.raises(ValueError, match="must save values at some times"):
        choose(lambda q: None, 1e-4)
