"""Linear friction of one leaf: rates of its entries, or one that couples them."""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from .._forms import matvec, vecmat
from .._numbers import as_time, cast_to, Scalar, Time
from ._exponential import exponential_products, exponentials, norm, product
from ._log_scale import (
    AbstractLogScale,
    by_quadrature,
    Effect,
    increment,
    LinearScale,
    Terms,
)
from ._near_singularity import by_powers
from ._over_step import DecayOverStep


class EntryFriction(eqx.Module):
    """Friction of a leaf by rates of its entries, of any log scales."""

    terms: Terms
    within: DecayOverStep | None = None  # of a step, for spans of which it is prepared

    @property
    def is_autonomous(self) -> bool:
        return self.within is None and all(law.is_autonomous for law, _ in self.terms)

    @property
    def is_known(self) -> bool:
        (law, _), *others = self.terms
        return not others and type(law).effect is not AbstractLogScale.effect

    @property
    def is_one_rate(self) -> bool:
        """Whether all entries decay alike, whatever the momentum."""
        is_number = lambda law, rate: law.shape == () and jnp.shape(rate) == ()
        return all(is_number(*term) for term in self.terms)

    def over_step(self, t: Time, h: Time) -> "EntryFriction":
        """The same for spans within a step, by polynomials."""
        return EntryFriction(self.terms, DecayOverStep(self.terms, t, h))

    def prepare(self, t: Time, h: Time, order: int) -> Effect:
        if self.within is not None:
            return self.within.effect(t, h)
        if len(self.terms) == 1:
            ((law, rate),) = self.terms
            effect = law.effect(rate, t, h, order)
        else:
            effect = by_powers(self.terms, t, h, order)
            effect = effect or by_quadrature(self.terms, t, h, order)
        strength = self._singular_strength(t)
        if strength is None:
            return effect
        # No motion starts from infinite growth.
        change = jnp.where(strength < 0, jnp.nan, effect.change)
        return effect._replace(change=change)

    def _singular_strength(self, t: Time) -> Array | None:
        """Of the rates that are infinite at `t`, the limit of their sum times the time
        since; `None` if they never are."""
        each = [(law.is_singular(t), law.strength * rate) for law, rate in self.terms]
        known = [jnp.where(here, x, 0) for here, x in each if here is not None]
        return functools.reduce(jnp.add, known) if known else None

    def fix(self, effects: Sequence[Effect]) -> Sequence[Effect]:
        return effects

    def decay(self, effect: Effect, p: Array) -> Array:
        return cast_to(effect.change, p) * p

    def flow(self, effect: Effect, p: Array) -> tuple[Array, Array]:
        return self.decay(effect, p), cast_to(effect.carried, p) * p

    def respond(self, effect: Effect, force: Array) -> Array:
        return cast_to(effect.responded, force) * force

    def net_force(self, t: Time, force: Array, p: Array) -> Array:
        rates = [(law, cast_to(rate, p), law.rate(t)) for law, rate in self.terms]
        finite = lambda x: jnp.where(jnp.isinf(x), 0, x)
        lost = sum(rate * cast_to(finite(x), p) for _, rate, x in rates)
        net = force - lost * p
        strength = self._singular_strength(t)
        if strength is None:
            return net
        singular = [jnp.isinf(x) & (rate != 0) for _, rate, x in rates]
        # Of motion from rest p grows like F t / (1 + gamma). No other has a limit.
        limit = jnp.where(p == 0, force / (1 + cast_to(strength, p)), jnp.nan)
        return jnp.where(functools.reduce(jnp.logical_or, singular), limit, net)

    def growth(self, t: Time, h: Time) -> Scalar:
        if self.within is not None:
            # Of so much that rounding matters no polynomial is right to rounding.
            return jnp.zeros_like(as_time(h))
        return jnp.max(increment(self.terms, t, h), initial=-jnp.inf)

    def over(self, t: Time, h: Time, closely: bool) -> Scalar:
        each = jnp.abs(increment(self.terms, t, h))
        if not self.is_autonomous:
            rate = lambda t: functools.reduce(
                jnp.add, [cast_to(x, h) * law.rate(t) for law, x in self.terms]
            )
            grows = rate(jnp.maximum(t, t + h)) >= rate(jnp.minimum(t, t + h))
            each = jnp.where(grows, each, 0)
        return jnp.max(each, initial=0)

    def strength(self, t: Time, h: Time) -> Scalar:
        first, second = (increment(self.terms, t + x * h, h / 2) for x in (0.0, 0.5))
        falls = (first > second) & (second > 0)
        # After a singularity the rate falls like a power of time, which polynomials
        # follow.
        ratio = jnp.where(falls, second / jnp.where(falls, first, 1), 1)
        both = jnp.where(falls, 2 * second * ratio**2, first + second)
        return jnp.max(both, initial=0)

    def is_smooth(self, t: Time) -> Bool[Array, ""]:
        def each(law: AbstractLogScale) -> Bool[Array, ""]:
            slope = lambda t: jax.jvp(law.rate, (t,), (jnp.ones_like(t),))[1]
            return jnp.all(jnp.isfinite(jax.jvp(slope, (t,), (jnp.ones_like(t),))[1]))

        t = as_time(t)
        laws = [law for law, _ in self.terms if not law.is_autonomous]
        return functools.reduce(jnp.logical_and, map(each, laws), jnp.asarray(True))

    def scaled(self, factor: Scalar) -> "EntryFriction":
        return EntryFriction(tuple((law, _times(factor, x)) for law, x in self.terms))

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return reduce_any([law.is_singular(t) for law, _ in self.terms])

    def by_rates(self, start: Time | None) -> "EntryFriction":
        if start is None:
            return self

        def seen(law: AbstractLogScale, rate: Array) -> Array:
            here = law.is_singular(start) if law.strength else None
            if here is None:
                return rate
            return jnp.where(here & (law.strength * rate > 0), 0, rate)

        return EntryFriction(tuple((law, seen(law, x)) for law, x in self.terms))


class MatrixFriction(eqx.Module):
    """Friction of a leaf by a constant matrix for each vector over its last axis."""

    matrix: Inexact[Array, "*batch n n"]
    is_autonomous = True
    is_known = True
    is_one_rate = False

    def prepare(self, t: Time, h: Time, order: int) -> Effect:
        return Effect(*[as_time(h)] * 3)

    def fix(self, effects: Sequence[Effect]) -> list[Effect]:
        times = [effect.change for effect in effects]
        matrix = cast_to(self.matrix, times[0])
        # All at once: the exponentials take longer to compile than the rest of a step.
        both = exponentials(matrix, jnp.concatenate(list(map(jnp.ravel, times))))
        ends = np.cumsum([x.size for x in times])[:-1]
        parts = zip(times, *(jnp.split(y, ends) for y in both), strict=True)
        # Transposed, as a sum over the first axis is the faster one.
        shape = lambda x, y: y.reshape(*x.shape, *matrix.shape).swapaxes(-1, -2)
        return [Effect(shape(x, a), shape(x, b), shape(x, b)) for x, a, b in parts]

    def flow(self, effect: Effect, p: Array) -> tuple[Array, Array]:
        if jnp.ndim(effect.change):
            change, carried = (vecmat(p, cast_to(x, p)) for x in effect[:2])
            return change, carried
        matrix, time = cast_to(self.matrix, p), cast_to(effect.change, p)
        return exponential_products(matrix, time, p)

    def decay(self, effect: Effect, p: Array) -> Array:
        return self.flow(effect, p)[0]

    def respond(self, effect: Effect, force: Array) -> Array:
        return self.flow(effect, force)[1]

    def net_force(self, t: Time, force: Array, p: Array) -> Array:
        return force - matvec(cast_to(self.matrix, p), p)

    def growth(self, t: Time, h: Time) -> Scalar:
        matrix = cast_to(self.matrix, h := as_time(h))
        symmetric = (matrix + jnp.swapaxes(matrix, -1, -2)) / 2
        # No more than this, by Gershgorin's circles, which compile in no time. Nothing
        # of the size of the matrix depends on the span.
        diagonal = np.eye(symmetric.shape[-1], dtype=bool)
        circles = lambda x: jnp.where(diagonal, x, jnp.abs(x))
        most = lambda x: jnp.max(jnp.sum(circles(x), axis=-1))
        forwards, backwards = most(symmetric), most(-symmetric)
        return jnp.where(h > 0, forwards, backwards) * jnp.abs(h)

    def over(self, t: Time, h: Time, closely: bool) -> Scalar:
        matrix = cast_to(self.matrix, h := as_time(h))
        symmetric = (matrix + jnp.swapaxes(matrix, -1, -2)) / 2
        # At least this, the length of a column: a bound from above might fail a solve
        # that is right.
        squares = jnp.sum(symmetric**2, axis=-2)
        most = jnp.max(squares, axis=-1, keepdims=True)
        if closely:
            # By how much the matrix lengthens this column.
            longest = (squares == most)[..., None, :]
            column = jnp.sum(jnp.where(longest, symmetric, 0), axis=-1)
            before = jnp.sum(column**2, axis=-1, keepdims=True)
            after = jnp.sum(vecmat(column, symmetric) ** 2, axis=-1, keepdims=True)
            most = after / jnp.where(before == 0, 1, before)
        return jnp.sqrt(jnp.max(most, initial=0)) * jnp.abs(h)

    def strength(self, t: Time, h: Time) -> Scalar:
        return self.growth(t, h)

    def is_smooth(self, t: Time) -> Bool[Array, ""]:
        return jnp.asarray(True)

    def scaled(self, factor: Scalar) -> "MatrixFriction":
        return MatrixFriction(_times(factor, self.matrix))

    def is_singular(self, t: Time) -> None:
        return None

    def by_rates(self, start: Time | None) -> EntryFriction:
        size = jnp.maximum(norm(self.matrix), float(jnp.finfo(self.matrix.dtype).tiny))
        power = self.matrix / size
        for _ in range(3):
            power = product(power, power)
        # The norm of a power is close to that of its largest eigenvalue, where that of
        # the matrix may be several times as large.
        return EntryFriction(((LinearScale(), size * norm(power) ** (1 / 8)),))


def _times(factor: Scalar, x: Array) -> Array:
    return cast_to(factor, x) * x


def reduce_any(conditions: list[Bool[Array, ""] | None]) -> Bool[Array, ""] | None:
    known = [x for x in conditions if x is not None]
    return functools.reduce(jnp.logical_or, known) if known else None
