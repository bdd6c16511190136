"""A thousand pendulums until each is down, with a progress meter."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

system = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    friction=dps.ConstantDamping(0.2),
)
down = dfx.Event(
    lambda t, y, args, **kwargs: y[0][0],
    root_finder=optx.Newton(rtol=1e-10, atol=1e-10),
    direction=False,
)
angles = np.linspace(0.1, 3.1, 1000)


def fall(angle, dt0):
    y0 = angle[None], jnp.zeros(1)
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 20.0, dt0, y0),
        event=down,
        progress_meter=dfx.TqdmProgressMeter(),
        max_steps=2000,
    )


last = jax.jit(lambda dt0: fall(angles[-1], dt0))
step = dps.choose_step(last, 0.0, 20.0, rtol=1e-8, atol=1e-8)
sol = jax.jit(jax.vmap(fall, in_axes=(0, None)))(jnp.asarray(angles), step.dt0)
times, speeds = sol.ts[:, 0], sol.ys[1][:, 0, 0]
assert jnp.all(sol.result == dfx.RESULTS.event_occurred)


def hit(t, y):
    return y[0]


hit.terminal = True  # pyright: ignore
for i in (0, 333, 999):
    field = lambda t, y: [y[1], -np.sin(y[0]) - 0.2 * y[1]]
    exact = solve_ivp(
        field, (0, 20), [angles[i], 0], "DOP853", events=hit, rtol=1e-12, atol=1e-12
    )
    t, (_, v) = exact.t_events[0][0], exact.y_events[0][0]
    error = max(abs(times[i] - t), abs(speeds[i] - v))
    print(f"from {angles[i]:.2f}: down at {times[i]:.6f}, errors {error:.1e}")
    assert error < 1e-7
