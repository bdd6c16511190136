"""How long the first solve takes, most of which is compilation, over that of Tsit5.

Of scalar friction, matrix friction and a list of two laws that depend on time with
`TunedRKN6`, of a mass matrix that depends on positions with `PresymplecticGauss(4)`,
and of two rods with ball joints and drag, free bodies with constraints, with `Strang`:
seconds from the call of `jax.jit` of a solve to its result, that saves the end or at
501 times, and of the gradient of a sum of squares at the end. The solvers of Diffrax
solve the same system with constant steps. Each number is measured in a fresh process,
without a cache of compiled programs; imports do not count. Medians of all processes,
and of the ratios of neighbours.

`--readme` measures the README's first result, the choice of the step and the solve, and
the first gradient, over the same solve and gradient by an adaptive `Tsit5`.
"""

import os
import statistics
import subprocess
import sys
import time
from typing import Any

import bodies
import diffrax as dfx
import jax
import jax.numpy as jnp
from _report import command_line, Table

import diffrax_presym as dps


N = 6
SPAN = 10.0
OURS = {
    "scalar friction": dps.TunedRKN6(),
    "matrix friction": dps.TunedRKN6(),
    "two laws of time": dps.TunedRKN6(),
    "M(q), Gauss": dps.PresymplecticGauss(4),
    "joined bodies": dps.Strang(),
}
SAVED = {"end": None, "501 times": 501, "gradient": None}


def system_of(kind):
    """A chain of pendulums, the links of an arm, or rods."""
    if kind == "joined bodies":
        return bodies.joined(2)
    if kind == "M(q), Gauss":
        below = N - jnp.maximum(jnp.arange(N)[:, None], jnp.arange(N))
        mass = lambda t, q, args: below * jnp.cos(q[:, None] - q)
        height = lambda t, q, args: -9.81 * jnp.sum((N - jnp.arange(N)) * jnp.cos(q))
        return dps.LagrangianSystem(mass, height, dps.ViscousDamping(0.1))
    potential = lambda t, q, args: jnp.sum(jnp.diff(q) ** 2) - jnp.sum(jnp.cos(q))
    law = dps.ConstantDamping(0.1)
    if kind == "two laws of time":
        law = [dps.LogDamping(3.0, 1.0), lambda t: 0.1 * jnp.sin(t)]
    if kind == "matrix friction":
        law = dps.ViscousDamping(0.1 * (2 * jnp.eye(N) - jnp.eye(N, k=1)))
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, law)


def options_of(solver, tolerance=None):
    if isinstance(solver, dps.extend.AbstractPresymplecticSolver):
        return {"max_steps": None, "adjoint": dps.FixedStepAdjoint()}
    if tolerance is None:
        return {}
    return {"stepsize_controller": dfx.PIDController(rtol=tolerance, atol=tolerance)}


def seconds(call):
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def cold(kind, what, solver):
    """Seconds of the first call of a solve or of its gradient."""
    system, count = system_of(kind), SAVED[what]
    options: Any = options_of(solver)
    if count is not None:
        options["saveat"] = dfx.SaveAt(ts=jnp.linspace(0.0, SPAN, count))
    y0 = jnp.linspace(0.1, 1.0, N), jnp.zeros(N)
    if kind == "joined bodies":
        q = jnp.tile(jnp.eye(1, 4), (2, 1))
        zero = jnp.zeros((2, 3))
        y0 = (bodies.placed(q)[0], q), (zero, zero)

    def run(y0):
        return dfx.diffeqsolve(system, solver, 0.0, SPAN, 0.05, y0, **options).ys

    fn = run
    if what == "gradient":
        fn = jax.grad(lambda y0: sum(jnp.sum(x**2) for x in jax.tree.leaves(run(y0))))
    return [seconds(lambda: jax.jit(fn)(y0))]


def cold_readme(solver):
    """Seconds to the README's first result, and then to its first gradient."""
    ts, y0 = jnp.linspace(0, 50, 501), (jnp.array([2.0, 0.5]), jnp.zeros(2))
    ours = isinstance(solver, dps.extend.AbstractPresymplecticSolver)
    options: Any = options_of(solver, 1e-4) | {"saveat": dfx.SaveAt(ts=ts)}

    def solution(dt0, rate):
        system = dps.MechanicalSystem(
            kinetic=dps.QuadraticKinetic(mass=2.0),
            potential=lambda t, q, args: -jnp.sum(jnp.cos(q)),
            friction=dps.ConstantDamping(rate),
        )
        dt0 = dt0 if ours else None
        return dfx.diffeqsolve(system, solver, 0.0, 50.0, dt0, y0, **options)

    solve = jax.jit(lambda dt0: solution(dt0, 0.1))
    steps = []

    def first():
        if ours:
            chosen = dps.choose_step(solve, 0.0, 50.0, rtol=1e-4, atol=1e-4)
            steps.append(chosen.dt0)
        return solve(steps[0] if ours else 0.0).ys

    def loss(rate):
        q, p = solution(steps[0] if ours else None, rate).ys  # pyright: ignore
        return jnp.sum(q**2) + jnp.sum(p**2)

    return [seconds(first), seconds(lambda: jax.jit(jax.grad(loss))(0.1))]


def in_a_process(*task):
    """The seconds that this script prints for a task, in a process of its own."""
    task = [sys.executable, __file__, "--task", *task]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    return [float(x) for x in subprocess.check_output(task, env=environment).split()]


def compared(repeats, *task):
    """For each number of a task: the medians of ours, Tsit5's, and of the ratios."""
    sides = "ours", "Tsit5"
    rounds = [[in_a_process(side, *task) for side in sides] for _ in range(repeats)]
    for i in range(len(rounds[0][0])):
        ours, theirs = ([both[k][i] for both in rounds] for k in (0, 1))
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        yield [statistics.median(x) for x in (ours, theirs, ratios)]


def main():
    parser = command_line(__doc__)
    parser.add_argument("--readme", action="store_true", help="the README's example")
    parser.add_argument("--task", nargs="+", help="for the processes of this script")
    options = parser.parse_args()
    if options.task:
        side, kind, *what = options.task
        ours = OURS.get(kind, dps.TunedRKN6())
        solver = ours if side == "ours" else dfx.Tsit5()
        print(*(cold(kind, what[0], solver) if what else cold_readme(solver)))
        return
    repeats = 1 if options.quick else 5
    columns = "ours, s:>8.2f", "Tsit5, s:>8.2f", "ratio:>6.2f"
    if options.readme:
        table = Table("The first results of the README, cold", ":<22", *columns)
        names = "choose_step and solve", "gradient"
        for name, row in zip(names, compared(repeats, "readme"), strict=True):
            table.row(name, *row)
        return
    caption = "The first call of a solve or of its gradient, cold"
    table = Table(caption, "system:<17", "of:<10", *columns)
    for kind in OURS:
        for what in SAVED:
            (row,) = compared(repeats, kind, what)
            table.row(kind, what, *row)


if __name__ == "__main__":
    main()
