"""One engine for all schemes that are lists of moves.

A move maps the state within a step over a span of time, and has an inverse. `Stages`
are sequences of moves. A step, its inverse and its vector-Jacobian product all traverse
the same list.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._misc import cast_to, tree_sum
from .._scan import scan_stages
from .._system import System


Result: TypeAlias = dfx.RESULTS | None  # `None`: no move could fail
# The state within a step: usually the variables of a split, and the solver state.
Stage: TypeAlias = PyTree
Outcome: TypeAlias = tuple[Stage, Result]


class Span(NamedTuple):
    """An interval of time.

    `h` is the difference of its ends, which may be more accurate than `t1 - t0`.
    """

    t0: Array
    t1: Array
    h: Array

    def part(self, start, end, length) -> "Span":
        """The part between two fractions of the span, `length` times as long."""
        return Span(self._at(start), self._at(end), length * self.h)

    def _at(self, fraction) -> Array:
        if isinstance(fraction, float) and fraction in (0, 1):
            return self.t1 if fraction else self.t0
        # Rounding must not make the last stage miss the end of the step.
        return jnp.where(fraction == 1, self.t1, self.t0 + fraction * self.h)

    @property
    def reversed(self) -> "Span":
        return Span(self.t1, self.t0, -self.h)


class Move(NamedTuple):
    """A map over a span of time, and its inverse.

    Both are functions of the system, the span and the state at its start, and return
    the state at its end. The inverse is called with the reversed span.
    """

    do: Callable[[System, Span, Stage], Outcome]
    undo: Callable[[System, Span, Stage], Outcome]
    # Whether it is a whole step, in which friction acts over parts that are not known.
    is_step: bool = False

    @property
    def inverse(self) -> "Move":
        return Move(self.undo, self.do, self.is_step)


class Stages:
    """A sequence of moves, repeated for each row of a table.

    A row has three numbers for each move: its start, end and length, in units of the
    whole.
    """

    moves: "tuple[Moves, ...]"
    table: np.ndarray

    def __init__(self, moves: "Sequence[Moves]", table):
        self.moves = tuple(moves)
        self.table = np.reshape(np.asarray(table, float), (-1, len(self.moves), 3))

    @property
    def inverse(self) -> "Stages":
        moves = [move.inverse for move in self.moves[::-1]]
        start, end, length = np.moveaxis(self.table[::-1, ::-1], -1, 0)
        return Stages(moves, np.stack([1 - end, 1 - start, length], axis=-1))


Moves: TypeAlias = Move | Stages


def time_lengths(moves: Moves) -> np.ndarray:
    """The distinct lengths of the moves that advance time, in units of the step.

    None if they are not known.
    """
    unknown = False

    def each(moves: Moves):
        nonlocal unknown
        if isinstance(moves, Stages):
            for row in moves.table:
                for move, (start, end, length) in zip(moves.moves, row, strict=True):
                    if start != end:
                        yield from (length * x for x in each(move))
        else:
            unknown |= moves.is_step
            yield 1.0

    lengths = np.unique(np.round(list(each(moves)), 15))
    return lengths[:0] if unknown else lengths


def forward(moves: Moves, system: System, span: Span, stage: Stage) -> Outcome:
    """Apply all moves, in order."""
    return _walk(lambda move, *at: move.do(system, *at), moves, span, stage)


def undo(moves: Moves, system: System, span: Span, stage: Stage) -> Stage:
    """The state at the start of the span, from that at its end."""
    return forward(moves.inverse, system, span.reversed, stage)[0]


def vjp(
    moves: Moves, system: System, wanted: PyTree, span: Span, start: Stage, bar: Stage
) -> tuple[PyTree, Stage]:
    """The vector-Jacobian product of moves, from the state at their start.

    Returns the cotangents of the `wanted` leaves of the system, and of that state.
    """
    moved, fixed = eqx.partition(system, wanted)
    redo = lambda moved, x: forward(moves, eqx.combine(moved, fixed), span, x)[0]
    return jax.vjp(redo, moved, start)[1](bar)


def vjp_step(
    moves: Moves, system: System, wanted: PyTree, span: Span, end: Stage, bar: Stage
) -> tuple[Stage, PyTree, Stage]:
    """Invert all moves, and compute their vector-Jacobian product, move by move.

    Returns the state at the start, the cotangents of the `wanted` leaves of the system,
    and those of that state.
    """

    def back(move: Move, span: Span, x: PyTree) -> Outcome:
        end, gradient, bar = x
        start, _ = move.undo(system, span.reversed, end)
        more, bar = vjp(move, system, wanted, span, start, bar)
        return (start, tree_sum(gradient, more), bar), None

    gradient = jtu.tree_map(jnp.zeros_like, eqx.filter(system, wanted))
    return _walk(back, moves, span, (end, gradient, bar), reverse=True)[0]


def _walk(
    act: Callable, moves: Moves, span: Span, state: PyTree, reverse: bool = False
) -> Outcome:
    """Apply `act` to each move and its part of the span, in order."""
    if not isinstance(moves, Stages):
        return act(moves, span, state)
    order = slice(None, None, -1 if reverse else 1)

    def row(state: PyTree, parts) -> Outcome:
        result = None
        for move, part in list(zip(moves.moves, parts, strict=True))[order]:
            state, more = _walk(act, move, span.part(*part), state, reverse)
            result = first_failure(result, more)
        return state, result

    if len(moves.table) == 1:
        return row(state, moves.table[0].tolist())
    columns = np.moveaxis(moves.table, 0, -1)  # moves, three numbers, rows
    # Constants, multiplied by the step size inside the loop over the stages.
    # Recomputing the table at each step was measured to take as long as the stages
    # themselves.
    flat = columns.reshape(-1, len(moves.table))
    unique, which = np.unique(flat, axis=0, return_inverse=True)
    which = which.reshape(columns.shape[:2])
    rows = tuple(cast_to(column, span.h) for column in unique)
    pick = lambda state, numbers: row(state, [[numbers[i] for i in m] for m in which])
    state, results = scan_stages(pick, state, rows, reverse=reverse)
    if results is not None:
        # The first stage that failed, or any if none did.
        failed = jnp.argmax(results != dfx.RESULTS.successful)
        results = jtu.tree_map(lambda x: x[failed], results)
    return state, results


def first_failure(result: Result, other: Result) -> Result:
    """The first of two results, or the second if the first is a success."""
    if result is None or other is None:
        return other if result is None else result
    return dfx.RESULTS.where(result == dfx.RESULTS.successful, other, result)
