import functools
import math

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from . import _tree as tree
from ._numbers import cast_to


class HermiteInterpolation(dfx.AbstractLocalInterpolation):
    """Hermite interpolation of a step, from values and derivatives at several points.

    Exact at both ends. From the two ends alone it is cubic, with an error of fourth
    order in the length of the step. Each point between them, where the solution is a
    shorter step of the scheme, adds two orders.
    """

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree
    # Derivatives, times the length of the step.
    k0: PyTree
    k1: PyTree
    # Values and derivatives at the points of `inner_points`, stacked.
    inner: tuple[PyTree, PyTree] | None = None

    def evaluate(self, t0, t1=None, left: bool = True) -> PyTree:
        del left
        if t1 is not None:
            return tree.sub(self.evaluate(t1), self.evaluate(t0))
        # A step of zero length, as in an empty solve, evaluates to its start.
        length = self.t1 - self.t0
        empty = length == 0
        s = jnp.where(empty, 0, (t0 - self.t0) / jnp.where(empty, 1, length))
        ends = self.y0, self.y1, self.k0, self.k1
        inner = () if self.inner is None else self.inner
        return jtu.tree_map(lambda *x: _hermite(cast_to(s, x[0]), *x), *ends, *inner)


HermiteInterpolation.__init__.__doc__ = "**Arguments:** its fields, if any."


@functools.cache
def inner_points(number: int) -> np.ndarray:
    """The points of a step, as fractions, of which Hermite interpolation uses values
    and derivatives besides the ends: the Lobatto points."""
    legendre = np.polynomial.legendre.Legendre.basis(number + 1)
    return np.sort((1 + legendre.deriv().roots().real) / 2)


def _hermite(s, y0, y1, k0, k1, inner=(), slopes=()):
    number = len(inner)
    points = [0.0, *inner_points(number).tolist(), 1.0]
    jump = y1 - y0
    y = (1 - s) * y0 + s * y1
    # The rest is zero at both ends, and is interpolated by squares of the Lagrange
    # polynomials.
    for i, c in enumerate(points):
        others = [d for d in points if d != c]
        lagrange = math.prod((s - d) / (c - d) for d in others) ** 2
        if i in (0, number + 1):
            y = y + (s - c) * lagrange * ((k1 if i else k0) - jump)
            continue
        value, slope = inner[i - 1], slopes[i - 1]
        rest = value - ((1 - c) * y0 + c * y1)
        steep = 2 * sum(1 / (c - d) for d in others)
        y = y + lagrange * (rest + (s - c) * (slope - jump - steep * rest))
    return y
