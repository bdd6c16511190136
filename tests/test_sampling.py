"""A gradient of each member of a batch, for samplers that start anywhere in a prior."""

from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps


TS = jnp.linspace(0.5, 20.0, 60)


@partial(jax.jit, static_argnums=1)
@partial(jax.vmap, in_axes=(0, None))
def density(logs, adjoint):
    """Value and gradient of the log density of a damped pendulum measured at `TS`."""

    def value(logs):
        gamma, k = jnp.exp(logs)
        energy = dps.QuadraticKinetic(), lambda t, q, args: -k * jnp.cos(q)
        sol = dfx.diffeqsolve(
            dps.MechanicalSystem(*energy, dps.ConstantDamping(gamma)),
            *(dps.TunedRKN6(), 0.0, 20.0, 0.5, (jnp.asarray(1.5), jnp.asarray(0.0))),
            saveat=dfx.SaveAt(ts=TS),
            adjoint=adjoint,
            max_steps=40,
            throw=False,
        )
        assert sol.ys is not None
        misfit = jnp.sum((sol.ys[0] - 1.5 * jnp.exp(-TS / 7) * jnp.cos(TS)) ** 2)
        good = sol.result == dfx.RESULTS.successful
        return jnp.where(good, -50 * misfit - logs @ logs / 8, -jnp.inf)

    return jax.value_and_grad(value)(logs)


def test_draws_of_a_broad_prior():
    rng = np.random.default_rng(0)
    gamma = np.append(np.exp(rng.uniform(np.log(0.01), np.log(50), 62)), [50, 1e9])
    logs = jnp.log(jnp.stack([gamma, np.exp(rng.uniform(-0.5, 1.5, 64))], -1))
    value, slope = density(logs, dps.FixedStepAdjoint())
    by_steps = density(logs, dps.FixedStepAdjoint("checkpoints"))
    np.testing.assert_allclose(value, by_steps[0], rtol=1e-12)
    np.testing.assert_allclose(slope[:-1], by_steps[1][:-1], rtol=1e-8)
    # Damping that no step resolves is impossible, for that draw alone.
    assert np.all(np.isfinite(value[:-1])) and value[-1] == -np.inf
