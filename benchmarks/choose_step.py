"""`choose_step` on the problems of both halves: errors asked for, predicted, and got.

The error is that of `choose_step`, with `atol = rtol`: the largest of an entry over
`rtol (1 + |y|)`. It is found against `reference`, of the state at the final time, and
at 40 equally spaced times. Nothing in `choose_step` was tuned on the problems of
`problems_test.py`.
"""

import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import problems
from _report import command_line, Table
from _solve import solve
from problems_test import PROBLEMS as TEST
from problems_tuning import PROBLEMS as TUNING

import diffrax_presym as dps


TOLERANCES = (1e-3, 1e-6, 1e-9)
SAVED = 40
# The first that accepts the system is used.
SOLVERS = dps.TunedRKN6(), dps.BlanesMoan6(), dps.PresymplecticGauss(6)


def all_problems():
    for make in (*TUNING, *TEST):
        # A thousand unknowns take minutes here, and a hundred show the same.
        yield make(100, 125) if make is problems.random_quadratic else make()


def solve_of(problem, saveat):
    """`solve(dt0)`, with the first solver that accepts the system, and its name."""
    for solver in SOLVERS:

        @jax.jit
        def run(dt0, solver=solver):
            y0, adjoint = problem.y0, dps.FixedStepAdjoint()
            times = 0.0, problem.t1, dt0
            return solve(
                problem.system, solver, *times, y0, saveat=saveat, adjoint=adjoint
            )

        try:
            jax.eval_shape(run, problem.t1)
        except ValueError:
            continue
        return run
    raise ValueError(problem.name)


def scaled(ys, exact, rtol):
    """The largest error of an entry over the tolerance."""
    pairs = zip(ys, exact, strict=True)
    return max(np.max(np.abs(y - x) / (rtol * (1 + np.abs(x)))) for y, x in pairs)


def measure(problem, ts, table):
    """A row for each tolerance; the errors got, over those asked for and predicted."""
    if ts is None and problem.exact is not None:
        exact = np.array(problem.exact())[:, None]
    else:
        exact = problem.solution([0.0, problem.t1] if ts is None else [0.0, *ts])
    saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts))
    run = solve_of(problem, saveat)
    for rtol in TOLERANCES:
        start = time.perf_counter()
        try:
            step = dps.choose_step(run, 0.0, problem.t1, rtol=rtol, atol=rtol)
        except RuntimeError:
            table.row(problem.name, rtol, *[None] * 7)
            continue
        seconds = time.perf_counter() - start
        got = scaled(run(step.dt0).ys, exact, rtol)
        cost = sum(trial.steps for trial in step.trials) / step.steps
        cells = step.error * rtol, got * rtol, got, step.order, cost, seconds
        table.row(problem.name, rtol, str(step.steps), *cells)
        yield got, got / step.error, step.smooth


def main():
    options = command_line(__doc__).parse_args()
    chosen = list(all_problems())
    if options.quick:
        chosen = chosen[:: len(chosen) // 3]
    for label in ("the state at the final time", f"{SAVED} saved times"):
        table = Table(
            f"The largest error of {label}",
            *("problem:<24", "asked:>6.0e", "steps:>7", "predicted:>9.1e"),
            *("got:>8.1e", "got/asked:>9.2f", "order:>6.1f", "trials:>7.1f", "s:>5.1f"),
        )
        ratios = []
        for problem in chosen:
            at_end = label.startswith("the")
            ts = None if at_end else np.linspace(0, problem.t1, SAVED + 1)[1:]
            ratios += measure(problem, ts, table)
            jax.clear_caches()
        got, predicted, smooth = map(np.array, zip(*ratios, strict=True))
        print(
            f"\n{label}, error got over tolerance: mean "
            f"{np.exp(np.mean(np.log(got))):.2f}, largest {np.max(got):.2f}, at least "
            f"a third in {np.sum(got >= 1 / 3)} of {len(got)}\nerror over predicted: "
            f"{np.min(predicted):.2f} to {np.max(predicted):.2f}\n"
            f"noted as not smooth: {np.sum(~smooth)}"
        )


if __name__ == "__main__":
    main()
