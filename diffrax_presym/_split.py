"""Splits: the pairs of exact flows into which the motion of a system splits.

A Hamiltonian lists the splits that its energy allows, and a scheme needs one by kind:

- `"separable"`: the velocity does not depend on `q`, and the force not on `p`;
- `"any"`: a drift, which is the exact flow of one part, and a kick by the other;
- `"nystrom"`: as any, and the part that drifts is quadratic, so that the commutator
  [kick, [kick, [kick, drift]]] vanishes, as Runge--Kutta--Nyström methods require;
- `"shared"`: a second-order equation, with the friction turned into a force.

Both act on a pair of variables, usually `(q, p)`: a drift advances time, and a kick
adds to the second of the pair.
"""

import abc
from typing import cast, TYPE_CHECKING, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact, PyTree

from ._friction._base import Time
from ._friction._damping import AbstractDamping, ScaledDamping


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar

    from ._hamiltonian import MechanicalSystem, QuadraticKinetic
    from ._system import System
else:
    from equinox import AbstractVar


State: TypeAlias = tuple[PyTree[Inexact[Array, "..."]], PyTree[Inexact[Array, "..."]]]


class AbstractSplit(eqx.Module):
    """A pair of exact flows, and the variables in which they act."""

    kinds: AbstractVar[frozenset[str]]

    @abc.abstractmethod
    def to_split(self, system: "System", t: Time, y: State) -> State:
        """The variables of the split, from `(q, p)`."""

    @abc.abstractmethod
    def from_split(self, system: "System", t: Time, z: State) -> State:
        """The inverse of `to_split`."""

    @abc.abstractmethod
    def drift(self, system: "System", t: Time, h: Time, z: State, order: int) -> State:
        """The flow of one part from `t` to `t + h`, friction included.

        Exact if known in closed form, otherwise of the given order in `h`.
        """

    @abc.abstractmethod
    def force(self, system: "System", t: Time, z: State) -> PyTree:
        """What a kick needs to know of the first variable: by default the rate of
        change of the second."""

    def kick(
        self, system: "System", t: Time, h: Time, z: State, force: PyTree, order: int
    ) -> State:
        """The flow of the other part at fixed time, over a length `h`."""
        first, second = z
        return first, system.add(second, h, force)


class _AbstractKineticSplit(AbstractSplit):
    """The drift is the flow of the kinetic part."""

    def to_split(self, system: "System", t: Time, y: State) -> State:
        return y

    def from_split(self, system: "System", t: Time, z: State) -> State:
        return z

    def drift(self, system: "System", t: Time, h: Time, z: State, order: int) -> State:
        return system.drift(t, h, z, order)


class KineticSplit(_AbstractKineticSplit):
    """The drift is the flow of the kinetic part, and the kick that of the potential."""

    kinds: frozenset[str] = eqx.field(static=True)

    def __init__(self, separable: bool, nystrom: bool):
        """**Arguments:**

        - `separable`: whether the velocity depends on `p` alone, and the force on `q`.
        - `nystrom`: whether the kinetic part is quadratic in `p`.
        """
        names = {"any": True, "separable": separable, "nystrom": nystrom}
        self.kinds = frozenset(name for name, holds in names.items() if holds)

    def force(self, system: "System", t: Time, z: State) -> PyTree:
        return system.potential_force(t, z)


class LocalSplit(_AbstractKineticSplit):
    """The drift is the flow of the kinetic part, and the kick that of the potential and
    of friction that depends on place, for [`diffrax_presym.MechanicalSystem`][]."""

    @property
    def kinds(self) -> frozenset[str]:
        return frozenset({"any"})

    def force(self, system: "System", t: Time, z: State) -> PyTree:
        q, _ = system.values(z)
        values = _mechanical(system).local_values(t, q, system.args)
        return system.potential_force(t, z), values

    def kick(
        self, system: "System", t: Time, h: Time, z: State, force: PyTree, order: int
    ) -> State:
        (q, p), (force, values) = z, force
        change = _mechanical(system).kick(t, h, system.values(p), force, values, order)
        return q, system.add(p, 1, change)


def _mechanical(system: "System") -> "MechanicalSystem":
    return cast("MechanicalSystem", system.hamiltonian)


class PotentialSplit(AbstractSplit):
    """The drift is the flow of a quadratic potential, and the kick that of the
    kinetic energy: positions and momenta in swapped roles."""

    @property
    def kinds(self) -> frozenset[str]:
        return frozenset({"any", "nystrom"})

    def to_split(self, system: "System", t: Time, y: State) -> State:
        q, p = y
        return p, q

    def from_split(self, system: "System", t: Time, z: State) -> State:
        p, q = z
        return q, p

    def drift(self, system: "System", t: Time, h: Time, z: State, order: int) -> State:
        p, q = z
        force = system.potential_force(t, (q, p))
        if system.friction is None:
            return system.add(p, h, force), q
        gained = system.friction.respond(t, h, force, order)
        return system.add(system.move_frame(t, h, p), 1, gained), q

    def force(self, system: "System", t: Time, z: State) -> PyTree:
        p, q = z
        return system.velocity(t, (q, p))


class SharedSplit(AbstractSplit):
    r"""Half of the friction on positions and half on momenta, which leaves a force.

    With $q = e^{-\eta / 2} x$ the motion is
    $M x'' = e^{\eta / 2} F + (\eta'^2 / 4 + \eta'' / 2) M x$. The pair is $q$ and
    $p + \eta' M q / 2$, which are $e^{-\eta / 2}$ times $x$ and $M x'$.
    """

    kinetic: "QuadraticKinetic"
    half: ScaledDamping | None

    def __init__(self, kinetic: "QuadraticKinetic", damping: AbstractDamping | None):
        """**Arguments:**

        - `kinetic`: the kinetic energy, whose mass is constant.
        - `damping`: the damping law of the Hamiltonian, or `None`.
        """
        self.kinetic = kinetic
        self.half = None if damping is None else ScaledDamping(damping, 0.5)

    @property
    def kinds(self) -> frozenset[str]:
        return frozenset({"shared"})

    def _momentum(self, system: "System", q: PyTree) -> PyTree:
        return self.kinetic.momentum(system.values(q))

    def _shift(self, system: "System", t: Time, y: State, sign: int) -> State:
        if self.half is None:
            return y
        q, p = y
        return q, system.add(p, sign * self.half.rate(t), self._momentum(system, q))

    def to_split(self, system: "System", t: Time, y: State) -> State:
        return self._shift(system, t, y, 1)

    def from_split(self, system: "System", t: Time, z: State) -> State:
        return self._shift(system, t, z, -1)

    def drift(self, system: "System", t: Time, h: Time, z: State, order: int) -> State:
        q, p = z
        z = system.add(q, h, system.velocity(t, z)), p
        if self.half is None:
            return z
        return system.add(z, 1, self.half.decay(t, h, system.values(z)))

    def force(self, system: "System", t: Time, z: State) -> PyTree:
        force = system.potential_force(t, z)
        if self.half is None:
            return force
        rate, change = jax.jvp(self.half.rate, (t,), (jnp.ones_like(t),))
        return system.add(force, rate**2 + change, self._momentum(system, z[0]))
