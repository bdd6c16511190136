"""Scalar functions for damping laws."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._misc import cast_to
from ._base import Scalar, Time


def gauss_legendre(h: Time, order: int) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature from 0 to `h`, of at least the given order."""
    nodes, weights = np.polynomial.legendre.leggauss((order + 1) // 2)
    return cast_to((1 + nodes) / 2, h) * h, cast_to(weights / 2, h) * h


def quadrature(fn: Callable, h: Time, order: int) -> Scalar:
    """The integral of a scalar function of time, from 0 to `h`."""
    nodes, weights = gauss_legendre(h, order)
    return jnp.sum(weights * cast_to(jax.vmap(fn)(nodes), h))


# exp(x) - 1 and its ratio to x, accurate to rounding near zero, with derivatives. XLA's
# own expm1 takes longer than the rest of a leapfrog step of one unknown.


@jax.custom_jvp
def expm1(x: Scalar) -> Scalar:
    return jnp.where(jnp.abs(x) < 0.1, x * _series(x), jnp.exp(x) - 1)


@expm1.defjvp
def _expm1_jvp(x, dx):
    # Much shorter than the derivative of the series.
    value = expm1(*x)
    return value, (value + 1) * dx[0]


def expm1_ratio(x: Scalar) -> Scalar:
    small = jnp.abs(x) < 0.1
    # Each branch is evaluated within its range: outside, derivatives would overflow.
    near, far = jnp.where(small, x, 0), jnp.where(small, 1, x)
    return jnp.where(small, _series(near), (jnp.exp(far) - 1) / far)


def _series(x: Scalar) -> Scalar:
    # Horner's rule; `jnp.polyval` would be a loop.
    value = 1 / math.factorial(10)
    for k in range(9, 0, -1):
        value = value * x + 1 / math.factorial(k)
    return jnp.asarray(value)
