"""The backward pass through the steps of a solve, and through what was saved."""

import abc
from collections.abc import Callable
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int, PyTree

from .. import _tree as tree
from .._numbers import State
from .._scheme._base import Point
from ._nodes import NODES, Stencils
from ._problem import Functions, Problem
from ._run import end_is_separate, Trace
from ._tracks import put, stack


def _zeros(x: PyTree) -> PyTree:
    """The cotangent zero, for which a `tree.Sum` is two arrays."""
    return jtu.tree_map(jnp.zeros_like, x)


class BackwardState(eqx.Module):
    """How far the backward pass has come."""

    n: Int[Array, ""]  # the number of steps left
    point: Point
    bar: PyTree  # the cotangents of the state and the solver state
    gradient: PyTree  # the cotangents of the functions so far
    tracks: list[PyTree]  # the states of `Backward.tracks`
    # The end of the last step, as the backward pass came to it, and from its start.
    ends: tuple[State, State]

    def add(self, gradient: PyTree, bar: PyTree) -> "BackwardState":
        where = lambda x: (x.gradient, x.bar)
        new = tree.add((self.gradient, self.bar), (gradient, bar))
        return eqx.tree_at(where, self, new, is_leaf=lambda x: x is None)


# The state at the start of a step, of its number and the state at its end.
Start = Callable[[Array, Point], Point]


class Backward(eqx.Module):
    """The backward pass through a solve, step by step."""

    problem: Problem
    trace: Trace
    wanted: PyTree  # the differentiated leaves of the functions
    saved_bars: list[PyTree]  # the cotangents of the times and values of each output
    carry_bar: PyTree

    @property
    def _functions(self) -> tuple[PyTree, PyTree]:
        """What is differentiated of the functions, and the rest."""
        return eqx.partition(self.problem.functions, self.wanted)

    def pull(self, fn: Callable[..., PyTree], bar: PyTree, *args: PyTree):
        """Pull back `fn(functions, *args)`: the cotangents of the functions and of the
        arguments."""
        moved, fixed = self._functions
        redo = lambda moved, *args: eqx.filter(
            fn(eqx.combine(moved, fixed), *args), eqx.is_inexact_array
        )
        return jax.vjp(redo, moved, *args)[1](bar)

    def end(self) -> BackwardState:
        """The end of the solve."""
        problem, n, point = self.problem, self.trace.n, self.trace.end
        at = BackwardState(
            n,
            point,
            (_zeros(point[0]), self.carry_bar),
            _zeros(self._functions[0]),
            [track.start(self) for track in self.tracks],
            (point[0], point[0]),
        )
        for i, (sub, rows) in enumerate(zip(problem.subs, problem.rows, strict=True)):
            separate = end_is_separate(sub, n) if sub.t1 else None
            if separate is not None:
                last = int(sub.t0) + jnp.sum(rows.reached(n))
                row = self.row(i, last, separate)
                at = at.add(*self._pull_point(i, n, point, row))
        return at

    @property
    def tracks(self) -> list["AbstractPull"]:
        problem, tracks = self.problem, []
        for i, (rows, stencils) in enumerate(
            zip(problem.rows, problem.stencils, strict=True)
        ):
            tracks += [PullRows(i, rows.stop)] if len(rows) else []
            tracks += [] if stencils is None else [PullNodes(i, stencils)]
        return tracks

    def start(self, at: BackwardState) -> BackwardState:
        """Pull back the outputs of `t0`."""
        for i, sub in enumerate(self.problem.subs):
            if sub.t0:
                row = self.row(i, jnp.zeros((), int), True)
                at = at.add(*self._pull_point(i, at.n, at.point, row))
        return at

    def back_to(self, at: BackwardState, first: Array, start: Start) -> BackwardState:
        """All steps back to the start of step `first`, and what was saved there."""
        tracks = self.tracks

        def due(at: BackwardState) -> list[Array]:
            pairs = zip(tracks, at.tracks, strict=True)
            return [track.due(state, at.n) for track, state in pairs]

        def steps(at: BackwardState, stop: Array) -> BackwardState:
            def back(at: BackwardState) -> BackwardState:
                # Members of a batch that are done repeat a step that may be undone.
                n = jnp.maximum(at.n, stop + 1)
                return self.step(eqx.tree_at(lambda at: at.n, at, n), start)

            return lax.while_loop(lambda at: at.n > stop, back, at)

        if not tracks:
            return steps(at, first)

        def more(at: BackwardState):
            return (at.n > first) | (reduce(jnp.maximum, due(at)) == at.n)

        def stop(at: BackwardState) -> BackwardState:
            wanted = due(at)
            at = steps(at, reduce(jnp.maximum, wanted, first))
            for i, (track, wanted_step) in enumerate(zip(tracks, wanted, strict=True)):

                def pull(at: BackwardState, i=i, track=track) -> BackwardState:
                    at, state = track.pull(self, at, at.tracks[i])
                    return eqx.tree_at(lambda at: at.tracks[i], at, state)

                at = lax.cond(wanted_step == at.n, pull, lambda at: at, at)
            return at

        return lax.while_loop(more, stop, at)

    def step(self, at: BackwardState, start: Start) -> BackwardState:
        """One step back."""
        n = at.n - 1
        point = start(n, at.point)
        moved, fixed = self._functions

        def redo(moved, point):
            return eqx.combine(moved, fixed).step(n, point)[0]

        end, pull = jax.vjp(redo, moved, point)
        more, bar = pull(at.bar)
        gradient, ends = tree.add(at.gradient, more), (at.point[0], end[0])
        return BackwardState(n, point, bar, gradient, at.tracks, ends)

    def row(self, i: int, row: Array, pred: Any) -> PyTree:
        """The cotangents of the time and the value of one row of an output, or zero."""
        return jtu.tree_map(lambda x: jnp.where(pred, x[row], 0), self.saved_bars[i])

    def _pull_point(self, i: int, n: Array, point: Point, bar: PyTree):
        """Pull back an output saved at a step, to the functions and the state."""

        def output(functions: Functions, point: Point):
            # A solve that `max_steps` ends may do so at a time that depends on states.
            time = self.problem.steps.begin(n, point)
            return time, functions.outputs[i](time, point[0])

        return self.pull(output, bar, point)


class AbstractPull(eqx.Module):
    """How what a track collected is pulled back, on the way back."""

    i: int = eqx.field(static=True)  # the output

    @abc.abstractmethod
    def start(self, backward: Backward) -> PyTree:
        """The state at the end of the solve."""

    @abc.abstractmethod
    def due(self, state: PyTree, n: Array) -> Array:
        """The next step at whose start something is pulled back, from step `n` on."""

    @abc.abstractmethod
    def pull(
        self, backward: Backward, at: BackwardState, state: PyTree
    ) -> tuple[BackwardState, PyTree]:
        """Pull back what is due."""


class PullRows(AbstractPull):
    """Values at steps, or of shorter ones from there; the state is their number."""

    stops: Array

    def start(self, backward):
        problem, i = backward.problem, self.i
        number = jnp.sum(problem.rows[i].reached(backward.trace.n))
        stencils = problem.stencils[i]
        return number if stencils is None else jnp.minimum(number, stencils.latest)

    def due(self, state, n):
        stop = self.stops[state - 1]
        return jnp.where(state > 0, jnp.where(stop < 0, n, stop), -1)

    def pull(self, backward, at, state):
        i, j, problem = self.i, state - 1, backward.problem
        rows = problem.rows[i]
        taken = rows.stop[j] >= 0
        if (stencils := problem.stencils[i]) is not None:
            taken &= j < stencils.begin
        bar = backward.row(i, int(problem.subs[i].t0) + j, taken)

        def pull(shorter: bool):
            def output(functions: Functions, start: Point):
                return problem.output(i, functions, j, start, shorter)[:2]

            return backward.pull(output, bar, at.point)

        if not rows.may_be_inside:
            return at.add(*pull(False)), j
        # Decided before the derivative is taken: in a batch, JAX would differentiate
        # the branch that is not taken at zeros, where an implicit step is singular.
        pulled = lax.cond(rows.inside[j], lambda: pull(True), lambda: pull(False))
        return at.add(*pulled), j


class PullNodes(AbstractPull):
    """Values between steps, by the cotangents of the last few nodes."""

    stencils: Stencils

    def start(self, backward):
        n, node = backward.trace.n, stack(backward.trace.end[0], 3)
        # The first that is not known.
        number = jnp.argmax(self.stencils.last(slice(None)) > n)
        return n + 1, n + 1, number, _zeros(stack(node, NODES))

    def due(self, state, n):
        node, low, j, _ = state
        last = self.stencils.last(j - 1)
        row = jnp.where(last < 0, n, last)
        row = jnp.where(j > self.stencils.earliest, row, -1)
        return jnp.where(node > low, node - 1, row)

    def pull(self, backward, at, state):
        problem, i, n = backward.problem, self.i, at.n
        rows, start = problem.rows[i], problem.start[0]

        def spread(x):
            gradient, low, j, bars = x
            j = j - 1
            taken = (rows.stop[j] >= 0) & (j >= self.stencils.begin)
            _, bar = backward.row(i, int(problem.subs[i].t0) + j, taken)
            # Of the others nothing may fail of which a gradient takes zero times.
            time = jnp.where(taken, rows.time[j], problem.steps.t0)
            y = jtu.tree_map(lambda x: x[j], backward.trace.between[i])
            y = tree.where(taken, y, start)
            output = lambda functions, y: functions.outputs[i](time, y)
            more, bar = backward.pull(output, bar, y)
            bars = self.stencils.spread(j, bar, bars)
            low = jnp.where(rows.stop[j] >= 0, self.stencils.first[j], low)
            return tree.add(gradient, more), low, j, bars

        def unspread(x):
            last = self.stencils.last(x[2] - 1)
            return (x[2] > self.stencils.earliest) & ((last < 0) | (last >= n))

        def pull(side: Array, at: BackwardState, bars: PyTree):
            node = lambda functions, point: functions.node(n, side, point)
            bar = jtu.tree_map(lambda x: x[n % NODES], bars)
            at = at.add(*backward.pull(node, bar, at.point))
            return at, put(bars, n % NODES, _zeros(bar))

        _, low, j, bars = state
        kink, kinks = jnp.zeros((), int), problem.steps.kinks
        if kinks is not None:
            kink = jnp.any(kinks == n).astype(int)
            after = lambda: pull(kink, at, bars)
            at, bars = lax.cond(kink == 1, after, lambda: (at, bars))
        gradient, low, j, bars = lax.while_loop(
            unspread, spread, (at.gradient, low, j, bars)
        )
        at = eqx.tree_at(lambda at: at.gradient, at, gradient, is_leaf=_is_none)
        at, bars = pull(-kink, at, bars)
        return at, (n, low, j, bars)


_is_none = lambda x: x is None
