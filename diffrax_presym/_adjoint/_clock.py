from collections.abc import Callable

import diffrax as dfx
import jax.numpy as jnp
from jaxtyping import Array


def clock(controller, t0: Array, t1: Array, dt0: Array) -> Callable[[Array], Array]:
    """The start of step `n`, as computed by the step size controllers of Diffrax."""
    if isinstance(controller, dfx.StepTo):
        return lambda n: controller.ts[n]
    up, down = (jnp.asarray(sign * jnp.inf, t0.dtype) for sign in (1, -1))
    steps = jnp.ceil((t1 - t0) / jnp.nextafter(dt0, up))
    almost = t1
    for _ in range(100):
        almost = jnp.nextafter(almost, down)

    def time(n):
        t = t0 + (t1 - t0) * (n.astype(t0.dtype) / steps)
        t = jnp.where((n >= steps) | (t > almost), t1, t)
        # Only the first step has the length `dt0`.
        return jnp.where(n == 1, jnp.minimum(t0 + dt0, t1), t)

    return time
