from typing import Literal

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, PyTree

from .._split import State
from .._system import System
from ._engine import Moves, Stages
from ._euler import _ARGUMENTS
from ._frozen import AbstractFrozenSolver


class PresymplecticLeapfrog(AbstractFrozenSolver[PyTree]):
    """The presymplectic leapfrog, also known as Störmer--Verlet.

    2nd order and symmetric. One force evaluation per step, explicit for separable
    Hamiltonians and implicit for any other. Uses 3rd order Hermite interpolation for
    dense/ts output.

    The default choice: no scheme of this cost is stable at longer steps. For more than
    a few digits, schemes of higher order are cheaper.

    With `first="momentum"` the last force of a step is reused by the next step and by
    dense output. With `first="position"` the error is often smaller, but dense output
    costs two more force evaluations per step.

    !!! warning

        With `first="momentum"` the `solver_state` is the force at the end of the last
        step. After an event the solution ends inside that step. To continue from there,
        pass only the state `y` (the default), or the `solver_state` with
        `made_jump=True`.

    Equations (presymp_leapfrog) and (presymp_leapfrog2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(static=True, default="momentum")
    root_finder: optx.AbstractRootFinder | None = None
    root_find_max_steps: int = eqx.field(static=True, default=32)

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return 2

    def start(self, system: System, t: Array, y: State) -> PyTree:
        # The last force of a step is reused only if it does not depend on `p`.
        if self.first == "momentum" and system.is_separable:
            return system.force(t, y)
        return None

    def moves(self, system: System) -> Moves:
        known = self.first == "momentum" and system.is_separable
        # In both directions the first kick is by the force known from the last one.
        A = self.momentum_first(system, known)
        B = A.inverse
        halves = [(0, 0.5, 0.5), (0.5, 1, 0.5)]
        if self.first == "momentum":
            return Stages([A, B], halves)
        if not system.is_separable:
            return Stages([B, A], halves)
        # Two kicks at the same position are merged.
        (kick, drift), (drift_end, _) = A.moves, B.moves
        table = [(0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5)]
        return Stages([drift_end, kick, drift], table)

    def slope(self, system: System, t: Array, y: State, carry: PyTree) -> State:
        return system.slope(t, y, force=carry)


PresymplecticLeapfrog.__init__.__doc__ = _ARGUMENTS
