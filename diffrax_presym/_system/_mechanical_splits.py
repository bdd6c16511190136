"""The splits of mechanical systems."""

import math
from typing import ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import PyTree

from .. import _tree as tree
from .._compositions import lengths
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


def _potential_force(system: "System", t: Time, y: State) -> PyTree:
    return system.term.potential.force(t, tree.values(y)[0], system.args)


class KineticSplit(AbstractSplit):
    """The drift is the flow of the kinetic energy and of linear friction, the kick that
    of the potential and of friction that depends on place or speed: exact if that is
    linear, otherwise a composition. A kick by any force of the velocity is implicit."""

    kinds: frozenset[str] = eqx.field(static=True)
    is_implicit: bool = eqx.field(static=True, default=False)

    @property
    def failure(self):
        return FORCE_NOT_SOLVED if self.is_implicit else NONFINITE

    def quadrature(self, system, order) -> int:
        return 0 if system.term.kinetic.flow_is_known(system.friction) else order

    def prepare(self, system, t, h, order) -> PyTree:
        return system.term.kinetic.prepare(system.friction, t, h, order)

    def drift(self, system, t, h, data, y) -> State:
        kinetic, p = system.term.kinetic, tree.values(y)[1]
        return system.add(y, kinetic.flow(system.friction, t, h, data, p, system.args))

    def force(self, system, t, y) -> PyTree:
        """The force, and the other friction at the place if there is any."""
        force = _potential_force(system, t, y)
        if "separable" in self.kinds or self.is_implicit:
            return force
        parts, at = system.parts, (t, tree.values(y)[0], system.args)
        forms = [part.at(*at) for part in parts.local]
        return force, forms, [drag.at(*at) for drag in parts.drags]

    def kick(self, system, t, h, y, force, order) -> State:
        if "separable" in self.kinds:
            return super().kick(system, t, h, y, force, order)
        if self.is_implicit:
            term, (q, p), args = system.term, tree.values(y), system.args
            state = lambda p: (t, q, p, term.velocity(t, q, p, args), args)
            total = lambda p: term.add_forces(force, term.external, *state(p))
            dp, found = force_flow(total, h, p, order)
            return system.add(y, (None, tree.invalid_if(~found, dp)))
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

        def stage(dp: PyTree, h: Time) -> tuple[PyTree, None]:
            dp = pushed(slowed(drags, dp, h / 2), h)
            return slowed(drags[::-1], dp, h / 2), None

        if drags:
            dp = lax.scan(stage, tree.zeros(p), lengths(order, h))[0]
        else:
            dp = pushed(tree.zeros(p), h)
        return system.add(y, (None, dp))


class PotentialSplit(AbstractSplit):
    """The drift is the flow of a quadratic potential, and the kick that of the
    kinetic energy: positions and momenta in swapped roles."""

    kinds: frozenset[str] = eqx.field(
        static=True, default=frozenset({"any", "nystrom"})
    )
    names: ClassVar[tuple[str, str]] = ("move", "push")

    def quadrature(self, system, order) -> int:
        return 0 if system.friction is None or system.friction.is_known else order

    def prepare(self, system, t, h, order) -> PyTree:
        friction = system.friction
        return None if friction is None else friction.prepare(t, h, order)

    def drift(self, system, t, h, data, y) -> State:
        force = _potential_force(system, t, y)
        if system.friction is None:
            return system.add(y, (None, tree.scale(h, force)))
        gained = system.friction.respond(data, force)
        return system.add(system.decay(data, y), (None, gained))

    def force(self, system, t, y) -> PyTree:
        return system.velocity(t, y)

    def kick(self, system, t, h, y, force, order) -> State:
        return system.add(y, (tree.scale(h, force), None))


class SharedSplit(AbstractSplit):
    """Of friction at one constant rate: half of it on positions and half on momenta,
    which leaves a force.

    With `q = exp(-γ t / 2) x` the motion is `M x'' = exp(γ t / 2) F + γ^2 M x / 4`. The
    pair is `q` and `p + γ M q / 2`, which are `exp(-γ t / 2)` times `x` and `M x'`;
    `enter` and `leave` go from `(q, p)` to it and back.
    """

    kinds: frozenset[str] = eqx.field(static=True)
    names: ClassVar[tuple[str, str]] = ("shared kick", "shared drift")

    def _shift(self, system: "System", t: Time, y: State, sign: float) -> State:
        law = system.term.damping
        if law is None:
            return y
        shift = system.term.kinetic.momentum(tree.values(y[0]))
        return system.add(y, (None, tree.scale(sign * law.rate(t), shift)))

    def enter(self, system: "System", t: Time, y: State) -> State:
        return self._shift(system, t, y, 0.5)

    def leave(self, system: "System", t: Time, z: State) -> State:
        return self._shift(system, t, z, -0.5)

    def prepare(self, system, t, h, order) -> PyTree:
        law = system.term.damping
        return None if law is None else jnp.expm1(-law.increment(t, h) / 2)

    def drift(self, system, t, h, data, y) -> State:
        y = system.add(y, (tree.scale(h, system.velocity(t, y)), None))
        # From the frame of the start of the span to that of its end.
        return y if data is None else system.add(y, tree.scale(data, tree.values(y)))

    def force(self, system, t, y) -> PyTree:
        force, law = _potential_force(system, t, y), system.term.damping
        if law is None:
            return force
        mass = system.term.kinetic.momentum(tree.values(y[0]))
        return tree.add_scaled(force, law.rate(t) ** 2 / 4, mass)
