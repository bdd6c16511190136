r"""The solution within a step of a splitting, from the forces of its kicks.

For a second-order equation with one rate of friction, a force $F$ at a fraction $c$ of
a step of length $h$ has added $h F \, dc$ times a decay to the momentum at a fraction
$s$, and $h F \, dc$ times the integral of the decay to what moves the position.

1. At a few points of the step, the position is computed from the forces of the kicks,
   with other weights than at the end. They are determined by order conditions, so no
   force is evaluated.
2. The solution is the integral over the polynomial through the forces at these points
   and the ends. It meets both ends of the step.

This is one iteration of Picard. As measured, the errors between steps are then those at
steps.
"""

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._interpolation import inner_points
from .._misc import cast_to, tree_scale, tree_sub, tree_sum
from .._split import State
from .._system import System
from ._engine import Span
from ._extension import AbstractExtension, blend, combine, fraction
from ._moves import Forces
from ._tableaus import SplittingTableau


# Degrees of the order conditions, and what they are weighted by: the size of a step,
# relative to the time scale of the motion, that is typical for an error.
_DEGREE = 6
_TYPICAL = ((1.6, 1e-3), (0.8, 1e-6), (0.33, 1e-9))
# Phases h omega of a step of an oscillator, for which the weights are fitted too.
_PHASES = np.linspace(0.1, 6, 60)
# Points within a step from which the accuracy is that at steps, as measured.
_POINTS_LOW, _POINTS_HIGH = 3, 6


class _Segment(NamedTuple):
    """The solution within a step."""

    q: PyTree  # at its start
    # Stacked: the momentum at the start, the forces at the points, and what the
    # integrals of their polynomial miss at the end.
    sources: PyTree


class SplittingExtension(AbstractExtension):
    """The continuous extension of a splitting, of a second-order equation."""

    def __init__(self, tableau: SplittingTableau):
        self.order = 2 * tableau.order
        self.ends_known = tableau.kick_first
        self.constants = _constants(tableau)

    def recording(self, y: State, carry: PyTree | None) -> Forces:
        """What records the forces of the kicks, of which the first may be known."""
        number = self.kicks + (carry is None)
        stack = lambda x: jnp.zeros((number, *jnp.shape(x)), jnp.result_type(x))
        last = jtu.tree_map(jnp.zeros_like, y[1]) if carry is None else carry
        return Forces(jnp.asarray(0), jtu.tree_map(stack, y[1]), last)

    def recorded(self, y: State, carry: Forces) -> tuple[PyTree | None, PyTree]:
        forces = carry.complete
        first_unknown = len(jtu.tree_leaves(forces)[0]) > self.kicks
        forces = jtu.tree_map(lambda x: x[-self.kicks :], forces)
        return None if first_unknown else carry.last, forces

    @property
    def kicks(self) -> int:
        return len(self.constants.times)

    def segment(self, system: System, span: Span, y: State, record: PyTree) -> _Segment:
        forces, const, t0, h = record, self.constants, span.t0, span.h
        times, points, kicks, fractions = (
            cast_to(x, h)
            for x in (const.times, const.points, const.kicks, const.fractions)
        )
        q, p = system.values(y)
        decay, carry = self._numbers(system, span, times)
        ends = self._numbers(system, span, points)
        ratio = ends[1][1:-1] / ends[0][1:-1]
        # Of forces: to the positions at the points, and to both variables at the end.
        within = kicks * (carry[None] - jnp.outer(ratio, decay))
        at_end = jnp.stack([fractions * carry, fractions * decay])
        sums = combine(h * jnp.concatenate([within, at_end]), forces)
        first = jtu.tree_map(lambda x: x[0], ends)
        starts = jnp.append(first[1] - ratio * first[0], first[1])

        def position(start: Array, sums: PyTree) -> PyTree:
            momentum = tree_sum(tree_scale(start, p), sums)
            return tree_sum(q, system.velocity(t0, (q, momentum)))

        part = lambda x, which: jtu.tree_map(lambda x: x[which], x)
        number = len(const.points) - 1
        qs = jax.vmap(position)(starts, part(sums, slice(number)))
        at = lambda s, q: system.potential_force(t0 + s * h, (q, p))
        if self.ends_known:
            between = jax.vmap(at)(points[1:-1], part(qs, slice(-1)))
            join = lambda f, x: jnp.concatenate([f[:1], x, f[-1:]])
            at_points = jtu.tree_map(join, forces, between)
        else:
            join = lambda x, xs: jnp.concatenate([x[None], xs])
            at_points = jax.vmap(at)(points, jtu.tree_map(join, q, qs))
        # The integrals over the whole step.
        lengths = h * cast_to(const.lengths, h)
        decay, carry = ends
        reached = combine(jnp.stack([lengths * carry, lengths * decay]), at_points)
        missed = tree_sub(part(sums, slice(number - 1, None)), reached)
        join = lambda *x: jnp.concatenate([x[0][None], *x[1:]])
        return _Segment(q, jtu.tree_map(join, p, at_points, missed))

    def at(self, system: System, span: Span, segment: _Segment, t: Array) -> State:
        s = fraction(span, t)
        # Of all polynomials these lose least to rounding.
        x = 2 * s - 1
        values = [jnp.ones_like(x), x]
        while len(values) < len(self.constants.integrals):
            values.append(2 * x * values[-1] - values[-2])
        integrals = combine(jnp.stack(values), cast_to(self.constants.integrals, x))
        flat = blend(s)
        decay, carry = self._numbers(system, span, cast_to(self.constants.points, s))
        now = jtu.tree_map(lambda x: x[0], self._numbers(system, span, s[None]))
        of_force, none = span.h * integrals, jnp.zeros_like(flat)
        join = lambda first, forces, *rest: jnp.concatenate(
            [first[:1], of_force * forces, jnp.stack(rest)]
        )
        momenta = join(decay, decay, none, flat) / now[0]
        moves = join(carry, carry, flat, none) - now[1] * momenta
        sums = combine(jnp.stack([moves, momenta]), segment.sources)
        move, p = (jtu.tree_map(lambda x, i=i: x[i], sums) for i in range(2))
        q = tree_sum(segment.q, system.velocity(t, (segment.q, move)))
        return q, p

    def _numbers(self, system: System, span: Span, s: Array) -> tuple[Array, Array]:
        """The decay of a momentum from fractions of a step to its end, and the integral
        of the decay."""
        _, t1, h = span
        left = (1 - s) * h
        friction, order = system.friction, self.order
        if friction is None:
            return jnp.ones_like(s), left

        def number(left: Array) -> tuple[Array, Array]:
            t, one = t1 - left, jnp.ones_like(left)
            return 1 + friction.decay(t, left, one), friction.carry(t, left, one, order)

        return jax.vmap(number)(left)


class _Constants(NamedTuple):
    """All as fractions of a step, or its multiples."""

    times: np.ndarray  # of the kicks
    fractions: np.ndarray  # that the kicks take
    points: np.ndarray  # including both ends
    kicks: np.ndarray  # the weight of each kick at each point within the step
    lengths: np.ndarray  # the integrals of the Lagrange polynomials of the points
    integrals: np.ndarray  # up to any fraction, by Chebyshev polynomials


def number_of_points(tableau: SplittingTableau) -> int:
    """The number of points within a step for this order."""
    return _POINTS_LOW if tableau.order <= 4 else _POINTS_HIGH


@functools.cache
def _constants(tableau: SplittingTableau) -> _Constants:
    points = np.array([0.0, *inner_points(number_of_points(tableau)), 1.0])
    kinds, fractions = zip(*_moves(tableau), strict=True)
    is_kick, fractions = np.array(kinds) == "B", np.array(fractions)
    times = np.cumsum(np.where(is_kick, 0, fractions))[is_kick]
    if tableau.kick_first:
        times[-1] = 1.0
    weights = _weights(tableau, times, points[1:-1])
    series = np.polynomial.chebyshev
    lagrange = np.linalg.inv(series.chebvander(2 * points - 1, len(points) - 1))
    integrals = series.chebint(lagrange, lbnd=-1, scl=0.5)
    # At the end all Chebyshev polynomials are one.
    lengths = np.sum(integrals, axis=0)
    return _Constants(times, fractions[is_kick], points, weights, lengths, integrals)


def _weights(tableau: SplittingTableau, times: np.ndarray, points) -> np.ndarray:
    """The weights of kicks that give the positions at fractions of a step.

    Least squares over the order conditions and oscillators, each divided by the error
    of the scheme that is to be expected.
    """
    words = _words(_DEGREE)
    degrees = np.array([len(w) for w in words])
    sizes = [x ** (degrees + 2) / error for x, error in _TYPICAL]
    scale = np.max(sizes, axis=0)
    factorials = np.array([math.factorial(k + 2) for k in degrees])
    forces = [(_expansions(tableau, words) * scale).T]
    exact = [points[:, None] ** (degrees + 2) / factorials * scale]
    for x in _PHASES:
        kicked, end = _oscillate(tableau, x)
        at = lambda t, x=x: np.stack([np.cos(t * x), np.sin(t * x) / x], axis=-1)
        slope = np.array([-x * np.sin(x), np.cos(x)])
        errors = np.abs(end - np.stack([at(1.0), slope])) / [[1.0], [max(x, 1.0)]]
        scale = 0.3 / math.sqrt(len(_PHASES)) / (np.max(errors) + 1e-13)
        forces.append(kicked.T * scale)
        uniform = np.stack([np.ones_like(points), points], axis=-1)
        exact.append((at(points) - uniform) * scale)
    matrix, wanted = np.concatenate(forces), np.concatenate(exact, axis=1)
    # Large weights would amplify rounding.
    least, none = np.eye(len(times)), np.zeros(len(times))

    def fit(s: float, wanted: np.ndarray) -> np.ndarray:
        rows = np.concatenate([matrix * (s - times), least])
        return np.linalg.lstsq(rows, np.append(wanted, none), rcond=None)[0]

    return np.stack([fit(s, row) for s, row in zip(points, wanted, strict=True)])


def _moves(tableau: SplittingTableau) -> list[tuple[str, float]]:
    letters = itertools.cycle("BA" if tableau.kick_first else "AB")
    return list(zip(letters, tableau.fractions, strict=False))


def _words(degree: int) -> list[str]:
    """The products of at most so many drifts A and kicks B that act on a force.

    From right to left, a drift raises the degree in the momentum by at most one, and a
    kick lowers it by one. Others than these are zero.
    """

    def acts(word: tuple[str, ...]) -> bool:
        degrees = itertools.accumulate(1 if x == "A" else -1 for x in reversed(word))
        return all(k >= 0 for k in degrees)

    every = (itertools.product("AB", repeat=k) for k in range(degree + 1))
    return ["".join(w) for w in itertools.chain(*every) if acts(w)]


def _expansions(tableau: SplittingTableau, words: list[str]) -> np.ndarray:
    """The coefficients of words in the expansion of the force at each kick.

    The force after moves of lengths a, b, ... is exp(a A) exp(b B) ... F.
    """
    prefixes = {w[:k] for w in words for k in range(len(w) + 1)}
    now = {w: float(w == "") for w in prefixes}
    rows = []
    for letter, length in _moves(tableau):
        if letter == "B":
            rows.append([now[w] for w in words])
        new = dict(now)
        for w in prefixes:
            run = len(w) - len(w.rstrip(letter))
            for m in range(1, run + 1):
                new[w] += now[w[:-m]] * length**m / math.factorial(m)
        now = new
    return np.array(rows)


def _oscillate(tableau: SplittingTableau, x: float) -> tuple[np.ndarray, np.ndarray]:
    """The forces of a step of q'' = -x^2 q at each kick, and its end, for the two unit
    vectors as starts."""
    q, p = np.eye(2)
    forces = []
    for letter, length in _moves(tableau):
        if letter == "A":
            q = q + length * p
        else:
            forces.append(-(x**2) * q)
            p = p + length * forces[-1]
    return np.array(forces), np.stack([q, p])
