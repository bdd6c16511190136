"""Time to reach an error: our schemes, Diffrax's, and integrators from outside JAX.

For each problem every method is run over a sweep of step sizes or tolerances, all
interleaved in one process. A point is the median time and the error of the solution at
the final time: the largest entry, relative to that of the solution, since damping
shrinks both, against `reference`. Tables give the time to reach an error, read off each
method's curve, and the geometric mean over the problems of (best Diffrax solver) / (our
best). Figures go to `docs/img/`. heyoka is measured if it is installed.

`--set tuning` and `--set test` measure the two halves of a larger set of problems,
without solvers from outside of JAX, with the worst problem beside the mean: nothing in
the package was tuned on the test half. Where bodies attract each other, splittings are
also run with the variable steps of `StepDensityController`, as
the documentation advises for close encounters. `--saved` saves at 201 times, where the
error is the largest over these, relative to the largest entry of the solution.
A further table has the ratio of the numbers of force evaluations. That of schemes which
are not explicit is an estimate.
"""

import concurrent.futures
import math
import multiprocessing
import pathlib
import time
from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import problems_test
import problems_tuning
from _plot import error_against_time, FOLDER, ratio_dots
from _report import command_line, means, Table
from _schemes import DIFFRAX, Scheme, SCHEMES
from _solve import relative_error, states
from _timing import error_curves, fastest
from outside import heyoka_runs

import diffrax_presym as dps


TARGETS = (1e-3, 1e-6, 1e-9)
TOLERANCES = tuple(10.0**-k for k in range(2, 14))
OURS = [
    *("PresymplecticLeapfrog", "Suzuki4", "SofroniouSpaletta(8)"),
    *("BlanesMoan4", "BlanesMoan6", "BlanesMoanRKN4", "BlanesMoanRKN6"),
    *("BlanesCasasRKN8", "TunedRKN6", "TunedLinear8"),
    *("SymmetricMultistep(8)", "SymmetricMultistep(10)"),
]
# For energies that are not separable; Gauss to rounding, and to two tolerances.
OTHERS = {
    f"PresymplecticGauss({n}), {name}": Scheme(
        dps.PresymplecticGauss(n, tolerance=tolerance), 2 * n, 7 * n
    )
    for n in (2, 4, 6, 8)
    for name, tolerance in {"rounding": 0.0, "1e-6": 1e-6, "1e-9": 1e-9}.items()
}
# With steps that vary by a density, where bodies attract each other.
VARIABLE = ["BlanesMoanRKN4", "BlanesMoanRKN6", "BlanesCasasRKN8"]
SETS = {
    "seven": problems.PROBLEMS,
    "tuning": problems_tuning.PROBLEMS,
    "test": problems_test.PROBLEMS,
}
SAVED = 201
GROUPS = ("ours", "Diffrax", "heyoka")


def solver_of(problem, solver, terms=None, ts=None, **options):
    """`solve(x)`, with `x` the number of steps, or the tolerance.

    It returns the final state, or those at all of `ts`, the number of steps, and
    how many values between these are interpolated.
    """
    if ts is not None:
        options["saveat"] = dfx.SaveAt(ts=jnp.asarray(ts))
    terms = problem.system if terms is None else terms
    args = terms, solver, (0.0, problem.t1), problem.y0
    return jax.jit(lambda x: states(*args, x, count=True, **options))


def semi_implicit_euler(problem, ts=None):
    """Diffrax's only symplectic solver, on the canonical equations, which it needs."""
    s = problem.system
    velocity = lambda t, P, args: s.velocity(t, None, s.from_canonical(t, P))
    force = lambda t, q, args: s.to_canonical(t, s.force(t, q, jnp.zeros_like(q)))
    terms = dfx.ODETerm(velocity), dfx.ODETerm(force)
    solve = solver_of(problem, dfx.SemiImplicitEuler(), terms, ts)
    mechanical = s.from_canonical if ts is None else jax.vmap(s.from_canonical)
    end = jnp.asarray(problem.t1 if ts is None else ts)

    def run(x):
        (q, P), *counts = solve(x)
        return (q, mechanical(end, P)), *counts

    return jax.jit(run)


def step_counts(problem, evaluations, quick, saved=False):
    """Numbers of steps by factors of the square root of two, from 0.4 per stage; where
    all of the times are `saved`, also those whose ends are at saved times."""
    most = 4e3 if np.size(problem.q0) >= 1000 else 2e4 if quick else 1e5
    least = problem.t1 / (0.8 * evaluations * problem.unit)
    count = max(1, math.ceil(2 * math.log2(most / evaluations / least)))
    counts = [math.ceil(least * 2 ** (k / 2)) for k in range(count)]
    if saved:
        spans = SAVED - 1
        divisors = [n for n in range(1, spans + 1) if spans % n == 0]
        longer = lambda n: next((k for k in divisors if k >= n), None)
        ends = [longer(n) or spans * math.ceil(n / spans) for n in counts]
        counts = sorted({*counts, *ends})
    return [jnp.asarray(n) for n in counts]


def accepts(solver, problem):
    """Whether a solver supports the system, as it says when a solve is traced."""
    try:
        jax.eval_shape(solver_of(problem, solver), jnp.asarray(10))
    except ValueError:
        return False
    return True


def all_runs(problem, quick, ts=None):
    """Every method: `{(group, name): (solve, sweep)}`."""
    run_of = partial(solver_of, problem, ts=ts)
    counts = partial(step_counts, problem, quick=quick, saved=ts is not None)
    runs = {}
    separable = problem.system.splits != ()
    ours = {name: SCHEMES[name] for name in OURS} if separable else OTHERS
    for name, (solver, _, evaluations) in ours.items():
        if accepts(solver, problem):
            runs["ours", name] = run_of(solver), counts(evaluations)
    if problem.distances is not None:
        distances = problem.distances
        density = lambda t, y, args: jnp.sum(distances(y[0]) ** -3.0) ** -0.5
        for name in VARIABLE:
            solver, _, evaluations = SCHEMES[name]
            sweep = step_counts(problem, evaluations, quick)
            runs["ours", f"{name}, density"] = run_of(solver, density=density), sweep
    for name, (solver, _, evaluations) in DIFFRAX.items():
        tolerances = [jnp.asarray(x) for x in TOLERANCES]
        runs["Diffrax", f"{name}, adaptive"] = run_of(solver, adaptive=True), tolerances
        runs["Diffrax", f"{name}, constant"] = run_of(solver), counts(evaluations)
    if separable:
        run = semi_implicit_euler(problem, ts)
        runs["Diffrax", "SemiImplicitEuler"] = run, counts(1)
    outside = {} if ts is not None else heyoka_runs(problem, TOLERANCES)
    return runs | {("heyoka", name): run for name, run in outside.items()}


def evaluations(t1, ts, key, found):
    """Of the force in a solve. Where saved times are not interpolated, each of them
    within a step costs as much as a step; with the multistep method as much as a step
    of its start."""
    (group, name), (_, steps, interpolated) = key, found
    known = {"SemiImplicitEuler": 1, "heyoka": math.nan}
    known |= {x: scheme.evaluations for x, scheme in (SCHEMES | DIFFRAX).items()}
    known |= {x: scheme.evaluations for x, scheme in OTHERS.items()}
    cost = between = known[name if name in known else name.split(",")[0]]
    start = 0
    if "Multistep" in name:
        between = known["BlanesCasasRKN8"]
        start = between * min(steps, SCHEMES[name].order - 1)
    if ts is None or group != "ours":
        return start + cost * steps
    at = ts[: len(ts) - interpolated] / t1 * steps
    inside = np.sum(np.abs(at - np.round(at)) > 1e-6)
    return start + cost * steps + between * inside


def tables(results):
    """Print them, and return the ratios of times for each problem and their mean."""
    ratios, heyoka, work = [], [], []
    for target in TARGETS:
        label = f"to an error of {target:.0e}:<23"
        table = Table("", label, "ours:>24", "us:>6.0f", "Diffrax's:>19", "us:>6.0f")
        both = []
        for problem, curves in results.items():
            best = [fastest(curves, target, x) for x in GROUPS]
            cells = [(name, seconds * 1e6) for seconds, name in best[:2]]
            table.row(problem, *cells[0], *cells[1])
            both.append([seconds for seconds, _ in best])
        over = lambda a, b: a / b if max(a, b) < math.inf else None
        ratios.append([over(theirs, ours) for ours, theirs, _ in both])
        heyoka.append([over(ours, taylor) for ours, _, taylor in both])
        costs = [
            [fastest(curves, target, group, 2)[0] for group in ("Diffrax", "ours")]
            for curves in results.values()
        ]
        work.append([over(*both) for both in costs])
    columns = [f"{target:.0e}:>7.2f" for target in TARGETS]
    of_times = list(zip(*ratios, strict=True))
    mean, _ = means(of_times)
    dots = dict(zip(results, of_times, strict=True)) | {"geometric mean": mean}
    captions = (
        "Best Diffrax solver over our best",
        "The same of force evaluations",
        "Our best over heyoka, one trajectory",
    )
    for caption, columns_of in zip(captions, (ratios, work, heyoka), strict=True):
        rows = list(zip(*columns_of, strict=True))
        mean, least = means(rows)
        if any(mean):
            table = Table(caption, ":<24", *columns)
            for problem, row in zip(results, rows, strict=True):
                table.row(problem, *row)
            table.row("geometric mean", *mean)
            table.row("least", *least)
    return dots


def picture(results, path):
    keys = dict.fromkeys(key for curves in results.values() for key in curves)
    groups = [[name for g, name in keys if g == group] for group in GROUPS]
    named = {
        problem: {name: curve for (_, name), curve in curves.items()}
        for problem, curves in results.items()
    }
    error_against_time(named, groups, path, columns=2)


def measure(make, which, saved, repeats, quick):
    """The name of a problem, a curve for each method, and the time it took."""
    problem, start = make(), time.perf_counter()
    ts = np.linspace(0, problem.t1, SAVED) if saved else None
    if ts is None:
        exact = problem.reference()
    else:
        first = jax.tree.map(lambda x: x[None], problem.y0)
        later = problem.solution(ts)
        exact = jax.tree.map(lambda a, b: np.concatenate([a, b]), first, later)
    runs = all_runs(problem, quick, ts)
    error = lambda found: relative_error(found[0], exact)
    enough = None if which == "seven" else (min(TARGETS), 1.0)
    cost = partial(evaluations, problem.t1, ts)
    curves = error_curves(runs, error, repeats, enough, cost)
    return problem.name, curves, time.perf_counter() - start


def main():
    parser = command_line(__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=pathlib.Path, default=FOLDER)
    parser.add_argument("--set", choices=SETS, default="seven")
    parser.add_argument("--saved", action="store_true", help="save at 201 times")
    parser.add_argument("--only", nargs="+", help="parts of the names of problems")
    options = parser.parse_args()
    repeats = 1 if options.quick else options.repeats
    makers = SETS[options.set]
    makers = makers[:4:3] if options.quick else makers
    if options.only:
        wanted = lambda make: any(part in make().name for part in options.only)
        makers = list(filter(wanted, makers))
    results = {}
    print(f"Median of {repeats} runs")
    # A process for each problem: compiled programs are kept until it ends.
    spawn = multiprocessing.get_context("spawn")
    for make in makers:
        with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
            task = measure, make, options.set, options.saved, repeats, options.quick
            name, curves, taken = pool.submit(*task).result()
        results[name] = curves
        print(f"{name}: measured in {taken:.0f} s", flush=True)
    dots = tables(results)
    if options.quick or options.only:
        return
    if options.set == "seven":
        picture(results, options.output / "work_precision.png")
        return
    title = "201 saved times" if options.saved else "the state at the final time"
    path = options.output / f"speed_{options.set}{'_saved' * options.saved}.png"
    ratio_dots(dots, TARGETS, f"Fourteen problems, {title}", path)


if __name__ == "__main__":
    main()
