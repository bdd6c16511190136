import abc
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Inexact, PyTree

from .._misc import tree_scale
from ._damping import AbstractDamping, Scalar, Time
from ._kinetic import QuadraticKinetic


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


Q = PyTree[Inexact[Array, "..."]]
P = PyTree[Inexact[Array, "..."]]


class AbstractHamiltonian(eqx.Module):
    r"""What is simulated: an energy $E$ and a log scale $\eta$.

    Together they are the Hamiltonian
    $H(t, q, P) = e^{\eta(t)} E(t, q, e^{-\eta(t)} P)$. The state of a solve is $q$
    and the *mechanical* momentum $p = e^{-\eta(t)} P$, which stays of the size of the
    velocity however much the system is damped; the canonical momentum $P$ overflows
    once $\eta(t)$ exceeds 88 in `float32`. The equations of motion are
    $q' = \partial E / \partial p$ and
    $p' = -\partial E / \partial q - \eta'(t) \, p$.
    """

    damping: AbstractVar[AbstractDamping | None]

    @property
    @abc.abstractmethod
    def is_separable(self) -> bool:
        """Whether the velocity does not depend on `q`, nor the force on `p`."""

    @abc.abstractmethod
    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """The mechanical energy $E(t, q, p)$, what a physicist calls the energy."""

    @abc.abstractmethod
    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        r"""The velocity $\partial E / \partial p$."""

    @abc.abstractmethod
    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        r"""The force $-\partial E / \partial q$, without the friction."""

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        """Both at once, for schemes that need them at the same place.

        Overridden where the two have much in common, which XLA finds only in part.
        """
        return self.velocity(t, q, p, args), self.force(t, q, p, args)

    @property
    @abc.abstractmethod
    def is_split(self) -> bool:
        """Whether the energy is a part whose flow is known plus `V(t, q)`."""

    @property
    @abc.abstractmethod
    def is_quadratic(self) -> bool:
        """Whether that part is known to be a kinetic energy quadratic in `p`."""

    @property
    def has_quadratic_potential(self) -> bool:
        """Whether the energy is known to be a sum of any kinetic energy and a potential
        quadratic in `q` that does not depend on time."""
        return False

    @property
    def quadratic_kinetic(self) -> QuadraticKinetic | None:
        """The kinetic energy, if the energy is known to be the sum of a potential and
        one with a constant mass."""
        return None

    @abc.abstractmethod
    def drift(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, P]:
        """The flow of the kinetic part from `t` to `t + h`, frame included.

        Exact where it is known in closed form, and else to the given order in `h`.
        """

    def potential_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        r"""The force $-\partial V / \partial q$ of the potential part, if split.

        All of `force`, unless the kinetic part depends on `q` too.
        """
        return self.force(t, q, p, args)

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        """Whether the energy is defined at this state. Where it is not, a solve fails.

        `None`, the default, where it is not worth checking.
        """
        return None

    def log_scale(self, t: Time) -> Scalar:
        r"""The log scale $\eta(t)$; 0 for a system without damping."""
        return jnp.zeros_like(t) if self.damping is None else self.damping(t)

    def canonical(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        r"""The value of the Hamiltonian, $e^{\eta(t)} E(t, q, p)$.

        `p` is the mechanical momentum, as in a solution.
        """
        energy = self.energy(t, q, p, args)
        return tree_scale(self._scale(t, 1), energy)

    def to_canonical(self, t: Time, p: P) -> P:
        r"""From the mechanical momentum to the canonical, $P = e^{\eta(t)} p$."""
        return tree_scale(self._scale(t, 1), p)

    def from_canonical(self, t: Time, P: P) -> P:
        r"""From the canonical momentum to the mechanical, $p = e^{-\eta(t)} P$."""
        return tree_scale(self._scale(t, -1), P)

    def _scale(self, t, sign):
        return None if self.damping is None else jnp.exp(sign * self.damping(t))
