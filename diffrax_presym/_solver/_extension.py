import abc
from collections.abc import Callable
from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._cost import nanoseconds
from .._misc import cast_to
from .._scan import cheap_iterations
from .._split import State
from .._system import System
from ._engine import Span


# What an extension costs besides evaluations, in nanoseconds, as measured.
_OVERHEAD = 15e3


def pays(step: int, extension: int, evaluate: Callable, *args) -> bool:
    """Whether an extension is faster than a shorter step for each saved time.

    `step` and `extension` are their numbers of evaluations. Shorter steps are for all
    times at once, and take little more than these. How many times there are in a step
    is not known: two are assumed. On a GPU, where a loop over steps costs more than
    evaluations, it was not measured.
    """
    saved = 2 * step - extension
    return cheap_iterations() and saved * nanoseconds(evaluate, *args) >= _OVERHEAD


class AbstractExtension(abc.ABC):
    """The continuous extension of a scheme: the solution within a step."""

    def recording(self, y: State, carry: PyTree) -> PyTree:
        """The solver state with which a step records what the extension needs."""
        return carry

    @abc.abstractmethod
    def recorded(self, y: State, carry: PyTree) -> tuple[PyTree, PyTree]:
        """The solver state at the end of such a step, and what it recorded."""

    @abc.abstractmethod
    def segment(self, system: System, span: Span, y: State, record: PyTree) -> Any:
        """The solution within a step from `y`."""

    @abc.abstractmethod
    def at(self, system: System, span: Span, segment: Any, t: Array) -> State:
        """The state at a time in a step, not at its start, where friction may be
        infinite."""


def fraction(span: Span, t: Array) -> Array:
    """The fraction of a step at a time."""
    length = span.t1 - span.t0
    # A step of zero length has no fractions.
    empty = length == 0
    return jnp.where(empty, 0, (t - span.t0) / jnp.where(empty, 1, length))


def blend(s: Array) -> Array:
    """From zero to one, and flat at both."""
    return s * s * (3 - 2 * s)


def combine(weights: Array | np.ndarray, rows: PyTree) -> PyTree:
    """The sums of rows with each row of weights."""
    precision = lax.Precision.HIGHEST

    def leaf(x: Array) -> Array:
        return jnp.tensordot(cast_to(weights, x), x, axes=1, precision=precision)

    return jtu.tree_map(leaf, rows)
