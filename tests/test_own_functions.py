"""Parts of a solve that are compiled as functions of their own, as large ones are."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import pytest
from helpers import assert_close, pendulum

import diffrax_presym as dps
from diffrax_presym._loop import _one_function


FIXED = dfx.ConstantStepSize()
VARIABLE = dps.StepDensityController(0.1, lambda t, y, args: 1 + jnp.sum(y[0] ** 2))
# The rate of friction, the first step, how steps are chosen, and the gradient.
CASES = {
    "weak friction": (0.1, 0.1, FIXED, "reversal"),
    "weak friction, checkpoints": (0.1, 0.1, FIXED, "checkpoints"),
    "shorter steps": (20.0, 0.1, FIXED, "reversal"),
    "few steps": (0.1, 2.0, FIXED, "reversal"),
    "steps that vary": (0.1, None, VARIABLE, "reversal"),
}
ALWAYS, NEVER = 0, 2**30


def gradient(case):
    """Of a sum of squares of what is saved, by the friction and the state, and the
    compiled program that computes it."""
    rate, h, controller, adjoint = CASES[case]

    def loss(rate, q):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(), pendulum, dps.ConstantDamping(rate)
        )
        options: Any = dict(max_steps=200, adjoint=dps.FixedStepAdjoint(adjoint))
        saveat = dfx.SaveAt(ts=jnp.linspace(0.3, 5.1, 11), t1=True)
        sol = dfx.diffeqsolve(
            *(system, dps.Strang(), 0.0, 5.2, h, (q, jnp.ones(2))),
            stepsize_controller=controller,
            saveat=saveat,
            **options,
        )
        return sum(jnp.sum(y**2) for y in jtu.tree_leaves(sol.ys))

    # One member of the batch would be that of a single solve.
    at = jnp.array([rate, rate / 2]), jnp.array([[1.0, 0.2], [0.3, 2.0]])
    one = jax.jit(jax.grad(loss, (0, 1))).lower(at[0][0], at[1][0]).compile()
    batch = jax.jit(jax.vmap(jax.grad(loss, (0, 1))))(*at)
    return one(at[0][0], at[1][0]), batch, str(one.as_text())


@pytest.mark.parametrize("case", CASES)
def test_gradient_is_the_same(monkeypatch, case):
    found = []
    for least in ALWAYS, NEVER:
        monkeypatch.setattr(_one_function, "_MANY", least)
        jax.clear_caches()
        *values, program = gradient(case)
        found.append((values, program.count("xla_cpu_small_call")))
    jax.clear_caches()
    (apart, parts), (together, whole) = found
    assert_close(apart, together, 1e-12)
    assert jnp.all(jnp.isfinite(jnp.concatenate(jtu.tree_leaves(apart), axis=None)))
    if whole:  # On JAX whose XLA makes functions of loops.
        assert parts > whole
