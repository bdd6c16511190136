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

    The workhorse: for its cost nothing is stable at longer steps. Where more than a few
    digits are wanted, a scheme of higher order gets there with less work.

    With `first="momentum"` a step ends with the force that starts the next one, which
    is carried along, so that dense output needs no evaluations of its own. With
    `first="position"` nothing is carried and the error is often smaller, but dense
    output evaluates the force twice more per step.

    !!! warning

        The force carried with `first="momentum"` is part of the `solver_state`, and
        belongs to the end of the last step. After an event the solution ends inside
        that step. To go on from there, pass the state `y` alone (the default), or
        `made_jump=True` along with the `solver_state`.

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
        # The force that ends a step starts the next only if it does not depend on `p`.
        if self.first == "momentum" and system.is_separable:
            return system.force(t, y)
        return None

    def moves(self, system: System) -> Moves:
        known = self.first == "momentum" and system.is_separable
        A, B = self.momentum_first(system, known), self.momentum_first(system).inverse
        halves = [(0, 0.5, 0.5), (0.5, 1, 0.5)]
        if self.first == "momentum":
            return Stages([A, B], halves)
        if not system.is_separable:
            return Stages([B, A], halves)
        # Two kicks at one place are one.
        (kick, drift), (drift_end, _) = A.moves, B.moves
        table = [(0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5)]
        return Stages([drift_end, kick, drift], table)

    def slope(self, system: System, t: Array, y: State, carry: PyTree) -> State:
        return system.slope(t, y, force=carry)


PresymplecticLeapfrog.__init__.__doc__ = _ARGUMENTS
