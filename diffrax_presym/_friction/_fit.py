"""From the laws of a system to its friction."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._forms import fit_form, is_matrix, is_operator
from ._base import (
    COEFFICIENTS,
    DAMPING,
    Form,
    LinearPart,
    MASS,
    Mechanics,
    Parts,
)
from ._damping import AbstractDamping, SumOfDampings
from ._exponential import product
from ._leaf import EntryFriction, MatrixFriction
from ._linear import LinearFriction
from ._log_scale import AbstractLogScale


def fit_friction(
    parts: Sequence[LinearPart], mechanics: Mechanics, p: PyTree
) -> LinearFriction | None:
    """The linear friction of some parts together, for momenta like `p`."""
    if not parts:
        return None
    columns = [_rates(part, mechanics, p) for part in parts]
    laws = [part.log_scale for part in parts]
    like, structure = jtu.tree_flatten(p)
    leaves = [
        _leaf_friction(list(zip(laws, rates, strict=True)), x)
        for *rates, x in zip(*columns, like, strict=True)
    ]
    precision = max(float(jnp.finfo(x.dtype).eps) for x in like)
    return LinearFriction(structure.unflatten(leaves), precision)


def _rates(part: LinearPart, mechanics: Mechanics, p: PyTree) -> list[Array]:
    """The rate of each leaf: of its entries, or as a matrix."""
    name = COEFFICIENTS if part.per_velocity else DAMPING
    like, form = jtu.tree_leaves(p), _as_array(part.form, p, name)
    rates = jtu.tree_leaves(fit_form(form, p, name, "p"))
    if part.per_velocity:
        mass = fit_form(_as_array(mechanics.mass, p, MASS), p, MASS, "p")
        inverse = jtu.tree_leaves(mechanics.inverse) or [None] * len(like)
        rows = zip(rates, jtu.tree_leaves(mass), inverse, like, strict=True)
        return [_per_momentum(*row) for row in rows]
    couples = any(is_matrix(x, xi) for x, xi in zip(rates, like, strict=True))
    if couples and not part.may_couple:
        raise ValueError(
            "The damping is a matrix that couples the entries of `p`. Friction by a "
            "matrix is given per velocity: write `ViscousDamping(matrix)`."
        )
    return rates


def _as_array(form: Form, p: PyTree, name: str) -> Any:
    """An operator as its matrix."""
    if not is_operator(form):
        return form
    shapes = jtu.tree_map(jnp.shape, p)
    if not eqx.is_array(p) or jnp.ndim(p) != 1:
        raise ValueError(
            f"{name} is an operator, which with friction per velocity needs positions "
            f"and momenta in one vector, but `p` has shape {shapes}. Write a matrix "
            "for each leaf, or the friction as `MechanicalSystem(..., force=f)`."
        )
    return form.as_matrix()  # pyright: ignore[reportOptionalMemberAccess]


def _leaf_friction(
    terms: list[tuple[AbstractLogScale, Array]], like: Array
) -> EntryFriction | MatrixFriction:
    coupled = any(is_matrix(rate, like) for _, rate in terms)
    # Laws of one log scale are one law.
    same: dict[Any, list[tuple[AbstractLogScale, Array]]] = {}
    for law, rate in terms:
        leaves, structure = jtu.tree_flatten(law)
        key = structure, tuple(map(id, leaves))
        same.setdefault(key, []).append((law, rate))
    terms = [(group[0][0], _sum(group, like, coupled)) for group in same.values()]
    if not coupled:
        for law, _ in terms:
            _check_values(law, like)
        return EntryFriction(tuple(terms))
    if len(terms) > 1:
        raise ValueError(
            "Friction by a matrix and friction that depends on time have no exact flow "
            "together. Write the matrix as `ViscousDamping(function)`, with a function "
            "`C(t, q, args)`, which is part of the kicks."
        )
    return MatrixFriction(terms[0][1])


def _sum(
    terms: list[tuple[AbstractLogScale, Array]], like: Array, coupled: bool
) -> Array:
    rates = [rate for _, rate in terms]
    if len(rates) > 1 and coupled:
        rates = [_as_matrix(x, like) for x in rates]
    rank = max(map(jnp.ndim, rates))
    rates = [jnp.reshape(x, (1,) * (rank - jnp.ndim(x)) + jnp.shape(x)) for x in rates]
    return functools.reduce(jnp.add, rates)


def _check_values(law: AbstractLogScale, like: Array) -> None:
    shape = jax.eval_shape(law.rate, jnp.zeros(())).shape
    if len(shape) > jnp.ndim(like):
        raise ValueError(
            f"The damping has shape {shape} for a `p` of shape {jnp.shape(like)}. "
            "Friction by a matrix is given per velocity: write "
            "`ViscousDamping(matrix)`."
        )
    fit_form(jnp.zeros(shape), like, DAMPING, "p")


def _per_momentum(
    coefficient: Array, mass: Array, inverse: Array | None, p: Array
) -> Array:
    """C M^-1 for one leaf."""
    if not is_matrix(mass, p):
        if is_matrix(coefficient, p):
            return coefficient / jnp.broadcast_to(mass, jnp.shape(p))[..., None, :]
        return coefficient / mass
    if inverse is not None:
        # In every kick, of coefficients that depend on the place: no factorisation.
        if is_matrix(coefficient, p):
            return product(coefficient, inverse)
        return jnp.broadcast_to(coefficient, jnp.shape(p))[..., None] * inverse
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
    one = jnp.eye(entries.shape[-1], dtype=entries.dtype)
    return entries[..., None] * jnp.expand_dims(one, range(entries.ndim - 1))


def one_rate(parts: Parts) -> AbstractDamping | None:
    """The law of friction, if that is one rate for all momenta and nothing else.

    `ValueError` if there is any other friction.
    """
    if not has_one_rate(parts):
        raise ValueError(
            "Only one rate of damping for all momenta has a log scale and a canonical "
            "momentum, but this system has other friction. Write "
            "`ConstantDamping(rate)` with a number; or use `energy(t, q, p)`."
        )
    terms = tuple((part.log_scale, part.form) for part in parts.linear)
    return SumOfDampings(terms) if terms else None


def has_rates(parts: Parts) -> bool:
    """Whether friction is one rate for each array of momenta, and nothing else."""

    def is_rate(part: LinearPart) -> bool:
        if part.per_velocity or is_operator(part.form):
            return False
        shapes = [*map(jnp.shape, jtu.tree_leaves(part.form)), part.log_scale.shape]
        return all(shape == () for shape in shapes)

    linear, *other = parts
    return not any(other) and all(map(is_rate, linear))


def has_one_rate(parts: Parts) -> bool:
    """Whether this is the same rate for all arrays."""
    is_number = lambda part: jtu.treedef_is_leaf(jtu.tree_structure(part.form))
    return has_rates(parts) and all(map(is_number, parts.linear))
