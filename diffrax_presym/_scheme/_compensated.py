import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .. import _tree as tree
from .._numbers import State
from .._system._base import AbstractSystem
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, check_base, Scheme
from ._moves import ToSums


class Compensated(AbstractPresymplecticSolver):
    """Any scheme, with compensated summation.

    Order, structure, evaluations per step and dense/ts output are those of the base.
    Each kick and each drift adds a small number to a large one. The rounding error is
    kept in the `solver_state` and added to the next increment, so that the remaining
    error is smaller by about a factor of the step size.

    For very many steps without damping, especially in `float32`. Not for strong
    friction, which damps rounding errors anyway, nor for `PresymplecticGauss`, which
    sums so by itself and stays as it is.

    ??? cite "Reference"

        Section VIII.5 of Hairer, Lubich and Wanner (2006), see `PresymplecticGauss`,
        after

        ```bibtex
        @article{moller1965quasi,
            author={M{\\o}ller, Ole},
            title={Quasi double-precision in floating point addition},
            journal={BIT Numerical Mathematics}, volume={5}, pages={37--50},
            year={1965}}
        ```
    """

    base: AbstractPresymplecticSolver

    def __init__(self, base: AbstractPresymplecticSolver):
        """**Arguments:**

        - `base`: any presymplectic solver.

        **Raises:**

        `ValueError` if it is not one, or is compensated itself; and when the solve is
        traced, if the system updates its states otherwise than by sums.
        """
        check_base(base)
        inner = base
        while inner is not None:
            if isinstance(inner, Compensated):
                raise ValueError(
                    f"`Compensated(base)` takes a scheme that is not compensated, but "
                    f"got {base!r}. Remove one of the two."
                )
            inner = getattr(inner, "base", None)
        self.base = base

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric

    def order(self, terms) -> int:
        return self.base.order(terms)

    def scheme(self, system: System) -> Scheme:
        if type(system.term).add is not AbstractSystem.add:
            raise ValueError(
                f"`Compensated` sums states, but this `{system.name}` updates them by "
                "an `add` of its own. Use the scheme without it."
            )
        base = self.base.scheme(system)

        def start(system: System, t: Array, y: State) -> PyTree:
            lost = tree.zeros(y)
            return base.start(system, t, jtu.tree_map(tree.Sum, y, lost)), lost

        def at_kink(system: System, t: Array, y: State, carry: PyTree) -> PyTree:
            assert base.at_kink is not None
            return base.at_kink(system, t, y, carry[0]), carry[1]

        inner = base.check
        check = inner and (lambda system, t, y, x: inner(system, t, y, x[0]))
        return base._replace(
            inner=base.moves,
            ends=ToSums(),
            start=start,
            at_kink=base.at_kink and at_kink,
            end_force=lambda carry: base.end_force(carry[0]),
            check=check,
        )
