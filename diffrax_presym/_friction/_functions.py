"""Scalar functions for damping laws."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._misc import cast_to
from ._base import Numbers, Scalar, Time


def gauss_legendre(h: Time, order: int) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature from 0 to `h`, of at least the given order."""
    nodes, weights = np.polynomial.legendre.leggauss((order + 1) // 2)
    return cast_to((1 + nodes) / 2, h) * h, cast_to(weights / 2, h) * h


def quadrature(fn: Callable, h: Time, order: int) -> Numbers:
    """The integral of a function of time, from 0 to `h`, leaf by leaf."""
    nodes, weights = gauss_legendre(h, order)

    def integral(x):
        parts = jnp.expand_dims(weights, range(1, x.ndim)) * cast_to(x, h)
        return jnp.sum(parts, axis=0)

    return jtu.tree_map(integral, jax.vmap(fn)(nodes))


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


@jax.custom_jvp
def log_growth(h: Time, since: Time) -> Scalar:
    """The logarithm of `(since + h) / since`, or 1e30 if `since` is zero.

    Not infinity, whose product with zero is not a number.
    """
    return jnp.minimum(jnp.log1p(h / since), 1e30)


@log_growth.defjvp
def _log_growth_jvp(x, dx):
    (h, since), (dh, dsince) = x, dx
    singular = since == 0
    safe = jnp.where(singular, 1, since)
    slope = (dh - h / safe * dsince) / jnp.where(singular, 1, since + h)
    return log_growth(h, since), jnp.where(singular, 0, slope)


@jax.custom_jvp
def expm1_ratio(x: Scalar) -> Scalar:
    small = jnp.abs(x) < 0.1
    return jnp.where(small, _series(x), (jnp.exp(x) - 1) / jnp.where(small, 1, x))


@expm1_ratio.defjvp
def _expm1_ratio_jvp(x, dx):
    (x,), (dx,) = x, dx
    value, small = expm1_ratio(x), jnp.abs(x) < 0.1
    # Each branch is evaluated within its range: outside, it would overflow.
    near, far = jnp.where(small, x, 0), jnp.where(small, 1, x)
    return value, jnp.where(small, _series(near, 1), (jnp.exp(far) - value) / far) * dx


@jax.custom_jvp
def log1p_ratio(x: Scalar) -> Scalar:
    """`log(1 + x) / x`, and NaN for `x <= -1`."""
    zero = x == 0
    value = jnp.log1p(x) / jnp.where(zero, 1, x)
    return jnp.where(zero, 1, jnp.where(x > -1, value, jnp.nan))


@log1p_ratio.defjvp
def _log1p_ratio_jvp(x, dx):
    (x,), (dx,) = x, dx
    value, small = log1p_ratio(x), jnp.abs(x) < 0.05
    near, far = jnp.where(small, x, 0), jnp.where(small, 1, x)
    terms = [-((-1) ** k) * (k + 1) / (k + 2) for k in range(14)]
    return value, jnp.where(
        small, _horner(terms, near), (1 / (1 + far) - value) / far
    ) * dx


def _series(x: Scalar, derivative: int = 0) -> Scalar:
    """The series of the ratio, or of its derivative."""
    terms = [1 / math.factorial(k + 1) for k in range(10 + derivative)]
    for _ in range(derivative):
        terms = [k * c for k, c in enumerate(terms)][1:]
    return _horner(terms, x)


def _horner(terms: list[float], x: Scalar) -> Scalar:
    # `jnp.polyval` would be a loop.
    value = terms[-1]
    for c in terms[-2::-1]:
        value = value * x + c
    return jnp.asarray(value)
