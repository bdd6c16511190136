from typing import Literal

import equinox as eqx
import optimistix as optx
from jaxtyping import PyTree

from .._term import State, View
from ._base import AbstractKickDriftSolver, first_failure
from ._euler import _ARGUMENTS


class PresymplecticLeapfrog(AbstractKickDriftSolver[PyTree]):
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

    def order(self, terms):
        return 2

    def start(self, view: View, t, y: State):
        # The force that ends a step starts the next only if it does not depend on `p`.
        if self.first == "momentum" and view.is_separable:
            return view.force(t, y)
        return None

    def advance(self, view: View, t0, t1, h, y: State, carry: PyTree):
        half = h / 2
        middle = t0 + half
        if self.first == "momentum":
            y, result0 = self.momentum_first(view, t0, half, y, carry)
            y, force, result1 = self.position_first(view, middle, half, y, t1)
            carry = force if view.is_separable else None
        else:
            y, force, result0 = self.position_first(view, t0, half, y, middle)
            force = force if view.is_separable else None
            y, result1 = self.momentum_first(view, middle, half, y, force)
        return y, carry, first_failure(result0, result1)

    def slope(self, view: View, t, y: State, carry: PyTree) -> State:
        return view.slope(t, y, force=carry)


PresymplecticLeapfrog.__init__.__doc__ = _ARGUMENTS
