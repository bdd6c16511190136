"""Splits: the pairs of exact flows into which the motion of a system splits.

A system lists the splits that it allows, and a scheme needs one by kind:

- `"separable"`: the velocity does not depend on `q`, and the force not on `p`;
- `"any"`: a drift, which is the exact flow of one part and advances time, and a kick by
  the other part, at fixed time;
- `"nystrom"`: as any, and the part that drifts is quadratic, so that the commutator
  [kick, [kick, [kick, drift]]] vanishes, as Runge--Kutta--Nyström methods require;
- `"shared"`: constant friction turned into a force, for a constant mass;
- `"linear"`: as shared, and the force is linear in the positions.

What a drift needs of time alone is prepared, for all stages of a step at once.
"""

import abc
from typing import Any, ClassVar, TYPE_CHECKING

import diffrax as dfx
import equinox as eqx
from jaxtyping import PyTree

from .. import _tree as tree
from .._numbers import State, Time
from .._results import NONFINITE


if TYPE_CHECKING:
    from ._bound import System


class AbstractSplit(eqx.Module):
    """A pair of exact flows: of a drift, friction included, and of a kick.

    A user's system may offer one, for any motion whose flow is known: on a sphere,
    along Kepler's orbits. `system` is the system bound to its arguments; states are
    updated by `system.add` alone.
    """

    kinds: eqx.AbstractVar[frozenset[str]]

    @abc.abstractmethod
    def drift(
        self, system: "System", t: Time, h: Time, data: PyTree, y: State
    ) -> State:
        """The flow of one part from `t` to `t + h`, with the `data` prepared for it.

        Exact if known in closed form, otherwise of the order it was prepared for.
        """

    @abc.abstractmethod
    def force(self, system: "System", t: Time, y: State) -> PyTree:
        """What a kick needs of the variables that it does not change."""

    # What is different for some splits.

    def enter(self, system: "System", t: Time, y: State) -> State:
        """From `(q, p)`, at the start of a step, to the variables of the split. By
        default these are the same."""
        return y

    def leave(self, system: "System", t: Time, y: State) -> State:
        """Back to `(q, p)`, at the end of a step."""
        return y

    @property
    def has_variables(self) -> bool:
        """Whether it acts on other variables than `(q, p)`."""
        return type(self).leave is not AbstractSplit.leave

    def attempt(
        self, system: "System", t: Time, h: Time, data: PyTree, y: State
    ) -> tuple[State, dfx.RESULTS | None]:
        """The drift, and its result if it can fail. By default it cannot."""
        return self.drift(system, t, h, data, y), None

    # What a kick and a drift do, and how a drift integrates, see `_strong_friction.py`.
    names: ClassVar[tuple[str, str]] = ("kick", "drift")

    def quadrature(self, system: "System", order: int) -> int:
        """The order of the quadratures in a drift, 0 if they are not needed."""
        return 0

    def prepare(self, system: "System", t: Time, h: Time, order: int) -> PyTree:
        """What the drift from `t` to `t + h` needs of time alone. Nothing by
        default."""
        return None

    # Whether steps show the motion between them: not if a drift may turn by far within
    # one. Otherwise values between steps are shorter steps.
    is_resolved: ClassVar[bool] = False

    failure: ClassVar[Any] = NONFINITE  # the reason if a state is not finite

    def kick(
        self, system: "System", t: Time, h: Time, y: State, force: PyTree, order: int
    ) -> State:
        """The flow of the other part at fixed time, over a length `h`. By default that
        of a force that does not depend on the momentum."""
        return system.add(y, (None, tree.scale(h, force)))


AbstractSplit.__init__.__doc__ = "**Arguments:** its fields, if any."
