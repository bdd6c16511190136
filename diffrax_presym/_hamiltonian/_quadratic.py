"""Symmetric linear maps, for masses and stiffnesses."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import PyTree

from .._misc import as_parameter, as_positive, cast_to


_MASSLESS = (
    " For massless test particles let `p` be the momentum per unit mass: "
    "`SeparableHamiltonian(QuadraticKinetic(), potential, force=acceleration)`."
)


def as_form(form, name: str, positive: bool):
    """A number, an array, a matrix, a pytree of these, a Lineax operator or `None`."""
    if form is None or isinstance(form, lx.AbstractLinearOperator):
        return form

    def leaf(x):
        shape = jnp.shape(x)
        if not positive:
            return as_parameter(x, name)
        if len(shape) != 2 or shape[0] != shape[1]:
            return as_positive(x, name, _MASSLESS)
        # It may be a matrix, whose other entries may have any sign.
        as_positive(jnp.diagonal(x), f"The diagonal of {name}", _MASSLESS)
        return as_parameter(x, name)

    return jtu.tree_map(leaf, form)


def apply_form(form, x: PyTree, name: str, state: str, leaf: Callable, operator):
    """Apply a form to `x`: `leaf(xi, form, is_matrix)` for arrays, `operator(form, x)`
    for an operator."""
    if form is None:
        return x
    if isinstance(form, lx.AbstractLinearOperator):
        return operator(form, x)

    def one(xi, form):
        form = cast_to(form, xi)
        is_matrix = form.ndim == 2 and xi.ndim == 1
        if is_matrix and form.shape != (xi.size, xi.size):
            raise ValueError(
                f"{name} with a matrix needs one row and column for each entry of "
                f"`{state}`, but got shape {form.shape} for `{state}` of shape "
                f"{xi.shape}."
            )
        fits = form.ndim == 0 or (
            form.ndim == xi.ndim
            and all(m in (1, n) for m, n in zip(form.shape, xi.shape, strict=True))
        )
        if not (fits or is_matrix):
            raise ValueError(
                f"{name} of shape {form.shape} does not fit `{state}` of shape "
                f"{xi.shape}. Pass a number, or an array with as many dimensions as "
                f"`{state}` that broadcasts to it, for example `x[:, None]` for `n` "
                f"particles with `{state}` of shape `(n, 3)`; or a matrix for a vector "
                f"`{state}`."
            )
        return leaf(xi, form, is_matrix)

    if eqx.is_array(form):
        return jtu.tree_map(lambda xi: one(xi, form), x)
    if jtu.tree_structure(form) != jtu.tree_structure(x):
        raise ValueError(
            f"{name} must be a number, an array or a pytree of the structure of "
            f"`{state}`, {jtu.tree_structure(x)}, but got {jtu.tree_structure(form)}. "
            "Convert a list of numbers with `jnp.array(...)`."
        )
    return jtu.tree_map(one, x, form)


def multiply(form, x: PyTree, name: str, state: str) -> PyTree:
    leaf = lambda x, form, is_matrix: form @ x if is_matrix else form * x
    return apply_form(form, x, name, state, leaf, lambda form, x: form.mv(x))


def divide(form, x: PyTree, name: str, state: str) -> PyTree:
    def leaf(x, form, is_matrix):
        if not is_matrix:
            return x / form
        operator = lx.MatrixLinearOperator(form, lx.positive_semidefinite_tag)
        return lx.linear_solve(operator, x, lx.Cholesky(), throw=False).value

    solve = lambda form, x: lx.linear_solve(form, x, throw=False).value
    return apply_form(form, x, name, state, leaf, solve)
