from jaxtyping import PyTree

from .._system import System
from ._base import AbstractPresymplecticSolver, AbstractWrapper
from ._engine import Moves, Stages
from ._moves import check_finite


class Checked(AbstractWrapper[PyTree]):
    """Any scheme, with solves that fail at the first step that is not finite.

    Order, cost per step and dense/ts output are those of the base. A potential that
    returns `nan`, a force that overflows, or a step beyond the limit of stability ends
    the solve with `RESULTS.nonfinite`, an error unless `throw=False`, instead of
    continuing with `nan`.

    It is not the default because it has a cost where a step takes a few nanoseconds.
    Around [`diffrax_presym.Substeps`][] it checks once per `n` steps.
    """

    base: AbstractPresymplecticSolver

    def __init__(self, base: AbstractPresymplecticSolver):
        """**Arguments:**

        - `base`: any presymplectic solver.

        **Raises:**

        `ValueError` if it is not one.
        """
        self.base = base

    def moves(self, system: System) -> Moves:
        moves = self.base.moves(system), check_finite
        return Stages(moves, [(0, 1, 1), (1, 1, 0)])
