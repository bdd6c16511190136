import inspect
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Inexact, PyTree, Real


Time = Real[ArrayLike, ""]
Scalar = Inexact[Array, ""]
# A state: positions and momenta.
State = tuple[PyTree[Inexact[Array, "..."]], PyTree[Inexact[Array, "..."]]]


def as_parameter(x, name: str) -> Inexact[Array, "..."]:
    """A user's number as a leaf for `jax.grad` and `eqx.filter_grad`."""
    if not eqx.is_array_like(x):
        raise ValueError(f"{name} must be a real number, but got {x!r}.")
    if jnp.issubdtype(jnp.result_type(x), jnp.complexfloating):
        raise ValueError(f"{name} must be real, but got {x!r}.")
    if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
        x = jnp.asarray(x, jnp.result_type(float))
    return jnp.asarray(x)


def as_finite(x, name: str) -> Inexact[Array, "..."]:
    """As `as_parameter`, and checked to be finite unless it is traced."""
    x = as_parameter(x, name)
    if not isinstance(x, Tracer) and not np.all(np.isfinite(np.asarray(x))):
        raise ValueError(f"{name} must be finite, but got {x}.")
    return x


def as_positive(x, name: str, instead: str = "") -> Inexact[Array, "..."]:
    """As `as_parameter`, and checked to be positive unless it is traced."""
    x = as_parameter(x, name)
    if not isinstance(x, Tracer) and not np.all(np.asarray(x) > 0):
        raise ValueError(f"{name} must be positive, but got {x}.{instead}")
    return x


def check_callable(fn, name: str, signature: str, optional: bool = False) -> None:
    """An error unless `fn` is a function that takes the arguments of `signature`."""
    if optional and fn is None:
        return
    if not callable(fn):
        raise ValueError(f"`{name}` must be a function `{signature}`, but got {fn!r}.")
    try:
        parameters = inspect.signature(fn)
    except (TypeError, ValueError):  # of a builtin, say
        return
    try:
        parameters.bind(*signature.split(","))
    except TypeError:
        raise ValueError(
            f"`{name}` must be a function `{signature}`, but got one of the arguments "
            f"{parameters}."
        ) from None


def cast_to(x: ArrayLike, like: ArrayLike) -> Array:
    """`x` in the precision of `like`: a parameter never upcasts time or state.

    An integer, such as a time of `10`, does not truncate it.
    """
    dtype = jnp.result_type(like)
    return jnp.asarray(x, dtype if jnp.issubdtype(dtype, jnp.inexact) else None)


def as_time(t: ArrayLike) -> Array:
    """A time as a floating-point array."""
    if jnp.issubdtype(jnp.result_type(t), jnp.inexact):
        return jnp.asarray(t)
    return jnp.asarray(t, jnp.result_type(float))


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


def tree_add(y: PyTree, h: ArrayLike, dy: PyTree) -> PyTree:
    """`y + h * dy`, each leaf in its own precision. Leaves of `y` may be `Sum`s."""
    add = lambda di, yi: yi + cast_to(h, di) * di
    return jtu.tree_map(add, dy, y)


def tree_sum(x: PyTree, y: PyTree) -> PyTree:
    """`x + y`. Leaves of `x` may be `Sum`s."""
    return jtu.tree_map(lambda yi, xi: xi + yi, y, x)


def tree_sub(x: PyTree, y: PyTree) -> PyTree:
    """`x - y`, where both may have `Sum`s for leaves."""
    return jtu.tree_map(lambda xi, yi: xi - yi, x, y, is_leaf=is_sum)


def tree_scale(c: ArrayLike | None, y: PyTree) -> PyTree:
    """`c * y`, each leaf in its own precision; `y` if `c` is `None`."""
    if c is None:
        return y
    return jtu.tree_map(lambda yi: cast_to(c, yi) * yi, y)


def tree_zeros(x: PyTree) -> PyTree:
    return jtu.tree_map(jnp.zeros_like, x)


def tree_where(condition: Bool[ArrayLike, ""], x: PyTree, y: PyTree) -> PyTree:
    return jtu.tree_map(lambda xi, yi: jnp.where(condition, xi, yi), x, y)


def tree_dot(x: PyTree, y: PyTree) -> Array:
    """The inner product of two pytrees of one structure."""
    dots = jtu.tree_map(lambda xi, yi: jnp.sum(xi * yi), x, y)
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.add, dots)


def largest(x: PyTree) -> Array:
    """The largest absolute value of all entries."""
    sizes = jtu.tree_map(lambda x: jnp.max(jnp.abs(x), initial=0), x)
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.maximum, sizes)


def all_finite(x: PyTree) -> Bool[Array, ""]:
    """Whether all entries of a pytree are finite."""
    finite = jtu.tree_map(lambda xi: jnp.all(jnp.isfinite(xi)), x)
    return jtu.tree_reduce(jnp.logical_and, finite, jnp.array(True))


def describe(tree: PyTree) -> str:
    """The precisions and shapes of the leaves of a pytree, for errors."""
    leaf = lambda x: f"{jnp.result_type(x)}{list(jnp.shape(x))}"
    return str(jtu.tree_map(leaf, tree)).replace("'", "")


def check_root_finder(root_finder) -> None:
    if not isinstance(root_finder, optx.AbstractRootFinder):
        raise ValueError(
            "`root_finder` must be an Optimistix root finder, for example "
            f"`optimistix.Newton(rtol=1e-10, atol=1e-10)`, but got {root_finder!r}."
        )
    # Diffrax's own root finders leave their tolerances to an adaptive controller.
    for name in ("rtol", "atol"):
        if not eqx.is_array_like(getattr(root_finder, name, 0.0)):
            raise ValueError(
                f"`root_finder` needs a tolerance `{name}`. Write for example "
                "`optimistix.Newton(rtol=1e-10, atol=1e-10)`."
            )


def scalar_fn(fn, name: str):
    """`fn`, with an error if it does not return a real scalar."""

    def checked(*args):
        out = fn(*args)
        leaves = jtu.tree_leaves(out)
        if len(leaves) != 1 or jnp.shape(leaves[0]) != ():
            instead = "Sum over the degrees of freedom, for example `jnp.sum(...)`."
        elif not jnp.issubdtype(jnp.result_type(leaves[0]), jnp.floating):
            instead = "Convert it to floating point, a complex number with `jnp.real`."
        else:
            return leaves[0]
        raise ValueError(
            f"{name} must return a real scalar for the whole system, but returned "
            f"{describe(out)}. {instead}"
        )

    return checked


def match(value: PyTree, like: PyTree, name: str, like_name: str) -> PyTree:
    """A user's velocity or force, broadcast and cast to the leaves of the state."""
    if jtu.tree_structure(value) != jtu.tree_structure(like):
        raise ValueError(
            f"{name} must return a pytree of the same structure as {like_name}, "
            f"{jtu.tree_structure(like)}, but returned {jtu.tree_structure(value)}."
        )

    def leaf(v, x):
        # A cast would drop the imaginary part.
        if jnp.issubdtype(jnp.result_type(v), jnp.complexfloating):
            raise ValueError(
                f"{name} must return real arrays, but returned {describe(v)}. Use "
                "`jnp.real` if the real part is meant."
            )
        try:
            return jnp.broadcast_to(cast_to(v, x), jnp.shape(x))
        except ValueError as e:
            raise ValueError(
                f"{name} must return arrays of the shapes of {like_name}, but returned "
                f"shape {jnp.shape(v)} for a leaf of shape {jnp.shape(x)}."
            ) from e

    return jtu.tree_map(leaf, value, like)
