"""Solves with more and more steps until they converge, and the cheapest."""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ._grid import Grid
from ._law import Law, Trial
from ._solution import Solution


# The error that is aimed at, and that with which the search ends, over the tolerance.
AIM, ENOUGH = 0.6, 0.4
# With fewer steps these may be too long for the motion, and not converge for that.
PATIENCE = 2000
# Among so many numbers the best is chosen.
_CANDIDATES = 100_000


class Choice(NamedTuple):
    """The cheapest number of steps found that reaches the tolerance."""

    best: Trial
    order: float
    claimed: int | None
    smooth: bool  # whether errors follow the law of convergence
    grid: Grid


def find_steps(
    solve: Callable[[int], Solution],
    times: tuple[float, float],
    tolerances: tuple[float, float],
    max_steps: int,
    report: Callable[[Trial], None],
) -> Choice:
    law = grid = doubted = None
    found: list[Trial] = []
    failed: list[Trial] = []  # No longer step is chosen than those of these.
    interpolates: dict[int, bool] = {}  # whether a solve does, by its number of steps
    same, numbers, expected = 0, doubling(4), float
    while expected(n := next(numbers)) <= max_steps:
        finest, last = solve(n), law and law.finest
        expected, interpolates[n] = finest.expected, finest.interpolates
        if grid is None and finest.finite:
            # Of a solve that fails, the saved times are not known.
            grid = Grid.of(finest.ts, *times)
            if finest.steps != n:  # The steps are not those that divide the span.
                grid = grid._replace(intervals=None)
            numbers = _numbers(grid.intervals or 1, n)
        grid = grid and grid.of_solve(finest.interpolates)
        if law is None or last is None:
            law = Law((), finest, finest.order, tolerances)
            continue
        if last.finite and last.steps == finest.steps:
            same += 1
            # Of two steps, an event may end one solve and the next in the second; of
            # one, many in the first.
            if (same > 1 and 1 < finest.steps < n) or n > max_steps > finest.steps:
                raise ValueError(
                    "The solve does not use `dt0`, or an event ends it at once: it "
                    f"takes {finest.steps} steps also where `dt0` is that of {n}. "
                    "Write `solve = lambda dt0: diffeqsolve(..., dt0=dt0, ...)`, with "
                    "steps of constant size."
                )
            continue  # Steps between given times may be the same.
        same, before, law = 0, law, law.add(finest)
        high, best_law = law.trial(last), law
        report(high)
        found.append(high)
        if law.rounds:
            # The last solve has the largest errors of rounding.
            high, best_law = found[-2], before._replace(extrapolates=False)
        agrees = law.agrees or law.rounds
        converges = len(law.ladder) > 1 and (law.converges or agrees)
        if grid and high.error <= 1 and (converges or doubted):

            def measure(n: int, law: Law = best_law) -> Trial:
                solution = law.finest if n == law.finest.number else solve(n)
                interpolates[n] = solution.interpolates
                report(trial := law.trial(solution))
                if trial.error > 1:
                    failed.append(trial)
                return trial

            smooth = _is_smooth(best_law, high, grid, measure)
            rounding = max(x.error for x in law.ladder[-2:]) < 1e-3
            rounding = rounding or (agrees and not law.exceeds(0.75))
            if rounding:
                finest.check_precision(*tolerances)
            order = math.nan if rounding else law.orders[-1]
            choice = Choice(high, order, law.claimed, smooth, grid)
            if smooth or doubted:
                best = high
                if smooth:
                    best = _smallest(best_law, failed, high, grid, measure)
                own = grid.of_solve(interpolates[best.number])
                more = int(own.cheaper(np.array([best.number]))[0])
                if best.number < more and expected(more) <= max_steps:
                    finer = measure(more)
                    best = finer if finer.error <= 1 else best
                return choice._replace(best=best)
            doubted = choice
            continue
        doubted = None
        if high.error > 1:
            _check_rounding(law)
            _check_hopeless(law, high, max_steps)
    if doubted is None:
        raise RuntimeError(_exceeds(law, max_steps))
    return doubted


def _is_smooth(law: Law, high: Trial, grid: Grid, measure) -> bool:
    """Whether errors fall by the law also where steps have another phase: where a force
    jumps inside of a step, they may have fallen by chance."""
    order = law.orders[-1]
    if law.extrapolates and (
        0.75 <= order < law.least or not (law.agrees or order >= law.least)
    ):
        return False
    most = (0.5 if law.agrees else 0.1) if law.extrapolates else 1
    unit = grid.intervals or 1
    unit = unit if high.number % unit == 0 else 1
    settled = law.exceeds(0.65 * (law.claimed or 2))
    factors = (1.5,) if settled else (1.5, 1.25)
    # Even, since the others are odd: these see one phase in the middle of the span.
    numbers = (2 * unit * math.ceil(x * high.number / unit / 2) for x in factors)
    for trial in map(measure, dict.fromkeys(numbers)):
        expected = 1.3 * high.error * (high.steps / trial.steps) ** law.least
        if not trial.error <= max(expected, most):
            return False
    return True


def _smallest(law: Law, failed: list[Trial], high: Trial, grid: Grid, measure) -> Trial:
    """A smaller number of steps that reaches the tolerance, as all that were tried
    between the two."""
    few = [x for x in (*law.ladder[:-1], *failed) if x.error > 1]
    few = [x for x in few if x.number < high.number]
    low = max(few, key=lambda x: x.number, default=Trial(0, math.inf, 0))
    steepest, again = 1.5 * (law.claimed or 20), False
    # The first that sufficed: those after it may differ by rounding alone.
    first = next(x.number for x in law.ladder if x.number > low.number)
    first = int(grid.cheaper(np.array([first]))[0])
    if first < high.number:
        trial = measure(first)
        low, high = (trial, high) if trial.error > 1 else (low, trial)
    for _ in range(6):
        between = np.linspace(low.number + 1, high.number - 1, _CANDIDATES).astype(int)
        numbers = np.unique(grid.cheaper(between))
        numbers = numbers[(numbers > low.number) & (numbers < high.number)]
        if (law.extrapolates and high.error >= ENOUGH) or not numbers.size:
            break
        # By the law of convergence, between the two on a log scale. Where the larger
        # step is unstable, errors fall faster than that.
        error, slope = max(high.error, 1e-8), steepest
        if low.number and low.error < math.inf:
            slope = math.log(low.error / error) / math.log(high.number / low.number)
            slope = min(slope, steepest)
        guess = high.number * (error / AIM) ** (1 / slope)
        middle = math.sqrt(low.number * high.number)
        if again:  # Not close to the lower end.
            guess = max(guess, middle)
        guess = guess if law.extrapolates else middle
        trial = measure(int(numbers[np.argmin(np.abs(numbers - guess))]))
        again = trial.error > 1
        low, high = (trial, high) if again else (low, trial)
    return high


def _check_rounding(law: Law):
    """An error if solves have stopped converging, in the precision of the state."""
    change, eps, precision = law.change, law.eps, law.precision
    if precision is None or not all(x < 0.5 for x in law.orders[-2:]):
        return
    settled = 0.65 * (law.claimed or 2)
    settled = any(law.exceeds(settled, i) for i in range(3, len(law.orders)))
    if change < 1e3 * eps or (settled and change < eps**0.5):
        least = min(law.ladder, key=lambda x: x.error)
        double = "double precision (`jax.config.update('jax_enable_x64', True)`), "
        # Only the loop of the package tells the order.
        equal = "`adjoint=FixedStepAdjoint()`, whose steps are all equal, "
        raise RuntimeError(
            f"`choose_step` cannot reach this tolerance in {precision}: from "
            f"{least.steps} steps on, solves with more steps differ by rounding, by "
            f"{least.error:.1e} times the tolerance or more. Use "
            f"{equal if law.claimed is None else ''}`Compensated(solver)`, unless "
            "that is `PresymplecticGauss`, which is compensated already, "
            f"{double if precision == np.float32 else ''}or a larger tolerance."
        )


def _check_hopeless(law: Law, high: Trial, max_steps: int):
    """An error if by three doublings the tolerance is not within reach."""
    four = law.ladder[-4:]
    patience = max(PATIENCE, max_steps // 500)
    if len(four) < 4 or four[0].steps < patience or not four[0].error < math.inf:
        return
    # In favour of solves that begin to converge.
    order = max(four[0].order(four[-1]), law.orders[-1])
    needed = high.steps * high.error ** (1 / order) if order > 0.1 else math.inf
    if needed > 2 * max_steps:
        raise RuntimeError(_exceeds(law, max_steps, needed))


def _exceeds(law: Law | None, max_steps: int, needed: float = math.inf) -> str:
    """The error message where more steps than `max_steps` are needed."""
    if law is None or len(law.ladder) < 2:
        return (
            f"`choose_step(max_steps={max_steps})` is too few steps to find an error: "
            "at least three solves with different numbers of steps are needed."
        )
    last, order, tried = law.ladder[-1], law.orders[-1], law.finest.steps
    claimed = "" if law.claimed is None else f", that of the scheme {law.claimed}"
    found = (
        f"with {last.steps} steps the error is {last.error:.1e} times the tolerance, "
        f"and the measured order {order:.1f}{claimed}"
    )
    finite = [x for x in law.ladder if x.error < math.inf]
    if finite and finite[-1] is not last:
        what, best = "needs more steps than the solve takes", finite[-1]
        found = (
            f"with {best.steps} steps the error is {best.error:.1e} times the "
            "tolerance, and solves with more steps fail"
        )
        advice = (
            "Let the solve take more, `diffeqsolve(..., max_steps=...)`, or use a "
            "larger tolerance."
        )
    elif not finite:
        what, found = "found no finite solution", f"with up to {tried} steps"
        advice = (
            "Check that the solution exists up to `t1`, that force and friction are "
            "finite along it, and that the solve allows as many steps "
            "(`max_steps=None`)."
        )
        if law.finest.missed:
            advice = (
                "`epsilon` was too large each time, beginning with a quarter of the "
                "span: say where to begin, `choose_step(..., first=1.0)`."
            )
    elif not order >= law.least - 0.4:
        what = f"found no regular convergence with up to {tried} steps"
        advice = (
            "Check that the motion is not chaotic, the tolerance above rounding, the "
            "`tolerance` of `PresymplecticGauss` or of a root finder small enough for "
            "so many steps, and the force smooth: if it has kinks or jumps at known "
            "times, write `stepsize_controller=StepsBetween(times)`; otherwise use a "
            "shorter time span, a larger tolerance or, for many fast periods, a larger "
            "`max_steps`."
        )
    else:
        about = f"about {needed:.1e}, more" if needed < math.inf else "more"
        what = f"needs {about} than {max_steps} steps (`max_steps`)"
        high = (law.claimed or order) >= 5
        scheme = "" if high else "a scheme of higher order, "
        advice = (
            f"Use {scheme}a larger tolerance, or let it take more: `max_steps=...`."
        )
    return f"`choose_step` {what}: {found}. {advice}"


def _numbers(grid: int, after: int) -> Iterator[int]:
    """Numbers of steps to try after one, each about twice the last.

    Those above the grid are its multiples by 1, 3, 7, 15, ... No two in succession have
    a common divisor beyond the grid: otherwise all solves might see the same phase of a
    force that is periodic in time, and agree on a wrong solution.
    """
    numbers = [grid]
    while numbers[-1] > 10:
        numbers.append((numbers[-1] - 1) // 2)
    more = (n * grid for n in doubling(3))
    chain = itertools.chain(reversed(numbers), more)
    yield from (n for n in chain if n > 1.5 * after)


def doubling(n: int) -> Iterator[int]:
    """Integers, each about twice the last, without a common divisor."""
    while True:
        yield n
        n = 2 * n + 1
