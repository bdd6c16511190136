"""Many small operations as one function of the compiled program."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._scheme._engine import cheap_iterations


_T = TypeVar("_T")


def as_one_function(compute: Callable[[], _T]) -> _T:
    """What `compute` returns; on a CPU computed in a loop of one iteration.

    XLA compiles a loop to one function there, but calls the operations around it one by
    one, by two threads if any has more than 512 bytes. That took as long as a solve of
    a small system.
    """
    if not cheap_iterations():
        return compute()
    compute = eqx.filter_closure_convert(compute)  # traced once
    like = eqx.filter_eval_shape(compute)
    arrays, rest = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    start = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), arrays)
    # XLA would remove a loop that it knows to be of one iteration.
    first = lax.optimization_barrier(jnp.asarray(True))
    once = lambda x: (jnp.asarray(False), eqx.filter(compute(), eqx.is_array))
    _, arrays = lax.while_loop(lambda x: x[0], once, (first, start))
    return eqx.combine(arrays, rest)
