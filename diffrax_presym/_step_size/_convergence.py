import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


# The error that is aimed at, and that with which the search ends, over the tolerance.
AIM, ENOUGH = 0.6, 0.4


class Trial(NamedTuple):
    """A solve made to choose a step."""

    steps: int
    # The estimated error over the tolerance; infinite if the solve is not finite.
    error: float


class Solution(NamedTuple):
    """A solution at the saved times, on the host."""

    steps: int
    # With a leading axis of saved times.
    leaves: list[np.ndarray]
    finite: bool

    @classmethod
    def of(cls, steps: int, ys: PyTree, successful) -> "Solution":
        leaves = [np.asarray(y) for y in jax.tree.leaves(ys)]
        finite = bool(successful) and all(np.all(np.isfinite(y)) for y in leaves)
        return cls(steps, leaves, finite)


def find_steps(
    solve: Callable[[int], Solution],
    solver: str,
    order: int,
    tolerances: tuple[float, float],
    grid: int | None,
    max_steps: int,
) -> tuple[Trial, "Convergence"]:
    """The smallest number of steps found that reaches the tolerance, and its error."""
    convergence = Convergence(solver, order, tolerances, max_steps)
    for n in _numbers(1 if grid is None else grid):
        if n > max_steps:
            raise RuntimeError(convergence.exceeds())
        if convergence.add(solve(n)):
            break
    return _smallest(convergence, solve, grid), convergence


def scaled_error(
    leaves: list[np.ndarray], exact: list[np.ndarray], rtol: float, atol: float
) -> float:
    """The largest error over all times, in the norm of Diffrax, over the tolerance."""
    squares, count = 0.0, 0
    for y, y_exact in zip(leaves, exact, strict=True):
        y_exact = np.asarray(y_exact, float)
        error = np.abs(np.asarray(y, float) - y_exact)
        scale = atol + rtol * np.abs(y_exact)
        # Where both vanish, as for a coordinate at rest, there is no error.
        scaled = np.divide(
            *(error, scale), out=np.where(error > 0, np.inf, 0.0), where=scale > 0
        )
        with np.errstate(over="ignore"):
            squares = squares + np.sum(scaled.reshape(len(y), -1) ** 2, axis=1)
        count += scaled[0].size
    return float(np.sqrt(np.max(squares) / count))


class Convergence:
    """The differences of solves with more and more steps, and what follows from them.

    Of the solutions only the last is kept.
    """

    def __init__(self, solver: str, order, tolerances, max_steps: int):
        self.solver, self.claimed, self.max_steps = solver, order, max_steps
        self.tolerances = tolerances
        self.trials: list[Trial] = []
        self.order = math.nan
        self.finest: Solution | None = None
        self._difference = math.inf
        self._least, self._regular, self._stalls = math.inf, False, 0

    def add(self, solution: Solution) -> bool:
        """Whether the tolerance is reached, by the last solution but one."""
        coarse, self.finest = self.finest, solution
        if coarse is None:
            return False
        last, self._difference = self._difference, self._distance(coarse, solution)
        before, self.order = self.order, math.nan
        if self.trials and 0 < self._difference and last < math.inf:
            ratio = coarse.steps / self.trials[-1].steps
            self.order = math.log(last / self._difference) / math.log(ratio)
        error = self.correct(coarse.steps, self._difference)
        self.trials.append(Trial(coarse.steps, error))
        # An order far above the claim is that of leaving an unstable step behind.
        regular = max(self.claimed / 2, 0.75) <= self.order <= 2 * self.claimed + 1
        slow = self.order >= 0.75 and before >= 0.75
        # Differences of three solves below the tolerance: of rounding, or exact.
        agree = max(last, self._difference) <= 0.5
        if error <= 1 and (regular or slow or agree):
            if agree and not (regular or slow):
                self.order = math.nan
            return True
        if all(0.75 < order / self.claimed < 1.25 for order in (before, self.order)):
            self._check_affordable(coarse.steps, error)
        self._check_rounding(regular or slow, coarse, solution)
        return False

    def measure(self, solution: Solution) -> float:
        """The error of another solution, over the tolerance."""
        error = self.correct(solution.steps, self._distance(solution, self.finest))
        self.trials.append(Trial(solution.steps, error))
        return error

    def correct(self, steps: int, difference: float) -> float:
        """The error, from the difference to the finest solution."""
        assert self.finest is not None
        known = 0.75 <= self.order < math.inf
        order = self.order if known else self.claimed
        return difference / (1 - (steps / self.finest.steps) ** order)

    def exceeds(self) -> str:
        """The error message where more steps than `max_steps` are needed."""
        if len(self.trials) < 2:
            return (
                f"`choose_step(max_steps={self.max_steps})` is too few steps to find "
                "an error: at least three solves are needed."
            )
        steps, error = self.trials[-1]
        if not error < math.inf:
            return (
                f"`choose_step` found no finite solution with up to {self.max_steps} "
                "steps. Check that the solution exists up to `t1` and that the force "
                "is finite along it, or allow more steps: `max_steps=...`."
            )
        if not self.order >= self.claimed / 2:
            return (
                f"`choose_step` found no regular convergence with up to "
                f"{self.max_steps} steps: with {steps} steps the error is {error:.1e} "
                f"times the tolerance, and the measured order is {self.order:.1f} "
                f"instead of {self.claimed}. Check that the force is smooth, and that "
                "the motion is not chaotic: otherwise use a shorter time span or a "
                "larger tolerance."
            )
        return (
            f"`choose_step` needs more than {self.max_steps} steps: with {steps} steps "
            f"the error is {error:.1e} times the tolerance, and the measured order "
            f"{self.order:.1f}. {self._instead()}"
        )

    def _check_affordable(self, steps: int, error: float):
        needed = steps * error ** (1 / self.order)
        if needed > 2 * self.max_steps:
            raise RuntimeError(
                f"`choose_step` needs about {needed:.1e} steps, but `max_steps` is "
                f"{self.max_steps}: with {steps} steps the error is {error:.1e} times "
                f"the tolerance, and the measured order {self.order:.1f}. "
                f"{self._instead()}"
            )

    def _instead(self):
        return (
            "Use a scheme of higher order, for example `TunedRKN6()`, a larger "
            "tolerance, or allow more steps: `max_steps=...`."
        )

    def _check_rounding(self, converges: bool, coarse: Solution, fine: Solution):
        """An error if solves have stopped converging."""
        if not (coarse.finite and fine.finite):
            return
        self._regular = self._regular or converges
        self._stalls = self._stalls + 1 if self.order < 0.5 else 0
        if self._difference < self._least:
            self._least, self._at = self._difference, coarse.steps
        eps = max(jnp.finfo(y.dtype).eps for y in fine.leaves)
        largest = [max(np.max(np.abs(y)), 1e-300) for y in fine.leaves]
        change = max(
            np.max(np.abs(np.asarray(a, float) - b)) / c
            for a, b, c in zip(coarse.leaves, fine.leaves, largest, strict=True)
        )
        rounding = change < 1e3 * eps or (self._regular and change < eps**0.25)
        if self._stalls >= 2 and rounding:
            precision = fine.leaves[0].dtype
            more = (
                ""
                if self.solver == "Compensated"
                else f"`Compensated({self.solver}(...))`, "
            )
            double = (
                "double precision (`jax.config.update('jax_enable_x64', True)`), "
                if precision == np.float32
                else ""
            )
            raise RuntimeError(
                f"`choose_step` cannot reach this tolerance in {precision}: rounding "
                f"leaves an error of {self._least:.1e} times the tolerance with "
                f"{self._at} steps, and more steps do not reduce it. Use {more}"
                f"{double}or a larger tolerance."
            )

    def _distance(self, solution: Solution, finest: Solution | None) -> float:
        assert finest is not None
        if not (solution.finite and finest.finite):
            return math.inf
        return scaled_error(solution.leaves, finest.leaves, *self.tolerances)


def _numbers(grid: int) -> Iterator[int]:
    """Numbers of steps to try, each about twice the last.

    Those above the grid are its multiples by 1, 3, 7, 15, ... No two in succession have
    a common divisor beyond the grid: otherwise all solves might see the same phase of a
    force that is periodic in time, and agree on a wrong solution.
    """
    numbers = [grid]
    while numbers[-1] > 10:
        numbers.append((numbers[-1] - 1) // 2)
    yield from (n for n in reversed(numbers) if n > 3)
    multiple = 3
    while True:
        if multiple * grid > 3:
            yield multiple * grid
        multiple = 2 * multiple + 1


def _smallest(
    convergence: Convergence, solve: Callable[[int], Solution], grid: int | None
) -> Trial:
    """A smaller number of steps than the last that reaches the tolerance."""
    measure = lambda n: convergence.measure(solve(n))
    *trials, high = convergence.trials
    low = next((t for t in reversed(trials) if t.error > 1), Trial(0, math.inf))
    every = lambda low, high: np.arange(low + 1, high)
    steepest = 1.5 * convergence.claimed
    if grid is None:
        return _search(every, low, high, measure, steepest)
    if high.steps >= grid:
        multiples = lambda low, high: grid * np.arange(low // grid + 1, high // grid)
        return _search(multiples, low, high, measure, steepest)
    best = _search(every, low, high, measure, steepest)
    for n in range(best.steps, min(2 * best.steps, grid) + 1):
        if grid % n == 0:
            error = best.error if n == best.steps else measure(n)
            if error <= 1:
                return Trial(n, error)
    return best


def _search(
    between: Callable[[int, int], np.ndarray],
    low: Trial,
    high: Trial,
    measure: Callable[[int], float],
    steepest: float,
) -> Trial:
    """A smaller number of steps than `high` that reaches the tolerance."""
    failed = False
    for _ in range(6):
        numbers = between(low.steps, high.steps)
        if high.error >= ENOUGH or not numbers.size:
            break
        # By the law of convergence, between the two on a log scale. Where the larger
        # step is unstable, errors fall faster than that.
        error, slope = max(high.error, 1e-8), steepest
        if low.steps and low.error < math.inf:
            slope = math.log(low.error / error) / math.log(high.steps / low.steps)
            slope = min(slope, steepest)
        guess = high.steps * (error / AIM) ** (1 / slope)
        if failed:  # Not again close to the lower end.
            guess = max(guess, math.sqrt(low.steps * high.steps))
        n = int(numbers[np.argmin(np.abs(numbers - guess))])
        trial = Trial(n, measure(n))
        failed = trial.error > 1
        low, high = (trial, high) if failed else (low, trial)
    return high
