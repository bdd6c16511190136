"""The free rotation of rigid bodies.

Euler's equations have Jacobi's elliptic functions as solutions. By their addition
theorem the momentum after a time `s` is rational in that at the start and in

`S = sn(a s) / a`, `C = cn(a s)` and `D = dn(a s)`,

which are smooth functions of `s` and of two squares: `S'^2 = (1 - α S^2)(1 - β S^2)`,
`C^2 = 1 - α S^2` and `D^2 = 1 - β S^2`. So neither a phase nor a distinction of cases
is needed. The attitude follows from the momentum at both ends, and from one angle.
"""

from collections.abc import Callable
from functools import partial

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
# The squares of the momenta vary faster, whose mean the derivatives by the moments of
# inertia need.
_FINE = tuple(x / 2 for x in np.polynomial.legendre.leggauss(14))
# The interpolant through the nodes, at the end, and by how much of an angle the rate at
# an end may differ from it over the step. The quadrature has twice the order: its error
# is then about 1e-9, at most 4e-6 in 6e4 random steps.
_AT_END = np.array(
    [np.prod([(0.5 - y) / (x - y) for y in _NODES if y != x]) for x in _NODES]
)
_MOST_MISSED = 1e-4


def multiply(x: Quaternions, y: Quaternions) -> Quaternions:
    return _stacked(
        *_product((x[..., 0], _entries(x[..., 1:])), (y[..., 0], _entries(y[..., 1:])))
    )


def _turned_back(q: Quaternions, x: Vectors) -> Vectors:
    """A vector, rotated by the inverse."""
    a, u = q[..., :1], q[..., 1:]
    moved = once(jnp.cross(x, u))
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


# The square of the largest phase, in 64ths, for which the series has converged.
_MOST_SQUARE = 0.25


def _elliptic(s: Array, alpha: Array, beta: Array, gap: Array) -> Three:
    """`S`, `C` and `D`, by the difference of the squares too, `gap = alpha - beta`.
    Neither of these is negative."""
    s, total, product = s / 2**_DOUBLINGS, alpha + beta, alpha * beta
    z, square = total * s**2, product * s**4
    z = jnp.where(z > _MOST_SQUARE, jnp.nan, z)
    series = 1 + z * (-1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z / 362880)))
    series += square * (1 / 10 + z * (-11 / 420 + z * 17 / 5040) + square / 120)
    S = once(s * series)

    def double(_, x: Three) -> Three:
        # Sums of what is not negative: near the middle axis `C` and `D` vanish.
        S, C, D = x
        both, split = (C * D) ** 2, gap * S**2
        scale = 1 / (C**2 + alpha * (S * D) ** 2)
        return 2 * S * C * D * scale, (both - split) * scale, (both + split) * scale

    start = S, jnp.sqrt(1 - alpha * S**2), jnp.sqrt(1 - beta * S**2)
    # By a loop, or XLA on a CPU computes all of them again for each use.
    return lax.fori_loop(0, _DOUBLINGS, double, start)


def _one_less(cosine: Array, square: Array) -> Array:
    """`1 - C`, which may be small, from `C` and `1 - C^2`."""
    near = cosine > 0
    return jnp.where(near, square / jnp.where(near, 1 + cosine, 1), 1 - cosine)


def _momentum(p: Three, rates: Three, s: Array) -> Three:
    """The angular momentum after a time `s`."""
    u, v, w = rates
    # The second axis is to be that of the middle moment.
    is_second = (v - u) * (v - w) <= 0
    is_first = ~is_second & ((u - v) * (u - w) <= 0)
    is_third = ~(is_second | is_first)
    u, v, w = once(_cycled(rates, is_first, is_third))
    x, y, z = once(_cycled(p, is_first, is_third))
    # Euler's equations: x' = a y z, y' = b z x, z' = c x y, with a c >= 0 >= b a, b c.
    a, b, c = w - v, u - w, v - u
    both, first, third = a * c * y**2, a * b * z**2, b * c * x**2
    gap = b * (c * x**2 - a * z**2)
    alpha, beta = both - first, both - third
    S, C, D = _elliptic(s, alpha, beta, gap)
    square = S**2
    # 1 - both S^2, and its differences from C, C D and D, without cancellation.
    scale = 1 / (C**2 - first * square)
    same = C * D > 0
    apart = jnp.where(same, gap * square / jnp.where(same, C + D, 1), D - C)
    change = (
        (x * (C * _one_less(C, alpha * square) + first * square) + a * y * z * S * D)
        * scale,
        (y * (C * apart + first * square) + b * z * x * S) * scale,
        (z * (D * _one_less(D, beta * square) + third * square) + c * x * y * S * C)
        * scale,
    )
    return _each(jnp.add, p, _cycled(once(change), is_third, is_first))


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
    start, each = once((_entries(p), _entries(rates)))
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
    size = jnp.sqrt(jnp.where(is_small, 1, _dot(middle, middle)))
    for at_end, way in ((rates_at[-1], 1), (rate(start)[0], -1)):
        followed = jnp.tensordot(cast_to(_AT_END[::way], p), rates_at[:-1], 1)
        too_far |= jnp.abs(s * size * (at_end - followed)) > _MOST_MISSED

    def about(small: Array, c: Array) -> Array:
        return jnp.where(is_small, small, s * c * mean) / 2

    half = once(_each(about, _small_angle(start, end, each, s), middle))
    angle = once(jnp.sqrt(_dot(half, half)))
    scale = once(sinc(angle))
    turn = once((jnp.cos(angle), _each(lambda x: x * scale, half)))

    def shortest(x: Three, y: Three) -> tuple[Array, Three]:
        real = jnp.where(is_small, 1, _dot(middle, _each(jnp.add, x, y)))
        axis = _each(lambda x: jnp.where(is_small, 0, x), _cross(x, y))
        real, axis = once((real, axis))
        scale = once(1 / jnp.sqrt(real**2 + _dot(axis, axis)))
        return real * scale, _each(lambda x: x * scale, axis)

    turn = _product(shortest(middle, start), _product(turn, shortest(end, middle)))
    turn = jnp.where(too_far[..., None], jnp.nan, _stacked(*turn))
    return once((turn, jnp.stack(end, axis=-1)))


@_rotation.def_jvp
def _rotation_jvp(primals, tangents):
    # By matrices for each body: where there are many directions, as in Newton's method,
    # the functions are differentiated in three.
    p, s = primals[0], primals[2]
    turn, end = _rotation(*primals)
    theta, dend = jnp.zeros_like(p), jnp.zeros_like(p)
    for k, dx in enumerate(tangents):
        if dx is None:
            continue
        along = partial(_change_along, primals, turn, end, k)
        if k == 2:
            columns = [x[None] for x in along(jnp.ones_like(s))]
            entries = jnp.reshape(dx, (1,) * (p.ndim + 1))
        else:
            eye = jnp.eye(3, dtype=p.dtype)
            basis = jnp.broadcast_to(
                eye.reshape(*(1,) * (p.ndim - 1), 3, 3), (*p.shape, 3)
            )
            columns = jax.vmap(along, in_axes=-1)(basis)
            entries = jnp.moveaxis(dx, -1, 0)[..., None]
        theta, dend = (
            x + jnp.sum(entries * y, axis=0)
            for x, y in zip((theta, dend), once(tuple(columns)), strict=True)
        )
    half = jnp.concatenate([jnp.zeros_like(theta[..., :1]), theta / 2], axis=-1)
    return (turn, end), once((multiply(turn, half), dend))


def _change_along(
    primals, turn: Quaternions, end: Vectors, which: int, direction: Array
) -> tuple[Vectors, Vectors]:
    """The changes of the rotation, as a vector, and of the momentum at the end, by one
    of the arguments: from the derivative of the momentum alone. The angular momentum in
    space is that at the start, and the derivative of the action is the change of the
    rotation along the momentum."""
    p, rates, s = primals
    dp, drates, ds = (
        direction if k == which else jnp.zeros_like(x) for k, x in enumerate(primals)
    )

    def momentum(p: Vectors, rates: Vectors, s: Array) -> Vectors:
        return jnp.stack(_momentum(_entries(p), _entries(rates), s), axis=-1)

    dend = once(jax.jvp(momentum, primals, (dp, drates, ds))[1])
    work = s * p * rates * dp + ds * rates * end**2
    if which == 1:
        times, weights = cast_to(0.5 + _FINE[0], p), cast_to(_FINE[1], p)
        squares = jax.vmap(lambda x: momentum(p, rates, x * s))(times) ** 2
        mean = jnp.tensordot(weights, squares, 1)
        work += s / 2 * (p**2 + mean) * drates
    change = once(_turned_back(turn, dp) - dend)
    along = once(end * jnp.sum(work, axis=-1, keepdims=True))
    is_small = _is_small(p, rates, s)[..., None]
    square = jnp.where(is_small, 1, inner(p, p))

    def small_angle(p: Vectors, end: Vectors, rates: Vectors, s: Array) -> Vectors:
        start, later, each = map(_entries, (p, end, rates))
        return jnp.stack(_small_angle(start, later, each, s), axis=-1)

    at, changes = (p, end, rates, s), (dp, dend, drates, ds)
    angle, dangle = once(jax.jvp(small_angle, at, changes))
    turning = once(jnp.cross(angle, dangle))
    small = dangle - turning / 2 + jnp.cross(angle, turning) / 6
    theta = (along + jnp.cross(end, change)) / square
    return jnp.where(is_small, small, theta), dend


def free_rotation(p: Vectors, rates: Vectors, s: Array) -> tuple[Quaternions, Vectors]:
    """The rotation of bodies over a time `s`, from their axes at the end to those at
    the start, and the angular momenta along the axes at the end. `rates` are the
    inverses of the moments of inertia. Not a number if a momentum turns by more than
    half of a circle, relative to the body."""
    # By a power of two: rounding by any other unit was not the same up and down, and
    # the momentum decayed.
    exponent = jnp.frexp(jnp.max(jnp.abs(p), axis=-1, keepdims=True))[1]
    unit = lax.stop_gradient(jnp.ldexp(jnp.ones((), p.dtype), exponent))
    turn, end = _rotation(*once((p / unit, rates * unit)), s)
    return turn, end * unit
