"""Tables of symmetric multistep methods, computed from their roots."""

import functools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np


# The coefficients of rho up to the middle one. They determine the method, as sigma
# follows from the conditions of order. Quinlan and Tremaine (1990):
QUINLAN_TREMAINE_12 = (1, -2, 2, -1, 0, 0, 0)


def _from_cosines(*twice: str) -> tuple[Fraction, ...]:
    """rho with a double root at one, and others given by twice their cosines."""
    rho = [Fraction(1), Fraction(-2), Fraction(1)]
    for c in map(Fraction, twice):
        padded = [Fraction(0)] * 2 + rho + [Fraction(0)] * 2
        terms = zip(padded[2:], padded[1:-1], padded[:-2], strict=True)
        rho = [x - c * y + z for x, y, z in terms]
    return tuple(rho[: len(rho) // 2 + 1])


# Chosen in `benchmarks/multistep.py`, for few steps that resonate or are unstable on
# Kepler orbits.
RHO = {
    8: _from_cosines("0.8516", "-0.2157", "-1.6290"),
    10: _from_cosines("1.4191", "0.6472", "-0.5899", "-1.6846"),
    12: QUINLAN_TREMAINE_12,
}


class MultistepTable(NamedTuple):
    r"""A method as a filter of forces, in the order from the newest to the oldest.

    $\rho(z) = (z - 1)^2 R(z)$, so that a step is a kick and a drift, with a kick $a_n$
    that is a filtered force: $\sum_i R_i a_{n-i} = \sum_i \sigma_{i+1} g_{n-i}$.
    """

    order: int
    forces: np.ndarray  # sigma, without its two zeros
    kicks: np.ndarray  # R
    # The momentum at a step less its mean over the step, divided by the length of the
    # step: from the state of the filter and the newest force.
    momentum: np.ndarray


@functools.cache
def multistep_table(rho: tuple) -> MultistepTable:
    """The table of a method, computed in rational arithmetic and rounded once."""
    kicks, forces = exact_coefficients(rho)
    momentum = _momentum(kicks, forces)
    columns = (np.array(x, float) for x in (forces, kicks, momentum))
    return MultistepTable(len(kicks) + 1, *columns)


def exact_coefficients(rho: Sequence) -> tuple[list[Fraction], list[Fraction]]:
    """The coefficients of R and of sigma, without its two zeros, for rho up to its
    middle coefficient."""
    left = [Fraction(x) for x in (*rho, *rho[-2::-1])]
    steps = len(left) - 1
    kicks = []
    # Division by (z - 1)^2.
    for i in range(steps - 1):
        kicks.append(left[i])
        left[i + 1] += 2 * kicks[-1]
        left[i + 2] -= kicks[-1]
    # Even powers about the middle, up to the order: those of rho, from R.
    half = steps // 2
    matrix, right = [], []
    for r in range(1, half + 1):
        power = lambda x, r=r: Fraction(x) ** (2 * r)
        differences = [
            power(j + 1) - 2 * power(j) + power(j - 1) for j in range(1 - half, half)
        ]
        right.append([_dot(kicks, differences) / (2 * r * (2 * r - 1))])
        moment = lambda i, r=r: Fraction(i) ** (2 * r - 2) * (2 if i else 1)
        matrix.append([moment(i) for i in range(half)])
    middle = [x for (x,) in _solve(matrix, right)]
    return kicks, middle[:0:-1] + middle


def _momentum(kicks: list[Fraction], forces: list[Fraction]) -> list[Fraction]:
    # For the force exp(w t / h), in powers of w: the kick is 2 (cosh(w) - 1) / w^2, an
    # entry of the state of the filter is what past forces and kicks add to a later
    # kick, and the momentum less its mean over the step is 1 / w - (1 - exp(-w)) / w^2.
    count = len(kicks)
    kick = [Fraction(1 - j % 2) * 2 / math.factorial(j + 2) for j in range(count)]

    def shifted(series, m):
        past = [Fraction(-m) ** j / math.factorial(j) for j in range(count)]
        return [_dot(series[: j + 1], past[j::-1]) for j in range(count)]

    state = []
    for i in range(count - 1):
        total = [Fraction(0)] * count
        for m in range(1, count - i):
            series = [-kicks[i + m] * x for x in kick]
            series[0] += forces[i + m]
            total = [a + b for a, b in zip(total, shifted(series, m), strict=True)]
        state.append(total)
    newest = [Fraction(int(j == 0)) for j in range(count)]
    columns = list(zip(*state, newest, strict=True))
    wanted = [[Fraction((-1) ** j, math.factorial(j + 2))] for j in range(count)]
    return [x for (x,) in _solve(columns, wanted)]


def _dot(x, y) -> Fraction:
    return sum((a * b for a, b in zip(x, y, strict=True)), Fraction(0))


def _solve(matrix, right) -> list[list[Fraction]]:
    """Solve a linear system by elimination, in rational arithmetic."""
    rows = [[*a, *b] for a, b in zip(matrix, right, strict=True)]
    size = len(rows)
    for i in range(size):
        pivot = next(r for r in range(i, size) if rows[r][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for r in range(size):
            if r != i and rows[r][i] != 0:
                factor = rows[r][i]
                rows[r] = [
                    x - factor * y for x, y in zip(rows[r], rows[i], strict=True)
                ]
    return [row[size:] for row in rows]
