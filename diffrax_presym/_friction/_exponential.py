"""Exponentials of rates: of numbers, of matrices, and of products with vectors."""

import math
from collections.abc import Callable

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from .._misc import cast_to


Numbers = Inexact[Array, "..."]


def gauss_legendre(h: ArrayLike, order: int) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature from 0 to `h`, of at least the given order."""
    nodes, weights = np.polynomial.legendre.leggauss((order + 1) // 2)
    return cast_to((1 + nodes) / 2, h) * h, cast_to(weights / 2, h) * h


# exp(x) - 1 and its ratio to x, accurate to rounding near zero, with derivatives. XLA's
# own expm1 takes longer than the rest of a leapfrog step of one unknown.


@jax.custom_jvp
def expm1(x: Numbers) -> Numbers:
    return jnp.where(jnp.abs(x) < 0.1, x * _series(x), jnp.exp(x) - 1)


@expm1.defjvp
def _expm1_jvp(x, dx):
    # Much shorter than the derivative of the series.
    value = expm1(*x)
    return value, (value + 1) * dx[0]


@jax.custom_jvp
def expm1_ratio(x: Numbers) -> Numbers:
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
def log1p_ratio(x: Numbers) -> Numbers:
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


def _series(x: Numbers, derivative: int = 0) -> Numbers:
    """The series of the ratio, or of its derivative."""
    terms = [1 / math.factorial(k + 1) for k in range(10 + derivative)]
    for _ in range(derivative):
        terms = [k * c for k, c in enumerate(terms)][1:]
    return _horner(terms, x)


def _horner(terms: list[float], x: Numbers) -> Numbers:
    # `jnp.polyval` would be a loop.
    value = terms[-1]
    for c in terms[-2::-1]:
        value = value * x + c
    return jnp.asarray(value)


# Terms of the series where the matrix times the longest time has a norm of 1/2: the
# first omitted one is below the rounding of `float64`.
_TERMS = 14
_SQUARINGS = 16


def exponentials(
    matrix: Inexact[Array, "*batch n n"], times: Inexact[Array, " times"]
) -> tuple[Inexact[Array, "times *batch n n"], Inexact[Array, "times *batch n n"]]:
    r"""For each time $x$ the change $e^{-x G} - 1$, and the integral of $e^{-s G}$ over
    $s$ from 0 to $x$.

    By scaling and squaring, with powers of the matrix that all times share. The change
    is computed without cancellation. Both are NaN if the matrix times the longest time
    has a norm beyond about 3e4, and for a time that is not finite.
    """
    times = cast_to(times, matrix)
    known = jnp.isfinite(times)
    times = jnp.where(known, times, 0)
    longest = jnp.max(jnp.abs(times))
    norm = jnp.max(jnp.sum(jnp.abs(matrix), axis=-2)) * longest
    halvings = jnp.ceil(jnp.log2(jnp.maximum(2 * lax.stop_gradient(norm), 1)))
    solvable = halvings <= _SQUARINGS
    halvings = jnp.where(solvable, halvings, 0)
    unit = jnp.where(longest == 0, 1, longest) * 2**-halvings
    fractions = times / jnp.where(longest == 0, 1, longest)

    z = -unit * matrix
    powers = [jnp.broadcast_to(jnp.eye(z.shape[-1], dtype=z.dtype), z.shape)]
    for _ in range(_TERMS):
        powers.append(_product(powers[-1], z))
    factorials = [float(math.factorial(k + 1)) for k in range(_TERMS)]
    terms = jnp.stack([fractions**k / f for k, f in enumerate(factorials)], axis=1)
    combine = lambda c, x: jnp.tensordot(c, jnp.stack(x), 1, precision="highest")
    mean = combine(terms, powers[:-1])
    change = combine(fractions[:, None] * terms, powers[1:])

    def double(x, i):
        def doubled(x):
            change, mean = x
            # (e^z - 1)(e^z + 1), and the mean of e^(sz) over s from 0 to 2.
            half = change / 2
            square = _product(change, change)
            return change + change + square, mean + _product(mean, half)

        return lax.cond(i < halvings, doubled, lambda x: x, x), None

    (change, mean), _ = lax.scan(
        double, (change, mean), np.arange(_SQUARINGS, dtype=z.dtype)
    )
    length = jnp.expand_dims(times, range(1, mean.ndim))
    known = jnp.expand_dims(known, range(1, mean.ndim))
    valid = lambda x: jnp.where(solvable & known, x, jnp.nan)
    return valid(change), valid(length * mean)


def _product(x: Array, y: Array) -> Array:
    return jnp.matmul(x, y, precision="highest")


# Most terms of a series, and how many times larger than the vector they may become:
# so many digits are lost by cancellation. A part of the time for which that does not
# suffice is halved.
_MOST, _GROWTH = 32, 8.0
_SHORTEST = 2.0**-20


@eqx.filter_custom_jvp
def exponential_products(
    rate: Callable[[Array], Array], time: Array, x: Inexact[Array, "..."]
) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."]]:
    """As `exponentials` times a vector, for a matrix given by its products.

    By the series, over parts of the time that are short enough.
    """
    eps, size = float(jnp.finfo(x.dtype).eps), lambda x: jnp.max(jnp.abs(x), initial=0)

    def series(part, y):
        def term(state):
            k, last, change, integral, most = state
            integral = integral + last * (part / k)
            last = rate(last) * (-part / k)
            return k + 1, last, change + last, integral, jnp.maximum(most, size(last))

        def more(state):
            k, last, _, _, most = state
            open = (size(last) > eps / 8 * size(y)) & (most <= _GROWTH * size(y))
            return open & (k <= _MOST)

        one, zero = jnp.ones((), x.dtype), jnp.zeros_like(y)
        start = one, y, zero, zero, jnp.zeros((), x.dtype)
        _, last, change, integral, most = lax.while_loop(more, term, start)
        accurate = (size(last) <= eps / 8 * size(y)) & (most <= _GROWTH * size(y))
        return accurate, change, integral

    def advance(state):
        left, part, change, integral = state
        accurate, dx, dintegral = series(part * time, x + change)
        keep = lambda new, old: jnp.where(accurate, new, old)
        return (
            keep(left - part, left),
            keep(part, part / 2),
            keep(change + dx, change),
            keep(integral + dintegral, integral),
        )

    going = lambda state: (state[0] > 0) & (state[1] >= _SHORTEST)
    one, zero = jnp.ones((), x.dtype), jnp.zeros_like(x)
    state = lax.while_loop(going, advance, (one, one, zero, zero))
    left, _, change, integral = state
    valid = lambda x: jnp.where(left > 0, jnp.nan, x)
    return valid(change), valid(integral)


@exponential_products.def_jvp
def _exponential_products_jvp(primals, tangents):
    rate, time, x = primals
    arrays, static = eqx.partition(primals, eqx.is_inexact_array)
    zeros = lambda x, dx: jnp.zeros_like(x) if dx is None else dx
    moved = jax.tree.map(zeros, arrays, tangents)

    def short(inputs):
        rate, time, x = eqx.combine(inputs, static)

        def term(state, k):
            last, change, integral = state
            integral = integral + last * (time / k)
            last = rate(last) * (-time / k)
            return (last, change + last, integral), None

        k = np.arange(1, _MOST + 1).astype(x.dtype)
        state = x, jnp.zeros_like(x), jnp.zeros_like(x)
        return lax.scan(term, state, k)[0][1:]

    @jax.checkpoint
    def long(inputs):
        rate, time, x = eqx.combine(inputs, static)
        flat = lambda v: rate(v.reshape(x.shape)).ravel()
        matrix = jax.jacfwd(flat)(jnp.zeros(x.size, x.dtype))
        both = exponentials(matrix, time[None])
        return tuple(_product(part[0], x.ravel()).reshape(x.shape) for part in both)

    # Whether the series over the whole time loses digits, as measured on this vector.
    last, most = x, jnp.zeros((), x.dtype)
    for k in (1, 2, 3, 4):
        last = rate(last) * (time / k)
        most = jnp.maximum(most, jnp.max(jnp.abs(last), initial=0))
    weak = most <= 4 * jnp.max(jnp.abs(x), initial=0)
    derivative = lambda fn: lambda inputs, moved: jax.jvp(fn, (inputs,), (moved,))[1]
    # One decision for a batch: otherwise both would be computed.
    all_weak = ~eqxi.unvmap_any(~lax.stop_gradient(weak))
    both = derivative(short), derivative(long)
    return exponential_products(*primals), lax.cond(all_weak, *both, arrays, moved)
