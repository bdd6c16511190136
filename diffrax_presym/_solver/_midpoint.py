import diffrax as dfx
import equinox as eqx
import jax.tree_util as jtu
import optimistix as optx

from .._misc import check_root_finder, tree_add, tree_sub
from .._term import State, View
from ._base import AbstractPresymplecticSolver


class PresymplecticMidpoint(AbstractPresymplecticSolver[None]):
    """The implicit midpoint rule, in the frame of the middle of the step.

    2nd order and symmetric. Implicit for every Hamiltonian: one root find per step, for
    all of the state. Uses 3rd order Hermite interpolation for dense/ts output, at the
    cost of two more evaluations of velocity and force.

    For Hamiltonians that are stiff, or not separable and not smooth enough for long
    explicit steps. Preserves quadratic invariants, such as angular momentum, besides
    the structure.

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

    def order(self, terms):
        return 2

    def start(self, view: View, t, y: State) -> None:
        return None

    def advance(self, view: View, t0, t1, h, y: State, carry: None):
        half = h / 2
        middle = t0 + half
        q, p = y
        y = q, view.move_frame(t0, half, p)
        field = lambda y: (view.velocity(middle, y), view.force(middle, y))
        residual = lambda z, _: tree_sub(tree_add(y, half, field(z)), z)
        solution = optx.root_find(
            residual,
            self.root_finder,
            y,
            max_steps=self.root_find_max_steps,
            throw=False,
        )
        q, p = jtu.tree_map(lambda z, y: y + 2 * (z - y), solution.value, y)
        y = q, view.move_frame(middle, half, p)
        return y, None, dfx.RESULTS.promote(solution.result)

    def slope(self, view: View, t, y: State, carry: None) -> State:
        return view.slope(t, y)


PresymplecticMidpoint.__init__.__doc__ = """**Arguments:**

- `root_finder`: an Optimistix root finder, for example
    `optimistix.Newton(rtol=1e-10, atol=1e-10)`. Its tolerances bound how well the
    structure is preserved.
- `root_find_max_steps`: the most steps one root find may take. Defaults to 32.

**Raises:**

`ValueError` if `root_finder` is of the wrong kind. A root find that fails makes the
solve fail.
"""
