from typing import Literal

import equinox as eqx
import optimistix as optx

from .._system import System
from ._engine import Moves
from ._frozen import AbstractFrozenSolver


class PresymplecticEuler(AbstractFrozenSolver[None]):
    """Presymplectic Euler's method.

    1st order. One force evaluation per step, explicit for separable Hamiltonians and
    implicit for any other. Uses 3rd order Hermite interpolation for dense/ts output.

    The cheapest scheme. Not symmetric: the two variants are adjoint to each other.
    [`diffrax_presym.PresymplecticLeapfrog`][] has second order at the same cost; use
    Euler only where this map itself is wanted, for example as an optimiser.

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

    def order(self, terms) -> int:
        return 1

    def moves(self, system: System) -> Moves:
        momentum_first = self.momentum_first(system)
        return momentum_first if self.first == "momentum" else momentum_first.inverse


_ARGUMENTS = """**Arguments:**

- `first`: what is updated first, `"momentum"` (the default) or `"position"`.
- `root_finder`: an Optimistix root finder, used only if the Hamiltonian is not
    separable, and then required. Its tolerances limit how well the structure is
    preserved. Defaults to `None`.
- `root_find_max_steps`: the maximum number of steps of a root find. Defaults to 32.

**Raises:**

`ValueError` if `first` or `root_finder` is invalid; and when the solve is traced, if
the Hamiltonian is not separable and no root finder is given.
"""

PresymplecticEuler.__init__.__doc__ = _ARGUMENTS
