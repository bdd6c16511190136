import abc

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ._misc import cast_to


class AbstractStepInterpolation(dfx.AbstractLocalInterpolation):
    """The interpolation of a step, as a function of the fraction of the step."""

    @abc.abstractmethod
    def at_fraction(self, s: Array) -> PyTree:
        """The value at a fraction from 0 to 1."""

    def evaluate(self, t0, t1=None, left: bool = True) -> PyTree:
        del left
        if t1 is not None:
            start, end = self.evaluate(t0), self.evaluate(t1)
            return jtu.tree_map(lambda a, b: b - a, start, end)
        # A step of zero length, as in an empty solve, evaluates to its start.
        length = self.t1 - self.t0
        empty = length == 0
        s = jnp.where(empty, 0, (t0 - self.t0) / jnp.where(empty, 1, length))
        return self.at_fraction(s)


class HermiteInterpolation(AbstractStepInterpolation):
    """Hermite interpolation of a step from values and derivatives at its two ends.

    Exact at both ends. Cubic from first derivatives, with an error of fourth order in
    the step; quintic if second derivatives are given too, with an error of sixth order.
    """

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree
    # First and second derivatives, times the step size and its square.
    k0: PyTree
    k1: PyTree
    b0: PyTree = None
    b1: PyTree = None

    def at_fraction(self, s: Array) -> PyTree:
        seconds = () if self.b0 is None else (self.b0, self.b1)
        ends = (self.y0, self.y1, self.k0, self.k1, *seconds)
        return jtu.tree_map(lambda *x: _hermite(cast_to(s, x[0]), *x), *ends)


def _hermite(s, y0, y1, k0, k1, b0=None, b1=None):
    r = 1 - s
    jump = y1 - y0
    y = r * y0 + s * y1 - s * r * ((r - s) * jump - r * k0 + s * k1)
    if b0 is None:
        return y
    # The errors of the second derivatives of the cubic.
    miss0 = b0 - (6 * jump - 4 * k0 - 2 * k1)
    miss1 = b1 - (2 * k0 + 4 * k1 - 6 * jump)
    return y + (s * r) ** 2 * (r * miss0 + s * miss1) / 2
