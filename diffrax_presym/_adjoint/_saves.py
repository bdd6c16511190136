"""Cotangents of the outputs of a solve."""

from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree


class Saved(NamedTuple):
    """The number of outputs left of one of `SaveAt(subs=...)`."""

    times: Array  # those at `ts`
    outputs: Array  # all


class SavedOutputs:
    """The outputs of each of `SaveAt(subs=...)`, and their cotangents."""

    def __init__(self, saveat: dfx.SaveAt, final, cotangents, moved, fixed):
        is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
        self.subs = jtu.tree_leaves(saveat.subs, is_leaf=is_sub)
        structure = jtu.tree_structure(saveat.subs, is_leaf=is_sub)
        self._states = structure.flatten_up_to(final.save_state)
        bars = structure.flatten_up_to(cotangents.save_state)
        self._bars = [
            materialise(state.ys, bar.ys)
            for state, bar in zip(self._states, bars, strict=True)
        ]
        self._moved, self._fixed = moved, fixed

    def left_at_end(self, n: Array) -> list[Saved]:
        """The outputs of `n` steps, without that of `t1=True`.

        Counted here, since the count of Diffrax may include an end that was not saved.
        """
        return [
            _left_at_end(sub, state, n)
            for sub, state in zip(self.subs, self._states, strict=True)
        ]

    def bar_at(self, i: int, index: Array, pred) -> PyTree:
        """The cotangent of one output, or zero."""
        return jtu.tree_map(lambda x: jnp.where(pred, x[index], 0), self._bars[i])

    def sum_of_first(self, i: int, n: Array) -> PyTree:
        return jtu.tree_map(lambda x: _sum_of_first(n, x), self._bars[i])

    def pull_saved_output(self, i: int, t: Array, y: PyTree, bar: PyTree):
        """Pull back an output saved at `y`, to the parameters and `y`."""

        def output(moved, y):
            system, fns = eqx.combine(moved, self._fixed)
            return eqx.filter(fns[i](t, y, system.args), eqx.is_inexact_array)

        return jax.vjp(output, self._moved, y)[1](bar)


def materialise(like: PyTree, bar: PyTree) -> PyTree:
    """The cotangents of all inexact arrays, zero where there are none."""
    like = eqx.filter(like, eqx.is_inexact_array)
    return jtu.tree_map(lambda x, b: jnp.zeros_like(x) if b is None else b, like, bar)


def is_within(ts: Array, times: Array, n: Array, t_start: Array) -> Array:
    """Whether the last of the first `times` of `ts` is in step `n`, from `t_start`."""
    return (times > 0) & ((n == 0) | (ts[times - 1] > t_start))


def _left_at_end(sub: dfx.SubSaveAt, state, n: Array) -> Saved:
    times = jnp.asarray(0)
    if sub.ts is not None:
        # A solve of zero length saves them all without counting.
        times = jnp.where(n == 0, len(sub.ts), state.saveat_ts_index)
    steps = 0 if sub.steps == 0 else n // sub.steps
    return Saved(times, times + steps + int(sub.t0))


def _sum_of_first(n: Array, x: Array) -> Array:
    mask = (jnp.arange(len(x)) < n).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.sum(jnp.where(mask, x, 0), axis=0)
