"""Friction by rates: of all momenta alike, or of each entry."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Inexact, PyTree

from .. import _tree as tree
from .._checks import as_finite, check_callable
from .._forms import multiply
from .._numbers import as_time, cast_to, Time
from ._base import AbstractFriction, LinearPart, Mechanics, Parts
from ._log_scale import (
    AbstractLogScale,
    FunctionOfTime,
    LinearScale,
    Logarithm,
    Power,
)


# A number for the whole system, or arrays for the entries of its momenta.
Numbers = PyTree[Inexact[Array, "..."]]


class AbstractDamping(AbstractFriction):
    """Friction `p' = F - η'(t) p` at a rate, in units of one over time.

    Positive rates damp, negative rates excite. The log scale `η` is a sum of functions
    of time, each with a factor: one number for friction alike on all momenta; or an
    array with as many dimensions as `p` that broadcasts to it, or a pytree of these,
    with a rate for each degree of freedom.
    """

    # The functions of time, and their factors.
    terms: eqx.AbstractVar[tuple[tuple[AbstractLogScale, Any], ...]]

    def parts(self, mechanics: Mechanics) -> Parts:
        return Parts(tuple(LinearPart(*term) for term in self.terms))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        return multiply(tree.scale(-1, self.rate(t)), p, "The damping", "p")

    def _sum(self, values: Callable) -> Numbers:
        def term(law: AbstractLogScale, factor: Numbers) -> Numbers:
            value = values(law)
            return jtu.tree_map(lambda x: cast_to(x, value) * value, factor)

        return functools.reduce(tree.add, [term(*x) for x in self.terms])

    def __call__(self, t: Time) -> Numbers:
        """The log scale `η(t)`."""
        return self._sum(lambda law: law(t))

    def increment(self, t: Time, h: Time) -> Numbers:
        """The difference `η(t + h) - η(t)`, without cancellation."""
        return self._sum(lambda law: law.increment(t, h))

    def rate(self, t: Time) -> Numbers:
        """The rate `η'(t)`."""
        return self._sum(lambda law: law.rate(as_time(t)))


_VARYING = (
    " A rate that depends on time is given by its integral, `friction=eta` with a "
    "function `eta(t)`, one that depends on place by `PositionDamping(rate)`."
)


def as_numbers(x, name: str) -> Numbers:
    """A user's numbers for the entries of `p`: a number, an array or a pytree."""

    def leaf(x):
        return as_finite(x, name, _VARYING if callable(x) else "")

    return jtu.tree_map(leaf, x) if jtu.tree_leaves(x) else leaf(x)


class ConstantDamping(AbstractDamping):
    """Friction `-γ p` at a constant rate `γ`, in units of one over time.

    The log scale is `η(t) = γ t`: the heavy-ball method and the damped oscillator,
    equation (eta1_large) of França, Jordan and Vidal (2021). For friction by a
    coefficient, in units of force per velocity, write `ViscousDamping`.
    """

    gamma: Numbers

    def __init__(self, gamma):
        """**Arguments:**

        - `gamma`: the rate of damping, in units of one over time. Real, of any sign;
            negative excites. A number, or for `MechanicalSystem` a rate for each degree
            of freedom: an array with as many dimensions as `p` that broadcasts to it,
            or a pytree of these.

        **Raises:**

        `ValueError` if it is not a finite real number or array; and when the solve is
        traced, if it does not fit `p`.
        """
        self.gamma = as_numbers(gamma, "`ConstantDamping(gamma)`")

    @property
    def terms(self):
        return ((LinearScale(), self.gamma),)


class LogDamping(AbstractDamping):
    """Friction that decays with time, `-γ p / (t + s)`.

    The log scale is `η(t) = γ log(t + s)`. With `γ = 3` and no shift this is the ODE of
    Nesterov's method, equation (eta1_small) of França, Jordan and Vidal (2021); with
    `s = 1` their decaying oscillator.

    The rate is infinite at `t = -s`. With positive damping a solve may start there,
    from zero momentum; there splittings with a quadratic kinetic energy have at most
    order `γ + 1`, and other schemes order 2. Schemes whose stages extend beyond the
    step, such as `SuzukiYoshida`, must start far enough from there; otherwise the solve
    fails. Backwards in time the momentum is infinite there: end before it.

    Write the infinite part of a rate as this law also if there is more of it, in a list
    with the rest: its power of time is then exact, where a function alone loses most
    digits in the first steps. The rest must be finite at the start. The rate
    `2 a coth(a t)` is `[LogDamping(2.0), lambda t: 2 * jnp.log(jnp.sinh(x(t)) / x(t))]`
    with `x = lambda t: jnp.maximum(a * t, 1e-9)`.
    """

    gamma: Numbers
    shift: Inexact[Array, "..."] | None

    def __init__(self, gamma, shift: ArrayLike | None = None):
        """**Arguments:**

        - `gamma`: the strength of the damping, dimensionless, of any sign. A number,
            array or pytree as for `ConstantDamping`.
        - `shift`: the shift `s` of time, in units of time: a number. Defaults to none.

        **Raises:**

        `ValueError` as `ConstantDamping`.
        """
        if shift is not None:
            shift = as_finite(shift, "`LogDamping(shift=...)`")
        self.gamma, self.shift = as_numbers(gamma, "`LogDamping(gamma)`"), shift

    @property
    def terms(self):
        return ((Logarithm(self.shift), self.gamma),)


class PowerDamping(AbstractDamping):
    """Friction that varies like a power of time, `-γ δ t^(δ - 1) p`.

    The log scale is `η(t) = γ t^δ`. With an exponent between 0 and 1, and together with
    `LogDamping`, it is between that and `ConstantDamping`: equation (damp_between) of
    França, Jordan and Vidal (2021) is `friction=[LogDamping(gamma1),
    PowerDamping(gamma2, delta)]`. Time must not be negative; from `t = 0`, where the
    rate is infinite for an exponent below 1, a solve may start from zero momentum, with
    order `1 + δ`, or 2 beside `LogDamping`. Backwards in time end before it, or the
    solve fails.
    """

    gamma: Numbers
    delta: Inexact[Array, "..."]

    def __init__(self, gamma, delta):
        """**Arguments:**

        - `gamma`: the strength, in units of time to the power `-δ`. A number, array or
            pytree as for `ConstantDamping`.
        - `delta`: the exponent, a number.

        **Raises:**

        `ValueError` as `ConstantDamping`.
        """
        self.delta = as_finite(delta, "`PowerDamping(..., delta)`")
        self.gamma = as_numbers(gamma, "`PowerDamping(gamma, ...)`")

    @property
    def terms(self):
        return ((Power(self.delta), self.gamma),)


class SumOfDampings(AbstractDamping):
    """Friction at a rate that is a sum, or a function of time of one's own."""

    terms: tuple[tuple[AbstractLogScale, Any], ...]


SumOfDampings.__init__.__doc__ = "**Arguments:** its fields, if any."


_FRICTION = "`friction`"
_OF_PLACE = (
    " Parameters of it are closed over, and differentiated so: build the system in the "
    "function of them. For a rate that depends on place write `PositionDamping(rate)`, "
    "for any other force `force=f`, with a function `f(t, q, v, args)`."
)


def as_friction(law, name: str = _FRICTION) -> AbstractFriction:
    """A user's law of friction; a function `eta(t)` is one too."""
    if isinstance(law, AbstractFriction):
        return law
    if callable(law):
        instead = _OF_PLACE if name == _FRICTION else ""
        check_callable(law, name.strip("`"), "eta(t)", instead=instead)
        law = law if isinstance(law, AbstractLogScale) else FunctionOfTime(law)
        return SumOfDampings(((law, jnp.ones(())),))
    raise ValueError(
        f"{name} must be a law of friction, a function eta(t) or a list of these, but "
        f"got {law!r}. For a constant rate write `ConstantDamping(rate)`, for a "
        "coefficient, in units of force per velocity, `ViscousDamping(coefficient)`."
    )


def as_laws(friction, name: str = _FRICTION) -> tuple[AbstractFriction, ...]:
    """A user's laws of friction: none, one, or a list."""
    if friction is None:
        return ()
    laws = friction if isinstance(friction, list | tuple) else [friction]
    return tuple(as_friction(law, name) for law in laws)
