"""Functions that XLA computes slowly on a CPU.

In `float64` XLA computes one sine or cosine at a time. Those here are polynomials,
which it vectorises: measured 2 to 4 times faster for arrays of ten entries and more,
also under `jax.vmap`, and slower for a single number. For a pendulum in a batch the
sine is most of the time of a solve.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact


# pi / 2 in three parts, the first two of 33 bits, so that products with the number of
# quarter turns are exact (Cody and Waite 1980).
_PARTS = tuple(
    map(
        float.fromhex,
        ("0x1.921fb544p0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69"),
    )
)
_LARGEST = 1e6
# Beyond these terms the series are less than a hundredth of rounding, up to pi / 4.
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(1, 9)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(2, 10)]


@jax.custom_jvp
def sin(x: Inexact[ArrayLike, "..."]) -> Inexact[Array, "..."]:
    """The sine, to one unit in the last place, for `x` between -1e6 and 1e6.

    `jax.numpy.sin` for other types than `float64`.

    **Arguments:**

    - `x`: an angle in radians.

    **Returns:**

    The sine, `nan` beyond a million.
    """
    return _quarter(x, 0)


@jax.custom_jvp
def cos(x: Inexact[ArrayLike, "..."]) -> Inexact[Array, "..."]:
    """The cosine, as [`diffrax_presym.math.sin`][].

    **Arguments:**

    - `x`: an angle in radians.

    **Returns:**

    The cosine, `nan` beyond a million.
    """
    return _quarter(x, 1)


@sin.defjvp
def _sin_jvp(x, dx):
    return sin(*x), cos(*x) * dx[0]


@cos.defjvp
def _cos_jvp(x, dx):
    return cos(*x), -sin(*x) * dx[0]


def _quarter(x: ArrayLike, turns: int) -> Array:
    """The sine of `x` and some quarter turns."""
    x = jnp.asarray(x)
    if x.dtype != jnp.float64:
        return jnp.cos(x) if turns else jnp.sin(x)
    first, second, third = _PARTS
    n = jnp.round(x * (2 / math.pi))
    a, b = x - n * first, n * second
    near = a - b
    low = ((a - near) - b) - n * third
    r = near + low
    low = (near - r) + low
    z = r * r
    sine = r + (low + r * z * _horner(z, _SINE))
    half = z / 2
    one = 1 - half
    rest = (1 - one) - half
    cosine = one + (rest + (z * z * _horner(z, _COSINE) - r * low))
    quarter = n.astype(jnp.int32) + turns
    y = jnp.where(quarter % 2 == 1, cosine, sine)
    y = jnp.where(quarter % 4 >= 2, -y, y)
    return jnp.where(jnp.abs(x) <= _LARGEST, y, jnp.nan)


def _horner(z: Array, coefficients: list[float]) -> Array:
    value = jnp.full_like(z, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * z + c
    return value
