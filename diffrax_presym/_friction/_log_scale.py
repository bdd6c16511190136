"""Log scales: how a rate of friction depends on time, apart from its size.

The friction at the rate eta'(t) G, with any constant G, makes a momentum decay by
exp(-x G) where x is the difference of eta. What it does besides are integrals of such
exponentials, which each log scale states for numbers and matrices G alike.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact

from .._misc import as_time, cast_to, Scalar, Time
from ._exponential import expm1, gauss_legendre


class Integral(eqx.Module):
    r"""A multiple of $\int_0^x e^{-s (G + c)} \, \mathrm ds$."""

    factor: Scalar
    x: Scalar
    shift: float = eqx.field(static=True)  # c


class Quadrature(eqx.Module):
    r"""A sum $\sum_j w_j e^{-x_j G}$."""

    weights: Inexact[Array, " nodes"]
    x: Inexact[Array, "nodes ..."]


class Exponents(eqx.Module):
    """What friction does over a span, but for the size of its rate."""

    x: Scalar  # it makes a momentum decay by exp(-x G)
    carried: Integral | Quadrature  # the integral of a decaying momentum
    responded: Integral | Quadrature  # the momentum left by a constant force


class AbstractLogScale(eqx.Module):
    r"""A function $\eta(t)$, the integral of a rate of friction.

    Subclass it for a rate whose differences are known without cancellation, and pass an
    instance as `friction=`; a function `eta(t)` is enough otherwise.
    """

    # Whether the rate is constant; and whether it has a derivative, which schemes in
    # the shared frame need.
    is_autonomous: eqx.AbstractClassVar[bool]
    is_smooth: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def __call__(self, t: Time) -> Inexact[Array, "..."]:
        r"""The log scale $\eta(t)$."""

    @abc.abstractmethod
    def increment(self, t: Time, h: Time) -> Inexact[Array, "..."]:
        r"""The difference $\eta(t + h) - \eta(t)$.

        Subtracting two values loses most digits at late times in `float32`.
        """

    @abc.abstractmethod
    def rate(self, t: Time) -> Inexact[Array, "..."]:
        r"""The rate $\eta'(t)$."""

    def exponents(self, t: Time, h: Time, order: int) -> Exponents:
        """What this friction does from `t` to `t + h`, by a quadrature of at least the
        given order in `h` where it is not known in closed form."""
        return by_quadrature(self, t, h, order)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether the rate is infinite at `t`; `None` if it never is."""
        return None

    @property
    def strength(self) -> float:
        """The limit of the rate times the time since its singularity."""
        return 0.0


def by_quadrature(law: AbstractLogScale, t: Time, h: Time, order: int) -> Exponents:
    nodes, weights = gauss_legendre(h, order)
    carried = jax.vmap(lambda s: law.increment(t, s))(nodes)
    responded = jax.vmap(lambda s: law.increment(t + s, h - s))(nodes)
    return Exponents(
        law.increment(t, h),
        Quadrature(weights, carried),
        Quadrature(weights, responded),
    )


class Linear(AbstractLogScale):
    r"""$\eta(t) = t$."""

    is_autonomous: ClassVar[bool] = True
    is_smooth: ClassVar[bool] = True

    def __call__(self, t: Time) -> Scalar:
        return as_time(t)

    def increment(self, t: Time, h: Time) -> Scalar:
        return as_time(h)

    def rate(self, t: Time) -> Scalar:
        return jnp.ones_like(as_time(t))

    def exponents(self, t: Time, h: Time, order: int) -> Exponents:
        h = as_time(h)
        integral = Integral(jnp.ones_like(h), h, 0.0)
        return Exponents(h, integral, integral)


# Of the singularity: the momentum left there is less than rounding.
_ALL_LOST = 40.0


class Logarithm(AbstractLogScale):
    r"""$\eta(t) = \log(t + s)$."""

    shift: Inexact[ArrayLike, "..."] | None
    is_autonomous: ClassVar[bool] = False
    is_smooth: ClassVar[bool] = True

    def __call__(self, t: Time) -> Scalar:
        return jnp.log(self._after(t))

    def _after(self, t: Time) -> Scalar:
        t = as_time(t)
        return t if self.shift is None else t + cast_to(self.shift, t)

    def _since(self, t: Time) -> tuple[Bool[Array, "..."], Scalar]:
        """Whether `t` is the singularity, and the time since, or 1 there."""
        since = self._after(t)
        return since == 0, jnp.where(since == 0, 1, since)

    def increment(self, t: Time, h: Time) -> Scalar:
        singular, since = self._since(t)
        return jnp.where(singular, _ALL_LOST, jnp.log1p(as_time(h) / since))

    def rate(self, t: Time) -> Scalar:
        singular, since = self._since(t)
        return jnp.where(singular, jnp.inf, 1 / since)

    def exponents(self, t: Time, h: Time, order: int) -> Exponents:
        # With the time tau since the singularity, at the start and at the end,
        # exp(-x G) is (tau / tau_end)^G.
        singular, since = self._since(t)
        start = jnp.where(singular, 0, since)
        x, h = self.increment(t, h), as_time(h)
        return Exponents(x, Integral(start, x, -1.0), Integral(start + h, x, 1.0))

    def is_singular(self, t: Time) -> Bool[Array, ""]:
        return jnp.any(self._since(t)[0])

    @property
    def strength(self) -> float:
        return 1.0


class Power(AbstractLogScale):
    r"""$\eta(t) = t^\delta$."""

    delta: Inexact[ArrayLike, "..."]
    is_autonomous: ClassVar[bool] = False
    is_smooth: ClassVar[bool] = True

    def _parameters(self, t: Time):
        """Whether time is zero, the time, or 1 there, and the exponent."""
        t = as_time(t)
        return t == 0, jnp.where(t == 0, 1, t), cast_to(self.delta, t)

    def __call__(self, t: Time) -> Scalar:
        t = as_time(t)
        return t ** cast_to(self.delta, t)

    def increment(self, t: Time, h: Time) -> Scalar:
        zero, since, delta = self._parameters(t)
        h = as_time(h)
        grown = since**delta * expm1(delta * jnp.log1p(h / since))
        return jnp.where(zero, jnp.where(zero, h, 1) ** delta, grown)

    def rate(self, t: Time) -> Scalar:
        zero, since, delta = self._parameters(t)
        return jnp.where(zero, jnp.inf, delta * since ** (delta - 1))

    def is_singular(self, t: Time) -> Bool[Array, ""]:
        return as_time(t) == 0


class FunctionOfTime(AbstractLogScale):
    """Any function `eta(t)`; its increments are plain differences."""

    eta: Callable
    is_autonomous: ClassVar[bool] = False
    # It may have a rate that jumps.
    is_smooth: ClassVar[bool] = False

    def __call__(self, t: Time) -> Inexact[Array, "..."]:
        return cast_to(self.eta(t), as_time(t))

    def increment(self, t: Time, h: Time) -> Inexact[Array, "..."]:
        return self(t + h) - self(t)

    def rate(self, t: Time) -> Inexact[Array, "..."]:
        t = as_time(t)
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]
