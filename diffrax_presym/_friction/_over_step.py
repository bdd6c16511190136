"""Friction that depends on time over one step, by interpolation.

The stages of a step need its decays and their integrals over many spans. By quadrature
each of these evaluates the log scale at several times. But with `u(t)` the decay from
the start of the step, a decay over a span is a ratio of two values of `u`, and its
integral a difference of two of the integral of `u`: both are known from a few values.
"""

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact
from numpy.polynomial import chebyshev

from .._numbers import as_time, cast_to, Time
from ._exponential import expm1
from ._log_scale import Effect, increment, Terms


# Rounding of `float64` is reached where friction over a step is at most about two.
NODES = 12
_POINTS = (1 - np.cos(np.pi * np.arange(NODES) / (NODES - 1))) / 2
_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(2 * _POINTS - 1, NODES - 1))
_INTEGRALS = chebyshev.chebint(_COEFFICIENTS, lbnd=-1) / 2
# From values at the points: the polynomial, and its integral in units of the step.
_POLYNOMIALS = np.stack([np.pad(_COEFFICIENTS, ((0, 1), (0, 0))), _INTEGRALS], axis=1)


class DecayOverStep(eqx.Module):
    """The decay from the start of a step as polynomials, for spans within it."""

    start: Float[Array, ""]
    length: Float[Array, ""]
    # Chebyshev coefficients of the decay from the start, less one, and of its integral;
    # and of the inverse of the decay.
    decayed: Inexact[Array, "nodes 2 ..."]
    grown: Inexact[Array, "nodes 2 ..."]

    def __init__(self, terms: Terms, start: Time, length: Time):
        self.start, self.length = as_time(start), as_time(length)
        points = cast_to(_POINTS, self.length) * self.length
        lost = jax.vmap(lambda s: increment(terms, self.start, s))(points)
        fit = lambda x: jnp.tensordot(cast_to(_POLYNOMIALS, x), x, 1)
        self.decayed, self.grown = fit(expm1(-lost)), fit(expm1(lost))

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the polynomials are right to rounding: whether further coefficients
        are less, if they go on to fall as the last four do, in pairs."""
        # From a singularity on the decay is constant to rounding, its inverse huge.
        both = lax.stop_gradient((self.decayed, self.grown))
        size = jnp.maximum(*(jnp.abs(x[-5:-1, 0]) for x in both))
        eps = float(jnp.finfo(size.dtype).eps)
        first, last = jnp.max(size[:2], axis=0), jnp.max(size[2:], axis=0)
        return jnp.all((last < jnp.inf) & (last * last <= eps * (first + 4 * eps)))

    def effect(self, t: Time, h: Time) -> Effect:
        since = as_time(t) - self.start
        ends = since / self.length, (since + as_time(h)) / self.length
        at = lambda x: [_values(x, s) for s in ends]
        (first, begin), (last, end) = at(self.decayed)
        (_, before), (inverse, after) = at(self.grown)
        shape = lambda x: cast_to(x, first)
        h, length = shape(h), shape(self.length)
        carried = (h + length * (end - begin)) / (1 + first)
        responded = (h + length * (after - before)) / (1 + inverse)
        return Effect((last - first) / (1 + first), carried, responded)


def _values(coefficients: Array, s: Array) -> Array:
    """A polynomial at a part of the step, by the recursion of Clenshaw."""
    x = cast_to(2 * s - 1, coefficients)
    ahead = second = jnp.zeros_like(coefficients[0])
    for c in coefficients[:0:-1]:
        ahead, second = c + 2 * x * ahead - second, ahead
    return coefficients[0] + x * ahead - second
