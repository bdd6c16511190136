"""Friction of which a part is a power of the time since a singularity.

After it no polynomial follows the decay of a momentum, but one follows that by the
other parts, and the integrals of powers of time are known.
"""

import functools
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._numbers import as_time, cast_to, Time
from ._exponential import expm1, expm1_and_ratio
from ._log_scale import decays, Effect, increment, Logarithm, Terms


# Of a shorter logarithm of the time since the singularity over a span a quadrature is
# as accurate, and the integrals of high polynomials would be lost to rounding.
_SHORT = 0.4


def by_powers(terms: Terms, t: Time, h: Time, order: int) -> Effect | None:
    """What friction of several log scales does from `t` to `t + h`, in closed form but
    for the other log scales than a logarithm, of which polynomials are taken; `None` if
    there is no logarithm."""
    logarithms = [x for x in terms if isinstance(x[0], Logarithm)]
    if not logarithms:
        return None
    own, others = _nearest(logarithms, t, h)
    others += [x for x in terms if not isinstance(x[0], Logarithm)]
    nodes, weights = np.polynomial.legendre.leggauss(order)
    values = np.polynomial.legendre.legvander(nodes, order - 1)
    coefficients = values.T * weights * np.arange(0.5, order)[:, None]
    h = as_time(h)
    points = cast_to((1 + nodes) / 2, h) * h

    smooth = decays(others, t, h, points)
    powers = decays(own, t, h, points)
    ((law, rate),) = own
    assert isinstance(law, Logarithm)
    moments, short = _moments(law, rate, t, h, order)
    weights = h * cast_to(weights / 2, h)

    def integral(smooth: Array, power: Array, moment: Array) -> Array:
        # For rates of all entries and of each.
        rank = max(x.ndim for x in (smooth, power, moment))
        wide = lambda x: x.reshape(len(x), *(1,) * (rank - x.ndim), *x.shape[1:])
        smooth, power, moment = map(wide, (smooth, power, moment))
        # By sums, as XLA on a CPU makes no function of a loop with a product.
        each = lambda x: jnp.expand_dims(
            cast_to(x, smooth), range(x.ndim, x.ndim + rank - 1)
        )
        by_nodes = jnp.sum(each(weights) * smooth * power, axis=0)
        polynomial = jnp.sum(each(coefficients) * smooth[None], axis=1)
        return jnp.where(short, by_nodes, jnp.sum(polynomial * moment, axis=0))

    integrals = map(integral, smooth, powers, moments)
    return Effect(expm1(-increment(terms, t, h)), *integrals)


def _nearest(logarithms: Terms, t: Time, h: Time) -> tuple[list, list]:
    """The logarithm whose singularity is nearest to a span, and what is left."""
    if len(logarithms) == 1:
        return list(logarithms), []
    t = as_time(t)
    laws, rates = zip(*logarithms, strict=True)
    shift = lambda law: 0.0 if law.shift is None else law.shift
    shifts = jnp.stack([cast_to(shift(law), t) for law in laws])
    away = jnp.minimum(jnp.abs(t + shifts), jnp.abs(t + h + shifts))
    nearest = jnp.argmin(away)
    parts = [jnp.where(nearest == k, rate, 0) for k, rate in enumerate(rates)]
    own = Logarithm(shifts[nearest]), functools.reduce(jnp.add, parts)
    others = [
        (law, rate - part) for law, rate, part in zip(laws, rates, parts, strict=True)
    ]
    return [own], others


def _moments(
    law: Logarithm, rate: Array, t: Time, h: Array, number: int
) -> tuple[tuple[Array, Array], Array]:
    """The integrals over a span of Legendre polynomials times the decay by a power of
    time, from its start and to its end; and whether the span is short for that."""
    singular, start = law.since(t)
    start, x = jnp.where(singular, 0, start), law.increment(t, h)
    c, end, short = cast_to(rate, x), start + h, jnp.abs(x) < _SHORT
    unit = jnp.maximum(jnp.abs(start), jnp.abs(end))
    unit = jnp.where(unit == 0, 1, unit)
    left = jnp.exp(-c * x)

    # Of powers of time, in units of the later one. No exponential overflows.
    carried, responded = [], []
    first, last = start, end
    for k in range(1, number + 1):
        a, b = (k - c) * x, (k + c) * x
        of_start, of_end = (
            jnp.where(a > 0, last * left, first),
            jnp.where(b < 0, first * left, last),
        )
        # Not by the absolute value, whose derivative at zero is not that of either.
        a, b = jnp.where(a > 0, -a, a), jnp.where(b < 0, b, -b)
        carried.append(x * of_start * expm1_and_ratio(a)[1])
        responded.append(x * of_end * expm1_and_ratio(b)[1])
        first, last = first * start / unit, last * end / unit
    # What has friction does not leave a singularity.
    lost = singular & (c != 0)
    carried = [jnp.where(lost, 0, y) for y in carried]

    scale = 2 * unit / jnp.where(short, 2 * unit, h)
    shift = 2 * start / jnp.where(short, 2 * unit, h) + 1

    def of_legendre(moments: list[Array]) -> Array:
        # Each of fewer powers of time, as a product with one is of two of them.
        before, now, found = moments, moments, [moments[0]]
        for k in range(number - 1):
            product = [
                scale * high - shift * low for low, high in itertools.pairwise(now)
            ]
            new = [
                ((2 * k + 1) * y - k * z) / (k + 1)
                for y, z in zip(product, before, strict=False)
            ]
            before, now = now, new
            found.append(now[0])
        return jnp.stack(jnp.broadcast_arrays(*found))

    return (of_legendre(carried), of_legendre(responded)), short
