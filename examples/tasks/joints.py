"""Two pendulums with springs and dashpots in their joints, at 300 irregular times, to
1e-8."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

masses = np.array([1.0, 0.5])
springs = np.array([[3.0, -1.0], [-1.0, 1.0]])
dashpots = np.array([[0.3, -0.1], [-0.1, 0.1]])
ts = np.sort(np.random.default_rng(0).uniform(0.0, 30.0, 300))
angles, velocities = np.array([0.8, -0.4]), np.array([0.0, 1.0])


def potential(t, q, args):
    return q @ springs @ q / 2 - 2 * jnp.cos(q[0]) - jnp.cos(q[1])


system = dps.MechanicalSystem(
    dps.QuadraticKinetic(masses), potential, friction=dps.ViscousDamping(dashpots)
)
y0 = system.from_velocity(0.0, (jnp.array(angles), jnp.array(velocities)))


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 30.0, dt0, y0),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts), fn=system.to_velocity),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 30.0, rtol=1e-8, atol=1e-8)
q, v = solve(step.dt0).ys


def field(t, y):
    q, v = np.split(y, 2)
    gravity = np.array([2.0, 1.0]) * np.sin(q)
    return np.concatenate([v, -(springs @ q + gravity + dashpots @ v) / masses])


start = np.concatenate([angles, velocities])
exact = solve_ivp(field, (0, 30), start, "DOP853", ts, rtol=1e-13, atol=1e-13).y.T
error = np.max(np.abs(np.hstack([q, v]) - exact) / (1 + np.abs(exact)))
print(f"{step.steps} steps, largest relative error at 300 times {error:.1e}")
assert error < 1e-8
