"""Arrays held by Python functions, as leaves of a pytree."""

import functools
import inspect
from types import CellType, FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
from jaxtyping import PyTree


def closure_to_pytree(tree: PyTree) -> PyTree:
    """The same tree, with every array held by one of its functions as a leaf.

    Custom derivative rules need this. `equinox.filter_closure_convert` would need the
    arguments of each function. Supports closures, defaults, partial and bound
    arguments, and attributes, also within `jax.jit`, `jax.checkpoint` and other
    wrappers.
    """
    return jtu.tree_map(lambda x: _convert(x, ()) if callable(x) else x, tree)


class _Parts(eqx.Module):
    """A Python object as a pytree of its parts, from which it can be rebuilt."""

    kind: Any = eqx.field(static=True)
    original: Any = eqx.field(static=True)
    parts: PyTree

    def build(self):
        is_parts = lambda x: isinstance(x, _Parts)
        rebuilt = lambda x: x.build() if is_parts(x) else x
        parts = jtu.tree_map(rebuilt, self.parts, is_leaf=is_parts)
        return _BUILD[self.kind](self.original, parts)

    def __call__(self, *args, **kwargs):
        return self.build()(*args, **kwargs)


def _build_function(original: FunctionType, parts):
    cells, defaults, keywords, attributes = parts
    fn = FunctionType(
        original.__code__,
        original.__globals__,
        original.__name__,
        defaults,
        tuple(map(CellType, cells)),
    )
    fn.__kwdefaults__ = keywords
    fn.__dict__.update(attributes)
    return fn


def _build_object(original, parts):
    new = object.__new__(type(original))
    new.__dict__.update(parts)
    return new


_BUILD = {
    "function": _build_function,
    "object": _build_object,
    "partial": lambda _, parts: functools.partial(parts[0], *parts[1], **parts[2]),
    "method": lambda original, parts: MethodType(*parts),
}
_JITTED = type(jax.jit(lambda: None))
_PLAIN = (type, ModuleType, str, bytes, int, float, complex)


def _convert(x, within: tuple):
    # A solve is compiled anyway, so `jax.jit` can be removed.
    x = inspect.unwrap(x, stop=lambda x: not isinstance(x, _JITTED))
    # Objects that contain themselves would cause an infinite recursion.
    if any(x is y for y in within):
        return x
    taken = _take_apart(x)
    if taken is None:
        return x
    kind, parts = taken
    parts = jtu.tree_map(lambda leaf: _convert(leaf, (*within, x)), parts)
    # Functions compare by identity, so those without arrays are kept.
    found = any(map(eqx.is_array, jtu.tree_leaves(parts)))
    return _Parts(kind, x, parts) if found else x


def _take_apart(x) -> tuple[str, PyTree] | None:
    if isinstance(x, functools.partial):
        return "partial", (x.func, x.args, x.keywords)
    if isinstance(x, MethodType):
        return "method", (x.__func__, x.__self__)
    if isinstance(x, FunctionType):
        try:
            cells = [cell.cell_contents for cell in x.__closure__ or ()]
        except ValueError:  # empty cell
            return None
        return "function", (cells, x.__defaults__, x.__kwdefaults__, vars(x))
    if eqx.is_array_like(x) or isinstance(x, _PLAIN) or not hasattr(x, "__dict__"):
        return None
    return "object", dict(vars(x))
