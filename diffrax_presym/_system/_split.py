"""Splits: the pairs of exact flows into which the motion of a system splits.

A system lists the splits that it allows, and a scheme needs one by kind:

- `"separable"`: the velocity does not depend on `q`, and the force not on `p`;
- `"any"`: a drift, which is the exact flow of one part and advances time, and a kick by
  the other part, at fixed time;
- `"nystrom"`: as any, and the part that drifts is quadratic, so that the commutator
  [kick, [kick, [kick, drift]]] vanishes, as Runge--Kutta--Nyström methods require;
- `"shared"`: a second-order equation, with the friction turned into a force.

What a drift needs of time alone is prepared, for all stages of a step at once.
"""

import abc
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._misc import State, Time, tree_add, tree_scale


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
    def prepare(self, system: "System", t: Time, h: Time, order: int) -> PyTree:
        """What the drift from `t` to `t + h` needs of time alone."""

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

    @abc.abstractmethod
    def kick(
        self, system: "System", t: Time, h: Time, y: State, force: PyTree, order: int
    ) -> State:
        """The flow of the other part at fixed time, over a length `h`."""


def add_momentum(system: "System", h: Time, y: State, force: PyTree) -> State:
    """The kick of a force that does not depend on the momentum."""
    return system.add(y, (None, tree_scale(h, force)))


class KineticSplit(AbstractSplit):
    """The drift is the flow of the kinetic part, and the kick that of the potential and
    of friction that depends on place."""

    kinds: frozenset[str] = eqx.field(static=True)
    local: bool = eqx.field(static=True)

    def __init__(self, separable: bool, nystrom: bool, local: bool = False):
        """**Arguments:**

        - `separable`: whether the velocity depends on `p` alone, and the force on `q`.
        - `nystrom`: whether the kinetic part is quadratic in `p`.
        - `local`: whether there is friction that depends on place.
        """
        names = {"any": True, "separable": separable, "nystrom": nystrom}
        self.kinds = frozenset(name for name, holds in names.items() if holds)
        self.local = local

    def prepare(self, system: "System", t: Time, h: Time, order: int) -> PyTree:
        return system.term.prepare_drift(system.friction, t, h, order)

    def drift(
        self, system: "System", t: Time, h: Time, data: PyTree, y: State
    ) -> State:
        q, p = system.values(y)
        change = system.term.drift(system.friction, t, h, data, q, p, system.args)
        return system.add(y, change)

    def force(self, system: "System", t: Time, y: State) -> PyTree:
        force = system.potential_force(t, y)
        if not self.local:
            return force
        return force, system.term.local_friction(t, *system.values(y), system.args)

    def kick(self, system, t, h, y, force, order) -> State:
        if not self.local:
            return add_momentum(system, h, y, force)
        _, p = system.values(y)
        return system.add(y, (None, system.term.local_kick(t, h, p, *force, order)))


class PotentialSplit(AbstractSplit):
    """The drift is the flow of a quadratic potential, and the kick that of the
    kinetic energy: positions and momenta in swapped roles."""

    kinds: frozenset[str] = eqx.field(
        static=True, default=frozenset({"any", "nystrom"})
    )

    def prepare(self, system: "System", t: Time, h: Time, order: int) -> PyTree:
        friction = system.friction
        return None if friction is None else friction.prepare(t, h, order)

    def drift(
        self, system: "System", t: Time, h: Time, data: PyTree, y: State
    ) -> State:
        force = system.potential_force(t, y)
        if system.friction is None:
            return add_momentum(system, h, y, force)
        gained = system.friction.respond(data, force)
        return system.add(system.decay(data, y), (None, gained))

    def force(self, system: "System", t: Time, y: State) -> PyTree:
        return system.velocity(t, y)

    def kick(self, system, t, h, y, force, order) -> State:
        return system.add(y, (tree_scale(h, force), None))


class SharedSplit(AbstractSplit):
    r"""Half of the friction on positions and half on momenta, which leaves a force.

    With $q = e^{-\eta / 2} x$ the motion is
    $M x'' = e^{\eta / 2} F + (\eta'^2 / 4 + \eta'' / 2) M x$. The pair is $q$ and
    $p + \eta' M q / 2$, which are $e^{-\eta / 2}$ times $x$ and $M x'$; `enter` and
    `leave` go from $(q, p)$ to it and back.
    """

    kinds: frozenset[str] = eqx.field(static=True, default=frozenset({"shared"}))

    def times_mass(self, system: "System", x: PyTree) -> PyTree:
        return system.term.kinetic.momentum(system.values(x))

    def _shift(self, system: "System", t: Time, y: State, sign: float) -> State:
        law = system.one_rate
        if law is None:
            return y
        shift = tree_scale(sign * law.rate(t), self.times_mass(system, y[0]))
        return system.add(y, (None, shift))

    def enter(self, system: "System", t: Time, y: State) -> State:
        return self._shift(system, t, y, 0.5)

    def leave(self, system: "System", t: Time, z: State) -> State:
        return self._shift(system, t, z, -0.5)

    def prepare(self, system: "System", t: Time, h: Time, order: int) -> PyTree:
        law = system.one_rate
        return None if law is None else jnp.expm1(-law.increment(t, h) / 2)

    def drift(
        self, system: "System", t: Time, h: Time, data: PyTree, y: State
    ) -> State:
        y = system.add(y, (tree_scale(h, system.velocity(t, y)), None))
        return self.decay(system, data, y)

    def decay(self, system: "System", data: PyTree, y: State) -> State:
        """From the frame of the start of a span to that of its end."""
        return y if data is None else system.add(y, tree_scale(data, system.values(y)))

    def force(self, system: "System", t: Time, y: State) -> PyTree:
        force, law = system.potential_force(t, y), system.one_rate
        if law is None:
            return force
        t = jnp.asarray(t)
        rate, change = jax.jvp(law.rate, (t,), (jnp.ones_like(t),))
        mass = self.times_mass(system, y[0])
        return tree_add(force, rate * rate / 4 + change / 2, mass)

    def kick(self, system, t, h, y, force, order) -> State:
        return add_momentum(system, h, y, force)
