"""Friction as a linear operator on momenta."""

import abc

import equinox as eqx
from jaxtyping import Array, ArrayLike, Bool, Inexact, PyTree, Real


Time = Real[ArrayLike, ""]
Scalar = Inexact[Array, ""]


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
    def amplification(self, t: Time, h: Time) -> Scalar:
        """The factor by which errors grow from `t + h` back to `t`."""

    @abc.abstractmethod
    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether the friction is infinite at `t`; `None` if it never is."""
