"""What goes into a solve, and how far it has been run backwards."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, PyTree

from .._system import System
from ._saves import Saved


class Inputs(NamedTuple):
    """The inputs of a solve."""

    start: tuple[PyTree, PyTree]  # the state and the solver state
    parameters: tuple[System, list[Callable]]  # the system, and functions of `SaveAt`
    rest: dict[str, Any]  # inputs that are not differentiated
    run: Callable  # the loop


class Position(NamedTuple):
    """The state of the backward pass."""

    n: Array  # the number of steps left
    t: Array
    state: tuple[PyTree, PyTree]
    bar: tuple[PyTree, PyTree]  # the cotangents of the state
    gradient: PyTree  # the cotangents of the parameters so far
    left: list[Saved]
