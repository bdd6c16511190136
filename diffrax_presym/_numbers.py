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


def as_time(t: ArrayLike) -> Array:
    """A time as a floating-point array."""
    if jnp.issubdtype(jnp.result_type(t), jnp.inexact):
        return jnp.asarray(t)
    return jnp.asarray(t, jnp.result_type(float))
