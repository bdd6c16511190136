"""The exponential of a matrix over several times at once, and its integral."""

import math
from collections.abc import Callable

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from .._misc import cast_to


# Terms of the series where the matrix times the longest time has a norm of 1/2: the
# first omitted one is below the rounding of `float64`.
_TERMS = 14
_SQUARINGS = 16
# Most terms of the series for products with a vector.
_PRODUCTS = 48


def exponentials(
    matrix: Inexact[Array, "*batch n n"], times: Inexact[Array, " times"]
) -> tuple[Inexact[Array, "times *batch n n"], Inexact[Array, "times *batch n n"]]:
    r"""For each time $x$ the change $e^{-x G} - 1$, and the integral of $e^{-s G}$ over
    $s$ from 0 to $x$.

    By scaling and squaring, with powers of the matrix that all times share. The change
    is computed without cancellation. Both are NaN if the matrix times the longest time
    has a norm beyond about 3e4, or is not finite.
    """
    times = cast_to(times, matrix)
    longest = jnp.max(jnp.abs(times))
    norm = jnp.max(jnp.sum(jnp.abs(matrix), axis=-2)) * longest
    norm = lax.stop_gradient(norm)
    halvings = jnp.ceil(jnp.log2(jnp.maximum(2 * norm, 1)))
    solvable = halvings <= _SQUARINGS
    halvings = jnp.where(solvable, halvings, 0)
    unit = jnp.where(longest == 0, 1, longest) * 2**-halvings
    fractions = times / jnp.where(longest == 0, 1, longest)

    z = -unit * matrix
    powers = [jnp.broadcast_to(jnp.eye(z.shape[-1], dtype=z.dtype), z.shape)]
    for _ in range(_TERMS):
        powers.append(_product(powers[-1], z))
    terms = jnp.stack([fractions**k / f for k, f in enumerate(_FACTORIALS)], axis=1)
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
    valid = lambda x: jnp.where(solvable, x, jnp.nan)
    return valid(change), valid(length * mean)


_FACTORIALS = [float(math.factorial(k + 1)) for k in range(_TERMS)]


def _product(x: Array, y: Array) -> Array:
    return jnp.matmul(x, y, precision="highest")


def exponential_products(
    apply: Callable[[Array], Array], time: Array, x: Inexact[Array, " n"]
) -> tuple[Inexact[Array, " n"], Inexact[Array, " n"]]:
    """As `exponentials` times a vector, for a matrix given by its products.

    By the series, with as many products as it takes, and at most 48. NaN if these are
    not enough, which is when the matrix times the time has a norm beyond about 10.
    """
    eps = float(jnp.finfo(x.dtype).eps)
    size = jnp.max(jnp.abs(x), initial=0)

    def term(state, k):
        def more(state):
            last, change, integral = state
            integral = integral + last * (time / k)
            last = apply(last) * (-time / k)
            return last, change + last, integral

        last = state[0]
        going: Bool[Array, ""] = jnp.max(jnp.abs(last), initial=0) > eps / 8 * size
        return lax.cond(going, more, lambda x: x, state), None

    k = np.arange(1, _PRODUCTS + 1).astype(x.dtype)
    zero = jnp.zeros_like(x)
    (last, change, integral), _ = lax.scan(term, (x, zero, zero), k)
    solved = jnp.max(jnp.abs(last), initial=0) <= 64 * eps * size
    valid = lambda x: jnp.where(solved, x, jnp.nan)
    return valid(change), valid(integral)
