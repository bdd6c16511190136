"""Exponentials of rates: of numbers, of matrices, and of products with vectors."""

import math

import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from .._forms import matvec, vecmat
from .._numbers import cast_to


Numbers = Inexact[Array, "..."]


def gauss_legendre(h: ArrayLike, order: int) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature from 0 to `h`, of at least the given order."""
    nodes, weights = np.polynomial.legendre.leggauss((order + 1) // 2)
    return cast_to((1 + nodes) / 2, h) * h, cast_to(weights / 2, h) * h


# exp(x) - 1 and its ratio to x, accurate to rounding near zero, with derivatives. XLA's
# own expm1 takes longer than the rest of a leapfrog step of one unknown.


@jax.custom_jvp
def expm1_and_ratio(x: Numbers) -> tuple[Numbers, Numbers]:
    small, series, far = jnp.abs(x) < 0.1, _series(x), jnp.exp(x) - 1
    ratio = jnp.where(small, series, far / jnp.where(small, 1, x))
    return jnp.where(small, x * series, far), ratio


@expm1_and_ratio.defjvp
def _expm1_and_ratio_jvp(x, dx):
    (x,), (dx,) = x, dx
    (value, ratio), small = expm1_and_ratio(x), jnp.abs(x) < 0.1
    # Each branch is evaluated within its range: outside, it would overflow. Both are
    # much shorter than the derivative of the series.
    near, far = jnp.where(small, x, 0), jnp.where(small, 1, x)
    slope = jnp.where(small, _series(near, 1), (jnp.exp(far) - ratio) / far)
    return (value, ratio), ((value + 1) * dx, slope * dx)


def expm1(x: Numbers) -> Numbers:
    return expm1_and_ratio(x)[0]


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


# Terms of a series where the matrix times the time has a norm of at most 1/2: the first
# omitted one is below the rounding of `float64`.
_TERMS = 14
# On a CPU XLA makes one function of a loop, unless it multiplies matrices larger than
# 3 x 3. Sums of products are 4 to 50 times faster for matrices of 4 to 12, and
# 3 times slower for those of 16.
_MOST_SUMMED = 12
# Parts of the time for each row of a matrix, from which on it is squared instead.
_MOST_PARTS = 2


def exponentials(
    matrix: Inexact[Array, "*batch n n"], times: Inexact[Array, " times"]
) -> tuple[Inexact[Array, "times *batch n n"], Inexact[Array, "times *batch n n"]]:
    """For each time `x` the change `exp(-x G) - 1`, and the integral of `exp(-s G)`
    over `s` from 0 to `x`.

    By scaling and squaring, with powers of the matrix that all times share. The change
    is computed without cancellation. Both are NaN if the matrix times the longest time
    has a norm of which the rounding leaves less than two digits, about 1e13 and, in
    `float32`, 3e4, and for a time that is not finite.
    """
    times = cast_to(times, matrix)
    known = jnp.isfinite(times)
    times = jnp.where(known, times, 0)
    longest = jnp.max(jnp.abs(times))
    halvings = jnp.ceil(jnp.log2(jnp.maximum(2 * norm(matrix) * longest, 1)))
    squarings = jnp.finfo(times.dtype).nmant - 7
    solvable = halvings <= squarings
    halvings = jnp.where(solvable, halvings, 0)
    unit = jnp.where(longest == 0, 1, longest) * 2**-halvings
    fractions = times / jnp.where(longest == 0, 1, longest)

    z = -unit * matrix
    one = jnp.broadcast_to(jnp.eye(z.shape[-1], dtype=z.dtype), z.shape)
    # Loops rather than code for each term, which takes long to compile.
    next_power = lambda x, _: (product(x, z), x)
    _, powers = lax.scan(next_power, one, None, length=_TERMS + 1)
    # x^k / (k + 1)!, by their ratios.
    numbers = np.arange(_TERMS, dtype=z.dtype)[None]
    ratios = jnp.expand_dims(fractions, 1) / (numbers + 1)
    terms = jnp.cumprod(jnp.where(numbers == 0, 1, ratios), axis=1)

    def combine(c, x):
        if x.shape[-1] <= _MOST_SUMMED:
            return jnp.sum(jnp.expand_dims(c, range(2, x.ndim + 1)) * x[None], axis=1)
        return jnp.tensordot(c, x, 1, precision="highest")

    mean = combine(terms, powers[:-1])
    change = combine(fractions[:, None] * terms, powers[1:])

    def double(x, i):
        def doubled(x):
            change, mean = x
            # (e^z - 1)(e^z + 1), and the mean of e^(sz) over s from 0 to 2.
            square = product(change, change)
            return change + change + square, mean + product(mean, change / 2)

        return lax.cond(i < halvings, doubled, lambda x: x, x), None

    numbers = np.arange(squarings, dtype=z.dtype)
    (change, mean), _ = lax.scan(double, (change, mean), numbers)
    expand = lambda x: jnp.expand_dims(x, range(1, mean.ndim))
    valid = lambda x: jnp.where(solvable & expand(known), x, jnp.nan)
    return valid(change), valid(expand(times) * mean)


def norm(matrix: Array) -> Array:
    return lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(matrix), axis=-2), initial=0))


def exponential(matrix: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    if len(matrix) > _MOST_SUMMED:
        return jax.scipy.linalg.expm(matrix)
    change, _ = exponentials(-matrix, jnp.ones(1, matrix.dtype))
    return jnp.eye(len(matrix), dtype=matrix.dtype) + change[0]


def product(x: Array, y: Array) -> Array:
    if x.shape[-1] <= _MOST_SUMMED:
        return jnp.sum(x[..., None] * jnp.expand_dims(y, -3), axis=-2)
    return jnp.matmul(x, y, precision="highest")


@jax.custom_jvp
def exponential_products(
    matrix: Inexact[Array, "*batch n n"],
    time: Inexact[Array, ""],
    x: Inexact[Array, "*batch n"],
) -> tuple[Inexact[Array, "*batch n"], Inexact[Array, "*batch n"]]:
    """As `exponentials` times a vector: without the matrices, by the series, over as
    many parts of the time as it needs, unless these are many."""
    parts = _parts(matrix, time)
    # One decision for a batch: otherwise both would be computed. What is not finite is
    # left to the matrices, which are NaN then.
    strong = eqxi.unvmap_any(~(parts <= _MOST_PARTS * matrix.shape[-1]))
    found = _by_products(matrix, jnp.where(strong, 0, time), x)
    # A loop, as XLA copies what a conditional takes.
    by_matrices = lambda _: (jnp.asarray(False), *_by_matrices(matrix, time, x))
    return lax.while_loop(lambda state: state[0], by_matrices, (strong, *found))[1:]


def _by_matrices(matrix: Array, time: Array, x: Array) -> tuple[Array, Array]:
    change, integral = exponentials(matrix, time[None])
    return matvec(change[0], x), matvec(integral[0], x)


def _by_products(matrix: Array, time: Array, x: Array) -> tuple[Array, Array]:
    parts = _parts(matrix, time)
    part = time / parts
    size, rounding = norm(matrix) * jnp.abs(part), float(jnp.finfo(x.dtype).eps)
    # Those of which the next is below rounding, relative to the first.
    small = [(rounding * math.factorial(k)) ** (1 / k) for k in range(1, _TERMS)]
    terms = 1 + jnp.sum(size > np.asarray(small, x.dtype))

    def advance(state):
        i, change, integral = state
        more = _short(matrix, part, x + change, terms)
        return i + 1, change + more[0], integral + more[1]

    start = jnp.zeros_like(parts), jnp.zeros_like(x), jnp.zeros_like(x)
    return lax.while_loop(lambda x: x[0] < parts, advance, start)[1:]


def _parts(matrix: Array, time: Array) -> Array:
    return jnp.maximum(jnp.ceil(2 * norm(matrix) * jnp.abs(time)), 1)


def _short(
    matrix: Array, time: Array, x: Array, terms: Array | int = _TERMS
) -> tuple[Array, Array]:
    transposed = jnp.swapaxes(matrix, -1, -2)

    def term(i, state):
        last, change, integral = state
        part = time / (i + 1).astype(time.dtype)
        integral = integral + last * part
        last = vecmat(last, transposed) * -part
        return last, change + last, integral

    zero = jnp.zeros_like(x)
    return lax.fori_loop(0, terms, term, (x, zero, zero))[1:]


@exponential_products.defjvp
def _exponential_products_jvp(primals, tangents):
    # A loop of unknown length has no reverse mode: the series if it is enough, and
    # the matrices otherwise.
    weak = ~eqxi.unvmap_any(_parts(*primals[:2]) > 1)
    derivative = lambda fn: lambda x, dx: jax.jvp(fn, x, dx)[1]
    both = derivative(_short), derivative(jax.checkpoint(_by_matrices))
    return exponential_products(*primals), lax.cond(weak, *both, primals, tangents)
