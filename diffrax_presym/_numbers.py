"""Times, numbers and states, each in its own precision."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact, PyTree, Real


Time = Real[ArrayLike, ""]
Scalar = Inexact[Array, ""]
# A state: positions and momenta.
State = tuple[PyTree[Inexact[Array, "..."]], PyTree[Inexact[Array, "..."]]]


def cast_to(x: ArrayLike, like: ArrayLike) -> Array:
    """`x` in the precision of `like`: a parameter never upcasts time or state.

    An integer, such as a time of `10`, does not truncate it.
    """
    dtype = jnp.result_type(like)
    return jnp.asarray(x, dtype if jnp.issubdtype(dtype, jnp.inexact) else None)


def rounding_of(t0: Array, t: Array, length: Array) -> Array:
    """By how much the end of a step may differ from the same time computed otherwise,
    in a solve that begins at `t0`."""
    largest = jnp.maximum(jnp.abs(t0), jnp.abs(t))
    return jnp.minimum(4 * float(jnp.finfo(t.dtype).eps) * largest, length / 64)


def as_time(t: ArrayLike) -> Array:
    """A time as a floating-point array."""
    if jnp.issubdtype(jnp.result_type(t), jnp.inexact):
        return jnp.asarray(t)
    return jnp.asarray(t, jnp.result_type(float))
