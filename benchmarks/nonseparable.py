"""Nonseparable systems: speed against error, long times, and the coupling of copies.

1. Error against time of Bregman dynamics, with a quadratic and with an entropic mirror
   map, and of Tao's benchmark H = (q^2 + 1)(p^2 + 1) / 2. Times are medians of
   interleaved runs; errors are at the final time, relative.
2. Tao's benchmark from q = -3, p = 0 to t = 10^4 at equal cost: the largest error of
   the energy in the first and the last eighth of the run.
3. The error of the energy over coupling and step: where the copies resonate.
"""

import math
import pathlib
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from _plot import error_against_time, FOLDER, panels, save
from _report import command_line, Table
from _schemes import Scheme, SCHEMES
from _solve import reference_end, relative_error, solve, states
from _timing import error_curves, least_to

import diffrax_presym as dps


NEWTON = optx.Newton(rtol=1e-12, atol=1e-12)
SIZE = 20

# Sweeps start from steps of equal cost. That of an implicit step includes what its
# Newton iterations differentiate.
SPLIT = {name: SCHEMES[name] for name in ("Strang", "BlanesMoan4", "BlanesMoan6")}
QUADRATIC = {"BlanesMoanRKN6": SCHEMES["BlanesMoanRKN6"]}
COPIES = {
    "Tao": SCHEMES["PresymplecticTao"],
    "Suzuki4 of Tao": Scheme(dps.Suzuki4(dps.PresymplecticTao(20.0)), 4, 15),
}
MIDPOINT = dps.PresymplecticGauss(1, NEWTON)
IMPLICIT = {
    "Midpoint, implicit": Scheme(MIDPOINT, 2, 40),
    "Suzuki4 of Midpoint": Scheme(dps.Suzuki4(MIDPOINT), 4, 200),
    "Gauss, 3 stages": Scheme(dps.PresymplecticGauss(3), 6, 20),
    "Gauss, 6 stages": Scheme(dps.PresymplecticGauss(6), 12, 40),
    # Its iteration ends at a tolerance.
    "Gauss, 4 stages, 1e-8": Scheme(dps.PresymplecticGauss(4, tolerance=1e-8), 8, 20),
}
ANY = COPIES | IMPLICIT


def mixed_energy(t, q, p, args):
    return (q**2 + 1) * (p**2 + 1) / 2


def least_squares(t, q, args):
    A, b = args
    return jnp.sum((A @ q - b) ** 2) / 2


def data():
    random = np.random.default_rng(0)
    A = random.normal(size=(2 * SIZE, SIZE)) / np.sqrt(2 * SIZE)
    return jnp.array(A), jnp.array(A @ random.dirichlet(np.ones(SIZE)))


MIXED = dps.Hamiltonian(mixed_energy)
START = (jnp.array(-3.0), jnp.array(0.0))


def bregman(mirror_map, schemes):
    scaling = dps.PolynomialScaling(2.0, 0.25)
    system = dps.BregmanHamiltonian(mirror_map, least_squares, scaling)
    y0 = jnp.full(SIZE, 1 / SIZE), jnp.zeros(SIZE)
    return system, y0, data(), (1.0, 21.0), schemes | ANY, 0.5


# System, initial state, arguments, time, schemes that apply, longest stage
PROBLEMS: dict[str, Any] = {
    "Bregman, quadratic": bregman(dps.EuclideanMirror(), SPLIT | QUADRATIC),
    "Bregman, entropic": bregman(dps.EntropyMirror(simplex=True), SPLIT),
    "(q² + 1)(p² + 1)/2": (MIXED, START, None, (0.0, 20.0), ANY, 0.05),
}


def speed(quick, repeats):
    """`{problem: {scheme: [(error, seconds), ...]}}`."""
    curves = {}
    for problem, (H, y0, args, times, schemes, longest) in PROBLEMS.items():
        (t0, t1), runs = times, {}
        exact = reference_end(H, y0, t0, t1, args)
        for name, (solver, _, cost) in schemes.items():
            run = partial(states, H, solver, times, y0, args=args)
            least = 4 * max(1, (t1 - t0) / longest / cost)
            most = math.log2((3e3 if quick else 6e4) / cost / least)
            n = [round(least * 2 ** (k / 2)) for k in range(math.ceil(2 * most))]
            runs[name] = jax.jit(run), [jnp.asarray(max(1, k)) for k in n]

        def error(y, exact=exact):
            found = relative_error(y, exact)
            return found if found < 1 else math.nan

        curves[problem] = error_curves(runs, error, repeats)
        jax.clear_caches()
    return curves


def print_speed(curves, targets=(1e-3, 1e-6, 1e-9)):
    for problem, schemes in curves.items():
        columns = [f"{target:.0e}:>9.0f" for target in targets]
        table = Table("", f"{problem}, microseconds to an error of:<50", *columns)
        for name in PROBLEMS[problem][-2]:
            curve = schemes.get(name, [])
            table.row(f"  {name}", *(1e6 * least_to(curve, x) for x in targets))


@eqx.filter_jit
def energies(solver, h, t1, max_steps):
    record = lambda t, y, args: mixed_energy(t, y[0], y[1], args)
    saveat = dfx.SaveAt(steps=True, fn=record)
    sol = solve(MIXED, solver, 0.0, t1, h, START, saveat=saveat, max_steps=max_steps)
    return jnp.abs(jnp.asarray(sol.ys) - 5.0)


TAO = dps.PresymplecticTao
LONG = {
    "Tao": SCHEMES["PresymplecticTao"],
    "Suzuki4 of Tao, 10": Scheme(dps.Suzuki4(TAO(10.0)), 4, 15),
    "Suzuki4 of Tao, 20": Scheme(dps.Suzuki4(TAO(20.0)), 4, 15),
    # About so many evaluations, in its iterations.
    "Gauss, 1 stage": Scheme(dps.PresymplecticGauss(1), 2, 10),
    "Gauss, 2 stages": Scheme(dps.PresymplecticGauss(2), 4, 20),
}


def long_times(quick):
    t1 = 1e3 if quick else 1e4
    table = Table(
        f"Energy error over t = {t1:.0e}, in the first and the last eighth, at 100 and "
        "300 evaluations per unit of time",
        "scheme:<22",
        "order:>5d",
        *(f"{part}:>9.1e" for part in ("100: first", "last", "300: first", "last")),
    )
    curves = {}
    for name, (solver, order, cost) in LONG.items():
        cells = []
        for evaluations in (100, 300):
            n = round(t1 * evaluations / cost)
            errors = np.asarray(energies(solver, t1 / n, t1, n + 1))[:n]
            cells += [np.max(errors[: n // 8]), np.max(errors[-n // 8 :])]
            if evaluations == 300:
                parts = np.array_split(errors, 64)
                curves[name] = order, [np.max(part) for part in parts]
        table.row(name, order, *cells)
    return t1, curves


def scan(quick):
    """Energy errors over strength and step, for Tao's scheme at orders 2 and 4."""
    t1, many = (20.0, 24) if quick else (100.0, 72)
    hs = np.geomspace(0.01, 0.2, many)
    strengths = np.geomspace(0.1, 300, 2 * many)
    makers = {
        "Tao, order 2": (TAO, strengths),
        "Suzuki4 of Tao": (lambda x: dps.Suzuki4(TAO(x)), strengths),
    }
    found = {}
    for name, (make, values) in makers.items():
        steps = int(t1 / hs[0]) + 2

        @jax.jit
        def errors(h, xs, make=make, steps=steps):
            taken = jnp.arange(steps) < jnp.ceil(t1 / h)
            error = lambda x: jnp.where(taken, energies(make(x), h, t1, steps), 0)
            return jax.vmap(lambda x: jnp.nanmax(error(x)))(xs)

        grid = [np.asarray(errors(h, jnp.asarray(values))) for h in hs]
        found[name] = hs, values, np.array(grid)
    return found


def picture_speed(curves, path):
    error_against_time(curves, [SPLIT | QUADRATIC, COPIES, IMPLICIT], path, columns=3)


def picture_long(t1, curves, path):
    fig, axes = panels(2, 2, (4.4, 4), sharey=True)
    for ax, order in zip(axes, (2, 4), strict=True):
        for name, (r, errors) in curves.items():
            if r == order:
                style = ":" if "Tao" in name else "-"
                ax.semilogy(np.linspace(0, t1, 64), errors, style, label=name)
        title = f"order {order}, 300 evaluations per unit of time"
        ax.set(title=title, xlabel="time")
        ax.legend(fontsize=9)
    axes[0].set_ylabel("largest error of the energy (of 5)")
    save(fig, path)


def picture_scan(found, path):
    fig, axes = panels(2, 2, (4, 4.5), sharey=True)
    for ax, (name, (hs, values, errors)) in zip(axes, found.items(), strict=True):
        shown = np.log10(np.clip(np.nan_to_num(errors, nan=1e2), 1e-8, 1e2))
        ax.pcolormesh(
            values, hs, shown, vmin=-6, vmax=1, cmap="viridis", rasterized=True
        )
        ax.set(yscale="log", title=name, ylim=(hs[0], hs[-1]))
        ax.set(xscale="log", xlabel=r"coupling $\xi$")
        for k in (1, 2, 3):
            ax.plot(k * np.pi / 2 / hs, hs, "k:", lw=1.2)
        if "order" in name:
            ax.plot(3 * np.pi / 16 / hs, hs, "r--", lw=1.5)
        ax.set_xlim(values[0], values[-1])
    axes[0].set_ylabel("step $h$")
    label = "log10 of the largest error of the energy"
    fig.colorbar(axes[0].collections[0], ax=axes, label=label)
    save(fig, path)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=pathlib.Path, default=FOLDER)
    options = parser.parse_args()
    t1, errors = long_times(options.quick)
    picture_long(t1, errors, options.output / "nonseparable_energy.png")
    picture_scan(scan(options.quick), options.output / "nonseparable_coupling.png")
    curves = speed(options.quick, 1 if options.quick else options.repeats)
    print_speed(curves)
    picture_speed(curves, options.output / "nonseparable_speed.png")


if __name__ == "__main__":
    main()
