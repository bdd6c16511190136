"""Pulling back what was saved between the ends of a step."""

from functools import partial
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._misc import tree_sum
from .._solver._engine import Span
from ._saves import is_within, Saved
from ._types import Position


if TYPE_CHECKING:
    from ._backward import Backward


def pull_interpolated(
    backward: "Backward", at: Position, n: Array, span: Span, start: PyTree
) -> tuple[Position, PyTree]:
    """Pull back the outputs between the ends of a step, to its end (in the
    position) and to its start."""
    t_start = backward.time(n)

    def dense_info(moved, start, end):
        system, _ = eqx.combine(moved, backward.fixed)
        return backward.solver.dense_info(system, *span, start, end)

    info, pull = jax.vjp(dense_info, backward.moved, start, at.state)
    info_bar = jtu.tree_map(jnp.zeros_like, info)
    if backward.dense is not None:
        info_bar = jtu.tree_map(lambda x: x[n], backward.dense)

    def take(i, x):
        (times, outputs), (gradient, info_bar) = x
        times, outputs = times - 1, outputs - 1
        t = backward.saves.subs[i].ts[times]
        evaluate = lambda info: backward.solver.interpolation_cls(
            t0=t_start, t1=at.t, **info
        ).evaluate(t)
        y, pull = jax.vjp(evaluate, info)
        bar = backward.saves.bar_at(i, outputs, True)
        more, y_bar = backward.saves.pull_saved_output(i, t, y, bar)
        sums = tree_sum((gradient, info_bar), (more, *pull(y_bar)))
        return Saved(times, outputs), sums

    sums, left = (at.gradient, info_bar), list(at.left)
    for i, sub in enumerate(backward.saves.subs):
        if sub.ts is not None:
            inside = lambda x, ts=sub.ts: is_within(ts, x[0].times, n, t_start)
            left[i], sums = lax.while_loop(inside, partial(take, i), (left[i], sums))
    gradient, info_bar = sums
    more, start_bar, end_bar = pull(info_bar)
    gradient, bar = tree_sum((gradient, at.bar), (more, end_bar))
    return at._replace(gradient=gradient, bar=bar, left=left), start_bar
