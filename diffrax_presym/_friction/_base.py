"""Friction as a linear operator on momenta."""

import abc

import equinox as eqx
from jaxtyping import Array, ArrayLike, Bool, Inexact, PyTree, Real


Time = Real[ArrayLike, ""]
Scalar = Inexact[Array, ""]
# A scalar for the whole system, or arrays for the entries of its momenta.
Numbers = PyTree[Inexact[Array, "..."]]


class AbstractFriction(eqx.Module):
    r"""Linear friction, $p' = F - \Gamma(t) \, p$.

    The interface that solvers use. Methods return changes rather than new momenta, so
    that solvers can add them with compensated summation.
    """

    @abc.abstractmethod
    def decay(self, t: Time, h: Time, p: PyTree) -> PyTree:
        """The change of `p` from `t` to `t + h` by friction alone."""

    @abc.abstractmethod
    def carry(self, t: Time, h: Time, p: PyTree, order: int) -> PyTree:
        """The integral of the decaying `p` from `t` to `t + h`.

        Exact if known in closed form, otherwise of the given order in `h`.
        """

    @abc.abstractmethod
    def respond(self, t: Time, h: Time, force: PyTree, order: int) -> PyTree:
        """The momentum gained from `t` to `t + h` under a constant force.

        Exact if known in closed form, otherwise of the given order in `h`.
        """

    @abc.abstractmethod
    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        r"""The force less the friction, $F - \Gamma(t) \, p$."""

    @abc.abstractmethod
    def amplification(self, t: Time, h: Time, p: PyTree) -> Scalar:
        """The factor by which errors of `p` grow from `t + h` back to `t`."""

    @abc.abstractmethod
    def contraction(self, t: Time, h: Time, p: PyTree) -> Scalar:
        r"""The integral of the trace of $\Gamma$ from `t` to `t + h`.

        Phase volume contracts by the exponential of it. Of `p` only the shapes matter.
        """

    @abc.abstractmethod
    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether the friction is infinite at `t`; `None` if it never is."""

    def has_table(self, p: PyTree) -> bool:
        """Whether `decay`, `carry` and `respond` share what is worth storing. Of `p`
        only the shapes matter."""
        return False

    def tabulate(self, p: PyTree, times: Array) -> PyTree:
        """What these share for times of such lengths, if there is such a thing."""
        return None

    def with_table(self, table: PyTree) -> "AbstractFriction":
        """The same friction, which uses the result of `tabulate`."""
        return self
