"""Convergence of solves with more and more steps, and the fewest that suffice."""

import contextlib
import logging
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import numpy as np
from jaxtyping import Array


# The error that is aimed at, and that with which the search ends, over the tolerance.
AIM, ENOUGH = 0.6, 0.4


class Trial(NamedTuple):
    """A solve made to choose a step."""

    steps: int
    # The estimated error over the tolerance; infinite if the solve is not finite.
    error: float
    number: int  # of steps that was asked for


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the traceback that JAX logs where a solve fails, as a trial may."""
    logger = logging.getLogger("jax._src.callback")
    disabled, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = disabled


class Solution(NamedTuple):
    """What a solve saved, on the host."""

    number: int  # of steps that was asked for
    steps: int  # that were taken
    ts: np.ndarray  # all times
    leaves: list[np.ndarray]  # values, and times
    finite: bool
    order: int | None  # of the scheme, if that is known

    @classmethod
    def of(cls, number: int, solve: Callable[[Array], Any], step) -> "Solution":
        try:
            with _quiet():
                sol = jax.device_get(solve(step))
        except (RuntimeError, ValueError) as error:
            # As `diffeqsolve` raises if a solve fails, by the name of its type or, from
            # inside of `jax.jit`, in the text of another.
            if "EquinoxRuntimeError" not in f"{type(error).__name__} {error}":
                raise
            return cls(number, number, np.zeros(0), [], False, None)
        if not isinstance(sol, dfx.Solution):
            raise ValueError(
                "The solve must return a `diffrax.Solution`, the result of "
                f"`diffeqsolve`, but returned {type(sol).__name__}."
            )
        if np.ndim(sol.stats["num_steps"]):
            raise ValueError(
                "The solve must be of one problem, but it is a batch. Choose the step "
                "for its most difficult member."
            )
        times = [np.asarray(t) for t in jax.tree.leaves(sol.ts)]
        if not times:
            raise ValueError(
                "The solve must save at some times, for example by `SaveAt(t1=True)`, "
                "to find its error."
            )
        values = [np.asarray(y) for y in jax.tree.leaves(sol.ys)]
        good = (dfx.RESULTS.successful, dfx.RESULTS.event_occurred)
        finite = any(bool(sol.result == x) for x in good)
        if finite and not all(np.all(np.isfinite(t)) for t in times):
            raise ValueError(
                "The solve must save at times that do not depend on the step. Write "
                "`SaveAt(t1=True)` or `SaveAt(ts=ts)`; with an event, the first."
            )
        finite = finite and all(np.all(np.isfinite(y)) for y in values)
        order = sol.stats.get("order")
        return cls(
            number,
            int(sol.stats["num_steps"]),
            np.concatenate([np.ravel(t) for t in times]),
            [*values, *times],
            finite,
            None if order is None else int(order),
        )


def find_steps(
    solve: Callable[[int], Solution],
    tolerances: tuple[float, float],
    grid: int | None,
    max_steps: int,
) -> tuple[Trial, "Convergence"]:
    """The smallest number of steps found that reaches the tolerance, and its error."""
    convergence = Convergence(tolerances, max_steps)
    for n in _numbers(1 if grid is None else grid):
        if n > max_steps:
            raise RuntimeError(convergence.exceeds())
        if convergence.add(solve(n)):
            break
    return _smallest(convergence, solve, grid), convergence


def scaled_error(
    leaves: list[np.ndarray], exact: list[np.ndarray], rtol: float, atol: float
) -> float:
    """The largest error of an entry, over the tolerance."""
    worst = 0.0
    for y, z in zip(leaves, exact, strict=True):
        z = np.asarray(z, float)
        error = np.abs(np.asarray(y, float) - z)
        scale = atol + rtol * np.abs(z)
        # Where both vanish, as for a coordinate at rest, there is no error.
        scaled = np.divide(
            *(error, scale), out=np.where(error > 0, np.inf, 0.0), where=scale > 0
        )
        worst = max(worst, float(np.max(scaled, initial=0)))
    return worst


class Convergence:
    """The differences of solves with more and more steps, and what follows from them.

    Of the solutions only the last is kept.
    """

    def __init__(self, tolerances: tuple[float, float], max_steps: int):
        self.max_steps, self.tolerances = max_steps, tolerances
        self.trials: list[Trial] = []
        self.order, self.claimed = math.nan, None
        self.finest: Solution | None = None
        self._difference = math.inf
        self._least, self._regular, self._stalls = math.inf, False, 0
        self._at = 0

    @property
    def _least_order(self) -> float:
        return 0.75 if self.claimed is None else max(self.claimed / 2, 0.75)

    @property
    def highest_order(self) -> float:
        return 20 if self.claimed is None else 2 * self.claimed + 1

    def add(self, solution: Solution) -> bool:
        """Whether the tolerance is reached, by the last solution but one."""
        coarse = self.finest
        if coarse is not None and coarse.steps == solution.steps and coarse.finite:
            return False  # Steps between given times may be the same.
        self.finest, self.claimed = solution, solution.order or self.claimed
        if coarse is None:
            return False
        last, self._difference = self._difference, self._distance(coarse, solution)
        before, self.order = self.order, math.nan
        if self.trials and 0 < self._difference and last < math.inf:
            ratio = coarse.steps / self.trials[-1].steps
            self.order = math.log(last / self._difference) / math.log(ratio)
        error = self.correct(coarse.steps, self._difference)
        self.trials.append(Trial(coarse.steps, error, coarse.number))
        # An order far above the claim is that of leaving an unstable step behind.
        regular = self._least_order <= self.order <= self.highest_order
        slow = self.order >= 0.75 and before >= 0.75
        # Differences of three solves below the tolerance: of rounding, or exact.
        agree = max(last, self._difference) <= 0.5
        if error <= 1 and (regular or slow or agree):
            if agree and not (regular or slow):
                self.order = math.nan
            return True
        both = before, self.order
        if min(both) >= self._least_order and abs(before / self.order - 1) < 0.25:
            self._check_affordable(coarse.steps, error)
        self._check_rounding(regular or slow, coarse, solution)
        return False

    def measure(self, solution: Solution) -> Trial:
        """The error of another solution, over the tolerance."""
        error = self.correct(solution.steps, self._distance(solution, self.finest))
        self.trials.append(Trial(solution.steps, error, solution.number))
        return self.trials[-1]

    def correct(self, steps: int, difference: float) -> float:
        """The error, from the difference to the finest solution."""
        assert self.finest is not None
        known = 0.75 <= self.order < math.inf
        order = self.order if known else (self.claimed or 2)
        left = 1 - (steps / self.finest.steps) ** order
        return difference / left if left > 0 else difference

    def exceeds(self, needed: str = "more") -> str:
        """The error message where more steps than `max_steps` are needed."""
        if len(self.trials) < 2:
            return (
                f"`choose_step(max_steps={self.max_steps})` is too few steps to find "
                "an error: at least three solves are needed."
            )
        steps, error, _ = self.trials[-1]
        claimed = "" if self.claimed is None else f", that of the scheme {self.claimed}"
        found = (
            f"with {steps} steps the error is {error:.1e} times the tolerance, and the "
            f"measured order {self.order:.1f}{claimed}"
        )
        if not error < math.inf:
            what, found = "found no finite solution", f"up to {self.max_steps} steps"
            advice = (
                "Check that the solution exists up to `t1`, that the force is finite "
                "along it, and that the solve allows as many steps "
                "(`diffeqsolve(..., max_steps=None)`)."
            )
        elif not self.order >= self._least_order:
            what = f"found no regular convergence with up to {self.max_steps} steps"
            advice = (
                "Check that the motion is not chaotic, and that the force is smooth: "
                "if it has kinks at known times, write "
                "`stepsize_controller=StepsBetween(times)`; otherwise use a shorter "
                "time span or a larger tolerance."
            )
        else:
            what = f"needs {needed} than {self.max_steps} steps (`max_steps`)"
            advice = (
                "Use a scheme of higher order, for example `TunedRKN6()`, a larger "
                "tolerance, or allow more steps: `max_steps=...`."
            )
        return f"`choose_step` {what}: {found}. {advice}"

    def _check_affordable(self, steps: int, error: float):
        needed = steps * error ** (1 / self.order)
        if needed > 2 * self.max_steps:
            raise RuntimeError(self.exceeds(f"about {needed:.1e}, more"))

    def _check_rounding(self, converges: bool, coarse: Solution, fine: Solution):
        """An error if solves have stopped converging."""
        if not (coarse.finite and fine.finite):
            return
        self._regular = self._regular or converges
        self._stalls = self._stalls + 1 if self.order < 0.5 else 0
        if self._difference < self._least:
            self._least, self._at = self._difference, coarse.steps
        pairs = zip(coarse.leaves, fine.leaves, strict=True)
        pairs = [x for x in pairs if np.issubdtype(x[1].dtype, np.floating)]
        precision = max((b.dtype for _, b in pairs), key=lambda x: np.finfo(x).eps)
        eps, size = (
            float(np.finfo(precision).eps),
            lambda x: np.max(np.abs(x), initial=0),
        )
        change = max(float(size(a - b) / max(size(b), 1e-300)) for a, b in pairs)
        rounding = change < 1e3 * eps or (self._regular and change < eps**0.25)
        if self._stalls >= 2 and rounding:
            double = "double precision (`jax.config.update('jax_enable_x64', True)`), "
            # Only the loop of the package tells the order.
            equal = "`adjoint=FixedStepAdjoint()`, whose steps are all equal, "
            raise RuntimeError(
                f"`choose_step` cannot reach this tolerance in {precision}: "
                f"from {self._at} steps on, solves with more steps differ by rounding, "
                f"by {self._least:.1e} times the tolerance or more. Use "
                f"{equal if self.claimed is None else ''}`Compensated(solver)`, "
                f"{double if precision == np.float32 else ''}or a larger tolerance."
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
    yield from (n * grid for n in doubling(3) if n * grid > 3)


def doubling(n: int) -> Iterator[int]:
    """Integers, each about twice the last, without a common divisor."""
    while True:
        yield n
        n = 2 * n + 1


def _smallest(
    convergence: Convergence, solve: Callable[[int], Solution], grid: int | None
) -> Trial:
    """A smaller number of steps than the last that reaches the tolerance."""
    measure = lambda n: convergence.measure(solve(n))
    *trials, high = convergence.trials
    low = next((t for t in reversed(trials) if t.error > 1), Trial(0, math.inf, 0))
    every = lambda low, high: np.arange(low + 1, high)
    steepest = 1.5 * (convergence.claimed or convergence.highest_order)
    if grid is None:
        return _search(every, low, high, measure, steepest)
    if high.number >= grid:
        multiples = lambda low, high: grid * np.arange(low // grid + 1, high // grid)
        return _search(multiples, low, high, measure, steepest)
    best = _search(every, low, high, measure, steepest)
    for n in range(best.number, min(2 * best.number, grid) + 1):
        if grid % n == 0:
            trial = best if n == best.number else measure(n)
            if trial.error <= 1:
                return trial
    return best


def _search(
    between: Callable[[int, int], np.ndarray],
    low: Trial,
    high: Trial,
    measure: Callable[[int], Trial],
    steepest: float,
) -> Trial:
    """A smaller number of steps than `high` that reaches the tolerance."""
    failed = False
    for _ in range(6):
        numbers = between(low.number, high.number)
        if high.error >= ENOUGH or not numbers.size:
            break
        # By the law of convergence, between the two on a log scale. Where the larger
        # step is unstable, errors fall faster than that.
        error, slope = max(high.error, 1e-8), steepest
        if low.number and low.error < math.inf:
            slope = math.log(low.error / error) / math.log(high.number / low.number)
            slope = min(slope, steepest)
        guess = high.number * (error / AIM) ** (1 / slope)
        if failed:  # Not again close to the lower end.
            guess = max(guess, math.sqrt(low.number * high.number))
        n = int(numbers[np.argmin(np.abs(numbers - guess))])
        trial = measure(n)
        failed = trial.error > 1
        low, high = (trial, high) if failed else (low, trial)
    return high
