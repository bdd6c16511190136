"""Rates of Bregman dynamics, and the stability limit of a fixed step size."""

import diffrax as dfx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper._common import parser, report


# Convex with tiny eigenvalues, as the rates do not assume strong convexity.
EIGENVALUES = jnp.logspace(-5, 0, 60)
POINT = jnp.linspace(1, 10, 10) / 55.0


def quadratic(t, q, args):
    return jnp.sum(EIGENVALUES * q**2) / 2


def divergence(t, q, args):
    """Kullback-Leibler divergence from a point of the simplex; its minimum is 0."""
    return jnp.sum(q * jnp.log(q / POINT))


def values(mirror_map, objective, scaling, solver, q0, t1, h):
    """Times from 1 to `t1` in steps of `h`, and f - f* at each."""
    hamiltonian = dps.BregmanHamiltonian(mirror_map, objective, scaling)
    sol = dfx.diffeqsolve(
        hamiltonian,
        solver,
        t0=1.0,
        t1=t1,
        dt0=h,
        y0=(q0, jnp.zeros_like(q0)),
        saveat=dfx.SaveAt(steps=True, fn=lambda t, y, args: objective(t, y[0], args)),
        max_steps=round((t1 - 1) / h) + 1,
        throw=False,  # an unstable solve ends early
    )
    assert sol.ts is not None and sol.ys is not None
    taken = np.isfinite(sol.ts) & np.isfinite(sol.ys)
    return np.asarray(sol.ts)[taken], np.asarray(sol.ys)[taken]


def exponent(ts, fs):
    """The exponent of time in the decay of the envelope of f - f*, from t = 3 on."""
    envelope = np.maximum.accumulate(fs[::-1])[::-1]
    late = ts > 3
    return np.polyfit(np.log(ts[late]), np.log(envelope[late]), 1)[0]


def blow_up(ts, fs):
    """The time at which f exceeds ten times its initial value."""
    above = np.flatnonzero(fs > 10 * fs[0])
    return ts[above[0]] if len(above) else np.inf


SEPARABLE = {
    "Euler": dps.PresymplecticEuler(),
    "leapfrog": dps.PresymplecticLeapfrog(),
    "exact drift, Strang": dps.Strang(),
}
ANY = {
    "Tao, coupling 2": dps.PresymplecticTao(2.0),
    "Tao, coupling 10": dps.PresymplecticTao(10.0),
    "exact drift, Strang": dps.Strang(),
}


def main():
    options = parser(__doc__).parse_args()
    t1 = 41.0 if options.quick else 401.0
    euclidean, simplex = dps.EuclideanMirror(), dps.EntropyMirror(simplex=True)
    start, corner = jnp.ones(len(EIGENVALUES)), jnp.ones(10) / 10
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    rows = []
    cases = {
        "separable": (euclidean, quadratic, SEPARABLE, start, 0.05, axes[0]),
        "entropy on the simplex": (simplex, divergence, ANY, corner, 0.01, axes[1]),
    }
    scaling = dps.PolynomialScaling(2.0)
    for case, (mirror_map, objective, solvers, q0, h, ax) in cases.items():
        for name, solver in solvers.items():
            ts, fs = values(mirror_map, objective, scaling, solver, q0, t1, h)
            ax.loglog(ts, fs, label=name, lw=1)
            scaled = ts**2 * fs
            found = f"fails at t = {ts[-1]:.3g}, where a copy leaves the simplex"
            if ts[-1] > t1 - h:
                late = scaled[ts > t1 / 2].max()
                found = (
                    f"{exponent(ts, fs):.2f}; t^2 (f - f*) is at most "
                    f"{scaled.max():.3g} on [1, {t1:g}], {late:.3g} on its second half"
                )
            rows.append(
                (
                    f"{case}, c = 2, {name}: exponent of the decay of f - f*",
                    "-2, the rate of the motion",
                    found,
                )
            )
        ax.loglog([1, t1], [1, t1**-2], "k:", lw=0.8, label="slope -2")
        ax.set(
            title=f"{case}, c = 2, h = {h}",
            xlabel="time t",
            ylabel="objective above its minimum",
        )
        ax.legend(fontsize=8)

    # The leapfrog is stable up to the frequency 2 / h. The fastest mode, whose
    # eigenvalue is one, has the frequency exp(alpha + beta / 2).
    h = 0.05
    fastest = {
        "t^-3": (dps.PolynomialScaling(3.0), lambda t: 3 * np.sqrt(t)),
        "t^-4": (dps.PolynomialScaling(4.0), lambda t: 4 * t),
        "exp(-t)": (dps.ExponentialScaling(1.0), lambda t: np.exp(t / 2)),
    }
    fine = np.linspace(1, 1000, 1_000_000)
    for rate, (scaling, frequency) in fastest.items():
        limit = fine[np.argmax(frequency(fine) * h > 2)]
        end = 1 + round(1.2 * (limit - 1) / h) * h
        ts, fs = values(
            euclidean, quadratic, scaling, SEPARABLE["leapfrog"], start, end, h
        )
        axes[2].loglog(ts, fs.clip(max=1e3), label=rate, lw=1)
        rows.append(
            (
                f"separable, leapfrog: rate {rate}",
                "preserved",
                f"until the stability limit, at t = {limit:.1f} in theory; "
                f"f is ten times its initial value at t = {blow_up(ts, fs):.1f}",
            )
        )
    axes[2].set(
        title=f"separable, leapfrog, h = {h}: faster rates",
        xlabel="time t",
        ylabel="objective above its minimum",
        ylim=(1e-6, 1e3),
    )
    axes[2].legend(fontsize=8)
    report("bregman", fig, rows, options)


if __name__ == "__main__":
    main()
