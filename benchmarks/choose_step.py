"""`choose_step` on twenty problems: the error asked for, predicted, and got.

The seven problems of `problems.py`, and thirteen others: chains, bodies that attract
each other, molecules, waves, driven, nonquadratic and nonseparable systems. The error
is that of `choose_step`, with `atol = rtol`, and found against `reference`: of the
state at the final time, and the largest at 40 equally spaced times.
"""

import statistics
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import problems
from _report import command_line, Table
from _solve import reference, solve

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

TOLERANCES = (1e-3, 1e-6, 1e-9)
SAVED = 40
ADJOINT = dps.FixedStepAdjoint()


def further():
    """Problems besides those of `problems.py`: name, system, state and final time."""
    constant, none = dps.ConstantDamping, dps.ConstantDamping(0.0)
    conformal, pairs = problems.conformal, np.triu_indices(3, 1)
    grid = np.arange(32) / 32

    def toda(t, q, args):
        return jnp.sum(jnp.exp(q - jnp.roll(q, -1)))

    def bodies(t, q, args):
        r = jnp.linalg.norm(q[pairs[0]] - q[pairs[1]], axis=-1)
        return -jnp.sum(jnp.array([1e-2, 1e-4, 1e-6]) / r)

    def molecules(t, q, args):
        r2 = jnp.sum((q[pairs[0]] - q[pairs[1]]) ** 2, axis=-1)
        return jnp.sum(1 / r2**6 - 2 / r2**3)

    def wave(t, q, args):
        slope = (jnp.roll(q, -1) - q) * 32
        return jnp.sum(slope**2 / 2 + 10 * (1 - jnp.cos(q)))

    def duffing(t, q, args):
        x = jnp.sum(q)
        return x**4 / 4 - x**2 / 2 - 0.3 * x * jnp.cos(1.2 * t)

    def mathieu(t, q, args):
        return (1 + 0.4 * jnp.cos(2.3 * t)) * jnp.sum(q**2) / 2

    def double_well(t, q, args):
        return (q[0] ** 2 - 1) ** 2 / 4 + q[1] ** 2 + q[0] * q[1] / 2

    def logarithmic(t, q, args):
        return jnp.log(0.04 + q[0] ** 2 + q[1] ** 2 / 0.64) / 2

    def quartic_kinetic(t, p, args):
        return jnp.sum(p**2 / 2 + p**4 / 4)

    def cosine(t, q, args):
        return -jnp.sum(jnp.cos(q))

    def morse(t, q, args):
        return jnp.sum((1 - jnp.exp(-q)) ** 2)

    def mixed(t, q, p, args):
        return jnp.sum((q**2 + 1) * (p**2 + 1)) / 2

    def spring(t, q, args):
        return (jnp.linalg.norm(q) - 1) ** 2 * 5 + q[1]

    triangle = np.array([[0.0, 0.0], [1.2, 0.0], [0.5, 1.1]])
    orbits = np.array([[0.0, 0.0], [1.0, 0.0], [-1.6, 0.0]])
    speeds = np.array([[0.0, 0.0], [0.0, 1e-2], [0.0, -7.9e-5]])
    kinetic = dps.QuadraticKinetic
    masses = jnp.array([[1.0], [1e-2], [1e-4]]) * jnp.ones((3, 2))
    copies = dps.PresymplecticCoupled(6)
    yield "Toda chain", conformal(toda, constant(0.02)), np.sin(grid[::4] * 6), 0.3, 30
    yield (
        "planets with drag",
        conformal(bodies, constant(1e-3), kinetic(masses)),
        *(orbits, speeds, 60),
    )
    yield "molecules", conformal(molecules, constant(0.1)), triangle, 0.1, 10
    waves = np.exp(-(((grid - 0.5) * 8) ** 2))
    yield "sine-Gordon waves", conformal(wave, constant(0.1)), waves, 0.0, 5
    one, two = np.array([1.3]), np.array([0.9, 0.2])
    yield "driven Duffing", conformal(duffing, constant(0.25)), one, 0.0, 30
    yield "Mathieu", conformal(mathieu, dps.LogDamping(0.5, 1.0)), one, 0.0, 50
    yield "double well", conformal(double_well, constant(0.05)), two, 0.7, 40
    yield "galaxy", conformal(logarithmic, none), two, 0.4, 50
    system = conformal(cosine, constant(0.05), quartic_kinetic)
    yield "quartic kinetic energy", system, one, 0.2, 50, dps.BlanesMoan6()
    yield "Morse oscillators", conformal(morse, constant(0.02)), two, 0.4, 60
    system = dps.ConformalHamiltonian(energy=mixed, damping=constant(0.05))
    yield "not separable", system, one, 0.2, 20, copies
    yield "elastic pendulum", conformal(spring, constant(0.02)), two, 0.1, 30
    yield "stiff pendulum", conformal(cosine, constant(2.0)), np.array([3.1]), 0.0, 20


def all_problems():
    """Name, system, initial state, final time and solver of twenty problems."""
    for make in problems.PROBLEMS:
        # A thousand unknowns take minutes here, and a hundred show the same.
        problem = make(100, 125) if make is problems.random_quadratic else make()
        yield problem.name, problem.hamiltonian, problem.y0, problem.t1, None
    for name, hamiltonian, q0, p0, t1, *solver in further():
        q0 = jnp.asarray(q0)
        p0 = jnp.broadcast_to(jnp.asarray(p0, float), q0.shape)
        yield name, hamiltonian, (q0, p0), float(t1), solver[0] if solver else None


def scaled(ys, exact, rtol):
    """The error over the tolerance, the largest over all times."""
    errors = jax.tree.map(lambda y, x: (y - x) / (rtol * (1 + abs(x))), ys, exact)
    return float(jnp.max(jax.vmap(optx.rms_norm)(errors)))


def measure(problem, ts, exact, table, ratios):
    name, hamiltonian, y0, t1, solver = problem
    term = dps.HamiltonianTerm(hamiltonian)
    solver = dps.TunedRKN6() if solver is None else solver
    for rtol in TOLERANCES:
        start = time.perf_counter()
        step = dps.choose_step(
            *(term, solver, 0.0, t1, y0),
            **{"rtol": rtol, "atol": rtol, "ts": ts, "adjoint": ADJOINT},
        )
        seconds = time.perf_counter() - start
        saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts)
        sol = solve(
            *(hamiltonian, solver, 0.0, t1, step.dt0, y0),
            **{"saveat": saveat, "adjoint": ADJOINT},
        )
        got = scaled(sol.ys, exact, rtol)
        ratios.append((got, got / step.error))
        cost = sum(n for n, _ in step.trials) / step.steps
        cells = step.steps, step.error * rtol, got * rtol, got, step.order, cost
        table.row(name, rtol, *cells, seconds)


def summary(ratios, label):
    got, predicted = map(np.array, zip(*ratios, strict=True))
    within = lambda x, factor: np.mean((x >= 1 / factor) & (x <= factor))
    mean = statistics.geometric_mean(got)
    print(
        f"\n{label}, error got over tolerance: mean {mean:.2f}, largest "
        f"{np.max(got):.2f}, within a factor of three {within(got, 3):.0%}"
        f"\nerror got over predicted: {np.min(predicted):.2f} to "
        f"{np.max(predicted):.2f}"
    )


def main():
    options = command_line(__doc__).parse_args()
    chosen = list(all_problems())
    if options.quick:
        chosen = chosen[::7]
    for label in ("the state at the final time", f"{SAVED} saved times"):
        table = Table(
            f"The largest error of {label}",
            *("problem:<24", "asked:>6.0e", "steps:>7d", "predicted:>9.1e"),
            *("got:>8.1e", "got/asked:>9.2f", "order:>6.1f", "trials:>7.1f", "s:>5.1f"),
        )
        ratios = []
        for problem in chosen:
            _, hamiltonian, y0, t1, _ = problem
            last = label.startswith("the")
            times = np.linspace(0, t1, 2 if last else SAVED + 1)
            exact = reference(hamiltonian, y0, times)
            ts = None if last else jnp.asarray(times[1:])
            measure(problem, ts, exact, table, ratios)
        summary(ratios, label)
        jax.clear_caches()


if __name__ == "__main__":
    main()
