"""The multipliers of constraints: linear systems, and Newton's method."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Inexact

from .. import _tree as tree
from .._implicit import solve_linear


Multipliers = Inexact[Array, " constraints"]
LinearMap = Callable[[Multipliers], Multipliers]

# It converges in two to five steps, or the step of the scheme is too long.
_MOST_STEPS = 12
# On a CPU XLA makes one function of a loop, unless it calls LAPACK: with 3 and 10
# constraints that is 8 and 2 times slower, with 20 it is faster.
_MOST_ELIMINATED = 16
# Of the rows of diagonals at once, as an iteration of a loop takes as long as a row.
_ROWS = 4


class _AbstractMatrix(eqx.Module):
    """What is known of a linear system: it is found once, for derivatives too."""

    @abc.abstractmethod
    def __call__(self, x: Multipliers) -> Multipliers: ...

    @abc.abstractmethod
    def solve(self, b: Multipliers) -> Multipliers:
        """The solution, not finite if there is none."""

    @property
    @abc.abstractmethod
    def transpose(self) -> "_AbstractMatrix": ...


class _Dense(_AbstractMatrix):
    matrix: Inexact[Array, "constraints constraints"]

    def __call__(self, x: Multipliers) -> Multipliers:
        return jnp.sum(self.matrix * x[None], axis=-1)

    def solve(self, b: Multipliers) -> Multipliers:
        if b.size > _MOST_ELIMINATED:
            operator = lx.MatrixLinearOperator(self.matrix)
            found = lx.linear_solve(operator, b, lx.LU(), throw=False)
            return tree.invalid_if(found.result != lx.RESULTS.successful, found.value)
        row = jnp.arange(b.size)

        def step(k: Array, x: Array) -> Array:
            """Of Gauss and Jordan, with pivots."""
            size = jnp.where(row < k, -1, jnp.abs(x[:, k]))
            chosen, old = (row == jnp.argmax(size))[:, None], x[k]
            pivot = jnp.sum(jnp.where(chosen, x, 0), axis=0)
            x = jnp.where(chosen, old[None], x)
            pivot = pivot / pivot[k]
            return jnp.where(
                (row == k)[:, None], pivot[None], x - x[:, k, None] * pivot[None]
            )

        start = jnp.concatenate([self.matrix, b[:, None]], axis=1)
        return lax.fori_loop(0, b.size, step, start)[:, -1]

    @property
    def transpose(self) -> "_Dense":
        return _Dense(self.matrix.T)


class _Tridiagonal(_AbstractMatrix):
    # Each as long as a row. The first entry of `lower` and the last of `upper` are the
    # corners of the matrix, and zero.
    lower: Multipliers
    diagonal: Multipliers
    upper: Multipliers

    def __call__(self, x: Multipliers) -> Multipliers:
        before, after = (jnp.pad(x, 1)[k : k + x.size] for k in (0, 2))
        return self.lower * before + self.diagonal * x + self.upper * after

    def solve(self, b: Multipliers) -> Multipliers:
        """By elimination of the lower diagonal, with pivots."""
        zero = jnp.zeros((), b.dtype)

        def eliminate(row, after):
            """The pivot of a row and the next, and the other less its first entry."""
            before, swap = (*row[:2], zero, row[2]), jnp.abs(after[0]) > jnp.abs(row[0])
            either = lambda x, y: [jnp.where(swap, *z) for z in zip(x, y, strict=True)]
            pivot, other = either(after, before), either(before, after)
            factor = other[0] / pivot[0]
            rest = [y - factor * x for x, y in zip(pivot[1:], other[1:], strict=True)]
            return tuple(rest), tuple(pivot)

        def substitute(x, pivot):
            first, second, third, value = pivot
            found = (value - second * x[0] - third * x[1]) / first
            return (found, x[0]), found

        # A row has entries in three columns from its own on. Before the first one is
        # that of a multiplier that is zero.
        start, rows = (zero + 1, zero, zero), (self.lower, self.diagonal, self.upper, b)
        end, pivots = lax.scan(eliminate, start, rows, unroll=_ROWS)
        last = end[2] / end[0]
        start = last, zero
        x = lax.scan(substitute, start, pivots, reverse=True, unroll=_ROWS)[1]
        return jnp.append(x[1:], last)

    @property
    def transpose(self) -> "_Tridiagonal":
        lower, upper = jnp.roll(self.upper, 1), jnp.roll(self.lower, -1)
        return _Tridiagonal(lower, self.diagonal, upper)


def as_matrix(
    linear: LinearMap, like: Any, solver: lx.AbstractLinearSolver | None
) -> LinearMap:
    """The matrix of a linear map, or the map itself if a solver needs none. That of
    three diagonals is not finite if other entries are not zero, as with masses or
    friction that join links."""
    if isinstance(linear, _AbstractMatrix) or like.size == 0:
        return linear
    # Scans of length one fail within `eqx.error_if`, where XLA evaluates constants.
    if solver is None or like.size == 1:
        basis = jnp.eye(like.size, dtype=like.dtype)
        return _Dense(jax.vmap(linear, out_axes=1)(basis))
    if not isinstance(solver, lx.Tridiagonal):
        return linear
    # Each row couples three neighbours, so three products show all entries, and another
    # one whether these are all.
    row = jnp.arange(like.size)
    probe = jnp.cos(row.astype(like.dtype))
    each = [*((row % 3 == k).astype(like.dtype) for k in range(3)), probe]
    *columns, product = jax.vmap(linear)(jnp.stack(each))
    diagonals = [jnp.stack(columns)[(row + k) % 3, row] for k in (-1, 0, 1)]
    # Those around the ends, the corners of the matrix of a ring, are other entries.
    known = _Tridiagonal(*diagonals)(probe)
    unit = float(jnp.finfo(like.dtype).eps) ** 0.5 * sum(map(jnp.abs, diagonals))
    are_all = jnp.all(jnp.abs(product - known) <= unit)
    return _Tridiagonal(*(jnp.where(are_all, x, jnp.nan) for x in diagonals))


def solve(
    linear: LinearMap, b: Multipliers, solver: lx.AbstractLinearSolver | None
) -> Multipliers:
    """The solution of a linear system, by its matrix unless a solver is given; NaN if
    there is none."""
    if b.size == 0:
        return b
    matrix = as_matrix(linear, b, solver)
    if not isinstance(matrix, _AbstractMatrix):
        assert solver is not None
        return solve_linear(linear, b, solver)
    matrix = lax.stop_gradient(matrix)
    attempt = lambda _, b: matrix.solve(b)
    transposed = lambda _, b: matrix.transpose.solve(b)
    return lax.custom_linear_solve(linear, b, attempt, transposed)


def is_regular(
    linear: LinearMap, like: Multipliers, solver: lx.AbstractLinearSolver | None
) -> Bool[Array, ""]:
    """Whether the solution of a linear system is unique."""
    x = jnp.cos(jnp.arange(1, like.size + 1).astype(like.dtype))
    miss = solve(linear, linear(x), solver) - x
    return tree.largest(miss) <= float(jnp.finfo(like.dtype).eps) ** 0.25


def find_root(
    residual: LinearMap, like: Multipliers, solver: lx.AbstractLinearSolver | None
) -> tuple[Multipliers, Bool[Array, ""]]:
    """The root of a function by Newton's method from zero, and whether it was found.
    The derivatives are those of the implicit function.

    It was if the derivative of the function did not change over the last correction but
    one: relative to that, the error that the last leaves is the third power of half of
    the change. This has no scale, and holds where only rounding is left. As the change
    is small also of a function that is symmetric about the middle of that correction,
    what it left must be as small as this says, or not smaller, which is rounding.
    """

    def newton(residual: LinearMap, x: Multipliers):
        def more(state):
            _, found, count, *_ = state
            return ~found & (count < _MOST_STEPS)

        def improve(state):
            x, _, count, change, miss = state
            new, linear = jax.linearize(residual, x)
            linear = as_matrix(linear, x, solver)
            bend, before = tree.largest(linear(change) - miss), tree.largest(miss)
            limit, left = float(jnp.finfo(x.dtype).eps) ** (1 / 3), tree.largest(new)
            found = (left <= limit * before) | (left >= before / 8)
            found &= bend <= 2 * limit * before
            change = solve(linear, new, solver)
            return x - change, found, count + 1, change, new

        unknown = jnp.full_like(x, jnp.nan)
        start = x, jnp.array(False), jnp.zeros((), int), unknown, unknown
        x, found, *_ = lax.while_loop(more, improve, start)
        found &= jnp.all(jnp.isfinite(x))
        return x, found.astype(x.dtype)  # JAX 0.6 has no derivatives of other types.

    tangent = lambda linear, b: solve(linear, b, solver)
    x, found = lax.custom_root(residual, like, newton, tangent, has_aux=True)
    return x, found > 0
