"""Many trajectories at once: time per trajectory under `vmap`, beside the error.

Damped pendulums to t = 100 from different starting points. Step sizes and tolerances
are tuned, so that every method has the same error: the largest over the first starting
points, of which the first is the hardest, relative to the largest entry of the
solution, against tiny steps of Dopri8. The error beside each time is the largest over
the batch, or its first 4096 members. Everything runs in one process, compiled and
warmed up, by turns; a number is the median, or one run if that takes seconds. Where the
time for a smaller batch says that a solve would take too long, and where it would take
more than a million steps, it is left out.

The other tables are batches of 1024: damped Henon-Heiles systems, whose force is a
polynomial, and the pendulums with what else matters on a CPU: the sine, which XLA
evaluates one by one in double precision, written as a polynomial; and the batch cut
into blocks, `jax.lax.map(solve, y0, batch_size=512)`, too small for XLA to spread each
operation over threads, which costs more than it gains at this size. heyoka is
measured if it is installed, as it is used for many trajectories: one after the other,
and as many at a time as the processor has lanes. It runs on one core, where XLA may use
all, so the second column is the time of all cores together: also the steadier of the
two on a machine with other work.
"""

import argparse
import dataclasses
import math
import statistics
import time
from collections.abc import Callable

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import problems
from outside import symbolic

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

SIZES = (1, 64, 4096, 262144)
TARGETS = (1e-6, 1e-9)
BLOCK = 512
CHECKED = 4096
MOST_STEPS = 1e6


@dataclasses.dataclass(frozen=True)
class Method:
    name: str
    solver: dfx.AbstractSolver
    order: int
    adaptive: bool = False


OURS = [
    Method("PresymplecticLeapfrog", dps.PresymplecticLeapfrog(), 2),
    Method("BlanesMoanRKN4", dps.BlanesMoanRKN4(), 4),
    Method("BlanesMoanRKN6", dps.BlanesMoanRKN6(), 6),
    Method("BlanesCasasRKN8", dps.BlanesCasasRKN8(), 8),
]
DIFFRAX = [
    Method("Tsit5, constant", dfx.Tsit5(), 5),
    Method("Tsit5, adaptive", dfx.Tsit5(), 5, adaptive=True),
    Method("Dopri8, constant", dfx.Dopri8(), 8),
    Method("Dopri8, adaptive", dfx.Dopri8(), 8, adaptive=True),
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
    # The powers of the root of x^(d+1) = x + 1, the golden ratio's kin.
    ratio = max(np.roots([1] + [0] * (len(boxes) - 1) + [-1, -1]).real)
    powers = ratio ** -np.arange(1.0, len(boxes) + 1)
    i = np.arange(n)
    return [
        jnp.asarray(side * (0.5 - (i * power + 0.5 - first / side) % 1))
        for power, (first, side) in zip(powers, boxes, strict=True)
    ]


def polynomial_sine(x):
    """The sine to 2e-16 for moderate arguments, of what XLA can vectorise."""
    turns = jnp.round(x / math.pi)
    x = (x - turns * math.pi) - turns * 1.2246467991473532e-16
    square, series = x * x, 0.0
    for k in range(10, 0, -1):
        series = (series + (-1) ** k / math.factorial(2 * k + 1)) * square
    x = x + x * series
    return jnp.where(turns - 2 * jnp.floor(turns / 2) == 0, x, -x)


def pendulums():
    problem = problems.pendulum()
    polynomial = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        problem.hamiltonian.damping,
        force=lambda t, q, args: -polynomial_sine(q),
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
    term = dps.HamiltonianTerm(hamiltonian)

    def one(y0, x):
        controller = dfx.ConstantStepSize()
        if method.adaptive:
            controller = dfx.PIDController(rtol=x, atol=x)
        sol = dfx.diffeqsolve(
            term,
            method.solver,
            t0=0.0,
            t1=t1,
            dt0=None if method.adaptive else t1 / x,
            y0=y0,
            max_steps=None,
            throw=False,
            stepsize_controller=controller,
        )
        return jax.tree.map(lambda y: y[-1], sol.ys)

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
        fine = batched(batch.problem.hamiltonian, batch.problem.t1, DIFFRAX[2])
        y0 = batch.starts(n)
        self.exact = rows(fine(y0, jnp.asarray(4e3)))
        self.largest = np.max(np.abs(self.exact))
        assert self.of(fine(y0, jnp.asarray(3e3))) < 1e-12

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
        # Never by too much at once: far from the target the order is not yet seen.
        factor = max(1e-4, min(1e4, 0.8 * target / error))
        if method.adaptive:
            x = max(1e-15, x * factor)
        else:
            x = math.ceil(x * max(0.5, factor ** (-1 / method.order)))
    return good


def timed(call):
    """The result, the seconds, and the seconds of all cores together."""
    cpu, start = time.process_time(), time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - start, time.process_time() - cpu


def by_turns(calls, repeats):
    """For each call its result, and the medians of both times."""
    rounds = [[timed(call) for call in calls.values()] for _ in range(repeats)]
    results = {}
    for name, of_one in zip(calls, zip(*rounds, strict=True), strict=True):
        (*_, y), seconds, cores = zip(*of_one, strict=True)
        results[name] = y, statistics.median(seconds), statistics.median(cores)
    return results


def program(solve, y0, x, warm=True):
    """A compiled solve, called once before it counts."""
    compiled = solve.lower(y0, jnp.asarray(x)).compile()
    call = lambda: compiled(y0, jnp.asarray(x))
    if warm:
        jax.block_until_ready(call())
    return call


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
    head = "".join(f"{f'batch of {n}':>16}" for n in sizes)
    print(f"\nMicroseconds per trajectory, and error\n{'':24}{head}{'per second':>11}")
    for target in TARGETS:
        cells = {method.name: [] for method in methods}
        rates = dict.fromkeys(cells, 0.0)
        last = dict.fromkeys(cells, 0.0)
        for n in sizes:
            y0 = batch.starts(n)
            short, long = {}, {}
            for method in methods:
                solve, x = tuned[method.name, target]
                expected = last[method.name] * n
                if x is not None and expected < longest:
                    # One run is enough where noise has time to average out.
                    group = short if expected < 1 else long
                    group[method.name] = program(solve, y0, x, warm=group is short)
            found = by_turns(short, repeats) | by_turns(long, 1)
            for name, (y, seconds, _) in found.items():
                each = seconds / n
                last[name] = each if n >= 64 else 0.0
                rates[name] = max(rates[name], 1 / each)
                cells[name].append(f"{each * 1e6:.1f} {errors.of(y):.0e}")
            for name in cells.keys() - found.keys():
                cells[name].append("-")
        print(f"error {target:.0e}")
        for name, row in cells.items():
            rate = f"{rates[name]:>11.0f}" if rates[name] else f"{'-':>11}"
            print(f"  {name:22}" + "".join(f"{c:>16}" for c in row) + rate, flush=True)


def heyoka_runs(batch, n, errors):
    """heyoka over a batch: one by one, and by the lanes of the processor."""
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
            fastest = min(reach, key=lambda s: timed(s)[1])
            runs[name, target] = fastest
    return runs


def beside_heyoka(batch, methods, n, repeats):
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
    found = by_turns(calls, repeats)
    print(
        f"\n{batch.problem.name}, a batch of {n}: microseconds per trajectory, "
        f"of all cores, and error\n{'':48}"
        + "".join(f"{f'error {t:.0e}':>22}" for t in TARGETS)
    )
    for name in dict.fromkeys(name for name, _ in calls):
        row = ""
        for target in TARGETS:
            cell = "-"
            if (name, target) in found:
                y, *times = found[name, target]
                us = [t / n * 1e6 for t in times]
                cell = f"{us[0]:.1f} {us[1]:>7.1f} {errors.of(y):.0e}"
            row += f"{cell:>22}"
        print(f"{name:48}{row}")
    print("\nThe best of each over our best: in time (in time of all cores)")
    rivals = {"Diffrax": names(DIFFRAX)}
    rivals |= {name: name for name, _ in calls if name.startswith("heyoka")}
    print(f"{'':26}" + "".join(f"{rival:>22}" for rival in rivals))
    for target in TARGETS:
        for variant in batch.variants:
            row = []
            for rival, start in rivals.items():
                share = variant if rival == "Diffrax" else ""
                time, cores = (
                    best(found, target, start, share, clock)
                    / best(found, target, names(OURS), variant, clock)
                    for clock in (1, 2)
                )
                row.append(f"{time:.1f} ({cores:.1f})")
            case = f"{target:.0e}, {variant}"
            print(f"  {case:24}" + "".join(f"{cell:>22}" for cell in row))


def names(methods):
    return tuple(method.name for method in methods)


def best(found, target, start, contains, clock):
    return min(
        result[clock]
        for (name, t), result in found.items()
        if t == target and name.startswith(start) and contains in name
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    parser.add_argument(
        "--longest", type=float, help="leave out solves that take more seconds"
    )
    options = parser.parse_args()
    quick = options.quick
    repeats = 1 if quick else 5
    longest = options.longest or (0.3 if quick else 12.0)
    sizes = (1, 64, 256) if quick else SIZES
    print(f"{jax.devices()[0].device_kind}, median of {repeats} runs")
    methods = [OURS[2], DIFFRAX[3]] if quick else OURS + DIFFRAX
    scaling(pendulums(), methods, sizes, repeats, longest)
    few = [m for m in methods if m in OURS[2:] + DIFFRAX[3:]]
    for batch in pendulums(), henon_heiles():
        beside_heyoka(batch, few, sizes[-1] if quick else 1024, repeats)


if __name__ == "__main__":
    main()
