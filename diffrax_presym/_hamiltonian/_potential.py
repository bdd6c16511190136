import equinox as eqx
import lineax as lx
from jaxtyping import Array, Inexact, PyTree

from .._forms import as_form, multiply
from .._friction._base import Scalar, Time
from .._misc import tree_dot


_STIFFNESS = "`QuadraticPotential(stiffness)`"


class QuadraticPotential(eqx.Module):
    r"""The potential energy $V(q) = \tfrac12 \, q \cdot K q$ of linear springs.

    It tells solvers that the force is linear. Runge--Kutta--Nyström splittings then
    accept any kinetic energy, by swapping the roles of positions and momenta, and the
    force is one product with $K$.
    """

    stiffness: PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None

    def __init__(self, stiffness=None):
        """**Arguments:**

        - `stiffness`: the stiffness $K$, of any sign, in any of these forms. Defaults
            to `None`.
            - `None`: unit stiffness.
            - A number: the same stiffness for every degree of freedom.
            - An array with as many dimensions as `q`, and broadcastable to it: a
                stiffness for each degree of freedom.
            - A symmetric matrix, with `q` a vector.
            - A pytree of the structure of `q`, whose leaves are any of the above.
            - A symmetric `lineax.AbstractLinearOperator` acting on `q`'s space.

        **Raises:**

        `ValueError` if a stiffness is not a real number or array, or if its shape does
        not fit `q` (when the solve is traced).
        """
        self.stiffness = as_form(stiffness, _STIFFNESS, positive=False)

    def __call__(self, t: Time, q: PyTree, args: PyTree = None) -> Scalar:
        return tree_dot(q, self.gradient(q)) / 2

    def gradient(self, q: PyTree) -> PyTree:
        """The gradient $K q$, minus the force."""
        return multiply(self.stiffness, q, _STIFFNESS, "q")
