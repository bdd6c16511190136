"""The multipliers of constraints: linear systems, and Newton's method."""

from collections.abc import Callable

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


def solve(
    linear: LinearMap, b: Multipliers, solver: lx.AbstractLinearSolver | None
) -> Multipliers:
    """The solution of a linear system, by its matrix unless a solver is given; NaN if
    there is none."""
    operator = lambda linear, like: _operator(linear, like, solver)
    return solve_linear(linear, b, lx.LU() if solver is None else solver, operator)


def _operator(
    linear: LinearMap,
    like: jax.ShapeDtypeStruct,
    solver: lx.AbstractLinearSolver | None,
) -> lx.AbstractLinearOperator:
    if isinstance(solver, lx.Tridiagonal):
        # Each row couples three neighbours, so three products show all entries.
        row = jnp.arange(like.size)
        products = jax.vmap(lambda k: linear((row % 3 == k).astype(like.dtype)))
        columns = products(jnp.arange(3))
        lower, diagonal, upper = (columns[(row + k) % 3, row] for k in (-1, 0, 1))
        return lx.TridiagonalLinearOperator(diagonal, lower[1:], upper[:-1])
    if solver is None:
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(like.size, dtype=like.dtype))
        return lx.MatrixLinearOperator(matrix)
    return lx.FunctionLinearOperator(linear, like)


def is_regular(
    linear: LinearMap, like: Multipliers, solver: lx.AbstractLinearSolver | None
) -> Bool[Array, ""]:
    """Whether the solution of a linear system is unique."""
    x = jnp.cos(jnp.arange(1, like.size + 1).astype(like.dtype))
    miss = solve(linear, linear(x), solver) - x
    return tree.largest(miss) <= float(jnp.finfo(like.dtype).eps) ** 0.25


def find_root(
    residual: LinearMap,
    like: Multipliers,
    is_small: Callable[[Multipliers], Bool[Array, ""]],
    solver: lx.AbstractLinearSolver | None,
) -> tuple[Multipliers, Bool[Array, ""]]:
    """The root of a function by Newton's method from zero, and whether it was found:
    whether a correction became small, so that the error is its square. The derivatives
    are those of the implicit function."""

    def newton(residual: LinearMap, x: Multipliers):
        def more(state):
            _, found, count = state
            return ~found & (count < _MOST_STEPS)

        def improve(state):
            x, _, count = state
            miss, linear = jax.linearize(residual, x)
            change = solve(linear, miss, solver)
            return x - change, is_small(change), count + 1

        start = x, jnp.array(False), jnp.zeros((), int)
        x, found, _ = lax.while_loop(more, improve, start)
        return x, found

    tangent = lambda linear, b: solve(linear, b, solver)
    return lax.custom_root(residual, like, newton, tangent, has_aux=True)
