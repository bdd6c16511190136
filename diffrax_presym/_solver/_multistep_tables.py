"""Tables of symmetric multistep methods, computed from their roots, and their dense
output."""

import functools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._interpolation import AbstractStepInterpolation
from .._misc import cast_to


# Published methods: the coefficients of rho up to the middle one. They determine the
# method, as sigma follows from the conditions of order.
# Quinlan and Tremaine (1990), and method 8A of Quinlan (1999).
QUINLAN_TREMAINE_8 = (1, -2, 2, -1, 0)
QUINLAN_8A = (1, -2, 2, -2, 2)
QUINLAN_TREMAINE_10 = (1, -1, 1, -1, 1, -2)
QUINLAN_TREMAINE_12 = (1, -2, 2, -1, 0, 0, 0)
RHO = {8: QUINLAN_TREMAINE_8, 10: QUINLAN_TREMAINE_10, 12: QUINLAN_TREMAINE_12}


def check_rho(order: int, rho: Sequence[float]) -> tuple[float, ...]:
    """Coefficients of rho up to the middle one, checked."""
    name = "`SymmetricMultistep(order, rho)`"
    try:
        rho = tuple(float(x) for x in rho)
    except TypeError:
        raise ValueError(
            f"{name} needs a sequence of numbers, but got {rho!r}. For example "
            f"`rho={RHO[order]}`."
        ) from None
    if len(rho) != order // 2 + 1 or rho[0] != 1:
        raise ValueError(
            f"{name} of order {order} needs {order // 2 + 1} coefficients up to the "
            f"middle one, the first of which is 1, but got {rho}. For example "
            f"`rho={RHO[order]}`."
        )
    everything = np.array([*rho, *rho[-2::-1]])
    kicks, rest = np.polydiv(everything, [1.0, -2.0, 1.0])
    roots = np.roots(kicks)
    distances = np.abs(roots[:, None] - roots) + 2 * np.eye(len(roots))
    stable = np.max(np.abs(np.abs(roots) - 1)) < 1e-6 and np.min(distances) > 1e-3
    if np.max(np.abs(rest)) > 1e-9 or np.min(np.abs(roots - 1)) < 1e-3 or not stable:
        raise ValueError(
            f"{name} needs a double root at one and all other roots simple and on the "
            f"unit circle, but the roots of {rho} are not. For example "
            f"`rho={RHO[order]}`."
        )
    return rho


class MultistepTable(NamedTuple):
    r"""A method as a filter of forces, in the order from the newest to the oldest.

    $\rho(z) = (z - 1)^2 R(z)$, so that a step is a kick and a drift, with a kick $a_n$
    that is a filtered force: $\sum_i R_i a_{n-i} = \sum_i \sigma_{i+1} g_{n-i}$.
    """

    order: int
    forces: np.ndarray  # sigma, without its two zeros
    kicks: np.ndarray  # R
    # Row j is the derivative of order j of the force, times the power j of the step,
    # from the state of the filter and the newest force.
    derivatives: np.ndarray
    # The momentum at a step, less that of the step before it, over h: from the same.
    momentum: np.ndarray


@functools.cache
def multistep_table(rho: tuple) -> MultistepTable:
    """The table of a method, computed in rational arithmetic and rounded once."""
    kicks, forces = exact_coefficients(rho)
    derivatives = _derivatives(kicks, forces)
    count = len(derivatives)
    weights = [Fraction((-1) ** j, math.factorial(j + 2)) for j in range(count)]
    momentum = [_dot(weights, column) for column in zip(*derivatives, strict=True)]
    return MultistepTable(
        count + 1, *(np.array(x, float) for x in (forces, kicks, derivatives, momentum))
    )


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


def _derivatives(kicks: list[Fraction], forces: list[Fraction]):
    # In powers of w, for forces exp(w t / h): the kick is 2 (cosh(w) - 1) / w^2, and an
    # entry of the state of the filter what past forces and kicks add to a later kick.
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
    identity = [[Fraction(int(i == j)) for j in range(count)] for i in range(count)]
    return list(zip(*_solve(columns, identity), strict=True))


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


# Nodes of the interpolation of a log scale within a step, backwards from its end.
LOG_SCALE_NODES = np.arange(1, 7) / 6
_LOG_SCALE = np.linalg.inv(LOG_SCALE_NODES[:, None] ** np.arange(1, 7))


def _hermite() -> np.ndarray:
    """From the momentum and its first two derivatives at both ends, and its mean, to
    the derivatives of the force at the end."""
    powers = np.arange(7)
    last, first = np.eye(7)[:3], np.ones((3, 7))
    first[1] = powers
    first[2] = powers * (powers - 1)
    last[2] *= 2
    # The derivative with respect to time is minus that backwards from the end.
    signs = np.array([1, -1, 1])[:, None]
    rows = [signs * last, signs * first, 1 / (powers + 1)[None]]
    factors = [-((-1) ** j) * math.factorial(j + 1) for j in range(6)]
    return np.array(factors)[:, None] * np.linalg.inv(np.concatenate(rows))[1:]


HERMITE = _hermite()


class MultistepInterpolation(AbstractStepInterpolation):
    """The polynomial of a step with the derivatives of the force at its end.

    Exact at both ends, and of the order of the method between them: in the variables
    of the shared split, in which the method steps.
    """

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree
    # The mean slope, times the length of the step.
    mean: PyTree
    # The derivatives of the slope at the end, times powers of the length of the step.
    derivatives: PyTree
    # Half the log scale at the nodes less that at the end, and the mass times the
    # position at the end over the length of the step; with friction only.
    log_scale: Array | None = None
    moment: PyTree = None

    def at_fraction(self, s: Array) -> PyTree:
        q, p = self._curve(s)
        # The momentum at the start has an error of its own.
        miss = jtu.tree_map(jnp.subtract, self.y0[1], self._curve(jnp.zeros_like(s))[1])
        weight = (1 - s) ** 2 * (1 + 2 * s)
        fix = lambda p, miss: p + cast_to(weight, p) * miss
        return q, jtu.tree_map(fix, p, miss)

    def _curve(self, s: Array) -> PyTree:
        back = 1 - s
        (dq, dp), (ddq, ddp) = self.mean, self.derivatives

        def position(x1, mean, slopes):
            r = cast_to(back, x1)
            weights = _weights(r, len(slopes), 2)
            terms = (w * x for w, x in zip(weights, slopes, strict=True))
            return functools.reduce(jnp.add, terms, x1 - r * mean)

        def momentum(mean, slopes):
            weights = _weights(cast_to(back, mean), len(slopes), 1)
            terms = (w * x for w, x in zip(weights, slopes, strict=True))
            return functools.reduce(jnp.subtract, terms, mean)

        q = jtu.tree_map(position, self.y1[0], dq, ddq)
        p = jtu.tree_map(momentum, dp, ddp)
        if self.log_scale is None:
            return q, p
        coefficients = cast_to(_LOG_SCALE, self.log_scale) @ self.log_scale
        terms = list(enumerate(coefficients, 1))
        scale = jnp.exp(-sum((c * back**n for n, c in terms), jnp.zeros_like(back)))
        rate = sum((n * c * back ** (n - 1) for n, c in terms), jnp.zeros_like(back))
        moment = jtu.tree_map(position, self.moment, dp, ddp)
        leaf = lambda p, m: cast_to(scale, p) * (p + cast_to(rate, p) * m)
        return (
            jtu.tree_map(lambda q: cast_to(scale, q) * q, q),
            jtu.tree_map(leaf, p, moment),
        )


def _weights(r, count: int, integrals: int) -> list:
    """The Taylor polynomials of the slope, integrated once or twice from both ends."""
    weights = []
    for j in range(count):
        factor = (-1) ** j / math.factorial(j + 2)
        if integrals == 2:
            weights.append(factor * (r ** (j + 2) - r))
        else:
            weights.append(factor * ((j + 2) * r ** (j + 1) - 1))
    return weights
