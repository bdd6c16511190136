"""Linear maps in the forms that users write: masses, stiffnesses, friction."""

import operator
from functools import partial

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Inexact, PyTree

from . import _tree as tree
from ._checks import as_finite, as_parameter, as_positive
from ._implicit import solve_linear
from ._numbers import cast_to


Vector = Inexact[Array, " n"]
Matrix = Inexact[Array, "n n"]

_NEGATIVE = (
    " For a negative effective mass write the kinetic energy as a function "
    "`T(t, p, args)`; or reverse the signs of the mass, of the potential and of all "
    "friction per velocity, for the same positions and the opposite momenta."
)
_MASSLESS = (
    " For massless test particles let `p` be the momentum per unit mass: "
    "`MechanicalSystem(QuadraticKinetic(), ForceField(acceleration))`."
)


# Of vectors in a plane and in space, as many as these have dimensions.
_SPACES = (2, 2), (3, 3)


def as_form(form, name: str, instead: str = ""):
    """A number, an array, a matrix, a pytree of these, a Lineax operator or `None`.

    `instead` is what to write in place of a function.
    """
    if form is None or is_operator(form):
        return form
    return jtu.tree_map(lambda x: as_finite(x, name, instead), form)


def as_mass(form, name: str, instead: str):
    """The same, of positive numbers."""
    if form is None or is_operator(form):
        return form

    def leaf(x):
        mass = as_parameter(x, name, instead)
        if isinstance(x, Tracer):
            return mass
        entries, which = np.asarray(x), name
        if _may_be_matrix(entries):
            # Its other entries may have any sign.
            as_finite(entries, name)
            entries = np.diagonal(entries, axis1=-2, axis2=-1)
            which = f"The diagonal of {name}"
        as_positive(entries, which, _NEGATIVE if np.any(entries < 0) else _MASSLESS)
        return mass

    return jtu.tree_map(leaf, form)


def _may_be_matrix(x) -> bool:
    return jnp.ndim(x) > 1 and jnp.shape(x)[-1] == jnp.shape(x)[-2]


def is_symmetric(form) -> bool:
    """False if a form is known not to be symmetric, should it be a matrix.

    Whether it is one depends on the state.
    """
    if isinstance(form, lx.MatrixLinearOperator):
        form = form.matrix
    elif is_operator(form):  # The entries of others may take long to compute.
        return True

    def leaf(x):
        if isinstance(x, Tracer) or not _may_be_matrix(x):
            return True
        x = np.asarray(x)
        x = x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)
        rounding = float(jnp.finfo(x.dtype).eps) ** 0.5 * np.max(np.abs(x), initial=0)
        return bool(np.all(np.abs(x - np.swapaxes(x, -1, -2)) <= rounding))

    return all(map(leaf, jtu.tree_leaves(form)))


def _check_symmetric(symmetric: bool, name: str) -> None:
    if not symmetric:
        raise ValueError(
            f"{name} must be a symmetric matrix, but got one that is not. Write "
            "`(A + A.T) / 2` if its symmetric part is meant, and `ForceField(force)` "
            "for a force that has no energy."
        )


def fit_form(form, x: PyTree, name: str, state: str, symmetric: bool = True) -> PyTree:
    """The arrays of a form for the leaves of `x`: for each an array with as many axes
    that broadcasts to it or, with one more, a matrix for each vector over the last
    axis.

    `ValueError` if it does not fit, or is a matrix that is not `symmetric` and should
    be.
    """
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
            _check_symmetric(symmetric, name)
        fits = form.ndim == 0 or (
            form.ndim == len(wanted)
            and all(m in (1, n) for m, n in zip(form.shape, wanted, strict=True))
        )
        if not fits:
            raise ValueError(
                f"{name} of shape {form.shape} does not fit `{state}` of shape "
                f"{shape}. Pass a number, or an array with as many dimensions as "
                f"`{state}` that broadcasts to it, for example `x[:, None]` for `n` "
                f"particles with `{state}` of shape `(n, 3)`; or a matrix for each "
                f"vector over the last axis of `{state}`, for example `x[None]` for "
                "one matrix for all particles."
            )
        if shape[-2:] in _SPACES and form.shape == shape:
            # That of a magnetic field would be taken for its entries.
            diagonal = np.broadcast_to(np.eye(shape[-1], dtype=bool), shape)
            off = jnp.where(diagonal, 0, form)
            is_field = jnp.all(off == -jnp.swapaxes(off, -1, -2)) & jnp.any(off != 0)
            form = tree.invalid_if(is_field, form)
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


# A loop over matrices copies each before XLA on a CPU calls its product, but not before
# a sum, which is 1.3 to 2.6 times faster up to these sizes, and in a batch 1.2 to 2
# times up to the first of them.
_SUMMED, _SUMMED_ALONE = 10, 32


def vecmat(x: Array, matrix: Array) -> Array:
    """Vectors over the last axis, each times its matrix, one of those of a loop."""
    if matrix.shape[-1] <= _SUMMED or jnp.ndim(x) > 1:
        return jnp.sum(x[..., None] * matrix, axis=-2)
    return _alone(x, matrix) if len(x) <= _SUMMED_ALONE else x @ matrix


@jax.custom_jvp
def _alone(x: Array, matrix: Array) -> Array:
    """One vector by a sum; those of a batch by a product."""
    product = jax.custom_batching.custom_vmap(lambda x, y: jnp.sum(x[:, None] * y, 0))

    @product.def_vmap
    def batched(size, is_batched, x, matrix):
        axes = tuple(0 if each else None for each in is_batched)
        return jax.vmap(jnp.matmul, axes)(x, matrix), True

    return product(x, matrix)


@_alone.defjvp
def _alone_jvp(primals, tangents):
    (x, matrix), (dx, d_matrix) = primals, tangents
    return _alone(x, matrix), dx @ matrix + x @ d_matrix


def multiply(
    form, x: PyTree, name: str, state: str, symmetric=True, product=operator.mul
) -> PyTree:
    """The form times `x`, of numbers for its entries by a `product`."""
    if form is None:
        return x
    if is_operator(form):
        _check_symmetric(symmetric, name)
        return form.mv(x)

    def leaf(x, form):
        return matvec(form, x) if is_matrix(form, x) else product(form, x)

    return jtu.tree_map(leaf, x, fit_form(form, x, name, state, symmetric))


def momentum(mass, v: PyTree, name: str, state: str, symmetric=True) -> PyTree:
    """The mass times the velocity: zero at rest, also of an infinite mass."""

    def product(m: Array, v: Array) -> Array:
        return jnp.where(jnp.isinf(m) & (v == 0), 1, m) * v

    return multiply(mass, v, name, state, symmetric, product)


def divide(form, x: PyTree, name: str, state: str, symmetric=True) -> PyTree:
    if form is None:
        return x
    if is_operator(form):
        _check_symmetric(symmetric, name)
        known, transposed = lambda *_: form, lambda *_: form.T
        how = lx.AutoLinearSolver(True)
        return solve_linear(form.mv, x, how, known, transposed)

    def leaf(x, form):
        if not is_matrix(form, x):
            return x / form
        return jnp.vectorize(solve_positive, signature="(n,n),(n)->(n)")(form, x)

    return jtu.tree_map(leaf, x, fit_form(form, x, name, state, symmetric))


def inverse(form, x: PyTree, name: str, state: str) -> PyTree:
    """The form of the inverse map, to `multiply` by; `None` if no part of it is a
    matrix, or if it is an operator."""
    if form is None or is_operator(form):
        return None
    form = fit_form(form, x, name, state)
    if not any(jtu.tree_leaves(jtu.tree_map(is_matrix, form, x))):
        return None

    @partial(jnp.vectorize, signature="(n,n)->(n,n)")
    def inverted(M: Matrix) -> Matrix:
        columns = jax.vmap(partial(solve_positive, M))(jnp.eye(len(M), dtype=M.dtype))
        return (columns + columns.T) / 2

    leaf = lambda form, x: inverted(form) if is_matrix(form, x) else 1 / form
    return jtu.tree_map(leaf, form, x)


# The fastest factorisation depends on the size: written out in full, which for more
# entries takes long to compile; a loop; and LAPACK, which takes long to call.
WRITTEN_OUT, _LARGE = 4, 16


@jax.jit  # Outside of a solve, a loop would be compiled again by each call.
def solve_positive(M: Matrix, p: Vector) -> Vector:
    """The solution of `M v = p`, NaN if `M` is not positive definite."""
    # The derivative is that of the solution, not of the steps to it.
    return lax.custom_linear_solve(
        lambda v: matvec(M, v), p, lambda _, p: _by_size(M, p), symmetric=True
    )


def _by_size(M: Matrix, p: Vector) -> Vector:
    """The same without derivatives, by the fastest factorisation of this size."""
    n = len(p)
    if n > _LARGE:
        L = jnp.linalg.cholesky(M, symmetrize_input=False)
        return jsl.cho_solve((L, True), p)
    if n > WRITTEN_OUT:
        return _eliminate(M, p)
    # Cholesky's factorisation, scalar by scalar.
    L = [[M[i, j] for j in range(i + 1)] for i in range(n)]
    v = [p[i] for i in range(n)]
    inverse = []
    for j in range(n):
        for i in range(j, n):
            for k in range(j):
                L[i][j] = L[i][j] - L[i][k] * L[j][k]
        inverse.append(1 / jnp.sqrt(L[j][j]))
        for i in range(j + 1, n):
            L[i][j] = L[i][j] * inverse[j]
    for i in range(n):
        for k in range(i):
            v[i] = v[i] - L[i][k] * v[k]
        v[i] = v[i] * inverse[i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            v[i] = v[i] - L[k][i] * v[k]
        v[i] = v[i] * inverse[i]
    return jnp.stack(v)


def _eliminate(M: Matrix, p: Vector) -> Vector:
    """By Gauss--Jordan elimination, which needs no pivots if `M` is definite."""
    rows = jnp.arange(len(p))[:, None]

    def eliminate(k, A):
        row = A[k] / jnp.where(A[k, k] > 0, A[k, k], jnp.nan)
        return jnp.where(rows == k, row[None], A - jnp.outer(A[:, k], row))

    A = jnp.concatenate([M, p[:, None]], axis=1)
    return lax.fori_loop(0, len(p), eliminate, A)[:, -1]
