"""Linear maps in the forms that users write: masses, stiffnesses, friction."""

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree

from ._checks import as_finite, as_positive
from ._numbers import cast_to


_MASSLESS = (
    " For massless test particles let `p` be the momentum per unit mass: "
    "`MechanicalSystem(QuadraticKinetic(), ForceField(acceleration))`."
)


def as_form(form, name: str, positive: bool):
    """A number, an array, a matrix, a pytree of these, a Lineax operator or `None`."""
    if form is None or isinstance(form, lx.AbstractLinearOperator):
        return form

    def leaf(x):
        shape = jnp.shape(x)
        if not positive:
            return as_finite(x, name)
        if len(shape) != 2 or shape[0] != shape[1]:
            return as_positive(x, name, _MASSLESS)
        # It may be a matrix, whose other entries may have any sign.
        as_positive(jnp.diagonal(x), f"The diagonal of {name}", _MASSLESS)
        return as_finite(x, name)

    return jtu.tree_map(leaf, form)


def fit_form(form, x: PyTree, name: str, state: str) -> PyTree:
    """The arrays of a form for the leaves of `x`: for each an array with as many axes
    that broadcasts to it or, with one more, a matrix for each vector over the last
    axis."""
    if form is None:
        return jtu.tree_map(lambda xi: jnp.ones((), jnp.result_type(xi)), x)

    def one(xi, form):
        form, shape = cast_to(form, xi), jnp.shape(xi)
        wanted = shape
        if shape and form.ndim == len(shape) + 1:
            wanted = *shape, shape[-1]
            if form.shape[-2:] != wanted[-2:]:
                raise ValueError(
                    f"{name} with a matrix needs one row and column for each entry of "
                    f"`{state}`, but got shape {form.shape} for `{state}` of shape "
                    f"{shape}."
                )
        fits = form.ndim == 0 or (
            form.ndim == len(wanted)
            and all(m in (1, n) for m, n in zip(form.shape, wanted, strict=True))
        )
        if not fits:
            raise ValueError(
                f"{name} of shape {form.shape} does not fit `{state}` of shape "
                f"{shape}. Pass a number, or an array with as many dimensions as "
                f"`{state}` that broadcasts to it, for example `x[:, None]` for `n` "
                f"particles with `{state}` of shape `(n, 3)`; or a matrix for a vector "
                f"`{state}`."
            )
        return form

    if eqx.is_array(form):
        return jtu.tree_map(lambda xi: one(xi, form), x)
    if jtu.tree_structure(form) != jtu.tree_structure(x):
        raise ValueError(
            f"{name} must be a number, an array or a pytree of the structure of "
            f"`{state}`, {jtu.tree_structure(x)}, but got {jtu.tree_structure(form)}. "
            "Convert a list of numbers with `jnp.array(...)`."
        )
    return jtu.tree_map(one, x, form)


def is_matrix(form: Array, x: Array) -> bool:
    """Whether a form for `x` is a matrix, rather than an array of its entries."""
    return jnp.ndim(form) > jnp.ndim(x)


def is_operator(form) -> bool:
    return isinstance(form, lx.AbstractLinearOperator)


def matvec(matrix: Array, x: Array) -> Array:
    """A matrix for each vector over the last axis, times that vector."""
    if jnp.ndim(x) == 1:
        return matrix @ x
    return jnp.sum(matrix * x[..., None, :], axis=-1)


def multiply(form, x: PyTree, name: str, state: str) -> PyTree:
    if form is None or is_operator(form):
        return x if form is None else form.mv(x)

    def leaf(x, form):
        return matvec(form, x) if is_matrix(form, x) else form * x

    return jtu.tree_map(leaf, x, fit_form(form, x, name, state))


def divide(form, x: PyTree, name: str, state: str) -> PyTree:
    if form is None:
        return x
    if is_operator(form):
        return lx.linear_solve(form, x, throw=False).value

    def solve(form, x):
        operator = lx.MatrixLinearOperator(form, lx.positive_semidefinite_tag)
        return lx.linear_solve(operator, x, lx.Cholesky(), throw=False).value

    def leaf(x, form):
        if not is_matrix(form, x):
            return x / form
        return jnp.vectorize(solve, signature="(n,n),(n)->(n)")(form, x)

    return jtu.tree_map(leaf, x, fit_form(form, x, name, state))
