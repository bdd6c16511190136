"""Tables of Gauss collocation."""

import functools
from typing import Any, NamedTuple

import numpy as np


MAX_STAGES = 8


class GaussTable(NamedTuple):
    """Gauss collocation on `[0, 1]`; see section II.1.3 of Hairer, Lubich, Wanner.

    Polynomials are written in the Legendre polynomials `P_k` shifted to `[0, 1]`. With
    the discrete orthogonality of these at the nodes, the Lagrange polynomials are
    `l_j(x) = b_j Σ_k (2k + 1) P_k(c_j) P_k(x)`.
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
    """The table of so many stages, to a few units in the last place."""
    x, weights = np.polynomial.legendre.leggauss(stages)
    values = np.array(legendre(stages + 1, x))
    # The integrals of P_k from 0 to the nodes are differences of its neighbours.
    integrals = (values[2:] - values[:-2]) / 2
    mu = (1 + x[:, None]) / 2 + integrals.T @ values[1:-1]
    # The larger of two that add up to one is rounded, the other is exact.
    upper = np.triu(1 - mu.T, 1)
    project = (2 * np.arange(stages)[:, None] + 1) * values[:-1]
    return GaussTable(
        (1 + x) / 2, weights / 2, np.tril(mu, -1) + upper + np.eye(stages) / 2, project
    )
