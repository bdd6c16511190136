"""Kicks by forces, and by friction that is not part of the drift."""

import abc
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
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

    def in_kicks(self, system: "System", order: int) -> bool:
        """Whether friction that depends on time alone is part of kicks of an order, and
        not of drifts. By default it is not."""
        return False

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
        if self.kick_by == "force" and not self.in_kicks(system, order):
            return super().kick(system, t, h, y, force, order)
        q, p = tree.values(y)
        change = self.change(system, t, h, q, p, force, order, once=True)
        return system.add(y, (None, change(p)))

    def change(
        self,
        system: "System",
        t: Time,
        h: Time,
        q: PyTree,
        p: PyTree,
        force: PyTree,
        order: int,
        once: bool,
        along: Callable[[PyTree], PyTree] = lambda force: force,
    ) -> Callable[[PyTree], PyTree]:
        """The change of momenta such as `p` by a kick at a place, as their function. If
        that is not applied `once`, what takes longer to prepare pays. An implicit kick
        is by the part `along` constraints of all forces."""
        friction = system.friction if self.in_kicks(system, order) else None
        if self.kick_by != "momentum":
            force = force if self.kick_by == "friction" else (force, [], [])
            linear = () if friction is None else system.parts.linear
            return _by_friction(system, t, h, p, force, linear, order, once)
        term, args = system.term, system.args
        state = lambda p: (t, q, p, term.velocity(t, q, p, args), args)

        def total(p: PyTree) -> PyTree:
            net = force if friction is None else friction.net_force(t, force, p)
            return along(term.add_forces(net, term.external, *state(p)))

        def change(p: PyTree) -> PyTree:
            dp, found = force_flow(total, h, p, order)
            return tree.invalid_if(~found, dp)

        return change


def _by_friction(
    system, t, h, p, force, linear, order, once
) -> Callable[[PyTree], PyTree]:
    force, forms, drags = force
    parts, mechanics = system.parts, system.term.mechanics
    pairs = zip(parts.local, forms, strict=True)
    local = [
        LinearPart(LinearScale(), x, part.per_velocity, may_couple=True)
        for part, x in pairs
    ]
    friction = fit_friction([*local, *linear], mechanics, p)

    def prepare(h: Time) -> PyTree:
        if friction is None:
            return None
        bad = (as_time(h) < 0) & (friction.over(t, h) > _MOST_BACK)
        data = friction.prepare(t, h, order)
        return tree.invalid_if(bad, data if once else friction.fix([data])[0])

    def pushed(p: PyTree, h: Time, data: PyTree) -> PyTree:
        if friction is None:
            return tree.scale(h, force)
        # One exponential, and not two: of the momentum, and of the force.
        return friction.respond(data, friction.net_force(t, force, p))

    if not drags:
        data = prepare(h)
        return lambda p: pushed(p, h, data)
    h = lengths(order, h)
    rows = h, jax.vmap(prepare)(h)

    def change(p: PyTree) -> PyTree:
        def slowed(drags: list[Drag], dp: PyTree, h: Time) -> PyTree:
            for drag in drags:
                dp = tree.add(dp, drag.decay(h, tree.add(p, dp), mechanics.mass))
            return dp

        def stage(dp: PyTree, row) -> PyTree:
            h, data = row
            dp = slowed(drags, dp, h / 2)
            dp = tree.add(dp, pushed(tree.add(p, dp), h, data))
            return slowed(drags[::-1], dp, h / 2)

        return over_stages(stage, tree.zeros(p), rows)

    return change
