"""The hard cases: errors of all kinds of schemes, one table per group."""

import functools
import pathlib
from typing import Any, cast

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from _hard_cases import (
    adaptive,
    end,
    FEW,
    LEAPFROG,
    RKN6,
    run,
    successful,
)
from _hard_friction import stability
from _hard_orbits import encounters, infalls, kepler
from _plot import panels, save, slope
from _report import command_line, Table
from _schemes import SCHEMES
from _solve import CONSTANT, last, reference_end, solve
from problems import henon_heiles as damped_henon_heiles, mechanics

import diffrax_presym as dps


RKN4 = dps.BlanesMoanRKN4()
QUADRATIC = dps.QuadraticKinetic()

harmonic = lambda t, q, args: jnp.sum(q**2) / 2
pendulum = lambda t, q, args: jnp.sum(1 - jnp.cos(q))
absolute = lambda t, q, args: jnp.sum(jnp.abs(q))
# Not defined for negative positions.
# Without a lower bound: the motion reaches infinity in finite time.
duffing = lambda t, q, args: jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t))
henon_heiles = damped_henon_heiles().system.potential
height = lambda t, y, args, **kwargs: y[0][0]


def canonical_form(potential, gamma):
    """The same system in canonical momenta, the naive way: P grows like exp(eta)."""
    gradient = jax.grad(potential, argnums=1)
    return dps.MechanicalSystem(
        lambda t, p, args: jnp.exp(-gamma * t) * jnp.sum(p**2) / 2,
        dps.ForceField(lambda t, q, args: -jnp.exp(gamma * t) * gradient(t, q, args)),
    )


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
        *(singular_damping, non_smooth),
    )
    out = {}
    for group in groups:
        if options.only is None or group.__name__ in options.only:
            out[group.__name__] = group(options.quick)
    if options.pictures and {"kepler", "long_times"} <= set(out):
        pictures(out["kepler"], out["long_times"], options.pictures)


if __name__ == "__main__":
    main()
