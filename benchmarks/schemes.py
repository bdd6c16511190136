"""Accuracy and stability of every scheme per evaluation of the force.

Accuracy: the factor by which the error is smaller than that of the first scheme of the
same order (the leapfrog, or its triple jump) at equal numbers of force evaluations, in
the geometric mean over the problems. Stability: the largest step times frequency, per
force evaluation, below which the undamped oscillator is stable for every step: the end
of the first interval of stability (`stability_limit`). Times are not measured, so the
output does not depend on the machine.
"""

import statistics

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import problems
from _report import command_line, Table
from _schemes import SCHEMES, stability_limit
from _solve import states


# The first of each order is what the others are compared to.
NAMES = (
    "PresymplecticLeapfrog",
    "PresymplecticLeapfrog, position first",
    "PresymplecticTao",
    "SuzukiYoshida(4)",
    "SuzukiYoshida(4), position first",
    *("Suzuki4", "BlanesMoan4", "BlanesMoanRKN4"),
    *("SuzukiYoshida(6)", "SofroniouSpaletta(6)"),
    *("BlanesMoan6", "BlanesMoanRKN6", "TunedRKN6"),
    *("SuzukiYoshida(8)", "SofroniouSpaletta(8)", "BlanesCasasRKN8"),
)
PROBLEMS = {
    "pendulum": problems.pendulum,
    "decaying": problems.decaying,
    "Henon": problems.henon_heiles,
    "Kepler": problems.kepler,
}

solve = eqx.filter_jit(states)


def error_constant(problem, exact, scheme):
    """The error times the number of force evaluations to the power of the order."""
    solver, order, evaluations = scheme
    constants = []
    for half_doublings in range(28):
        steps = round(problem.t1) * 2 ** (half_doublings / 2) / evaluations
        steps = jnp.asarray(max(1, round(steps)))
        times = jnp.zeros(()), jnp.asarray(problem.t1)
        y = solve(problem.system, solver, times, problem.y0, steps)
        error = float(np.max(np.abs(np.array(y) - exact)))
        if 1e-10 < error < 1e-3:
            constants.append(error * (int(steps) * evaluations) ** order)
    # The finest steps whose error is not rounding.
    return statistics.geometric_mean(constants[-2:]) if constants else np.nan


def main():
    quick = command_line(__doc__).parse_args().quick
    names = list(PROBLEMS)[: 1 if quick else None]
    systems = [(problem := PROBLEMS[name](), problem.reference()) for name in names]
    columns = [f"{name}:>8.2g" for name in (*names, "mean")]
    table = Table("", "times less error:<34", *columns, "h omega:>7.3f")
    base = {}
    for name in NAMES:
        scheme = SCHEMES[name]
        constants = [error_constant(*system, scheme) for system in systems]
        first = base.setdefault(scheme.order, constants)
        gains = [b / c for b, c in zip(first, constants, strict=True)]
        # Tao's stability depends on its coupling as much as on the step.
        limit = None
        if name != "PresymplecticTao":
            limit = stability_limit(scheme) / scheme.evaluations
        label = name.removeprefix("Presymplectic")
        mean = statistics.geometric_mean(gains)
        table.row(f"{scheme.order} {label}", *gains, mean, limit)


if __name__ == "__main__":
    main()
