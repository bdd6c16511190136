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


def test_fields_of_friction_at_a_place_may_be_numbers():
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
