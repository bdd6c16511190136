"""Single precision, the default of JAX, to the tolerance that it allows."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


system = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    friction=dps.ConstantDamping(0.1),
)
y0 = jnp.array([2.0]), jnp.array([0.0])
ts = jnp.linspace(0.0, 30.0, 61)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 30.0, dt0, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 30.0, rtol=1e-5, atol=1e-5)
q, p = solve(step.dt0).ys
assert q.dtype == jnp.float32
field = lambda t, y: [y[1], -np.sin(y[0]) - 0.1 * y[1]]
exact = solve_ivp(field, (0, 30), [2.0, 0.0], "DOP853", ts, rtol=1e-12, atol=1e-12).y.T
error = np.max(np.abs(np.hstack([q, p]) - exact))
print(f"{step.steps} steps, largest error {error:.1e}")
assert error < 2e-5
