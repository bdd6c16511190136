"""The schemes of the paper on four dissipative systems: order, speed against error.

Prints two tables, error against step size and speed against error, and saves one
figure. `--quick` runs a smaller version.
"""

import argparse
import pathlib
import statistics
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.special import jv, yv

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt


jax.config.update("jax_enable_x64", True)

SCHEMES = {
    "Euler, momentum first": dps.PresymplecticEuler(),
    "Euler, position first": dps.PresymplecticEuler("position"),
    "leapfrog, momentum first": dps.PresymplecticLeapfrog(),
    "leapfrog, position first": dps.PresymplecticLeapfrog("position"),
    "Tao": dps.PresymplecticTao(),
    "Yoshida 4": dps.SuzukiYoshida(4),
    "Suzuki-Yoshida 6": dps.SuzukiYoshida(6),
    "Suzuki-Yoshida 8": dps.SuzukiYoshida(8),
    "Blanes-Moan RKN 4": dps.BlanesMoanRKN4(),
    "Blanes-Moan RKN 6": dps.BlanesMoanRKN6(),
}


def harmonic(t, q, args):
    return jnp.sum(q**2) / 2


def pendulum(t, q, args):
    return -jnp.sum(jnp.cos(q))


def double_well(t, q, args):
    return jnp.sum(q**4 / 4 - q**2 / 2)


def system(potential, damping):
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)


DAMPED = system(harmonic, dps.ConstantDamping(0.2))
DECAYING = system(harmonic, dps.LogDamping(3.0, shift=1.0))
PENDULUM = system(pendulum, dps.ConstantDamping(0.1))
DOUBLE_WELL = system(double_well, dps.ConstantDamping(0.1))


def damped_exact(t):
    """Equation (sol_const) of the paper, with the mechanical momentum."""
    gamma, q0 = 0.2, 10.0
    omega = np.sqrt(4 - gamma**2)
    phase, decay = omega * t / 2, np.exp(-gamma * t / 2)
    q = q0 * decay * (np.cos(phase) + gamma / omega * np.sin(phase))
    return q, -2 * q0 / omega * decay * np.sin(phase)


def decaying_exact(t):
    """Equation (sol_dec) of the paper, with the mechanical momentum."""
    gamma, s = 3.0, t + 1
    minus, plus = (gamma - 1) / 2, (gamma + 1) / 2
    scale = np.pi / 2
    q = jv(plus, 1) * yv(minus, s) - yv(plus, 1) * jv(minus, s)
    p = yv(plus, 1) * jv(plus, s) - jv(plus, 1) * yv(plus, s)
    return scale * s**-minus * q, scale * s ** (plus - gamma) * p


def hamiltonian_error(hamiltonian, exact, q0, max_steps):
    """The largest error in the Hamiltonian over [0, 10], as in the paper's figures."""
    y0 = (jnp.array(q0), jnp.array(0.0))
    values = jax.vmap(hamiltonian.canonical)

    def error(solver, h):
        # An array `dt0` and one `max_steps`: one compilation for all step sizes.
        sol = dfx.diffeqsolve(
            hamiltonian,
            solver,
            t0=0.0,
            t1=10.0,
            dt0=jnp.asarray(h),
            y0=y0,
            saveat=dfx.SaveAt(steps=True),
            max_steps=max_steps,
        )
        ts = np.asarray(sol.ts)
        taken = ts < np.inf
        ts, ys = ts[taken], jax.tree.map(lambda y: y[taken], sol.ys)
        difference = values(ts, *ys) - values(ts, *exact(ts))
        return float(jnp.max(jnp.abs(difference)))

    return error


def solution_error(hamiltonian, q0, t1):
    """The error of the solution at `t1`, against Dopri8 with tiny steps."""
    y0 = (jnp.array(q0), jnp.array(0.0))

    def solve(solver, h):
        return dfx.diffeqsolve(
            hamiltonian, solver, 0.0, t1, jnp.asarray(h), y0, max_steps=None
        ).ys

    exact = solve(dfx.Dopri8(), 0.005)

    def error(solver, h):
        return distance(solve(solver, h), exact)

    return error


def distance(ys, exact):
    pairs = zip(jax.tree.leaves(ys), jax.tree.leaves(exact), strict=True)
    return float(max(jnp.max(jnp.abs(y - e)) for y, e in pairs))


def slope(hs, errors, floor):
    """The measured order, from the smallest steps whose error is not rounding."""
    fit = [(h, e) for h, e in zip(hs, errors, strict=True) if floor < e < 1][-3:]
    if len(fit) < 2:
        return float("nan")
    log_hs, log_errors = np.log(fit).T
    return np.polyfit(log_hs, log_errors, 1)[0]


def convergence(hs):
    steps = round(10 / hs[-1])
    problems = {
        "damped oscillator": (
            hamiltonian_error(DAMPED, damped_exact, 10.0, steps),
            1e-9,
        ),
        "decaying oscillator": (
            hamiltonian_error(DECAYING, decaying_exact, 1.0, steps),
            1e-11,
        ),
        "damped pendulum": (solution_error(PENDULUM, 2.0, 10.0), 1e-11),
    }
    print("Measured order, and error at step size h =", hs[2])
    print(f"{'':26} {'order':>5}" + "".join(f" {name:>26}" for name in problems))
    errors = {}
    for scheme, solver in SCHEMES.items():
        row = f"{scheme:26} {solver.order(None):>5}"
        for name, (error, floor) in problems.items():
            es = errors[name, scheme] = [error(solver, h) for h in hs]
            row += f" {slope(hs, es, floor):>15.2f} {es[2]:>10.1e}"
        print(row, flush=True)
    return errors


def canonical_terms(gamma):
    """The pendulum for Diffrax's `SemiImplicitEuler`, with canonical momentum."""
    velocity = lambda t, P, args: jnp.exp(-gamma * t) * P
    force = lambda t, q, args: -jnp.exp(gamma * t) * jnp.sin(q)
    return dfx.ODETerm(velocity), dfx.ODETerm(force)


def speed(quick):
    """Time to solve the damped pendulum to t = 100, against the error there."""
    y0, t1, gamma = (jnp.array(2.0), jnp.array(0.0)), 100.0, 0.1

    def constant(terms, solver):
        @jax.jit
        def solve(h):
            return dfx.diffeqsolve(
                terms, solver, t0=0.0, t1=t1, dt0=h, y0=y0, max_steps=None
            ).ys

        return solve

    def adaptive(solver):
        @jax.jit
        def solve(tol):
            controller = dfx.PIDController(rtol=tol, atol=tol)
            return dfx.diffeqsolve(
                PENDULUM,
                solver,
                t0=0.0,
                t1=t1,
                dt0=None,
                y0=y0,
                max_steps=None,
                stepsize_controller=controller,
            ).ys

        return solve

    steps, tols = [0.5, 0.25, 0.1, 0.05, 0.02], [1e-2, 1e-4, 1e-6, 1e-8, 1e-10]
    runs = {
        "leapfrog": (constant(PENDULUM, dps.PresymplecticLeapfrog()), steps),
        "Yoshida 4": (constant(PENDULUM, dps.SuzukiYoshida(4)), steps),
        "Blanes-Moan RKN 4": (constant(PENDULUM, dps.BlanesMoanRKN4()), steps),
        "Blanes-Moan RKN 6": (constant(PENDULUM, dps.BlanesMoanRKN6()), steps),
        "Diffrax SemiImplicitEuler": (
            constant(canonical_terms(gamma), dfx.SemiImplicitEuler()),
            steps,
        ),
        "Diffrax Tsit5, adaptive": (adaptive(dfx.Tsit5()), tols),
    }
    exact = constant(PENDULUM, dfx.Dopri8())(0.005)
    repeats = 3 if quick else 15
    curves = {name: [] for name in runs}
    # The runs alternate, so that changes of the load of the machine affect all alike.
    times = {(name, x): [] for name, (_, xs) in runs.items() for x in xs}
    for solve, xs in runs.values():
        for x in xs:
            jax.block_until_ready(solve(x))
    for _ in range(repeats):
        for name, (solve, xs) in runs.items():
            for x in xs:
                start = time.perf_counter()
                jax.block_until_ready(solve(x))
                times[name, x].append(time.perf_counter() - start)
    for name, (solve, xs) in runs.items():
        for x in xs:
            q, p = solve(x)
            if name == "Diffrax SemiImplicitEuler":
                p = p * jnp.exp(-gamma * t1)
            curves[name].append(
                (distance((q, p), exact), statistics.median(times[name, x]) * 1e6)
            )
    print(f"\nDamped pendulum to t = 100: time (median of {repeats} runs) and error")
    for name, curve in curves.items():
        pairs = "".join(f" {us:>7.0f} us to {e:.0e}" for e, us in curve)
        print(f"{name:26}{pairs}")
    return curves


def basins(n):
    """The well in which a damped particle settles, for a grid of initial states."""
    q0, p0 = jnp.meshgrid(jnp.linspace(-2.5, 2.5, n), jnp.linspace(-2.5, 2.5, n))
    print("\nDouble well, one solve for", n * n, "initial states:")
    sol = dfx.diffeqsolve(
        DOUBLE_WELL,
        dps.PresymplecticLeapfrog(),
        t0=0.0,
        t1=60.0,
        dt0=0.05,
        y0=(q0, p0),
        progress_meter=dfx.TqdmProgressMeter(),
    )
    q, _ = jax.tree.map(lambda y: np.asarray(y[-1]), sol.ys)
    return q


def picture(path, hs, errors, curves, wells):
    fig, axes = plt.subplots(2, 2, figsize=(11, 8.5), layout="constrained")
    shown = [s for s in SCHEMES if "position" not in s]
    for ax, name in zip(
        axes[0], ("damped oscillator", "decaying oscillator"), strict=True
    ):
        for scheme in shown:
            ax.loglog(hs, errors[name, scheme], "o-", ms=4, label=scheme)
        for r in (1, 2, 4, 6):
            anchor = errors[name, "Euler, momentum first"][0] / hs[0]
            ax.loglog(hs, anchor * hs[0] * (np.array(hs) / hs[0]) ** r, "k:", lw=0.7)
        ax.set(
            title=f"The paper's {name}, t in [0, 10]",
            xlabel="step size h",
            ylabel="largest error in the Hamiltonian",
            ylim=(1e-17, 100),
        )
    axes[0, 0].legend(fontsize=8, ncols=2, loc="lower right")
    for name, curve in curves.items():
        es, us = np.array(curve).T
        axes[1, 0].loglog(
            es, us, "s--" if "Diffrax" in name else "o-", ms=4, label=name
        )
    axes[1, 0].set(
        title="Damped pendulum to t = 100: speed against error",
        xlabel="error of the solution",
        ylabel="time of one solve (microseconds)",
    )
    axes[1, 0].invert_xaxis()
    axes[1, 0].legend(fontsize=8)
    axes[1, 1].imshow(
        wells, origin="lower", extent=(-2.5, 2.5, -2.5, 2.5), cmap="RdBu", aspect="auto"
    )
    axes[1, 1].set(
        title="Damped double well: final well by initial state",
        xlabel="initial position",
        ylabel="initial momentum",
    )
    fig.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="schemes.png")
    options = parser.parse_args()
    hs = [0.625 / 2**k for k in range(4 if options.quick else 7)]
    errors = convergence(hs)
    curves = speed(options.quick)
    wells = basins(40 if options.quick else 400)
    picture(options.output, hs, errors, curves, wells)
    print(f"\nFigure saved to {options.output}")


if __name__ == "__main__":
    main()
