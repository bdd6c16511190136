"""Many trajectories at once: time per trajectory under `vmap`, beside the error.

Damped pendulums to t = 100 from different starting points. Step sizes and tolerances
are tuned, so that every method has the same error: the largest over the first starting
points, of which the first is the hardest, relative to the largest entry of the
solution, against tiny steps of Dopri8. The error beside each time is the largest over
the batch, or its first 4096 members. Everything runs in one process, compiled and
warmed up, by turns; a number is the median, or one run if that takes seconds. Where the
time for a smaller batch says that a solve would take too long, and where it would take
more than a million steps, it is left out.

The second table is a batch of 1024 with what else matters on a CPU: the sine, which XLA
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

PENDULUM = problems.pendulum()
T1 = PENDULUM.t1
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


def starts(n):
    """The first `n` of a sequence that fills a square evenly, hardest start first."""
    i = np.arange(n)
    q0 = 2.5 - 5 * (i * 0.7548776662466927 % 1)
    p0 = (i * 0.5698402909980532 + 0.5) % 1 - 0.5
    return jnp.asarray(q0), jnp.asarray(p0)


def polynomial_sine(x):
    """The sine to 2e-16 for moderate arguments, of what XLA can vectorise."""
    turns = jnp.round(x / math.pi)
    x = (x - turns * math.pi) - turns * 1.2246467991473532e-16
    square, series = x * x, 0.0
    for k in range(10, 0, -1):
        series = (series + (-1) ** k / math.factorial(2 * k + 1)) * square
    x = x + x * series
    return jnp.where(turns - 2 * jnp.floor(turns / 2) == 0, x, -x)


def with_polynomial():
    return dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(0.1),
        force=lambda t, q, args: -polynomial_sine(q),
    )


def batched(hamiltonian, method, block=None):
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
            t1=T1,
            dt0=None if method.adaptive else T1 / x,
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


class Errors:
    """The largest error over a batch, relative to the largest entry of the solution."""

    def __init__(self, n):
        fine = batched(PENDULUM.hamiltonian, DIFFRAX[2])
        self.exact, coarser = (
            np.array(fine(starts(n), jnp.asarray(steps))) for steps in (4e3, 3e3)
        )
        self.largest = np.max(np.abs(self.exact))
        assert self.of(coarser) < 1e-12

    def of(self, y):
        n = min(len(y[0]), self.exact.shape[1])
        y = np.array([np.asarray(x[:n]) for x in y])
        return np.max(np.abs(y - self.exact[:, :n])) / self.largest


def tune(solve, method, target, errors):
    """The fewest steps, or the largest tolerance, that reach the target, nearly."""
    y0 = starts(64)
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


def scaling(tuned, methods, sizes, repeats, longest, errors):
    head = "".join(f"{f'batch of {n}':>18}" for n in sizes)
    print(
        f"\nMicroseconds per trajectory, and error\n{'':24}{head}{'trajectories/s':>16}"
    )
    for target in TARGETS:
        cells = {method.name: [] for method in methods}
        rates = dict.fromkeys(cells, 0.0)
        last = dict.fromkeys(cells, 0.0)
        for n in sizes:
            y0 = starts(n)
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
                cells[name].append(f"{each * 1e6:>10.1f} {errors.of(y):.0e}")
            for name in cells.keys() - found.keys():
                cells[name].append("-")
        print(f"error {target:.0e}")
        for name, row in cells.items():
            rate = f"{rates[name]:>16.0f}" if rates[name] else f"{'-':>16}"
            print(f"  {name:22}" + "".join(f"{c:>18}" for c in row) + rate, flush=True)


def heyoka_runs(n, errors):
    """heyoka over a batch: one by one, and by the lanes of the processor."""
    try:
        import heyoka as hy  # pyright: ignore[reportMissingImports]
    except ImportError:
        return {}
    equations = symbolic(PENDULUM, hy)
    y0 = np.array(starts(n))
    lanes = hy.recommended_simd_size()

    def serial(tolerance):
        integrator = hy.taylor_adaptive(equations, np.zeros(2), tol=tolerance)

        def solve():
            out = np.empty_like(y0)
            for i in range(n):
                integrator.time = 0.0
                integrator.state[:] = y0[:, i]
                integrator.propagate_until(T1)
                out[:, i] = integrator.state
            return out

        return solve

    def in_lanes(tolerance):
        zeros = np.zeros((2, lanes))
        integrator = hy.taylor_adaptive_batch(equations, zeros, tol=tolerance)

        def solve():
            out = np.empty_like(y0)
            for i in range(0, n, lanes):
                integrator.set_time(0.0)
                integrator.state[:] = y0[:, i : i + lanes]
                integrator.propagate_until(T1)
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


def beside_heyoka(tuned, methods, n, repeats, errors):
    y0 = starts(n)
    calls: dict[tuple[str, float], Callable] = {}
    sines = {"XLA's sine": PENDULUM.hamiltonian, "polynomial": with_polynomial()}
    for sine, hamiltonian in sines.items():
        for block in (None, BLOCK) if n > BLOCK else (None,):
            how = f"{sine}, {'vmap' if block is None else f'blocks of {block}'}"
            for method in methods:
                solve = batched(hamiltonian, method, block)
                for target in TARGETS:
                    _, x = tuned[method.name, target]
                    if x is not None:
                        key = f"{method.name:20} {how}", target
                        calls[key] = program(solve, y0, x)
    calls |= heyoka_runs(n, errors)
    found = by_turns(calls, repeats)
    print(f"\nA batch of {n}: microseconds per trajectory, of all cores, and error")
    print(f"{'':46}" + "".join(f"{f'error {t:.0e}':>24}" for t in TARGETS))
    for name in dict.fromkeys(name for name, _ in calls):
        row = ""
        for target in TARGETS:
            cell = "-"
            if (name, target) in found:
                y, *times = found[name, target]
                us = [t / n * 1e6 for t in times]
                cell = f"{us[0]:.1f} {us[1]:>7.1f} {errors.of(y):.0e}"
            row += f"{cell:>24}"
        print(f"{name:46}{row}")
    print("\nThe best of each over our best: in time (in time of all cores)")
    rivals = {"Diffrax": names(DIFFRAX)}
    rivals |= {name: name for name, _ in calls if name.startswith("heyoka")}
    for target in TARGETS:
        for sine in sines:
            row = []
            for rival, start in rivals.items():
                share = sine if rival == "Diffrax" else ""
                time, cores = (
                    best(found, target, start, share, clock)
                    / best(found, target, names(OURS), sine, clock)
                    for clock in (1, 2)
                )
                row.append(f"{rival} {time:.1f} ({cores:.1f})")
            print(f"  at {target:.0e}, {sine}: " + ", ".join(row))


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
    errors = Errors(min(max(sizes), CHECKED))
    tuned = {}
    methods = [OURS[2], DIFFRAX[3]] if quick else OURS + DIFFRAX
    for method in methods:
        solve = batched(PENDULUM.hamiltonian, method)
        for target in TARGETS:
            tuned[method.name, target] = solve, tune(solve, method, target, errors)
    scaling(tuned, methods, sizes, repeats, longest, errors)
    few = [m for m in methods if m in OURS[2:] + DIFFRAX[3:]]
    beside_heyoka(tuned, few, sizes[-1] if quick else 1024, repeats, errors)


if __name__ == "__main__":
    main()
