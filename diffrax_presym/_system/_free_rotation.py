"""The angular momentum of a rigid body that rotates freely.

Euler's equations have Jacobi's elliptic functions as solutions. By their addition
theorem the momentum after a time `s` is rational in that at the start and in

`S = sn(a s) / a`, `C = cn(a s)` and `D = dn(a s)`,

which are smooth functions of `s` and of two squares: `S'^2 = (1 - α S^2)(1 - β S^2)`,
`C^2 = 1 - α S^2` and `D^2 = 1 - β S^2`. So neither a phase nor a distinction of cases
is needed.
"""

import jax.numpy as jnp
from jaxtyping import Array, Inexact


Three = tuple[Array, Array, Array]  # the entries along the principal axes

# Of the arithmetic-geometric mean, which then has converged for any modulus.
_LEVELS = 8


def root(x: Array) -> Array:
    """The square root, with a derivative where it is zero."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def sinc(x: Array) -> Array:
    return jnp.sinc(x / jnp.pi)


def _turned(x: Three, first: Array, third: Array) -> Three:
    """The axes in cyclic order, so that the first or the third becomes the second."""
    a, b, c = x
    choose = lambda a, b, c: jnp.where(first, b, jnp.where(third, c, a))
    return choose(a, c, b), choose(b, a, c), choose(c, b, a)


def _elliptic(s: Array, alpha: Array, beta: Array, difference: Array) -> Three:
    """`S`, `C` and `D`, by the descending Landen transformation. The difference of the
    squares is given without cancellation."""
    swap = difference < 0
    larger, gap = jnp.where(swap, beta, alpha), jnp.where(swap, -1, 1) * difference
    # If they are equal the period is infinite, and the mean would be zero.
    least = float(jnp.finfo(larger.dtype).eps) * larger
    a, b = root(larger), root(gap + least)
    products = []
    for _ in range(_LEVELS):
        a, b, half = (a + b) / 2, root(a * b), (a - b) / 2
        products.append(a * half)
    S, C, D = s * sinc(a * s), jnp.cos(a * s), jnp.ones_like(a * s)
    for product in reversed(products):
        x = product * S**2
        S, C, D = S / (1 + x), C * D / (1 + x), (1 - x) / (1 + x)
    return S, jnp.where(swap, D, C), jnp.where(swap, C, D)


def free_momentum(
    p: Inexact[Array, "... 3"], rates: Inexact[Array, "... 3"], s: Array
) -> Inexact[Array, "... 3"]:
    """The angular momentum after a time `s`. `rates` are the inverses of the moments of
    inertia."""
    (u, v, w), (x, y, z) = jnp.moveaxis(rates, -1, 0), jnp.moveaxis(p, -1, 0)
    # The second axis is to be that of the middle moment.
    is_second = (v - u) * (v - w) <= 0
    is_first = ~is_second & ((u - v) * (u - w) <= 0)
    is_third = ~(is_second | is_first)
    u, v, w = _turned((u, v, w), is_first, is_third)
    x, y, z = _turned((x, y, z), is_first, is_third)
    # Euler's equations: x' = a y z, y' = b z x, z' = c x y, with a c >= 0.
    a, b, c = w - v, u - w, v - u
    both = a * c * y**2
    squares = both - a * b * z**2, both - b * c * x**2
    S, C, D = _elliptic(s, *squares, b * (c * x**2 - a * z**2))
    later = (
        x * C + a * y * z * S * D,
        y * C * D + b * z * x * S,
        z * D + c * x * y * S * C,
    )
    later = _turned(later, is_third, is_first)
    return jnp.stack(later, axis=-1) / (1 - both * S**2)[..., None]
