"""Linear friction of one leaf: rates of its entries, or one that couples them."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Inexact, PyTree

from .._forms import divide, matvec, multiply
from .._misc import cast_to, Scalar, Time, tree_sum
from ._base import Form
from ._exponential import expm1, expm1_ratio, exponential_products, exponentials
from ._log_scale import (
    AbstractLogScale,
    by_quadrature,
    Exponents,
    Integral,
    Quadrature,
)


MASS = "`QuadraticKinetic(mass)`"
COEFFICIENTS = "`ViscousDamping(coefficients)`"
DAMPING = "The damping"


class Ravel(eqx.Module):
    """A state of one structure as one vector, or as its leaves."""

    structure: Any = eqx.field(static=True)
    shapes: tuple = eqx.field(static=True)
    joined: bool = eqx.field(static=True)

    def __init__(self, like: PyTree, joined: bool):
        leaves, self.structure = jtu.tree_flatten(like)
        self.shapes = tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)
        self.joined = joined

    def leaves(self, x: PyTree) -> list[Array]:
        return [self(x)] if self.joined else self.structure.flatten_up_to(x)

    def unflatten(self, leaves: Sequence[Array]) -> PyTree:
        if self.joined:
            return self.inverse(leaves[0])
        return self.structure.unflatten(leaves)

    def __call__(self, x: PyTree) -> Array:
        with jax.numpy_dtype_promotion("standard"):
            return jnp.concatenate([jnp.ravel(leaf) for leaf in jtu.tree_leaves(x)])

    @property
    def zeros(self) -> Array:
        return self(self.structure.unflatten([jnp.zeros(*x) for x in self.shapes]))

    def inverse(self, x: Array) -> PyTree:
        sizes = [int(np.prod(shape)) for shape, _ in self.shapes]
        parts = jnp.split(x, np.cumsum(sizes)[:-1])
        return self.structure.unflatten(
            [
                part.reshape(shape).astype(dtype)
                for part, (shape, dtype) in zip(parts, self.shapes, strict=True)
            ]
        )


class Effect(NamedTuple):
    """What friction does to a leaf: numbers for its entries, or matrices."""

    change: Array  # of a momentum by decay
    carried: Any = None  # the integral of a decaying momentum
    responded: Any = None  # the momentum left by a constant force


class EntryFriction(eqx.Module):
    """Friction of a leaf by rates of its entries, of any log scales."""

    terms: tuple[tuple[AbstractLogScale, Array], ...]

    @property
    def is_autonomous(self) -> bool:
        return all(law.is_autonomous for law, _ in self.terms)

    def _sum(self, value) -> Array:
        each = [cast_to(rate, x := value(law)) * x for law, rate in self.terms]
        return functools.reduce(jnp.add, each)

    def prepare(self, t: Time, h: Time, order: int) -> Effect:
        if len(self.terms) == 1:
            ((law, rate),) = self.terms
            exponents = law.exponents(t, h, order)
            rate = cast_to(rate, exponents.x)
            integrals = (
                _integral(x, rate) for x in (exponents.carried, exponents.responded)
            )
            return Effect(expm1(-rate * exponents.x), *integrals)
        laws: list[Any] = [
            (by_quadrature(law, t, h, order), rate) for law, rate in self.terms
        ]
        rank = max(max(jnp.ndim(x.x), jnp.ndim(rate)) for x, rate in laws)

        def total(get, nodes: bool) -> Array:
            terms = [
                _outer(get(x), cast_to(rate, x.x), rank, nodes) for x, rate in laws
            ]
            return functools.reduce(jnp.add, terms)

        sums = [
            _weighted(laws[0][0].carried.weights, jnp.exp(-total(get, True)))
            for get in (lambda x: x.carried.x, lambda x: x.responded.x)
        ]
        return Effect(expm1(-total(lambda x: x.x, False)), *sums)

    def prepare_decays(self, t: Array, h: Array) -> Effect:
        increments = jax.vmap(self.increment)(t, h)
        return Effect(expm1(-increments))

    def fix(self, effect: Any) -> Effect:
        return effect

    def decay(self, effect: Effect, p: Array) -> Array:
        return cast_to(effect.change, p) * p

    def flow(self, effect: Effect, p: Array) -> tuple[Array, Array]:
        change, carried, _ = effect
        return cast_to(change, p) * p, cast_to(carried, p) * p

    def respond(self, effect: Effect, force: Array) -> Array:
        return cast_to(effect.responded, force) * force

    def net_force(self, t: Time, force: Array, p: Array) -> Array:
        rates = [(law, cast_to(rate, p), law.rate(t)) for law, rate in self.terms]
        finite = lambda x: jnp.where(jnp.isinf(x), 0, x)
        lost = sum(rate * cast_to(finite(x), p) for _, rate, x in rates)
        net = force - lost * p
        if self.is_singular(t) is None:
            return net
        singular = [jnp.isinf(x) & (rate != 0) for _, rate, x in rates]
        strength = sum(
            jnp.where(s, law.strength * rate, 0)
            for (law, rate, _), s in zip(rates, singular, strict=True)
        )
        # Of motion from rest p grows like F t / (1 + gamma). No other has a limit.
        limit = jnp.where(p == 0, force / (1 + strength), jnp.nan)
        return jnp.where(functools.reduce(jnp.logical_or, singular), limit, net)

    def increment(self, t: Time, h: Time) -> Array:
        return self._sum(lambda law: law.increment(t, h))

    def amplification(self, t: Time, h: Time) -> Scalar:
        return jnp.exp(jnp.max(self.increment(t, h)))

    def contraction(self, t: Time, h: Time, p: Array) -> Scalar:
        return jnp.sum(jnp.broadcast_to(self.increment(t, h), jnp.shape(p)))

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return reduce_any([law.is_singular(t) for law, _ in self.terms])


def _outer(x: Array, rate: Array, rank: int, nodes: bool) -> Array:
    """Increments times a rate, of numbers or entries of a rank; at several nodes, along
    the first axis, or at none."""
    lead, shape = x.shape[:nodes], x.shape[nodes:]
    x = x.reshape(*lead, *(1,) * (rank - len(shape)), *shape)
    return x * rate.reshape((1,) * (nodes + rank - rate.ndim) + rate.shape)


def _weighted(weights: Array, x: Array) -> Array:
    return jnp.sum(jnp.expand_dims(weights, range(1, x.ndim)) * x, axis=0)


def _integral(spec: Integral | Quadrature, rate: Array) -> Array:
    if isinstance(spec, Quadrature):
        return _weighted(
            spec.weights,
            jnp.exp(-_outer(spec.x, rate, max(spec.x.ndim - 1, rate.ndim), True)),
        )
    total = -(rate + spec.shift) * spec.x
    return spec.factor * spec.x * expm1_ratio(total)


class MatrixRate(eqx.Module):
    """A rate that is a matrix for each vector over the last axis."""

    matrix: Inexact[Array, "*batch n n"]
    shift: float = eqx.field(static=True, default=0.0)

    def __call__(self, x: Array) -> Array:
        product = matvec(cast_to(self.matrix, x), x)
        return product + self.shift * x if self.shift else product

    def plus(self, shift: float) -> "MatrixRate":
        return MatrixRate(self.matrix, self.shift + shift)

    def dense(self) -> Array:
        return self.matrix + self.shift * identity(self.matrix[..., 0])


def identity(vectors: Array) -> Array:
    """The identity matrix for each vector over the last axis."""
    size = vectors.shape[-1]
    one = jnp.eye(size, dtype=vectors.dtype)
    return jnp.broadcast_to(one, (*vectors.shape, size))


class ProductRate(eqx.Module):
    """A rate known by its products with a state that was made one vector."""

    rates: tuple[Form, ...]
    coefficients: tuple[Form, ...]
    mass: Any
    ravel: "Ravel"
    shift: float = eqx.field(static=True, default=0.0)

    def __call__(self, x: Array) -> Array:
        p = self.ravel.inverse(x)
        parts = [multiply(form, p, DAMPING, "p") for form in self.rates]
        if self.coefficients:
            v = divide(self.mass, p, MASS, "p")
            parts += [multiply(c, v, COEFFICIENTS, "p") for c in self.coefficients]
        return self.ravel(functools.reduce(tree_sum, parts)) + self.shift * x

    def plus(self, shift: float) -> "ProductRate":
        return eqx.tree_at(lambda x: x.shift, self, self.shift + shift)

    def dense(self) -> Array:
        return jax.jacfwd(self)(self.ravel.zeros)


class CoupledFriction(eqx.Module):
    """Friction of a leaf by a rate that couples its entries, of one log scale."""

    log_scale: AbstractLogScale
    rate: MatrixRate | ProductRate

    @property
    def is_autonomous(self) -> bool:
        return self.log_scale.is_autonomous

    def prepare(self, t: Time, h: Time, order: int) -> Exponents:
        return self.log_scale.exponents(t, h, order)

    def prepare_decays(self, t: Array, h: Array) -> Effect:
        x = jax.vmap(self.log_scale.increment)(t, h)
        return Effect(exponentials(cast_to(self.rate.dense(), x), x)[0])

    def fix(self, effect: Any) -> Effect | Exponents:
        if isinstance(effect, Effect):
            return effect
        if not self.is_autonomous or isinstance(self.rate, ProductRate):
            return effect
        x = effect.x
        matrix = cast_to(self.rate.dense(), x)
        change, carried = (
            y.reshape(*x.shape, *matrix.shape)
            for y in exponentials(matrix, jnp.ravel(x))
        )
        return Effect(change, carried, carried)

    def decay(self, effect: Effect | Exponents, p: Array) -> Array:
        if isinstance(effect, Effect):
            return matvec(cast_to(effect.change, p), p)
        return exponential_products(self.rate, cast_to(effect.x, p), p)[0]

    def flow(self, effect: Effect | Exponents, p: Array) -> tuple[Array, Array]:
        if isinstance(effect, Effect):
            change, carried = (cast_to(x, p) for x in effect[:2])
            return matvec(change, p), matvec(carried, p)
        change, integral = exponential_products(self.rate, cast_to(effect.x, p), p)
        if self.is_autonomous:
            return change, integral
        return change, self._integral(effect.carried, p)

    def respond(self, effect: Effect | Exponents, force: Array) -> Array:
        if isinstance(effect, Effect):
            return matvec(cast_to(effect.responded, force), force)
        return self._integral(effect.responded, force)

    def _integral(self, spec: Integral | Quadrature, x: Array) -> Array:
        if isinstance(spec, Integral):
            rate = self.rate.plus(spec.shift)
            time, factor = cast_to(spec.x, x), cast_to(spec.factor, x)
            return factor * exponential_products(rate, time, x)[1]
        left = lambda time: x + exponential_products(self.rate, time, x)[0]
        return _weighted(cast_to(spec.weights, x), jax.vmap(left)(cast_to(spec.x, x)))

    def net_force(self, t: Time, force: Array, p: Array) -> Array:
        rate = cast_to(self.log_scale.rate(t), p)
        singular = self.is_singular(t)
        if singular is None:
            return force - rate * self.rate(p)
        net = force - jnp.where(singular, 0, rate) * self.rate(p)
        matrix = self.log_scale.strength * cast_to(self.rate.dense(), p)
        limit = jnp.linalg.solve(identity(matrix[..., 0]) + matrix, force[..., None])[
            ..., 0
        ]
        at_rest = jnp.all(p == 0)
        return jnp.where(singular, jnp.where(at_rest, limit, jnp.nan), net)

    def amplification(self, t: Time, h: Time) -> Scalar:
        x = self.log_scale.increment(t, h)
        if isinstance(self.rate, ProductRate):
            # Not known; a gradient by reversal measures its errors in any case.
            return jnp.ones_like(x)
        matrix = cast_to(self.rate.matrix, x) * jnp.sign(x)
        symmetric = (matrix + jnp.swapaxes(matrix, -1, -2)) / 2
        # No more than this, by Gershgorin's circles, which compile in no time.
        sums = jnp.sum(jnp.abs(symmetric), axis=-1)
        diagonal = jnp.diagonal(symmetric, axis1=-2, axis2=-1)
        return jnp.exp(jnp.max(diagonal + sums - jnp.abs(diagonal)) * jnp.abs(x))

    def contraction(self, t: Time, h: Time, p: Array) -> Scalar:
        diagonal = jnp.diagonal(self.rate.dense(), axis1=-2, axis2=-1)
        x = self.log_scale.increment(t, h)
        return x * cast_to(jnp.sum(jnp.broadcast_to(diagonal, jnp.shape(p))), x)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return self.log_scale.is_singular(t)


def reduce_any(conditions: list[Bool[Array, ""] | None]) -> Bool[Array, ""] | None:
    known = [x for x in conditions if x is not None]
    return functools.reduce(jnp.logical_or, known) if known else None
