"""Nonseparable systems: speed against error, long times, and the coupling of copies.

1. Error against time of Bregman dynamics, with a quadratic and with an entropic mirror
   map, and of Tao's benchmark H = (q^2 + 1)(p^2 + 1) / 2. Times are the median of
   several, compiled, warmed up, all by turns; errors are at the final time, relative.
2. Tao's benchmark from q = -3, p = 0 to t = 10^4 at equal cost: the largest error of
   the energy in the first and the last eighth of the run.
3. The error of the energy over coupling and step: where the copies resonate.
4. The benchmark with friction, gamma = 0.05, to t = 10^3, and how well the last step is
   conformally symplectic with both copies.
"""

import argparse
import math
import pathlib
import statistics
import time
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D


jax.config.update("jax_enable_x64", True)

HERE = pathlib.Path(__file__).parent
NEWTON = optx.Newton(rtol=1e-12, atol=1e-12)
SIZE = 20

# With the number of evaluations that a step costs, to start from steps of equal cost;
# those of an implicit step include what its Newton iterations differentiate.
SPLIT = {
    "Strang": (dps.Strang(), 1),
    "BlanesMoan4": (dps.BlanesMoan4(), 6),
    "BlanesMoan6": (dps.BlanesMoan6(), 10),
}
QUADRATIC = {"BlanesMoanRKN6": (dps.BlanesMoanRKN6(), 14)}
ANY = {
    "Tao": (dps.PresymplecticTao(), 3),
    "Suzuki4 of Tao": (dps.Suzuki4(dps.PresymplecticTao(20.0)), 15),
    "Coupled, 2": (dps.PresymplecticCoupled(2), 3),
    "Coupled, 4": (dps.PresymplecticCoupled(4), 11),
    "Coupled, 6": (dps.PresymplecticCoupled(6), 27),
    "Projected, 4": (dps.PresymplecticProjected(4), 11),
    "Midpoint, implicit": (dps.PresymplecticMidpoint(NEWTON), 40),
    "Suzuki4 of Midpoint": (dps.Suzuki4(dps.PresymplecticMidpoint(NEWTON)), 200),
}


def mixed_energy(t, q, p, args):
    return (q**2 + 1) * (p**2 + 1) / 2


def least_squares(t, q, args):
    A, b = args
    return jnp.sum((A @ q - b) ** 2) / 2


def data():
    random = np.random.default_rng(0)
    A = random.normal(size=(2 * SIZE, SIZE)) / np.sqrt(2 * SIZE)
    solution = random.dirichlet(np.ones(SIZE))
    return jnp.array(A), jnp.array(A @ solution)


MIXED = dps.Hamiltonian(mixed_energy)
DAMPED = dps.ConformalHamiltonian(
    energy=mixed_energy, damping=dps.ConstantDamping(0.05)
)
START = (jnp.array(-3.0), jnp.array(0.0))


def bregman(mirror_map):
    return dps.BregmanHamiltonian(
        mirror_map, least_squares, dps.PolynomialScaling(2.0, 0.25)
    )


# Hamiltonian, initial state, arguments, time, schemes that apply, longest stage
UNIFORM = (jnp.full(SIZE, 1 / SIZE), jnp.zeros(SIZE))
PROBLEMS = {
    "Bregman, quadratic": (
        *(bregman(dps.EuclideanMirror()), UNIFORM, data(), (1.0, 21.0)),
        *(SPLIT | QUADRATIC | ANY, 0.5),
    ),
    "Bregman, entropic": (
        *(bregman(dps.EntropyMirror(simplex=True)), UNIFORM, data(), (1.0, 21.0)),
        *(SPLIT | ANY, 0.5),
    ),
    "(q² + 1)(p² + 1)/2": (MIXED, START, None, (0.0, 20.0), ANY, 0.05),
}


def solver_of(hamiltonian, solver, y0, args, t0, t1):
    term = dps.HamiltonianTerm(hamiltonian)

    @jax.jit
    def solve(n):
        sol = dfx.diffeqsolve(
            term,
            solver,
            t0=t0,
            t1=t1,
            dt0=(t1 - t0) / n,
            y0=y0,
            args=args,
            max_steps=None,
            throw=False,
        )
        return ravel_pytree(sol.ys)[0], sol.result == dfx.RESULTS.successful

    return solve


def speed(quick, repeats):
    """`{problem: {scheme: [(error, seconds), ...]}}`."""
    curves = {}
    for problem, (H, y0, args, (t0, t1), schemes, longest) in PROBLEMS.items():
        reference = solver_of(H, dfx.Dopri8(scan_kind="lax"), y0, args, t0, t1)
        exact = np.asarray(reference(4000)[0])
        scale = np.max(np.abs(exact))
        runs = {}
        for name, (solver, cost) in schemes.items():
            solve = solver_of(H, solver, y0, args, t0, t1)
            least = 4 * max(1, (t1 - t0) / longest / cost)
            most = math.log2((3e3 if quick else 6e4) / cost / least)
            n = [round(least * 2 ** (k / 2)) for k in range(math.ceil(2 * most))]
            runs[name] = solve, [jnp.asarray(max(1, k)) for k in n]
        errors, times = {}, {}
        for name, (solve, sweep) in runs.items():
            for i, n in enumerate(sweep):
                y, solved = jax.block_until_ready(solve(n))
                error = np.max(np.abs(np.asarray(y) - exact)) / scale
                if solved and error < 1:
                    errors[name, i] = error
                    times[name, i] = []
        for _ in range(repeats):
            for name, i in errors:
                solve, sweep = runs[name]
                start = time.perf_counter()
                jax.block_until_ready(solve(sweep[i]))
                times[name, i].append(time.perf_counter() - start)
        curves[problem] = {
            name: [
                (errors[name, i], statistics.median(times[name, i]))
                for i in range(len(runs[name][1]))
                if (name, i) in errors
            ]
            for name in schemes
        }
        jax.clear_caches()
    return curves


def time_to(curve, target):
    """The least time of a run with at most this error, in microseconds."""
    times = [seconds for error, seconds in curve if error <= target]
    return min(times, default=float("nan")) * 1e6


def print_speed(curves, targets=(1e-3, 1e-6, 1e-9)):
    for problem, schemes in curves.items():
        print(f"\n{problem + ': microseconds to an error of':50}", end="")
        print("".join(f"{target:>10.0e}" for target in targets))
        for name, curve in schemes.items():
            row = "".join(f"{time_to(curve, t):>10.0f}" for t in targets)
            print(f"  {name:48}{row}")


@eqx.filter_jit
def energies(solver, h, t1, max_steps):
    record = lambda t, y, args: mixed_energy(t, y[0], y[1], args)
    sol: Any = dfx.diffeqsolve(
        dps.HamiltonianTerm(MIXED),
        solver,
        t0=0.0,
        t1=t1,
        dt0=h,
        y0=START,
        saveat=dfx.SaveAt(steps=True, fn=record),
        max_steps=max_steps,
        throw=False,
    )
    return jnp.abs(sol.ys - 5.0)


LONG = {
    "Tao": (2, dps.PresymplecticTao(), 3),
    "Coupled": (2, dps.PresymplecticCoupled(2), 3),
    "Projected": (2, dps.PresymplecticProjected(2), 3),
    "Suzuki4 of Tao, 10": (4, dps.Suzuki4(dps.PresymplecticTao(10.0)), 15),
    "Suzuki4 of Tao, 20": (4, dps.Suzuki4(dps.PresymplecticTao(20.0)), 15),
    "Coupled, 4": (4, dps.PresymplecticCoupled(4), 11),
    "Projected, 4": (4, dps.PresymplecticProjected(4), 11),
    "Coupled, 6": (6, dps.PresymplecticCoupled(6), 27),
    "Projected, 6": (6, dps.PresymplecticProjected(6), 27),
}


def long_times(quick):
    t1 = 1e3 if quick else 1e4
    print(
        f"\nEnergy error over t = {t1:.0e}, first and last eighth, evaluations a time"
    )
    print(f"  {'':20} order" + "".join(f"{e:>22}" for e in (100, 300)))
    curves = {}
    for name, (order, solver, cost) in LONG.items():
        row = f"  {name:20} {order:>5}"
        for evaluations in (100, 300):
            n = round(t1 * evaluations / cost)
            errors = np.asarray(energies(solver, t1 / n, t1, n + 1))[:n]
            first, last = np.max(errors[: n // 8]), np.max(errors[-n // 8 :])
            row += f"{first:>12.1e}{last:>10.1e}"
            if evaluations == 300:
                parts = np.array_split(errors, 64)
                curves[name] = order, [np.max(part) for part in parts]
        print(row, flush=True)
    return t1, curves


def scan(quick):
    """Energy errors over strength and step, for Tao's scheme at orders 2 and 4 and for
    the angle of `PresymplecticCoupled`."""
    t1, many = (20.0, 24) if quick else (100.0, 72)
    hs = np.geomspace(0.01, 0.2, many)
    strengths, angles = np.geomspace(0.1, 300, 2 * many), np.linspace(0, 6.5, 2 * many)
    makers = {
        "Tao, order 2": (dps.PresymplecticTao, strengths),
        "Suzuki4 of Tao": (lambda x: dps.Suzuki4(dps.PresymplecticTao(x)), strengths),
        "Coupled, order 2": (lambda x: dps.PresymplecticCoupled(2, x), angles),
        "Coupled, order 4": (lambda x: dps.PresymplecticCoupled(4, x), angles),
    }
    found = {}
    for name, (make, values) in makers.items():
        steps = int(t1 / hs[0]) + 2

        @jax.jit
        def errors(h, xs, make=make, steps=steps):
            one = lambda x: jnp.nanmax(
                jnp.where(
                    jnp.arange(steps) < jnp.ceil(t1 / h),
                    energies(make(x), h, t1, steps),
                    0,
                )
            )
            return jax.vmap(one)(xs)

        grid = [np.asarray(errors(h, jnp.asarray(values))) for h in hs]
        found[name] = hs, values, np.array(grid)
    return found


def canonical_energy(t, q, P, args):
    return DAMPED.canonical(t, q, DAMPED.from_canonical(t, P))


def friction():
    print("\nWith friction 0.05 to t = 1000, h = 1/16")
    runs = {
        "Tao": (DAMPED, dps.PresymplecticTao()),
        "Coupled, 2": (DAMPED, dps.PresymplecticCoupled(2)),
        "Coupled, 4": (DAMPED, dps.PresymplecticCoupled(4)),
        "Tao, canonical momenta": (
            dps.Hamiltonian(canonical_energy),
            dps.PresymplecticTao(5.0),
        ),
    }
    h = 1 / 16
    for name, (hamiltonian, solver) in runs.items():
        saveat = dfx.SaveAt(t1=True, solver_state=True)
        sol: Any = dfx.diffeqsolve(
            dps.HamiltonianTerm(hamiltonian),
            solver,
            t0=0.0,
            t1=1000.0,
            dt0=h,
            y0=START,
            saveat=saveat,
            max_steps=None,
            throw=False,
        )
        if sol.result != dfx.RESULTS.successful:
            print(f"  {name:24} fails at t = {sol.stats['num_steps'] * h:.0f}")
            continue
        q, p = (float(x[-1]) for x in sol.ys)
        decay = np.log(np.hypot(q, p))
        defect = conformal_defect(hamiltonian, solver, 1000.0, h, sol.solver_state)
        print(
            f"  {name:24} log |y| = {decay:.2f}, rate of the oscillator -25; "
            f"conformal defect of a step {defect:.1e}"
        )


def conformal_defect(hamiltonian, solver, t, h, carry):
    """Of a step of both copies, from a state that is not small."""
    half = jax.tree.map(lambda x: 0 * x + 0.01, jax.tree.leaves(carry)[:2])
    state, unravel = ravel_pytree(((jnp.array(0.7), jnp.array(-0.4)), tuple(half)))
    t0, t1 = jnp.array(t), jnp.array(t + h)

    def step(x):
        y, other = unravel(x)
        if isinstance(solver, dps.PresymplecticTao):
            other = jax.tree.map(jnp.add, y, other)
            at = t0, y[0], other[1]
            other = other, (hamiltonian.velocity(*at), hamiltonian.force(*at))
        term = dps.HamiltonianTerm(hamiltonian)
        y, _, _, other, _ = solver.step(term, t0, t1, y, None, other, False)
        other = jnp.stack(jax.tree.leaves(other)[:2])
        if isinstance(solver, dps.PresymplecticTao):
            other = other - jnp.stack(y)
        return jnp.concatenate([jnp.stack(y), other])

    J = np.asarray(jax.jit(jax.jacfwd(step))(state))
    # In a state and the difference to its copy, or in their mean and half of it.
    tao = isinstance(solver, dps.PresymplecticTao)
    weights = np.array([[2.0, 1.0], [1.0, 1.0]]) if tao else 2 * np.eye(2)
    form = np.kron(weights, [[0, 1], [-1, 0]])
    return np.max(np.abs(J.T @ form @ J - np.exp(-0.05 * h) * form))


def picture_speed(curves, path):
    fig, axes = plt.subplots(1, 3, figsize=(15, 4.8), layout="constrained", sharey=True)
    names = list(SPLIT | QUADRATIC | ANY)
    # Circles are splittings, squares two copies, triangles implicit.
    markers = ["o-"] * len(SPLIT | QUADRATIC) + ["s--"] * 6 + ["^:"] * 2
    colors = [plt.get_cmap("tab20")(2 * i % 20 + (i >= 10)) for i in range(len(names))]
    for ax, (problem, schemes) in zip(axes, curves.items(), strict=True):
        for name, marker, color in zip(names, markers, colors, strict=True):
            if schemes.get(name):
                error, seconds = np.array(schemes[name]).T
                ax.loglog(error, seconds * 1e3, marker, ms=4, color=color)
        ax.set(
            title=problem, xlabel="relative error at the final time", xlim=(1, 1e-12)
        )
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("time of one solve (milliseconds)")
    handles = [
        Line2D([], [], marker=m[0], ls=m[1:], color=c)
        for m, c in zip(markers, colors, strict=True)
    ]
    fig.legend(handles, names, loc="outside right center", fontsize=9)
    fig.savefig(path, dpi=75)


def picture_long(t1, curves, path):
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained", sharey=True)
    for ax, order in zip(axes, (2, 4, 6), strict=True):
        for name, (r, errors) in curves.items():
            if r == order:
                style = "--" if "Projected" in name else ":" if "Tao" in name else "-"
                ax.semilogy(np.linspace(0, t1, 64), errors, style, label=name)
        ax.set(title=f"order {order}, 300 evaluations a unit of time", xlabel="time")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=9)
    axes[0].set_ylabel("largest error of the energy (of 5)")
    fig.savefig(path, dpi=80)


def picture_scan(found, path):
    fig, axes = plt.subplots(1, 4, figsize=(16, 4.5), layout="constrained", sharey=True)
    for ax, (name, (hs, values, errors)) in zip(axes, found.items(), strict=True):
        shown = np.log10(np.clip(np.nan_to_num(errors, nan=1e2), 1e-8, 1e2))
        ax.pcolormesh(
            values, hs, shown, vmin=-6, vmax=1, cmap="viridis", rasterized=True
        )
        ax.set(yscale="log", title=name, ylim=(hs[0], hs[-1]))
        if "Tao" in name:
            ax.set(xscale="log", xlabel=r"coupling $\xi$")
            for k in (1, 2, 3):
                ax.plot(k * np.pi / 2 / hs, hs, "w:", lw=1)
            if "order" in name:
                ax.plot(3 * np.pi / 16 / hs, hs, "r--", lw=1.5)
            ax.set_xlim(values[0], values[-1])
        else:
            ax.set(xlabel="angle (radians)")
            for k in (1, 2):
                ax.axvline(k * np.pi, color="w", ls=":", lw=1)
            ax.axvline(np.pi / 2, color="r", ls="--", lw=1.5)
    axes[0].set_ylabel("step $h$")
    fig.colorbar(
        axes[0].collections[0],
        ax=axes,
        label="log10 of the largest error of the energy",
    )
    fig.savefig(path, dpi=80)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=pathlib.Path, default=HERE.parent / "docs/img")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    t1, errors = long_times(options.quick)
    picture_long(t1, errors, options.output / "nonseparable_energy.png")
    friction()
    picture_scan(scan(options.quick), options.output / "nonseparable_coupling.png")
    curves = speed(options.quick, 1 if options.quick else options.repeats)
    print_speed(curves)
    picture_speed(curves, options.output / "nonseparable_speed.png")


if __name__ == "__main__":
    main()
