"""The loop over steps that are known beforehand, and what is saved.

Diffrax's loop asks after each step whether something is to be saved in it. Here the
steps, and those in which the saved times fall, are known, so that the loop runs from
one to the next without asking. Between steps the solution is a shorter step of the
scheme, of its full order.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree

from .. import _tree as tree
from .._numbers import cast_to
from .._results import NONFINITE
from .._scheme._base import Point
from .._scheme._engine import cheap_iterations
from ._problem import Problem


# The steps of a loop whose length is known, for which the host does not wait on a GPU.
_BLOCK = 32


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
    last = problem.last
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
                values, good = problem.outputs(
                    i, problem.functions, stacked[i], progress.n
                )
            else:
                values, each = stacked[i]
                good = jnp.all(each | ~rows.taken(progress.n))
            finite &= good
        saved.append(values)
    success: Any = dfx.RESULTS.successful
    result = success if progress.result is None else progress.result
    bad = (result == success) & ~finite
    result = dfx.RESULTS.where(bad, NONFINITE, result)
    result = problem.explain(progress.n, progress.point, result)
    short = (result == success) & (progress.n < problem.steps.total)
    result = dfx.RESULTS.where(short, dfx.RESULTS.max_steps_reached, result)
    trace = Trace(progress.n, progress.point, starts, kept)
    return (progress, result, saved), trace


def _track(problem: Problem, i: int) -> Track:
    rows, output = problem.rows[i], problem.functions.outputs[i]
    stops = rows.stop, rows.reached(problem.last), problem.last + 1
    if problem.at_once:
        return Track(*stops, lambda j, point: point, problem.start)
    init = output(problem.steps.t0, problem.start[0]), jnp.asarray(True)
    value = lambda j, point: problem.output(i, problem.functions, j, point)
    return Track(*stops, value, init)


def _walk(problem: Problem, tracks: PyTree) -> tuple[Progress, PyTree]:
    """All steps, stopping where a value of a track is due."""
    steps, last, meter = problem.steps, problem.last, problem.progress_meter

    def step(progress: Progress) -> Progress:
        n = progress.n
        end, result = problem.functions.step(n, progress.point)
        done = (steps.time(n + 1) - steps.t0) / (steps.t1 - steps.t0)
        return Progress(n + 1, end, result, meter.step(progress.meter, done))

    start = Progress(jnp.asarray(0), problem.start, None, problem.meter)
    can_fail = eqx.filter_eval_shape(step, start).result is not None
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

    def more(x):
        progress, states = x
        some = unfinished(progress, last) | (reduce(jnp.minimum, due(states)) <= last)
        # Steps from a state that is not finite are of no use.
        return some & tree.all_finite(progress.point[0])

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
    steps, output = problem.steps, problem.functions.outputs[i]
    first = int(sub.t0)
    if first:
        value = output(steps.t0, problem.start[0])
        ts, ys = _put(ts, jnp.asarray(0), steps.t0), _put(ys, jnp.asarray(0), value)
    reached = rows.reached(n)
    if len(rows):
        taken = rows.taken(n)

        def place(xs: Array, x: Array) -> Array:
            keep = taken.reshape(-1, *(1,) * (x.ndim - 1))
            x = jnp.where(keep, x.astype(xs.dtype), xs[first : first + len(x)])
            return lax.dynamic_update_slice_in_dim(xs, x, first, 0)

        ts, ys = place(ts, rows.time), jtu.tree_map(place, ys, values)
    number = first + jnp.sum(reached)
    if sub.t1:
        separate = end_is_separate(sub, n)
        if separate is not None:
            value = output(steps.time(n), progress.point[0])
            ts = _put(ts, number, steps.time(n), separate)
            ys, number = _put(ys, number, value, separate), number + 1
    return ts, ys, number, jnp.sum(reached & rows.of_ts)


def end_is_separate(sub: dfx.SubSaveAt, n: Array) -> Bool[Array, ""] | None:
    """Whether the end is not also saved as one of the steps; `None` if never."""
    if sub.steps == 1:
        return None
    return n % sub.steps != 0 if sub.steps else jnp.asarray(True)
