"""The Sun, Jupiter and Saturn, and a test particle without mass between them."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

# Astronomical units, years and solar masses. The orbits begin circular.
G = 4 * np.pi**2
masses = np.array([1.0, 1 / 1047.3, 1 / 3497.9])
radii = np.array([0.0, 5.2, 9.58, 3.27])
angles = np.array([0.0, 0.0, 2.0, 4.0])
places = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
speeds = np.array([0.0, *np.sqrt(G / radii[1:])])
velocities = speeds[:, None] * np.stack([-np.sin(angles), np.cos(angles)], 1)


def acceleration(t, q, args):
    """Of all four bodies, by the three that have a mass."""
    difference = q[None, :3] - q[:, None]
    squares = jnp.sum(difference**2, -1)
    nearby = jnp.where(squares > 0, squares, 1.0)
    return G * jnp.sum((masses / nearby**1.5)[..., None] * difference, axis=1)


# `p` is the momentum per unit mass, so that none is divided by zero.
system = dps.MechanicalSystem(dps.QuadraticKinetic(), dps.ForceField(acceleration))
ts = jnp.linspace(0.0, 200.0, 21)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.SymmetricMultistep(10), 0.0, 200.0, dt0),
        (jnp.asarray(places), jnp.asarray(velocities)),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 200.0, rtol=1e-8, atol=1e-8)
q, v = (np.asarray(y) for y in solve(step.dt0).ys)


def field(t, y):
    q, v = y.reshape(2, 4, 2)
    a = np.zeros((4, 2))
    for i in range(4):
        for j in range(3):
            if i != j:
                r = q[j] - q[i]
                a[i] += G * masses[j] * r / np.linalg.norm(r) ** 3
    return np.concatenate([v, a]).ravel()


start = np.concatenate([places, velocities]).ravel()
exact = solve_ivp(field, (0, 200), start, "DOP853", ts, rtol=1e-13, atol=1e-13).y.T
error = np.max(np.abs(q - exact.reshape(-1, 2, 4, 2)[:, 0]))


def energy(q, v):
    """Of the three bodies with a mass."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    potential = sum(
        -G * masses[i] * masses[j] / np.linalg.norm(q[i] - q[j]) for i, j in pairs
    )
    return np.sum(masses[:, None] * v[:3] ** 2) / 2 + potential


first, last = energy(q[0], v[0]), energy(q[-1], v[-1])
print(f"{step.steps} steps, largest error {error:.1e} au in 200 years")
print(f"the energy changes by a fraction of {abs(last / first - 1):.1e}")
assert error < 1e-7 and abs(last / first - 1) < 1e-10
