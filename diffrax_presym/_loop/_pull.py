"""How what was saved of a solve is pulled back."""

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int, PyTree

from .. import _tree as tree
from .._numbers import cast_to, State
from .._scheme._base import Point
from ._backward import AbstractPull, Backward, BackwardState, zeros
from ._nodes import DERIVATIVES, NODES, spread, Stencils
from ._problem import Functions, Problem
from ._tracks import apart, put, row_of, stack, where_any
from ._within import End


def pulls(problem: Problem) -> list[AbstractPull]:
    """How each output is pulled back."""
    tracks = []
    for i, (rows, stencils) in enumerate(
        zip(problem.rows, problem.stencils, strict=True)
    ):
        varies = rows.may_be_inside and problem.functions.end is not None
        if varies:
            tracks.append(PullTimed(i, rows.stop))
        elif len(rows):
            tracks.append(PullRows(i, rows.stop, stencils))
        if stencils is not None:
            tracks.append(PullNodes(i, stencils))
    return tracks


class PullRows(AbstractPull):
    """Values at steps, or of shorter ones from there; the state is their number."""

    stops: Array
    stencils: Stencils | None  # of those that are not interpolated

    def start(self, backward):
        row = backward.problem.rows[self.i].first_left(backward.trace.n)
        return row if self.stencils is None else self.stencils.others_before(row)

    def _row(self, state: Array) -> Array:
        return state - 1 if self.stencils is None else self.stencils.others[state - 1]

    def due(self, state, n):
        stop = self.stops[self._row(state)]
        return jnp.where(state > 0, jnp.where(stop < 0, n, stop), -1)

    def pull(self, backward, n, at, state):
        j = self._row(state)
        taken = backward.problem.rows[self.i].stop[j] >= 0
        if self.stencils is not None:
            taken &= ~self.stencils.own[j]
        return _pull_row(backward, at, self.i, j, taken), state - 1


def _pull_row(
    backward: Backward, at: BackwardState, i: int, j: Array, taken: Array
) -> BackwardState:
    """Pull back a value at a step, or by a shorter one from there."""
    problem = backward.problem
    rows, bar = problem.rows[i], backward.row(i, int(problem.subs[i].t0) + j, taken)
    row = row_of(rows.each, j)
    # Of the others nothing may fail of which a gradient takes zero times.
    here = problem.steps.begin(at.n, at.point)
    time, inside = jnp.where(taken, row.time, here), row.inside & taken
    row = row._replace(time=time, inside=inside)

    def pull(shorter: bool):
        def output(functions: Functions, start: Point):
            return problem.output(i, functions, row, start, shorter)[:2]

        return backward.pull(at.n, output, bar, at.point)

    if not rows.may_be_inside or problem.functions.shorter is None:
        return at.add(*pull(False))
    # Decided before the derivative is taken: in a batch, JAX would differentiate the
    # branch that is not taken at zeros, where an implicit step is singular.
    return at.add(*lax.cond(row.inside, lambda: pull(True), lambda: pull(False)))


class PullNodes(AbstractPull):
    """Values between steps, by the cotangents of the last few nodes."""

    stencils: Stencils

    def start(self, backward):
        n, node = backward.trace.n, stack(backward.trace.end[0], self.stencils.each)
        # The first that is not known.
        number = jnp.argmax(self.stencils.last(slice(None)) > n)
        return n + 1, n + 1, number, zeros(stack(node, NODES))

    def due(self, state, n):
        node, low, j, _ = state
        last = self.stencils.last(j - 1)
        row = jnp.where(last < 0, n, last)
        row = jnp.where(j > self.stencils.earliest, row, -1)
        return jnp.where(node > low, node - 1, row)

    def pull(self, backward, n, at, state):
        problem, i = backward.problem, self.i
        rows = problem.rows[i]

        def pull_row(x):
            gradient, low, j, bars = x
            j = j - 1
            taken = (rows.stop[j] >= 0) & self.stencils.own[j]
            y = row_of(backward.trace.between[i], j)
            more, bar = _pull_value(backward, i, j, taken, y)
            bars = self.stencils.spread(j, n, bar, bars)
            first = self.stencils.first[j]
            low = jnp.where(first >= 0, first, low)
            return tree.add(gradient, more), low, j, bars

        def more_rows(x):
            last = self.stencils.last(x[2] - 1)
            return (x[2] > self.stencils.earliest) & ((last < 0) | (last >= n))

        def pull(side: Array, at: BackwardState, bars: PyTree, low: Array):
            node = lambda functions, point: functions.node(n, side, point)
            bar = jtu.tree_map(lambda x: x[n % NODES], bars)
            at = at.add(*_apart(low <= n, backward, at, node, bar))
            return at, put(bars, n % NODES, zeros(bar))

        _, low, j, bars = state
        kink, kinks = jnp.zeros((), int), problem.steps.kinks
        if kinks is not None:
            kink = jnp.any(kinks == n).astype(int)
            after = lambda: pull(kink, at, bars, low)
            at, bars = lax.cond(kink == 1, after, lambda: (at, bars))
        gradient, low, j, bars = lax.while_loop(
            more_rows, pull_row, (at.gradient, low, j, bars)
        )
        at = eqx.tree_at(lambda at: at.gradient, at, gradient, is_leaf=_is_none)
        at, bars = pull(-kink, at, bars, low)
        return at, (n, low, j, bars)


def _pull_value(backward: Backward, i: int, j: Array, taken: Array, y: State):
    """Pull back what is saved of a state between steps, to the functions and to it."""
    problem = backward.problem
    _, bar = backward.row(i, int(problem.subs[i].t0) + j, taken)
    # Of the others nothing may fail of which a gradient takes zero times.
    time = jnp.where(taken, problem.rows[i].time[j], problem.steps.t0)
    y = tree.where(taken, y, problem.start[0])
    output = lambda functions, y: functions.outputs[i](time, y)
    return backward.pull(j, output, bar, y)


def _apart(here: Array, backward: Backward, at: BackwardState, fn, bar: PyTree):
    """The cotangents of a node, if it is `here`, apart from all that was saved, as in
    `_tracks.apart`."""
    nothing = zeros((at.gradient, at.bar))
    pull = lambda: backward.pull(at.n, fn, bar, at.point)
    return tree.where(here, apart(at.n, here, pull, nothing), nothing)


class PullTimed(AbstractPull):
    """Values within steps that vary, by the cotangents of the ends of these."""

    stops: Int[Array, " rows"]

    def start(self, backward):
        trace, t0 = backward.trace, backward.problem.steps.t0
        number = backward.problem.rows[self.i].first_left(trace.n)
        node = zeros(stack(stack(trace.end[0], DERIVATIVES + 1), 2))
        bars = stack(jnp.zeros_like(t0), 2), node
        return trace.n + 1, trace.n + 1, number, bars

    def due(self, state, n):
        node, low, j, _ = state
        stop = self.stops[j - 1]
        row = jnp.where(j > 0, jnp.where(stop < 0, n, stop), -1)
        return jnp.where(node > low, node - 1, row)

    def pull(self, backward, n, at, state):
        problem, i = backward.problem, self.i
        rows = problem.rows[i]
        interpolated, kept = backward.trace.between[i]
        place = (jnp.arange(2) - (n - 1)) % 2

        def pull_row(x):
            at, low, j, bars = x
            j = j - 1
            taken, row = rows.stop[j] >= 0, row_of(kept, j)
            own, other = taken & interpolated[j], taken & ~interpolated[j]
            # All members of a batch do this, of which others add zero.
            row = tree.where(own, row, zeros(row))
            more, bar = _pull_value(backward, i, j, own, row.y)
            by_time = jax.vmap(lambda x: tree.dot(bar, x))(row.by_time)
            times = bars[0] + cast_to(by_time, bars[0])[place]
            bars = times, spread(row.weights[place], bar, bars[1])
            at = at.add(more, zeros(at.bar))
            step = lambda at: _pull_row(backward, at, i, j, other)
            at = where_any(other, step, at)
            return at, jnp.where(own, rows.stop[j] - 1, low), j, bars

        def more_rows(x):
            stop = self.stops[x[2] - 1]
            return (x[2] > 0) & ((stop < 0) | (stop >= n))

        _, low, j, bars = state
        at, low, j, bars = lax.while_loop(more_rows, pull_row, (at, low, j, bars))
        end = lambda functions, point: functions.end(n, point)[0]
        time, node = jtu.tree_map(lambda x: x[n % 2], bars)
        bar = End(tree.Sum(time, time), node)
        at = at.add(*_apart(low <= n, backward, at, end, bar))
        return at, (n, low, j, put(bars, n % 2, zeros((time, node))))


_is_none = lambda x: x is None
