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
from ._one_function import as_own_function
from ._problem import Functions, Problem
from ._run import end_is_separate, Trace


def zeros(x: PyTree) -> PyTree:
    """The cotangent zero, for which a `tree.Sum` is two arrays."""
    return jtu.tree_map(jnp.zeros_like, x)


def _vjp(n: Array, fn: Callable[..., PyTree], bar: PyTree, *args: PyTree):
    """The value of `fn(*args)`, and the cotangents of the arguments."""
    value, pull = as_own_function(lambda: jax.vjp(fn, *args), n)
    return value, as_own_function(lambda: pull(bar), n)


class BackwardState(eqx.Module):
    """How far the backward pass has come."""

    n: Int[Array, ""]  # the number of steps left
    point: Point
    bar: PyTree  # the cotangents of the state and the solver state
    gradient: PyTree  # the cotangents of the functions so far
    tracks: list[PyTree]  # the states of those of `Backward`
    # The end of the last step, as the backward pass came to it, and from its start.
    ends: tuple[State, State]

    def add(self, gradient: PyTree, bar: PyTree) -> "BackwardState":
        where = lambda x: (x.gradient, x.bar)
        new = tree.add((self.gradient, self.bar), (gradient, bar))
        return eqx.tree_at(where, self, new, is_leaf=lambda x: x is None)


# The state at the start of a step, of its number and the state at its end.
Start = Callable[[Array, Point], Point]


class Backward(eqx.Module):
    """The backward pass through a solve, step by step, and through what its tracks
    collected."""

    problem: Problem
    trace: Trace
    wanted: PyTree  # the differentiated leaves of the functions
    saved_bars: list[PyTree]  # the cotangents of the times and values of each output
    carry_bar: PyTree
    tracks: list["AbstractPull"]

    @property
    def _functions(self) -> tuple[PyTree, PyTree]:
        """What is differentiated of the functions, and the rest."""
        return eqx.partition(self.problem.functions, self.wanted)

    def pull(self, n: Array, fn: Callable[..., PyTree], bar: PyTree, *args: PyTree):
        """Pull back `fn(functions, *args)`, in iteration `n` of a loop: the cotangents
        of the functions and of the arguments."""
        moved, fixed = self._functions
        redo = lambda moved, *args: eqx.filter(
            fn(eqx.combine(moved, fixed), *args), eqx.is_inexact_array
        )
        return _vjp(n, redo, bar, moved, *args)[1]

    def end(self) -> BackwardState:
        """The end of the solve."""
        problem, n, point = self.problem, self.trace.n, self.trace.end
        at = BackwardState(
            n,
            point,
            (zeros(point[0]), self.carry_bar),
            zeros(self._functions[0]),
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

    def start(self, at: BackwardState) -> BackwardState:
        """Pull back the outputs of `t0`."""
        for i, sub in enumerate(self.problem.subs):
            if sub.t0:
                row = self.row(i, jnp.zeros((), int), True)
                at = at.add(*self._pull_point(i, at.n, at.point, row))
        return at

    def begin(self, at: BackwardState) -> BackwardState:
        """Pull back what the solve begins with besides the state."""
        if self.problem.functions.begin is None:
            return at
        redo, y = (lambda functions, y: functions.begin(y)), self.problem.start[0]
        gradient, bar = self.pull(at.n, redo, at.bar[1], y)
        return at.add(gradient, (bar, zeros(at.bar[1])))

    def back_to(self, at: BackwardState, first: Array, start: Start) -> BackwardState:
        """All steps back to the start of step `first`, and what was saved there."""
        # Members of a batch may have ended before.
        tracks, first = self.tracks, jnp.minimum(first, at.n)

        def due(at: BackwardState) -> list[Array]:
            pairs = zip(tracks, at.tracks, strict=True)
            return [track.due(state, at.n) for track, state in pairs]

        def steps(at: BackwardState, stop: Array, soon: Array) -> BackwardState:
            all_steps = self.problem.steps
            left = lambda at: all_steps.together(at.n > stop, soon)

            def back(at: BackwardState) -> BackwardState:
                # Members of a batch that are done repeat a step that may be undone.
                n = jnp.maximum(at.n, stop + 1)
                return self.step(eqx.tree_at(lambda at: at.n, at, n), start)

            return lax.while_loop(left, back, at)

        if not tracks:
            return steps(at, first, jnp.asarray(False))

        def more(at: BackwardState):
            return (at.n > first) | (reduce(jnp.maximum, due(at)) == at.n)

        def stop(at: BackwardState) -> BackwardState:
            wanted = due(at)
            # Members of a batch stop together, as on the way there.
            own = reduce(jnp.maximum, wanted, first)
            going = more(at)
            n = -self.problem.steps.common(-own, going)
            # All stop where one is to: a step back costs more than what is done there.
            at = steps(at, jnp.maximum(n, first), going)
            for i, (track, wanted_step) in enumerate(zip(tracks, wanted, strict=True)):

                def pull(at: BackwardState, i=i, track=track) -> BackwardState:
                    at, state = track.pull(self, n, at, at.tracks[i])
                    return eqx.tree_at(lambda at: at.tracks[i], at, state)

                here = (wanted_step == n) & (at.n == n)
                at = lax.cond(here, pull, lambda at: at, at)
            return at

        return lax.while_loop(more, stop, at)

    def step(self, at: BackwardState, start: Start) -> BackwardState:
        """One step back."""
        n = at.n - 1
        point = as_own_function(lambda: start(n, at.point), n)
        moved, fixed = self._functions

        def redo(moved, point):
            return eqx.combine(moved, fixed).step(n, point)[0]

        end, (more, bar) = _vjp(n, redo, at.bar, moved, point)
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

        return self.pull(n, output, bar, point)


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
        self, backward: Backward, n: Array, at: BackwardState, state: PyTree
    ) -> tuple[BackwardState, PyTree]:
        """Pull back what is due at the start of step `n`."""
