"""What is to be one function of the compiled program."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int

from .._scheme._engine import cheap_iterations


_T = TypeVar("_T")

# From so many operations on a function takes about a second to compile.
_MANY = 2000


def as_one_function(compute: Callable[[], _T]) -> _T:
    """What `compute` returns; on a CPU computed in a loop of one iteration.

    XLA compiles a loop to one function there, but calls the operations around it one by
    one, by two threads if any has more than 512 bytes. That took as long as a solve of
    a small system.
    """
    if not cheap_iterations():
        return compute()
    # XLA would remove a loop that it knows to be of one iteration.
    first = lax.optimization_barrier(jnp.asarray(True))
    return _in_a_loop(eqx.filter_closure_convert(compute), first)


def as_own_function(compute: Callable[[], _T], n: Int[Array, ""]) -> _T:
    """What `compute` returns, in iteration `n` of a loop: on a CPU, if it has many
    operations, computed in a function of its own and not in that of the loop.

    XLA takes longer per operation to compile a function, the more there are: of rigid
    bodies that are joined, gradients took minutes.
    """
    if not cheap_iterations():
        return compute()
    traced: Any = eqx.filter_closure_convert(compute)
    if _operations(traced.jaxpr) < _MANY:
        return traced()
    # XLA makes no function of a loop with a product of matrices.
    matrix = lax.optimization_barrier(jnp.full((4, 4), n.astype("float32")))
    square = jnp.dot(matrix, matrix)[0, 0]
    return _in_a_loop(traced, square >= 0)


def _in_a_loop(compute: Callable[[], _T], first: Array) -> _T:
    like = eqx.filter_eval_shape(compute)
    arrays, rest = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    start = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), arrays)
    once = lambda x: (jnp.asarray(False), eqx.filter(compute(), eqx.is_array))
    _, arrays = lax.while_loop(lambda x: x[0], once, (first, start))
    return eqx.combine(arrays, rest)


def _operations(x: Any) -> int:
    """The number of those of a traced function, with what they call."""
    if isinstance(x, tuple | list):
        return sum(map(_operations, x))
    jaxpr = getattr(x, "jaxpr", x)
    if not hasattr(jaxpr, "eqns"):
        return 0
    inner = [_operations(tuple(eqn.params.values())) for eqn in jaxpr.eqns]
    return len(inner) + sum(inner)
