import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from .._checks import as_positive
from .._friction._damping import (
    AbstractDamping,
    as_friction,
    ConstantDamping,
    LogDamping,
)
from .._numbers import cast_to, Scalar, Time


class Scaling(eqx.Module):
    """The functions `α`, `β` and `γ` of time in Bregman dynamics.

    They satisfy `γ' = exp(α)`, from which `α` follows, and `β' ≤ exp(α)`, equation
    (scaling) of França, Jordan and Vidal (2021). The objective then converges like
    `exp(-β)`, best with `β = γ` but for a constant: `PolynomialScaling` and
    `ExponentialScaling`.

    The conditions are checked at the end of every step; a solve fails if they do not
    hold.
    """

    gamma: AbstractDamping
    beta: AbstractDamping | None
    C: Scalar

    def __init__(self, gamma, beta=None, C: ArrayLike = 1.0):
        """**Arguments:**

        - `gamma`: `γ`, a damping law such as `LogDamping`, or an increasing function of
            time.
        - `beta`: `β`, a function of time. Defaults to `gamma`.
        - `C`: the strength of the objective, a positive number: `log C` is added to
            `beta`. Defaults to 1.

        **Raises:**

        `ValueError` if any of these is of the wrong kind.
        """
        self.gamma = _as_damping(gamma, "`gamma`")
        self.beta = None if beta is None else _as_damping(beta, "`beta`")
        self.C = as_positive(C, "`C`")

    def rate(self, t: Time) -> Scalar:
        """The rate `exp(α(t))` at which positions move along the mirror step."""
        return self.gamma.rate(t)

    def strength(self, t: Time) -> Scalar:
        """The strength `exp(α(t) + β(t))` of the objective."""
        rate = self.rate(t)
        beta = self.gamma(t) if self.beta is None else self.beta(t)
        return cast_to(self.C, rate) * rate * jnp.exp(beta)

    def is_valid(self, t: Time) -> Bool[Array, ""]:
        """Whether the conditions hold at a time."""
        rate = self.rate(t)
        valid = jnp.isfinite(rate) & (rate > 0)
        if self.beta is None:
            return valid
        # To the accuracy of a derivative.
        tolerance = float(np.sqrt(jnp.finfo(rate.dtype).eps))
        return valid & (self.beta.rate(t) <= (1 + tolerance) * rate)


def _as_damping(law, name: str) -> AbstractDamping:
    law = as_friction(law, name)
    if not isinstance(law, AbstractDamping):
        raise ValueError(f"{name} must be a function of time, but got {law!r}.")
    return law


def PolynomialScaling(c, C: ArrayLike = 1.0) -> Scaling:
    """`α = log (c / t)`, `β = c log t + log C` and `γ = c log t`.

    The objective converges like `t^-c`, equation (scaling2) of França, Jordan and Vidal
    (2021); with `c = 2` and `C = 1/4` the motion is that of Nesterov's method. Time
    must be positive. The frequency of the motion grows like `t^(c/2 - 1)`, so that for
    `c > 2` any explicit scheme of fixed step eventually becomes unstable.

    **Arguments:**

    - `c`: the rate of convergence, a positive number.
    - `C`: the strength of the objective, a positive number, in units of time to the
        power `-c`. Defaults to 1.

    **Raises:**

    `ValueError` if either is known not to be positive.
    """
    return Scaling(LogDamping(as_positive(c, "`PolynomialScaling(c)`")), C=C)


def ExponentialScaling(c, C: ArrayLike = 1.0) -> Scaling:
    """`α = log c`, `β = c t + log C` and `γ = c t`.

    The objective converges like `exp(-ct)`, equation (scaling1) of França, Jordan and
    Vidal (2021). So does the square of the largest stable step of an explicit scheme.

    **Arguments:**

    - `c`: the rate of convergence, a positive number, in units of one over time.
    - `C`: the strength of the objective, a positive number. Defaults to 1.

    **Raises:**

    `ValueError` if either is known not to be positive.
    """
    return Scaling(ConstantDamping(as_positive(c, "`ExponentialScaling(c)`")), C=C)
