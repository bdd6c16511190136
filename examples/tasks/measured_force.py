"""A force from a measured table, linear between its times."""

from itertools import pairwise

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

rng = np.random.default_rng(3)
times = np.concatenate([[0.0], np.sort(rng.uniform(0.0, 20.0, 60)), [20.0]])
forces = rng.normal(size=62)


def force(t, q, args):
    return -jnp.sin(q) + jnp.interp(t, times, forces)


system = dps.MechanicalSystem(
    dps.QuadraticKinetic(), dps.ForceField(force), friction=dps.ConstantDamping(0.2)
)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 20.0, dt0, (jnp.ones(1), jnp.zeros(1))),
        stepsize_controller=dps.StepsBetween(times),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 20.0, rtol=1e-9, atol=1e-9)
found = np.concatenate(solve(step.dt0).ys)[:, 0]


def field(t, y):
    return [y[1], -np.sin(y[0]) + np.interp(t, times, forces) - 0.2 * y[1]]


y = [1.0, 0.0]
for a, b in pairwise(times):
    y = solve_ivp(field, (a, b), y, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
error = np.max(np.abs(found - y))
print(f"{step.steps} steps, error {error:.1e}")
assert np.all(np.abs(found - y) < 1e-9 * (1 + np.abs(y)))
