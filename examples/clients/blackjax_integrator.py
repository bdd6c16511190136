"""A scheme of this package as an integrator of BlackJAX, compared with BlackJAX's own.

Needs `pip install blackjax`. Prints the differences of a step forwards and backwards,
and the standard deviations of a sample by NUTS.

    python examples/clients/blackjax_integrator.py
"""

# pyright: reportMissingImports=false

import blackjax
import jax
import jax.numpy as jnp
from blackjax.mcmc.integrators import IntegratorState, velocity_verlet
from blackjax.mcmc.metrics import default_metric

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)
solver = dps.PresymplecticLeapfrog("momentum")


def integrator(logdensity_fn, kinetic_energy_fn):
    kinetic = lambda t, p, args: kinetic_energy_fn(p)
    potential = lambda t, q, args: -logdensity_fn(q)
    system = dps.MechanicalSystem(kinetic, potential)

    def one_step(state, h):
        y = state.position, state.momentum
        start = solver.init(system, 0.0, h, y, None)
        q, p = solver.step(system, 0.0, h, y, None, start, made_jump=False)[0]
        return IntegratorState(q, p, *jax.value_and_grad(logdensity_fn)(q))

    return one_step


def log_density(q):
    return -jnp.sum((q / jnp.array([1.0, 0.5, 2.0])) ** 2) / 2


q, p = jnp.array([0.3, 0.2, -0.5]), jnp.array([1.0, -0.4, 0.2])
state = IntegratorState(q, p, *jax.value_and_grad(log_density)(q))
energy = default_metric(jnp.array([0.7, 1.0, 1.3])).kinetic_energy
for h in (0.3, -0.3):
    ours, theirs = (
        f(log_density, energy)(state, h) for f in (integrator, velocity_verlet)
    )
    error = max(float(jnp.abs(x - y).max()) for x, y in zip(ours, theirs, strict=True))
    print(f"h = {h}: difference {error:.0e}")
    assert error < 1e-14

nuts = blackjax.nuts(log_density, 0.4, jnp.ones(3), integrator=integrator)


@jax.jit
def sample(state, key):
    step = lambda state, key: (nuts.step(key, state)[0],) * 2
    return jax.lax.scan(step, state, jax.random.split(key, 5000))[1].position


deviations = sample(nuts.init(q), jax.random.key(0)).std(0)
print("standard deviations", deviations.round(2), "of 1, 0.5 and 2")
assert jnp.all(jnp.abs(deviations / jnp.array([1.0, 0.5, 2.0]) - 1) < 0.05)
