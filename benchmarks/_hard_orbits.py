"""Hard cases: orbits with close encounters."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _hard_cases import (
    adaptive,
    end,
    LEAPFROG,
    RKN6,
    run,
    successful,
)
from _report import Table
from _solve import CONSTANT, reference
from problems import mechanics

import diffrax_presym as dps


ZERO = jnp.zeros(())

softened = lambda q, args: jnp.sum(q**2) + (0.0 if args is None else args**2)
newton = lambda t, q, args: -1 / jnp.sqrt(softened(q, args))
# A step density, by Kepler's third law.
distance = lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5


def kepler(quick):
    """Orbits of e = 0.9, with drag and without: controller, constant steps, Dopri8."""
    e, orbits = 0.9, 100 if quick else 2000
    y0 = (jnp.array([1 - e, 0.0]), jnp.array([0.0, ((1 + e) / (1 - e)) ** 0.5]))
    t1 = 2 * np.pi * orbits
    # Times of no common period with the orbit, so that all phases are seen.
    ts = jnp.linspace(0.0, t1, 20 * orbits + 1)
    series = {}
    for drag in (None, 1e-5):
        system = mechanics(newton)
        if drag is not None:
            system = mechanics(newton, dps.ConstantDamping(drag))
        record = lambda t, y, args, s=system: s.energy(t, y[0], y[1], args)
        density = lambda epsilon: dps.StepDensityController(epsilon, distance)
        runs = {
            "RKN6, density": (RKN6, density(0.25)),
            "leapfrog, density": (LEAPFROG, density(0.04)),
            "leapfrog, constant": (LEAPFROG, CONSTANT),
            "Dopri8, 1e-8": (dfx.Dopri8(), adaptive(1e-8)),
            "Tsit5, 1e-8": (dfx.Tsit5(), adaptive(1e-8)),
        }
        costs = (14, 1, 1, 14, 6)
        exact = -0.5
        if drag is not None:
            q, p = reference(system, y0, ts, tolerance=1e-9)
            energies = jax.vmap(lambda t, q, p, s=system: s.energy(t, q, p, None))
            exact = np.append(-0.5, energies(ts[1:], q, p))
        table = Table(
            f"4. Kepler, e = {e}, {orbits} orbits, drag {drag or 0:g}: energy error",
            *("solver:<18", "forces per orbit:>16.0f"),
            *("first tenth:>11.1e", "last tenth:>10.1e"),
        )
        saveat = dfx.SaveAt(ts=ts, fn=record)
        for (name, (solver, control)), cost in zip(runs.items(), costs, strict=True):
            dt0 = 2 * np.pi / 4000 if control is CONSTANT else None
            problem = system, solver, 0.0, t1, dt0, y0
            sol = run(*problem, controller=control, saveat=saveat)
            error = np.abs(np.asarray(sol.ys) - exact)
            series[name, drag] = error
            tenth, forces = len(error) // 10, int(sol.stats["num_steps"]) * cost
            first, last = error[1:tenth].max(), error[-tenth:].max()
            table.row(name, forces / orbits, first, last)
    return series


def encounters(quick):
    """Energy errors where bodies come close."""
    table = Table(
        "   ten orbits: energy error of the leapfrog",
        *("e:>4", "softening:>9", "steps:>6d", "density:>8.1e"),
        *("steps:>6d", "constant:>8.1e"),
    )
    for e, soft in ((0.9, None), (0.99, None), (0.99, 1e-2)):
        # From the far end, where softening does not matter.
        q0 = jnp.array([1 + e, 0.0])
        y0 = (q0, jnp.array([0.0, ((1 - e) / (1 + e)) ** 0.5]))
        system = mechanics(newton)
        start = float(system.energy(ZERO, *y0, soft))
        cells = []
        for control, dt0 in (
            (dps.StepDensityController(0.04, distance), None),
            (CONSTANT, 2 * np.pi / 4000),
        ):
            t1 = 20 * np.pi + 3
            problem = system, LEAPFROG, 0.0, t1, dt0, y0, soft
            sol, (q, p) = end(*problem, controller=control)
            error = float(system.energy(ZERO, q, p, soft)) - start
            cells += [int(sol.stats["num_steps"]), abs(error)]
        table.row(str(e), str(soft or 0), *cells)


def kepler_cases(lows):
    """Close encounters of two bodies: name, initial state, time, and the position at
    the end in closed form. Without cancellation at the pericentre."""
    starts = {"apocentre": np.pi, "pericentre": 0.0, "outwards": 2.0, "inwards": -0.3}
    for low in lows:
        b = (low * (2 - low)) ** 0.5
        for name, x in starts.items():
            versed = 2 * np.sin(x / 2) ** 2
            r = low + (1 - low) * versed
            q, p = (low - versed, b * np.sin(x)), (-np.sin(x) / r, b * np.cos(x) / r)
            yield f"1 - e = {low:g}, {name}", (q, p), 2 * np.pi, q
    # Fly-bys are symmetric about the axis; `x` is half of the true anomaly's tangent.
    low, x = 1e-3, 40.0
    q, p = (low * (1 - x**2), -2 * low * x), np.array([x, 1]) * (2 / low) ** 0.5
    t1 = 2 * (2 * low**3) ** 0.5 * (x + x**3 / 3)
    yield "parabola", (q, p / (1 + x**2)), t1, (q[0], -q[1])
    x, e = 1.5, 1 + low
    b, versed = (low * (2 + low)) ** 0.5, 2 * np.sinh(x / 2) ** 2
    q, p = (low - versed, -b * np.sinh(x)), np.array([np.sinh(x), b * np.cosh(x)])
    t1 = 2 * (e * np.sinh(x) - x)
    yield "hyperbola", (q, p / (low + e * versed)), t1, (q[0], -q[1])


def infalls(quick):
    """Steps by a density where bodies come close, for many `epsilon`."""
    epsilons = (0.3, 0.2, 0.1, 0.05, 0.02, 0.01)
    table = Table(
        "   close encounters, BlanesMoanRKN6, steps by a density: steps at epsilon = "
        "0.1,\n   and for each epsilon the error of the position, of three bodies that "
        "of the energy",
        *("case:<25", "steps:>6d", *(f"{x:g}:>8.0e" for x in epsilons)),
    )

    def row(name, system, density, t1, y0, error):
        cells, steps = [], {}
        y0 = jax.tree.map(jnp.asarray, y0)
        for x in epsilons:
            control = dps.StepDensityController(jnp.array(x), density)
            problem = system, RKN6, ZERO, jnp.array(t1), None, y0
            sol, y = end(*problem, controller=control)
            steps[x] = int(sol.stats["num_steps"])
            cells.append(error(*y) if successful(sol) else "failed")
        table.row(name, steps[0.1], *cells)

    one = mechanics(newton)
    for name, y0, t1, exact in kepler_cases(10.0 ** -np.arange(1, 3 if quick else 6)):
        y0 = tuple(map(jnp.array, y0))
        error = lambda q, p, exact=exact: np.linalg.norm(q - np.array(exact))
        row(name, one, distance, t1, y0, error)
    distances = lambda q: jnp.linalg.norm(q - jnp.roll(q, 1, axis=0), axis=1)
    masses = jnp.array([[3.0, 3.0], [4.0, 4.0], [5.0, 5.0]])
    three = dps.MechanicalSystem(
        dps.QuadraticKinetic(masses),
        lambda t, q, args: -jnp.sum(jnp.array([15.0, 12.0, 20.0]) / distances(q)),
    )
    density = lambda t, y, args: jnp.sum(distances(y[0]) ** -3) ** -0.5
    y0 = jnp.array([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]]), jnp.zeros((3, 2))
    start = float(three.energy(ZERO, *y0))
    error = lambda q, p: abs(float(three.energy(ZERO, q, p)) / start - 1)
    for t1 in (10.0, 60.0):
        row(f"three bodies, t = {t1:g}", three, density, t1, y0, error)
