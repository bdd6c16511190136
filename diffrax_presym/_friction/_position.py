from collections.abc import Callable

from jaxtyping import PyTree

from .. import _tree as tree
from .._forms import multiply
from .._numbers import Time
from ._base import AbstractFriction, DAMPING, Local, Mechanics, Parts


class PositionDamping(AbstractFriction):
    r"""Friction $-\Gamma(t, q) \, p$ at a rate that depends on place: absorbing layers,
    media, contact with a fluid.

    For [`diffrax_presym.MechanicalSystem`][]. The friction is part of the kicks, which
    are exact at fixed positions: $p$ to $e^{-h \Gamma} p$ plus the momentum gained.
    [`diffrax_presym.Strang`][], [`diffrax_presym.BlanesMoan4`][] and
    [`diffrax_presym.BlanesMoan6`][] keep their order, and contract phase volume by the
    friction at the kicks. Runge--Kutta--Nyström splittings such as
    [`diffrax_presym.TunedRKN6`][] would not, and refuse it.

    The function is evaluated once per kick. A matrix is exponentiated in every kick.
    For friction per velocity write [`diffrax_presym.ViscousDamping`][] with a function.
    Where the rate does not depend on place [`diffrax_presym.ConstantDamping`][] is more
    efficient.
    """

    rate: Callable

    def __init__(self, rate: Callable):
        r"""**Arguments:**

        - `rate`: the rate $\Gamma$, in units of one over time, a function
            `rate(t, q, args)` that returns a number; an array with as many dimensions
            as `p` that broadcasts to it, a rate for each degree of freedom; a square
            matrix, with `p` a vector; or a pytree of the structure of `p` of these.

        **Raises:**

        `ValueError` if it is not a function, and when the solve is traced if it returns
        values of the wrong shape.
        """
        if not callable(rate):
            raise ValueError(
                "`PositionDamping(rate)` must be a function `rate(t, q, args)`, but "
                f"got {rate!r}. For a rate that does not depend on place write "
                "`ConstantDamping(rate)`."
            )
        self.rate = rate

    def parts(self, mechanics: Mechanics) -> Parts:
        return Parts(local=(Local(self.rate),))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        rate = self.rate(t, q, args)
        return tree.scale(-1, multiply(rate, p, DAMPING, "p"))
