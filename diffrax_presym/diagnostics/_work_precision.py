"""Error against time, of solves that a user gives."""

import functools
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from .._step_size._solution import (
    check_number,
    check_times,
    scaled_error,
    Solution,
)


Solve = Callable[[Any], Any]


class WorkPrecisionRun(NamedTuple):
    """One solve of `diagnostics.work_precision`.

    **Attributes:**

    - `name`: the name of the solve.
    - `error`: the largest error of a saved entry, over `atol + rtol * size`: at most
        one where the tolerance is reached.
    - `seconds`: the time of a call, a median.
    - `steps`: the number of steps, rejected ones included.
    - `setting`: the `dt0`, or the tolerance of an adaptive solve.
    """

    name: str
    error: float
    seconds: float
    steps: int
    setting: float


class WorkPrecision(NamedTuple):
    """The measurements of `diagnostics.work_precision`.

    **Attributes:**

    - `runs`: a `diagnostics.WorkPrecisionRun` for each solve and each of its steps or
        tolerances.
    - `reference`: the name of the solve whose finest solution the errors refer to.
    - `missing`: the names of the solves whose errors were never within the `decades`.
    """

    runs: tuple[WorkPrecisionRun, ...]
    reference: str
    missing: tuple[str, ...] = ()

    def fastest(self, error: float = 1.0) -> WorkPrecisionRun:
        """The fastest run whose error is at most so many times the tolerance.

        **Raises:**

        `ValueError` if there is none.
        """
        good = [run for run in self.runs if run.error <= error]
        if not good:
            raise ValueError(f"No solve has an error of {error} times the tolerance.")
        return min(good, key=lambda run: run.seconds)

    def __str__(self) -> str:
        width = max(len(run.name) for run in self.runs)
        lines = [f"{'solve':{width}}  {'steps':>8}  {'error':>8}  {'time (ms)':>9}"]
        lines += [
            f"{run.name:{width}}  {run.steps:8}  {run.error:8.1e}  "
            f"{1e3 * run.seconds:9.3f}"
            for run in self.runs
        ]
        lines.append(f"errors over the tolerance, against {self.reference!r}")
        if self.missing:
            lines.append(f"never near the tolerance: {', '.join(self.missing)}")
        return "\n".join(lines)


def work_precision(
    solves: Mapping[str, Solve],
    t0,
    t1,
    *,
    rtol: float,
    atol: float,
    adaptive: Mapping[str, Solve] | None = None,
    decades: int = 2,
    repeats: int = 5,
    max_steps: int = 1_000_000,
) -> WorkPrecision:
    """Speed against error: the time of each solve, at errors around a tolerance.

    Each solve is repeated with more and more steps, until it converges. The errors of
    all are measured against one reference, the converged solution with which the most
    solves agree: a solve that converges to something else is never the fastest.

    !!! example

        ```python
        system = MechanicalSystem(QuadraticKinetic(), QuadraticPotential())
        y0 = jnp.ones(1), jnp.zeros(1)

        def solve_by(solver):
            return jax.jit(
                lambda dt0: diffeqsolve(
                    system, solver, 0.0, 20.0, dt0, y0, max_steps=None
                )
            )

        solves = {"TunedRKN6": solve_by(TunedRKN6()), "Dopri8": solve_by(dfx.Dopri8())}
        result = dps.diagnostics.work_precision(
            solves, 0.0, 20.0, rtol=1e-4, atol=1e-4, decades=1
        )
        print(result, result.fastest().name)
        ```

    **Arguments:**

    - `solves`: names, and functions of the step `dt0` that return a `diffrax.Solution`,
        as for `choose_step`. They should be jitted.
    - `t0`, `t1`: the start and the end of the solves.
    - `rtol`, `atol`: the tolerance, for each entry of what is saved.
    - `adaptive`: names, and functions of a relative tolerance that return a
        `diffrax.Solution`. Defaults to none.
    - `decades`: how many powers of ten around the tolerance are measured.
    - `repeats`: the number of calls of which the median time is taken.
    - `max_steps`: the largest number of steps of a solve.

    **Returns:**

    A `diagnostics.WorkPrecision`, which prints as a table;
    `diagnostics.plot_work_precision` draws it.

    **Raises:**

    `ValueError` if an argument is not valid, or the solves do not save the same;
    `RuntimeError` if no solve converges.
    """
    t0, t1 = check_times(t0, t1, "work_precision")
    tolerance = (
        check_number(rtol, "work_precision(rtol=...)"),
        check_number(atol, "work_precision(atol=...)"),
    )
    if not solves or not any(tolerance):
        raise ValueError(
            "`work_precision` needs at least one solve and a positive tolerance: "
            "`work_precision({name: solve}, t0, t1, rtol=1e-6, atol=1e-6)`."
        )
    span, goal = t1 - t0, 10.0**-decades
    finest = {
        name: _converged(
            lambda n, solve=solve: Solution.of(n, solve, span / n),
            *(tolerance, goal, max_steps),
        )
        for name, solve in solves.items()
    }
    finest = {name: x for name, x in finest.items() if x is not None}
    if not finest:
        raise RuntimeError(
            f"No solve converges to {goal:.0e} of the tolerance with up to {max_steps} "
            "steps. Use a larger tolerance, or a scheme of higher order."
        )
    reference = _agreed(finest, tolerance)
    exact = finest[reference].leaves
    steps = [(n, span / n) for n in _ladder(max_steps)]
    coarse = (tolerance[0] or tolerance[1]) / goal
    levels = [coarse * 10 ** (-k / 2) for k in range(4 * decades + 5)]
    tasks = [(*x, steps) for x in solves.items()]
    tasks += [(*x, [(0, level) for level in levels]) for x in (adaptive or {}).items()]
    measured, calls = [], []
    for name, solve, settings in tasks:
        for error, number, x in _measured(solve, settings, exact, tolerance, goal):
            measured.append((name, error, number, x))
            calls.append(functools.partial(solve, x))
    rows = zip(measured, _medians(calls, repeats), strict=True)
    runs = tuple(
        WorkPrecisionRun(name, error, seconds, number, x)
        for (name, error, number, x), seconds in rows
    )
    found = {run.name for run in runs}
    missing = tuple(name for name, *_ in tasks if name not in found)
    return WorkPrecision(runs, reference, missing)


def _measured(
    solve: Solve, settings, exact: list[np.ndarray], tolerance, goal: float
) -> Iterator[tuple[float, int, float]]:
    """The errors around the tolerance, the numbers of steps and the settings; at least
    those of the fastest that is accurate."""
    least = 0.0
    for number, x in settings:
        solution = Solution.of(number, solve, x)
        error = _error(solution, exact, tolerance)
        if least <= error <= 1 / goal:
            yield error, solution.steps, x
            least = goal / 10
        if error < goal:
            return


def _ladder(max_steps: int):
    """Numbers of steps, each about the root of two times the last, mostly odd: even
    ones might all see the same phase of a periodic force."""
    number = 5.0
    while number <= max_steps:
        yield round(number) | 1
        number *= 2**0.5


def _error(solution: Solution, exact: list[np.ndarray], tolerance) -> float:
    if not solution.finite:
        return np.inf
    shapes = [[np.shape(x) for x in each] for each in (solution.leaves, exact)]
    if shapes[0] != shapes[1]:
        raise ValueError(
            "The solves of `work_precision` must save the same, but one saves arrays "
            f"of shapes {shapes[0]} and another of shapes {shapes[1]}. Pass the same "
            "`saveat` to all."
        )
    return scaled_error(solution.leaves, exact, *tolerance)


def _converged(
    solve: Callable[[int], Solution], tolerance, goal: float, max_steps: int
) -> Solution | None:
    """The first solution that differs from that of half as many steps by less than a
    tenth of the goal."""
    last, n = None, 5
    while n <= max_steps:
        solution = solve(n)
        if last is not None and last.finite:
            if _error(solution, last.leaves, tolerance) < goal / 10:
                return solution
        last, n = solution, 2 * n + 1
    return None


def _agreed(finest: Mapping[str, Solution], tolerance) -> str:
    """The solve with which the most others agree, of these that with the most steps."""
    agree = lambda a, b: _error(a, b.leaves, tolerance) <= 1
    votes = {
        name: sum(agree(other, solution) for other in finest.values())
        for name, solution in finest.items()
    }
    return max(finest, key=lambda name: (votes[name], finest[name].steps))


def _medians(calls: list[Callable], repeats: int) -> list[float]:
    """The median time of each call, all of them alternately."""
    seconds: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, times in zip(calls, seconds, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(call())
            times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in seconds]
