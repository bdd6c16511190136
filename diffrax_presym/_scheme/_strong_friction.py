"""How much friction over a step a scheme resolves, from its coefficients."""

import functools
import math

import numpy as np

from .._system._bound import System


# The maps of a step: what each does, its part of the step, and the order of the
# quadrature by which it integrates, 0 if exactly. "kick" is by a force, "move" by a
# velocity, and "decay" of momenta; "drift" is a move and decay as one, and "push" a
# kick and decay. "shared kick" and "shared drift" have half of the friction on
# positions.
Pattern = tuple[tuple[str, float, int], ...]

# Step times frequency of the oscillators on which schemes are measured: of a motion
# that many steps resolve, and of one that takes very many steps, whose rate is small.
_FREQUENCIES = (0.3, 0.01)
# The relative error of the rate of the slow motion, and of its momentum: one digit.
_TOLERANCE = 0.1
_PRODUCTS = np.geomspace(1.0, 300.0, 250)
_TAKE_TIME = ("decay", "drift", "push", "shared drift")


def part_of(pattern: Pattern, fraction: float) -> Pattern:
    """The pattern of a step that is a part of another."""
    return tuple((name, fraction * part, by) for name, part, by in pattern)


def friction_limit(system: System, pattern: Pattern, order: int) -> float:
    """The most friction over a step that a scheme of an order resolves.

    Infinite up to order 2: such schemes are used with heavy damping on purpose.
    """
    if system.friction is None or order <= 2 or not pattern:
        return math.inf
    return _limit(pattern, system.friction.precision)


@functools.cache
def _limit(pattern: Pattern, precision: float) -> float:
    """The largest friction over a step, its rate times the length, up to which the slow
    motion of an overdamped oscillator is right to one digit, in position and momentum,
    and rounding errors are amplified within a step by at most half of the digits."""
    clock = np.cumsum([0, *(part for name, part, _ in pattern if name in _TAKE_TIME)])
    back = np.max(np.maximum.accumulate(clock) - clock)
    good = _PRODUCTS * back <= -math.log(precision) / 2
    with np.errstate(all="ignore"):
        for omega in _FREQUENCIES:
            good &= _error(pattern, _PRODUCTS, omega) <= _TOLERANCE
    count = int(np.argmin(np.append(good, False)))
    return math.inf if count == len(good) else float(_PRODUCTS[max(count - 1, 0)])


def _error(pattern: Pattern, x: np.ndarray, omega: float) -> np.ndarray:
    """The error of the slow motion of `q'' = -omega^2 q - x q'`, with steps of 1."""
    one, zero = np.ones_like(x), np.zeros_like(x)
    step = np.stack([[one, zero], [zero, one]])
    for each in pattern:
        step = np.einsum("ijn,jkn->ikn", _map(*each, x, omega), step)
    (a, b), (c, d) = step
    if pattern[0][0].startswith("shared"):  # from and to the momentum p + x q / 2
        c, d = c + (a - d) * x / 2 - b * x * x / 4, d - b * x / 2
        a = a + b * x / 2
    half = (a + d) / 2
    value = half + np.sqrt(half * half - np.exp(-x))  # the larger eigenvalue
    rate = -(omega**2) / (x / 2 + np.sqrt(x * x / 4 - omega**2))
    errors = np.log(value) / rate - 1, c / (value - d) / rate - 1
    return np.nan_to_num(np.max(np.abs(errors), axis=0), nan=np.inf)


def _map(name: str, part: float, by: int, x: np.ndarray, omega: float) -> np.ndarray:
    one, zero = np.ones_like(x), np.zeros_like(x)
    left, force = np.exp(-part * x), -(omega**2) * one
    integral = (1 - left) / x
    if by:
        nodes, weights = np.polynomial.legendre.leggauss((by + 1) // 2)
        decayed = np.exp(np.multiply.outer(x, -part * (1 + nodes) / 2))
        integral = part / 2 * (decayed @ weights)
    rows = {
        "kick": ([one, zero], [part * force, one]),
        "move": ([one, part * one], [zero, one]),
        "decay": ([one, zero], [zero, left]),
        "drift": ([one, integral], [zero, left]),
        "push": ([one, zero], [integral * force, left]),
        "shared kick": ([one, zero], [part * (force + x * x / 4), one]),
        "shared drift": ([left**0.5, part * left**0.5], [zero, left**0.5]),
    }
    return np.stack(rows[name])
