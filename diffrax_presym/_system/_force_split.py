"""Kicks by forces, and by friction that is not part of the drift."""

import abc
import math
from typing import TYPE_CHECKING

import equinox as eqx
from jaxtyping import PyTree

from .. import _tree as tree
from .._compositions import lengths, over_stages
from .._friction._base import LinearPart
from .._friction._drag import Drag
from .._friction._fit import fit_friction
from .._friction._log_scale import LinearScale
from .._numbers import as_time, State, Time
from .._results import FORCE_NOT_SOLVED, NONFINITE
from ._force_flow import force_flow
from ._split import AbstractSplit


if TYPE_CHECKING:
    from ._bound import System


# The most friction over a kick back in time. It amplifies the distance of a momentum
# from that of the slow motion. By `friction_limit` of a "push" and a "move" the schemes
# of order four and more resolve from 4.6 (`SofroniouSpaletta(8, Strang())`) to 8.8.
_MOST_BACK = math.log(100)


class AbstractForceSplit(AbstractSplit):
    """A kick by a force of the place, and by friction and forces of the velocity that
    are not part of the drift: exact if these are linear, otherwise a composition. A
    kick by any other force of the velocity is implicit."""

    # "force" alone, with "friction", or by an equation for the "momentum".
    kick_by: eqx.AbstractVar[str]

    @abc.abstractmethod
    def place_force(self, system: "System", t: Time, y: State) -> PyTree:
        """The force that does not depend on the velocity."""

    @property
    def failure(self):
        return FORCE_NOT_SOLVED if self.kick_by == "momentum" else NONFINITE

    def force(self, system, t, y) -> PyTree:
        """The force, and the other friction at the place if there is any."""
        force = self.place_force(system, t, y)
        if self.kick_by != "friction":
            return force
        parts, at = system.parts, (t, tree.values(y)[0], system.args)
        forms = [part.at(*at) for part in parts.local]
        return force, forms, [drag.at(*at) for drag in parts.drags]

    def kick(self, system, t, h, y, force, order) -> State:
        if self.kick_by == "force":
            return super().kick(system, t, h, y, force, order)
        if self.kick_by == "friction":
            return _kick_with_friction(system, t, h, y, force, order)
        term, (q, p), args = system.term, tree.values(y), system.args
        state = lambda p: (t, q, p, term.velocity(t, q, p, args), args)
        total = lambda p: term.add_forces(force, term.external, *state(p))
        dp, found = force_flow(total, h, p, order)
        return system.add(y, (None, tree.invalid_if(~found, dp)))


def _kick_with_friction(system, t, h, y, force, order) -> State:
    (force, forms, drags), p = force, tree.values(y)[1]
    parts, mechanics = system.parts, system.term.mechanics
    pairs = zip(parts.local, forms, strict=True)
    linear = [
        LinearPart(LinearScale(), x, part.per_velocity, may_couple=True)
        for part, x in pairs
    ]
    friction = fit_friction(linear, mechanics, p)

    def pushed(dp: PyTree, h: Time) -> PyTree:
        if friction is None:
            return tree.add_scaled(dp, h, force)
        bad = (as_time(h) < 0) & (friction.over(t, h) > _MOST_BACK)
        data = tree.invalid_if(bad, friction.prepare(t, h, order))
        gained = friction.decay(data, tree.add(p, dp))
        return tree.add(dp, tree.add(gained, friction.respond(data, force)))

    def slowed(drags: list[Drag], dp: PyTree, h: Time) -> PyTree:
        for drag in drags:
            dp = tree.add(dp, drag.decay(h, tree.add(p, dp), mechanics.mass))
        return dp

    def stage(dp: PyTree, h: Time) -> PyTree:
        dp = pushed(slowed(drags, dp, h / 2), h)
        return slowed(drags[::-1], dp, h / 2)

    if drags:
        dp = over_stages(stage, tree.zeros(p), lengths(order, h))
    else:
        dp = pushed(tree.zeros(p), h)
    return system.add(y, (None, dp))
