"""The free rotation of rigid bodies.

Euler's equations have Jacobi's elliptic functions as solutions. By their addition
theorem the momentum after a time `s` is rational in that at the start and in

`S = sn(a s) / a`, `C = cn(a s)` and `D = dn(a s)`,

which are smooth functions of `s` and of two squares: `S'^2 = (1 - α S^2)(1 - β S^2)`,
`C^2 = 1 - α S^2` and `D^2 = 1 - β S^2`. So neither a phase nor a distinction of cases
is needed. The attitude follows from the momentum at both ends, and from one angle.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from .._numbers import cast_to
from ._manifolds import inner, once, sinc


Vectors = Inexact[Array, "... 3"]
Quaternions = Inexact[Array, "... 4"]
Three = tuple[Array, Array, Array]  # the entries along the principal axes

# The functions are doubled so often. At a 64th of the time the series has converged.
_DOUBLINGS = 6
# Where the rate of the angle is known, in units of the step, and its end.
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(7))
_TIMES = np.append(0.5 + _NODES, 1.0)


def multiply(x: Quaternions, y: Quaternions) -> Quaternions:
    return _stacked(
        *_product((x[..., 0], _entries(x[..., 1:])), (y[..., 0], _entries(y[..., 1:])))
    )


def _turned_back(q: Quaternions, x: Vectors) -> Vectors:
    """A vector, rotated by the inverse."""
    a, u = q[..., :1], q[..., 1:]
    moved = jnp.cross(x, u)
    return x + 2 * (a * moved + jnp.cross(moved, u))


# Along the axes separately, as XLA on a CPU computes what is stacked more than once.


def _entries(x: Vectors) -> Three:
    a, b, c = jnp.moveaxis(x, -1, 0)
    return a, b, c


def _each(fn: Callable, *vectors: Three) -> Three:
    a, b, c = map(fn, *vectors)
    return a, b, c


def _dot(x: Three, y: Three) -> Array:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _cross(x: Three, y: Three) -> Three:
    (a, b, c), (u, v, w) = x, y
    return b * w - c * v, c * u - a * w, a * v - b * u


def _product(x: tuple[Array, Three], y: tuple[Array, Three]) -> tuple[Array, Three]:
    (a, u), (b, v) = x, y
    vector = lambda u, v, w: a * v + b * u + w
    return a * b - _dot(u, v), _each(vector, u, v, _cross(u, v))


def _stacked(real: Array, vector: Three) -> Quaternions:
    return jnp.stack([real, *vector], axis=-1)


def _cycled(x: Three, first: Array, third: Array) -> Three:
    """The axes in cyclic order, so that the first or the third becomes the second."""
    a, b, c = x
    choose = lambda a, b, c: jnp.where(first, b, jnp.where(third, c, a))
    return choose(a, c, b), choose(b, a, c), choose(c, b, a)


def _elliptic(s: Array, alpha: Array, beta: Array) -> Three:
    """`S`, `1 - C` and `1 - D`, of which the last two are small."""
    s, total, product = s / 2**_DOUBLINGS, alpha + beta, alpha * beta
    z, square = total * s**2, product * s**4
    series = 1 + z * (-1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z / 362880)))
    series += square * (1 / 10 + z * (-11 / 420 + z * 17 / 5040) + square / 120)
    S = s * series
    C, D = jnp.sqrt(1 - alpha * S**2), jnp.sqrt(1 - beta * S**2)
    c, d = alpha * S**2 / (1 + C), beta * S**2 / (1 + D)

    def double(_, x: Three) -> Three:
        S, c, d = x
        twice = 2 * S / (1 - product * S**4)
        C, D = 1 - c, 1 - d
        return twice * C * D, twice * S * D**2 * alpha, twice * S * C**2 * beta

    # By a loop, or XLA on a CPU computes all of them again for each use.
    return lax.fori_loop(0, _DOUBLINGS, double, (S, c, d))


def _momentum(p: Three, rates: Three, s: Array) -> Three:
    """The angular momentum after a time `s`."""
    u, v, w = rates
    # The second axis is to be that of the middle moment.
    is_second = (v - u) * (v - w) <= 0
    is_first = ~is_second & ((u - v) * (u - w) <= 0)
    is_third = ~(is_second | is_first)
    u, v, w = _cycled(rates, is_first, is_third)
    x, y, z = _cycled(p, is_first, is_third)
    # Euler's equations: x' = a y z, y' = b z x, z' = c x y, with a c >= 0.
    a, b, c = w - v, u - w, v - u
    both = a * c * y**2
    S, C, D = _elliptic(s, both - a * b * z**2, both - b * c * x**2)
    shift, scale = both * S**2, 1 / (1 - both * S**2)
    change = (
        (x * (shift - C) + a * y * z * S * (1 - D)) * scale,
        (y * (shift - C - D + C * D) + b * z * x * S) * scale,
        (z * (shift - D) + c * x * y * S * (1 - C)) * scale,
    )
    return _each(jnp.add, p, _cycled(change, is_third, is_first))


def _is_small(p: Vectors, rates: Vectors, s: Array) -> Bool[Array, "..."]:
    limit = float(jnp.finfo(p.dtype).eps) ** 0.5
    return jnp.sum(p**2, axis=-1) * (s * jnp.max(rates, axis=-1)) ** 2 <= limit


def _small_angle(start: Three, end: Three, rates: Three, s: Array) -> Three:
    """The vector of a small rotation, by the momenta at its ends, to the fourth order:
    the mean velocity by that of Hermite, and the first commutator of Magnus."""
    u, v = (_each(jnp.multiply, x, rates) for x in (start, end))
    bend = _each(jnp.subtract, _cross(start, u), _cross(end, v))
    first = lambda u, v, bend, rate, both: (
        s / 2 * (u + v) + s**2 / 12 * (rate * bend + both)
    )
    return _each(first, u, v, bend, rates, _cross(u, v))


@eqx.filter_custom_jvp
def _rotation(p: Vectors, rates: Vectors, s: Array) -> tuple[Quaternions, Vectors]:
    # Through the momentum in the middle: from that at the end to it, by an angle about
    # it, and on to that at the start, each of the first and the last by the shortest
    # rotation. The angle is an integral. A small rotation is by a series, as these are
    # not defined for a body at rest.
    is_small = _is_small(p, rates, s)
    start, each = _entries(p), _entries(rates)
    momentum = lambda x: _momentum(start, each, x * s)
    later = once(jax.vmap(momentum)(cast_to(_TIMES, p)))
    middle, end = (_each(lambda x, i=i: x[i], later) for i in (len(_NODES) // 2, -1))

    def rate(later: Three) -> tuple[Array, Array]:
        """Of the angle, and by how much the momentum turns, squared."""
        velocity = _each(jnp.multiply, later, each)
        both, turning = _each(jnp.add, middle, later), _cross(later, velocity)
        product = jnp.where(is_small, 1, _dot(middle, both))
        square = jnp.where(is_small, 1, _dot(middle, middle))
        return _dot(both, velocity) / product, _dot(turning, turning) / square

    rates_at, turned = once(jax.vmap(rate)(later))
    mean = jnp.tensordot(cast_to(_WEIGHTS, p), rates_at[:-1], 1)
    too_far = s**2 * jnp.max(turned, axis=0) > np.pi**2

    def about(small: Array, c: Array) -> Array:
        return jnp.where(is_small, small, s * c * mean) / 2

    half = _each(about, _small_angle(start, end, each, s), middle)
    angle = jnp.sqrt(_dot(half, half))
    turn = once((jnp.cos(angle), _each(lambda x: x * sinc(angle), half)))

    def shortest(x: Three, y: Three) -> tuple[Array, Three]:
        real = jnp.where(is_small, 1, _dot(middle, _each(jnp.add, x, y)))
        axis = _each(lambda x: jnp.where(is_small, 0, x), _cross(x, y))
        scale = 1 / jnp.sqrt(real**2 + _dot(axis, axis))
        return real * scale, _each(lambda x: x * scale, axis)

    turn = _product(shortest(middle, start), _product(turn, shortest(end, middle)))
    turn = jnp.where(too_far[..., None], jnp.nan, _stacked(*turn))
    return once((turn, jnp.stack(end, axis=-1)))


@_rotation.def_jvp
def _rotation_jvp(primals, tangents):
    """From the derivative of the momentum alone. The angular momentum in space is that
    at the start, and the derivative of the action is the change of the rotation along
    the momentum."""
    p, rates, s = primals
    dp, drates, ds = (
        jnp.zeros_like(x) if dx is None else dx
        for x, dx in zip(primals, tangents, strict=True)
    )
    turn, end = _rotation(p, rates, s)

    def momentum(p: Vectors, rates: Vectors, s: Array) -> Vectors:
        return jnp.stack(_momentum(_entries(p), _entries(rates), s), axis=-1)

    dend = once(jax.jvp(momentum, primals, (dp, drates, ds))[1])
    work = s * p * rates * dp + ds * rates * end**2
    if tangents[1] is not None:
        nodes = jax.vmap(lambda x: momentum(p, rates, x * s))(cast_to(_TIMES[:-1], p))
        mean = jnp.tensordot(cast_to(_WEIGHTS, p), nodes**2, 1)
        work += s / 2 * (p**2 + mean) * drates
    change = _turned_back(turn, dp) - dend
    along = end * jnp.sum(work, axis=-1, keepdims=True)
    is_small = _is_small(p, rates, s)[..., None]
    square = jnp.where(is_small, 1, inner(p, p))

    def small_angle(p: Vectors, end: Vectors, rates: Vectors, s: Array) -> Vectors:
        start, later, each = map(_entries, (p, end, rates))
        return jnp.stack(_small_angle(start, later, each, s), axis=-1)

    at, changes = (p, end, rates, s), (dp, dend, drates, ds)
    angle, dangle = jax.jvp(small_angle, at, changes)
    turning = jnp.cross(angle, dangle)
    small = dangle - turning / 2 + jnp.cross(angle, turning) / 6
    theta = (along + jnp.cross(end, change)) / square
    theta = once(jnp.where(is_small, small, theta))
    half = jnp.concatenate([jnp.zeros_like(theta[..., :1]), theta / 2], axis=-1)
    return (turn, end), once((multiply(turn, half), dend))


def free_rotation(p: Vectors, rates: Vectors, s: Array) -> tuple[Quaternions, Vectors]:
    """The rotation of bodies over a time `s`, from their axes at the end to those at
    the start, and the angular momenta along the axes at the end. `rates` are the
    inverses of the moments of inertia. Not a number if a momentum turns by more than
    half of a circle, relative to the body."""
    unit = lax.stop_gradient(jnp.max(jnp.abs(p), axis=-1, keepdims=True))
    unit = jnp.where(unit > 0, unit, 1)
    turn, end = _rotation(p / unit, rates * unit, s)
    return turn, end * unit
