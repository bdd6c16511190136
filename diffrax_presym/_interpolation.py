import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from ._misc import cast_to


class HermiteInterpolation(dfx.AbstractLocalInterpolation):
    """Cubic Hermite interpolation of a step from its end values and end slopes.

    Third order, exact at both ends. `k0` and `k1` are the slopes times the length of
    the step. (Diffrax's own cannot subtract values that are pytrees.)
    """

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree
    k0: PyTree
    k1: PyTree

    def evaluate(self, t0, t1=None, left: bool = True) -> PyTree:
        del left
        if t1 is not None:
            start, end = self.evaluate(t0), self.evaluate(t1)
            return jtu.tree_map(lambda a, b: b - a, start, end)
        # A step of no length, as in an empty solve, is all start.
        length = self.t1 - self.t0
        s = jnp.where(
            length == 0, 0, (t0 - self.t0) / jnp.where(length == 0, 1, length)
        )

        def leaf(y0, y1, k0, k1):
            u = cast_to(s, y0)
            v = 1 - u
            bend = (v - u) * (y1 - y0) - v * k0 + u * k1
            return v * y0 + u * y1 - u * v * bend

        return jtu.tree_map(leaf, self.y0, self.y1, self.k0, self.k1)
