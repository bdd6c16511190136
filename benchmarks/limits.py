"""What one trajectory to an error of 1e-9 consists of, against heyoka.

For each problem that heyoka is measured on: the fastest scheme of this package that
reaches the error, its time, and how this divides into the call (a solve of one step),
the force evaluations (a loop of as many, one after the other, and nothing else) and the
rest: drifts, kicks and friction. Beside it the time of heyoka, and what the ratio would
be if the rest took no time, and if neither it nor the call did. A dash is that heyoka
is not installed.
"""

import functools
import math

import jax
import jax.numpy as jnp
import problems
from _report import command_line, means, Table
from _schemes import SCHEMES
from _solve import relative_error
from _timing import interleaved
from outside import heyoka_runs
from work_precision import accepts, solver_of, step_counts

import diffrax_presym as dps


TARGET = 1e-9
HEYOKA = [10 ** (-8 - k / 2) for k in range(13)]  # tolerances
CANDIDATES = ("TunedRKN6", "BlanesCasasRKN8", "BlanesMoanRKN6")


def force_loop(problem, stages):
    """As many force evaluations as a solve of `n` steps has, each from the last."""
    system = problem.system
    force = lambda t, q: system.potential.force(t, q)
    if not isinstance(system.kinetic, dps.QuadraticKinetic):
        # The roles are swapped, and the kicks are by the velocity.
        force = lambda t, q: system.velocity(t, None, q)
    stages = jnp.linspace(0.0, 1e-12, stages)

    @jax.jit
    def run(n):
        def stage(q, x):
            # The time is a number of the loop, as in a solve.
            return q + x * force(x, q), None

        step = lambda _, q: jax.lax.scan(stage, q, stages)[0]
        return jax.lax.fori_loop(0, n, step, jnp.asarray(problem.q0))

    return run


def measured(problem, repeats):
    """The fastest scheme: its name and times; and the time of heyoka."""
    exact, calls = problem.reference(), {}
    for name in CANDIDATES:
        scheme = SCHEMES[name]
        if not accepts(scheme.solver, problem):
            continue
        solve = solver_of(problem, scheme.solver)
        for n in step_counts(problem, scheme.evaluations, quick=False):
            if relative_error(solve(n)[0], exact) <= TARGET:
                calls[name, "solve"] = functools.partial(solve, n)
                calls[name, "call"] = functools.partial(solve, jnp.asarray(1))
                loop = force_loop(problem, scheme.evaluations)
                calls[name, "forces"] = functools.partial(loop, n)
                break
    for solve, tolerances in heyoka_runs(problem, HEYOKA).values():
        for tolerance in tolerances:
            if relative_error(solve(tolerance)[0], exact) <= TARGET:
                calls["heyoka", "solve"] = functools.partial(solve, tolerance)
                break
    found = interleaved(calls, repeats)
    times = {key: timing.median * 1e6 for key, timing in found.items()}
    ours = [name for name, kind in calls if kind == "solve" and name != "heyoka"]
    best = min(ours, key=lambda name: times[name, "solve"])
    parts = (times[best, kind] for kind in ("solve", "call", "forces"))
    return best, *parts, times.get(("heyoka", "solve"), math.inf)


def main():
    options = command_line(__doc__).parse_args()
    makers = [make for make in problems.PROBLEMS if make.__name__ != "random_quadratic"]
    makers = makers[: 1 if options.quick else None]
    table = Table(
        f"Microseconds of one trajectory to an error of {TARGET:.0e}",
        *(":<23", "ours:<15", "time:>5.0f", "call:>4.0f", "forces:>6.0f"),
        *("rest:>4.0f", "heyoka:>6.0f", "ratio:>5.2f", "no rest:>8.2f"),
        "forces alone:>13.2f",
    )
    ratios = []
    for make in makers:
        problem = make()
        name, total, call, forces, heyoka = measured(problem, 3 if options.quick else 9)
        bounds = total, min(total, call + forces), forces
        ratios.append([x / heyoka or None for x in bounds])
        rest = max(0.0, total - call - forces)
        table.row(problem.name, name, total, call, forces, rest, heyoka, *ratios[-1])
    table.row("geometric mean", "", *(None,) * 5, *means(ratios)[0])


if __name__ == "__main__":
    main()
