"""A spherical pendulum in Cartesian coordinates: the tension of its rod as a force."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

gravity, rate = 9.81, 0.05


def tension(t, q, v, args):
    """The multiplier of |q| = 1, from its second derivative in time."""
    return -(v @ v - gravity * q[2]) / (q @ q) * q


pendulum = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: gravity * q[2],
    friction=dps.ConstantDamping(rate),
    force=tension,
)
polar, azimuth, v0 = 2.0, 0.0, 1.5  # from upright; the velocity is horizontal
q0 = jnp.array([jnp.sin(polar), 0.0, jnp.cos(polar)])
y0 = q0, jnp.array([0.0, v0, 0.0])
ts = jnp.linspace(0.0, 20.0, 101)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(pendulum, dps.PresymplecticGauss(4), 0.0, 20.0, dt0, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 20.0, rtol=1e-9, atol=1e-9)
q, p = solve(step.dt0).ys


def field(t, y):
    polar, _, w, u = y
    sin, cos = np.sin(polar), np.cos(polar)
    acceleration = sin * cos * u**2 + gravity * sin - rate * w
    return [w, u, acceleration, -2 * cos / sin * w * u - rate * u]


start = [polar, azimuth, 0.0, v0 / np.sin(polar)]
angles = solve_ivp(field, (0, 20), start, "DOP853", ts, rtol=1e-13, atol=1e-13).y
sin = np.sin(angles[0])
exact = np.stack([sin * np.cos(angles[1]), sin * np.sin(angles[1]), np.cos(angles[0])])
error = np.max(np.abs(q - exact.T))
length = np.max(np.abs(np.linalg.norm(q, axis=1) - 1))
print(f"{step.steps} steps, largest error {error:.1e}, length {length:.1e}")
assert error < 2e-9 and length < 1e-9
