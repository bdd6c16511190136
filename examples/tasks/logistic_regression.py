"""Logistic regression by leapfrog with friction, beside optax."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.optimize import minimize

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

rng = np.random.default_rng(0)
x = rng.normal(size=(500, 20)) * np.logspace(0, -1, 20)
labels = (x @ rng.normal(size=20) + 0.5 * rng.normal(size=500) > 0).astype(float)


def loss(w, _=None):
    logits = x @ w
    errors = optax.sigmoid_binary_cross_entropy(logits, labels)
    return jnp.mean(errors) + 1e-3 * w @ w


learning_rate, momentum, updates = 4.0, 0.95, 400
h = learning_rate**0.5
system = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, w, args: loss(w),
    friction=dps.ConstantDamping(-np.log(momentum) / h),
)


def by_scheme(solver):
    def update(y, _):
        y, *_ = solver.step(system, 0.0, h, y, None, None, made_jump=False)
        return y, loss(y[0])

    return update, (jnp.zeros(20), jnp.zeros(20))


def by_optax(optimiser):
    def update(y, _):
        w, state = y
        changes, state = optimiser.update(jax.grad(loss)(w), state)
        w = optax.apply_updates(w, changes)
        return (w, state), loss(w)

    return update, (jnp.zeros(20), optimiser.init(jnp.zeros(20)))


runs = {
    "optax.sgd": by_optax(optax.sgd(learning_rate, momentum)),
    "optax.sgd, Nesterov": by_optax(optax.sgd(learning_rate, momentum, nesterov=True)),
    "Euler": by_scheme(dps.PresymplecticEuler()),
    "leapfrog": by_scheme(dps.PresymplecticLeapfrog(first="position")),
}


def slow_loss(w):
    z = x @ w
    return np.mean(np.logaddexp(0, z) - labels * z) + 1e-3 * w @ w


best = minimize(slow_loss, np.zeros(20), method="BFGS", tol=1e-9).fun
losses = {}
for name, (update, start) in runs.items():
    (w, _), losses[name] = jax.lax.scan(update, start, length=updates)
    print(f"{name:20}loss {losses[name][-1] - best:.1e} above the minimum")
    assert losses[name][-1] - best < 1e-5
# Euler's scheme is gradient descent with momentum.
assert np.allclose(losses["Euler"], losses["optax.sgd"], rtol=1e-9)
