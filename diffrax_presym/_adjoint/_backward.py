"""The backward pass through the steps of a solve, and through what was saved."""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._loop import Inputs, Plan, Trace
from .._misc import tree_sum
from .._scan import repeat
from .._solver._engine import Span, undo, vjp, vjp_step


class Position(NamedTuple):
    """How far the backward pass has come."""

    n: Array  # the number of steps left
    state: tuple[PyTree, PyTree]
    bar: tuple[PyTree, PyTree]  # the cotangents of the state
    gradient: PyTree  # the cotangents of the parameters so far
    left: list[Array]  # the number of outputs left, of each kind


class _Saved(NamedTuple):
    """Outputs of one kind, in the order of time."""

    number: Array
    step: Callable[[Array], Array]  # the step from whose start each is computed
    pull: Callable[[Position, Array], tuple[PyTree, PyTree]]  # of one of them


class Backward:
    """The backward pass through a solve, step by step."""

    def __init__(self, inputs: Inputs, perturbed: Inputs, final, trace: Trace, bars):
        self.plan, self.trace = Plan(inputs), trace
        self.system, self.solver = self.plan.system, self.plan.solver
        # The differentiated leaves of the system, and of all parameters.
        self.wanted, _ = perturbed.parameters
        self.moved, self.fixed = eqx.partition(inputs.parameters, perturbed.parameters)
        self.dense = _materialise(final.dense_infos, bars.dense_infos)
        self.carried = _materialise(final.solver_state, bars.solver_state)
        split = self.plan.structure.flatten_up_to
        self.bars = [
            _materialise(save.ys, bar.ys)
            for save, bar in zip(
                split(final.save_state), split(bars.save_state), strict=True
            )
        ]

    def advance(self, n: Array, state: PyTree) -> PyTree:
        """The state after step `n`."""
        return self.solver.advance(self.system, *self.plan.span(n), *state)[:2]

    def end(self) -> Position:
        """The end of the solve, where also outputs between steps are pulled back to
        the starts of their steps, if they were all computed at once."""
        n, plan, state = self.trace.n, self.plan, self.trace.end
        zeros = partial(jtu.tree_map, jnp.zeros_like)
        gradient, bar = zeros(self.moved), (zeros(state[0]), self.carried)
        self.saved: list[_Saved] = []
        for i, output in enumerate(plan.outputs):
            if output.t1:
                row = self._row(i, output.saved(n), output.end_is_separate(n))
                pulled = self._pull_state(i, n, state, row)
                gradient, bar = tree_sum((gradient, bar), pulled)
            if output.every:
                self.saved.append(self._every(i))
            if len(output.held):
                starts = self.trace.starts[i]
                pull = partial(self._pull_time, i)
                if starts is not None:
                    more, rows = self._pull_all(i, starts)
                    gradient = tree_sum(gradient, more)
                    pull = lambda at, j, rows=rows: (
                        zeros(self.moved),
                        jtu.tree_map(lambda x: x[j], rows),
                    )
                begin = jnp.where(output.empty, 0, output.start)
                step = lambda j, begin=begin: begin[j]
                self.saved.append(_Saved(output.times(n), step, pull))
        return Position(n, state, bar, gradient, [x.number for x in self.saved])

    def start(self, at: Position) -> Position:
        """Pull back the outputs of `t0`."""
        for i, output in enumerate(self.plan.outputs):
            if output.first:
                row = self._row(i, jnp.asarray(0), True)
                at = _add(at, self._pull_state(i, at.n, at.state, row))
        return at

    def back_to(self, at: Position, first: Array, start: Callable) -> Position:
        """All steps back to the start of step `first`, and what was saved there.

        `start` gives the state at the start of a step, if it is known.
        """

        def due(at: Position) -> list[Array]:
            pairs = zip(self.saved, at.left, strict=True)
            return [jnp.where(x > 0, saved.step(x - 1), -1) for saved, x in pairs]

        def steps(at: Position, stop: Array) -> Position:
            back = lambda at: self.step(at, start(at.n - 1))
            return repeat(lambda at: at.n - stop, back, at)

        if not self.saved:
            return steps(at, first)

        def more(at: Position):
            return (at.n > first) | (reduce(jnp.maximum, due(at)) == at.n)

        def stop(at: Position) -> Position:
            wanted = due(at)
            at = steps(at, reduce(jnp.maximum, wanted, first))
            for k, (saved, step) in enumerate(zip(self.saved, wanted, strict=True)):
                hit = step == at.n
                left = list(at.left)
                pull = lambda at, saved=saved, left=left, k=k: _add(
                    at, saved.pull(at, left[k] - 1)
                )
                at = lax.cond(hit, pull, lambda at: at, at)
                left[k] = jnp.where(hit, left[k] - 1, left[k])
                at = at._replace(left=left)
            return at

        return lax.while_loop(more, stop, at)

    def step(self, at: Position, start: Any = None) -> Position:
        """One step back; `start` is the state at its start, if known."""
        n, system = at.n - 1, self.system
        span, moves = self.plan.span(n), self.solver.moves(system)
        if self.dense is None:
            start_bar = jtu.tree_map(jnp.zeros_like, at.bar)
        else:
            if start is None:
                start = undo(moves, system, span, at.state)
            at, start_bar = self._pull_dense(at, n, span, start)
        if start is None:
            args = moves, system, self.wanted, span, at.state, at.bar
            start, more, bar = vjp_step(*args)
        else:
            more, bar = vjp(moves, system, self.wanted, span, start, at.bar)
        more = (more, jtu.tree_map(jnp.zeros_like, self.moved[1]))
        gradient, bar = tree_sum((at.gradient, bar), (more, start_bar))
        return Position(n, start, bar, gradient, at.left)

    def _every(self, i: int) -> _Saved:
        """The outputs saved every few steps."""
        output = self.plan.outputs[i]
        step = lambda j: (j + 1) * output.every

        def pull(at: Position, j: Array):
            bar = self._row(i, output.row_of_step(step(j)), True)
            return self._pull_state(i, at.n, at.state, bar)

        return _Saved(self.trace.n // output.every, step, pull)

    def _row(self, i: int, row: Array, pred) -> PyTree:
        """The cotangent of one row of an output, or zero."""
        return jtu.tree_map(lambda x: jnp.where(pred, x[row], 0), self.bars[i])

    def _pull_state(self, i: int, n: Array, state: PyTree, bar: PyTree):
        """Pull back an output saved at a step, to the parameters and the state."""
        y, carry = state
        t = self.plan.steps.time(n)

        def output(moved, y):
            system, fns = eqx.combine(moved, self.fixed)
            return eqx.filter(fns[i](t, y, system.args), eqx.is_inexact_array)

        gradient, y_bar = jax.vjp(output, self.moved, y)[1](bar)
        return gradient, (y_bar, jtu.tree_map(jnp.zeros_like, carry))

    def _pull_time(self, i: int, at: Position, j: Array):
        """Pull back an output saved between steps, from the start of its step."""
        plan = self.plan
        t = plan.outputs[i].ts[j]

        def output(moved, start):
            parameters = eqx.combine(moved, self.fixed)
            saved = plan.output(i, parameters, at.n, start, t)
            return eqx.filter(saved, eqx.is_inexact_array)

        bar = self._row(i, plan.outputs[i].rows_of_times()[j], True)
        return jax.vjp(output, self.moved, at.state)[1](bar)

    def _pull_all(self, i: int, starts: PyTree):
        """Pull back all outputs between steps."""
        plan, output = self.plan, self.plan.outputs[i]

        def outputs(moved, starts):
            parameters = eqx.combine(moved, self.fixed)
            saved = plan.all_outputs(i, parameters, starts)
            return eqx.filter(saved, eqx.is_inexact_array)

        rows = output.rows_of_times()
        made = output.reached(self.trace.n)

        def bar(x):
            keep = made.reshape(-1, *(1,) * (x.ndim - 1))
            return jnp.where(keep, x[jnp.where(made, rows, 0)], 0)

        bars = jtu.tree_map(bar, self.bars[i])
        return jax.vjp(outputs, self.moved, starts)[1](bars)

    def _pull_dense(self, at: Position, n: Array, span: Span, start: PyTree):
        """Pull back the data of dense output, to both ends of a step."""

        def dense_info(moved, start, end):
            system, _ = eqx.combine(moved, self.fixed)
            return self.solver.dense_info(system, span, start, end)

        bar = jtu.tree_map(lambda x: x[n], self.dense)
        pull = jax.vjp(dense_info, self.moved, start, at.state)[1]
        more, start_bar, end_bar = pull(bar)
        return _add(at, (more, end_bar)), start_bar


def _materialise(like: PyTree, bar: PyTree) -> PyTree:
    """The cotangents of all inexact arrays, zero where there are none."""
    like = eqx.filter(like, eqx.is_inexact_array)
    return jtu.tree_map(lambda x, b: jnp.zeros_like(x) if b is None else b, like, bar)


def _add(at: Position, bars) -> Position:
    gradient, bar = tree_sum((at.gradient, at.bar), bars)
    return at._replace(gradient=gradient, bar=bar)
