"""What a solve collects whose steps are found on the way."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import _tree as tree
from .._numbers import State
from .._scheme._base import Point
from ._base import MOST_STEPS, Stop
from ._nodes import combine, Found, Node, NODES, weights_of
from ._tracks import AbstractTrack, put, stack
from ._variable import VariableSteps


class Timed(AbstractTrack):
    """Values at given times, wherever these are in the steps, by shorter steps."""

    times: Float[Array, " rows"]
    # Of the row, the number and the start of its step, and whether it is inside of it.
    value: Callable[[Array, Array, Array, Point], PyTree]
    init: PyTree

    def start(self):
        found = stack(Found.nowhere(), len(self.times))
        return jnp.zeros((), int), found, stack(self.init, len(self.times))

    def due(self, state):
        return Stop(jnp.asarray(MOST_STEPS), _time(self.times, state[0]))

    def visit(self, state, n, point, starts):
        j, found, rows = state
        inside = self.times[j] > point[1][1].t
        found = put(found, j, Found.nowhere()._replace(stop=n, inside=inside))
        return j + 1, found, put(rows, j, self.value(j, n, inside, point))

    def rows(self, state):
        return state[1:]


class Position(NamedTuple):
    """How far the rows between steps have come."""

    j: Int[Array, ""]  # the next row
    due: Stop
    last: Int[Array, ""]  # the last node whose derivatives are known
    ring: tuple[Array, Node]  # the times of the last few, and derivatives
    found: Found
    rows: PyTree


class Between(AbstractTrack):
    """Values at given times from the ends of the steps around them, by interpolation
    where the lengths of these and friction allow it, otherwise by shorter steps.

    A row is known when the step after its own has ended.
    """

    times: Float[Array, " rows"]
    steps: VariableSteps
    most: Int[Array, ""]  # the number of steps at which the solve ends in any case
    # Whether interpolation can follow the motion between nodes of these times.
    is_smooth: Callable[[Array], Bool[Array, ""]]
    node: Callable[[Array, Array, Point], tuple[Array, Node]]
    # The state in a step, of its number and start, at a time inside of it or its start.
    shorter: Callable[[Array, Point, Array, Array], State]
    value: Callable[[Array, State], PyTree]  # of the row and the state in it
    y: State  # any
    init: PyTree
    keep: bool = eqx.field(static=True)  # what a gradient needs

    def start(self):
        zero, number = jnp.zeros((), int), len(self.times)
        ring = stack((self.steps.t0, (self.y, self.y, self.y)), NODES)
        state, slopes, weights = self._interpolate(self.times[0], zero, ring)
        found = Found.nowhere()
        if self.keep:
            found = found._replace(state=state, slopes=slopes, weights=weights)
        rows = stack((self.init, jnp.asarray(True)), number)
        due = Stop(jnp.asarray(MOST_STEPS), _time(self.times, zero))
        return Position(zero, due, zero - 1, ring, stack(found, number), rows)

    def due(self, state):
        return state.due

    def visit(self, state, n, point, starts):
        first, steps = n - NODES + 1, self.steps

        def at(m: Array) -> Point:
            before = jtu.tree_map(lambda x: x[m % (NODES - 1)], starts)
            return tree.where(m == n, point, before)

        ends = jnp.stack([steps.begin(m, at(m)) for m in first + jnp.arange(NODES)])
        ended = steps.ended(n, point)

        def is_known(j: Array) -> Bool[Array, ""]:
            t = self.times[jnp.minimum(j, len(self.times) - 1)]
            known = jnp.isnan(t) | ended | ((n >= self.most) & (t <= ends[-1]))
            return (j < len(self.times)) & (known | ((first >= 0) & (t < ends[-2])))

        smooth = (first >= 0) & self.is_smooth(ends)
        needed = smooth & is_known(state.j)

        def add(x):
            m = jnp.maximum(x[0] + 1, first)
            return m, put(x[1], m % NODES, self.node(m, jnp.zeros((), int), at(m)))

        nodes = state.last, state.ring
        last, ring = lax.while_loop(lambda x: needed & (x[0] < n), add, nodes)

        def save(x):
            j, found, rows = x
            t = self.times[j]
            gap = jnp.isnan(t)
            k = jnp.where(gap, n, first + jnp.sum(ends <= t) - 1)
            inside = t > ends[k - first]
            interpolated = smooth & inside
            y, slopes, weights = self._interpolate(t, first, ring)
            # Of a batch as one: otherwise each member would compute both.
            short = lambda: self.shorter(k, at(k), t, inside)
            others = lax.cond(tree.any_member(~interpolated), short, lambda: point[0])
            y = tree.where(interpolated, y, others)
            here = Found(
                jnp.where(gap, -1, k),
                inside,
                jnp.where(interpolated, first, MOST_STEPS),
            )
            if self.keep:
                here = here._replace(state=y, slopes=slopes, weights=weights)
            row = self.value(j, y), tree.all_finite(y)
            return j + 1, put(found, j, here), put(rows, j, row)

        rows = state.j, state.found, state.rows
        j, found, rows = lax.while_loop(lambda x: is_known(x[0]), save, rows)
        return Position(j, self._next(j, n, point), last, ring, found, rows)

    def _next(self, j: Array, n: Array, point: Point) -> Stop:
        """Where the loop stops for row `j`, from step `n` on: after the next steps, or
        when it has come to the time of the row."""
        t, steps = _time(self.times, j), self.steps
        soon = t < steps.end(n, point)
        more = jnp.where(t < steps.begin(n, point), 1, 2)
        target = jnp.minimum(jnp.maximum(n + more, NODES - 1), self.most)
        # At the end of the solve, if that comes first.
        time = jnp.where(soon, steps.t1, t)
        return Stop(jnp.where(soon, target, MOST_STEPS), time)

    def _interpolate(self, t: Array, first: Array, ring: tuple[Array, Node]):
        """The state at a time, its derivatives by the times of the nodes if these are
        kept, and the weights of the nodes."""
        times, data = ring
        nodes = times[(first + jnp.arange(NODES)) % NODES]

        def at(nodes: Array) -> tuple[State, Array]:
            begin, unit = nodes[1], nodes[2] - nodes[1]
            scaled = (nodes - begin) / unit
            weights = weights_of((t - begin) / unit, list(scaled), unit)
            return combine(weights, first, data), weights

        y, weights = at(nodes)
        slopes = jax.jacfwd(lambda x: at(x)[0])(nodes) if self.keep else None
        return y, slopes, weights

    def rows(self, state):
        return state.found, state.rows


def _time(times: Float[Array, " rows"], j: Array) -> Float[Array, ""]:
    """The time of row `j`: none is later if there is no such row, and none earlier if
    it is a gap in measured times, of which nothing is saved."""
    t = times[jnp.minimum(j, len(times) - 1)]
    return jnp.where(j < len(times), jnp.where(jnp.isnan(t), -jnp.inf, t), jnp.inf)


class Kept(AbstractTrack):
    """The states after every so many steps, as many as there is room for."""

    most: int = eqx.field(static=True)
    init: Point

    def start(self):
        zero, one = jnp.zeros((), int), jnp.ones((), int)
        return zero, one, stack(self.init, self.most)

    def due(self, state):
        count, every, _ = state
        return Stop(count * every)

    def visit(self, state, n, point, starts):
        count, every, rows = state
        full = count == self.most
        half = (self.most + 1) // 2
        # Every other one is dropped.
        fewer = lambda x: jnp.concatenate([x[::2], x[half:]])[: self.most]
        rows = lax.cond(full, lambda: jtu.tree_map(fewer, rows), lambda: rows)
        count, every = jnp.where(full, half, count), jnp.where(full, 2 * every, every)
        here = count * every == n  # Not if an odd number was full.
        rows = put(rows, jnp.minimum(count, self.most - 1), point, here)
        return jnp.where(here, count + 1, count), every, rows

    def rows(self, state):
        count, every, rows = state
        i = jnp.arange(self.most)
        return jnp.where(i < count, i * every, MOST_STEPS), rows
