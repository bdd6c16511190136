"""The moves of schemes with one copy of the system.

The state within a step is a pair: the variables of a split or `(q, p)`, and the force
of the last kick, or `None` if the scheme does not reuse it.
"""

from collections.abc import Callable

import diffrax as dfx
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import PyTree

from .._misc import all_finite, rounding_errors, Sum, tree_scale, tree_sub
from .._split import AbstractSplit, State
from .._system import NONFINITE, System
from ._engine import Move, Outcome, Span, Stage


def _split(system: System, kind: str) -> AbstractSplit:
    split = system.split(kind)
    assert split is not None  # the scheme has checked that there is one
    return split


def to_split(kind: str) -> Move:
    """From `(q, p)` to the variables of a split; the inverse goes back."""

    def enter(system: System, span: Span, stage: Stage) -> Outcome:
        y, carry = stage
        return (_split(system, kind).to_split(system, span.t0, y), carry), None

    def leave(system: System, span: Span, stage: Stage) -> Outcome:
        z, carry = stage
        return (_split(system, kind).from_split(system, span.t0, z), carry), None

    return Move(enter, leave)


def drift(kind: str, order: int) -> Move:
    """The exact flow of one part of a split, which advances time."""

    def move(system: System, span: Span, stage: Stage) -> Outcome:
        z, carry = stage
        z = _split(system, kind).drift(system, span.t0, span.h, z, order)
        return (z, carry), None

    return Move(move, move)


def _kicked(system: System, span: Span, stage: Stage, force: PyTree) -> Outcome:
    (first, second), carry = stage
    z = first, system.add(second, span.h, force)
    return (z, None if carry is None else force), None


def _known_kick(system: System, span: Span, stage: Stage) -> Outcome:
    return _kicked(system, span, stage, force=stage[1])


def kick(kind: str, order: int, known: bool = False) -> Move:
    """The flow of the other part of a split, at fixed time.

    If `known`, the force is that of the last kick.
    """

    def by(force, system: System, span: Span, z: State) -> State:
        return _split(system, kind).kick(system, span.t0, span.h, z, force, order)

    def same(system: System, span: Span, stage: Stage) -> Outcome:
        z, carry = stage
        return (by(carry, system, span, z), carry), None

    def move(system: System, span: Span, stage: Stage) -> Outcome:
        z, carry = stage
        force = _split(system, kind).force(system, span.t0, z)
        return (by(force, system, span, z), None if carry is None else force), None

    return Move(same if known else move, move)


# The moves of the paper, with forces and velocities frozen at one end. For nonseparable
# energies either a move or its inverse is implicit.

RootFind = Callable[[Callable, PyTree], tuple[PyTree, dfx.RESULTS]]


def root_find(root_finder: optx.AbstractRootFinder | None, max_steps: int) -> RootFind:
    """A root find for `x = fn(x)`, from a guess."""

    def find(fn: Callable, guess: PyTree) -> tuple[PyTree, dfx.RESULTS]:
        assert root_finder is not None  # the scheme has checked that there is one
        solution = optx.root_find(
            lambda x, _: tree_sub(fn(x), x),
            root_finder,
            guess,
            max_steps=max_steps,
            throw=False,
        )
        return solution.value, dfx.RESULTS.promote(solution.result)

    return find


def frozen_kick(find: RootFind, known: bool = False) -> Move:
    """A kick by the force at `p` after it; the inverse is by that at `p` before it."""

    def before(system: System, span: Span, stage: Stage) -> Outcome:
        return _kicked(system, span, stage, system.force(span.t0, stage[0]))

    def after(system: System, span: Span, stage: Stage) -> Outcome:
        if system.is_separable:
            return before(system, span, stage)
        (q, p), carry = stage
        force = lambda dp: system.force(span.t0, (q, system.add(p, 1, dp)))
        dp, result = find(lambda dp: tree_scale(span.h, force(dp)), system.zeros(p))
        return ((q, system.add(p, 1, dp)), carry), result

    return Move(_known_kick if known else after, before)


def frozen_drift(find: RootFind) -> Move:
    """A drift by the velocity at its start; the inverse is by that at its end."""

    def start(system: System, span: Span, stage: Stage) -> Outcome:
        (q, p), carry = stage
        q = system.add(q, span.h, system.velocity(span.t0, (q, p)))
        return ((q, system.move_frame(span.t0, span.h, p)), carry), None

    def end(system: System, span: Span, stage: Stage) -> Outcome:
        (q, p), carry = stage
        p = system.move_frame(span.t0, span.h, p)
        if system.is_separable:
            q = system.add(q, span.h, system.velocity(span.t1, (q, p)))
            return ((q, p), carry), None
        velocity = lambda dq: system.velocity(span.t1, (system.add(q, 1, dq), p))
        dq, result = find(lambda dq: tree_scale(span.h, velocity(dq)), system.zeros(q))
        return ((system.add(q, 1, dq), p), carry), result

    return Move(start, end)


# The moves of wrappers.


def _check_finite(system: System, span: Span, stage: Stage) -> Outcome:
    finite = all_finite(stage[0])
    return stage, dfx.RESULTS.where(finite, dfx.RESULTS.successful, NONFINITE)


def _to_sums(system: System, span: Span, stage: Stage) -> Outcome:
    y, (carry, lost) = stage
    return (jtu.tree_map(Sum, y, lost), carry), None


def _from_sums(system: System, span: Span, stage: Stage) -> Outcome:
    y, carry = stage
    return (system.values(y), (carry, rounding_errors(y))), None


check_finite = Move(_check_finite, _check_finite)
to_sums = Move(_to_sums, _from_sums)
