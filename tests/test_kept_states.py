# pyright: reportOptionalSubscript=false, reportCallIssue=false
"""Gradients where states cannot be recomputed: kept states, or a failure."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close

import diffrax_presym as dps


REVERSIBLE = dps.FixedStepAdjoint()
FIXED_STEP = dps.FixedStepAdjoint("checkpoints")
CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()
LEAPFROG = dps.PresymplecticLeapfrog()


def pendulum(gamma):
    potential = lambda t, q, args: jnp.sum(1 - jnp.cos(q))
    damping = dps.ConstantDamping(gamma)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)


@eqx.filter_jit
def damping_gradient(adjoint, inputs):
    def loss(inputs):
        q0, gamma = inputs
        dtype = q0.dtype
        # Early states are saved, as the final state does not depend on the initial one.
        saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 20, dtype=dtype))
        times = (jnp.asarray(t, dtype) for t in (0.0, 100.0, 1 / 16))
        system = pendulum(gamma)
        args = system, LEAPFROG, *times, (q0, jnp.zeros_like(q0))
        options: dict[str, Any] = dict(adjoint=adjoint, saveat=saveat, max_steps=1600)
        sol = dfx.diffeqsolve(*args, **options)
        return sum(jnp.sum(y**2) for y in jtu.tree_leaves(sol.ys))

    return jax.grad(loss)(inputs)


@pytest.mark.parametrize(
    "dtype, eta, tolerance",
    [(jnp.float64, 1000.0, 1e-10), (jnp.float32, 100.0, 1e-4)],
)
def test_kept_states_make_up_for_what_damping_forgets(dtype, eta, tolerance):
    """Over some e-folds of damping."""
    inputs = lambda dtype: (jnp.array([1.0, 0.3], dtype), jnp.asarray(eta / 100, dtype))
    found = damping_gradient(REVERSIBLE, inputs(dtype))
    assert all(x.dtype == dtype for x in jtu.tree_leaves(found))
    assert_close(found, damping_gradient(FIXED_STEP, inputs(jnp.float64)), tolerance)


@pytest.mark.variants(1)
@pytest.mark.parametrize("adjoint", [REVERSIBLE, FIXED_STEP])
def test_members_of_a_batch_keep_what_each_needs(adjoint):
    """One of few steps with strong friction, beside one of many."""

    def loss(gamma, t1):
        saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5) * t1)
        start = jnp.array([1.0, 0.3]), jnp.zeros(2)
        sol: Any = dfx.diffeqsolve(
            *(pendulum(gamma), dps.TunedRKN6(), 0.0, t1, 0.4, start),
            saveat=saveat,
            adjoint=adjoint,
            max_steps=400,
        )
        return sum(jnp.sum(y**2) for y in sol.ys)

    gammas, ends = jnp.array([9.0, 0.01, 0.5]), jnp.array([8.0, 150.0, 60.0])
    slope = jax.grad(loss)
    alone = jnp.stack(list(map(slope, gammas, ends)))
    assert_close(jax.vmap(slope)(gammas, ends), alone, 1e-9)


def with_gaps(system, solver, t1, dt0, q0, **options) -> Any:
    """A solve from rest by constant steps, or by steps that vary if none is given."""
    density = lambda t, y, args: 1 / (1 + y[0] @ y[0])
    control = dps.StepDensityController(0.2, density)
    return dfx.diffeqsolve(
        *(system, solver, 0.0, t1, dt0, (q0, 0 * q0)),
        stepsize_controller=dfx.ConstantStepSize() if dt0 else control,
        **options,
    )


def squares(rows):
    return jnp.sum(jnp.where(jnp.isfinite(rows), rows, 0) ** 2)


@pytest.mark.variants(1)
@pytest.mark.parametrize("adjoint", [REVERSIBLE, FIXED_STEP])
@pytest.mark.parametrize(
    "varies, steps, max_steps", [(False, 0, 5), (False, 3, 40), (True, 0, 5)]
)
def test_gaps_after_the_end(adjoint, varies, steps, max_steps):
    """Of measured times: their rows come after those that are not reached."""

    def value(q0, ts):
        saveat = dfx.SaveAt(ts=ts, steps=steps)
        options: Any = {"max_steps": max_steps, "adjoint": adjoint, "throw": False}
        at = pendulum(5.0), dps.TunedRKN6(), 5.0, None if varies else 0.3, q0
        return squares(with_gaps(*at, saveat=saveat, **options).ys[0])

    slope, q0, ts = jax.grad(value), jnp.ones(1), jnp.array([0.4, 1.0, 3.0])
    with_gap = slope(q0, jnp.append(ts, jnp.nan))
    assert_close(with_gap, slope(q0, ts), 1e-12)


@pytest.mark.parametrize("adjoint", [REVERSIBLE, FIXED_STEP])
@pytest.mark.parametrize("varies", [False, True])
def test_gaps_in_what_is_a_function_of_time(adjoint, varies):
    energy = lambda t, y, args: jnp.sin(t) * (jnp.sum(y[0] ** 2) + jnp.sum(y[1]))

    def value(q0, ts):
        saveat = dfx.SaveAt(ts=ts, fn=energy)
        at = pendulum(0.1), LEAPFROG, 2.0, None if varies else 0.1, q0
        sol = with_gaps(*at, saveat=saveat, max_steps=60, adjoint=adjoint)
        return squares(sol.ys)

    slope, q0, ts = jax.grad(value), jnp.ones(1), jnp.array([0.4, jnp.nan, 1.0, 1.7])
    assert_close(slope(q0, ts), slope(q0, ts[jnp.array([0, 2, 3])]), 1e-12)


# States that cannot be recomputed.

# States of the last three rates cannot be recomputed between 8 of 1000 kept ones.
RATES = jnp.concatenate([jnp.linspace(0.0, 5.0, 61), jnp.array([1e3, 3e3, 1e4])])


def _damped(gamma, adjoint, throw=True):
    sol = dfx.diffeqsolve(
        *(pendulum(gamma), dps.TunedRKN6(), 0.0, 2.0, 2e-3),
        (jnp.asarray(1.5), jnp.asarray(0.3)),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 7)),
        adjoint=adjoint,
        max_steps=1000,
        throw=throw,
    )
    assert sol.ys is not None
    return jnp.sum(sol.ys[0] ** 2)


FEW = dps.FixedStepAdjoint(checkpoints=8)


def test_a_gradient_that_is_lost_is_that_of_one_member_of_a_batch():
    slopes = jax.jit(jax.vmap(jax.grad(lambda gamma: _damped(gamma, FEW))))(RATES)
    assert jnp.all(jnp.isnan(slopes[-3:]))
    alone = jax.jit(jax.grad(lambda gamma: _damped(gamma, FEW)))
    exact = jax.vmap(jax.grad(lambda gamma: _damped(gamma, FIXED_STEP)))(RATES)
    some = np.arange(0, 61, 12)
    np.testing.assert_allclose(slopes[some], [alone(x) for x in RATES[some]], rtol=1e-9)
    np.testing.assert_allclose(slopes[:-3], exact[:-3], rtol=1e-8)
    # Nothing is inverted between as many kept states as steps.
    every = dps.FixedStepAdjoint(checkpoints=999)
    kept = jax.grad(lambda gamma: _damped(gamma, every))(RATES[-1])
    np.testing.assert_allclose(kept, exact[-1], rtol=1e-12)


KEPT = [(400, {"checkpoints": 400}), (400, {"checkpoints": 200}), (100, {})]


@pytest.mark.parametrize("steps, adjoint", KEPT)
def test_as_many_kept_states_as_wanted(steps, adjoint):
    """Friction is strong in the first steps alone, of which few can be recomputed."""

    def loss(q0, adjoint):
        potential = lambda t, q, args: q @ q / 2
        friction = dps.LogDamping(20.0)
        sol = dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction),
            *(dps.PresymplecticLeapfrog(), 1.0, 1.0 + steps, 1.0, (q0, 0 * q0)),
            adjoint=adjoint,
            max_steps=steps,
        )
        return jnp.sum(sol.ys[0])

    slope = jax.grad(loss)(jnp.ones(2), dps.FixedStepAdjoint(**adjoint))
    exact = jax.grad(loss)(jnp.ones(2), dfx.RecursiveCheckpointAdjoint())
    np.testing.assert_allclose(slope, exact, rtol=1e-10)


def test_a_gradient_that_is_lost_is_an_error_or_not_a_number():
    slope = lambda adjoint, **options: jax.grad(
        lambda gamma: _damped(gamma, adjoint, **options)
    )
    with pytest.raises(Exception, match="with an error beyond"):
        jax.block_until_ready(slope(FEW)(RATES[-1]))
    assert jnp.isnan(slope(FEW, throw=False)(RATES[-1]))
    never = dps.FixedStepAdjoint(checkpoints=8, throw=False)
    assert jnp.isnan(slope(never)(RATES[-1]))
    always = dps.FixedStepAdjoint(checkpoints=8, throw=True)
    with pytest.raises(Exception, match="with an error beyond"):
        jax.block_until_ready(jax.vmap(slope(always, throw=False))(RATES[-2:]))


def test_the_branch_of_a_batch_that_is_not_taken():
    """JAX differentiates it at zeros, of which no state can be recomputed."""

    def end(k, adjoint):
        y0, args = (jnp.ones(1), jnp.zeros(1)), (0.0, 1.0, 0.1)
        sol = dfx.diffeqsolve(pendulum(k), LEAPFROG, *args, y0, adjoint=adjoint)
        return jnp.sum(sol.ys[0])

    def value(deep, k, adjoint):
        branch = lambda factor: lambda k: end(factor * k, adjoint)
        return jax.lax.cond(deep, branch(1.0), branch(2.0), k)

    slopes = jax.vmap(jax.grad(value, argnums=1), (0, None, None))
    both = slopes(jnp.array([True, False]), 1.3, REVERSIBLE)
    for deep, slope in zip((True, False), both, strict=True):
        exact = jax.grad(value, argnums=1)(deep, 1.3, CHECKPOINTED)
        np.testing.assert_allclose(slope, exact, rtol=1e-12)


def test_an_equation_of_one_member_that_has_no_solution():
    """The linear solve of the derivative of a root finder ends no other member."""
    newton = optx.Newton(rtol=1e-10, atol=1e-10)

    def loss(gamma):
        sol = dfx.diffeqsolve(
            pendulum(gamma),
            *(dps.PresymplecticGauss(1, newton), 0.0, 1.0, 0.1),
            (jnp.asarray(1.5), jnp.asarray(0.0)),
            adjoint=REVERSIBLE,
            throw=False,
        )
        assert sol.ys is not None
        return jnp.sum(sol.ys[0])

    good, bad = jax.vmap(jax.grad(loss))(jnp.array([0.2, jnp.nan]))
    np.testing.assert_allclose(good, jax.grad(loss)(0.2), rtol=1e-9)
    assert jnp.isnan(bad)


def test_the_last_saved_time_where_steps_are_short():
    # In a batch the last row computes a step too, which must not be one second long.
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: 1e18 * jnp.sum(q**4)
    )
    ts = jnp.linspace(0.0, 1e-8, 8)

    def saved(q):
        y0 = q[None], jnp.zeros(1)
        options = {"saveat": dfx.SaveAt(ts=ts), "adjoint": dps.FixedStepAdjoint()}
        solver = dps.BlanesMoanRKN4()
        sol = dfx.diffeqsolve(system, solver, 0.0, 1e-8, 1e-10, y0, **options)
        assert sol.ys is not None
        return jnp.sum(sol.ys[0])

    gradient = jax.vmap(jax.grad(saved))(jnp.array([0.5, 1.0]))
    assert jnp.all(jnp.isfinite(gradient))


@pytest.mark.parametrize("adjoint", [REVERSIBLE, FIXED_STEP], ids=str)
@pytest.mark.parametrize("varies", [False, True])
def test_a_member_that_failed_and_is_not_used_adds_nothing(adjoint, varies):
    """To the gradient by a parameter that members share, alone and in a batch."""

    def loss(k, gamma):
        potential = lambda t, q, args: -k * jnp.sum(jnp.cos(q))
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(), potential, dps.ConstantDamping(gamma)
        )
        options: Any = dict(throw=False, max_steps=64, adjoint=adjoint)
        if varies:
            density = lambda t, y, args: 1 / (1 + jnp.sum(y[1] ** 2))
            options["stepsize_controller"] = dps.StepDensityController(0.5, density)
        sol: Any = dfx.diffeqsolve(
            *(system, dps.TunedRKN6(), 0.0, 9.0, None if varies else 0.5),
            y0=(jnp.ones(1), k * jnp.ones(1)),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.7, 8.7, 9), t1=True),
            **options,
        )
        good = sol.result == dfx.RESULTS.successful
        q = jnp.where(good, sol.ys[0], 0.0)
        return jnp.sum(q**2), good

    rates = jnp.array([0.1, -300.0, 0.3])
    slope = jax.jit(jax.grad(loss, has_aux=True))
    each = [slope(1.0, x) for x in rates]
    assert [bool(good) for _, good in each] == [True, False, True]
    assert each[1][0] == 0.0
    total = lambda k: jnp.sum(jax.vmap(loss, (None, 0))(k, rates)[0])
    found = jax.jit(jax.grad(total))(1.0)
    np.testing.assert_allclose(found, sum(x for x, _ in each), 1e-9)


def test_few_large_states_are_kept_by_default():
    def loss(q):
        start = q, jnp.zeros_like(q)
        sol: Any = dfx.diffeqsolve(
            *(pendulum(0.1), LEAPFROG, 0.0, 1.0, 0.1, start),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        )
        return jnp.sum(sol.ys[0])

    def states(n):
        q = jax.ShapeDtypeStruct((n,), float)
        memory: Any = jax.jit(jax.grad(loss)).lower(q).compile().memory_analysis()
        return memory.temp_size_in_bytes / (16 * n)

    assert states(10**6) < 40 and states(10**3) > 128
