"""Arithmetic of states, each leaf in its own precision."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, PyTree, Shaped

from ._numbers import cast_to


class Sum(eqx.Module):
    """A number with compensated summation, equal to `value + lost`.

    `lost` is the rounding error of the additions so far.
    """

    value: Array
    lost: Array

    def __add__(self, x: Array) -> "Sum":
        # Exact, whichever of the two is larger (Møller, Knuth).
        x = x + self.lost
        value = self.value + x
        taken = value - self.value
        return Sum(value, (self.value - (value - taken)) + (x - taken))

    def __sub__(self, other: "Sum") -> Array:
        return (self.value - other.value) + (self.lost - other.lost)


_T = TypeVar("_T")
is_sum = lambda x: isinstance(x, Sum)


def values(x: _T) -> _T:
    """The arrays of a state, without the errors kept by compensated summation."""
    return jtu.tree_map(lambda x: x.value if is_sum(x) else x, x, is_leaf=is_sum)


def rounding_errors(x: PyTree) -> PyTree:
    """The rounding errors of a state whose leaves are `Sum`s."""
    return jtu.tree_map(lambda x: x.lost, x, is_leaf=is_sum)


def to_sums(y: PyTree, lost: PyTree) -> PyTree:
    """A state with compensated summation; one that has it already stays as it is."""
    leaf = lambda x, lost: x if is_sum(x) else Sum(x, lost)
    return jtu.tree_map(leaf, y, lost, is_leaf=is_sum)


def from_sums(sums: PyTree, like: PyTree) -> PyTree:
    """The inverse of `to_sums`, for a state `like` the one that was given."""
    leaf = lambda x, new: new if is_sum(x) else new.value
    return jtu.tree_map(leaf, like, sums, is_leaf=is_sum)


def add_scaled(y: PyTree, h: ArrayLike, dy: PyTree) -> PyTree:
    """`y + h * dy`, each leaf in its own precision. Leaves of `y` may be `Sum`s."""
    add = lambda di, yi: yi + cast_to(h, di) * di
    return jtu.tree_map(add, dy, y)


def add(x: PyTree, y: PyTree) -> PyTree:
    """`x + y`. Leaves of `x` may be `Sum`s."""
    return jtu.tree_map(lambda yi, xi: xi + yi, y, x)


def sub(x: PyTree, y: PyTree) -> PyTree:
    """`x - y`, where both may have `Sum`s for leaves."""
    return jtu.tree_map(lambda xi, yi: xi - yi, x, y, is_leaf=is_sum)


def scale(c: ArrayLike, y: PyTree) -> PyTree:
    """`c * y`, each leaf in its own precision."""
    return jtu.tree_map(lambda yi: cast_to(c, yi) * yi, y)


@jax.custom_batching.custom_vmap
def largest_member(x: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """The largest among the members of a batch, the same for all of them."""
    return x


@largest_member.def_vmap
def _(axis_size, in_batched, x):
    return largest_member(jnp.max(x, axis=0)), False


def smallest_member(x: Shaped[Array, ""]) -> Shaped[Array, ""]:
    """The smallest among the members of a batch, the same for all of them."""
    return -largest_member(-x)


def any_member(x: Bool[Array, "..."]) -> Bool[Array, "..."]:
    """Whether it is true for any member of a batch, the same for all of them."""
    return largest_member(x)


def invalid_if(bad: Bool[Array, ""], y: PyTree) -> PyTree:
    """`y`, or NaN if it is `bad`: a product, so that its gradient is NaN too."""
    return scale(jnp.where(bad, jnp.nan, 1.0), y)


def all_batched(x: PyTree) -> PyTree:
    """`x`, whose numbers are all batched by `jax.vmap` if some are."""
    is_number = lambda y: eqx.is_inexact_array(y) and y.size > 0
    numbers = filter(is_number, jtu.tree_leaves(x))
    either = jnp.asarray(False)
    for y in numbers:
        either |= jnp.isnan(jnp.ravel(y)[0])
    return jtu.tree_map(lambda y: jnp.where(either, y, y) if is_number(y) else y, x)


def stop_gradient(x: PyTree) -> PyTree:
    arrays, other = eqx.partition(x, eqx.is_array)
    return eqx.combine(lax.stop_gradient(arrays), other)


def zeros(x: PyTree) -> PyTree:
    """Arrays of zeros like the leaves, which may be `Sum`s."""
    return jtu.tree_map(jnp.zeros_like, values(x))


def where(condition: Bool[ArrayLike, ""], x: PyTree, y: PyTree) -> PyTree:
    return jtu.tree_map(lambda xi, yi: jnp.where(condition, xi, yi), x, y)


def dot(x: PyTree, y: PyTree) -> Array:
    """The inner product of two pytrees of one structure."""
    dots = jtu.tree_map(lambda xi, yi: jnp.sum(xi * yi), x, y)
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.add, dots)


def largest(x: PyTree) -> Array:
    """The largest absolute value of all entries, NaN if one of them is."""

    def leaf(x):
        # XLA on a CPU drops NaN from the maxima of a thousand rows.
        bad = jnp.any(jnp.isnan(x))
        return jnp.where(bad, jnp.nan, jnp.max(jnp.abs(x), initial=0))

    sizes = jtu.tree_map(leaf, x)
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.maximum, sizes)


def all_finite(x: PyTree) -> Bool[Array, ""]:
    """Whether all entries of a pytree are finite."""
    finite = jtu.tree_map(lambda xi: jnp.all(jnp.isfinite(xi)), x)
    return jtu.tree_reduce(jnp.logical_and, finite, jnp.array(True))
