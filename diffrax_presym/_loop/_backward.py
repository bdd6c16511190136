"""The backward pass through the steps of a solve, and through what was saved."""

from collections.abc import Callable
from functools import partial, reduce
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
from ._problem import Functions, Problem
from ._run import end_is_separate, Trace


def _zeros(x: PyTree) -> PyTree:
    """The cotangent zero, for which a `tree.Sum` is two arrays."""
    return jtu.tree_map(jnp.zeros_like, x)


class BackwardState(eqx.Module):
    """How far the backward pass has come."""

    n: Int[Array, ""]  # the number of steps left
    point: Point
    bar: PyTree  # the cotangents of the state and the solver state
    gradient: PyTree  # the cotangents of the functions so far
    left: list[Array]  # the number of rows left, of each output
    # The end of the last step, as the backward pass came to it, and from its start.
    ends: tuple[State, State]

    def add(self, gradient: PyTree, bar: PyTree) -> "BackwardState":
        where = lambda x: (x.gradient, x.bar)
        new = tree.sum((self.gradient, self.bar), (gradient, bar))
        return eqx.tree_at(where, self, new, is_leaf=lambda x: x is None)


# The state at the start of a step, of its number and the state at its end.
Start = Callable[[Array, Point], Point]


class Backward(eqx.Module):
    """The backward pass through a solve, step by step."""

    problem: Problem
    trace: Trace
    wanted: PyTree  # the differentiated leaves of the functions
    saved_bars: list[PyTree]  # the cotangents of what each output saved
    carry_bar: PyTree

    @property
    def _functions(self) -> tuple[PyTree, PyTree]:
        """What is differentiated of the functions, and the rest."""
        return eqx.partition(self.problem.functions, self.wanted)

    def _pull(self, fn: Callable[..., PyTree], bar: PyTree, *args: PyTree):
        """Pull back `fn(functions, *args)`: the cotangents of the functions and of the
        arguments."""
        moved, fixed = self._functions
        redo = lambda moved, *args: eqx.filter(
            fn(eqx.combine(moved, fixed), *args), eqx.is_inexact_array
        )
        return jax.vjp(redo, moved, *args)[1](bar)

    def end(self) -> tuple[BackwardState, list[Callable]]:
        """The end of the solve, and for each output how one of its rows is pulled back.

        Outputs that were computed all at once are pulled back here, to the starts of
        their steps.
        """
        problem, n, point = self.problem, self.trace.n, self.trace.end
        at = BackwardState(
            n,
            point,
            (_zeros(point[0]), self.carry_bar),
            _zeros(self._functions[0]),
            [jnp.sum(rows.reached(n)) for rows in problem.rows],
            (point[0], point[0]),
        )
        pulls = []
        for i, (sub, rows) in enumerate(zip(problem.subs, problem.rows, strict=True)):
            separate = end_is_separate(sub, n) if sub.t1 else None
            if separate is not None:
                row = self._row(i, int(sub.t0) + at.left[i], separate)
                at = at.add(*self._pull_point(i, n, point, row))
            pull = partial(self._pull_row, i)
            if len(rows) and problem.at_once:
                more, starts = self._pull_rows(i)
                at = at.add(more, _zeros(at.bar))
                pull = lambda at, j, starts=starts: (
                    _zeros(at.gradient),
                    jtu.tree_map(lambda x: x[j], starts),
                )
            pulls.append(pull)
        return at, pulls

    def start(self, at: BackwardState) -> BackwardState:
        """Pull back the outputs of `t0`."""
        for i, sub in enumerate(self.problem.subs):
            if sub.t0:
                row = self._row(i, jnp.asarray(0), True)
                at = at.add(*self._pull_point(i, at.n, at.point, row))
        return at

    def back_to(
        self, at: BackwardState, pulls: list[Callable], first: Array, start: Start
    ) -> BackwardState:
        """All steps back to the start of step `first`, and what was saved there."""

        def due(at: BackwardState) -> list[Any]:
            def stop(rows, left):
                stop = rows.stop[left - 1]
                return jnp.where(left > 0, jnp.where(stop < 0, at.n, stop), -1)

            pairs = zip(self.problem.rows, at.left, strict=True)
            return [stop(rows, left) if len(rows) else -1 for rows, left in pairs]

        def steps(at: BackwardState, stop: Array) -> BackwardState:
            def back(at: BackwardState) -> BackwardState:
                # Members of a batch that are done repeat a step that may be undone.
                n = jnp.maximum(at.n, stop + 1)
                return self.step(eqx.tree_at(lambda at: at.n, at, n), start)

            return lax.while_loop(lambda at: at.n > stop, back, at)

        if not any(map(len, self.problem.rows)):
            return steps(at, first)

        def more(at: BackwardState):
            return (at.n > first) | (reduce(jnp.maximum, due(at)) == at.n)

        def stop(at: BackwardState) -> BackwardState:
            wanted = due(at)
            at = steps(at, reduce(jnp.maximum, wanted, first))
            for i, step in enumerate(wanted):
                if len(self.problem.rows[i]) == 0:
                    continue
                here, left = step == at.n, list(at.left)
                pull = lambda at, i=i, left=left: at.add(*pulls[i](at, left[i] - 1))
                at = lax.cond(here, pull, lambda at: at, at)
                left[i] = jnp.where(here, left[i] - 1, left[i])
                at = eqx.tree_at(lambda at: at.left, at, left)
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
        gradient, ends = tree.sum(at.gradient, more), (at.point[0], end[0])
        return BackwardState(n, point, bar, gradient, at.left, ends)

    def _row(self, i: int, row: Array, pred: Any) -> PyTree:
        """The cotangent of one row of an output, or zero."""
        return jtu.tree_map(lambda x: jnp.where(pred, x[row], 0), self.saved_bars[i])

    def _pull_point(self, i: int, n: Array, point: Point, bar: PyTree):
        """Pull back an output saved at a step, to the functions and the state."""
        y, carry = point
        output = lambda functions, y: functions.outputs[i](
            self.problem.steps.time(n), y
        )
        gradient, y_bar = self._pull(output, bar, y)
        return gradient, (y_bar, _zeros(carry))

    def _pull_row(self, i: int, at: BackwardState, j: Array):
        """Pull back one row of an output, from the start of its step."""
        rows = self.problem.rows[i]
        bar = self._row(i, int(self.problem.subs[i].t0) + j, rows.stop[j] >= 0)

        def pull(shorter: bool):
            def output(functions: Functions, start: Point):
                return self.problem.output(i, functions, j, start, shorter)[0]

            return self._pull(output, bar, at.point)

        if not rows.may_be_inside:
            return pull(False)
        # Decided before the derivative is taken: in a batch, JAX would differentiate
        # the branch that is not taken at zeros, where an implicit step is singular.
        return lax.cond(rows.inside[j], lambda: pull(True), lambda: pull(False))

    def _pull_rows(self, i: int):
        """Pull back all rows of an output."""
        problem, rows, n = self.problem, self.problem.rows[i], self.trace.n
        taken, first = rows.taken(n), int(problem.subs[i].t0)

        def bar(x):
            keep = taken.reshape(-1, *(1,) * (x.ndim - 1))
            return jnp.where(keep, x[first : first + len(taken)], 0)

        bars = jtu.tree_map(bar, self.saved_bars[i])
        outputs = lambda functions, starts: problem.outputs(i, functions, starts, n)[0]
        return self._pull(outputs, bars, self.trace.starts[i])
