"""A charge in a magnetic field B(q) that grows with the distance from the axis."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)


def coefficients(t, q, args):
    """The matrix C of the force -C v = v x B, with B = (0, 0, 1 + q.q / 4)."""
    b = 1 + q @ q / 4
    return b * jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


system = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: q @ q / 4,
    friction=dps.ViscousDamping(coefficients),
)
y0 = jnp.array([1.0, 0.0, 0.2]), jnp.array([0.0, 0.8, 0.1])
ts = jnp.linspace(0.0, 40.0, 101)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.BlanesMoan6(), 0.0, 40.0, dt0, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 40.0, rtol=1e-7, atol=1e-7)
sol = solve(step.dt0)


def field(t, y):
    q, v = np.split(y, 2)
    force = np.cross(v, np.array([0.0, 0.0, 1 + q @ q / 4]))
    return np.concatenate([v, force - q / 2])


start = np.concatenate(y0)
exact = solve_ivp(field, (0, 40), start, "DOP853", ts, rtol=1e-13, atol=1e-13).y.T
error = np.max(np.abs(np.hstack(sol.ys) - exact))
energy = dps.diagnostics.energy(system, sol.ts, sol.ys)
drift = jnp.max(jnp.abs(energy - energy[0]))
print(f"{step.steps} steps, largest error {error:.1e}, energy kept to {drift:.1e}")
assert error < 1e-7 and drift < 1e-7
