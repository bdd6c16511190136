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
from .._scheme._base import advance, Point, Scheme
from .._scheme._engine import prepare, Span, vjp, vjp_step
from ._run import end_is_separate, Problem, Trace


def _zeros(x: PyTree) -> PyTree:
    """The cotangent zero, for which a `tree.Sum` is two arrays."""
    return jtu.tree_map(jnp.zeros_like, x)


class Position(eqx.Module):
    """How far the backward pass has come."""

    n: Int[Array, ""]  # the number of steps left
    point: Point
    bar: PyTree  # the cotangents of the state and the solver state
    gradient: PyTree  # the cotangents of the parameters so far
    shared: PyTree  # the cotangents of what all steps share, so far
    left: list[Array]  # the number of rows left, of each output

    def add(self, gradient: PyTree, bar: PyTree) -> "Position":
        where = lambda x: (x.gradient, x.bar)
        new = tree.sum((self.gradient, self.bar), (gradient, bar))
        return eqx.tree_at(where, self, new, is_leaf=lambda x: x is None)


class Backward(eqx.Module):
    """The backward pass through a solve, step by step."""

    problem: Problem
    trace: Trace
    # The differentiated leaves of the system and of the functions of `SaveAt`.
    wanted: PyTree
    saved_bars: list[PyTree]  # the cotangents of what each output saved
    carry_bar: PyTree
    shared: PyTree  # what all steps share, and their inverses
    shared_back: PyTree

    def __init__(self, problem: Problem, trace: Trace, wanted, bars):
        self.problem, self.trace, self.wanted = problem, trace, wanted
        self.saved_bars, self.carry_bar = bars
        self.shared = problem.prepare(problem.system)
        self.shared_back = problem.prepare(problem.system, backward=True)

    @property
    def scheme(self) -> Scheme:
        return self.problem.scheme

    @property
    def _parameters(self) -> tuple[PyTree, PyTree]:
        """The parameters that are differentiated, and the others."""
        both = self.problem.system, self.problem.fns
        return eqx.partition(both, self.wanted)

    def span(self, n: Array) -> Span:
        return self.problem.steps.span(self.problem.system, n)

    def advance(self, n: Array, point: Point) -> Point:
        """The state after step `n`."""
        args = self.scheme, self.problem.system, self.span(n), point, self.shared
        return advance(*args)[0]

    def end(self) -> tuple[Position, list[Callable]]:
        """The end of the solve, and for each output how one of its rows is pulled back.

        Outputs that were computed all at once are pulled back here, to the starts of
        their steps.
        """
        problem, n, point = self.problem, self.trace.n, self.trace.end
        moved, _ = self._parameters
        at = Position(
            n,
            point,
            (_zeros(point[0]), self.carry_bar),
            _zeros(moved),
            _zeros(eqx.filter(self.shared, eqx.is_inexact_array)),
            [jnp.sum(rows.reached(n)) for rows in problem.rows],
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

    def start(self, at: Position) -> Position:
        """Pull back the outputs of `t0`, and what all steps share."""
        for i, sub in enumerate(self.problem.subs):
            if sub.t0:
                row = self._row(i, jnp.asarray(0), True)
                at = at.add(*self._pull_point(i, at.n, at.point, row))
        if self.shared is None:
            return at
        gradient = self._pull_prepared(self.problem.prepare, at.shared)
        return at.add(gradient, _zeros(at.bar))

    def back_to(
        self, at: Position, pulls: list[Callable], first: Array, start: Callable
    ) -> Position:
        """All steps back to the start of step `first`, and what was saved there.

        `start` gives the state at the start of a step, if it is known.
        """

        def due(at: Position) -> list[Any]:
            pairs = zip(self.problem.rows, at.left, strict=True)
            return [
                jnp.where(left > 0, rows.stop[left - 1], -1) if len(rows) else -1
                for rows, left in pairs
            ]

        def steps(at: Position, stop: Array) -> Position:
            def back(at: Position) -> Position:
                # Members of a batch that are done repeat a step that may be undone.
                n = jnp.maximum(at.n, stop + 1)
                at = eqx.tree_at(lambda at: at.n, at, n)
                return self.step(at, start(n - 1))

            return lax.while_loop(lambda at: at.n > stop, back, at)

        if not any(map(len, self.problem.rows)):
            return steps(at, first)

        def more(at: Position):
            return (at.n > first) | (reduce(jnp.maximum, due(at)) == at.n)

        def stop(at: Position) -> Position:
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

    def step(self, at: Position, start: Any = None) -> Position:
        """One step back; `start` is the state at its start, if known."""
        n, system, moves = at.n - 1, self.problem.system, self.scheme.moves
        span, (wanted, _) = self.span(n), self.wanted
        once = self.shared is not None
        data = self.shared if once else prepare(moves, system, span)
        back = self.shared_back
        if start is None and not once:
            back = prepare(moves, system, span, backward=True)
        if start is None:
            args = system, wanted, span, (data, back), at.point, at.bar
            start, more, prepared, bar = vjp_step(moves, *args)
        else:
            args = system, wanted, span, data, start, at.bar
            more, prepared, bar = vjp(moves, *args)
        moved, _ = self._parameters
        gradient = tree.sum(at.gradient, (more, _zeros(moved[1])))
        shared = at.shared
        if once:
            prepared = eqx.filter(prepared, eqx.is_inexact_array)
            shared = tree.sum(shared, prepared)
        else:
            fn = lambda system: prepare(moves, system, span)
            gradient = tree.sum(gradient, self._pull_prepared(fn, prepared))
        return Position(n, start, bar, gradient, shared, at.left)

    def _pull_prepared(self, fn: Callable, bar: PyTree) -> PyTree:
        """Pull back what was prepared, to the parameters."""
        moved, fixed = self._parameters

        def prepared(moved):
            system, _ = eqx.combine(moved, fixed)
            return eqx.filter(fn(system), eqx.is_inexact_array)

        bar = eqx.filter(bar, eqx.is_inexact_array)
        return jax.vjp(prepared, moved)[1](bar)[0]

    def _row(self, i: int, row: Array, pred: Any) -> PyTree:
        """The cotangent of one row of an output, or zero."""
        return jtu.tree_map(lambda x: jnp.where(pred, x[row], 0), self.saved_bars[i])

    def _pull_point(self, i: int, n: Array, point: Point, bar: PyTree):
        """Pull back an output saved at a step, to the parameters and the state."""
        y, carry = point
        moved, fixed = self._parameters
        t = self.problem.steps.time(n)

        def output(moved, y):
            system, fns = eqx.combine(moved, fixed)
            return eqx.filter(fns[i](t, y, system.args), eqx.is_inexact_array)

        gradient, y_bar = jax.vjp(output, moved, y)[1](bar)
        return gradient, (y_bar, _zeros(carry))

    def _pull_row(self, i: int, at: Position, j: Array):
        """Pull back one row of an output, from the start of its step."""
        moved, fixed = self._parameters
        bar = self._row(i, int(self.problem.subs[i].t0) + j, True)
        rows = self.problem.rows[i]

        def pull(shorter: bool):
            def output(moved, start):
                parameters = eqx.combine(moved, fixed)
                saved, _ = self.problem.output(i, parameters, j, start, shorter)
                return eqx.filter(saved, eqx.is_inexact_array)

            return jax.vjp(output, moved, at.point)[1](bar)

        if not rows.may_be_inside:
            return pull(False)
        # Decided before the derivative is taken: in a batch, JAX would differentiate
        # the branch that is not taken at zeros, where an implicit step is singular.
        return lax.cond(rows.inside[j], lambda: pull(True), lambda: pull(False))

    def _pull_rows(self, i: int):
        """Pull back all rows of an output."""
        problem, rows, n = self.problem, self.problem.rows[i], self.trace.n
        moved, fixed = self._parameters

        def outputs(moved, starts):
            parameters = eqx.combine(moved, fixed)
            saved, _ = problem.outputs(i, parameters, starts, n)
            return eqx.filter(saved, eqx.is_inexact_array)

        reached, first = rows.reached(n), int(problem.subs[i].t0)

        def bar(x):
            keep = reached.reshape(-1, *(1,) * (x.ndim - 1))
            return jnp.where(keep, x[first : first + len(reached)], 0)

        bars = jtu.tree_map(bar, self.saved_bars[i])
        return jax.vjp(outputs, moved, self.trace.starts[i])[1](bars)
