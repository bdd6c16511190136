"""Friction of every kind: time and force evaluations of a solve against its error.

Six systems whose friction is not one rate for all momenta, with the solvers of this
package and those of Diffrax, adaptive and with constant steps. `best ours / theirs` are
ratios of the least of any solver, by time and by evaluations; `schemes` are those that
reach it. A dash is an error that none of the runs reached. Further tables are the time
of solves with matrix friction of 50 unknowns, that save at 401 times: few long steps
over many short ones; and the cost of friction, and of compensated sums, in a step.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, means, Table
from _schemes import DIFFRAX, SCHEMES
from _solve import reference_end, relative_error, states
from _timing import error_curves, fastest, interleaved
from problems import mechanics

import diffrax_presym as dps


TARGETS = (1e-3, 1e-6, 1e-9)
# For friction by place or by speed, and for any linear friction.
GENERAL = "Strang", "BlanesMoan4", "BlanesMoan6", "SofroniouSpaletta(8), Strang"
NYSTROM = "PresymplecticLeapfrog", "BlanesMoanRKN4", "TunedRKN6", "BlanesCasasRKN8"
STRANG_8 = SCHEMES["SofroniouSpaletta(8)"]._replace(
    solver=dps.SofroniouSpaletta(8, dps.Strang())
)
OURS = SCHEMES | {"SofroniouSpaletta(8), Strang": STRANG_8}


class System(NamedTuple):
    name: str
    system: Any
    y0: Any
    t1: float
    schemes: tuple[str, ...]
    fastest: float  # the shortest period of the motion


def chain():
    """Ten pendulums with springs between them, unit inertia, and a damper at each."""
    dampers = jnp.linspace(0.05, 0.5, 10)

    potential = lambda t, q, args: 2 * jnp.sum(jnp.diff(q) ** 2) - jnp.sum(jnp.cos(q))
    system = mechanics(potential, dps.ViscousDamping(dampers))
    y0 = jnp.linspace(1.5, -0.5, 10), jnp.zeros(10)
    return System("chain of 10", system, y0, 20.0, NYSTROM, 1.5)


def network():
    """200 masses and random springs that stiffen, with Rayleigh damping."""
    rng, n = np.random.default_rng(0), 200
    i, j = (rng.integers(0, n, 600) for _ in range(2))
    strength = rng.uniform(0.5, 1.5, 600) * (i != j)
    stiffness = np.eye(n)
    for a, b, k in zip(i, j, strength, strict=True):
        stiffness[[a, b], [a, b]] += k
        stiffness[[a, b], [b, a]] -= k
    stiffness = jnp.asarray(stiffness)

    def potential(t, q, args):
        return q @ (stiffness @ q) / 2 + jnp.sum(q**4) / 4

    friction = [dps.ConstantDamping(0.05), dps.ViscousDamping(0.02 * stiffness)]
    masses = jnp.asarray(rng.uniform(0.5, 2, n))
    system = mechanics(potential, friction, dps.QuadraticKinetic(masses))
    y0 = jnp.asarray(rng.normal(size=n)), jnp.zeros(n)
    return System("network of 200", system, y0, 20.0, NYSTROM, 1.2)


def wave():
    """The wave equation on 512 points, with a layer at either end that absorbs."""
    n = 512
    x = jnp.linspace(0, 1, n)
    layer = 40 * (jnp.maximum(0.2 - x, 0) ** 2 + jnp.maximum(x - 0.8, 0) ** 2) / 0.04
    speed = float(n)

    def potential(t, q, args):
        return speed**2 * (jnp.sum(jnp.diff(q) ** 2) + q[0] ** 2 + q[-1] ** 2) / 2

    system = mechanics(potential, dps.ConstantDamping(layer))
    y0 = jnp.exp(-(((x - 0.4) / 0.03) ** 2)), jnp.zeros(n)
    return System("wave equation", system, y0, 1.0, NYSTROM, math.pi / speed)


def charge():
    """A charged particle in a field, a trap that is not harmonic, and friction."""
    field = 3 * jnp.array([[0.0, -1.0, 0.2], [1.0, 0.0, -0.4], [-0.2, 0.4, 0.0]])

    potential = lambda t, q, args: jnp.sum(q**4) / 4 + q[0] ** 2 * q[1] / 2
    system = mechanics(potential, dps.ViscousDamping(field + 0.05 * jnp.eye(3)))
    y0 = jnp.array([1.0, 0.3, -0.5]), jnp.array([0.0, 0.7, 0.2])
    return System("charged particle", system, y0, 50.0, NYSTROM, 2.0)


def projectiles():
    """100 bodies with quadratic drag, and weight that decreases with height."""
    rng, n = np.random.default_rng(0), 100
    masses = jnp.asarray(rng.uniform(0.5, 2, (n, 1)))
    gravity, radius = 9.81, 6.37e6

    def potential(t, q, args):
        height = q[:, 2:]
        return jnp.sum(masses * gravity * height / (1 + height / radius))

    drag = dps.Drag(masses * jnp.asarray(rng.uniform(5e-4, 2e-3, (n, 1))))
    system = mechanics(potential, drag, dps.QuadraticKinetic(masses))
    velocities = rng.normal(size=(n, 3)) * 50 + [100, 0, 200]
    y0 = jnp.zeros((n, 3)), masses * jnp.asarray(velocities)
    return System("projectiles", system, y0, 20.0, GENERAL, 4.0)


def planet():
    """A planet in gas whose density depends on the radius."""
    potential = lambda t, q, args: -1 / jnp.linalg.norm(q)
    rate = lambda t, q, args: 0.001 * jnp.exp(-4 * (jnp.linalg.norm(q) - 1))
    system = mechanics(potential, dps.PositionDamping(rate))
    y0 = jnp.array([1.1, 0.0, 0.0]), jnp.array([0.0, 0.9, 0.1])
    return System("planet in gas", system, y0, 50.0, GENERAL, 4.0)


# With a loop over stages that is as fast as it can be without gradients.
SCANNED: dict[str, Any] = {
    x.__name__: x(scan_kind="lax") for x in (dfx.Tsit5, dfx.Dopri5, dfx.Dopri8)
}
SYSTEMS = (chain, network, wave, charge, projectiles, planet)
ADAPTIVE = 10.0 ** -np.arange(2.5, 13.0, 1.5)


def exact_solution(problem):
    if problem.name != "wave equation":
        return reference_end(problem.system, problem.y0, 0.0, problem.t1)
    # A linear system has a solution by matrix exponential.
    import scipy.linalg

    n = len(problem.y0[0])
    K = n**2 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    rates = np.asarray(problem.system.friction[0].rate(0.0))
    matrix = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -np.diag(rates)]])
    y = scipy.linalg.expm(matrix * problem.t1) @ np.concatenate(problem.y0)
    return np.split(y, 2)


def work(problem, quick):
    """For every solver its points `(error, seconds, evaluations)`."""
    times = jnp.array([0.0, problem.t1])
    run_one = eqx.filter_jit(partial(states, count=True))
    exact = exact_solution(problem)
    runs, cost_of = {}, {}

    def add(key, solver, cost, sweep, adaptive=False):
        sweep = [jnp.asarray(float(x)) for x in sweep]
        run = partial(run_one, problem.system, solver, times, problem.y0)
        runs[key], cost_of[key] = (partial(run, adaptive=adaptive), sweep), cost

    periods = problem.t1 / problem.fastest
    points, most = (5, 100) if quick else (9, 800)
    for name in problem.schemes:
        solver, _, cost = OURS[name]
        per_period = np.geomspace(2, most, points) * (1 + (cost == 1))
        steps = np.unique(np.ceil(periods * per_period / cost))
        add(("ours", name), solver, cost, steps)
    for name, (solver, _, cost) in DIFFRAX.items():
        tolerances = ADAPTIVE[:: 2 if quick else 1]
        add(("Diffrax", name), SCANNED[name], cost, tolerances, True)
        per_period = np.geomspace(10, most, points)
        steps = np.unique(np.ceil(periods * per_period / cost))
        add(("Diffrax", name + ", constant"), solver, cost, steps)
    error = lambda found: relative_error(found[0], exact)
    evaluations = lambda key, found: cost_of[key] * found[1]
    return error_curves(runs, error, 2 if quick else 3, cost=evaluations)


_SHORT = {
    "PresymplecticLeapfrog": "Leapfrog",
    "SofroniouSpaletta(8), Strang": "SS8",
    "BlanesMoanRKN4": "RKN4",
    "TunedRKN6": "RKN6",
    "BlanesCasasRKN8": "RKN8",
    "BlanesMoan4": "BM4",
    "BlanesMoan6": "BM6",
}


def compare(problems, quick):
    rows: dict[str, list] = {"time": [], "evaluations": []}
    table = Table(
        "Least of Diffrax over least of ours, at errors of 1e-3, 1e-6, 1e-9",
        *("system:<17", "by:<11"),
        *(f"{target:.0e}:>6.1f" for target in TARGETS),
        *("ours:<32", "Diffrax's:<30"),
    )
    short = lambda found: " ".join(str(_SHORT.get(name, name)) for _, name in found)
    for problem in problems:
        curves = work(problem, quick)
        for by, kind in enumerate(rows, 1):
            ours, theirs = (
                [fastest(curves, target, group, by) for target in TARGETS]
                for group in ("ours", "Diffrax")
            )
            best = [np.array([cost for cost, _ in found]) for found in (ours, theirs)]
            reached = np.isfinite(best[0])
            rows[kind].append(np.where(reached, best[1] / best[0], np.inf))
            table.row(problem.name, kind, *rows[kind][-1], short(ours), short(theirs))
    for kind, ratios in rows.items():
        table.row("geometric mean", kind, *means(ratios)[0], "", "")


def many_times(quick):
    """Matrix friction, saved at 401 times: five in a step, or the end of each."""
    n, t1 = 50, 40.0
    rng = np.random.default_rng(0)
    dampers = jnp.asarray(0.2 * np.eye(n) + 0.02 * rng.normal(size=(n, n)))
    potential = lambda t, q, args: jnp.sum(jnp.diff(q) ** 2) - jnp.sum(jnp.cos(q))
    system = mechanics(potential, dps.ViscousDamping(dampers))
    y0, ts = (jnp.linspace(-1.0, 1.0, n), jnp.zeros(n)), jnp.linspace(0, t1, 401)
    exact = jnp.asarray(reference_end(system, y0, 0.0, t1))
    table = Table(
        "Matrix friction of 50 unknowns, saved at 401 times: milliseconds",
        *("solver:<15", "80 steps:>9.2f", "error:>8.0e", "400 steps:>9.2f"),
        *("error:>8.0e", "80 / 400:>9.2f"),
    )
    for name in ("TunedRKN6", "BlanesMoanRKN4"):
        options = {"saveat": dfx.SaveAt(ts=ts)}
        solver = SCHEMES[name].solver
        run = jax.jit(partial(states, system, solver, (0.0, t1), y0, **options))
        calls = {steps: partial(run, jnp.asarray(float(steps))) for steps in (80, 400)}
        found = interleaved(calls, 3 if quick else 15)
        cells = []
        for timing in found.values():
            end = jax.tree.map(lambda y: y[-1], timing.result)
            cells += [1e3 * timing.median, relative_error(end, exact)]
        table.row(name, *cells, found[80].over(found[400]))


STEPS = 200


def of_steps(variants, y0, quick):
    """Timings of solves of `STEPS` steps: of systems and solvers."""
    calls = {}
    for key, (system, solver) in variants.items():
        solve = partial(
            *(dfx.diffeqsolve, system, solver, 0.0, 20.0, 20.0 / STEPS),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        )
        run = jax.jit(lambda y0, solve=solve: solve(y0).ys)
        calls[key] = partial(run, y0)
    return interleaved(calls, 5 if quick else 101)


def pendulum(law):
    return mechanics(lambda t, q, args: -jnp.sum(jnp.cos(q)), law)


def of_time(quick):
    """The time of a step with friction that depends on time, over that with a constant
    rate, of one pendulum."""
    laws = {
        "constant": dps.ConstantDamping(0.1),
        "a function": lambda t: 2 * jnp.log1p(0.1 * t),
        "two laws": [dps.LogDamping(1.0, shift=10.0), dps.PowerDamping(0.1, 0.5)],
    }
    solvers = "PresymplecticLeapfrog", "BlanesMoanRKN4", "TunedRKN6", "BlanesMoan6"
    variants = {
        (name, kind): (pendulum(law), SCHEMES[name].solver)
        for name in solvers
        for kind, law in laws.items()
    }
    found = of_steps(variants, (jnp.ones(1), jnp.zeros(1)), quick)
    table = Table(
        "Friction that depends on time: a step over one with a constant rate",
        *("scheme:<24", "constant, ns:>12.0f", "a function:>11.1f", "two laws:>9.1f"),
    )
    for name in solvers:
        constant, *more = (found[name, kind] for kind in laws)
        ratios = (timing.over(constant) for timing in more)
        table.row(name, 1e9 * constant.median / STEPS, *ratios)


def costs(quick):
    """The time of a step with friction, or with compensated sums, over that without, of
    pendulums."""
    table = Table(
        "Pendulums: a step over one without friction",
        *("unknowns:>8", "scheme:<22", "without, ns:>11.0f", "constant:>8.2f"),
        *("3 / (t + 1):>11.2f", "Compensated:>11.2f"),
    )
    for n in (1, 100) if quick else (1, 100, 1000):
        for name in ("PresymplecticLeapfrog", "BlanesMoanRKN4"):
            solver: Any = SCHEMES[name].solver
            variants = {
                "without": (pendulum(None), solver),
                "constant": (pendulum(dps.ConstantDamping(0.1)), solver),
                "of time": (pendulum(dps.LogDamping(3.0, shift=1.0)), solver),
                "Compensated": (pendulum(None), dps.Compensated(solver)),
            }
            found = of_steps(variants, (jnp.ones(n), jnp.zeros(n)), quick)
            without, *more = found.values()
            ratios = (timing.over(without) for timing in more)
            table.row(str(n), name, 1e9 * without.median / STEPS, *ratios)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="*", help="names of systems")
    parser.add_argument("--saved", action="store_true", help="only at 401 times")
    options = parser.parse_args()
    chosen = [make() for make in SYSTEMS]
    if options.only:
        chosen = [x for x in chosen if x.name.split()[0] in options.only]
    elif options.quick:
        chosen = chosen[::3]
    if not options.saved:
        compare(chosen, options.quick)
    if not options.only:
        many_times(options.quick)
        of_time(options.quick)
        costs(options.quick)


if __name__ == "__main__":
    main()
