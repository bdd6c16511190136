"""The loop over steps, and what is saved.

Diffrax's loop asks after each step whether something is to be saved in it. Where the
steps, and those in which the saved times fall, are known beforehand, the loop runs from
one to the next without asking. Between steps the solution is interpolated from the ends
of several, or a shorter step of the scheme.
"""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree

from .. import _tree as tree
from .._numbers import State
from .._results import NONFINITE
from .._scheme._base import Point
from .._scheme._engine import cheap_iterations
from ._base import MOST_STEPS, Stop
from ._problem import Problem
from ._rows import Row, Rows, stops_due
from ._tracks import AbstractTrack, Between, put, Track
from ._variable import VariableSteps
from ._within import Timed


# The steps of a loop whose length is known, for which the host does not wait on a GPU.
_BLOCK = 32


class Progress(eqx.Module):
    """How far a solve has come."""

    n: Int[Array, ""]
    point: Point
    result: dfx.RESULTS | None  # `None` if no step can fail
    meter: PyTree
    before: Point | None  # the start of the last step, if that may be cut off


class Trace(eqx.Module):
    """What a gradient needs of a solve: its end and states along the way."""

    n: Int[Array, ""]
    end: Point
    between: list[PyTree]  # the states in interpolated rows, of each output
    kept: PyTree  # the steps whose starting states are kept, and these
    before: Point | None  # as in `Progress`
    rows: list[Rows]  # of which the steps are known now
    interpolated: Int[Array, ""]  # how many of these a polynomial followed


def run(problem: Problem, kept: AbstractTrack | None = None):
    """The end of a solve, what each output saved, and a trace, with the states `kept`
    for a gradient."""
    number, keep = len(problem.rows), kept is not None
    tracks = [_track(problem, i, keep) for i in range(number)]
    end, n, (stacked, kept_states) = _run_steps(problem, (tracks, kept))
    progress = eqx.tree_at(lambda x: x.n, end, n)

    saved, between = [], []
    finite = tree.all_finite((progress.point[0], problem.steps.t0))
    all_rows, interpolated = [], problem.number_interpolated
    for i, collected in enumerate(stacked):
        values, ys, rows = None, None, problem.rows[i]
        if problem.stencils[i] is not None:
            (values, ys), good = collected
            finite &= good
        elif collected is not None:
            if not rows.has_times:
                time, *collected = collected
                rows = rows.at(time)
            elif not problem.steps.are_known:
                found, *collected, kept_row = collected
                rows = rows.found(found.step, found.inside)
                ys = found.interpolated, kept_row
                interpolated += jnp.sum(rows.taken(progress.n) & found.interpolated)
            values, each = collected
            finite &= jnp.all(each | ~rows.taken(progress.n))
        saved.append(values)
        between.append(ys)
        all_rows.append(rows)
    success: Any = dfx.RESULTS.successful
    result = success if progress.result is None else progress.result
    bad = (result == success) & ~finite
    result = dfx.RESULTS.where(bad, NONFINITE, result)
    result = problem.explain(progress.n, progress.point, result)
    ended = problem.steps.ended(progress.n, progress.point)
    short = (result == success) & ~ended
    result = dfx.RESULTS.where(short, dfx.RESULTS.max_steps_reached, result)
    about = all_rows, interpolated
    trace = Trace(end.n, end.point, between, kept_states, end.before, *about)
    return (progress, result, saved), trace


def _track(problem: Problem, i: int, keep: bool) -> AbstractTrack | None:
    """What output `i` collects: values, and the states of those between steps if they
    are to `keep`."""
    rows, stencils, functions = problem.rows[i], problem.stencils[i], problem.functions
    if len(rows) == 0:
        return None
    y, output = problem.start[0], functions.outputs[i]
    init, due = output(problem.steps.t0, y), rows.reached(problem.last)
    saved = partial(problem.output, i, functions)
    stops = stops_due(rows.stop, due, problem.last + 1)
    if not rows.has_times:
        init = problem.steps.t0, init, jnp.asarray(True)
        return Track(stops, rows.each, saved, init)
    if isinstance(problem.steps, VariableSteps):
        shorter = None
        if functions.shorter is not None:
            shorter = partial(problem.between, functions)
        how = functions.end, shorter, output, keep
        return Timed(problem.steps, problem.last, rows.time, *how, y, init)
    if stencils is None:
        value = lambda row, point: saved(row, point)[1:]
        return Track(stops, rows.each, value, (init, jnp.asarray(True)))
    assert functions.node is not None

    def step(row: Row, point: Point) -> State:
        return problem.between(functions, row.stop, point, row.time, row.inside)

    kept = lambda y: y if keep else None
    value = lambda row, y: (output(row.time, y), kept(y))
    init, about = (init, kept(y)), (problem.steps.kinks, rows.each)
    stops = stencils.stops(rows, problem.last)
    return Between(stencils, stops, *about, step, functions.node, value, y, init)


def _run_steps(problem: Problem, tracks: PyTree) -> tuple[Progress, Array, PyTree]:
    """All steps, stopping where a value of a track is due, until none of a batch is
    left; the number of steps until each ended or was not finite; and what the tracks
    collected."""
    steps, last, meter = problem.steps, problem.last, problem.progress_meter
    may_be_cut = not steps.are_known and tracks[1] is not None

    def step(progress: Progress) -> Progress:
        n, point = progress.n, progress.point
        end, result = problem.functions.step(n, point)
        done = (steps.begin(n + 1, end) - steps.t0) / (steps.t1 - steps.t0)
        before = point if may_be_cut else None
        return Progress(n + 1, end, result, meter.step(progress.meter, done), before)

    before = problem.start if may_be_cut else None
    zero = jnp.zeros((), int)
    start = Progress(zero, problem.start, None, problem.meter, before)
    can_fail = eqx.filter_eval_shape(step, start).result is not None
    if can_fail:
        success = jtu.tree_map(jnp.asarray, dfx.RESULTS.successful)
        start = eqx.tree_at(lambda x: x.result, start, success, is_leaf=_is_none)

    def good(progress: Progress) -> Any:
        return True if not can_fail else progress.result == dfx.RESULTS.successful

    def unfinished(progress: Progress, stop: Stop) -> Bool[Array, ""]:
        return steps.before(stop, progress.n, progress.point) & good(progress)

    def advance_to(stop: Stop, progress: Progress, soon: Any) -> Progress:
        if not (cheap_iterations() or can_fail):
            block = lambda x: lax.fori_loop(0, _BLOCK, lambda _, x: step(x), x)
            several = lambda progress: progress.n + _BLOCK <= stop.n
            progress = lax.while_loop(several, block, progress)
        more = lambda x: steps.together(unfinished(x, stop), soon)
        return lax.while_loop(more, step, progress)

    is_track = lambda x: isinstance(x, AbstractTrack)
    flat, structure = jtu.tree_flatten(tracks, is_leaf=is_track)
    due = lambda states: [
        track.due(state) for track, state in zip(flat, states, strict=True)
    ]

    def stop(x):
        progress, states, reached, going = x
        wanted = due(states)
        first, new = steps.next_stop(wanted, last), []
        # Members of a batch stop together, at the first step where one of them is to.
        common = first._replace(n=steps.common(first.n, going))
        soon = going & (common.n == progress.n + 1)
        progress = advance_to(steps.next_stop([common], last), progress, soon)
        n, point = steps.number(common, progress.n), progress.point
        for track, state, next_stop in zip(flat, states, wanted, strict=True):
            here = steps.at(next_stop, n, point) & (n <= last)
            # Members that take the same steps are here together.
            alike = here if steps.are_known else here & going
            new.append(track.visit(state, n, point, alike))
        reached = jnp.where(going, progress.n, reached)
        return progress, new, reached, proceeds(progress, new)

    def proceeds(progress: Progress, states: list[PyTree]) -> Bool[Array, ""]:
        n, point, end = progress.n, progress.point, Stop(last)
        first = steps.next_stop(due(states), jnp.asarray(MOST_STEPS, last.dtype))
        some = unfinished(progress, end)
        some |= steps.is_left(first, last, n, point) & good(progress)
        # Steps from a state that is not finite are of no use.
        return some & tree.all_finite(point[0])

    states = [track.start() for track in flat]
    if not flat:
        end = advance_to(Stop(last), start, jnp.asarray(False))
        return end, end.n, jtu.tree_unflatten(structure, [])
    # The end is a stop too, so that there is one loop over steps.
    first = start, states, zero, proceeds(start, states)
    more = lambda x: tree.any_member(x[-1])
    end, states, n, _ = lax.while_loop(more, stop, first)
    rows = [track.rows(state) for track, state in zip(flat, states, strict=True)]
    return end, n, jtu.tree_unflatten(structure, rows)


_is_none = lambda x: x is None


def saved_rows(
    problem: Problem, i: int, rows: Rows, buffer, values, progress: Progress
):
    """The final times and values of output `i`, from those that Diffrax allocated, and
    the numbers of rows and of times of `ts` that were saved."""
    (ts, ys), sub, n = buffer, problem.subs[i], progress.n
    steps, output = problem.steps, problem.functions.outputs[i]
    first = int(sub.t0)
    if first:
        value = output(steps.t0, problem.start[0])
        ts, ys = (
            put(ts, jnp.zeros((), int), steps.t0),
            put(ys, jnp.zeros((), int), value),
        )
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
            time = steps.begin(n, progress.point)
            value = output(time, progress.point[0])
            ts = put(ts, number, time, separate)
            ys, number = put(ys, number, value, separate), number + 1
    return ts, ys, number, jnp.sum(reached & rows.of_ts)


def end_is_separate(sub: dfx.SubSaveAt, n: Array) -> Bool[Array, ""] | None:
    """Whether the end is not also saved as one of the steps; `None` if never."""
    if sub.steps == 1:
        return None
    return n % sub.steps != 0 if sub.steps else jnp.asarray(True)
