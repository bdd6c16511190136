"""The splits of mechanical systems."""

from typing import ClassVar, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PyTree

from .. import _tree as tree
from .._numbers import State, Time
from ._force_split import AbstractForceSplit
from ._split import AbstractSplit


if TYPE_CHECKING:
    from ._bound import System


def _potential_force(system: "System", t: Time, y: State) -> PyTree:
    return system.term.potential.force(t, tree.values(y)[0], system.args)


class KineticSplit(AbstractForceSplit):
    """The drift is the flow of the kinetic energy and of linear friction, the kick that
    of the potential and of friction that depends on place or speed."""

    kinds: frozenset[str] = eqx.field(static=True)
    kick_by: str = eqx.field(static=True, default="force")
    is_resolved: ClassVar[bool] = True

    def quadrature(self, system, order) -> int:
        return 0 if system.term.kinetic.flow_is_known(system.friction) else order

    def prepare(self, system, t, h, order) -> PyTree:
        return system.term.kinetic.prepare(system.friction, t, h, order)

    def drift(self, system, t, h, data, y) -> State:
        kinetic, p = system.term.kinetic, tree.values(y)[1]
        return system.add(y, kinetic.flow(system.friction, t, h, data, p, system.args))

    def place_force(self, system, t, y) -> PyTree:
        return _potential_force(system, t, y)


class PotentialSplit(AbstractSplit):
    """The drift is the flow of a quadratic potential, and the kick that of the
    kinetic energy: positions and momenta in swapped roles."""

    kinds: frozenset[str] = eqx.field(
        static=True, default=frozenset({"any", "nystrom"})
    )
    names: ClassVar[tuple[str, str]] = ("move", "push")
    is_resolved: ClassVar[bool] = True

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
    is_resolved: ClassVar[bool] = True

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
