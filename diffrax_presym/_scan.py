"""Loops over the stages of a step and over steps, as the platform needs them."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.lax as lax
from jaxtyping import Array, PyTree


_S = TypeVar("_S")

# The steps of a loop whose length is known, for which the host does not wait on a GPU.
_BLOCK = 32


def scan_stages(stage: Callable, init: PyTree, rows: PyTree, reverse: bool = False):
    """`jax.lax.scan` over the stages of a step."""
    unroll = 1 if cheap_iterations() else True
    return lax.scan(stage, init, rows, reverse=reverse, unroll=unroll)


def repeat(
    left: Callable[[_S], Array],
    step: Callable[[_S], _S],
    state: _S,
    going: Callable[[_S], Array] | None = None,
) -> _S:
    """Steps as long as any are `left`, and if given, as long as it is `going`."""
    if not cheap_iterations() and going is None:
        block = lambda state: lax.fori_loop(0, _BLOCK, lambda _, x: step(x), state)
        state = lax.while_loop(lambda state: left(state) >= _BLOCK, block, state)
    more = lambda state: left(state) > 0
    both = more if going is None else lambda state: more(state) & going(state)
    return lax.while_loop(both, step, state)


def cheap_iterations() -> bool:
    """Whether iterations are cheap, and code is not.

    On a GPU an iteration takes ten microseconds or more, whatever is in it, and twice
    as long if the host has to ask whether it is the last. So stages are written out,
    and steps are taken in blocks. On a CPU stages were measured to take four to five
    times as long so.
    """
    return jax.default_backend() == "cpu"
