"""Variable reversible steps, by the time scale that the package finds itself.

`kepler`: the energy error of orbits of eccentricity 0.9, 0.99 and 0.999 over 1000
periods, from a random phase, at random times: the slope of a linear fit with its
standard error, and the largest error.

`burrau`: three bodies of masses 3, 4 and 5 that start at rest, until t = 60, beside
Dopri8 with a tolerance of 1e-13. Szebehely and Peters (Astronomical Journal 72, 1967)
found that the lightest escapes, and that the others form a binary.

`speed`: the least time to an error of 1e-3, 1e-6 and 1e-9 at 201 saved times, and at
the end, beside Diffrax's Dopri8 and Tsit5 with error control, and beside IAS15 if
REBOUND is installed, for motions of point masses; it is called from Python once for
each saved time. Force evaluations of ours are those of steps, and of shorter steps to
saved times that are not interpolated; those of the time scale and of derivatives at the
ends of steps are in the time. References are by SciPy's DOP853 or, for Kepler orbits,
by Kepler's equation.

`gradients`: memory and error of gradients of many steps; time of a batch of orbits.
"""

import importlib.metadata
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _ias15 import has_rebound, ias15, simulation
from _plot import colors, FOLDER, panels, save
from _report import command_line, Table
from _schemes import DIFFRAX, SCHEMES
from _solve import last, relative_error, solve, states
from _timing import error_curves, interleaved, least_to
from problems import mechanics
from problems_test import pleiades
from problems_variable import (
    arenstorf,
    ATTRACTION,
    densities,
    eccentric,
    exact,
    galaxy,
    orbit,
)

import diffrax_presym as dps


OURS = ("BlanesMoanRKN4", "TunedRKN6", "BlanesCasasRKN8")
TARGETS = 1e-3, 1e-6, 1e-9


def variable(system, solver, times, y0, epsilon, density=None, **options) -> Any:
    """A solve with variable steps, in the loop of the package."""
    controller = dps.StepDensityController(epsilon, density or system)
    more: Any = {"adjoint": dps.FixedStepAdjoint()} | options
    return solve(system, solver, *times, None, y0, controller=controller, **more)


def kepler(quick):
    orbits = 100 if quick else 1000
    table = Table(
        f"Energy error of Kepler orbits over {orbits} periods",
        *("e:<6", "solver:<16", "epsilon:>7.2f", "steps per orbit:>15.0f"),
        *("slope per orbit:>15.1e", "standard error:>14.1e", "largest:>8.1e"),
    )
    rng, out = np.random.default_rng(0), {}
    for e in (0.9, 0.99, 0.999):
        y0 = tuple(map(jnp.asarray, eccentric(e, rng.uniform(0, 2 * np.pi))))
        ts = jnp.asarray(np.sort(rng.uniform(0, 2 * np.pi * orbits, 2000)))
        energy = lambda t, y, args: ATTRACTION.energy(t, y[0], y[1], args) + 0.5
        saveat = dfx.SaveAt(ts=ts, fn=energy)
        for name, epsilon in (("TunedRKN6", 0.3), ("BlanesMoanRKN4", 0.1)):
            scheme, times = SCHEMES[name].solver, (0.0, 2 * np.pi * orbits)
            run = eqx.filter_jit(partial(variable, ATTRACTION, scheme, times, y0))
            sol = run(epsilon, saveat=saveat)
            assert sol.result == dfx.RESULTS.successful
            error, turns = np.asarray(sol.ys), np.asarray(ts) / (2 * np.pi)
            (slope, _), covariance = np.polyfit(turns, error, 1, cov=True)
            deviation = float(covariance[0, 0]) ** 0.5
            steps, largest = int(sol.stats["num_steps"]) / orbits, np.abs(error).max()
            table.row(str(e), name, epsilon, steps, slope, deviation, largest)
            out[e, name] = turns, error
    return out


MASSES = np.array([3.0, 4.0, 5.0])


def to_sixty(system, y0, name, parameter):
    """Positions and momenta at t = 60, and the number of steps."""
    if name == "IAS15":
        sim = simulation(MASSES, y0[0], y0[1], parameter)
        sim.integrate(60.0)
        q = np.array([[body.x, body.y] for body in sim.particles])
        v = np.array([[body.vx, body.vy] for body in sim.particles])
        return q, MASSES[:, None] * v, sim.steps_done
    if name == "Dopri8":
        controller = dfx.PIDController(rtol=parameter, atol=parameter)
        at = system, dfx.Dopri8(), 0.0, 60.0, None, y0
        run = partial(solve, *at, controller=controller, max_steps=10**6)
    else:
        scheme = dps.BlanesCasasRKN8()
        scheme = dps.Compensated(scheme) if "Compensated" in name else scheme
        run = partial(variable, system, scheme, (0.0, 60.0), y0, parameter)
    sol: Any = eqx.filter_jit(run)()
    assert sol.result == dfx.RESULTS.successful, sol.result
    return *map(np.asarray, last(sol)), int(sol.stats["num_steps"])


def burrau(quick):
    i, j = np.triu_indices(3, 1)
    distances = lambda q: jnp.linalg.norm(q[i] - q[j], axis=1)
    system = mechanics(
        lambda t, q, args: -jnp.sum(MASSES[i] * MASSES[j] / distances(q)),
        kinetic=dps.QuadraticKinetic(jnp.array(MASSES[:, None])),
    )
    y0 = jnp.array([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]]), jnp.zeros((3, 2))
    table = Table(
        "Burrau's problem at t = 60: the escaping mass, the binary of the others",
        *("solver:<22", "parameter:>9.0e", "steps:>8", "escapes:>7.0f"),
        *("at x:>8.4f", "y:>8.4f", "axis:>8.5f", "e:>8.5f", "energy error:>12.1e"),
    )
    runs = [("Dopri8", 1e-13), ("BlanesCasasRKN8", 0.05)]
    epsilons = (0.1,) if quick else (0.1, 0.05, 0.02)
    runs += [("the same, Compensated", x) for x in epsilons]
    runs += [("IAS15", 1e-9), ("IAS15", 1e-12)] if has_rebound() else []
    for name, parameter in runs:
        q, p, steps = to_sixty(system, y0, name, parameter)
        drift = abs(float(system.energy(0.0, q, p)) - float(system.energy(0.0, *y0)))
        escaping = int(np.argmax(np.linalg.norm(q, axis=1)))
        a, b = (k for k in range(3) if k != escaping)
        mass = MASSES[a] + MASSES[b]
        r, v = q[a] - q[b], p[a] / MASSES[a] - p[b] / MASSES[b]
        axis = 1 / (2 / np.linalg.norm(r) - v @ v / mass)
        spin = r[0] * v[1] - r[1] * v[0]
        e = np.sqrt(1 - spin**2 / (mass * axis))
        cells = *q[escaping], axis, e, drift
        table.row(name, parameter, str(steps), MASSES[escaping], *cells)


def runs_of(problem, ts):
    """`{(group, name): (solve, sweep)}`, each from the coarsest."""
    system, times, y0 = problem.system, (0.0, problem.t1), problem.y0
    saveat, runs = dfx.SaveAt(ts=jnp.asarray(ts)), {}

    def ours(solver, density, epsilon):
        options: Any = {"saveat": saveat, "max_steps": None}
        sol = variable(system, solver, times, y0, epsilon, density, **options)
        good = sol.result == dfx.RESULTS.successful
        ys = jax.tree.map(lambda y: jnp.where(good, y, jnp.nan), sol.ys)
        return ys, sol.stats["num_steps"], sol.stats["interpolated"]

    sweep = list(2.0 ** -np.arange(-1, 8, 0.5))
    for group, density in (("own", None), ("user's", densities(problem.name))):
        for name in OURS:
            run = jax.jit(partial(ours, SCHEMES[name].solver, density))
            runs[group, name] = run, sweep
    options: Any = {"adaptive": True, "saveat": saveat, "count": True}
    for name in ("Tsit5", "Dopri8"):
        run = partial(states, system, DIFFRAX[name].solver, times, y0, **options)
        runs["Diffrax", name] = jax.jit(run), list(10.0 ** -np.arange(2, 14.5, 0.5))
    if (run := ias15(problem, ts)) is not None:
        runs["IAS15", "IAS15"] = run, list(10.0 ** -np.arange(-4, 10.0))
    return runs


def speed(quick):
    if has_rebound():
        print(f"REBOUND {importlib.metadata.version('rebound')}")
    else:
        print("REBOUND is not installed: IAS15 is omitted.")
    table = Table(
        "Best of Diffrax over ours in time and in force evaluations, by the package's "
        "own time scale and by the user's; IAS15 over ours in time",
        *("problem:<16", "saved:<5", "error:>6.0e", "ours, ms:>8.2f", "scheme:<16"),
        *("Diffrax:<7", "time:>5.2f", "forces:>6.2f", "user's:>6.2f", "IAS15:>6.2f"),
    )
    out = {}
    problems = (pleiades, orbit, arenstorf, galaxy)
    for make in problems[3:] if quick else problems:
        problem = make()
        every = np.linspace(0.0, problem.t1, 202)[1:]
        solution = exact(problem, every)
        for saved in (201, 1):
            ts = every[-saved:]
            want = jax.tree.map(lambda y, k=saved: y[-k:], solution)

            def evaluations(key, result, saved=saved):
                if key[0] == "IAS15":
                    return np.nan
                each = (SCHEMES | DIFFRAX)[key[1]].evaluations
                ours = key[0] != "Diffrax"
                extra = saved - 1 - float(result[2]) if ours else 0
                return each * (float(result[1]) + extra)

            error = lambda result, want=want: relative_error(result[0], want)
            runs = runs_of(problem, ts)
            repeats, enough = (2 if quick else 7), (TARGETS[-1], 0.5)
            curves = error_curves(runs, error, repeats, enough, evaluations)
            for target in TARGETS:
                best = {}
                for (group, name), curve in curves.items():
                    point = least_to(curve, target), name, least_to(curve, target, 2)
                    best[group] = min(best.get(group, (np.inf, "-", np.inf)), point)
                own, theirs = best["own"], best["Diffrax"]
                over = lambda x, y: x / y if y < np.inf else None
                other = best["user's"][0], best.get("IAS15", (np.inf,))[0]
                ratio = over(theirs[0], own[0]), over(theirs[2], own[2])
                more = over(theirs[0], other[0]), over(other[1], own[0])
                cells = 1e3 * own[0], own[1], theirs[1], *ratio, *more
                table.row(problem.name, "201" if saved > 1 else "end", target, *cells)
                out[problem.name, saved, target] = ratio[0], more[1]
    return out


def gradients(quick):
    table = Table(
        "Gradients of an orbit of e = 0.9 by its initial momentum, leapfrog",
        *("steps:>8", "memory, kB:>10.1f", "central differences:>20.1e"),
        "gradient over solve:>19.2f",
    )
    q0, p0 = map(jnp.asarray, eccentric(0.9))

    def end(scale, epsilon, t1):
        y0, times = (q0, scale * p0), (0.0, t1)
        leapfrog = dps.PresymplecticLeapfrog()
        sol = variable(ATTRACTION, leapfrog, times, y0, epsilon)
        return jnp.sum(last(sol)[0]), sol.stats["num_steps"]

    one = jnp.array(1.0)
    for epsilon in (0.1, 0.01) if quick else (0.1, 0.01, 0.001):
        at = one, jnp.array(epsilon), jnp.array(40 * np.pi)
        program = jax.jit(jax.value_and_grad(end, has_aux=True)).lower(*at).compile()
        memory: Any = program.memory_analysis()
        alone = jax.jit(end)
        (_, steps), slope = program(*at)
        h = 1e-7
        up, down = (alone(one + x, *at[1:])[0] for x in (h, -h))
        error = abs(slope * 2 * h / (up - down) - 1)
        calls = {"gradient": partial(program, *at), "solve": partial(alone, *at)}
        timed = interleaved(calls, 3)
        ratio = timed["gradient"].over(timed["solve"])
        table.row(str(int(steps)), memory.temp_size_in_bytes / 1e3, error, ratio)
    number = 16 if quick else 256
    es, t1 = jnp.linspace(0.0, 0.99, number), jnp.array(200 * np.pi)

    def energies(e, saveat):
        """The sum of errors of what is saved, the last, and the number of steps."""
        start = (
            jnp.stack([1 - e, 0 * e]),
            jnp.stack([0 * e, ((1 + e) / (1 - e)) ** 0.5]),
        )
        scheme, times = dps.TunedRKN6(), (0.0, t1)
        sol = variable(ATTRACTION, scheme, times, start, 0.2, saveat=saveat)
        energy = lambda q, p: ATTRACTION.energy(0.0, q, p, None)
        error = jax.vmap(energy)(*sol.ys) + 0.5
        return jnp.sum(error), (error[-1], sol.stats["num_steps"])

    table = Table(
        f"A batch of {number} orbits, e from 0 to 0.99, 100 periods",
        *("saved:<20", "fewest steps:>12", "most:>6", "largest energy error:>20.1e"),
        *("batch over slowest:>18.1f", "batch over one by one:>21.2f"),
    )
    ends, many = dfx.SaveAt(t1=True), dfx.SaveAt(ts=jnp.linspace(0, t1, 201))
    slopes = jax.grad(energies, has_aux=True)
    for name, fn, saveat in (
        ("the end", energies, ends),
        ("201 times", energies, many),
        ("201 times, gradient", slopes, many),
    ):
        alone = jax.jit(partial(fn, saveat=saveat))
        batch = jax.jit(jax.vmap(alone))
        _, (errors, steps) = batch(es)
        slowest = int(jnp.argmax(steps))
        calls = {
            "batch": partial(batch, es),
            "slowest": partial(alone, es[slowest]),
            "each": lambda alone=alone: [alone(e) for e in es],
        }
        timed = interleaved(calls, 3)
        extremes = str(int(steps.min())), str(int(steps.max()))
        ratios = (timed["batch"].over(timed[x]) for x in ("slowest", "each"))
        table.row(name, *extremes, jnp.abs(errors).max(), *ratios)


def picture(energies, ratios):
    fig, (left, right) = panels(2, 2, (5.2, 3.6))
    shades = colors([f"e = {e}" for e, _ in energies])
    for (e, name), (turns, error) in energies.items():
        if name == "TunedRKN6":
            label = f"e = {e}"
            left.semilogy(turns, np.abs(error), ".", ms=2, c=shades[label], label=label)
    left.set(xlabel="time (orbits)", ylabel="magnitude of the energy error")
    left.legend(markerscale=4, loc="lower right", fontsize=8)
    names = list(dict.fromkeys(name for name, saved, _ in ratios if saved > 1))
    for target in TARGETS:
        dots = [ratios[name, 201, target][0] for name in names]
        dots = [np.nan if x is None else x for x in dots]
        right.semilogx(dots, names, "o", label=f"to an error of {target:.0e}")
    right.axvline(1, color="black", lw=1)
    ticks = 0.5, 1, 2, 5
    right.set_xticks(ticks, map(str, ticks))
    right.minorticks_off()
    right.set(xlabel="times faster than the fastest of Dopri8 and Tsit5")
    fig.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    save(fig, FOLDER / "variable_steps.png")


def main():
    parser = command_line(__doc__)
    parts = {"kepler": kepler, "burrau": burrau, "speed": speed, "gradients": gradients}
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(parts)}")
    parser.add_argument("--picture", action="store_true", help="save the figure")
    options = parser.parse_args()
    out = {name: parts[name](options.quick) for name in options.parts or parts}
    if options.picture:
        picture(out["kepler"], out["speed"])


if __name__ == "__main__":
    main()
