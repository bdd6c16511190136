"""Friction by rates: of all momenta alike, or of each entry."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import TypeGuard

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, PyTree

from .._forms import fit_form, is_matrix
from .._misc import as_finite, as_time, cast_to, tree_scale, tree_sub, tree_sum
from ._base import AbstractFriction, Numbers, Scalar, Time
from ._functions import expm1, expm1_ratio, log_growth, quadrature


class AbstractDamping(AbstractFriction):
    r"""A log scale $\eta(t)$, or friction $p' = F - \eta'(t) \, p$.

    Positive rates $\eta'$ damp, negative rates excite. The values of a law are scalars,
    for friction alike on all momenta; or arrays with as many dimensions as `p` that
    broadcast to it, or pytrees of these, with a rate for each degree of freedom.

    Subclasses define `__call__`, `increment` and `rate`; by default `integral` and
    `response` are computed by quadrature.
    """

    @abc.abstractmethod
    def __call__(self, t: Time) -> Numbers:
        r"""The log scale $\eta(t)$."""

    @abc.abstractmethod
    def increment(self, t: Time, h: Time) -> Numbers:
        r"""The difference $\eta(t + h) - \eta(t)$.

        Solvers use only differences of $\eta$. Subtracting two values loses most digits
        at late times in `float32`, so each law computes them without cancellation.
        """

    @abc.abstractmethod
    def rate(self, t: Time) -> Numbers:
        r"""The rate of damping $\eta'(t)$."""

    def integral(self, t: Time, h: Time, order: int) -> Numbers:
        r"""The integral of $e^{\eta(t) - \eta(s)}$ over $s$ from $t$ to $t + h$.

        The displacement under a velocity that is one at $t$ and decays by friction.
        Exact if known in closed form, otherwise of the given order in `h`.
        """
        left = lambda x: jnp.exp(-x)
        return quadrature(lambda s: jtu.tree_map(left, self.increment(t, s)), h, order)

    def response(self, t: Time, h: Time, order: int) -> Numbers:
        r"""The integral of $e^{\eta(s) - \eta(t + h)}$ over $s$ from $t$ to $t + h$.

        The momentum gained under a unit force. Exact if known in closed form,
        otherwise of the given order in `h`.
        """
        left = lambda x: jnp.exp(-x)
        after = lambda s: jtu.tree_map(left, self.increment(t + s, h - s))
        return quadrature(after, h, order)

    @property
    def is_smooth(self) -> bool:
        """Whether the rate is known to have a continuous derivative, which schemes in
        the shared frame need. `False` by default: a function may jump."""
        return False

    @property
    def is_scalar(self) -> bool:
        """Whether one rate acts on all momenta."""
        value = jax.eval_shape(self.rate, jax.ShapeDtypeStruct((), jnp.zeros(()).dtype))
        return isinstance(value, jax.ShapeDtypeStruct) and value.shape == ()

    def decay(self, t: Time, h: Time, p: PyTree) -> PyTree:
        # A factor would have the same rounding error at every step, and equal errors
        # add up. The errors of increments vary with `p`, and mostly cancel.
        lost = jtu.tree_map(lambda x: expm1(-x), self.increment(t, h))
        return _scale(lost, p)

    def carry(self, t: Time, h: Time, p: PyTree, order: int) -> PyTree:
        return _scale(self.integral(t, h, order), p)

    def respond(self, t: Time, h: Time, force: PyTree, order: int) -> PyTree:
        return _scale(self.response(t, h, order), force)

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        rate = self.rate(t)
        if self.is_singular(t) is None:
            return tree_sub(force, _scale(rate, p))
        finite = jtu.tree_map(lambda x: jnp.where(jnp.isinf(x), 0, x), rate)
        return jtu.tree_map(
            lambda rate, strength, regular, force, p: jnp.where(
                jnp.isinf(rate), _at_rest(strength, force, p), regular
            ),
            _fit(rate, p),
            _fit(self.singular_strength(t), p),
            *(tree_sub(force, _scale(finite, p)), force, p),
        )

    @property
    def strength(self) -> Numbers:
        """The rate times the time since its singularity, or 0 if it has none."""
        return jnp.zeros(())

    def singular_strength(self, t: Time) -> Numbers:
        """The strength of what is singular at `t`."""
        singular, zero = self.is_singular(t), jnp.zeros(())
        if singular is None:
            return zero
        return jtu.tree_map(lambda x: jnp.where(singular, x, 0), self.strength)

    def amplification(self, t: Time, h: Time, p: PyTree) -> Scalar:
        most = jtu.tree_map(jnp.max, self.increment(t, h))
        return jnp.exp(functools.reduce(jnp.maximum, jtu.tree_leaves(most)))

    def contraction(self, t: Time, h: Time, p: PyTree) -> Scalar:
        lost = _fit(self.increment(t, h), p)
        total = lambda x, p: jnp.sum(jnp.broadcast_to(x, jnp.shape(p)))
        return jtu.tree_reduce(jnp.add, jtu.tree_map(total, lost, p))

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return None


def _fit(numbers: Numbers, p: PyTree) -> PyTree:
    """The numbers of a law for each leaf of `p`."""
    fitted = fit_form(numbers, p, "The damping", "p")
    for x, pi in zip(jtu.tree_leaves(fitted), jtu.tree_leaves(p), strict=True):
        if is_matrix(x, pi):
            raise ValueError(
                f"The damping has shape {jnp.shape(x)} for a `p` of shape "
                f"{jnp.shape(pi)}. Friction by a matrix is given per velocity: write "
                "`ViscousDamping(matrix)`."
            )
    return fitted


def _scale(numbers: Numbers, p: PyTree) -> PyTree:
    return jtu.tree_map(jnp.multiply, _fit(numbers, p), p)


def _at_rest(strength: Array, force: Array, p: Array) -> Array:
    """The limit of `F - gamma p / t` as `t` goes to zero, for motion from rest.

    There `p` grows like `F t / (1 + gamma)`. For any other momentum there is no limit.
    """
    return jnp.where(p == 0, force / (1 + strength), jnp.nan)


def check_scalar(damping: AbstractDamping | None, name: str) -> None:
    """An error unless one rate acts on all momenta."""
    if damping is not None and not damping.is_scalar:
        shape = jtu.tree_map(jnp.shape, jax.eval_shape(damping.rate, jnp.zeros(())))
        raise ValueError(
            f"The damping of `{name}` must be a scalar for the whole system, but has "
            f"shape {shape}. For friction that differs by degree of freedom write "
            "`MechanicalSystem(kinetic, potential, friction=law)`; to solve systems "
            "with different dampings use `jax.vmap`."
        )


def is_scalar(friction: AbstractFriction | None) -> TypeGuard[AbstractDamping | None]:
    """Whether there is no friction but one rate for all momenta."""
    if friction is None:
        return True
    return isinstance(friction, AbstractDamping) and friction.is_scalar


def _leafwise(method: Callable) -> Callable:
    """A method of a law; leaf by leaf where its parameters are pytrees."""

    @functools.wraps(method)
    def mapped(self, *args, **kwargs):
        names = [field.name for field in dataclasses.fields(self)]
        parameters = [getattr(self, name) for name in names]
        trees = [x for x in parameters if not is_leaf(x)]
        if not trees:
            return method(self, *args, **kwargs)
        structure = jtu.tree_structure(trees[0])
        leaves = [
            [x] * structure.num_leaves if is_leaf(x) else structure.flatten_up_to(x)
            for x in parameters
        ]
        laws = [type(self)(*x) for x in zip(*leaves, strict=True)]
        return structure.unflatten([method(law, *args, **kwargs) for law in laws])

    return mapped


def is_leaf(x: PyTree) -> bool:
    return jtu.treedef_is_leaf(jtu.tree_structure(x))


def as_numbers(x, name: str) -> Numbers:
    """A user's numbers for the entries of `p`: a number, an array or a pytree."""
    if not jtu.tree_leaves(x):
        return as_finite(x, name)
    return jtu.tree_map(lambda x: as_finite(x, name), x)


def _infinite(gamma: Scalar) -> Scalar:
    """Infinity with the sign of `gamma`, or zero where `gamma` is zero."""
    return jnp.where(gamma == 0, 0, jnp.where(gamma > 0, jnp.inf, -jnp.inf))


class ConstantDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma t$: friction at the constant rate $\gamma$.

    The heavy-ball method and the damped oscillator, equation (eta1_large) of França,
    Jordan and Vidal (2021).
    """

    gamma: Numbers
    is_smooth = True

    def __init__(self, gamma):
        """**Arguments:**

        - `gamma`: the rate of damping, in units of one over time. Real, of any sign;
            negative excites. A number, or for
            [`diffrax_presym.MechanicalSystem`][] a rate for each degree of freedom: an
            array with as many dimensions as `p` that broadcasts to it, or a pytree of
            these.
        """
        self.gamma = as_numbers(gamma, "`ConstantDamping(gamma)`")

    @_leafwise
    def __call__(self, t: Time) -> Numbers:
        t = as_time(t)
        return cast_to(self.gamma, t) * t

    @_leafwise
    def increment(self, t: Time, h: Time) -> Numbers:
        h = as_time(h)
        return cast_to(self.gamma, h) * h

    @_leafwise
    def rate(self, t: Time) -> Numbers:
        return cast_to(self.gamma, as_time(t))

    @_leafwise
    def integral(self, t: Time, h: Time, order: int) -> Numbers:
        return as_time(h) * expm1_ratio(-self.increment(t, h))

    @_leafwise
    def response(self, t: Time, h: Time, order: int) -> Numbers:
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

    gamma: Numbers
    shift: Numbers
    is_smooth = True

    def __init__(self, gamma, shift: ArrayLike = 0.0):
        """**Arguments:**

        - `gamma`: the strength of the damping, dimensionless, of any sign. A number,
            array or pytree as for [`diffrax_presym.ConstantDamping`][].
        - `shift`: the shift $s$ of time, in units of time, in the same forms. Defaults
            to 0.
        """
        self.gamma = as_numbers(gamma, "`LogDamping(gamma)`")
        self.shift = as_numbers(shift, "`LogDamping(shift=...)`")

    def _since(self, t: Time) -> tuple[Bool[Array, ""], Scalar, Scalar]:
        """Whether `t` is the singularity, the time since (1 there), and `gamma`."""
        t = as_time(t)
        since = t + cast_to(self.shift, t)
        singular = since == 0
        return singular, jnp.where(singular, 1, since), cast_to(self.gamma, t)

    @_leafwise
    def __call__(self, t: Time) -> Numbers:
        t = as_time(t)
        return cast_to(self.gamma, t) * jnp.log(t + cast_to(self.shift, t))

    @_leafwise
    def increment(self, t: Time, h: Time) -> Numbers:
        t, h = as_time(t), as_time(h)
        growth = log_growth(h, t + cast_to(self.shift, t))
        return cast_to(self.gamma, t) * growth

    @_leafwise
    def rate(self, t: Time) -> Numbers:
        singular, since, gamma = self._since(t)
        return jnp.where(singular, _infinite(gamma), gamma / since)

    @_leafwise
    def integral(self, t: Time, h: Time, order: int) -> Numbers:
        # With x = log((s + h) / s) it is s (exp((1 - gamma) x) - 1) / (1 - gamma).
        singular, since, gamma = self._since(t)
        growth = jnp.log1p(h / since)
        carried = since * growth * expm1_ratio((1 - gamma) * growth)
        # At the singularity all momentum is lost without any displacement.
        return jnp.where(singular, jnp.where(gamma == 0, h, 0), carried)

    @_leafwise
    def response(self, t: Time, h: Time, order: int) -> Numbers:
        # With the same x it is (s + h) (1 - exp(-(1 + gamma) x)) / (1 + gamma).
        singular, since, gamma = self._since(t)
        growth, power = jnp.log1p(h / since), 1 + gamma
        gained = (since + h) * growth * expm1_ratio(-power * growth)
        return jnp.where(singular, h / jnp.where(singular, power, 1), gained)

    @property
    def strength(self) -> Numbers:
        return self.gamma

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        singular = lambda s: jnp.any(as_time(t) + cast_to(s, as_time(t)) == 0)
        return functools.reduce(
            jnp.logical_or, map(singular, jtu.tree_leaves(self.shift))
        )


class MixedDamping(AbstractDamping):
    r"""The log scale $\eta(t) = \gamma_1 \log t + \gamma_2 t^\delta$.

    Between [`diffrax_presym.LogDamping`][] and [`diffrax_presym.ConstantDamping`][]:
    equation (damp_between) of França, Jordan and Vidal (2021). Time must be positive;
    the remarks on $t = 0$ in [`diffrax_presym.LogDamping`][] apply here too.
    """

    gamma1: Numbers
    gamma2: Numbers
    delta: Numbers
    is_smooth = True

    def __init__(self, gamma1, gamma2, delta):
        r"""**Arguments:**

        - `gamma1`: the strength of the logarithmic part, dimensionless.
        - `gamma2`: the strength of the power, in units of time to the power $-\delta$.
        - `delta`: the exponent, between 0 and 1 in the paper.

        Each is a number, array or pytree as for
        [`diffrax_presym.ConstantDamping`][].
        """
        self.gamma1 = as_numbers(gamma1, "`MixedDamping(gamma1, ...)`")
        self.gamma2 = as_numbers(gamma2, "`MixedDamping(..., gamma2, ...)`")
        self.delta = as_numbers(delta, "`MixedDamping(..., delta)`")

    def _parameters(self, t: Time):
        """Whether `t` is the singularity, `t` (1 there), and the parameters."""
        t = as_time(t)
        parameters = (cast_to(x, t) for x in (self.gamma1, self.gamma2, self.delta))
        return t == 0, jnp.where(t == 0, 1, t), *parameters

    @_leafwise
    def __call__(self, t: Time) -> Numbers:
        t = as_time(t)
        _, _, gamma1, gamma2, delta = self._parameters(t)
        return gamma1 * jnp.log(t) + gamma2 * t**delta

    @_leafwise
    def increment(self, t: Time, h: Time) -> Numbers:
        t, h = as_time(t), as_time(h)
        singular, since, gamma1, gamma2, delta = self._parameters(t)
        power = since**delta * expm1(delta * jnp.log1p(h / since))
        from_zero = jnp.where(singular, h, 1) ** delta
        return gamma1 * log_growth(h, t) + gamma2 * jnp.where(
            singular, from_zero, power
        )

    @_leafwise
    def rate(self, t: Time) -> Numbers:
        singular, t, gamma1, gamma2, delta = self._parameters(t)
        regular = gamma1 / t + gamma2 * delta * t ** (delta - 1)
        infinite = _infinite(jnp.where(gamma1 == 0, gamma2 * delta, gamma1))
        return jnp.where(singular, infinite, regular)

    @property
    def strength(self) -> Numbers:
        return self.gamma1  # the power is less singular

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return as_time(t) == 0


class CallableDamping(AbstractDamping):
    """Any function `eta(t)` as a damping law; its increments are plain differences."""

    eta: Callable

    def __call__(self, t: Time) -> Numbers:
        return jtu.tree_map(lambda x: cast_to(x, t), self.eta(t))

    def increment(self, t: Time, h: Time) -> Numbers:
        return tree_sub(self(t + h), self(t))

    def rate(self, t: Time) -> Numbers:
        t = as_time(t)
        return jax.jvp(self, (t,), (jnp.ones_like(t),))[1]


class ScaledDamping(AbstractDamping):
    """A scalar law times numbers, for example one half of it."""

    law: AbstractDamping
    factor: ArrayLike

    @property
    def is_smooth(self) -> bool:
        return self.law.is_smooth

    def __call__(self, t: Time) -> Numbers:
        return tree_scale(self.law(t), self.factor)

    def increment(self, t: Time, h: Time) -> Numbers:
        return tree_scale(self.law.increment(t, h), self.factor)

    def rate(self, t: Time) -> Numbers:
        return tree_scale(self.law.rate(t), self.factor)

    @property
    def strength(self) -> Numbers:
        return tree_scale(self.law.strength, self.factor)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return self.law.is_singular(t)


class SumDamping(AbstractDamping):
    """Several laws at once."""

    laws: tuple[AbstractDamping, ...]

    @property
    def is_smooth(self) -> bool:
        return all(law.is_smooth for law in self.laws)

    def _sum(self, values) -> Numbers:
        return functools.reduce(_add, values)

    def __call__(self, t: Time) -> Numbers:
        return self._sum(law(t) for law in self.laws)

    def increment(self, t: Time, h: Time) -> Numbers:
        return self._sum(law.increment(t, h) for law in self.laws)

    def rate(self, t: Time) -> Numbers:
        return self._sum(law.rate(t) for law in self.laws)

    def singular_strength(self, t: Time) -> Numbers:
        return self._sum(law.singular_strength(t) for law in self.laws)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        each = [law.is_singular(t) for law in self.laws]
        return functools.reduce(_or, each)


def _add(x: Numbers, y: Numbers) -> Numbers:
    """The sum, where either may be one array for all leaves of the other."""
    if is_leaf(x) and not is_leaf(y):
        return jtu.tree_map(lambda yi: x + yi, y)
    if is_leaf(y) and not is_leaf(x):
        return jtu.tree_map(lambda xi: xi + y, x)
    return tree_sum(x, y)


def _or(x: Bool[Array, ""] | None, y: Bool[Array, ""] | None):
    return (x if y is None else y) if x is None or y is None else x | y


def as_damping(damping, name: str) -> AbstractDamping:
    if isinstance(damping, AbstractDamping):
        return damping
    if callable(damping):
        return CallableDamping(damping)
    raise ValueError(
        f"{name} must be a damping law or a function eta(t), but got {damping!r}. For "
        "friction at a constant rate write `ConstantDamping(rate)`; for friction by "
        "coefficients, by place or by speed "
        "`MechanicalSystem(kinetic, potential, friction=law)`."
    )
