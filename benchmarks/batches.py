"""Many trajectories at once: time per trajectory under `vmap`, and the error.

Damped pendulums to t = 100 from different starting points. Step sizes and tolerances
are tuned, so that every method has the same error: the largest over the first starting
points, of which the first is the hardest, relative to the largest entry of the
solution. The error next to each time is the largest over the batch, or its first 4096
members. A time is the median of interleaved runs, or one run if that takes seconds.
Solves are omitted if the time for a smaller batch predicts that they take too long, and
if they take more than a million steps.

The other tables are batches of 1024: damped Henon-Heiles systems, whose force is a
polynomial, and the pendulums with what else matters on a CPU: the sine, which XLA
evaluates one by one in double precision, from `diffrax_presym.math`; and the batch cut
into blocks, `jax.lax.map(solve, y0, batch_size=512)`, too small for XLA to spread each
operation over threads, which costs more than it gains at this size. heyoka is
measured if it is installed, as it is used for many trajectories: one after the other,
and as many at a time as the processor has lanes. It runs on one core, where XLA may use
all, so the second column is the time summed over all cores: also the steadier of the
two on a machine with other work.
"""

import dataclasses
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

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

SIZES = (1, 64, 4096, 262144)
TARGETS = (1e-6, 1e-9)
BLOCK = 512
CHECKED = 4096
MOST_STEPS = 1e6


class Method(NamedTuple):
    name: str
    scheme: Scheme
    adaptive: bool = False


OURS = [
    Method(name, SCHEMES[name])
    for name in (
        "PresymplecticLeapfrog",
        "BlanesMoanRKN4",
        "BlanesMoanRKN6",
        "BlanesCasasRKN8",
    )
]
RIVALS = [
    Method(f"{name}, {kind}", DIFFRAX[name], kind == "adaptive")
    for name in ("Tsit5", "Dopri8")
    for kind in ("constant", "adaptive")
]


@dataclasses.dataclass(frozen=True)
class Batch:
    problem: problems.Problem
    # The first `n` starting points, with an array for each coordinate.
    starts: Callable
    # Other ways to write the Hamiltonian, by name.
    variants: dict[str, dps.AbstractHamiltonian]


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


def pendulums():
    problem = problems.pendulum()
    polynomial = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), lambda t, q, args: -jnp.sum(jnp.cos(q)), problem.damping
    )
    return Batch(
        problem,
        # The hardest first.
        lambda n: tuple(spread(n, (2.5, 5.0), (0.0, 1.0))),
        {"XLA's sine": problem.hamiltonian, "polynomial sine": polynomial},
    )


def henon_heiles():
    problem = problems.henon_heiles()

    def starts(n):
        x, y, px, py = spread(n, *[(0.25, 0.5)] * 4)
        return (x, y), (px, py)

    return Batch(problem, starts, {"polynomial force": problem.hamiltonian})


def batched(hamiltonian, t1, method, block=None):
    """`solve(y0, x)`, with `x` the number of steps, or the tolerance."""
    solver, options = method.scheme.solver, {}
    if isinstance(solver, dps.extend.AbstractPresymplecticSolver):
        options["adjoint"] = dps.FixedStepAdjoint()
    one = lambda y0, x: states(
        hamiltonian, solver, (0.0, t1), y0, x, adaptive=method.adaptive, **options
    )
    if block is None:
        return jax.jit(jax.vmap(one, in_axes=(0, None)))
    blocks = lambda y0, x: jax.lax.map(lambda y: one(y, x), y0, batch_size=block)
    return jax.jit(blocks)


def rows(y):
    """A row for each coordinate."""
    leaves = np.array(jax.tree.leaves(y))
    return leaves.reshape(-1, leaves.shape[-1])


class Errors:
    """The largest error over a batch, relative to the largest entry of the solution."""

    def __init__(self, batch, n):
        problem = batch.problem
        times = [0.0, problem.t1]
        ys = reference(problem.hamiltonian, batch.starts(n), times, batch=True)
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
        solve = batched(batch.problem.hamiltonian, batch.problem.t1, method)
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
    lanes = hy.recommended_simd_size()

    def serial(tolerance):
        zeros = np.zeros(len(y0))
        integrator = hy.taylor_adaptive(equations, zeros, tol=tolerance)

        def solve():
            out = np.empty_like(y0)
            for i in range(n):
                integrator.time = 0.0
                integrator.state[:] = y0[:, i]
                integrator.propagate_until(batch.problem.t1)
                out[:, i] = integrator.state
            return out

        return solve

    def in_lanes(tolerance):
        zeros = np.zeros((len(y0), lanes))
        integrator = hy.taylor_adaptive_batch(equations, zeros, tol=tolerance)

        def solve():
            out = np.empty_like(y0)
            for i in range(0, n, lanes):
                integrator.set_time(0.0)
                integrator.state[:] = y0[:, i : i + lanes]
                integrator.propagate_until(batch.problem.t1)
                out[:, i : i + lanes] = integrator.state
            return out

        return solve

    runs = {}
    for name, make in {
        "heyoka, one by one": serial,
        f"heyoka, {lanes} at a time": in_lanes,
    }.items():
        for target in TARGETS:
            # More digits can take less time, so any that reaches the target will do.
            tolerances = [target * 10 ** (-k / 2) for k in range(7)]
            solves = [make(tolerance) for tolerance in tolerances]
            reach = [s for s in solves if errors.of(s()) <= target]
            runs[name, target] = min(reach, key=lambda s: timed(s)[1])
    return runs


def compare_with_heyoka(batch, methods, n, repeats):
    errors = Errors(batch, n)
    tuned = tune_all(batch, methods, errors)
    y0 = batch.starts(n)
    calls: dict[tuple[str, float], Callable] = {}
    for variant, hamiltonian in batch.variants.items():
        for block in (None, BLOCK) if n > BLOCK else (None,):
            how = f"{variant}, {'vmap' if block is None else f'blocks of {block}'}"
            for method in methods:
                solve = batched(hamiltonian, batch.problem.t1, method, block)
                for target in TARGETS:
                    _, x = tuned[method.name, target]
                    if x is not None:
                        key = f"{method.name:17}{how}", target
                        calls[key] = program(solve, y0, x)
    calls |= heyoka_runs(batch, n, errors)
    found = interleaved(calls, repeats)
    table = Table(
        f"{batch.problem.name}, a batch of {n}: microseconds per trajectory, "
        "summed over all cores, and error",
        ":<47",
        *(f"error {target:.0e}:>21" for target in TARGETS),
    )
    for name in dict.fromkeys(name for name, _ in calls):
        row = []
        for target in TARGETS:
            timing = found.get((name, target))
            if timing is not None:
                us, cores = (s / n * 1e6 for s in (timing.median, timing.median_cpu))
                error = errors.of(timing.result)
                row.append(f"{us:.1f} {cores:>7.1f} {error:.0e}")
            else:
                row.append(None)
        table.row(name, *row)
    rivals = {"Diffrax": names(RIVALS)}
    rivals |= {name: name for name, _ in calls if name.startswith("heyoka")}
    table = Table(
        "The best of each over our best: in time (in time summed over all cores)",
        ":<26",
        *(f"{rival}:>21" for rival in rivals),
    )
    for target in TARGETS:
        for variant in batch.variants:
            row = []
            for rival, start in rivals.items():
                share = variant if rival == "Diffrax" else ""
                time, cores = (
                    best(found, target, start, share, clock)
                    / best(found, target, names(OURS), variant, clock)
                    for clock in ("median", "median_cpu")
                )
                row.append(f"{time:.1f} ({cores:.1f})")
            table.row(f"  {target:.0e}, {variant}", *row)


def names(methods):
    return tuple(method.name for method in methods)


def best(found, target, start, contains, clock):
    return min(
        getattr(timing, clock)
        for (name, t), timing in found.items()
        if t == target and name.startswith(start) and contains in name
    )


def main():
    parser = command_line(__doc__)
    parser.add_argument(
        "--longest", type=float, help="omit solves that take more seconds"
    )
    options = parser.parse_args()
    quick = options.quick
    repeats = 1 if quick else 5
    longest = options.longest or (0.3 if quick else 12.0)
    sizes = (1, 64, 256) if quick else SIZES
    print(f"{jax.devices()[0].device_kind}, median of {repeats} runs")
    methods = [OURS[2], RIVALS[3]] if quick else OURS + RIVALS
    scaling(pendulums(), methods, sizes, repeats, longest)
    few = [m for m in methods if m in OURS[2:] + RIVALS[3:]]
    for batch in pendulums(), henon_heiles():
        compare_with_heyoka(batch, few, sizes[-1] if quick else 1024, repeats)


if __name__ == "__main__":
    main()
