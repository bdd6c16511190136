"""Friction with one rate for all momenta, which may depend on time."""

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, PyTree

from .._misc import as_parameter, as_time, cast_to, tree_add, tree_scale
from ._base import AbstractFriction, Scalar, Time
from ._functions import expm1, expm1_ratio, log_growth, quadrature


class AbstractDamping(AbstractFriction):
    r"""A log scale $\eta(t)$, or friction $p' = F - \eta'(t) \, p$.

    Positive rates $\eta'$ damp, negative rates excite. Subclasses define `__call__`,
    `increment` and `rate`; by default `integral` and `response` are computed by
    quadrature.
    """

    @abc.abstractmethod
    def __call__(self, t: Time) -> Scalar:
        r"""The log scale $\eta(t)$."""

    @abc.abstractmethod
    def increment(self, t: Time, h: Time) -> Scalar:
        r"""The difference $\eta(t + h) - \eta(t)$.

        Solvers use only differences of $\eta$. Subtracting two values loses most digits
        at late times in `float32`, so each law computes them without cancellation.
        """

    @abc.abstractmethod
    def rate(self, t: Time) -> Scalar:
        r"""The rate of damping $\eta'(t)$."""

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        r"""The integral of $e^{\eta(t) - \eta(s)}$ over $s$ from $t$ to $t + h$.

        The displacement under a velocity that is one at $t$ and decays by friction.
        Exact if known in closed form, otherwise of the given order in `h`.
        """
        return quadrature(lambda s: jnp.exp(-self.increment(t, s)), h, order)

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        r"""The integral of $e^{\eta(s) - \eta(t + h)}$ over $s$ from $t$ to $t + h$.

        The momentum gained under a unit force. Exact if known in closed form,
        otherwise of the given order in `h`.
        """
        return quadrature(lambda s: jnp.exp(-self.increment(t + s, h - s)), h, order)

    def decay(self, t: Time, h: Time, p: PyTree) -> PyTree:
        # A factor would have the same rounding error at every step, and equal errors
        # add up. The errors of increments vary with `p`, and mostly cancel.
        return tree_scale(expm1(-_one_number(self.increment(t, h))), p)

    def carry(self, t: Time, h: Time, p: PyTree, order: int) -> PyTree:
        return tree_scale(self.integral(t, h, order), p)

    def respond(self, t: Time, h: Time, force: PyTree, order: int) -> PyTree:
        return tree_scale(self.response(t, h, order), force)

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        rate, singular = _one_number(self.rate(t)), self.is_singular(t)
        if singular is None:
            return tree_add(force, -rate, p)
        regular = tree_add(force, -jnp.where(singular, 0, rate), p)
        return jax.tree.map(
            lambda f, x, p: jnp.where(singular, self._at_rest(rate, f, p), x),
            *(force, regular, p),
        )

    def _at_rest(self, rate: Scalar, force: Array, p: Array) -> Array:
        """The limit of `F - gamma p / t` as `t` goes to zero, for motion from rest.

        There `p` grows like `F t / (1 + gamma)`. For any other momentum there is no
        limit, unless the rate is zero.
        """
        limit = force / (1 + cast_to(self.strength, force))
        return jnp.where((p == 0) | (rate == 0), limit, jnp.nan)

    @property
    def strength(self) -> Scalar | float:
        """The rate times the time since its singularity, or 0 if it has none."""
        return 0.0

    def amplification(self, t: Time, h: Time) -> Scalar:
        return jnp.exp(self.increment(t, h))

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return None


def _one_number(damping: Scalar) -> Scalar:
    if jnp.shape(damping) != ():
        raise ValueError(
            "The damping must be a scalar for the whole system, but has shape "
            f"{jnp.shape(damping)}. The momenta share one frame; to solve systems with "
            "different dampings use `jax.vmap`."
        )
    return damping


def _infinite(gamma: Scalar) -> Scalar:
    """Infinity with the sign of `gamma`, or zero where `gamma` is zero."""
    return jnp.where(gamma == 0, 0, jnp.where(gamma > 0, jnp.inf, -jnp.inf))


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
        t = as_time(t)
        return cast_to(self.gamma, t) * t

    def increment(self, t: Time, h: Time) -> Scalar:
        h = as_time(h)
        return cast_to(self.gamma, h) * h

    def rate(self, t: Time) -> Scalar:
        return cast_to(self.gamma, as_time(t))

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        return as_time(h) * expm1_ratio(-self.increment(t, h))

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        return self.integral(t, h, order)


class LogDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma \log(t + s)$: friction that decays as
    $\gamma / (t + s)$.

    With $\gamma = 3$ and no shift this is the ODE of Nesterov's method, equation
    (eta1_small) of França, Jordan and Vidal (2021); with $s = 1$ their decaying
    oscillator.

    The rate is infinite at $t = -s$. With positive damping a solve may start there,
    from zero momentum. Schemes whose stages extend beyond the step, such as
    [`diffrax_presym.PresymplecticYoshida4`][], must start far enough from there;
    otherwise the solve is `nan`, which [`diffrax_presym.Checked`][] reports.
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

    def _since(self, t: Time) -> tuple[Bool[Array, ""], Scalar, Scalar]:
        """Whether `t` is the singularity, the time since (1 there), and `gamma`."""
        t = as_time(t)
        since = t + cast_to(self.shift, t)
        singular = since == 0
        return singular, jnp.where(singular, 1, since), cast_to(self.gamma, t)

    def __call__(self, t: Time) -> Scalar:
        t = as_time(t)
        return cast_to(self.gamma, t) * jnp.log(t + cast_to(self.shift, t))

    def increment(self, t: Time, h: Time) -> Scalar:
        t, h = as_time(t), as_time(h)
        growth = log_growth(h, t + cast_to(self.shift, t))
        return cast_to(self.gamma, t) * growth

    def rate(self, t: Time) -> Scalar:
        singular, since, gamma = self._since(t)
        return jnp.where(singular, _infinite(gamma), gamma / since)

    def integral(self, t: Time, h: Time, order: int) -> Scalar:
        # With x = log((s + h) / s) it is s (exp((1 - gamma) x) - 1) / (1 - gamma).
        singular, since, gamma = self._since(t)
        growth = jnp.log1p(h / since)
        carried = since * growth * expm1_ratio((1 - gamma) * growth)
        # At the singularity all momentum is lost without any displacement.
        return jnp.where(singular, jnp.where(gamma == 0, h, 0), carried)

    def response(self, t: Time, h: Time, order: int) -> Scalar:
        # With the same x it is (s + h) (1 - exp(-(1 + gamma) x)) / (1 + gamma).
        singular, since, gamma = self._since(t)
        growth, power = jnp.log1p(h / since), 1 + gamma
        gained = (since + h) * growth * expm1_ratio(-power * growth)
        return jnp.where(singular, h / jnp.where(singular, power, 1), gained)

    @property
    def strength(self) -> Scalar:
        return self.gamma

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return self._since(t)[0]


class MixedDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma_1 \log t + \gamma_2 t^\delta$.

    Between [`diffrax_presym.LogDamping`][] and [`diffrax_presym.ConstantDamping`][]:
    equation (damp_between) of França, Jordan and Vidal (2021). Time must be positive;
    the remarks on $t = 0$ in [`diffrax_presym.LogDamping`][] apply here too.
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

    def _parameters(self, t: Time):
        """Whether `t` is the singularity, `t` (1 there), and the parameters."""
        t = as_time(t)
        parameters = (cast_to(x, t) for x in (self.gamma1, self.gamma2, self.delta))
        return t == 0, jnp.where(t == 0, 1, t), *parameters

    def __call__(self, t: Time) -> Scalar:
        t = as_time(t)
        _, _, gamma1, gamma2, delta = self._parameters(t)
        return gamma1 * jnp.log(t) + gamma2 * t**delta

    def increment(self, t: Time, h: Time) -> Scalar:
        t, h = as_time(t), as_time(h)
        singular, since, gamma1, gamma2, delta = self._parameters(t)
        power = since**delta * expm1(delta * jnp.log1p(h / since))
        from_zero = jnp.where(singular, h, 1) ** delta
        return gamma1 * log_growth(h, t) + gamma2 * jnp.where(
            singular, from_zero, power
        )

    def rate(self, t: Time) -> Scalar:
        singular, t, gamma1, gamma2, delta = self._parameters(t)
        regular = gamma1 / t + gamma2 * delta * t ** (delta - 1)
        infinite = _infinite(jnp.where(gamma1 == 0, gamma2 * delta, gamma1))
        return jnp.where(singular, infinite, regular)

    @property
    def strength(self) -> Scalar:
        return self.gamma1  # the power is less singular

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return self._parameters(t)[0]


class CallableDamping(AbstractDamping):
    """Any function `eta(t)` as a damping law; its increments are plain differences."""

    eta: Callable

    def __call__(self, t: Time) -> Scalar:
        return cast_to(self.eta(t), t)

    def increment(self, t: Time, h: Time) -> Scalar:
        return self(t + h) - self(t)

    def rate(self, t: Time) -> Scalar:
        t = as_time(t)
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]


class ScaledDamping(AbstractDamping):
    """A law times a number, for the frame that positions and momenta share."""

    law: AbstractDamping
    factor: float

    def __call__(self, t: Time) -> Scalar:
        return self.factor * self.law(t)

    def increment(self, t: Time, h: Time) -> Scalar:
        return self.factor * self.law.increment(t, h)

    def rate(self, t: Time) -> Scalar:
        return self.factor * self.law.rate(t)


def as_damping(damping, name: str) -> AbstractDamping:
    if isinstance(damping, AbstractDamping):
        return damping
    if callable(damping):
        return CallableDamping(damping)
    raise ValueError(
        f"{name} must be a damping law or a function eta(t), but got {damping!r}. For "
        "friction at a constant rate write `ConstantDamping(rate)`."
    )
