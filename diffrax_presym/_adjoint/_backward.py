"""The backward pass through the steps of a solve."""

from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._misc import tree_sum
from .._solver._engine import Span, undo, vjp, vjp_step
from ._clock import clock
from ._interpolated import pull_interpolated
from ._saves import is_within, materialise, Saved, SavedOutputs
from ._types import Inputs, Position


class Backward:
    """The backward pass through a solve, step by step."""

    def __init__(self, inputs: Inputs, perturbed: Inputs, final, cotangents):
        rest = inputs.rest
        self.solver, self.first, self.final = rest["solver"], inputs.start, final
        self.time = clock(
            *(rest[x] for x in ("stepsize_controller", "t0", "t1", "dt0"))
        )
        self.system, _ = inputs.parameters
        # The differentiated leaves of the system, and of all parameters.
        self.wanted, _ = perturbed.parameters
        self.moved, self.fixed = eqx.partition(inputs.parameters, perturbed.parameters)
        saved = rest["saveat"], final, cotangents, self.moved, self.fixed
        self.saves = SavedOutputs(*saved)
        self.dense = materialise(final.dense_infos, cotangents.dense_infos)
        self.carried = materialise(final.solver_state, cotangents.solver_state)

    def span(self, n: Array) -> Span:
        """The span of step `n`, in physical time."""
        t0, t1 = (self.system.time(self.time(i)) for i in (n, n + 1))
        return Span(t0, t1, self.solver.step_length(t0, t1))

    def advance(self, n: Array, state: PyTree) -> PyTree:
        return self.solver.advance(self.system, *self.span(n), *state)[:2]

    def end(self) -> Position:
        y, carry, n = self.final.y, self.final.solver_state, self.final.num_steps
        bar = jtu.tree_map(jnp.zeros_like, y), self.carried
        gradient = jtu.tree_map(jnp.zeros_like, self.moved)
        left = self.saves.left_at_end(n)
        at = Position(n, self.time(n), (y, carry), bar, gradient, left)
        for i, sub in enumerate(self.saves.subs):
            # The end may have been saved as a step already.
            if sub.t1 and sub.steps != 1:
                here = sub.steps == 0 or n % sub.steps != 0
                at = self._pull_output(at, i, left[i].outputs, here)
        return at

    def start(self, at: Position) -> Position:
        """Pull back the outputs saved at the start, more than one only for a solve of
        zero length."""
        for i, left in enumerate(at.left):
            bar = self.saves.sum_of_first(i, left.outputs)
            at = _add(at, self.saves.pull_saved_output(i, at.t, at.state[0], bar))
        return at

    def step(self, at: Position, start: Any = None) -> Position:
        """One step back; `start` is the state at its start, if known."""
        n, system, solver = at.n - 1, self.system, self.solver
        span, moves = self.span(n), solver.moves(system)
        for i, sub in enumerate(self.saves.subs):
            if sub.steps != 0:
                at = self._unsave_step(at, i, at.n % sub.steps == 0)
        start_bar = jtu.tree_map(jnp.zeros_like, at.bar)
        if self._may_interpolate():
            # Most steps have no output between their ends, and are cheaper.
            inner = lambda at: pull_interpolated(
                self,
                at,
                n,
                span,
                undo(moves, system, span, at.state) if start is None else start,
            )
            skip = lambda at: (at, start_bar)
            at, start_bar = lax.cond(self._interpolates(at.left, n), inner, skip, at)
        if start is None:
            pulled = vjp_step(moves, system, self.wanted, span, at.state, at.bar)
            start, more, bar = pulled
        else:
            more, bar = vjp(moves, system, self.wanted, span, start, at.bar)
        more = (more, jtu.tree_map(jnp.zeros_like, self.moved[1]))
        gradient, bar = tree_sum((at.gradient, bar), (more, start_bar))
        return Position(n, self.time(n), start, bar, gradient, at.left)

    def _may_interpolate(self) -> bool:
        return self.dense is not None or any(s.ts is not None for s in self.saves.subs)

    def _interpolates(self, left: list[Saved], n: Array):
        """Whether any output left was interpolated in step `n`."""
        if self.dense is not None:
            return True
        inside = [
            is_within(sub.ts, saved.times, n, self.time(n))
            for sub, saved in zip(self.saves.subs, left, strict=True)
            if sub.ts is not None
        ]
        return jnp.any(jnp.stack(inside))

    def _pull_output(self, at: Position, i: int, index: Array, pred) -> Position:
        bar = self.saves.bar_at(i, index, pred)
        return _add(at, self.saves.pull_saved_output(i, at.t, at.state[0], bar))

    def _unsave_step(self, at: Position, i: int, pred: Array) -> Position:
        """Pull back the last output if it was saved at the end of this step."""
        times, outputs = at.left[i]
        outputs = outputs - jnp.where(pred, 1, 0)
        at = self._pull_output(at, i, outputs, pred)
        left = [*at.left[:i], Saved(times, outputs), *at.left[i + 1 :]]
        return at._replace(left=left)


def _add(at: Position, bars) -> Position:
    gradient, y_bar = bars
    y, carry = at.bar
    gradient = tree_sum(at.gradient, gradient)
    return at._replace(gradient=gradient, bar=(tree_sum(y, y_bar), carry))
