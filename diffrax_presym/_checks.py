"""Checks of what users give, with errors that say what to write instead."""

import inspect

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Inexact, PyTree

from ._numbers import cast_to


def as_parameter(x, name: str, instead: str = "") -> Inexact[Array, "..."]:
    """A user's number as a leaf for `jax.grad` and `eqx.filter_grad`."""
    if not eqx.is_array_like(x):
        if isinstance(x, list | tuple):
            raise ValueError(
                f"{name} must be an array, but got a {type(x).__name__}. Write "
                "`jnp.array(...)`."
            )
        raise ValueError(f"{name} must be a real number, but got {x!r}.{instead}")
    if jnp.issubdtype(jnp.result_type(x), jnp.complexfloating):
        raise ValueError(f"{name} must be real, but got {x!r}.")
    if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
        x = jnp.asarray(x, jnp.result_type(float))
    return jnp.asarray(x)


def as_finite(x, name: str, instead: str = "") -> Inexact[Array, "..."]:
    """As `as_parameter`, and checked to be finite unless it is traced."""
    parameter = as_parameter(x, name, instead)
    # Under `jax.jit` a parameter is traced, but not what it was made of.
    if not isinstance(x, Tracer) and not np.all(good := np.isfinite(np.asarray(x))):
        raise ValueError(f"{name} must be finite, but got {_not_good(x, good)}.")
    return parameter


def as_positive(x, name: str, instead: str = "") -> Inexact[Array, "..."]:
    """As `as_parameter`, and checked to be positive unless it is traced."""
    parameter = as_parameter(x, name)
    if not isinstance(x, Tracer) and not np.all(good := np.asarray(x) > 0):
        got = _not_good(x, good)
        raise ValueError(f"{name} must be positive, but got {got}.{instead}")
    return parameter


def _not_good(x, good: np.ndarray) -> str:
    """What is not good, of a long array the first of it."""
    if good.size <= 9:
        return str(x)
    place = tuple(map(int, np.argwhere(~good)[0]))
    index = str(place[0]) if good.ndim == 1 else str(place)
    return f"{np.asarray(x)[place]} at the index {index}"


def check_callable(
    fn, name: str, signature: str, optional: bool = False, instead: str = ""
) -> None:
    """An error unless `fn` is a function that takes the arguments of `signature`."""
    if optional and fn is None:
        return
    wanted = f"`{name}` must be a function `{signature}`, but got"
    if not callable(fn):
        raise ValueError(f"{wanted} {fn!r}.{instead}")
    if isinstance(fn, type):
        name = fn.__name__
        raise ValueError(f"{wanted} the class `{name}`. Write `{name}(...)`.")
    try:
        parameters = inspect.signature(fn)
    except (TypeError, ValueError):  # of a builtin, say
        return
    expected = signature[:-1].partition("(")[2].split(", ")
    positions = {
        name: i
        for i, (name, x) in enumerate(parameters.parameters.items())
        if x.kind is x.POSITIONAL_OR_KEYWORD
    }
    ordered = all(positions.get(name, i) == i for i, name in enumerate(expected))
    try:
        parameters.bind(*expected)
    except TypeError:
        ordered = False
    if not ordered:
        raise ValueError(f"{wanted} one of the arguments {parameters}.{instead}")


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
    if isinstance(root_finder, optx.Bisection):
        raise ValueError(
            "`root_finder` solves for many numbers at once, but `optimistix.Bisection` "
            "is for one. Write for example `optimistix.Newton(rtol=1e-10, atol=1e-10)`."
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
    """A user's velocity or force, cast to the leaves of the state. It must have their
    shapes: one that broadcasts to these may be meant for some entries alone."""
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
        if jnp.shape(v) == jnp.shape(x):
            return cast_to(v, x)
        raise ValueError(
            f"{name} must return arrays of the shapes of {like_name}, but returned "
            f"shape {jnp.shape(v)} for a leaf of shape {jnp.shape(x)}. If one value is "
            "meant for all entries, write `jnp.full_like`."
        )

    return jtu.tree_map(leaf, value, like)
