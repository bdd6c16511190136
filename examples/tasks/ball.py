"""A ball in the wind, with quadratic drag, which bounces five times."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

mass, drag, gravity, restitution = 0.058, 1e-3, 9.81, 0.8
wind = np.array([6.0, 0.0])
system = dps.MechanicalSystem(
    dps.QuadraticKinetic(mass),
    lambda t, q, args: mass * gravity * q[1],
    friction=dps.Drag(drag, medium=wind),
)
landing = dfx.Event(
    lambda t, y, args, **kwargs: y[0][1],
    root_finder=optx.Newton(rtol=1e-12, atol=1e-12),
    direction=False,
)


@jax.jit
def bounces(dt0):
    def flight(start, _):
        t, (q, v) = start
        sol: Any = dfx.diffeqsolve(
            *(system, dps.BlanesMoan4(), t, t + 10.0, dt0),
            system.from_velocity(t, (q, v)),
            event=landing,
            max_steps=1000,
        )
        landed = sol.result == dfx.RESULTS.event_occurred
        (t,), y = sol.ts, jax.tree.map(lambda y: y[-1], sol.ys)
        q, v = system.to_velocity(t, y)
        start = t, (q.at[1].set(0.0), v * jnp.array([1.0, -restitution]))
        return start, (t, q[0], landed)

    y0 = jnp.array([0.0, 2.0]), jnp.array([3.0, 0.0])
    return jax.lax.scan(flight, (jnp.array(0.0), y0), length=5)[1]


times, places, landed = bounces(0.02)
assert jnp.all(landed)


def field(t, y):
    relative = y[2:] - wind
    force = -drag * np.linalg.norm(relative) * relative
    return np.concatenate([y[2:], force / mass - [0.0, gravity]])


def hit(t, y):
    return y[1]


hit.terminal, hit.direction = True, -1  # pyright: ignore
t, y, exact = 0.0, np.array([0.0, 2.0, 3.0, 0.0]), []
for _ in range(5):
    flight = solve_ivp(
        field, (t, t + 10), y, "DOP853", events=hit, rtol=1e-12, atol=1e-12
    )
    t, y = flight.t_events[0][0], flight.y_events[0][0]
    exact.append((t, y[0]))
    y = np.array([y[0], 0.0, y[2], -restitution * y[3]])
error = np.max(np.abs(np.stack([times, places], 1) - exact))
print("lands at", np.round(np.asarray(times), 3), f"s, largest error {error:.1e}")
assert error < 1e-7
