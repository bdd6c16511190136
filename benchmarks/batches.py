"""Many trajectories at once: time per trajectory under `vmap`, and the error.

Damped pendulums to t = 100 from different starting points. Step sizes and tolerances
are tuned, so that every method has the same error: the largest over the first starting
points, of which the first is the hardest, relative to the largest entry of the
solution. The error next to each time is the largest over the batch, or its first 4096
members. A time is the median of interleaved runs, or one run if that takes seconds.
Solves are omitted if the time for a smaller batch predicts that they take too long, and
if they take more than a million steps.

The other tables are batches of 1024, of pendulums and of damped Henon-Heiles systems,
whose force is a polynomial, beside heyoka if it is installed, as it is used for many
trajectories: one after the other, and as many at a time as the processor has lanes. It
runs on one core, where XLA may use all, so the second column is the time summed over
all cores: also the steadier of the two on a machine with other work.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import problems
from _report import command_line, Table
from _schemes import DIFFRAX, Scheme, SCHEMES
from _solve import reference, states
from _timing import interleaved, timed
from outside import symbolic


SIZES = (1, 64, 4096, 262144)
TARGETS = (1e-6, 1e-9)
CHECKED = 4096
MOST_STEPS = 1e6


class Method(NamedTuple):
    name: str
    scheme: Scheme
    adaptive: bool = False


NAMES = "PresymplecticLeapfrog BlanesMoanRKN4 BlanesMoanRKN6 BlanesCasasRKN8".split()
OURS = [Method(name, SCHEMES[name]) for name in NAMES]
RIVALS = [
    Method(f"{name}, {kind}", DIFFRAX[name], kind == "adaptive")
    for name in ("Tsit5", "Dopri8")
    for kind in ("constant", "adaptive")
]


class Batch(NamedTuple):
    problem: problems.Problem
    starts: Callable  # the first `n` starting points


def spread(n, *boxes):
    """The first `n` of a sequence that fills a box, of `(first, side)` each way."""
    # A Kronecker sequence by the root of x^(d+1) = x + 1, the golden ratio if d = 1.
    ratio = max(np.roots([1] + [0] * (len(boxes) - 1) + [-1, -1]).real)
    powers = ratio ** -np.arange(1.0, len(boxes) + 1)
    i = np.arange(n)
    return [
        jnp.asarray(side * (0.5 - (i * power + 0.5 - first / side) % 1))
        for power, (first, side) in zip(powers, boxes, strict=True)
    ]


def henon_starts(n):
    x, y, px, py = spread(n, *[(0.25, 0.5)] * 4)
    return (x, y), (px, py)


# The hardest first.
pendulum_starts = lambda n: tuple(spread(n, (2.5, 5.0), (0.0, 1.0)))
PENDULUMS = Batch(problems.pendulum(), pendulum_starts)
HENON_HEILES = Batch(problems.henon_heiles(), henon_starts)


def batched(problem, method):
    """`solve(y0, x)`, with `x` the number of steps, or the tolerance."""
    args = problem.system, method.scheme.solver, (0.0, problem.t1)
    one = lambda y0, x: states(*args, y0, x, adaptive=method.adaptive)
    return jax.jit(jax.vmap(one, in_axes=(0, None)))


def rows(y):
    """A row for each coordinate."""
    leaves = np.array(jax.tree.leaves(y))
    return leaves.reshape(-1, leaves.shape[-1])


class Errors:
    """The largest error over a batch, relative to the largest entry of the solution."""

    def __init__(self, batch, n):
        problem = batch.problem
        times = [0.0, problem.t1]
        ys = reference(problem.system, batch.starts(n), times, batch=True)
        self.exact = rows(jax.tree.map(lambda y: y[:, 0], ys))
        self.largest = np.max(np.abs(self.exact))

    def of(self, y):
        y = rows(y)
        n = min(y.shape[1], self.exact.shape[1])
        return np.max(np.abs(y[:, :n] - self.exact[:, :n])) / self.largest


def tune(solve, method, target, errors, y0):
    """The fewest steps, or the largest tolerance, that reach the target, nearly."""
    x, good = (target if method.adaptive else 300.0), None
    for _ in range(8):
        if x > MOST_STEPS:
            return None
        error = errors.of(solve(y0, jnp.asarray(x)))
        if not math.isfinite(error):
            error = 1.0
        if error <= target:
            good = x
            if error > target / 1.5:
                break
        # A limited change: the order shows only close to the target.
        factor = max(1e-4, min(1e4, 0.8 * target / error))
        if method.adaptive:
            x = max(1e-15, x * factor)
        else:
            x = math.ceil(x * max(0.5, factor ** (-1 / method.scheme.order)))
    return good


def program(solve, y0, x):
    """A compiled solve."""
    x = jnp.asarray(x)
    return functools.partial(solve.lower(y0, x).compile(), y0, x)


def tune_all(batch, methods, errors):
    """The number of steps, or the tolerance, by method and target."""
    tuned = {}
    for method in methods:
        solve = batched(batch.problem, method)
        for target in TARGETS:
            x = tune(solve, method, target, errors, batch.starts(64))
            tuned[method.name, target] = solve, x
    return tuned


def scaling(batch, methods, sizes, repeats, longest):
    errors = Errors(batch, min(max(sizes), CHECKED))
    tuned = tune_all(batch, methods, errors)
    print("\nMicroseconds per trajectory, and error")
    on_cpu = jax.default_backend() == "cpu"
    for target in TARGETS:
        heads = [f"batch of {n}:>15" for n in sizes]
        table = Table("", f"error {target:.0e}:<24", *heads, "per second:>10.0f")
        cells = {method.name: [] for method in methods}
        rates = dict.fromkeys(cells)
        last = dict.fromkeys(cells, 0.0)
        for n in sizes:
            y0 = batch.starts(n)
            short, long = {}, {}
            for method in methods:
                solve, x = tuned[method.name, target]
                # On a GPU larger batches take as long, until it is full.
                expected = last[method.name] * (n if on_cpu else min(n, 64))
                if x is not None and expected < longest:
                    # One run is enough where noise has time to average out.
                    group = short if expected < 1 else long
                    group[method.name] = program(solve, y0, x)
            found = interleaved(short, repeats) | interleaved(long, 1, warm_up=False)
            for name, timing in found.items():
                each = timing.median / n
                last[name] = each if n >= 64 else 0.0
                rates[name] = max(rates[name] or 0.0, 1 / each)
                error = errors.of(timing.result)
                us = each * 1e6
                cells[name].append(f"{us:.{1 if us >= 1 else 3}f} {error:.0e}")
            for name in cells.keys() - found.keys():
                cells[name].append(None)
        for name, row in cells.items():
            table.row(f"  {name}", *row, rates[name])


def heyoka_runs(batch, n, errors):
    """heyoka over a batch: one trajectory at a time, and one per lane."""
    try:
        import heyoka as hy  # pyright: ignore[reportMissingImports]
    except ImportError:
        return {}
    equations = symbolic(batch.problem, hy)
    y0 = rows(batch.starts(n))

    def make(tolerance, lanes):
        zeros = np.zeros((len(y0), lanes) if lanes > 1 else len(y0))
        kind = hy.taylor_adaptive_batch if lanes > 1 else hy.taylor_adaptive
        integrator = kind(equations, zeros, tol=tolerance)

        def solve():
            out = np.empty_like(y0)
            for i in range(0, n, lanes):
                if lanes > 1:
                    integrator.set_time(0.0)
                else:
                    integrator.time = 0.0
                part = slice(i, i + lanes) if lanes > 1 else i
                integrator.state[:] = y0[:, part]
                integrator.propagate_until(batch.problem.t1)
                out[:, part] = integrator.state
            return out

        return solve

    runs, several = {}, hy.recommended_simd_size()
    for name, lanes in {"one by one": 1, f"{several} at a time": several}.items():
        for target in TARGETS:
            # More digits can take less time, so any that reaches the target will do.
            solves = [make(target * 10 ** (-k / 2), lanes) for k in range(7)]
            reach = [s for s in solves if errors.of(s()) <= target]
            best = min(reach, key=lambda s: timed(s)[1])
            runs[f"heyoka, {name}", f"heyoka, {name}", target] = best
    return runs


def compare_with_heyoka(batch, methods, n, repeats):
    errors = Errors(batch, n)
    calls: dict[tuple[str, str, float], Callable] = {}
    for (name, target), (solve, x) in tune_all(batch, methods, errors).items():
        group = "ours" if name in NAMES else "Diffrax"
        if x is not None:
            calls[group, name, target] = program(solve, batch.starts(n), x)
    calls |= heyoka_runs(batch, n, errors)
    found = interleaved(calls, repeats)
    table = Table(
        f"{batch.problem.name}, a batch of {n}: microseconds per trajectory, "
        "summed over all cores, and error",
        *(":<22", *(f"error {target:.0e}:>21" for target in TARGETS)),
    )
    for name in dict.fromkeys(name for _, name, _ in calls):
        cells = dict.fromkeys(TARGETS)
        for (_, other, target), timing in found.items():
            if other == name:
                us, cores = (s / n * 1e6 for s in (timing.median, timing.median_cpu))
                error = errors.of(timing.result)
                cells[target] = f"{us:.1f} {cores:>7.1f} {error:.0e}"
        table.row(name, *cells.values())
    rivals = list(dict.fromkeys(group for group, *_ in calls if group != "ours"))
    table = Table(
        "The best of each over our best: in time (in time summed over all cores)",
        *(":<8", *(f"{rival}:>21" for rival in rivals)),
    )

    def best(group, target, clock):
        keys = (key for key in found if (key[0], key[2]) == (group, target))
        return min((getattr(found[key], clock) for key in keys), default=math.nan)

    for target in TARGETS:
        cells = []
        for rival in rivals:
            both = [
                best(rival, target, clock) / best("ours", target, clock)
                for clock in ("median", "median_cpu")
            ]
            cells.append(f"{both[0]:.1f} ({both[1]:.1f})")
        table.row(f"  {target:.0e}", *cells)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--longest", type=float, help="omit solves that take longer")
    options = parser.parse_args()
    quick = options.quick
    repeats = 1 if quick else 5
    longest = options.longest or (0.3 if quick else 12.0)
    sizes = (1, 64, 256) if quick else SIZES
    print(f"Median of {repeats} runs")
    methods = [OURS[2], RIVALS[3]] if quick else OURS + RIVALS
    scaling(PENDULUMS, methods, sizes, repeats, longest)
    few = [m for m in methods if m in OURS[2:] + RIVALS[3:]]
    for batch in PENDULUMS, HENON_HEILES:
        compare_with_heyoka(batch, few, sizes[-1] if quick else 1024, repeats)


if __name__ == "__main__":
    main()
