"""Equations that are solved by iteration, and their derivatives."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, Inexact, PyTree

from . import _tree as tree


@eqx.filter_custom_jvp
def implicit(equations: Any, guess: PyTree, *, find, tangent):
    """The root of `equations.residual` that `find(equations, guess)` returns, and its
    result, with the derivatives of the implicit function."""
    return find(equations, guess)


@implicit.def_jvp
def _implicit_jvp(primals, tangents, *, find, tangent):
    (equations, _), (changes, _) = primals, tangents
    root, result = implicit(*primals, find=find, tangent=tangent)
    is_none = lambda x: x is None
    moves = jtu.tree_map(lambda x: x is not None, changes, is_leaf=is_none)
    moving, fixed = eqx.partition(equations, moves)
    residual = lambda moving: eqx.combine(moving, fixed).residual(root)
    _, explicit = jax.jvp(residual, (moving,), (changes,))
    _, linear = jax.linearize(equations.residual, root)
    change = tangent(linear, tree.scale(-1, explicit))
    return (root, result), (change, jtu.tree_map(lambda _: None, result))


def lowest(x: PyTree):
    """The lowest precision of the leaves."""
    dtypes = [leaf.dtype for leaf in jtu.tree_leaves(x)]
    return max(dtypes, key=lambda dtype: float(jnp.finfo(dtype).eps))


def largest_change(x: PyTree, y: PyTree, dtype) -> Inexact[Array, ""]:
    """The largest difference, in units of rounding of the largest entry of a leaf."""

    def leaf(x, y):
        info = jnp.finfo(x.dtype)
        size = float(info.eps) * jnp.max(jnp.abs(x), initial=0)
        change = jnp.max(jnp.abs(x - y), initial=0)
        return (change / jnp.maximum(size, float(info.tiny))).astype(dtype)

    return jtu.tree_reduce(jnp.maximum, jtu.tree_map(leaf, x, y), jnp.zeros((), dtype))


def solve_linear(
    linear: Callable[[PyTree], PyTree],
    b: PyTree,
    solver: lx.AbstractLinearSolver,
    operator: Callable[..., lx.AbstractLinearOperator] = lx.FunctionLinearOperator,
    transposed: Callable[..., lx.AbstractLinearOperator] | None = None,
) -> PyTree:
    """The solution of a linear system by Lineax; NaN if there is none, in derivatives
    too, where Lineax itself would end all members of a batch.

    `operator(linear, structure)` is the system with what is known of its structure,
    `transposed` that of derivatives by reverse mode, if this differs.
    """

    def attempt(operator):
        def solve(linear, b):
            known = operator(linear, jax.eval_shape(lambda: b))
            found = lx.linear_solve(known, b, solver, throw=False)
            return tree.invalid_if(found.result != lx.RESULTS.successful, found.value)

        return solve

    both = attempt(operator), attempt(transposed or operator)
    return lax.custom_linear_solve(linear, b, *both)


def contract(g, y: PyTree) -> PyTree:
    """Solve a linear system of a residual by fixed-point iteration."""

    def solve(g, b):
        # x = x + g(x) - b
        def iterate(state):
            x, _, _, least, stalled, count = state
            new = tree.sub(tree.add(x, g(x)), b)
            change = largest_change(new, x, least.dtype)
            stalled = jnp.where(change < least, 0, stalled + 1)
            return new, change, state[1], jnp.minimum(change, least), stalled, count + 1

        def going(state):
            # A contraction that rotates may grow for some iterations.
            _, change, _, _, stalled, count = state
            return ~(change <= 1 / 8) & (stalled < 10) & (count < 200)

        many = jnp.asarray(jnp.inf, tree.largest(b).dtype)
        start = (tree.scale(-1, b), many, many, many, jnp.asarray(0), jnp.asarray(0))
        x, change, last, *_ = lax.while_loop(going, iterate, start)
        # Never numbers as if nothing had happened. Parts may change alternately.
        small = float(jnp.finfo(lowest(b)).eps) ** (-1 / 2)
        solved = (change <= 1 / 8) | (jnp.maximum(change, last) <= small)
        return jtu.tree_map(lambda x: jnp.where(solved, x, jnp.nan), x)

    # The transpose asserts that all leaves take part or none, in JAX 0.6 also after the
    # solve. Of a constraint that leaves a part of the state free some do not.
    def joined(x: PyTree) -> PyTree:
        total = tree.dot(x, tree.zeros(x))
        return jtu.tree_map(lambda x: x + total.astype(x.dtype), x)

    x = lax.custom_linear_solve(g, joined(y), solve, transpose_solve=solve)
    return joined(x)
