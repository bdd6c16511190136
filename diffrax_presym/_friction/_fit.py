"""From the laws of a system to its friction."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree

from .._forms import fit_form, is_matrix, is_operator
from ._base import Form, Linear as LinearPart, Mechanics, Parts
from ._damping import AbstractDamping
from ._linear import LinearFriction
from ._log_scale import (
    AbstractLogScale,
)
from ._rates import (
    COEFFICIENTS,
    CoupledFriction,
    DAMPING,
    EntryFriction,
    identity,
    MASS,
    MatrixRate,
    ProductRate,
    Ravel,
)


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
    if any(
        is_matrix(x, like) for x, like in zip(rates, jtu.tree_leaves(p), strict=True)
    ):
        raise ValueError(
            "The damping is a matrix that couples the entries of `p`. Friction by a "
            "matrix is given per velocity: write `ViscousDamping(matrix)`."
        )
    return rates


def _merged(
    terms: list[tuple[AbstractLogScale, Array]], like: Array
) -> EntryFriction | CoupledFriction:
    coupled = any(is_matrix(rate, like) for _, rate in terms)
    # Laws of one log scale are one law.
    same: dict[Any, list[tuple[AbstractLogScale, Array]]] = {}
    for law, rate in terms:
        leaves, structure = jtu.tree_flatten(law)
        key = structure, tuple(map(id, leaves))
        same.setdefault(key, []).append((law, rate))
    terms = [(group[0][0], _sum(group, like, coupled)) for group in same.values()]
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


def _sum(
    terms: list[tuple[AbstractLogScale, Array]], like: Array, coupled: bool
) -> Array:
    rates = [rate for _, rate in terms]
    if len(rates) > 1 and coupled:
        rates = [_as_matrix(x, like) for x in rates]
    rank = max(map(jnp.ndim, rates))
    rates = [jnp.reshape(x, (1,) * (rank - jnp.ndim(x)) + jnp.shape(x)) for x in rates]
    return functools.reduce(jnp.add, rates)


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
        rate = MatrixRate(rate.dense())
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
    return entries[..., None] * identity(entries)


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
