"""Values within steps that a controller finds on the way.

Hermite interpolation of degree 7, from the states at the two ends of the step and their
first three derivatives along the motion: unlike that over several steps, as accurate as
these where their lengths change fast.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import _tree as tree
from .._friction._linear import LinearFriction
from .._numbers import cast_to, State
from .._scheme._base import Point, Scheme
from .._system._bound import System
from ._base import follows, MOST_STEPS, Stop
from ._nodes import DERIVATIVES, derivatives, hermite, Node, turns_little
from ._tracks import AbstractTrack, apart, put_here, stack, where_any
from ._variable import VariableSteps


class End(NamedTuple):
    """An end of steps: its time, and the state there with its derivatives."""

    time: tree.Sum
    node: Node


def end_of_step(
    scheme: Scheme,
    system: System,
    steps: VariableSteps,
    friction: LinearFriction | None,
    n: Array,
    point: Point,
) -> tuple[End, Bool[Array, ""]]:
    """The start of a step, and whether a polynomial can follow the motion within it,
    with friction `by_rates`."""
    y, solver_state = point
    carry, _ = steps.split(solver_state)
    begin, h = steps.begin(n, point), steps.end(n, point) - steps.begin(n, point)
    node = derivatives(scheme, system, begin, (y, carry))
    smooth = turns_little(system, h, y)
    h = cast_to(system.direction, h) * h
    smooth &= follows(friction, system.time(begin), h)
    return End(steps.time(point), node), jnp.asarray(smooth)


def _combine(weights: Float[Array, "4"], node: Node) -> State:
    def leaf(x: Array) -> Array:
        each = jnp.expand_dims(cast_to(weights, x), range(1, x.ndim))
        return jnp.sum(each * x, axis=0)

    return jtu.tree_map(leaf, node)


class Found(NamedTuple):
    """What is known of a row only when the solve comes to it."""

    step: Int[Array, "..."]  # from whose start it is computed
    inside: Bool[Array, "..."]  # by a shorter step from there
    interpolated: Bool[Array, "..."]  # between that and the start of the step before


class KeptRow(NamedTuple):
    """What a gradient needs of an interpolated row."""

    weights: Float[Array, "2 4"]
    y: State
    by_time: State  # its derivatives by the times of both ends, stacked


class _Collected(NamedTuple):
    j: Int[Array, ""]  # the next row
    next: Int[Array, ""]  # the end of the step it is in, if it is interpolated there
    ends: tuple[End, End]  # the last two
    smooth: Bool[Array, ""]
    rows: PyTree


class Timed(AbstractTrack):
    """Values at given times, wherever these are in the steps."""

    steps: VariableSteps
    last: Int[Array, ""]  # the most steps
    times: Float[Array, " rows"]
    # `None` if all values within steps are shorter steps.
    end: Callable[[Array, Point], tuple[End, Bool[Array, ""]]] | None
    # At a time `inside` of a step, or at its start; `None` if all are interpolated.
    shorter: Callable[[Array, Point, Array, Array], State] | None
    output: Callable[[Array, State], PyTree]
    keep: bool = eqx.field(static=True)
    y: State  # any
    init: PyTree  # a value

    def start(self):
        zero, no, t = jnp.zeros((), int), jnp.zeros((), bool), self.steps.t0
        node, time = stack(self.y, DERIVATIVES + 1), tree.Sum(t, jnp.zeros_like(t))
        ends, kept = (End(time, node), End(time, node)), None
        if self.keep and self.end is not None:
            weights = jnp.zeros((2, DERIVATIVES + 1), t.dtype)
            kept = KeptRow(weights, self.y, stack(self.y, 2))
        row = Found(zero + MOST_STEPS, ~no, no), self.init, ~no, kept
        rows = stack(row, len(self.times))
        return _Collected(zero, zero + MOST_STEPS, ends, no, rows)

    def _time(self, j: Array) -> Array:
        # At once if that is a gap in measured times; after the last row never.
        t = self.times[jnp.minimum(j, len(self.times) - 1)]
        t = jnp.where(jnp.isnan(t), -jnp.inf, t)
        return jnp.where(j < len(self.times), t, jnp.inf)

    def due(self, state):
        waits = state.next < MOST_STEPS
        return Stop(state.next, jnp.where(waits, jnp.inf, self._time(state.j)))

    def visit(self, state, n, point, here):
        if (end := self.end) is not None:
            last = state.ends[1], state.smooth
            new, smooth = apart(n, here, lambda: end(n, point), last)
            ends = tree.where(here, (state.ends[1], new), state.ends)
            state = state._replace(ends=ends, smooth=smooth)
        go = lambda state: self._visit(state, n, point, here)
        return where_any(here, go, state)

    def _visit(
        self, state: _Collected, n: Array, point: Point, here: Array
    ) -> _Collected:
        now, ends, smooth = self.steps.begin(n, point), state.ends, state.smooth
        within = lambda j: here & self.steps.is_within(self._time(j), n, point)
        # The end of a step before moves with the state, unlike the ends of the solve.
        moves = (n > 0) & (n < self.last) & ~self.steps.ended(n, point)
        after = lambda t: (t > now) | ((t == now) & moves)
        waits = lambda j: within(j) & smooth & after(self._time(j))
        ready = lambda j: within(j) & ~waits(j)

        def save(x: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
            j, rows = x
            own, t, kept = ready(j), self._time(j), None
            inside, past = after(t), (t < now) & (state.next == n)
            y = point[0]
            if (shorter := self.shorter) is not None:
                time = jnp.where(inside, t, now)
                step = lambda: shorter(n, point, time, inside)
                y = apart(n, inside & own, step, point[0])
            if self.end is not None:
                between, kept = self._interpolate(t, past, ends)
                y = tree.where(past, between, y)
            value = self.output(self.times[j], y)
            row = Found(n, inside, past), value, tree.all_finite(y), kept
            return j + own.astype(j.dtype), put_here(rows, j, row, own)

        more = lambda x: tree.any_member(ready(x[0]))
        j, rows = lax.while_loop(more, save, (state.j, state.rows))
        due = jnp.where(waits(j), n + 1, MOST_STEPS)
        return _Collected(j, jnp.where(here, due, state.next), ends, smooth, rows)

    def _interpolate(
        self, t: Array, past: Array, ends: tuple[End, End]
    ) -> tuple[State, KeptRow | None]:
        first, last = ends
        (a, low), (b, high) = ((x.time.value, x.time.lost) for x in ends)
        # A step of length one where there is none.
        known = jnp.where(past, jnp.stack([a, b]), jnp.stack([b - 1, b]))
        t = jnp.where(past, t, b)

        def weights(times: Array) -> Float[Array, "2 4"]:
            h = (times[1] - times[0]) + (high - low)
            return hermite(1 + ((t - times[1]) - high) / h, [0.0, 1.0], h)

        found = weights(known)

        def combine(weights: Float[Array, "2 4"]) -> State:
            return tree.add(*map(_combine, weights, (first.node, last.node)))

        y = combine(found)
        if not self.keep:
            return y, None
        by_time = jnp.moveaxis(jax.jacfwd(weights)(known), -1, 0)
        return y, KeptRow(found, y, jax.vmap(combine)(by_time))

    def rows(self, state):
        return state.rows
