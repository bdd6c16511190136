"""The hard cases: errors of all kinds of schemes, one table per group."""

import functools
import pathlib
from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from _plot import panels, save, slope
from _report import command_line, Table
from _schemes import SCHEMES, stability_limit, step_matrices
from _solve import CONSTANT, last, reference, reference_end, solve
from problems import henon_heiles as damped_henon_heiles, mechanics

import diffrax_presym as dps


LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
RKN6 = dps.BlanesMoanRKN6()
QUADRATIC = dps.QuadraticKinetic()

harmonic = lambda t, q, args: jnp.sum(q**2) / 2
pendulum = lambda t, q, args: jnp.sum(1 - jnp.cos(q))
absolute = lambda t, q, args: jnp.sum(jnp.abs(q))
# Not defined for negative positions.
root = lambda t, q, args: -jnp.sum(jnp.sqrt(q))
# Without a lower bound: the motion reaches infinity in finite time.
quartic = lambda t, q, args: -jnp.sum(q**4)
mixed = lambda t, q, p, args: (1 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 2
duffing = lambda t, q, args: jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t))
henon_heiles = damped_henon_heiles().system.potential
softened = lambda q, args: jnp.sum(q**2) + (0.0 if args is None else args**2)
newton = lambda t, q, args: -1 / jnp.sqrt(softened(q, args))
# A step density, by Kepler's third law.
distance = lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5
height = lambda t, y, args, **kwargs: y[0][0]

run = eqx.filter_jit(solve)
ZERO = jnp.zeros(())
adaptive = lambda tolerance: dfx.PIDController(rtol=tolerance, atol=tolerance)
successful = lambda sol: sol.result == dfx.RESULTS.successful


def end(*arguments, **options):
    """The solve, and its final state in double precision."""
    sol = run(*arguments, **options)
    return sol, jax.tree.map(lambda x: np.asarray(x, np.float64), last(sol))


def overflow(quick):
    """Relative error of an oscillator whose momentum decays by exp(-eta) at the end."""
    table = Table(
        "1. overflow: q(50) of a damped oscillator, exp(eta) at the end",
        *("precision:<9", "eta:>7g", "in the frame:>12"),
        *("canonical:>9", "eta1 > eta2:>11"),
    )
    for dtype in (jnp.float32, jnp.float64):
        for eta in (1.0, 1e2, 1e3, 1e5):
            # Critically slow: the momentum follows the force, whatever the damping.
            t1, dt0 = jnp.asarray(50.0, dtype), jnp.asarray(50.0 / 2000, dtype)
            gamma = jnp.asarray(eta / 50, dtype)
            y0 = (jnp.ones(1, dtype), jnp.zeros(1, dtype))
            laws = dps.ConstantDamping(gamma), dps.ConstantDamping(gamma * 0.999)
            unequal = dps.DissipativeHamiltonian(QUADRATIC, harmonic, *laws)
            cells = []
            for system in (
                mechanics(harmonic, laws[0]),
                canonical_form(harmonic, gamma),
                unequal,
            ):
                _, (q, p) = end(system, LEAPFROG, 0 * t1, t1, dt0, y0)
                good = np.isfinite(q).all() and np.isfinite(p).all()
                cells.append(f"{q[0]:+.3f}" if good else "nan")
            table.row(jnp.dtype(dtype).name, eta, *cells)


def canonical_form(potential, gamma):
    """The same system in canonical momenta, the naive way: P grows like exp(eta)."""
    gradient = jax.grad(potential, argnums=1)
    return dps.MechanicalSystem(
        lambda t, p, args: jnp.exp(-gamma * t) * jnp.sum(p**2) / 2,
        dps.ForceField(lambda t, q, args: -jnp.exp(gamma * t) * gradient(t, q, args)),
    )


# Those that the groups of one scheme each compare.
FEW = (
    "PresymplecticEuler PresymplecticLeapfrog SuzukiYoshida(4) Suzuki4 "
    "BlanesMoan4 BlanesMoanRKN4 SofroniouSpaletta(6) BlanesMoan6 BlanesMoanRKN6 "
    "SofroniouSpaletta(8) BlanesCasasRKN8"
).split()


def stability(quick):
    """The end of the first interval of stability, by the trace of a step."""
    table = Table(
        "2. stability: the largest h * omega below which every step is stable",
        *("scheme:<21", "undamped:>8.2f", "gamma = omega / 2:>17.2f"),
    )
    for name in (*FEW, "TunedRKN6"):
        table.row(name, *(stability_limit(SCHEMES[name], x) for x in (0.0, 0.5)))
    # Frequencies 1 to 1e4 in one system, at and beyond the limit of the fastest.
    omega = jnp.logspace(0, 4, 5)
    stiff = mechanics(lambda t, q, args: jnp.sum((omega * q) ** 2) / 2)
    y0 = (jnp.ones(5) / omega, jnp.zeros(5))
    table = Table(
        "   frequencies 1 to 1e4, the leapfrog to t = 0.2: energy error",
        *("h * omega_max:>13", "error:>9.1e", "result:>10"),
    )
    for factor in (1.0, 1.9, 2.1):
        sol, (q, p) = end(stiff, LEAPFROG, 0.0, 0.2, factor * 1e-4, y0)
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.sum(p**2 + (np.asarray(omega) * q) ** 2) / 5
        table.row(str(factor), energy - 1, "" if successful(sol) else "reported")
    strong_friction(quick)
    slow_motion(quick)


def slow_motion(quick):
    """Errors of position and momentum of an oscillator with h omega = 0.3, relative to
    the exact values, at the time in which friction lets the slow motion fall by 1 / e,
    20 steps or more; in two loops, whose results are the same."""
    products = (0.1, 1.0, 10.0, 100.0)
    table = Table(
        "   strong friction: errors of q and p for each h gamma, h omega = 0.3",
        "scheme:<38",
        *(f"{x:g}, {part}:>8.0e" for x in products for part in "qp"),
    )
    strang = dps.Strang()
    solvers: dict[str, Any] = {name: x.solver for name, x in SCHEMES.items()}
    solvers |= {
        "SuzukiYoshida(4, Strang)": dps.SuzukiYoshida(4, strang),
        "SofroniouSpaletta(6, Strang)": dps.SofroniouSpaletta(6, strang),
        "Compensated(TunedRKN6)": dps.Compensated(dps.TunedRKN6()),
        "PresymplecticGauss(4)": dps.PresymplecticGauss(4),
        "PresymplecticGauss(4, Newton)": dps.PresymplecticGauss(
            4, optx.Newton(1e-12, 1e-12)
        ),
    }
    loops = dps.FixedStepAdjoint(), dfx.ForwardMode()
    for name, solver in solvers.items():
        rows = []
        for adjoint in loops[: 1 if quick else 2]:
            cells = []
            for x in products:
                system = mechanics(
                    dps.QuadraticPotential(0.09), dps.ConstantDamping(jnp.asarray(x))
                )
                # Two rates; the smaller one without cancellation.
                root = (x * x / 4 - 0.09 + 0j) ** 0.5
                fast = -x / 2 - root
                slow = 0.09 / fast
                t = float(max(20, np.ceil(x / 0.09)))
                y0 = (jnp.ones(1), jnp.zeros(1))
                sol, y = end(system, solver, 0.0, t, 1.0, y0, adjoint=adjoint)
                grow, decay = np.exp(slow * t), np.exp(fast * t)
                exact = (fast * grow - slow * decay) / (fast - slow), grow - decay
                exact = exact[0].real, (slow * fast / (fast - slow) * exact[1]).real
                good = successful(sol)
                pairs = zip(y, exact, strict=True)
                cells += [a[0] / b - 1 if good else np.inf for a, b in pairs]
            rows.append(cells)
        np.testing.assert_allclose(rows[0], rows[-1], rtol=0.05, atol=1e-11)
        table.row(name, *rows[0])


def strong_friction(quick):
    """From which friction a solution grows, by the eigenvalues of a step, and from
    which a solve fails, as it is more than the scheme resolves."""
    parts = "stable to", "error", "fails"
    table = Table(
        "   strong friction of q'' = -q - gamma q': the largest h gamma at which no "
        "solution\n   grows, the error of the slow motion there, and the first h gamma "
        "that fails",
        "scheme:<21",
        *(f"h = {h:g}, {x}:>18.3g" for h in (0.5, 1.0) for x in parts),
    )
    products = np.geomspace(0.05, 400, 60 if quick else 1200)
    for name in (*FEW, "Strang", "TunedRKN6", "SofroniouSpaletta(10)"):
        cells = []
        for h in (0.5, 1.0):
            gamma, steps = products / h, jnp.full(len(products), h)
            solver = SCHEMES[name].solver
            matrices = np.array(step_matrices(solver, steps, jnp.asarray(gamma)))
            fails = ~np.all(np.isfinite(matrices), axis=(1, 2))
            matrices[fails] = np.diag([2.0, 2.0])
            radius = np.max(np.abs(np.linalg.eigvals(matrices)), axis=1)
            # Of the motion that friction slows down.
            rate = (-gamma + np.sqrt((gamma**2 - 4).astype(complex))) / 2
            error = np.abs(radius - np.abs(np.exp(h * rate)))
            first = lambda bad: int(np.argmax(np.append(bad, True)))
            stable, failed = first(radius > 1 + 1e-12), first(fails)
            limits = np.append(products, np.inf)
            last_stable = np.inf if stable == len(products) else products[stable - 1]
            cells += [last_stable, error[stable - 1], limits[failed]]
        table.row(name, *cells)


def long_times(quick):
    """Rounding errors of the energy, root mean square of 16 orbits, against the same
    steps in compensated doubles."""
    growth, q0 = {}, jnp.linspace(0.3, 1.0, 16, dtype=jnp.float32)
    system = mechanics(pendulum)
    sub = dps.Composition(LEAPFROG, (1e-3,) * 1000)
    compensated = dps.Compensated(sub)
    runs = {
        "exact": (jnp.float64, compensated),
        "float32": (jnp.float32, sub),
        "float32 compensated": (jnp.float32, compensated),
        "float64": (jnp.float64, sub),
    }
    table = Table(
        "3. long times: error of the energy of a pendulum, leapfrog, h = 1/8",
        *("steps:>6.0e", "of the scheme:>13.1e"),
        *(f"rounding, {x}:>29.1e" for x in list(runs)[1:]),
    )
    for n in (10**4, 10**5) if quick else (10**4, 10**5, 10**6, 10**7):
        ends = {}
        for name, (dtype, solver) in runs.items():
            q = q0.astype(dtype)
            t1, dt0 = jnp.asarray(n / 8, dtype), jnp.asarray(125.0, dtype)
            _, y = end(system, solver, 0 * t1, t1, dt0, (q, jnp.zeros_like(q)))
            ends[name] = y[1] ** 2 / 2 + 1 - np.cos(y[0])
        exact = ends.pop("exact")
        start = 1 - np.cos(np.asarray(q0, np.float64))
        growth[n] = {k: np.sqrt(np.mean((v - exact) ** 2)) for k, v in ends.items()}
        table.row(n, np.abs(exact - start).max(), *growth[n].values())
    # The clock of float32: a free particle shows the lengths of the steps themselves.
    table = Table(
        "   float32 at t = 1e4, h = 0.01", "solver:<24", "error of the step:>17.1%"
    )
    h, t0 = jnp.float32(0.01), jnp.float32(1e4)
    free = mechanics(lambda t, q, args: 0 * jnp.sum(q))
    y0 = jnp.zeros(1, jnp.float32), jnp.ones(1, jnp.float32)
    for name, solver, n in (
        ("PresymplecticLeapfrog", LEAPFROG, 1),
        ("100 as one", dps.Composition(LEAPFROG, (1e-2,) * 100), 100),
    ):
        carry = solver.init(free, t0, t0 + n * h, y0, None)
        (q, _), *_ = solver.step(free, t0, t0 + n * h, y0, None, carry, False)
        table.row(name, abs(float(q[0]) / (n * 0.01) - 1))
    return growth


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


def chaos(quick):
    """Mean values over an ensemble, of two schemes and of two steps."""
    n = 200 if quick else 1000
    key = jax.random.key(0)
    table = Table(
        f"5. chaos: means over time and {n} orbits",
        *("system:<12", "solver:<14", "<q^2>:>16", "<p^2>:>16"),
    )
    saveat = dfx.SaveAt(ts=jnp.linspace(100.0, 300.0, 201))
    for name, system, size in (
        ("Duffing", mechanics(duffing, dps.ConstantDamping(0.25)), 1),
        ("Henon-Heiles", mechanics(henon_heiles), 2),
    ):
        q0 = 0.1 * jax.random.normal(key, (n, size))
        p0 = jax.random.normal(jax.random.fold_in(key, 1), (n, size))
        if size == 2:  # All of one energy, 1/8, where most orbits are chaotic.
            kinetic = 1 / 8 - jax.vmap(lambda q: henon_heiles(0.0, q, None))(q0)
            p0 *= jnp.sqrt(2 * kinetic / jnp.sum(p0**2, axis=1))[:, None]
        for label, solver, dt0, control in (
            ("RKN4, 1/20", RKN4, 0.05 * 6, CONSTANT),
            ("leapfrog, 1/20", LEAPFROG, 0.05, CONSTANT),
            ("Dopri8, 1e-10", dfx.Dopri8(), None, adaptive(1e-10)),
        ):
            one = functools.partial(run, system, solver, 0.0, 300.0, dt0)
            options = {"controller": control, "saveat": saveat, "throw": True}
            orbits = jax.vmap(lambda y0, one=one, options=options: one(y0, **options))
            cells, sol = [], orbits((q0, p0))
            for x in cast(tuple, sol.ys):
                each = np.mean(np.sum(np.asarray(x) ** 2, axis=-1), axis=1)
                error = each.std() / n**0.5
                cells.append(f"{each.mean():.4f} +- {error:.4f}")
            table.row(name, label, *cells)


def singular_damping(quick):
    """Nesterov's equation q'' + 3/t q' + q = 0, whose solution is 2 J_1(t) / t."""
    exact = 2 * 0.4400505857449335  # J_1(1), at t = 1.
    y0 = (jnp.ones(1), jnp.zeros(1))
    table = Table(
        "6. q'' + 3 q'/t + q = 0 to t = 1 in 100 steps: error, or a failure reported",
        *("scheme:<21", "from t0 = 1e-6:>14.1e", "from t0 = 0:>11.1e"),
    )
    system = mechanics(harmonic, dps.LogDamping(3.0))
    solvers: dict[str, Any] = {name: SCHEMES[name].solver for name in FEW}
    solvers["PresymplecticTao"] = dps.PresymplecticTao(5.0)
    for name, solver in solvers.items():
        cells = []
        for t0 in (1e-6, 0.0):
            sol, (q, _) = end(system, solver, t0, 1.0, (1.0 - t0) / 100, y0)
            cells.append(abs(q[0] - exact) if successful(sol) else "reported")
        table.row(name, *cells)


def non_smooth(quick):
    """Kinks, contacts and damping by pieces, against their exact solutions."""
    table = Table("7. non-smooth", "case:<35", "solver:<8", "steps:>6", "error:>8.1e")
    # |q|: parabolas, of period 4 sqrt(2) from q = 1, and of energy 1.
    for name, solver, dt0, control in (
        ("leapfrog", LEAPFROG, 0.01, CONSTANT),
        ("RKN6", RKN6, 0.1, CONSTANT),
        ("Tsit5", dfx.Tsit5(), None, adaptive(1e-6)),
    ):
        system, y0 = mechanics(absolute), (jnp.ones(1), jnp.zeros(1))
        t1 = 100 * 4 * 2**0.5
        sol, (q, p) = end(system, solver, 0.0, t1, dt0, y0, controller=control)
        error, steps = abs(q[0]) + p[0] ** 2 / 2 - 1, int(sol.stats["num_steps"])
        table.row("|q|, 100 periods", name, str(steps), abs(error))
    # A ball, thrown back at each contact, in ten bounces.
    falling = mechanics(lambda t, q, args: jnp.sum(q))
    event = dfx.Event(height, optx.Newton(rtol=1e-10, atol=1e-10), direction=False)
    for name, solver in (("leapfrog", LEAPFROG), ("RKN4", RKN4)):
        t, y = 0.0, (jnp.ones(1), jnp.zeros(1))
        for _ in range(10):
            sol = solve(falling, solver, t, t + 10, 0.05, y, event=event)
            assert sol.ts is not None
            (q, p), t = last(sol), sol.ts[-1]
            y = jnp.abs(q), -p
        table.row("ten bounces", name, "", abs(float(t) - 2**0.5 * 19))
    # Damping switched on at t = 1, between two steps and at the end of one.
    law = lambda t: jnp.maximum(t - 1.0, 0.0)
    system = mechanics(harmonic, law)
    y0 = y = (jnp.ones(1), jnp.zeros(1))
    always = mechanics(harmonic, dps.ConstantDamping(1.0))
    for piece, times in ((mechanics(harmonic), [0.0, 1.0]), (always, [1.0, 3.0])):
        y = reference_end(piece, y, *times)
    for name, count in (("within a step", 50), ("at the end of a step", 49)):
        control = dfx.StepTo(np.linspace(0.0, 3.0, count))
        _, (q, _) = end(system, RKN4, 0.0, 3.0, None, y0, controller=control)
        error = abs(q - y[0])[0]
        table.row(f"damping jumps {name}", "RKN4", str(count - 1), error)


def broken(quick):
    """What a solve reports whose input breaks at run time."""
    table = Table(
        "8. broken input: result, number of steps",
        *("case:<20", "as it is:>22", "Tsit5:>22"),
    )
    implicit = dps.PresymplecticGauss(2, max_iterations=4)
    y0 = (jnp.array([0.3]), jnp.array([-1.0]))
    limited = dfx.PIDController(1e-6, 1e-6, dtmin=1e-9, force_dtmin=False)
    for name, system, base in (
        ("nan: sqrt of q < 0", mechanics(root), LEAPFROG),
        ("overflow: -q^4", mechanics(quartic), LEAPFROG),
        ("4 iterations", dps.Hamiltonian(mixed), implicit),
    ):
        cells = []
        for solver, control in ((base, CONSTANT), (dfx.Tsit5(), limited)):
            problem = system, solver, 0.0, 20.0, 0.5, y0
            sol, (q, _) = end(*problem, controller=control)
            word = "successful" if successful(sol) else "failure"
            finite = "" if np.isfinite(q).all() else ", nan"
            cells.append(f"{word} at {int(sol.stats['num_steps'])}{finite}")
        table.row(name, *cells)


def pictures(series, growth, folder):
    fig, (ax,) = panels(1, 1, (7, 4))
    for name in (name for name, drag in series if drag is None):
        error = series[name, None]
        # The largest error in each of 200 stretches: drift, not oscillation.
        pieces = [x.max() for x in np.array_split(error[1:], 200)]
        orbits = np.linspace(0, (len(error) - 1) / 20, 200)
        ax.semilogy(orbits, pieces, label=name)
    ax.set(xlabel="orbits", ylabel="largest energy error per stretch")
    ax.set_title("Kepler orbit, e = 0.9")
    ax.legend(loc="lower right", fontsize="small")
    save(fig, folder / "hard_cases_kepler.png")
    fig, (ax,) = panels(1, 1, (7, 4))
    numbers = np.array(list(growth))
    for name in growth[numbers[0]]:
        errors = [growth[n][name] for n in numbers]
        ax.loglog(numbers, errors, "o-", label=name)
        slope(ax, numbers, errors[0], 0.5)
    ax.set(xlabel="steps", ylabel="energy error from rounding (rms)")
    ax.set_title("Pendulum, leapfrog, h = 1/8; dotted: square root of the steps")
    ax.legend(fontsize="small")
    save(fig, folder / "hard_cases_rounding.png")


def main():
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", help="groups, by their functions")
    parser.add_argument("--pictures", type=pathlib.Path, help="folder for figures")
    options = parser.parse_args()
    groups = (
        *(overflow, stability, long_times, kepler, encounters, infalls, chaos),
        *(singular_damping, non_smooth, broken),
    )
    out = {}
    for group in groups:
        if options.only is None or group.__name__ in options.only:
            out[group.__name__] = group(options.quick)
    if options.pictures and {"kepler", "long_times"} <= set(out):
        pictures(out["kepler"], out["long_times"], options.pictures)


if __name__ == "__main__":
    main()
