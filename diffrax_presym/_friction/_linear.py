"""Linear friction of one system: prepared for a span of time, applied to momenta."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Inexact, PyTree

from .._forms import divide, fit_form, is_matrix, is_operator, matvec, multiply
from .._misc import cast_to, Scalar, Time, tree_sum
from ._base import Form, Linear as LinearPart, Mechanics, Parts
from ._damping import AbstractDamping
from ._exponential import expm1, expm1_ratio, exponential_products, exponentials
from ._log_scale import (
    AbstractLogScale,
    by_quadrature,
    Exponents,
    Integral,
    Linear,
    Quadrature,
)


MASS = "`QuadraticKinetic(mass)`"
COEFFICIENTS = "`ViscousDamping(coefficients)`"
DAMPING = "The damping"


class Effect(NamedTuple):
    """What friction does to a leaf: numbers for its entries, or matrices."""

    change: Array
    carried: Array
    responded: Array


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
        laws = [(by_quadrature(law, t, h, order), rate) for law, rate in self.terms]
        total = lambda get: functools.reduce(
            jnp.add,
            [_outer(get(x), cast_to(rate, x.x)) for x, rate in laws],
        )
        sums = [
            _weighted(laws[0][0].carried.weights, jnp.exp(-total(nodes)))
            for nodes in (lambda x: x.carried.x, lambda x: x.responded.x)
        ]
        return Effect(expm1(-total(lambda x: x.x)), *sums)

    def fix(self, effect: Effect) -> Effect:
        return effect

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
        return _any([law.is_singular(t) for law, _ in self.terms])


def _outer(x: Array, rate: Array) -> Array:
    """Increments at a number of nodes, if any, times a rate for each entry."""
    return x.reshape(*x.shape, *(1,) * (rate.ndim - max(x.ndim - 1, 0))) * rate


def _weighted(weights: Array, x: Array) -> Array:
    return jnp.sum(jnp.expand_dims(weights, range(1, x.ndim)) * x, axis=0)


def _integral(spec: Integral | Quadrature, rate: Array) -> Array:
    if isinstance(spec, Quadrature):
        return _weighted(spec.weights, jnp.exp(-_outer(spec.x, rate)))
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

    def dense(self, like: Array) -> Array:
        return self.matrix + self.shift * _identity(self.matrix)


def _identity(matrix: Array) -> Array:
    one = jnp.eye(matrix.shape[-1], dtype=matrix.dtype)
    return jnp.broadcast_to(one, matrix.shape)


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

    def dense(self, like: Array) -> Array:
        return jax.jacfwd(self)(jnp.zeros_like(like))


class CoupledFriction(eqx.Module):
    """Friction of a leaf by a rate that couples its entries, of one log scale."""

    log_scale: AbstractLogScale
    rate: MatrixRate | ProductRate

    @property
    def is_autonomous(self) -> bool:
        return self.log_scale.is_autonomous

    def prepare(self, t: Time, h: Time, order: int) -> Exponents:
        return self.log_scale.exponents(t, h, order)

    def fix(self, exponents: Exponents) -> Effect | Exponents:
        if not (self.is_autonomous and isinstance(self.rate, MatrixRate)):
            return exponents
        x = exponents.x
        matrix = cast_to(self.rate.dense(x), x)
        change, carried = (
            y.reshape(*x.shape, *matrix.shape)
            for y in exponentials(matrix, jnp.ravel(x))
        )
        return Effect(change, carried, carried)

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
        matrix = self.log_scale.strength * cast_to(self.rate.dense(p), p)
        limit = jnp.linalg.solve(_identity(matrix) + matrix, force[..., None])[..., 0]
        at_rest = jnp.all(p == 0)
        return jnp.where(singular, jnp.where(at_rest, limit, jnp.nan), net)

    def amplification(self, t: Time, h: Time) -> Scalar:
        x = self.log_scale.increment(t, h)
        if isinstance(self.rate, ProductRate):
            # Not known; a gradient by reversal measures its errors in any case.
            return jnp.ones_like(x)
        matrix = cast_to(self.rate.matrix, x)
        symmetric = (matrix + jnp.swapaxes(matrix, -1, -2)) / 2
        return jnp.exp(jnp.max(jnp.linalg.eigvalsh(symmetric)) * x)

    def contraction(self, t: Time, h: Time, p: Array) -> Scalar:
        diagonal = jnp.diagonal(self.rate.dense(p), axis1=-2, axis2=-1)
        x = self.log_scale.increment(t, h)
        return x * cast_to(jnp.sum(jnp.broadcast_to(diagonal, jnp.shape(p))), x)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return self.log_scale.is_singular(t)


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

    def inverse(self, x: Array) -> PyTree:
        sizes = [int(np.prod(shape)) for shape, _ in self.shapes]
        parts = jnp.split(x, np.cumsum(sizes)[:-1])
        return self.structure.unflatten(
            [
                part.reshape(shape).astype(dtype)
                for part, (shape, dtype) in zip(parts, self.shapes, strict=True)
            ]
        )


class Effects(eqx.Module):
    """What was prepared of linear friction, for each leaf."""

    leaves: list[Effect | Exponents]


class LinearFriction(eqx.Module):
    r"""Linear friction $p' = F - \Gamma(t) \, p$ of momenta of one shape.

    `prepare` gives what depends on time alone, for a span; the other methods apply it.
    Changes rather than new momenta are returned, for compensated summation.
    """

    parts: tuple[EntryFriction | CoupledFriction, ...]
    ravel: Ravel

    @property
    def is_autonomous(self) -> bool:
        """Whether what is prepared depends on the length of a span alone."""
        return all(part.is_autonomous for part in self.parts)

    @property
    def precision(self) -> float:
        """The rounding error of a momentum, relative to it."""
        return max(float(jnp.finfo(dtype).eps) for _, dtype in self.ravel.shapes)

    def prepare(self, t: Time, h: Time, order: int) -> Effects:
        """What it does from `t` to `t + h`; of at least the given order in `h` where it
        is not known in closed form."""
        return Effects([part.prepare(t, h, order) for part in self.parts])

    def fix(self, effects: Effects) -> Effects:
        """What was prepared for many spans at once, to be applied many times."""
        rows = zip(self.parts, effects.leaves, strict=True)
        return Effects([part.fix(x) for part, x in rows])

    def _each(self, fn: str, effects: Effects, x: PyTree):
        rows = zip(self.parts, effects.leaves, self.ravel.leaves(x), strict=True)
        return [getattr(part, fn)(effect, leaf) for part, effect, leaf in rows]

    def flow(self, effects: Effects, p: PyTree) -> tuple[PyTree, PyTree]:
        """The change of `p` by friction alone, and the integral of `p` meanwhile."""
        both = self._each("flow", effects, p)
        change, carried = (self.ravel.unflatten(x) for x in zip(*both, strict=True))
        return change, carried

    def decay(self, effects: Effects, p: PyTree) -> PyTree:
        """The change of `p` by friction alone."""
        return self.flow(effects, p)[0]

    def respond(self, effects: Effects, force: PyTree) -> PyTree:
        """The momentum left by a constant force."""
        return self.ravel.unflatten(self._each("respond", effects, force))

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        r"""The force less the friction, $F - \Gamma(t) \, p$."""
        leaves = zip(self.ravel.leaves(force), self.ravel.leaves(p), strict=True)
        rows = zip(self.parts, leaves, strict=True)
        return self.ravel.unflatten([part.net_force(t, *pair) for part, pair in rows])

    def amplification(self, t: Time, h: Time) -> Scalar:
        """The factor by which errors of `p` grow from `t + h` back to `t`."""
        each = [part.amplification(t, h) for part in self.parts]
        return functools.reduce(jnp.maximum, each)

    def contraction(self, t: Time, h: Time, p: PyTree) -> Scalar:
        r"""The integral of the trace of $\Gamma$ from `t` to `t + h`: phase volume
        contracts by the exponential of it."""
        rows = zip(self.parts, self.ravel.leaves(p), strict=True)
        return functools.reduce(
            jnp.add, [part.contraction(t, h, x) for part, x in rows]
        )

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether it is infinite at `t`; `None` if it never is."""
        return _any([part.is_singular(t) for part in self.parts])


def _any(conditions: list[Bool[Array, ""] | None]) -> Bool[Array, ""] | None:
    known = [x for x in conditions if x is not None]
    return functools.reduce(jnp.logical_or, known) if known else None


# From the laws of a system to its friction.


def fit_friction(
    parts: Sequence[LinearPart], mechanics: Mechanics, p: PyTree
) -> LinearFriction | None:
    """The linear friction of some parts together, for momenta like `p`."""
    if not parts:
        return None
    forms = [part.form for part in parts]
    if any(part.per_velocity for part in parts):
        forms.append(mechanics.mass)
    joined = any(map(is_operator, forms))
    ravel = Ravel(p, joined)
    if joined:
        return LinearFriction((_by_products(parts, mechanics, p, ravel),), ravel)
    columns = [_rates(part, mechanics, p) for part in parts]
    laws = [part.log_scale for part in parts]
    rows = zip(*columns, strict=True)
    like = jtu.tree_leaves(p)
    merged = [
        _merged(list(zip(laws, row, strict=True)), x)
        for row, x in zip(rows, like, strict=True)
    ]
    return LinearFriction(tuple(merged), ravel)


def _rates(part: LinearPart, mechanics: Mechanics, p: PyTree) -> list[Array]:
    """The rate of each leaf: of its entries, or as a matrix."""
    name = COEFFICIENTS if part.per_velocity else DAMPING
    rates = jtu.tree_leaves(fit_form(part.form, p, name, "p"))
    if part.per_velocity:
        masses = jtu.tree_leaves(fit_form(mechanics.mass, p, MASS, "p"))
        rows = zip(rates, masses, jtu.tree_leaves(p), strict=True)
        return [_per_momentum(*row) for row in rows]
    return rates


def _merged(
    terms: list[tuple[AbstractLogScale, Array]], like: Array
) -> EntryFriction | CoupledFriction:
    coupled = any(is_matrix(rate, like) for _, rate in terms)
    if len(terms) > 1 and all(law.is_autonomous for law, _ in terms):
        rates = [_as_matrix(x, like) if coupled else x for _, x in terms]
        terms = [(Linear(), functools.reduce(jnp.add, rates))]
    for law, _ in terms:
        _check_values(law, like, coupled)
    if not coupled:
        return EntryFriction(tuple(terms))
    if len(terms) > 1:
        raise ValueError(
            "Friction by a matrix and friction that depends on time have no exact flow "
            f"together, but there are {len(terms)} laws. Write one "
            "`ViscousDamping(C, law)`; or all but one as `ViscousDamping(function)` "
            "with a function `C(t, q, args)`, which is part of the kicks."
        )
    ((law, rate),) = terms
    return CoupledFriction(law, MatrixRate(rate))


def _check_values(law: AbstractLogScale, like: Array, coupled: bool) -> None:
    shape = jax.eval_shape(law.rate, jnp.zeros(())).shape
    if coupled and shape != ():
        raise ValueError(
            "The law in `ViscousDamping(C, law)` with a matrix must be one rate for "
            f"all momenta, but has shape {shape}. Multiply the matrix by the numbers."
        )
    if len(shape) > jnp.ndim(like):
        raise ValueError(
            f"The damping has shape {shape} for a `p` of shape {jnp.shape(like)}. "
            "Friction by a matrix is given per velocity: write "
            "`ViscousDamping(matrix)`."
        )
    fit_form(jnp.zeros(shape), like, DAMPING, "p")


def _by_products(
    parts: Sequence[LinearPart], mechanics: Mechanics, p: PyTree, ravel: Ravel
) -> CoupledFriction:
    laws = [part.log_scale for part in parts]
    if len(parts) > 1 and not all(law.is_autonomous for law in laws):
        _merged([(law, jnp.zeros((2, 2))) for law in laws], jnp.zeros(2))
    rates = tuple(part.form for part in parts if not part.per_velocity)
    coefficients = tuple(part.form for part in parts if part.per_velocity)
    rate = ProductRate(rates, coefficients, mechanics.mass, ravel)
    _check_values(laws[0], ravel(p), coupled=True)
    if not any(map(_is_implicit, (*rates, *coefficients, mechanics.mass))):
        rate = MatrixRate(rate.dense(ravel(p)))
    return CoupledFriction(laws[0], rate)


def _is_implicit(form: Form) -> bool:
    """Whether a form is an operator that is not given by its entries."""
    known = (
        lx.MatrixLinearOperator,
        lx.DiagonalLinearOperator,
        lx.TridiagonalLinearOperator,
        lx.IdentityLinearOperator,
    )
    if not is_operator(form) or isinstance(form, known):
        return False
    # Sums, products and tags of operators.
    parts = [x for x in vars(form).values() if is_operator(x)]
    return not parts or any(map(_is_implicit, parts))


def _per_momentum(coefficient: Array, mass: Array, p: Array) -> Array:
    """C M^-1 for one leaf."""
    if not is_matrix(mass, p):
        if is_matrix(coefficient, p):
            return coefficient / jnp.broadcast_to(mass, jnp.shape(p))[..., None, :]
        return coefficient / mass
    # M is symmetric: C M^-1 is the transpose of M^-1 C^T.
    transposed = jnp.swapaxes(_as_matrix(coefficient, p), -1, -2)
    factor = jnp.linalg.cholesky(mass)
    mass, transposed = jnp.broadcast_arrays(factor, transposed)
    solved = jax.scipy.linalg.cho_solve((mass, True), transposed)
    return jnp.swapaxes(solved, -1, -2)


def _as_matrix(rate: Array, like: Array) -> Array:
    if is_matrix(rate, like):
        return rate
    entries = jnp.broadcast_to(rate, jnp.shape(like))
    return entries[..., None] * jnp.eye(entries.shape[-1], dtype=entries.dtype)


class SumDamping(AbstractDamping):
    """Several laws of one rate for all momenta, as one."""

    laws: tuple[tuple[AbstractLogScale, Any], ...]

    @property
    def terms(self):
        return self.laws


def one_rate(parts: Parts) -> AbstractDamping | None:
    """The law of friction, if that is one rate for all momenta and nothing else.

    `ValueError` if there is any other friction.
    """
    linear, *rest = parts
    shape = lambda part: jtu.tree_map(jnp.shape, part.form)
    values = lambda part: jax.eval_shape(part.log_scale.rate, jnp.zeros(()))
    scalar = all(
        not part.per_velocity and shape(part) == () and values(part).shape == ()
        for part in linear
        if not is_operator(part.form)
    )
    if any(rest) or any(is_operator(part.form) for part in linear) or not scalar:
        raise ValueError(
            "Only one rate of damping for all momenta has a log scale and a canonical "
            "momentum, but this system has other friction. Write "
            "`ConstantDamping(rate)` with a number; or use `energy(t, q, p)`, and "
            "`diagnostics.volume_defect` for linear friction."
        )
    terms = tuple((part.log_scale, part.form) for part in linear)
    return SumDamping(terms) if terms else None


def has_one_rate(parts: Parts) -> bool:
    try:
        one_rate(parts)
    except ValueError:
        return False
    return True
