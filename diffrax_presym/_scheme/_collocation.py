"""Tables of Gauss collocation, to the last digit of a double."""

import functools
from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

import numpy as np


MAX_STAGES = 8
_DIGITS = 60


class GaussTable(NamedTuple):
    r"""Gauss collocation on $[0, 1]$; see section II.1.3 of Hairer, Lubich, Wanner.

    Polynomials are written in the Legendre polynomials $P_k$ shifted to $[0, 1]$. With
    the discrete orthogonality of these at the nodes, the Lagrange polynomials are
    $\ell_j(x) = b_j \sum_k (2k + 1) P_k(c_j) P_k(x)$.
    """

    nodes: np.ndarray  # c
    weights: np.ndarray  # b
    # a_ij / b_j. A row and a column of it add up to one exactly, mu_ij + mu_ji = 1:
    # that is what makes the scheme symplectic, also in floating point.
    mu: np.ndarray
    # Row k is (2k + 1) P_k(c_j): from slopes times weights to Legendre coefficients.
    project: np.ndarray


def legendre(count: int, x: Any) -> list:
    """The first Legendre polynomials on [-1, 1], by their three-term recurrence."""
    values = [1 + 0 * x, x]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return values[:count]


@functools.cache
def gauss_table(stages: int) -> GaussTable:
    """The table of so many stages.

    Computed in 60 decimal digits and rounded once. `numpy.polynomial.legendre.leggauss`
    is right to a few units in the last place.
    """
    with localcontext() as context:
        context.prec = _DIGITS
        points = [_root(stages, guess) for guess in _guesses(stages)]
        # Exactly antisymmetric, the middle one exactly zero.
        points = [(a - b) / 2 for a, b in zip(points, points[::-1], strict=True)]
        values = [legendre(stages + 1, x) for x in points]
        slopes = [
            stages * (x * p[stages] - p[stages - 1]) / (x * x - 1)
            for x, p in zip(points, values, strict=True)
        ]
        weights = [
            1 / ((1 - x * x) * s * s) for x, s in zip(points, slopes, strict=True)
        ]
        project = [[(2 * k + 1) * p[k] for p in values] for k in range(stages)]
        mu = _matrix(
            lambda i, j: (
                (1 + points[i]) / 2
                + sum(
                    values[j][k] * (values[i][k + 1] - values[i][k - 1]) / 2
                    for k in range(1, stages)
                )
            ),
            stages,
        )
        nodes = _round([(1 + x) / 2 for x in points])
        rounded = _round(mu)
        # The larger of two that add up to one is rounded, the other is exact.
        lower = np.tril(rounded, -1)
        upper = np.triu(1 - rounded.T, 1)
        exact = lower + upper + np.eye(stages) / 2
        return GaussTable(nodes, _round(weights), exact, _round(project))


def _guesses(stages: int) -> list[Decimal]:
    points, _ = np.polynomial.legendre.leggauss(stages)
    return [Decimal(float(x)) for x in points]


def _root(stages: int, x: Decimal) -> Decimal:
    # Each iteration doubles the digits, of which there are 15 to begin with.
    for _ in range(3):
        p = legendre(stages + 1, x)
        x -= p[stages] * (x * x - 1) / (stages * (x * p[stages] - p[stages - 1]))
    return x


def _matrix(entry: Callable, size: int) -> list[list[Decimal]]:
    return [[entry(i, j) for j in range(size)] for i in range(size)]


def _round(x: Any) -> np.ndarray:
    # From decimal to the nearest double.
    return np.vectorize(float, otypes=[float])(np.array(x, dtype=object))
