"""The loop over steps that are known beforehand, and what is saved.

Diffrax's loop asks after each step whether something is to be saved in it. Here the
steps, and those in which the saved times fall, are known, so that the loop runs from
one to the next without asking. Between steps the solution is a shorter step of the
scheme, of its full order.
"""

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree

from .. import _tree as tree
from .._numbers import cast_to
from .._results import NONFINITE
from .._scheme._base import (
    AbstractPresymplecticSolver,
    advance,
    between,
    Point,
    Scheme,
)
from .._scheme._engine import cheap_iterations, prepare_once
from .._scheme._failure import explain, unless_too_strong
from .._system._bound import System
from ._steps import Rows, Steps


# What outputs are differentiated with respect to.
Parameters = tuple[System, list[Callable]]

# Numbers in a state from which the outputs between steps are computed one by one,
# rather than all at once, which would take more memory than it saves time.
_LARGE = 512
# The steps of a loop whose length is known, for which the host does not wait on a GPU.
_BLOCK = 32


class Problem(eqx.Module):
    """A solve. It is differentiated with respect to the first three."""

    system: System
    fns: list[Callable]  # of `SaveAt`
    start: Point
    steps: Steps
    rows: list[Rows]
    subs: list[dfx.SubSaveAt]  # without their functions
    solver: AbstractPresymplecticSolver
    max_steps: int | None = eqx.field(static=True)
    progress_meter: dfx.AbstractProgressMeter
    meter: PyTree

    @property
    def scheme(self) -> Scheme:
        return self.solver.scheme(self.system)

    @property
    def last(self) -> Int[Array, ""]:
        """The number of steps, if none fails."""
        total = self.steps.total
        return total if self.max_steps is None else jnp.minimum(total, self.max_steps)

    @property
    def prepared_once(self) -> bool:
        """Whether all steps share what is prepared for them."""
        return self.steps.are_equal and self.system.prepares_once

    @property
    def at_once(self) -> bool:
        """Whether outputs between steps are computed all at once after the last step,
        from the states at the starts of these steps. In implicit schemes they would all
        iterate as often as the slowest."""
        size = sum(jnp.size(x) for x in jtu.tree_leaves(self.start))
        return size <= _LARGE and not self.scheme.is_implicit

    def prepare(self, system: System, backward: bool = False) -> PyTree:
        """What all steps share, if anything."""
        if not self.prepared_once:
            return None
        span = self.steps.span(system, jnp.asarray(0))
        data = prepare_once(self.scheme.moves, system, span, backward)
        most = math.inf if backward else self.scheme.most_friction
        return unless_too_strong(most, system, span, data)

    def between(
        self,
        system: System,
        n: Array,
        start: Point,
        t: Array,
        inside: Array,
        shorter: bool | None = None,
    ) -> PyTree:
        """The state at a time `inside` step `n`, or at its start; that of the `shorter`
        step or of the start if it is known which."""
        last, begin, end = (self.steps.time(n + i) for i in (-1, 0, 1))
        # A batch computes the shorter step at the start of a step too, and after the
        # last one. Its result is not used, but it must be one that succeeds: half of a
        # step, the last one at the end of the solve, as friction that is singular at
        # its start would not allow none.
        ended = end <= begin
        begin, end = jnp.where(ended, last, begin), jnp.where(ended, begin, end)
        length = jnp.where(end > begin, end - begin, 1)
        t = jnp.where(inside, t, begin + length / 2)
        times = system.time(begin), system.time(t)
        step = lambda: between(self.scheme, system, times[0], start, times[1])
        y = system.values(start[0])
        if shorter is not None:
            return step() if shorter else y
        if self.at_once:
            # Under `jax.vmap` a `lax.cond` computes both, and copies what both share,
            # such as matrices of friction, for each row.
            return tree.where(inside, step(), y)
        return lax.cond(inside, step, lambda: y)

    def output(
        self,
        i: int,
        parameters: Parameters,
        j: Array,
        start: Point,
        shorter: bool | None = None,
    ) -> PyTree:
        """What output `i` saves in row `j`, from the state at the start of its step."""
        (system, fns), rows, y = parameters, self.rows[i], start[0]
        if rows.may_be_inside:
            at = rows.stop[j], start, rows.time[j], rows.inside[j]
            y = self.between(system, *at, shorter)
        return fns[i](rows.time[j], y, system.args), tree.all_finite(y)

    def outputs(
        self, i: int, parameters: Parameters, starts: PyTree, n: Array
    ) -> PyTree:
        """What output `i` saves in all rows, from the states at the starts of their
        steps, of `n` steps; and whether all states are finite."""
        (system, fns), rows = parameters, self.rows[i]
        # Rows that are not reached repeat the first, or what is saved at the start, so
        # that nothing fails of which a gradient takes zero times.
        reached = rows.reached(n)
        row, some = jnp.where(reached, jnp.arange(len(rows)), 0), reached[0]
        starts = jtu.tree_map(lambda x: x[row], starts)
        time = jnp.where(some, rows.time[row], self.steps.t0)
        stop = jnp.where(some, rows.stop[row], 0)
        inside = some & rows.inside[row]
        ys = starts[0]
        if rows.may_be_inside:
            each = jax.vmap(partial(self.between, system))
            # At once, a time that is the end of a step would cost as much as others.
            within = lambda: each(stop, starts, time, inside)
            ys = lax.cond(jnp.any(inside), within, lambda: ys)
        values = jax.vmap(lambda t, y: fns[i](t, y, system.args))(time, ys)
        return values, tree.all_finite(ys)


class Progress(eqx.Module):
    """How far a solve has come."""

    n: Int[Array, ""]
    point: Point
    result: dfx.RESULTS | None  # `None` if no step can fail
    meter: PyTree


class Track(eqx.Module):
    """Values at the starts of given steps, in order."""

    # After those that are due a step that is never reached. The row that belongs to it
    # takes what is not a value: to choose between rows would copy all of them.
    stops: Int[Array, " rows+1"]
    value: Callable[[Array, Point], PyTree]  # of the row and the state there
    init: PyTree

    def __init__(self, stops, is_due, never, value: Callable, init: PyTree):
        self.stops = jnp.append(jnp.where(is_due, stops, never), never)
        self.value, self.init = value, init

    def start(self) -> tuple[Array, PyTree]:
        stack = lambda x: jnp.broadcast_to(x, (len(self.stops), *jnp.shape(x)))
        return jnp.asarray(0), jtu.tree_map(stack, self.init)


class Trace(eqx.Module):
    """What a gradient needs of a solve: its end and states along the way."""

    n: Int[Array, ""]
    end: Point
    starts: list[PyTree]  # of the rows of each output, if computed at once
    kept: PyTree


def run(problem: Problem, keep: Array | None = None):
    """The end of a solve, what each output saved, and a trace.

    `keep` are the steps whose starting states are kept.
    """
    parameters, last = (problem.system, problem.fns), problem.last
    tracks = [
        None if len(rows) == 0 else _track(problem, i)
        for i, rows in enumerate(problem.rows)
    ]
    kept = None
    if keep is not None:
        value = lambda j, point: point
        kept = Track(keep, keep <= last, last + 1, value, problem.start)
    progress, (stacked, kept) = _walk(problem, (tracks, kept))

    saved, finite, starts = [], tree.all_finite(progress.point[0]), []
    for i, rows in enumerate(problem.rows):
        values = None
        starts.append(stacked[i] if problem.at_once else None)
        if stacked[i] is not None:
            if problem.at_once:
                values, good = problem.outputs(i, parameters, stacked[i], progress.n)
            else:
                values, each = stacked[i]
                good = jnp.all(each | ~rows.reached(progress.n))
            finite &= good
        saved.append(values)
    success: Any = dfx.RESULTS.successful
    result = success if progress.result is None else progress.result
    bad = (result == success) & ~finite
    result = dfx.RESULTS.where(bad, NONFINITE, result)
    system, steps, n = problem.system, problem.steps, progress.n
    time = lambda i: system.time(steps.time(i))
    ends = (time(0 * n), problem.start), (time(n), progress.point)
    spans = lambda i: steps.span(system, i)
    result = explain(problem.scheme, system, spans, n, ends, result)
    short = (result == success) & (progress.n < problem.steps.total)
    result = dfx.RESULTS.where(short, dfx.RESULTS.max_steps_reached, result)
    trace = Trace(progress.n, progress.point, starts, kept)
    return (progress, result, saved), trace


def _track(problem: Problem, i: int) -> Track:
    rows, system, fns = problem.rows[i], problem.system, problem.fns
    stops = rows.stop, rows.reached(problem.last), problem.last + 1
    if problem.at_once:
        return Track(*stops, lambda j, point: point, problem.start)
    y = problem.start[0]
    init = fns[i](problem.steps.t0, y, system.args), jnp.asarray(True)
    value = lambda j, point: problem.output(i, (system, fns), j, point)
    return Track(*stops, value, init)


def _walk(problem: Problem, tracks: PyTree) -> tuple[Progress, PyTree]:
    """All steps, stopping where a value of a track is due."""
    steps, system, last = problem.steps, problem.system, problem.last
    scheme, meter = problem.scheme, problem.progress_meter
    shared = problem.prepare(system)

    def one_step(progress: Progress) -> Progress:
        n, start = progress.n, progress.point
        end, result = advance(scheme, system, steps.span(system, n), start, shared)
        done = (steps.time(n + 1) - steps.t0) / (steps.t1 - steps.t0)
        return Progress(n + 1, end, result, meter.step(progress.meter, done))

    start = Progress(jnp.asarray(0), problem.start, None, problem.meter)
    # Traced once, for all of its uses.
    traced = eqx.filter_closure_convert(one_step, start)
    can_fail = eqx.filter_eval_shape(traced, start).result is not None
    step = lambda x: traced(eqx.tree_at(lambda x: x.result, x, None, is_leaf=_is_none))
    if can_fail:
        success = jtu.tree_map(jnp.asarray, dfx.RESULTS.successful)
        start = eqx.tree_at(lambda x: x.result, start, success, is_leaf=_is_none)

    def unfinished(progress: Progress, stop: Array) -> Bool[Array, ""]:
        left = progress.n < stop
        if not can_fail:
            return left
        return left & (progress.result == dfx.RESULTS.successful)

    def advance_to(stop: Array, progress: Progress) -> Progress:
        if not (cheap_iterations() or can_fail):
            block = lambda x: lax.fori_loop(0, _BLOCK, lambda _, x: step(x), x)
            several = lambda progress: progress.n + _BLOCK <= stop
            progress = lax.while_loop(several, block, progress)
        return lax.while_loop(lambda x: unfinished(x, stop), step, progress)

    is_track = lambda x: isinstance(x, Track)
    flat, structure = jtu.tree_flatten(tracks, is_leaf=is_track)
    due = lambda states: [
        track.stops[j] for track, (j, _) in zip(flat, states, strict=True)
    ]

    def stop(x):
        progress, states = x
        wanted = due(states)
        at = reduce(jnp.minimum, wanted, last)
        progress, new = advance_to(at, progress), []
        for track, (j, rows), next_stop in zip(flat, states, wanted, strict=True):
            here = next_stop == at
            place = jnp.where(here, j, len(track.stops) - 1)
            rows = _put(rows, place, track.value(j, progress.point))
            new.append((jnp.where(here, j + 1, j), rows))
        return progress, new

    more = lambda x: unfinished(x[0], last) | (reduce(jnp.minimum, due(x[1])) <= last)
    states = [track.start() for track in flat]
    if not flat:
        return advance_to(last, start), jtu.tree_unflatten(structure, [])
    # The end is a stop too, so that there is one loop over steps.
    end, states = lax.while_loop(more, stop, (start, states))
    values = [jtu.tree_map(lambda x: x[:-1], rows) for _, rows in states]
    return end, jtu.tree_unflatten(structure, values)


_is_none = lambda x: x is None


def _put(rows: PyTree, i: Array, value: PyTree, here: Any = True) -> PyTree:
    """Rows with one of them replaced, if it is `here`."""

    def leaf(xs, x):
        if here is not True:
            x = jnp.where(here, x, xs[i])
        return lax.dynamic_update_index_in_dim(xs, cast_to(x, xs), i, 0)

    return jtu.tree_map(leaf, rows, value)


def saved_rows(problem: Problem, i: int, buffer, values, progress: Progress):
    """The final times and values of output `i`, from those that Diffrax allocated, and
    the numbers of rows and of times of `ts` that were saved."""
    (ts, ys), sub, rows, n = buffer, problem.subs[i], problem.rows[i], progress.n
    steps, system, fn = problem.steps, problem.system, problem.fns[i]
    first = int(sub.t0)
    if first:
        value = fn(steps.t0, problem.start[0], system.args)
        ts, ys = _put(ts, jnp.asarray(0), steps.t0), _put(ys, jnp.asarray(0), value)
    reached = rows.reached(n)
    if len(rows):

        def place(xs: Array, x: Array) -> Array:
            keep = reached.reshape(-1, *(1,) * (x.ndim - 1))
            x = jnp.where(keep, x.astype(xs.dtype), xs[first : first + len(x)])
            return lax.dynamic_update_slice_in_dim(xs, x, first, 0)

        ts, ys = place(ts, rows.time), jtu.tree_map(place, ys, values)
    number = first + jnp.sum(reached)
    if sub.t1:
        separate = end_is_separate(sub, n)
        value = fn(steps.time(n), progress.point[0], system.args)
        if separate is not None:
            ts = _put(ts, number, steps.time(n), separate)
            ys, number = _put(ys, number, value, separate), number + 1
    return ts, ys, number, jnp.sum(reached & rows.of_ts)


def end_is_separate(sub: dfx.SubSaveAt, n: Array) -> Bool[Array, ""] | None:
    """Whether the end is not also saved as one of the steps; `None` if never."""
    if sub.steps == 1:
        return None
    return n % sub.steps != 0 if sub.steps else jnp.asarray(True)
