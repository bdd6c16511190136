"""The moves of schemes with one copy of the system.

The state within a step is a pair: `(q, p)`, and at the ends of a step the force there,
if the scheme starts with a kick.
"""

from typing import ClassVar

import equinox as eqx
from jaxtyping import PyTree

from .. import _tree as tree
from .._system._bound import System
from ._engine import AbstractMove, Outcome, Span, StepState


class Enter(AbstractMove):
    """From `(q, p)` to the variables of a split, for `Scheme(..., ends=Enter(kind))`;
    the inverse goes back."""

    kind: str = eqx.field(static=True)
    keeps_manifold: ClassVar[bool] = True

    def apply(
        self, system: System, span: Span, data: None, stage: StepState
    ) -> Outcome:
        y, carry = stage
        return (system.split(self.kind).enter(system, span.t0, y), carry), None

    def undo(self, system: System, span: Span, data: None, stage: StepState) -> Outcome:
        y, carry = stage
        return (system.split(self.kind).leave(system, span.t0, y), carry), None


class Drift(AbstractMove):
    """The exact flow of one part of a split, which advances time."""

    kind: str = eqx.field(static=True)
    order: int = eqx.field(static=True)
    keeps_manifold: ClassVar[bool] = True

    def prepare(self, system: System, span: Span) -> PyTree:
        split = system.split(self.kind)
        return split.prepare(system, span.t0, span.h, self.order)

    def is_autonomous(self, system: System) -> bool:
        return system.prepares_once

    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        (y, carry), split = stage, system.split(self.kind)
        y, result = split.attempt(system, span.t0, span.h, data, y)
        return (y, carry), result

    undo = apply  # of the reversed span


class Kick(AbstractMove):
    """The flow of the other part of a split, at fixed time.

    One that is `known` starts a step, by the force that the last step left. Its inverse
    ends a step, and leaves the force.
    """

    kind: str = eqx.field(static=True)
    order: int = eqx.field(static=True)
    known: bool = eqx.field(static=True, default=False)
    keeps_manifold: ClassVar[bool] = True

    def apply(
        self, system: System, span: Span, data: None, stage: StepState
    ) -> Outcome:
        if not self.known:
            return self.undo(system, span, data, stage)
        (y, force), split = stage, system.split(self.kind)
        return (split.kick(system, span.t0, span.h, y, force, self.order), None), None

    def undo(self, system: System, span: Span, data: None, stage: StepState) -> Outcome:
        (y, carry), split = stage, system.split(self.kind)
        force = split.force(system, span.t0, y)
        y = split.kick(system, span.t0, span.h, y, force, self.order)
        return (y, force if self.known else carry), None


_KIND = """**Arguments:**

- `kind`: the kind of split that the system must offer: `"separable"`, `"any"`,
    `"nystrom"`, `"shared"` or `"linear"`.
"""
_ORDER = """- `order`: the order in the step to which a flow without closed form is
    computed.
"""
Enter.__init__.__doc__ = _KIND
Drift.__init__.__doc__ = _KIND + _ORDER
_KNOWN = """- `known`: whether the kick starts a step, by the force that the last step
    left; its inverse ends a step, and leaves the force. Defaults to `False`.
"""
Kick.__init__.__doc__ = _KIND + _ORDER + _KNOWN


class FrozenDrift(AbstractMove):
    """A drift by the velocity at its start; the inverse is by that at its end."""

    def prepare(self, system: System, span: Span) -> PyTree:
        return system.prepare_decay(span.t0, span.h)

    def is_autonomous(self, system: System) -> bool:
        return system.prepares_once

    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        y, carry = stage
        velocity = system.velocity(span.t0, y)
        y = system.add(y, (tree.scale(span.h, velocity), None))
        return (system.decay(data, y), carry), None

    def undo(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        y, carry = stage
        y = system.decay(data, y)
        velocity = system.velocity(span.t1, y)
        return (system.add(y, (tree.scale(span.h, velocity), None)), carry), None


class ToSums(AbstractMove):
    """From a state to one with compensated summation; the inverse goes back.

    The solver state is `(carry, rounding errors)` outside, and `carry` within.
    """

    keeps_manifold: ClassVar[bool] = True

    def apply(
        self, system: System, span: Span, data: None, stage: StepState
    ) -> Outcome:
        y, (carry, lost) = stage
        return (tree.to_sums(y, lost), carry), None

    def undo(self, system: System, span: Span, data: None, stage: StepState) -> Outcome:
        y, carry = stage
        return (system.values(y), (carry, tree.rounding_errors(y))), None
