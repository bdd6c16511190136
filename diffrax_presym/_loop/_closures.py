"""Arrays held by Python functions, as leaves of a pytree."""

import functools
import inspect
from types import CellType, FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
from jaxtyping import PyTree


def closure_to_pytree(tree: PyTree) -> PyTree:
    """The same tree, with every array that one of its functions closes over as a leaf.

    Custom derivative rules need this. Of an object with attributes write an
    `equinox.Module`.
    """
    return jtu.tree_map(_convert, tree)


class _Closure(eqx.Module):
    """A function, and what it closes over, from which it can be rebuilt."""

    original: Any = eqx.field(static=True)
    cells: list[PyTree]
    defaults: tuple[PyTree, ...] | None
    keywords: dict[str, PyTree] | None

    def __call__(self, *args, **kwargs):
        rebuild = lambda x: x.function if isinstance(x, _Closure) else x
        is_leaf = lambda x: isinstance(x, _Closure)
        cells = jtu.tree_map(rebuild, self.cells, is_leaf=is_leaf)
        fn = FunctionType(
            self.original.__code__,
            self.original.__globals__,
            self.original.__name__,
            self.defaults,
            tuple(map(CellType, cells)),
        )
        fn.__kwdefaults__ = self.keywords
        return fn(*args, **kwargs)

    @property
    def function(self):
        # A plain function, as that in the closure of another one was.
        return lambda *args, **kwargs: self(*args, **kwargs)


_JITTED = type(jax.jit(lambda: None))


def _convert(x):
    if isinstance(x, functools.partial):
        fn, args, keywords = closure_to_pytree((x.func, x.args, x.keywords))
        return eqx.Partial(fn, *args, **keywords)
    # A solve is compiled anyway, so `jax.jit` can be removed.
    fn = (
        inspect.unwrap(x, stop=lambda x: not isinstance(x, _JITTED))
        if callable(x)
        else x
    )
    if not isinstance(fn, FunctionType):
        return x
    try:
        cells = [cell.cell_contents for cell in fn.__closure__ or ()]
    except ValueError:  # an empty cell
        return x
    if any(cell is fn for cell in cells):  # a recursive function
        return x
    held = closure_to_pytree((cells, fn.__defaults__, fn.__kwdefaults__))
    # Functions compare by identity, so those without arrays are kept.
    return _Closure(fn, *held) if any(map(eqx.is_array, jtu.tree_leaves(held))) else x
