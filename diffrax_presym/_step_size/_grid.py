"""The saved times as a grid, and what it costs to reach them."""

from typing import NamedTuple

import numpy as np


# What an interpolated value costs, in steps, if there are about as many as steps.
_INTERPOLATED = 1 / 3


class Grid(NamedTuple):
    """Saved times, in equal intervals of the span."""

    intervals: int | None  # `None` if the times are irregular
    at: np.ndarray  # the interval at whose end each time lies
    each: float = 1.0  # what a time inside of a step costs, in steps

    @classmethod
    def of(cls, ts: np.ndarray, t0: float, t1: float) -> "Grid":
        if not np.all(np.abs(ts - t0) <= abs(t1 - t0) * (1 + 1e-6)):
            raise ValueError(
                f"`choose_step(solve, t0, t1)` needs the times of the solve, but got "
                f"{t0} and {t1}, and the solve saves at times up to "
                f"{np.max(np.abs(ts - t0)):.6g} from `t0`."
            )
        number, where = intervals(ts, t0, t1), (np.asarray(ts, float) - t0) / (t1 - t0)
        return cls(number, np.round(where * (number or 1)).astype(int))

    def of_solve(self, interpolates: bool) -> "Grid":
        """For a solve that interpolates, or takes shorter steps to times inside."""
        return self._replace(each=_INTERPOLATED if interpolates else 1.0)

    def cost(self, steps: np.ndarray) -> np.ndarray:
        """Of a solve, in steps."""
        if self.intervals is None:
            return steps + self.each * len(self.at)
        # A time is the end of a step if it is so with the steps that divide the grid.
        common, which = np.unique(np.gcd(steps, self.intervals), return_inverse=True)
        inside = [np.count_nonzero(self.at * k % self.intervals) for k in common]
        return steps + self.each * np.asarray(inside, int)[which]

    def cheaper(self, steps: np.ndarray) -> np.ndarray:
        """As many steps, or more that end at all times and cost no more."""
        if self.intervals is None:
            return steps
        multiple = -(-steps // self.intervals) * self.intervals
        return np.where(multiple <= self.cost(steps), multiple, steps)


def intervals(ts: np.ndarray, t0: float, t1: float) -> int | None:
    """The number of equal intervals of the span at whose ends all times lie.

    `None` if there is none, or only one that is much finer than the times, as for 0.3
    and 7.7: the times are irregular.
    """
    start, span = np.float64(t0), np.float64(t1) - np.float64(t0)
    where = np.sort((np.asarray(ts, float) - start) / span)
    # Times are rounded, in their own precision.
    size = max(abs(float(t0)), abs(float(t1))) / abs(span)
    rounding = 4 * np.finfo(ts.dtype).eps * max(size, 1)
    gaps = np.diff(np.concatenate([[0.0], where, [1.0]]))
    gaps = gaps[gaps > rounding]
    if not gaps.size:
        return None
    # The mean of all that are equal, to average out the rounding.
    shortest = np.mean(gaps[gaps < 1.1 * np.min(gaps)])
    # The spacing may be a multiple of that of the grid, as for times half-way between
    # its points.
    for multiple in (1, 2, 3, 4):
        number = round(multiple / shortest)
        if number > 4 * (ts.size + 1):
            return None
        tolerance = rounding * number
        at = where * number
        if tolerance < 0.01 and np.all(np.abs(at - np.round(at)) <= tolerance):
            return number
    return None
