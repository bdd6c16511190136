import diffrax as dfx
from jaxtyping import PyTree

from .._misc import all_finite
from .._term import NONFINITE, State, View
from ._base import AbstractPresymplecticSolver, first_failure


class Checked(AbstractPresymplecticSolver[PyTree]):
    """Any scheme, whose solve fails at the first step that is not finite.

    Order, cost per step and dense/ts output are those of the base. A potential that
    returns `nan`, a force that overflows, or a step beyond the limit of stability ends
    the solve with `RESULTS.nonfinite`, an error unless `throw=False`, instead of
    running on to its end with `nan`. Versions of Optimistix without
    this result say `nonlinear_divergence`.

    It is not the default as it is not free where a step is a few nanoseconds; around
    [`diffrax_presym.Substeps`][] it looks once in so many steps.
    """

    base: AbstractPresymplecticSolver

    def __init__(self, base: AbstractPresymplecticSolver):
        """**Arguments:**

        - `base`: any presymplectic solver.

        **Raises:**

        `ValueError` if it is not one.
        """
        if not isinstance(base, AbstractPresymplecticSolver):
            raise ValueError(
                "`base` must be a presymplectic solver, for example "
                f"`PresymplecticLeapfrog()`, but got {base!r}."
            )
        self.base = base

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric

    def order(self, terms):
        return self.base.order(terms)

    def start(self, view: View, t, y: State):
        return self.base.start(view, t, y)

    def advance(self, view: View, t0, t1, h, y: State, carry: PyTree):
        y, carry, result = self.base.advance(view, t0, t1, h, y, carry)
        finite = dfx.RESULTS.where(all_finite(y), dfx.RESULTS.successful, NONFINITE)
        return y, carry, first_failure(result, finite)

    def slope(self, view: View, t, y: State, carry: PyTree) -> State:
        return self.base.slope(view, t, y, carry)
