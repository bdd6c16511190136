"""The timer of the benchmarks.

Calls that are compared run interleaved in one process, after one untimed call of each
that compiles and warms up. A time is the median over the rounds, and a ratio the median
of the ratios of each round, so that a change of the load on the machine affects both
sides alike.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from _report import Table
from _schemes import DIFFRAX


@dataclasses.dataclass(frozen=True)
class Timing:
    result: Any
    # Of each round, by the clock and summed over all cores.
    seconds: np.ndarray
    cpu_seconds: np.ndarray

    @property
    def median(self):
        return float(np.median(self.seconds))

    @property
    def median_cpu(self):
        return float(np.median(self.cpu_seconds))

    def over(self, other):
        return float(np.median(self.seconds / other.seconds))


def timed(call):
    """The result, the seconds, and the seconds summed over all cores."""
    cpu, start = time.process_time(), time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - start, time.process_time() - cpu


def interleaved(
    calls: Mapping[Any, Callable],
    repeats: int,
    *,
    warm_up: bool = True,
    setup: Callable = lambda: None,
) -> dict[Any, Timing]:
    """Times calls without arguments, each once per round.

    `setup` runs before each of them, untimed.
    """
    if warm_up:
        for call in calls.values():
            jax.block_until_ready(call())
    rounds = {key: [] for key in calls}
    results = {}
    for _ in range(repeats):
        for key, call in calls.items():
            setup()
            results[key], *both = timed(call)
            rounds[key].append(both)
    return {
        key: Timing(results[key], *np.array(both).T) for key, both in rounds.items()
    }


def error_curves(
    runs: Mapping[Any, tuple[Callable, list]],
    error: Callable,
    repeats: int,
    enough: tuple[float, float] | None = None,
    cost: Callable = lambda key, result: math.nan,
) -> dict[Any, list[tuple[float, float, float]]]:
    """The points `(error, seconds, cost)` of every run, a solve and its sweep.

    `error` maps what the solve returns to a number; points that are not finite are
    omitted. `cost` is of the run and of what the solve returns. Sweeps in order of cost
    end at an error that is small `enough`, or at a run that takes so many seconds.
    """
    least, longest = (0.0, math.inf) if enough is None else enough
    errors, costs, calls = {}, {}, {}
    for key, (solve, sweep) in runs.items():
        # The first call after another function's is slow to start.
        calls[key, None] = functools.partial(solve, sweep[0])
        for i, x in enumerate(sweep):
            call = functools.partial(solve, x)
            if i == 0:
                jax.block_until_ready(call())  # compiles
            result, seconds, _ = timed(call)
            found = float(error(result))
            if math.isfinite(found):
                errors[key, i], calls[key, i] = found, call
                costs[key, i] = float(cost(key, result))
            if found < least / 3 or seconds > longest:
                break
    timings = interleaved(calls, repeats, warm_up=False)
    curves = {key: [] for key in runs}
    for (key, i), found in errors.items():
        curves[key].append((found, timings[key, i].median, costs[key, i]))
    return {key: curve for key, curve in curves.items() if curve}


def diffrax_runs(run, group, counts, tolerances, quick):
    """Runs of Diffrax's schemes, functions of a solver and whether it is adaptive, and
    their sweeps."""
    runs = {}
    for name in ("Dopri8",) if quick else ("Dopri8", "Tsit5"):
        solver = DIFFRAX[name].solver
        runs[group, f"{name}, adaptive"] = run(solver, adaptive=True), tolerances
        if not quick:
            runs[group, f"{name}, constant"] = run(solver), counts
    return runs


def print_least(caption, curves, targets, ours):
    """Tables of the least time to an error, in milliseconds, of each run, and of each
    group over that of `ours`."""
    columns = [f"{target:.0e}:>8.2f" for target in targets]
    both = "kind:<21", "solver:<29"
    table = Table(f"{caption}: milliseconds to an error", *both, *columns)
    for (group, name), curve in curves.items():
        table.row(group, name, *(1e3 * least_to(curve, x) for x in targets))
    table = Table(f"The least time of each kind over that of {ours}", both[0], *columns)
    for group in dict.fromkeys(group for group, _ in curves if group != ours):
        table.row(group, *ratios(curves, targets, group, ours))


def least_to(curve, target, by=1):
    """The least time, or cost, to reach an error, between the points on a log scale."""
    best = math.inf
    points = sorted(((p[0], p[by]) for p in curve), key=lambda point: point[1])
    for i, (error, seconds) in enumerate(points):
        if error <= target:
            best = min(best, seconds)
            # The nearest less accurate point bounds the crossing from below.
            worse = [p for p in points[:i] if p[0] > target]
            if worse:
                e, s = min(worse)
                slope = math.log(seconds / s) / math.log(e / max(error, 1e-16))
                best = min(best, s * (e / target) ** slope)
    return best


def fastest(curves, target, group, by=1):
    """The least time to reach an error of a group of `(group, name)`, and its name."""
    found = (
        (least_to(curve, target, by), name)
        for (kind, name), curve in curves.items()
        if kind == group
    )
    return min((x for x in found if x[0] < math.inf), default=(math.inf, "-"))


def ratios(curves, targets, group, ours):
    """The least times of a group over those of `ours`; infinite if not reached."""
    pairs = [[fastest(curves, x, g)[0] for g in (group, ours)] for x in targets]
    return [a / b if b < math.inf else math.inf for a, b in pairs]
