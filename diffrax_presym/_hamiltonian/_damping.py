import abc
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact, PyTree, Real

from .._misc import as_parameter, cast_to, tree_add


Time = Real[Array, ""]
Scalar = Inexact[Array, ""]


class AbstractDamping(eqx.Module):
    r"""A log scale $\eta(t)$: how much the frame of the momentum has shrunk by $t$.

    The physical equations of motion lose momentum at the rate $\eta'(t)$. Positive
    rates damp, negative rates excite.
    """

    @abc.abstractmethod
    def __call__(self, t: Time) -> Scalar:
        r"""The log scale $\eta(t)$."""

    @abc.abstractmethod
    def increment(self, t: Time, h: Time) -> Scalar:
        r"""The difference $\eta(t + h) - \eta(t)$.

        It is all a solver ever uses of $\eta$. Subtracting two values of $\eta$ loses
        most digits at late times in `float32`, so each law gives its difference in a
        form without cancellation.
        """

    @abc.abstractmethod
    def rate(self, t: Time) -> Scalar:
        r"""The rate of damping $\eta'(t)$."""

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        r"""The integral of $e^{\eta(t) - \eta(s)}$ over $s$ from $t$ to $t + h$.

        How far a velocity that is one at $t$, and decays with the frame, carries.
        Exact where the law allows, and otherwise to the given order in `h`.
        """
        return quadrature(lambda s: jnp.exp(-self.increment(t, s)), h, order)

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        r"""The integral of $e^{\eta(s) - \eta(t + h)}$ over $s$ from $t$ to $t + h$.

        What a force that is one all the time does to a momentum, which decays with the
        frame. Exact where the law allows, and otherwise to the given order in `h`.
        """
        return quadrature(lambda s: jnp.exp(-self.increment(t + s, h - s)), h, order)


class ConstantDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma t$: friction at the constant rate $\gamma$.

    The heavy-ball method and the damped oscillator, equation (eta1_large) of França,
    Jordan and Vidal (2021).
    """

    gamma: Scalar

    def __init__(self, gamma):
        """**Arguments:**

        - `gamma`: the rate of damping, in units of one over time. A real number of any
            sign; negative excites.
        """
        self.gamma = as_parameter(gamma, "`ConstantDamping(gamma)`")

    def __call__(self, t: Time) -> Scalar:
        return cast_to(self.gamma, t) * t

    def increment(self, t: Time, h: Time) -> Scalar:
        return cast_to(self.gamma, h) * h

    def rate(self, t: Time) -> Scalar:
        return cast_to(self.gamma, t)

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        return h * _expm1_ratio(-self.increment(t, h))

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        return self.integral(t, h, order)


class LogDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma \log(t + s)$: friction that decays as
    $\gamma / (t + s)$.

    With $\gamma = 3$ and no shift this is the ODE of Nesterov's method, equation
    (eta1_small) of França, Jordan and Vidal (2021); with $s = 1$ their decaying
    oscillator.

    The rate is infinite at $t = -s$, where positive damping holds a system at rest: a
    solve may start there, from zero momentum. Schemes whose stages leave the step, such
    as [`diffrax_presym.PresymplecticYoshida4`][], need a start further from there than
    the stages reach; else the solve is `nan`, which [`diffrax_presym.Checked`][]
    reports.
    """

    gamma: Scalar
    shift: Scalar

    def __init__(self, gamma, shift: ArrayLike = 0.0):
        """**Arguments:**

        - `gamma`: the strength of the damping, a dimensionless number of any sign.
        - `shift`: the shift $s$ of time, in units of time. Defaults to 0.
        """
        self.gamma = as_parameter(gamma, "`LogDamping(gamma)`")
        self.shift = as_parameter(shift, "`LogDamping(shift=...)`")

    def __call__(self, t: Time) -> Scalar:
        return cast_to(self.gamma, t) * jnp.log(t + cast_to(self.shift, t))

    def increment(self, t: Time, h: Time) -> Scalar:
        since = t + cast_to(self.shift, t)
        return cast_to(self.gamma, t) * jnp.log1p(h / since)

    def rate(self, t: Time) -> Scalar:
        return cast_to(self.gamma, t) / (t + cast_to(self.shift, t))

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        # With x = log((s + h) / s) it is s (exp((1 - gamma) x) - 1) / (1 - gamma).
        singular, since, growth = self._grow(t, h)
        carried = since * growth * _expm1_ratio((1 - cast_to(self.gamma, t)) * growth)
        # At the singularity itself all momentum is lost before it carries anywhere.
        return jnp.where(singular, 0, carried)

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        # With the same x it is (s + h) (1 - exp(-(1 + gamma) x)) / (1 + gamma).
        singular, since, growth = self._grow(t, h)
        power = 1 + cast_to(self.gamma, t)
        gained = (since + h) * growth * _expm1_ratio(-power * growth)
        return jnp.where(singular, h / jnp.where(singular, power, 1), gained)

    def _grow(self, t, h):
        """Whether `t` is the singularity, the time since then, and its growth."""
        since = t + cast_to(self.shift, t)
        singular = since == 0
        since = jnp.where(singular, 1, since)
        return singular, since, jnp.log1p(h / since)


class MixedDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma_1 \log t + \gamma_2 t^\delta$.

    Between [`diffrax_presym.LogDamping`][] and [`diffrax_presym.ConstantDamping`][]:
    equation (damp_between) of França, Jordan and Vidal (2021). Time must be positive;
    the remarks on $t = 0$ in [`diffrax_presym.LogDamping`][] hold here too.
    """

    gamma1: Scalar
    gamma2: Scalar
    delta: Scalar

    def __init__(self, gamma1, gamma2, delta):
        r"""**Arguments:**

        - `gamma1`: the strength of the logarithmic part, dimensionless.
        - `gamma2`: the strength of the power, in units of time to the power $-\delta$.
        - `delta`: the exponent, between 0 and 1 in the paper.
        """
        self.gamma1 = as_parameter(gamma1, "`MixedDamping(gamma1, ...)`")
        self.gamma2 = as_parameter(gamma2, "`MixedDamping(..., gamma2, ...)`")
        self.delta = as_parameter(delta, "`MixedDamping(..., delta)`")

    def _parameters(self, t):
        return (cast_to(x, t) for x in (self.gamma1, self.gamma2, self.delta))

    def __call__(self, t: Time) -> Scalar:
        gamma1, gamma2, delta = self._parameters(t)
        return gamma1 * jnp.log(t) + gamma2 * t**delta

    def increment(self, t: Time, h: Time) -> Scalar:
        gamma1, gamma2, delta = self._parameters(t)
        growth = jnp.log1p(h / t)
        return gamma1 * growth + gamma2 * t**delta * _expm1(delta * growth)

    def rate(self, t: Time) -> Scalar:
        gamma1, gamma2, delta = self._parameters(t)
        return gamma1 / t + gamma2 * delta * t ** (delta - 1)


class CallableDamping(AbstractDamping):
    """Any function `eta(t)` as a damping; its increments are plain differences."""

    eta: Callable

    def __call__(self, t: Time) -> Scalar:
        return cast_to(self.eta(t), t)

    def increment(self, t: Time, h: Time) -> Scalar:
        return self(t + h) - self(t)

    def rate(self, t: Time) -> Scalar:
        t = jnp.asarray(t)
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]


def move_frame(
    damping: AbstractDamping | None, t: Time, h: Time, p: PyTree, share: float = 1
) -> PyTree:
    """`exp(eta(t) - eta(t + h)) p`: from the frame of `t` to the frame of `t + h`.

    Or to a power, the share that `p` has in the frame.
    """
    if damping is None:
        return p
    increment = share * _one_number(damping.increment(t, h))
    # As a factor, rounding would make the same error at every step, and errors that are
    # the same add up. As an increment they vary with `p`, and mostly cancel.
    return tree_add(p, _expm1(-increment), p)


def add_friction(damping: AbstractDamping | None, t: Time, force: PyTree, p: PyTree):
    """`force - eta'(t) p`: the whole rate of change of the momentum."""
    if damping is None:
        return force
    return tree_add(force, -_one_number(damping.rate(t)), p)


def _one_number(damping: Scalar) -> Scalar:
    if jnp.shape(damping) != ():
        raise ValueError(
            "The damping must be one number for the whole system, but has shape "
            f"{jnp.shape(damping)}. The momenta share one frame; solve systems with "
            "different dampings side by side with `jax.vmap`."
        )
    return damping


def gauss_legendre(h: Time, order: int) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature from 0 to `h`, of at least the given order."""
    nodes, weights = np.polynomial.legendre.leggauss((order + 1) // 2)
    return cast_to((1 + nodes) / 2, h) * h, cast_to(weights / 2, h) * h


def quadrature(fn: Callable, h: Time, order: int) -> Scalar:
    """The integral of a number that depends on time, from 0 to `h`."""
    nodes, weights = gauss_legendre(h, order)
    return jnp.sum(weights * cast_to(jax.vmap(fn)(nodes), h))


# exp(x) - 1 and its ratio to x, to rounding and with their derivatives, through zero.
# XLA's own expm1 takes longer than all else in a leapfrog step of one unknown.


@jax.custom_jvp
def _expm1(x: Scalar) -> Scalar:
    return jnp.where(jnp.abs(x) < 0.1, x * _series(x), jnp.exp(x) - 1)


@_expm1.defjvp
def _expm1_jvp(x, dx):
    # Much shorter than the derivative of the series.
    value = _expm1(*x)
    return value, (value + 1) * dx[0]


def _expm1_ratio(x: Scalar) -> Scalar:
    small = jnp.abs(x) < 0.1
    return jnp.where(small, _series(x), (jnp.exp(x) - 1) / jnp.where(small, 1, x))


def _series(x: Scalar) -> Scalar:
    # Horner's rule; `jnp.polyval` would be a loop.
    value = 1 / math.factorial(10)
    for k in range(9, 0, -1):
        value = value * x + 1 / math.factorial(k)
    return jnp.asarray(value)


def as_damping(damping, name: str) -> AbstractDamping:
    if isinstance(damping, AbstractDamping):
        return damping
    if callable(damping):
        return CallableDamping(damping)
    raise ValueError(
        f"{name} must be a damping law or a function eta(t), but got {damping!r}. For "
        "friction at a constant rate write `ConstantDamping(rate)`."
    )
