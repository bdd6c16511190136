"""Time to reach an error: our schemes, Diffrax's, and integrators from outside JAX.

For each problem every method is run over a sweep of step sizes or tolerances, all
interleaved in one process. A point is the median time and the error of the solution at
the final time: the largest entry, relative to that of the solution, since damping
shrinks both, against `reference`. Tables give the time to reach an error, read off each
method's curve, and the geometric mean over the problems of (best Diffrax solver) / (our
best). The figure goes to `docs/img/`. SciPy, heyoka, pyhamsys and symplecta are
measured if they are installed.
"""

import math
import pathlib
import platform
import statistics
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import problems
from _plot import error_against_time, FOLDER
from _report import command_line, Table
from _schemes import DIFFRAX, SCHEMES
from _solve import final_state, relative_error
from _timing import error_curves, time_to
from outside import heyoka_runs, pyhamsys_runs, scipy_runs, STEPS, symplecta_runs

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

TARGETS = (1e-3, 1e-6, 1e-9)
TOLERANCES = tuple(10.0**-k for k in range(2, 14))
OURS = [
    "PresymplecticLeapfrog",
    "Suzuki4",
    "SofroniouSpaletta8",
    "BlanesMoan4",
    "BlanesMoan6",
    "BlanesMoanRKN4",
    "BlanesMoanRKN6",
    "BlanesCasasRKN8",
    "TunedRKN6",
    "TunedLinear8",
]


def solver_of(problem, terms, solver, adaptive=False):
    """`solve(x)`, with `x` the number of steps, or the tolerance."""
    times = 0.0, problem.t1
    return jax.jit(
        lambda x: final_state(terms, solver, times, problem.y0, x, adaptive=adaptive)
    )


def semi_implicit_euler(problem):
    """Diffrax's only symplectic solver, on the canonical equations, which it needs."""
    h = problem.hamiltonian
    velocity = lambda t, P, args: h.velocity(t, None, h.from_canonical(t, P))
    force = lambda t, q, args: h.to_canonical(t, h.force(t, q, None))
    terms = (dfx.ODETerm(velocity), dfx.ODETerm(force))
    solve = solver_of(problem, terms, dfx.SemiImplicitEuler())

    @jax.jit
    def mechanical(x):
        q, P = solve(x)
        return q, h.from_canonical(problem.t1, P)

    return mechanical


def step_counts(problem, evaluations, quick):
    """Numbers of steps by factors of the square root of two, from 0.4 per stage."""
    most = 4e3 if len(problem.q0) >= 1000 else 2e4 if quick else 1e5
    least = problem.t1 / (0.8 * evaluations)
    count = max(1, math.ceil(2 * math.log2(most / evaluations / least)))
    return [jnp.asarray(math.ceil(least * 2 ** (k / 2))) for k in range(count)]


def all_runs(problem, quick):
    """Every method: `{(group, name): (solve, sweep)}`."""
    term = dps.HamiltonianTerm(problem.hamiltonian)
    runs = {}
    for name in OURS:
        if problem.linear or "Linear" not in name:
            solver, _, evaluations = SCHEMES[name]
            sweep = step_counts(problem, evaluations, quick)
            runs["ours", name] = solver_of(problem, term, solver), sweep
    for name, (solver, _, evaluations) in DIFFRAX.items():
        run = solver_of(problem, term, solver, adaptive=True)
        tolerances = [jnp.asarray(x) for x in TOLERANCES]
        runs["diffrax", f"{name}, adaptive"] = run, tolerances
        sweep = step_counts(problem, evaluations, quick)
        runs["diffrax", f"{name}, constant"] = solver_of(problem, term, solver), sweep
    run = semi_implicit_euler(problem)
    runs["diffrax", "SemiImplicitEuler"] = run, step_counts(problem, 1, quick)
    tolerances = TOLERANCES[1::4] if quick else TOLERANCES
    steps = STEPS[:2] if quick else STEPS
    outside = heyoka_runs(problem, tolerances) | scipy_runs(problem, tolerances[::2])
    outside |= pyhamsys_runs(problem, steps) | symplecta_runs(problem, steps)
    return runs | {("outside", name): run for name, run in outside.items()}


def best_of(curves, group, target):
    found = [
        (time_to(curve, target), name)
        for (g, name), curve in curves.items()
        if g == group
    ]
    return min(found, default=(math.inf, "-"))


def tables(results):
    ratios = {target: [] for target in TARGETS}
    heyoka = {target: [] for target in TARGETS}
    for target in TARGETS:
        label = f"to an error of {target:.0e}:<22"
        table = Table("", label, "ours:>19", "us:>6.0f", "Diffrax's:>19", "us:>6.0f")
        for problem, curves in results.items():
            ours, mine = best_of(curves, "ours", target)
            theirs, name = best_of(curves, "diffrax", target)
            table.row(problem, mine, ours * 1e6, name, theirs * 1e6)
            ratios[target].append(theirs / ours)
            if ("outside", "heyoka") in curves:
                taylor = time_to(curves["outside", "heyoka"], target)
                heyoka[target].append(ours / taylor)
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
    keys = dict.fromkeys(key for curves in results.values() for key in curves)
    groups = [
        [name for g, name in keys if g == group]
        for group in ("ours", "diffrax", "outside")
    ]
    named = {
        problem: {name: curve for (_, name), curve in curves.items()}
        for problem, curves in results.items()
    }
    error_against_time(named, groups, path, columns=2)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=pathlib.Path, default=FOLDER)
    options = parser.parse_args()
    repeats = 1 if options.quick else options.repeats
    makers = problems.PROBLEMS[::3] if options.quick else problems.PROBLEMS
    results = {}
    print(f"{platform.processor() or platform.machine()}, median of {repeats} runs")
    for make in makers:
        problem, start = make(), time.perf_counter()
        exact, runs = problem.reference(), all_runs(problem, options.quick)
        error = lambda y, exact=exact: relative_error(y, exact)
        results[problem.name] = error_curves(runs, error, repeats)
        taken = time.perf_counter() - start
        print(f"{problem.name}: measured in {taken:.0f} s", flush=True)
        jax.clear_caches()
    tables(results)
    picture(results, options.output / "work_precision.png")


if __name__ == "__main__":
    main()
