import equinox as eqx
import optimistix as optx

from .._misc import check_root_finder, tree_scale
from .._split import State
from .._system import System
from ._base import AbstractMoveSolver
from ._engine import Move, Moves, Outcome, Span, Stage
from ._moves import root_find


class PresymplecticMidpoint(AbstractMoveSolver[None]):
    """The implicit midpoint rule, in the frame at the middle of the step.

    2nd order and symmetric. Implicit for every Hamiltonian: one root find per step, for
    the whole state. Uses 3rd order Hermite interpolation for dense/ts output, at the
    cost of two more evaluations of velocity and force.

    For Hamiltonians that are stiff, or nonseparable and not smooth enough for long
    explicit steps. Also preserves quadratic invariants, such as angular momentum.

    ??? cite "Reference"

        ```bibtex
        @book{hairer2006geometric,
            author={Hairer, Ernst and Lubich, Christian and Wanner, Gerhard},
            title={Geometric Numerical Integration},
            edition={2},
            publisher={Springer},
            year={2006},
        }
        ```
    """

    root_finder: optx.AbstractRootFinder
    root_find_max_steps: int = eqx.field(static=True, default=32)

    def __check_init__(self):
        check_root_finder(self.root_finder)

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return 2

    def moves(self, system: System) -> Moves:
        find = root_find(self.root_finder, self.root_find_max_steps)

        def step(system: System, span: Span, stage: Stage) -> Outcome:
            (q, p), carry = stage
            half = span.h / 2
            middle = span.t0 + half
            y = q, system.move_frame(span.t0, half, p)

            def field(dy: State) -> State:
                inside = system.add(y, 1, dy)
                return system.velocity(middle, inside), system.force(middle, inside)

            dy, result = find(lambda dy: tree_scale(half, field(dy)), system.zeros(y))
            q, p = system.add(y, 2, dy)
            return ((q, system.move_frame(middle, half, p)), carry), result

        return Move(step, step, is_step=True)


PresymplecticMidpoint.__init__.__doc__ = """**Arguments:**

- `root_finder`: an Optimistix root finder, for example
    `optimistix.Newton(rtol=1e-10, atol=1e-10)`. Its tolerances limit how well the
    structure is preserved.
- `root_find_max_steps`: the maximum number of steps of a root find. Defaults to 32.

**Raises:**

`ValueError` if `root_finder` is invalid. The solve fails if a root find fails.
"""
