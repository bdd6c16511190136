"""Gradients of values between steps: where rows are not saved, and of second order."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_between_steps import GAUSS, RKN4, solve, Y0

import diffrax_presym as dps


@pytest.mark.parametrize("gradient", ["reversal", "checkpoints"])
def test_a_gradient_of_a_batch_with_a_member_that_fails(gradient):
    """The rows of a member that failed are not visited on the way back."""

    def loss(stiffness):
        well = lambda t, q, args: stiffness * jnp.sum(q**2) / 2
        law = dps.ConstantDamping(0.3)
        sol: Any = dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), well, law),
            *(GAUSS(4), 0.0, 4.0, 0.2, (jnp.ones(1), jnp.ones(1))),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 9)),
            adjoint=dps.FixedStepAdjoint(gradient),
            **{"throw": False, "max_steps": 20},
        )
        return jnp.sum(sol.ys[0] ** 2), sol.result == dfx.RESULTS.successful

    slope = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))
    got, successful = slope(jnp.array([1.0, 1e4, 1.2]))
    assert successful.tolist() == [True, False, True]
    for i, stiffness in ((0, 1.0), (2, 1.2)):
        alone, _ = jax.jit(jax.grad(loss, has_aux=True))(stiffness)
        assert got[i] == pytest.approx(float(alone), rel=1e-10)


@pytest.mark.parametrize("gamma", [0.02, 3.0])
def test_gradients_beside_a_gap_in_measured_times(gamma):
    """Also where values between steps are shorter steps, as with the second."""
    ts = np.array([0.3, 4.1, np.nan, 9.7, 15.2])

    def loss(x):
        saveat = dfx.SaveAt(ts=jnp.asarray(ts))
        sol: Any = solve(RKN4, 40, gamma=gamma, y0=(x, Y0[1]), saveat=saveat)
        return jnp.sum(jnp.where(jnp.isfinite(sol.ys[0]), sol.ys[0], 0) ** 2)

    got, h = jax.jit(jax.grad(loss))(Y0[0]), 1e-5
    for i, e in enumerate(h * jnp.eye(2)):
        difference = float(loss(Y0[0] + e) - loss(Y0[0] - e)) / (2 * h)
        assert got[i] == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("solver", [RKN4, dps.Strang()])
def test_hessian(solver):
    """Of which only derivatives are a batch, not the values."""

    def loss(x):
        sol: Any = solve(solver, 40, y0=(x, Y0[1]))
        return jnp.sum(sol.ys[0][:, 0] ** 2)

    slope, h = jax.jit(jax.grad(loss)), 1e-5
    rows = [(slope(Y0[0] + e) - slope(Y0[0] - e)) / (2 * h) for e in h * jnp.eye(2)]
    got = jax.jit(jax.hessian(loss))(Y0[0])
    assert np.asarray(got) == pytest.approx(np.stack(rows), rel=1e-5, abs=1e-6)
