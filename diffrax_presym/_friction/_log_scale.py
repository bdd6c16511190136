"""Log scales: how a rate of friction depends on time, apart from its size.

The friction at the rate eta'(t) g, with any constant g, makes a momentum decay by
exp(-x g) where x is the difference of eta. What it does besides are integrals of such
exponentials.
"""

import abc
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Inexact

from .._checks import as_parameter
from .._numbers import as_time, cast_to, Scalar, Time
from ._exponential import expm1, expm1_and_ratio, gauss_legendre


class Effect(NamedTuple):
    """What friction does to a leaf over a span: numbers for its entries, or matrices.

    A matrix that is not exponentiated has the time in place of all three.
    """

    change: Array  # of a momentum by decay
    carried: Array  # the integral of a decaying momentum
    responded: Array  # the momentum left by a constant force


class AbstractLogScale(eqx.Module):
    """A function `η(t)`, the integral of a rate of friction.

    Subclass it for a rate whose differences are known without cancellation, and pass an
    instance as `friction=`; a function `eta(t)` is enough otherwise.
    """

    # Whether the rate is constant.
    is_autonomous: eqx.AbstractClassVar[bool]
    # The limit of the rate times the time since its singularity.
    strength: ClassVar[float] = 0.0

    @abc.abstractmethod
    def __call__(self, t: Time) -> Inexact[Array, "..."]:
        """The log scale `η(t)`."""

    @abc.abstractmethod
    def increment(self, t: Time, h: Time) -> Inexact[Array, "..."]:
        """The difference `η(t + h) - η(t)`.

        Subtracting two values loses most digits at late times in `float32`.
        """

    @abc.abstractmethod
    def rate(self, t: Time) -> Inexact[Array, "..."]:
        """The rate `η'(t)`."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the rate."""
        return jax.eval_shape(self.rate, jnp.zeros(())).shape

    def effect(self, rate: Array, t: Time, h: Time, order: int) -> Effect:
        """What friction of this log scale times a rate does from `t` to `t + h`, by a
        quadrature of at least the given order in `h` where it is not known in closed
        form."""
        return by_quadrature([(self, rate)], t, h, order)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether the rate is infinite at `t`; `None` if it never is."""
        return None


AbstractLogScale.__init__.__doc__ = "**Arguments:** its fields, if any."


Terms = Sequence[tuple[AbstractLogScale, Array]]


def increment(terms: Terms, t: Time, h: Time) -> Array:
    """The difference of a sum of log scales with factors."""
    each = [cast_to(rate, x := law.increment(t, h)) * x for law, rate in terms]
    return functools.reduce(jnp.add, each)


def by_quadrature(terms: Terms, t: Time, h: Time, order: int) -> Effect:
    """What friction of several log scales with factors does from `t` to `t + h`."""
    nodes, weights = gauss_legendre(h, order)
    decayed, left = decays(terms, t, h, nodes)
    weights = jnp.expand_dims(weights, range(1, left.ndim))
    integrals = (jnp.sum(weights * x, axis=0) for x in (decayed, left))
    return Effect(expm1(-increment(terms, t, h)), *integrals)


def decays(terms: Terms, t: Time, h: Time, nodes: Array) -> tuple[Array, Array]:
    """Of a momentum from the start of a span to some times in it, and from these to its
    end."""
    decayed = jax.vmap(lambda s: jnp.exp(-increment(terms, t, s)))(nodes)
    left = jax.vmap(lambda s: jnp.exp(-increment(terms, t + s, h - s)))(nodes)
    return decayed, left


class LinearScale(AbstractLogScale):
    """`η(t) = t`."""

    is_autonomous: ClassVar[bool] = True
    shape: ClassVar[tuple[int, ...]] = ()  # known without tracing

    def __call__(self, t: Time) -> Scalar:
        return as_time(t)

    def increment(self, t: Time, h: Time) -> Scalar:
        return as_time(h)

    def rate(self, t: Time) -> Scalar:
        return jnp.ones_like(as_time(t))

    def effect(self, rate: Array, t: Time, h: Time, order: int) -> Effect:
        x = cast_to(rate, h := as_time(h)) * h
        change, ratio = expm1_and_ratio(-x)
        integral = h * ratio
        return Effect(change, integral, integral)


# Of the singularity: the momentum left there is less than rounding.
_ALL_LOST = 40.0


class Logarithm(AbstractLogScale):
    """`η(t) = log(t + s)`."""

    shift: Inexact[ArrayLike, "..."] | None
    strength: ClassVar[float] = 1.0
    is_autonomous: ClassVar[bool] = False

    def __call__(self, t: Time) -> Scalar:
        return jnp.log(self._after(t))

    def _after(self, t: Time) -> Scalar:
        t = as_time(t)
        return t if self.shift is None else t + cast_to(self.shift, t)

    def since(self, t: Time) -> tuple[Bool[Array, "..."], Scalar]:
        """Whether `t` is the singularity, and the time since, or 1 there."""
        since = self._after(t)
        return since == 0, jnp.where(since == 0, 1, since)

    def increment(self, t: Time, h: Time) -> Scalar:
        singular, since = self.since(t)
        return jnp.where(singular, _ALL_LOST, jnp.log1p(as_time(h) / since))

    def rate(self, t: Time) -> Scalar:
        singular, since = self.since(t)
        return jnp.where(singular, jnp.inf, 1 / since)

    def effect(self, rate: Array, t: Time, h: Time, order: int) -> Effect:
        # With the time tau since the singularity, at the start and at the end, a
        # momentum decays by (tau / tau_end)^rate.
        singular, since = self.since(t)
        start = jnp.where(singular, 0, since)
        x, h, rate = self.increment(t, h), as_time(h), cast_to(rate, since)
        carried = start * x * expm1_and_ratio((1 - rate) * x)[1]
        # What has no friction is carried from the singularity on too.
        carried = jnp.where(singular & (rate == 0), h, carried)
        responded = (start + h) * x * expm1_and_ratio(-(1 + rate) * x)[1]
        return Effect(expm1(-rate * x), carried, responded)

    def is_singular(self, t: Time) -> Bool[Array, ""]:
        return jnp.any(self.since(t)[0])


class Power(AbstractLogScale):
    """`η(t) = t^δ`."""

    delta: Inexact[ArrayLike, "..."]
    is_autonomous: ClassVar[bool] = False

    def _parameters(self, t: Time):
        """Whether time is zero; the time there, which keeps its derivative, and the
        time elsewhere, or 1; and the exponent."""
        zero, t = as_time(t) == 0, as_time(t)
        here, since = jnp.where(zero, t, 1), jnp.where(zero, 1, t)
        return zero, here, since, cast_to(self.delta, t)

    def __call__(self, t: Time) -> Scalar:
        t = as_time(t)
        return t ** cast_to(self.delta, t)

    def increment(self, t: Time, h: Time) -> Scalar:
        zero, here, since, delta = self._parameters(t)
        h = as_time(h)
        # Back to zero, where time may be negative by rounding.
        back = h / since < -0.5
        end = jnp.maximum(jnp.where(back, since + h, 1), 0)
        change = jnp.log1p(jnp.where(back, 0, h) / since)
        ahead = since**delta * expm1(delta * change)
        grown = jnp.where(back, end**delta - since**delta, ahead)
        before = jnp.where(delta == 0, 1, here ** jnp.maximum(delta, 1))
        # A root has no derivative at zero.
        some = zero & ((here + h != 0) | (delta >= 1))
        first = jnp.where(some, here + h, 1) ** delta - before
        from_zero = jnp.where(delta < 0, jnp.nan, jnp.where(some, first, 0))
        return jnp.where(zero, from_zero, grown)

    def rate(self, t: Time) -> Scalar:
        zero, here, since, delta = self._parameters(t)
        # To JAX a power of one has no second derivative at zero.
        power = delta * here ** jnp.where((delta <= 1) | (delta == 2), 2, delta - 1)
        smooth = jnp.where(delta == 1, 1, jnp.where(delta == 2, 2 * here, power))
        first = jnp.where((delta < 1) & (delta != 0), jnp.inf, smooth)
        return jnp.where(zero, first, delta * since ** (delta - 1))

    def is_singular(self, t: Time) -> Bool[Array, ""]:
        zero, *_, delta = self._parameters(t)
        return zero & jnp.any((delta < 1) & (delta != 0))


_LAWS = " A law of friction is passed with its numbers: `ConstantDamping(rate)`."

_OF_TIME = (
    "A function given as `friction` is called as `eta(t)`, with the time. One of the "
    "velocity is written as `force=f`, with `f(t, q, v, args)`."
)


class FunctionOfTime(AbstractLogScale):
    """Any function `eta(t)`; its increments are plain differences."""

    eta: Callable
    is_autonomous: ClassVar[bool] = False

    def __call__(self, t: Time) -> Inexact[Array, "..."]:
        try:
            value = self.eta(t)
        except Exception as error:
            error.add_note(_OF_TIME)
            raise
        value = as_parameter(value, "The value of `eta(t)`", _LAWS)
        return cast_to(value, as_time(t))

    def increment(self, t: Time, h: Time) -> Inexact[Array, "..."]:
        return self(t + h) - self(t)

    def rate(self, t: Time) -> Inexact[Array, "..."]:
        t = as_time(t)
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]
