"""The moves of schemes with one copy of the system.

The state within a step is a pair: `(q, p)`, and at the ends of a step the force there,
if the scheme starts with a kick.
"""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import optimistix as optx
from jaxtyping import PyTree

from .. import _tree as tree
from .._system._bound import System
from ._engine import AbstractMove, Outcome, Span, Stage


class Enter(AbstractMove):
    """From `(q, p)` to the variables of the shared split; the inverse goes back."""

    def prepare(self, system: System, span: Span) -> None:
        return None

    def apply(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        y, carry = stage
        return (system.split("shared").enter(system, span.t0, y), carry), None

    def undo(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        y, carry = stage
        return (system.split("shared").leave(system, span.t0, y), carry), None


class Drift(AbstractMove):
    """The exact flow of one part of a split, which advances time."""

    kind: str = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def prepare(self, system: System, span: Span) -> PyTree:
        split = system.split(self.kind)
        return split.prepare(system, span.t0, span.h, self.order)

    def apply(self, system: System, span: Span, data: PyTree, stage: Stage) -> Outcome:
        (y, carry), split = stage, system.split(self.kind)
        return (split.drift(system, span.t0, span.h, data, y), carry), None

    def undo(self, system: System, span: Span, data: PyTree, stage: Stage) -> Outcome:
        return self.apply(system, span, data, stage)


class Kick(AbstractMove):
    """The flow of the other part of a split, at fixed time.

    One that is `known` starts a step, by the force that the last step left. Its inverse
    ends a step, and leaves the force.
    """

    kind: str = eqx.field(static=True)
    order: int = eqx.field(static=True)
    known: bool = eqx.field(static=True, default=False)

    def prepare(self, system: System, span: Span) -> None:
        return None

    def apply(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        if not self.known:
            return self.undo(system, span, data, stage)
        (y, force), split = stage, system.split(self.kind)
        return (split.kick(system, span.t0, span.h, y, force, self.order), None), None

    def undo(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        (y, carry), split = stage, system.split(self.kind)
        force = split.force(system, span.t0, y)
        y = split.kick(system, span.t0, span.h, y, force, self.order)
        return (y, force if self.known else carry), None


# The moves of the paper, with forces and velocities frozen at one end. For nonseparable
# energies either a move or its inverse is implicit.

RootFind = Callable[[Callable, PyTree], tuple[PyTree, dfx.RESULTS]]


def root_find(root_finder: optx.AbstractRootFinder | None, max_steps: int) -> RootFind:
    """A root find for `x = fn(x)`, from a guess."""

    def find(fn: Callable, guess: PyTree) -> tuple[PyTree, dfx.RESULTS]:
        assert root_finder is not None  # the scheme has checked that there is one
        solution = optx.root_find(
            lambda x, _: tree.sub(fn(x), x),
            root_finder,
            guess,
            max_steps=max_steps,
            throw=False,
        )
        return solution.value, dfx.RESULTS.promote(solution.result)

    return find


class FrozenKick(AbstractMove):
    """A kick by the force at `p` after it; the inverse is by that at `p` before it."""

    root_finder: optx.AbstractRootFinder | None
    max_steps: int = eqx.field(static=True)
    known: bool = eqx.field(static=True, default=False)

    def prepare(self, system: System, span: Span) -> None:
        return None

    def _by(self, force: PyTree, system: System, span: Span, stage: Stage) -> Outcome:
        y, carry = stage
        y = system.add(y, (None, tree.scale(span.h, force)))
        return (y, None if carry is None else force), None

    def apply(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        y, carry = stage
        if self.known:
            return self._by(carry, system, span, stage)
        if system.is_separable:
            return self._by(system.force(span.t0, y), system, span, stage)
        after = lambda dp: system.add(y, (None, dp))
        find = root_find(self.root_finder, self.max_steps)
        kick = lambda dp: tree.scale(span.h, system.force(span.t0, after(dp)))
        dp, result = find(kick, tree.zeros(y[1]))
        return (after(dp), carry), result

    def undo(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        return self._by(system.force(span.t0, stage[0]), system, span, stage)


class FrozenDrift(AbstractMove):
    """A drift by the velocity at its start; the inverse is by that at its end."""

    root_finder: optx.AbstractRootFinder | None
    max_steps: int = eqx.field(static=True)

    def prepare(self, system: System, span: Span) -> PyTree:
        return system.prepare_decay(span.t0, span.h)

    def apply(self, system: System, span: Span, data: PyTree, stage: Stage) -> Outcome:
        y, carry = stage
        velocity = system.velocity(span.t0, y)
        y = system.add(y, (tree.scale(span.h, velocity), None))
        return (system.decay(data, y), carry), None

    def undo(self, system: System, span: Span, data: PyTree, stage: Stage) -> Outcome:
        y, carry = stage
        y = system.decay(data, y)
        after = lambda dq: system.add(y, (dq, None))
        drift = lambda dq: tree.scale(span.h, system.velocity(span.t1, after(dq)))
        nothing = tree.zeros(y[0])
        if system.is_separable:
            return (after(drift(nothing)), carry), None
        find = root_find(self.root_finder, self.max_steps)
        dq, result = find(drift, nothing)
        return (after(dq), carry), result


class ToSums(AbstractMove):
    """From a state to one with compensated summation; the inverse goes back.

    The solver state is `(carry, rounding errors)` outside, and `carry` within.
    """

    def prepare(self, system: System, span: Span) -> None:
        return None

    def apply(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        y, (carry, lost) = stage
        return (tree.to_sums(y, lost), carry), None

    def undo(self, system: System, span: Span, data: None, stage: Stage) -> Outcome:
        y, carry = stage
        return (system.values(y), (carry, tree.rounding_errors(y))), None
