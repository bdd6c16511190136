"""Laws, splits and moves of the user; the catalogue combines them with the rest."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import own
import pytest

import diffrax_presym as dps


@pytest.mark.parametrize("gradient", [None, "reversal", "checkpoints"])
def test_arrays_that_a_move_holds_are_differentiated(gradient):
    """Against the same recursion in NumPy, differentiated by differences."""
    spring = lambda t, q, args: args * jnp.sum(q**2) / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), spring)
    adjoint = dps.FixedStepAdjoint(gradient)
    if gradient is None:
        adjoint = dfx.RecursiveCheckpointAdjoint()

    def end(k):
        y0 = jnp.ones(1), jnp.zeros(1)
        sol = dfx.diffeqsolve(
            *(system, own.SpringLeapfrog(), 0.0, 2.0, 0.125, y0, k),
            adjoint=adjoint,
            max_steps=16,
        )
        assert sol.ys is not None
        return sol.ys[0][0, 0]

    def by_hand(k, q=1.0, p=0.0, h=0.125):
        for _ in range(16):
            q = q + h / 2 * p
            p = p - h * k * q
            q = q + h / 2 * p
        return q

    slope = (by_hand(1.3 + 1e-6) - by_hand(1.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(end)(jnp.asarray(1.3)), slope, rtol=1e-8)


@pytest.mark.variants(3)
@pytest.mark.parametrize("adjoint", ["reversal", "checkpoints", "forward", None])
@pytest.mark.parametrize("solver", [dps.Strang(), dps.Suzuki4(dps.Strang())])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_fields_of_friction_at_a_place_may_be_numbers(solver, adjoint, dtype):
    """Values and derivatives are those with an array in their place."""
    ts, forwards = jnp.linspace(0.13, 0.93, 5, dtype=dtype), adjoint == "forward"
    if adjoint is None:
        adjoint = dfx.RecursiveCheckpointAdjoint()
    else:
        adjoint = dps.FixedStepAdjoint(adjoint)

    def saved(c, speed):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(), lambda t, q, args: q[0], own.CubicDrag(c)
        )
        y0, saveat = (jnp.zeros_like(speed), speed), dfx.SaveAt(ts=ts, t1=True)
        t0, t1, dt0 = (jnp.asarray(x, dtype) for x in (0, 1, 0.1))
        return dfx.diffeqsolve(
            *(system, solver, t0, t1, dt0, y0), saveat=saveat, adjoint=adjoint
        ).ys

    speed = jnp.asarray([1.0, -0.5], dtype)
    differentiate = jax.jacfwd if forwards else jax.jacrev
    number, array = saved(0.3, speed), saved(jnp.asarray(0.3, dtype), speed)
    d_number = jax.jit(differentiate(lambda v: saved(0.3, v)))(speed)
    d_array = jax.jit(differentiate(saved, 1))(jnp.asarray(0.3, dtype), speed)
    pair = (number, d_number), (array, d_array)
    for x, y in zip(*map(jax.tree.leaves, pair), strict=True):
        assert x.dtype == y.dtype == dtype
        np.testing.assert_allclose(x, y, rtol=0, atol=20 * jnp.finfo(dtype).eps)


def test_a_law_with_numbers_in_both_loops():
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: q[0], own.CubicDrag(0.3)
    )
    ends = [
        dfx.diffeqsolve(
            *(system, dps.Strang(), 0.0, 1.0, 0.1, (jnp.zeros(2), jnp.ones(2))),
            adjoint=adjoint,
        ).ys
        for adjoint in (dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint())
    ]
    for x, y in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14)
