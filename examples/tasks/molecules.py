"""A hundred molecules in a periodic box, and their relaxation to a minimum."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

BOX, CUTOFF = 12.0, 2.5


def lennard_jones(t, r, args):
    s = jnp.clip(r / CUTOFF, 0.0, 1.0)
    return 4 * (r**-12 - r**-6) * (1 - s**2) ** 4


potential = dps.pairwise_potential(lennard_jones, box=BOX)
grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), -1).reshape(100, 2)
rng = np.random.default_rng(0)
q0 = 1.2 * grid + 0.03 * rng.normal(size=(100, 2))
v0 = 0.3 * rng.normal(size=(100, 2))
system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.BlanesMoanRKN6(), 0.0, 1.0, dt0),
        (jnp.asarray(q0), jnp.asarray(v0)),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 1.0, rtol=1e-7, atol=1e-7)
q, v = (np.asarray(y[-1]) for y in solve(step.dt0).ys)


def force(q):
    d = q[:, None] - q[None]
    d -= BOX * np.round(d / BOX)
    r = np.linalg.norm(d, axis=-1) + 10 * CUTOFF * np.eye(len(q))
    s = np.minimum(r / CUTOFF, 1)
    switch, slope = (1 - s**2) ** 4, -8 * s * (1 - s**2) ** 3 / CUTOFF
    well = 4 * (r**-12 - r**-6)
    pull = 4 * (-12 * r**-13 + 6 * r**-7) * switch + well * slope
    return -np.sum((pull / r)[..., None] * d, axis=1)


def field(t, y):
    q, v = y.reshape(2, 100, 2)
    return np.concatenate([v, force(q)]).ravel()


start = np.concatenate([q0, v0]).ravel()
exact = solve_ivp(field, (0, 1), start, "DOP853", rtol=1e-12, atol=1e-12)
error = np.max(np.abs(q - exact.y[:, -1].reshape(2, 100, 2)[0]))
print(f"{step.steps} steps, largest error {error:.1e}")
assert error < 1e-6

damped = dps.MechanicalSystem(
    dps.QuadraticKinetic(), potential, friction=dps.ConstantDamping(1.0)
)
rest: Any = dfx.diffeqsolve(
    *(damped, dps.PresymplecticLeapfrog(), 0.0, 200.0, 0.03, (jnp.asarray(q), 0 * q)),
    adjoint=dps.FixedStepAdjoint(),
    max_steps=None,
)
left = np.max(np.abs(force(np.asarray(rest.ys[0][-1]))))
print(f"at rest the largest force is {left:.1e}")
assert left < 1e-3
