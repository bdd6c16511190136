from typing import Generic, Literal, TYPE_CHECKING, TypeVar

import optimistix as optx

from .._misc import check_root_finder
from .._system import System
from ._base import AbstractMoveSolver
from ._engine import Stages
from ._moves import frozen_drift, frozen_kick, root_find, RootFind


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


_Carry = TypeVar("_Carry")


class AbstractFrozenSolver(AbstractMoveSolver[_Carry], Generic[_Carry]):
    """A scheme made of the two half-steps of the paper, which are adjoint to each
    other.

    Momentum first is a kick at `t`, then a drift to `t + h` with the velocity frozen at
    `t`: equation (presymp_euler), here A. Position first is a drift with the velocity
    frozen at `t + h`, then a kick there: equation (presymp_euler2), here B. Both are
    explicit for separable systems; for others their first move is implicit.
    """

    first: AbstractVar[Literal["momentum", "position"]]
    root_finder: AbstractVar[optx.AbstractRootFinder | None]
    root_find_max_steps: AbstractVar[int]

    def __check_init__(self):
        if self.first not in ("momentum", "position"):
            raise ValueError(
                f'`first` must be "momentum" or "position", but got {self.first!r}.'
            )
        if self.root_finder is not None:
            check_root_finder(self.root_finder)

    def momentum_first(self, system: System, known: bool = False) -> Stages:
        """A, where the force may be known. Its inverse is B, position first."""
        find = self._find(system)
        moves = frozen_kick(find, known), frozen_drift(find)
        return Stages(moves, [(0, 0, 1), (0, 1, 1)])

    def _find(self, system: System) -> RootFind:
        if self.root_finder is None and not system.is_separable:
            if system.split("any") is None:
                instead = (
                    "use `PresymplecticCoupled()`, which is explicit; or, if the "
                    "energy is a sum T(t, p) + V(t, q), give its parts: "
                    "`SeparableHamiltonian(kinetic, potential)` or "
                    "`ConformalHamiltonian(kinetic, potential, damping)`."
                )
            else:
                instead = "use `Strang()` or `BlanesMoan4()`, which are explicit."
            raise ValueError(
                f"This `{system.name}` is not separable, so `{type(self).__name__}` is "
                "implicit. Pass it a root finder, for example "
                "`root_finder=optimistix.Newton(rtol=1e-10, atol=1e-10)`; or " + instead
            )
        return root_find(self.root_finder, self.root_find_max_steps)
