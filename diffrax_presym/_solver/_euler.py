from typing import Literal

import equinox as eqx
import optimistix as optx

from .._term import State, View
from ._base import AbstractKickDriftSolver


class PresymplecticEuler(AbstractKickDriftSolver[None]):
    """Presymplectic Euler's method.

    1st order. One force evaluation per step, explicit for separable Hamiltonians and
    implicit for any other. Uses 3rd order Hermite interpolation for dense/ts output.

    The cheapest step there is, and not symmetric: the two variants are adjoint to each
    other, a step of one undoes a step backwards of the other. For the same cost
    [`diffrax_presym.PresymplecticLeapfrog`][] is of second order; take that one unless
    it is this very map that is wanted, for example as an optimiser.

    Equations (presymp_euler) and (presymp_euler2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(static=True, default="momentum")
    root_finder: optx.AbstractRootFinder | None = None
    root_find_max_steps: int = eqx.field(static=True, default=32)

    @property
    def is_symmetric(self) -> bool:
        return False

    @property
    def reverse(self) -> "PresymplecticEuler":
        other = "position" if self.first == "momentum" else "momentum"
        return PresymplecticEuler(other, self.root_finder, self.root_find_max_steps)

    def order(self, terms):
        return 1

    def start(self, view: View, t, y: State):
        return None

    def advance(self, view: View, t0, t1, h, y: State, carry: None):
        if self.first == "momentum":
            y, result = self.momentum_first(view, t0, h, y)
        else:
            y, _, result = self.position_first(view, t0, h, y, t1)
        return y, None, result

    def slope(self, view: View, t, y: State, carry: None) -> State:
        return view.slope(t, y)


_ARGUMENTS = """**Arguments:**

- `first`: which half of the state moves first, `"momentum"` (the default) or
    `"position"`.
- `root_finder`: an Optimistix root finder, needed if the Hamiltonian is not separable
    and unused if it is. Its tolerances bound how well the structure is preserved.
    Defaults to `None`.
- `root_find_max_steps`: the most steps one root find may take. Defaults to 32.

**Raises:**

`ValueError` if `first` or `root_finder` is of the wrong kind, and when the solve is
traced, if the Hamiltonian is not separable and no root finder is given.
"""

PresymplecticEuler.__init__.__doc__ = _ARGUMENTS
