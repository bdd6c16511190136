"""Rates of convergence of Bregman dynamics, and their preservation by the schemes.

Prints the slope of f - f* against time for polynomial and exponential scalings, with
the theoretical values, and the difference between discrete and continuous solution
against the step size. Saves one figure. `--quick` runs a smaller version.
"""

import argparse
import pathlib

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt


jax.config.update("jax_enable_x64", True)

# The points of a classification, multiplied by their labels; linearly separable.
POINTS = jnp.array(np.random.default_rng(0).normal(size=(12, 2)) / 2 + [2.0, 1.0])


def exponential(t, q, args):
    """The exact solution is q = beta(t), with f = exp(-beta)."""
    return jnp.sum(jnp.exp(-q))


def logistic(t, q, args):
    """Logistic regression. It has no minimum; its infimum is zero."""
    return jnp.mean(jnp.logaddexp(0.0, -POINTS @ q))


def quadratic(t, q, args):
    return jnp.sum(q**2) / 2


def uneven(t, q, args):
    return (q[0] ** 2 + 4 * q[1] ** 2) / 2 + jnp.sum(q**4) / 4


# Objective, initial position, and the theoretical exponent of t in units of c. For the
# quadratic it is not the bound, -1, but follows from the WKB amplitude.
PROBLEMS = {
    "exponential": (exponential, jnp.array([0.5]), -1.0),
    "logistic": (logistic, jnp.zeros(2), -1.0),
    "quadratic": (quadratic, jnp.array([1.0]), -1.5),
}
# Scaling, and the time at which exp(-beta) is about 1e-8
SCALINGS = {
    "c = 2": (dps.PolynomialScaling(2.0), 1e4),
    "c = 3": (dps.PolynomialScaling(3.0), 464.0),
    "c = 4": (dps.PolynomialScaling(4.0), 100.0),
    "c = 6": (dps.PolynomialScaling(6.0), 21.5),
    "exponential": (dps.ExponentialScaling(1.0), 18.4),
}
SOLVERS = {
    "Strang": (dps.Strang(), 2),
    "BlanesMoan4": (dps.BlanesMoan4(), 4),
    "BlanesMoan6": (dps.BlanesMoan6(), 6),
}


def solve(objective, scaling, solver, q0, ts, substeps):
    """The gap f - f* at the given times, with `substeps` steps between them."""
    hamiltonian = dps.BregmanHamiltonian(dps.EuclideanMirror(), objective, scaling)
    sol = dfx.diffeqsolve(
        hamiltonian,
        dps.Composition(solver, (1 / substeps,) * substeps),
        t0=ts[0],
        t1=ts[-1],
        dt0=None,
        y0=(q0, jnp.zeros_like(q0)),
        saveat=dfx.SaveAt(steps=True, fn=lambda t, y, args: objective(t, y[0], args)),
        stepsize_controller=dfx.StepTo(ts),
        max_steps=len(ts) - 1,
    )
    return np.asarray(sol.ys)


def fitted(x, gap):
    """The slope of the upper envelope of log gap, over the last two thirds of x."""
    chosen = x > x[0] + (x[-1] - x[0]) / 3
    x, log = x[chosen], np.log(gap[chosen])
    # The largest value of each window, as an oscillating solution has zeros.
    windows = np.array_split(np.arange(len(x)), 12)
    top = [window[np.argmax(log[window])] for window in windows]
    return np.polyfit(x[top], log[top], 1)[0]


def rates(quick):
    print("Slope of log(f - f*) against log t, or t for the exponential scaling;")
    print("theoretical values in brackets\n")
    print(f"{'scaling':14}" + "".join(f"{name:>22}" for name in PROBLEMS))
    curves = {}
    for scaling, (law, t1) in SCALINGS.items():
        exponential_rate = scaling == "exponential"
        row, c = f"{scaling:14}", float(law.rate(1.0))
        for name, (objective, q0, exponent) in PROBLEMS.items():
            # The frequency on the quadratic grows, so more steps are needed.
            last = t1**0.75 if quick or name == "quadratic" else t1
            if exponential_rate:
                ts = jnp.linspace(0.0, last, 501)
            else:
                ts = jnp.geomspace(1.0, last, 501)
            substeps = 40 if quick else 200
            gap = solve(objective, law, dps.BlanesMoan4(), q0, ts, substeps)
            ts = np.asarray(ts[1:])
            slope = fitted(ts if exponential_rate else np.log(ts), gap)
            row += f"{slope:>12.3f} ({exponent * c:>6.2f})"
            curves[scaling, name] = ts, gap
        print(row, flush=True)
    return curves


def convergence(quick):
    """The discrete minus the continuous gap at t = 3, against the step size."""
    q0, law = jnp.array([1.0, -0.5]), dps.PolynomialScaling(3.0)
    H = dps.BregmanHamiltonian(dps.EuclideanMirror(), uneven, law)

    def end(solver, n):
        sol = dfx.diffeqsolve(
            H,
            solver,
            t0=1.0,
            t1=3.0,
            dt0=jnp.asarray(2 / n),
            y0=(q0, jnp.zeros_like(q0)),
        )
        assert sol.ys is not None
        return float(uneven(3.0, sol.ys[0][-1], None))

    exact = end(dps.BlanesMoan6(), 2000)
    ns = [20, 40, 80] if quick else [20, 40, 80, 160, 320]
    print("\nDiscrete minus continuous f - f* at t = 3, c = 3, against the step h")
    print(f"{'':14}" + "".join(f"{2 / n:>12.4f}" for n in ns) + "     slope (order)")
    errors = {}
    for name, (solver, order) in SOLVERS.items():
        errors[name] = [abs(end(solver, n) - exact) for n in ns]
        kept = [(2 / n, e) for n, e in zip(ns, errors[name], strict=True) if e > 1e-13]
        log_h, log_error = np.log(np.array(kept[-3:])).T
        slope = np.polyfit(log_h, log_error, 1)[0]
        row = "".join(f"{e:>12.1e}" for e in errors[name])
        print(f"{name:14}{row}{slope:>10.2f} ({order})", flush=True)
    return ns, errors


def picture(path, curves, ns, errors):
    fig, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    for ax, problem in zip(axes, ("logistic", "quadratic"), strict=False):
        for scaling, (law, _) in SCALINGS.items():
            if scaling == "exponential":
                continue
            ts, gap = curves[scaling, problem]
            (line,) = ax.loglog(ts, gap, label=scaling)
            bound = gap[0] * 3 * (ts / ts[0]) ** -float(law.rate(1.0))
            ax.loglog(ts, bound, ":", color=line.get_color(), lw=1)
        ax.set(
            title=f"{problem}: f − f* and the rate $t^{{-c}}$ (dotted)",
            xlabel="time t",
            ylabel="f − f*",
        )
        ax.legend()
        ax.grid(alpha=0.3)
    hs = 2 / np.array(ns)
    for name, (_, order) in SOLVERS.items():
        (line,) = axes[2].loglog(hs, errors[name], "o-", label=f"{name}, order {order}")
        guide = errors[name][0] * (hs / hs[0]) ** order
        axes[2].loglog(hs, guide, ":", color=line.get_color(), lw=1)
    axes[2].set(
        title="discrete minus continuous, at t = 3",
        xlabel="step h",
        ylabel="difference of f − f*",
        ylim=(1e-15, None),
    )
    axes[2].legend()
    axes[2].grid(alpha=0.3)
    fig.savefig(path, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="bregman.png")
    options = parser.parse_args()
    curves = rates(options.quick)
    ns, errors = convergence(options.quick)
    picture(options.output, curves, ns, errors)
    print(f"\nFigure saved to {options.output}")


if __name__ == "__main__":
    main()
