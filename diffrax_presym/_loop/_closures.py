"""Arrays held by Python functions, as leaves of a pytree."""

import inspect
from types import CellType, FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
from jaxtyping import PyTree


def closure_to_pytree(tree: PyTree) -> PyTree:
    """The same tree, with every array that one of its functions closes over as a leaf.

    Custom derivative rules need this. Of what is not a function, such as a partial or
    an object with attributes, write an `equinox.Module`.
    """
    return jtu.tree_map(_convert, tree)


class _Closure(eqx.Module):
    """A function, and what it closes over, from which it can be rebuilt."""

    original: Any = eqx.field(static=True)
    cells: list[PyTree]
    defaults: tuple[PyTree, ...] | None

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
        fn.__kwdefaults__ = self.original.__kwdefaults__
        return fn(*args, **kwargs)

    @property
    def function(self):
        # A plain function, as that in the closure of another one was.
        return lambda *args, **kwargs: self(*args, **kwargs)


_JITTED = type(jax.jit(lambda: None))


def _convert(x):
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
    cells = [closure_to_pytree(cell) for cell in cells]
    defaults = None if fn.__defaults__ is None else closure_to_pytree(fn.__defaults__)
    # Functions compare by identity, so those without arrays are kept.
    if not any(map(eqx.is_array, jtu.tree_leaves((cells, defaults)))):
        return x
    return _Closure(fn, cells, defaults)
