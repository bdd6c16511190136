"""One engine for all schemes that are lists of moves.

A move maps the state within a step over a span of time, in two phases: what depends on
time alone is prepared, for all stages at once, and what touches the state is applied.
`MoveSequence` are sequences of moves. A step and its inverse traverse the same list.
"""

import abc
import itertools
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._numbers import cast_to, rounding_of
from .._system._bound import System


Result: TypeAlias = dfx.RESULTS | None  # `None`: no move could fail
# The state within a step: positions and momenta, and the solver state.
StepState: TypeAlias = PyTree
Outcome: TypeAlias = tuple[StepState, Result]


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
    def rounding(self) -> Array:
        """Forwards, by how much its ends may differ from the same times computed
        otherwise, as by a function of time."""
        return jnp.sign(self.h) * rounding_of(self.t0, self.t1, jnp.abs(self.h))

    @property
    def reversed(self) -> "Span":
        return Span(self.t1, self.t0, -self.h)


class AbstractMove(eqx.Module):
    """A map over a span of time, and its inverse.

    The inverse is called with the reversed span, and what was prepared for that.
    """

    # Whether it keeps states on the constraints or the manifold of a system. Schemes
    # with a move that does not refuse such systems.
    keeps_manifold: ClassVar[bool] = False

    @abc.abstractmethod
    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        """The state at the end of the span, from that at its start."""

    @abc.abstractmethod
    def undo(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        """The inverse: the state at the end of the reversed span."""

    def prepare(self, system: System, span: Span) -> PyTree:
        """What the move needs of time alone, by default nothing; called under
        `jax.vmap`."""
        return None

    def is_autonomous(self, system: System) -> bool:
        """Whether what is prepared depends on the length of the span alone, so that
        stages and steps of one length share it. By default only if it is nothing."""
        return type(self).prepare is AbstractMove.prepare


AbstractMove.__init__.__doc__ = "**Arguments:** its fields, if any."


class Inverse(AbstractMove):
    """The inverse of a move, as a move."""

    move: AbstractMove

    def is_autonomous(self, system: System) -> bool:
        return self.move.is_autonomous(system)

    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        return self.move.undo(system, span, data, stage)

    def undo(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        return self.move.apply(system, span, data, stage)


class MoveSequence:
    """A sequence of moves, repeated for each row of a table.

    A row has three numbers for each move: its start, end and length, in units of the
    whole.
    """

    moves: "tuple[Moves, ...]"
    table: np.ndarray

    def __init__(self, moves: "Sequence[Moves]", table):
        """**Arguments:** `moves`, and `table`, an array of three columns for each."""
        self.moves = tuple(moves)
        self.table = np.reshape(np.asarray(table, float), (-1, len(self.moves), 3))

    @property
    def inverse(self) -> "MoveSequence":
        """The adjoint sequence: the inverses in reverse order."""
        moves = [inverse(move) for move in self.moves[::-1]]
        start, end, length = np.moveaxis(self.table[::-1, ::-1], -1, 0)
        return MoveSequence(moves, np.stack([1 - end, 1 - start, length], axis=-1))


Moves: TypeAlias = AbstractMove | MoveSequence


def inverse(moves: Moves) -> Moves:
    if isinstance(moves, MoveSequence):
        return moves.inverse
    return moves.move if isinstance(moves, Inverse) else Inverse(moves)


def leaves(moves: Moves) -> list[AbstractMove]:
    """The moves of all sequences in it, without inverses."""
    if isinstance(moves, MoveSequence):
        return list(itertools.chain(*map(leaves, moves.moves)))
    return [moves.move if isinstance(moves, Inverse) else moves]


def is_autonomous(moves: Moves, system: System) -> bool:
    """Whether what the moves prepare depends on the length of a span alone."""
    if not isinstance(moves, MoveSequence):
        return moves.is_autonomous(system)
    return all(is_autonomous(move, system) for move in moves.moves)


def forward(
    moves: Moves, system: System, span: Span, data: PyTree, stage: StepState
) -> Outcome:
    """Apply all moves, in order, with what was prepared for them."""
    act = lambda move, *args: move.apply(system, *args)
    return _traverse(act, moves, span, data, stage)


def backward(
    moves: Moves, system: System, span: Span, data: PyTree, stage: StepState
) -> StepState:
    """Invert all moves, in reverse order, with what was prepared for that."""
    act = lambda move, span, *args: move.undo(system, span.reversed, *args)
    return _traverse(act, moves, span, data, stage, reverse=True)[0]


def _traverse(
    act: Callable[..., Outcome],
    moves: Moves,
    span: Span,
    data: PyTree,
    state: StepState,
    reverse: bool = False,
) -> Outcome:
    """Apply `act` to each move, its part of the span and its data, in order."""
    if not isinstance(moves, MoveSequence):
        return act(moves, span, data, state)
    order = slice(None, None, -1 if reverse else 1)
    each = list(enumerate(moves.moves))[order]

    def row(state: StepState, parts, data) -> Outcome:
        result = None
        for i, move in each:
            part = span.part(*parts[i])
            state, more = _traverse(act, move, part, data[i], state, reverse)
            result = first_failure(result, more)
        return state, result

    if len(moves.table) == 1:
        first = jtu.tree_map(lambda x: x[0], data)
        return row(state, moves.table[0].tolist(), first)
    # Moves, three numbers, rows. Each number once: a loop over few arrays is faster.
    numbers = np.moveaxis(moves.table, 0, -1)
    flat, which = np.unique(
        numbers.reshape(-1, len(moves.table)), axis=0, return_inverse=True
    )
    which = which.reshape(numbers.shape[:2])

    def body(state, x):
        flat, data = x
        return row(state, [[flat[i] for i in move] for move in which], data)

    rows = tuple(cast_to(x, span.h) for x in flat), data
    unroll = 1 if cheap_iterations() else True
    state, results = lax.scan(body, state, rows, reverse=reverse, unroll=unroll)
    if results is not None:
        # The first stage that failed, or any if none did.
        failed = jnp.argmax(results != dfx.RESULTS.successful)
        results = jtu.tree_map(lambda x: x[failed], results)
    return state, results


def cheap_iterations() -> bool:
    """Whether iterations of a loop are cheap, and code is not.

    On a GPU an iteration takes ten microseconds or more, whatever is in it, so stages
    are written out. On a CPU they were measured to take four to five times as long so.
    """
    return jax.default_backend() == "cpu"


def first_failure(result: Result, other: Result) -> Result:
    """The first of two results, or the second if the first is a success."""
    if result is None or other is None:
        return other if result is None else result
    return dfx.RESULTS.where(result == dfx.RESULTS.successful, other, result)
