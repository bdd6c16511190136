from typing import Generic, TYPE_CHECKING, TypeVar

from jaxtyping import Array, PyTree

from .._split import State
from .._system import System
from ._base import AbstractMoveSolver, AbstractPresymplecticSolver


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


_Carry = TypeVar("_Carry")


class AbstractWrapper(AbstractMoveSolver[_Carry], Generic[_Carry]):
    """A scheme that wraps another one and shares its properties."""

    base: AbstractVar[AbstractPresymplecticSolver]

    def __check_init__(self):
        if not isinstance(self.base, AbstractPresymplecticSolver):
            raise ValueError(
                "`base` must be a presymplectic solver, for example "
                f"`PresymplecticLeapfrog()`, but got {self.base!r}."
            )

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric

    @property
    def reverse(self) -> AbstractPresymplecticSolver[_Carry] | None:
        return None if self.base.reverse is None else super().reverse

    def order(self, terms) -> int:
        return self.base.order(terms)

    def start(self, system: System, t: Array, y: State) -> PyTree:
        return self.base.start(system, t, y)

    def slope(self, system: System, t: Array, y: State, carry: PyTree) -> State:
        return self.base.slope(system, t, y, carry)

    def step_length(self, t0: Array, t1: Array) -> Array:
        return self.base.step_length(t0, t1)

    def composition_error(self) -> str | None:
        return self.base.composition_error()

    def distance(self, y: State, solver_state: PyTree) -> Array:
        return self.base.distance(y, solver_state)
