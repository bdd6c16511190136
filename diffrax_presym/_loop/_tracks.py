"""What a solve collects on its way, and at which steps."""

import abc
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree, Shaped

from .. import _tree as tree
from .._numbers import cast_to, State
from .._scheme._base import Point
from ._base import Stop
from ._nodes import Node, NODES, Stencils
from ._one_function import as_own_function


_T = TypeVar("_T")


class AbstractTrack(eqx.Module):
    """Rows that are collected in order, at the starts of some steps.

    The loop runs from one of these to the next, and asks nothing in between.
    """

    @abc.abstractmethod
    def start(self) -> PyTree:
        """The state before the first step."""

    @abc.abstractmethod
    def due(self, state: PyTree) -> Stop:
        """Where a state is wanted next."""

    @abc.abstractmethod
    def visit(self, state: PyTree, n: Array, point: Point, here: Any) -> PyTree:
        """The state after that, at the start of step `n`, for those members of a batch
        that are `here`."""

    @abc.abstractmethod
    def rows(self, state: PyTree) -> PyTree:
        """What was collected."""


class Track(AbstractTrack):
    """Values at the starts of given steps."""

    stops: Int[Array, " rows+1"]  # after those that are due one that is never reached
    about: PyTree[Shaped[Array, "rows"]]  # what is known of each row
    value: Callable[[PyTree, Point], PyTree]  # of that and the state there
    init: PyTree

    def start(self):
        return jnp.zeros((), int), stack(self.init, len(self.stops) - 1)

    def due(self, state):
        return Stop(self.stops[state[0]])

    def visit(self, state, n, point, here):
        row = row_of(self.about, state[0])
        value = apart(n, here, lambda: self.value(row, point), self.init)

        def save(state):
            j, rows = state
            rows = put_here(rows, j, value, here)
            return j + jnp.asarray(here, j.dtype), rows

        return where_any(here, save, state)

    def rows(self, state):
        return state[1]


class Collected(eqx.Module):
    """What has been collected of values between steps."""

    shorter: Int[Array, ""]  # the next of the rows that are shorter steps
    node: Int[Array, ""]  # the next node, if there are rows left for which it is one
    interpolated: Int[Array, ""]  # the next row that is interpolated
    ring: Node  # the last nodes
    rows: PyTree
    finite: Bool[Array, ""]  # whether all states were


class Between(AbstractTrack):
    """Values between steps, the first by shorter steps, the others from the last few
    ends of steps."""

    stencils: Stencils
    stops: Int[Array, " rows+1"]  # of shorter steps, then one that is never reached
    kinks: Int[Array, " kinks"] | None  # the steps before which derivatives jump
    about: PyTree[Shaped[Array, "rows"]]  # what is known of each row
    step: Callable[[PyTree, Point], State]  # the state in a row, by a shorter step
    node: Callable[[Array, Array, Point], Node]
    value: Callable[[PyTree, State], PyTree]  # of the row and the state in it
    y: State  # any
    init: PyTree

    def start(self):
        node, zero = stack(self.y, self.stencils.each), jnp.zeros((), int)
        rows = stack(self.init, len(self.stencils.first) - 1)
        begin, ring = self.stencils.earliest, stack(node, NODES)
        return Collected(zero, zero, begin, ring, rows, jnp.asarray(True))

    def _due(self, state: Collected) -> tuple[Array, Array]:
        first = self.stencils.first[state.interpolated]
        return self.stops[state.shorter], jnp.maximum(state.node, first)

    def due(self, state):
        return Stop(jnp.minimum(*self._due(state)))

    def visit(self, state, n, point, here):
        shorter, own = (here & (due == n) for due in self._due(state))
        row = row_of(self.about, self.stencils.others[state.shorter])
        y = apart(n, shorter, lambda: self.step(row, point), self.y)
        save_step = lambda state: self._save_step(state, row, y, shorter)
        state = where_any(shorter, save_step, state)
        kink = jnp.zeros((), int)
        if self.kinks is not None:
            kink = jnp.any(self.kinks == n).astype(int)
        like = stack(self.y, self.stencils.each)
        node = apart(n, own, lambda: self.node(n, -kink, point), like)
        save = lambda state: self._visit_node(state, node, n, kink, point, own)
        return where_any(own, save, state)

    def _save_step(
        self, state: Collected, row: PyTree, y: State, here: Array
    ) -> Collected:
        j = self.stencils.others[state.shorter]
        # A member of a batch that interpolates it does so later.
        rows = put_here(state.rows, j, self.value(row, y), here)
        finite = state.finite & (~here | self.stencils.own[j] | tree.all_finite(y))
        new = state.shorter + here.astype(j.dtype), rows, finite
        return eqx.tree_at(lambda x: (x.shorter, x.rows, x.finite), state, new)

    def _visit_node(
        self,
        state: Collected,
        node: Node,
        n: Array,
        kink: Array,
        point: Point,
        here: Array,
    ) -> Collected:
        ring, finite = state.ring, state.finite
        ring = put_here(ring, n % NODES, node, here)
        complete = lambda j: here & (self.stencils.last(j) <= n)

        def save(x):
            j, rows = x
            done = complete(j)
            y = self.stencils.combine(j, n, ring)
            own = done & self.stencils.own[j]
            value = self.value(row_of(self.about, j), y)
            if self.kinks is not None:
                # In a span of few steps it has been saved.
                value = tree.where(self.stencils.own[j], value, row_of(rows, j))
            return j + done.astype(j.dtype), put_here(rows, j, value, own)

        more = lambda x: tree.any_member(complete(x[0]))
        j, rows = lax.while_loop(more, save, (state.interpolated, state.rows))
        if self.kinks is not None:
            other = lambda: self.node(n, kink, point)
            after = lambda: put_here(ring, n % NODES, other(), here)
            ring = lax.cond(kink == 1, after, lambda: ring)
        total = jtu.tree_map(lambda x: jnp.sum(0 * x, axis=0), node)
        finite &= ~here | tree.all_finite(total)
        due = jnp.where(here, n + 1, state.node)
        return Collected(state.shorter, due, j, ring, rows, finite)

    def rows(self, state):
        """They, and whether all states were finite."""
        return state.rows, state.finite


def row_of(x: _T, j: Array) -> _T:
    return jtu.tree_map(lambda x: x[j], x)


def where_any(here: Bool[Array, ""], visit: Callable[[_T], _T], state: _T) -> _T:
    """`visit(state)`, if any member of a batch is `here`: they are asked together, as
    JAX would otherwise copy all that was collected."""
    return lax.cond(tree.any_member(here), visit, lambda state: state, state)


def apart(
    n: Int[Array, ""], here: Bool[Array, ""], compute: Callable[[], _T], like: _T
) -> _T:
    """What is computed at step `n` if any member of a batch is `here`, apart from all
    that was collected: where arrays are small, XLA does one operation after another on
    a CPU, and otherwise several at once, by threads, which takes longer."""
    return where_any(here, lambda _: as_own_function(compute, n), like)


def stack(x: PyTree, number: int) -> PyTree:
    return jtu.tree_map(lambda x: jnp.broadcast_to(x, (number, *jnp.shape(x))), x)


def put(
    rows: PyTree, i: Array, value: PyTree, here: Any = True, axis: int = 0
) -> PyTree:
    """Rows with one of them replaced, if it is `here`."""

    def leaf(xs, x):
        if here is not True:
            x = jnp.where(here, x, lax.dynamic_index_in_dim(xs, i, axis, False))
        return lax.dynamic_update_index_in_dim(xs, cast_to(x, xs), i, axis)

    return jtu.tree_map(leaf, rows, value)


def put_here(rows: PyTree, i: Array, value: PyTree, here: Bool[Array, ""]) -> PyTree:
    """Rows with one of them replaced, in those members of a batch that are `here`, as
    some are: nothing is asked if all have the same row."""
    one = _put_here(0)
    return jtu.tree_map(lambda xs, x: one(xs, cast_to(x, xs), i, here), rows, value)


@functools.cache
def _put_here(axis: int) -> Callable[..., Array]:
    @jax.custom_batching.custom_vmap
    def one(xs: Array, x: Array, i: Array, here: Bool[Array, ""]) -> Array:
        return put(xs, i, x, axis=axis)

    @one.def_vmap
    def _(size: int, batched: list[bool], xs, x, i, here):
        each = lambda x, known: x if known else stack(x, size)
        xs, x = map(each, (xs, x), batched[:2])
        if not (batched[2] or batched[3]):
            return _put_here(axis + 1)(xs, x, i, here), True
        i, here = map(each, (i, here), batched[2:])

        def each_at_own(xs, x, i, here):
            # Out of range where it is not `here`: nothing is read first.
            i = jnp.where(here, i, xs.shape[axis])
            return xs.at[(slice(None),) * axis + (i,)].set(x, mode="drop")

        return jax.vmap(each_at_own)(xs, x, i, here), True

    # It is linear. JAX takes its derivative as another batch, in which `i` and `here`,
    # which have none, would seem to be the same for all members.
    whole = jax.custom_jvp(one)

    @whole.defjvp
    def _(primals, tangents):
        change = tangents[0]
        if jnp.issubdtype(primals[0].dtype, jnp.inexact):
            change = whole(*tangents[:2], *primals[2:])
        return whole(*primals), change

    return whole
