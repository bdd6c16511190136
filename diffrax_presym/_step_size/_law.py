"""How solves converge: trials with more and more steps, and their law.

An error is the difference to the finest solution, over the tolerance, corrected by the
law of convergence for the error of that.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from ._solution import scaled_error, Solution


# With fewer steps solves may all miss a short push, and agree on that.
SEEING = 50


class Trial(NamedTuple):
    """A solve made to choose a step."""

    steps: int
    # The estimated error over the tolerance; infinite if the solve is not finite.
    error: float
    number: int  # of steps that was asked for

    def order(self, finer: "Trial") -> float:
        """With which errors fall, if that is known."""
        if (
            not 0
            < min(self.error, finer.error)
            <= max(self.error, finer.error)
            < np.inf
        ):
            return math.nan
        return math.log(self.error / finer.error) / math.log(finer.steps / self.steps)


class Law(NamedTuple):
    """How solves converge: the steps tried, each with the difference to the next
    solution in place of its error, and the finest solution."""

    ladder: tuple[Trial, ...]
    finest: Solution
    claimed: int | None
    tolerances: tuple[float, float]
    # Of the last two solutions, by how much they differ relative to their size, and to
    # what that is rounded.
    change: float = math.inf
    precision: np.dtype | None = None
    extrapolates: bool = True  # not if most of the differences are by rounding

    def add(self, finer: Solution) -> "Law":
        law = self._replace(finest=finer, claimed=finer.order or self.claimed)
        last = self.finest
        step = Trial(last.steps, law.difference(last), last.number)
        change, precision = math.inf, None
        if last.finite and finer.finite:
            change, precision = last.relative_change(finer)
        ladder = *self.ladder, step
        return law._replace(ladder=ladder, change=change, precision=precision)

    @property
    def eps(self) -> float:
        """The relative rounding of the last two solutions, if both are finite."""
        return 0.0 if self.precision is None else float(np.finfo(self.precision).eps)

    @property
    def orders(self) -> list[float]:
        pairs = itertools.pairwise(self.ladder)
        return [math.nan, math.nan, *(a.order(b) for a, b in pairs)]

    @property
    def least(self) -> float:
        """The lowest order of a smooth problem."""
        return (self.claimed or min(max(self.orders[-1], 1), 4)) / 2 + 0.4

    def exceeds(self, order: float, last: int | None = None) -> bool:
        """Whether the last two orders, or earlier ones, are at least this one."""
        return all(x >= order for x in self.orders[:last][-2:])

    @property
    def converges(self) -> bool:
        # An order far above the claim is that of leaving an unstable step behind.
        most = 2 * (self.claimed or 10) + 1
        return self.exceeds(0.75) or self.least - 0.4 <= self.orders[-1] <= most

    @property
    def agrees(self) -> bool:
        """Whether four solves do: to rounding, or exactly."""
        three = self.ladder[-3:]
        seen = len(three) == 3 and three[-1].steps >= SEEING
        return seen and max(x.error for x in three) <= 0.5

    @property
    def rounds(self) -> bool:
        """Whether three solves agree to the tolerance, and more steps only add to their
        errors of rounding."""
        two = self.ladder[-2:]
        seen = len(two) == 2 and two[0].steps >= SEEING and self.orders[-1] < 0
        by_rounding = self.change <= self.eps * self.finest.steps
        return seen and by_rounding and max(x.error for x in two) <= 1

    def difference(self, solution: Solution) -> float:
        if not (solution.finite and self.finest.finite):
            return math.inf
        return scaled_error(solution.leaves, self.finest.leaves, *self.tolerances)

    def trial(self, solution: Solution) -> Trial:
        error, steps, order = self.difference(solution), solution.steps, self.orders[-1]
        order = order if order >= 0.75 else (self.claimed or 2)
        if not self.extrapolates:
            # The finest has an error of its own, at most that which is known.
            return Trial(steps, error + self.ladder[-1].error, solution.number)
        if steps < self.finest.steps:
            error /= 1 - (steps / self.finest.steps) ** order
        elif error <= 1:
            # At least as fine as the finest: an error that falls from the last one.
            last = self.ladder[-1]
            order = min(order, self.claimed or order)
            error = last.error * (last.steps / steps) ** order
        return Trial(steps, error, solution.number)
