import abc
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Inexact, PyTree

from .._friction import AbstractDamping, AbstractFriction, check_scalar
from .._friction._base import Scalar, Time
from .._misc import as_time, tree_scale
from .._split import AbstractSplit


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


Q = PyTree[Inexact[Array, "..."]]
P = PyTree[Inexact[Array, "..."]]


class AbstractHamiltonian(eqx.Module):
    r"""A Hamiltonian, given by an energy $E$ and a log scale $\eta$.

    It is $H(t, q, P) = e^{\eta(t)} E(t, q, e^{-\eta(t)} P)$. The state of a solve is
    $q$ and the *mechanical* momentum $p = e^{-\eta(t)} P$, which stays of the size of
    the velocity under damping; the canonical momentum $P$ overflows in `float32` once
    $\eta(t)$ exceeds 88. The equations of motion are
    $q' = \partial E / \partial p$ and
    $p' = -\partial E / \partial q - \eta'(t) \, p$.
    """

    damping: AbstractVar[AbstractDamping | None]
    # The pairs of exact flows into which the motion splits, the best first. For example
    # `(KineticSplit(separable=True, nystrom=False),)`, or `()` if no exact flow is
    # known.
    splits: AbstractVar[tuple[AbstractSplit, ...]]

    @property
    def friction(self) -> AbstractFriction | None:
        """The friction in the frame of the momenta; by default that of `damping`."""
        check_scalar(self.damping, type(self).__name__)
        return self.damping

    @property
    def friction_table(self) -> PyTree:
        """What `with_table` was given, or `None`."""
        return None

    def with_table(self, table: PyTree) -> "AbstractHamiltonian":
        """The same system, whose friction uses the result of its `tabulate`."""
        return self

    @abc.abstractmethod
    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """The mechanical energy $E(t, q, p)$."""

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

        Overridden if the two share computations that XLA does not find.
        """
        return self.velocity(t, q, p, args), self.force(t, q, p, args)

    @abc.abstractmethod
    def kinetic_flow(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, P | None]:
        """The flow of the kinetic part from `t` to `t + h`, friction included.

        Returns the change of `q`, and that of `p` beyond the friction of `damping` or
        `None` if there is none. Exact if known in closed form, otherwise of the given
        order in `h`. Only used by splittings, if `splits` is not empty.
        """

    def friction_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        """The force of all friction."""
        zero = jtu.tree_map(jnp.zeros_like, p)
        friction = self.friction
        return zero if friction is None else friction.net_force(t, zero, p)

    def potential_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        r"""The force $-\partial V / \partial q$ of the potential part, if there is one.

        Equal to `force` unless the kinetic part depends on `q` too.
        """
        return self.force(t, q, p, args)

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        """Whether the energy is defined at this state; if not, a solve fails.

        `None`, the default, means that it is not checked.
        """
        return None

    def log_scale(self, t: Time) -> Scalar:
        r"""The log scale $\eta(t)$; 0 for a system without damping."""
        t = as_time(t)
        if self.damping is None:
            return jnp.zeros_like(t)
        check_scalar(self.damping, type(self).__name__)
        return self.damping(t)

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

    def _scale(self, t: Time, sign: int) -> Scalar | None:
        return None if self.damping is None else jnp.exp(sign * self.log_scale(t))
