import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool

from .._checks import as_parameter, as_positive
from .._friction._damping import (
    as_friction,
    ConstantDamping,
    Damping,
    LogDamping,
)
from .._numbers import as_time, cast_to, Scalar, Time


class AbstractScaling(eqx.Module):
    r"""The functions $\alpha$, $\beta$ and $\gamma$ of time in Bregman dynamics.

    They satisfy $\dot\beta \le e^\alpha$ and $\dot\gamma = e^\alpha$, equation
    (scaling) of França, Jordan and Vidal (2021). The objective then converges like
    $e^{-\beta}$.
    """

    @property
    @abc.abstractmethod
    def gamma(self) -> Damping:
        r"""The function $\gamma(t)$, which is the log scale of the momentum."""

    @abc.abstractmethod
    def rate(self, t: Time) -> Scalar:
        r"""The rate $e^{\alpha(t)}$ at which positions move along the mirror step."""

    @abc.abstractmethod
    def strength(self, t: Time) -> Scalar:
        r"""The strength $e^{\alpha(t) + \beta(t)}$ of the objective."""

    def is_valid(self, t: Time) -> Bool[Array, ""] | None:
        """Whether the conditions hold at a time; `None` if they always do."""
        return None


class PolynomialScaling(AbstractScaling):
    r"""$\alpha = \log (c / t)$, $\beta = c \log t + \log C$ and $\gamma = c \log t$.

    The objective converges like $t^{-c}$, equation (scaling2) of França, Jordan and
    Vidal (2021); with $c = 2$ and $C = 1/4$ the motion is that of Nesterov's method.
    Time must be positive. The frequency of the motion grows like $t^{c/2 - 1}$, so that
    for $c > 2$ any explicit scheme of fixed step eventually becomes unstable.
    """

    c: Scalar
    C: Scalar

    def __init__(self, c, C: ArrayLike = 1.0):
        """**Arguments:**

        - `c`: the rate of convergence, a positive number.
        - `C`: the strength of the objective, a positive number, in units of time to the
            power `-c`. Defaults to 1.

        **Raises:**

        `ValueError` if either is known not to be positive.
        """
        self.c = as_positive(c, "`PolynomialScaling(c)`")
        self.C = as_positive(C, "`PolynomialScaling(c, C)`")

    @property
    def gamma(self) -> Damping:
        return LogDamping(self.c)

    def rate(self, t: Time) -> Scalar:
        t = as_time(t)
        return cast_to(self.c, t) / t

    def strength(self, t: Time) -> Scalar:
        t = as_time(t)
        c, C = cast_to(self.c, t), cast_to(self.C, t)
        return c * C * t ** (c - 1)

    def is_valid(self, t: Time) -> Bool[Array, ""] | None:
        return as_time(t) > 0


class ExponentialScaling(AbstractScaling):
    r"""$\alpha = \log c$, $\beta = c t + \log C$ and $\gamma = c t$.

    The objective converges like $e^{-ct}$, equation (scaling1) of França, Jordan and
    Vidal (2021). So does the square of the largest stable step of an explicit scheme.
    """

    c: Scalar
    C: Scalar

    def __init__(self, c, C: ArrayLike = 1.0):
        """**Arguments:**

        - `c`: the rate of convergence, a positive number, in units of one over time.
        - `C`: the strength of the objective, a positive number. Defaults to 1.

        **Raises:**

        `ValueError` if either is known not to be positive.
        """
        self.c = as_positive(c, "`ExponentialScaling(c)`")
        self.C = as_positive(C, "`ExponentialScaling(c, C)`")

    @property
    def gamma(self) -> Damping:
        return ConstantDamping(self.c)

    def rate(self, t: Time) -> Scalar:
        return cast_to(self.c, as_time(t))

    def strength(self, t: Time) -> Scalar:
        t = as_time(t)
        c, C = cast_to(self.c, t), cast_to(self.C, t)
        return c * C * jnp.exp(c * t)


class CustomScaling(AbstractScaling):
    r"""Any functions $\alpha$, $\beta$ and $\gamma$ that satisfy the conditions.

    The conditions are checked on a time interval at construction, and again at the end
    of every step; a solve fails if they do not hold.
    """

    alpha: Damping
    beta: Damping
    gamma_fn: Damping

    def __init__(self, alpha, beta, gamma, *, t0, t1):
        r"""**Arguments:**

        - `alpha`, `beta`, `gamma`: functions of time. For `gamma` prefer a damping law
            such as [`diffrax_presym.LogDamping`][], whose differences are computed
            without cancellation.
        - `t0`, `t1`: the interval of time on which to check the conditions.

        **Raises:**

        `ValueError` with the first time found at which a condition is violated, unless
        the functions are traced, as inside `jax.grad`.
        """
        self.alpha = _as_damping(alpha, "`alpha`")
        self.beta = _as_damping(beta, "`beta`")
        self.gamma_fn = _as_damping(gamma, "`gamma`")
        t0, t1 = (as_parameter(t, "`CustomScaling(t0=..., t1=...)`") for t in (t0, t1))
        with jax.ensure_compile_time_eval():
            ts = jnp.linspace(t0, t1, 1001)
            valid = jax.vmap(self.is_valid)(ts)
            if any(isinstance(x, Tracer) for x in (valid, *jtu.tree_leaves(self))):
                return
            first = ts[jnp.argmin(valid)]
            rate, beta_rate, gamma_rate = map(float, self._rates(first))
        if np.all(valid):
            return
        raise ValueError(
            "The scaling conditions gamma'(t) = exp(alpha(t)) and beta'(t) <= "
            f"exp(alpha(t)) are violated at t = {first:.6g}, where gamma' is "
            f"{gamma_rate:.6g}, beta' is {beta_rate:.6g} and exp(alpha) is {rate:.6g}. "
            "Without them no rate of convergence is known. Take for example alpha = "
            "log(gamma') and beta = gamma, or `PolynomialScaling(c)`."
        )

    @property
    def gamma(self) -> Damping:
        return self.gamma_fn

    def rate(self, t: Time) -> Scalar:
        return jnp.exp(self.alpha(t))

    def strength(self, t: Time) -> Scalar:
        return jnp.exp(self.alpha(t) + self.beta(t))

    def _rates(self, t: Time) -> tuple[Scalar, Scalar, Scalar]:
        return self.rate(t), self.beta.rate(t), self.gamma_fn.rate(t)

    def is_valid(self, t: Time) -> Bool[Array, ""]:
        rate, beta_rate, gamma_rate = self._rates(t)
        at_most = (beta_rate <= rate) | _equal(beta_rate, rate)
        return _equal(gamma_rate, rate) & at_most


def _as_damping(law, name: str) -> Damping:
    law = as_friction(law, name)
    if not isinstance(law, Damping):
        raise ValueError(f"{name} must be a function of time, but got {law!r}.")
    return law


def _equal(x, y):
    # To the accuracy of a derivative.
    tolerance = np.sqrt(np.finfo(np.result_type(y)).eps)
    return abs(x - y) <= tolerance * abs(y)
