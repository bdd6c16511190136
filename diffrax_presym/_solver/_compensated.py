import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact, PyTree

from .._misc import as_positive, cast_to, Sum
from .._split import State
from .._system import System
from ._base import AbstractPresymplecticSolver, AbstractWrapper
from ._engine import Moves, Stages
from ._moves import to_sums


class Compensated(AbstractWrapper[PyTree]):
    """Any scheme, with compensated summation.

    Order, structure, evaluations per step and dense/ts output are those of the base.
    Each kick and each drift adds a small number to a large one. The rounding error is
    kept in the `solver_state` and added to the next increment, so that the remaining
    error is smaller by about a factor of the step size.

    For very many steps without damping, especially in `float32`. Not for strong
    friction, which damps rounding errors anyway, nor for implicit schemes whose root
    finder is less accurate than rounding.

    ??? cite "Reference"

        Section VIII.5 of Hairer, Lubich and Wanner (2006), see
        [`diffrax_presym.PresymplecticMidpoint`][], after

        ```bibtex
        @article{moller1965quasi,
            author={M{\\o}ller, Ole},
            title={Quasi double-precision in floating point addition},
            journal={BIT Numerical Mathematics},
            volume={5},
            pages={37--50},
            year={1965},
        }
        ```
    """

    base: AbstractPresymplecticSolver
    length: Inexact[Array, ""] | None

    def __init__(self, base: AbstractPresymplecticSolver, length=None):
        """**Arguments:**

        - `base`: any presymplectic solver.
        - `length`: the step size, if it is constant: the `dt0` of the solve. It
            replaces the difference of two times where the two agree to the rounding of
            the times. In `float32` this matters as much as the rest: at a time of 1e4,
            steps of 0.01 vary by a tenth. Defaults to `None`, the difference.

        **Raises:**

        `ValueError` if `base` is not a presymplectic solver or `length` is known not to
        be positive.
        """
        self.base = base
        self.length = (
            None if length is None else as_positive(length, "`Compensated(length=...)`")
        )

    def step_length(self, t0: Array, t1: Array) -> Array:
        h = t1 - t0
        if self.length is None:
            return h
        length = jnp.copysign(cast_to(self.length, h), h)
        ulp = jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        # Steps of another length, for example halved ones, must not be replaced.
        nominal = (jnp.abs(h - length) <= 2 * ulp) & (jnp.abs(length) > 8 * ulp)
        return jnp.where(nominal, length, h)

    def start(self, system: System, t: Array, y: State) -> PyTree:
        lost = jtu.tree_map(jnp.zeros_like, y)
        return self.base.start(system, t, jtu.tree_map(Sum, y, lost)), lost

    def moves(self, system: System) -> Moves:
        moves = to_sums, self.base.moves(system), to_sums.inverse
        return Stages(moves, [(0, 0, 0), (0, 1, 1), (1, 1, 0)])

    def undoable(self, start: PyTree, end: PyTree) -> Array | None:
        return self.base.undoable(start[0], end[0])

    def slope(self, system: System, t: Array, y: State, carry: PyTree) -> State:
        return self.base.slope(system, t, y, carry[0])
