"""Time to reach an error: our schemes beside Diffrax's, and others from outside JAX.

For each problem every method is run over a sweep of step sizes or tolerances, in one
process, compiled and warmed up, all by turns. A point is the median time and the error
of the solution at the final time: the largest entry, relative to that of the solution,
since damping shrinks both, against a reference better than 1e-14. Tables give the time
to reach an error, read off each method's curve, and the geometric mean over the
problems of (best Diffrax solver) / (our best). The picture goes to `docs/img/`. SciPy,
heyoka, pyhamsys and symplecta are measured if they are installed.
"""

import argparse
import math
import pathlib
import platform
import statistics
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import problems
from matplotlib.lines import Line2D
from outside import heyoka_runs, pyhamsys_runs, scipy_runs, STEPS, symplecta_runs

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

HERE = pathlib.Path(__file__).parent
TARGETS = (1e-3, 1e-6, 1e-9)
TOLERANCES = tuple(10.0**-k for k in range(2, 14))

# Each with the longest of its steps, which are halved from there: stages of 0.4.
OURS = {
    "PresymplecticLeapfrog": (dps.PresymplecticLeapfrog(), 1),
    "Suzuki4": (dps.Suzuki4(), 5),
    "SofroniouSpaletta8": (dps.SofroniouSpaletta8(), 21),
    "BlanesMoan4": (dps.BlanesMoan4(), 6),
    "BlanesMoan6": (dps.BlanesMoan6(), 10),
    "BlanesMoanRKN4": (dps.BlanesMoanRKN4(), 6),
    "BlanesMoanRKN6": (dps.BlanesMoanRKN6(), 14),
    "BlanesCasasRKN8": (dps.BlanesCasasRKN8(), 19),
    "TunedRKN6": (dps.TunedRKN6(), 14),
    "TunedLinear8": (dps.TunedLinear8(), 14),
}
DIFFRAX = {"Tsit5": dfx.Tsit5(), "Dopri5": dfx.Dopri5(), "Dopri8": dfx.Dopri8()}


def constant(problem, terms, solver, back=lambda y: y):
    @jax.jit
    def solve(steps):
        sol = dfx.diffeqsolve(
            terms,
            solver,
            t0=0.0,
            t1=problem.t1,
            dt0=problem.t1 / steps,
            y0=problem.y0,
            max_steps=None,
            throw=False,
        )
        return back(jax.tree.map(lambda y: y[-1], sol.ys))

    return solve


def adaptive(problem, solver):
    term = dps.HamiltonianTerm(problem.hamiltonian)

    @jax.jit
    def solve(tolerance):
        sol = dfx.diffeqsolve(
            term,
            solver,
            t0=0.0,
            t1=problem.t1,
            dt0=None,
            y0=problem.y0,
            max_steps=None,
            throw=False,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        )
        return jax.tree.map(lambda y: y[-1], sol.ys)

    return solve


def semi_implicit_euler(problem):
    """Diffrax's only symplectic solver, on the canonical equations it can do."""
    h = problem.hamiltonian
    velocity = lambda t, P, args: h.velocity(t, None, h.from_canonical(t, P))
    force = lambda t, q, args: h.to_canonical(t, h.force(t, q, None))
    back = lambda y: (y[0], h.from_canonical(problem.t1, y[1]))
    terms = (dfx.ODETerm(velocity), dfx.ODETerm(force))
    return constant(problem, terms, dfx.SemiImplicitEuler(), back)


def step_counts(problem, stages, quick):
    """Numbers of steps by factors of the square root of two."""
    most = 4e3 if len(problem.q0) >= 1000 else 2e4 if quick else 1e5
    least = problem.t1 / (0.8 * stages)
    count = max(1, math.ceil(2 * math.log2(most / stages / least)))
    return [math.ceil(least * 2 ** (k / 2)) for k in range(count)]


def all_runs(problem, quick):
    """Every method, as `(group, name, solve, sweep)`."""
    term = dps.HamiltonianTerm(problem.hamiltonian)
    runs = []
    for name, (solver, stages) in OURS.items():
        if "Linear" in name and not problem.linear:
            continue
        sweep = [jnp.asarray(n) for n in step_counts(problem, stages, quick)]
        runs.append(("ours", name, constant(problem, term, solver), sweep))
    for name, solver in DIFFRAX.items():
        tolerances = [jnp.asarray(x) for x in TOLERANCES]
        run = adaptive(problem, solver)
        runs.append(("diffrax", f"{name}, adaptive", run, tolerances))
        stages = {"Dopri8": 13}.get(name, 6)
        sweep = [jnp.asarray(n) for n in step_counts(problem, stages, quick)]
        run = constant(problem, term, solver)
        runs.append(("diffrax", f"{name}, constant", run, sweep))
    sweep = [jnp.asarray(n) for n in step_counts(problem, 1, quick)]
    run = semi_implicit_euler(problem)
    runs.append(("diffrax", "SemiImplicitEuler", run, sweep))
    tolerances = TOLERANCES[1::4] if quick else TOLERANCES
    runs += heyoka_runs(problem, tolerances)
    runs += scipy_runs(problem, tolerances[::2])
    steps = STEPS[:2] if quick else STEPS
    runs += pyhamsys_runs(problem, steps) + symplecta_runs(problem, steps)
    return runs


def measure(problem, repeats, quick):
    """`{(group, name): [(error, seconds), ...]}`, the points that are finite."""
    exact = problems.reference(problem)
    runs = all_runs(problem, quick)
    errors = {}
    for group, name, solve, sweep in runs:
        for i, x in enumerate(sweep):
            y = np.array(jax.block_until_ready(solve(x)))
            errors[group, name, i] = np.max(np.abs(y - exact)) / np.max(np.abs(exact))
    times = {key: [] for key in errors}
    for _ in range(repeats):
        for group, name, solve, sweep in runs:
            # The first call after another function's is slow to start.
            jax.block_until_ready(solve(sweep[0]))
            for i, x in enumerate(sweep):
                start = time.perf_counter()
                jax.block_until_ready(solve(x))
                times[group, name, i].append(time.perf_counter() - start)
    curves = {}
    for (group, name, i), error in errors.items():
        if math.isfinite(error):
            point = error, statistics.median(times[group, name, i])
            curves.setdefault((group, name), []).append(point)
    return curves


def time_to(curve, target):
    """The least time to reach an error, between the points on a log scale."""
    best = math.inf
    points = sorted(curve, key=lambda point: point[1])
    for i, (error, seconds) in enumerate(points):
        if error <= target:
            best = min(best, seconds)
            # Its nearest neighbour that is worse bounds the crossing from below.
            worse = [p for p in points[:i] if p[0] > target]
            if worse:
                e, s = min(worse)
                slope = math.log(seconds / s) / math.log(e / max(error, 1e-16))
                best = min(best, s * (e / target) ** slope)
    return best


def best_of(curves, group, target):
    found = [
        (time_to(curve, target), name)
        for (g, name), curve in curves.items()
        if g == group
    ]
    return min(found, default=(math.inf, "-"))


def table(results):
    ratios = {target: [] for target in TARGETS}
    heyoka = {target: [] for target in TARGETS}
    for target in TARGETS:
        header = "".join(f"{x:>19} {'us':>6}" for x in ("ours", "Diffrax's"))
        print(f"\n{f'to an error of {target:.0e}':23}{header}")
        for problem, curves in results.items():
            best = [best_of(curves, group, target) for group in ("ours", "diffrax")]
            row = "".join(f"{name:>19} {x * 1e6:>6.0f}" for x, name in best)
            print(f"{problem:23}{row}")
            ours = best[0][0]
            ratios[target].append(best[1][0] / ours)
            theirs = [
                time_to(c, target) for (_, n), c in curves.items() if n == "heyoka"
            ]
            heyoka[target] += [ours / x for x in theirs]
    print("\nBest Diffrax solver over our best, by problem and in geometric mean")
    show(ratios, "{:>7.1f}")
    if any(heyoka.values()):
        print("Our best over heyoka, one trajectory, by problem and in geometric mean")
        show(heyoka, "{:>7.2f}")


def show(ratios, form):
    for target, each in ratios.items():
        # A sweep that ends before the target leaves no ratio.
        known = [r for r in each if 0 < r < math.inf]
        mean = form.format(statistics.geometric_mean(known)) if known else "      -"
        print(f"  at {target:.0e}: {''.join(map(form.format, each))}   mean {mean}")


def picture(results, path):
    columns = 2
    rows = math.ceil(len(results) / columns)
    fig, axes = plt.subplots(
        rows,
        columns,
        figsize=(4.6 * columns, 3.4 * rows),
        layout="constrained",
        squeeze=False,
    )
    styles = {"ours": "o-", "diffrax": "s--", "outside": "^:"}
    names = sorted({key for curves in results.values() for key in curves})
    colors = {key: plt.get_cmap("tab20")(i % 20) for i, key in enumerate(names)}
    for ax, (problem, curves) in zip(axes.flat, results.items(), strict=False):
        for key, curve in curves.items():
            e, s = np.array(curve).T
            ax.loglog(e, s * 1e6, styles[key[0]], ms=3, lw=1, color=colors[key])
        ax.set(
            title=problem, xlabel="relative error at the final time", xlim=(1e1, 1e-15)
        )
        ax.set_ylabel("microseconds")
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(results) :]:
        ax.axis("off")
    handles = [Line2D([], [], color=colors[k], ls=styles[k[0]][1:]) for k in names]
    where = axes.flat[len(results)] if len(results) < axes.size else axes.flat[-1]
    where.legend(
        handles, [name for _, name in names], fontsize=9, ncols=2, loc="center"
    )
    fig.savefig(path, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=pathlib.Path, default=HERE.parent / "docs/img")
    options = parser.parse_args()
    repeats = 1 if options.quick else options.repeats
    makers = problems.PROBLEMS[::3] if options.quick else problems.PROBLEMS
    results = {}
    print(f"{platform.processor() or platform.machine()}, median of {repeats} runs")
    for make in makers:
        problem = make()
        start = time.perf_counter()
        results[problem.name] = measure(problem, repeats, options.quick)
        print(
            f"{problem.name}: measured in {time.perf_counter() - start:.0f} s",
            flush=True,
        )
        jax.clear_caches()
    table(results)
    options.output.mkdir(parents=True, exist_ok=True)
    picture(results, options.output / "work_precision.png")


if __name__ == "__main__":
    main()
