"""Preservation of the continuous rate of convergence, and bounds in time."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper._common import Nesterov, parser, report
from examples.paper.exact_solutions import HIGH, solve
from examples.paper.hamiltonian_error import envelope
from examples.schemes import DAMPED, DECAYING, harmonic, slope, system


SYSTEMS = {
    "damped, gamma = 0.2": DAMPED,
    "decaying, gamma = 3": DECAYING,
    "overdamped, gamma = 3": system(harmonic, dps.ConstantDamping(3.0)),
}
SCHEMES = {
    "Euler": dps.PresymplecticEuler(),
    "leapfrog": dps.PresymplecticLeapfrog(),
    "Suzuki-Yoshida": dps.SuzukiYoshida(4),
}
METHODS = {
    "exact (order 8)": HIGH,
    "leapfrog": dps.PresymplecticLeapfrog(),
    "Euler": dps.PresymplecticEuler(),
    "Nesterov": Nesterov(),
    "explicit Euler": dfx.Euler(),
    "Heun": dfx.Heun(),
}
# The statements of the paper on the rates of decay.
KEPT = {name: "the continuous one" for name in ("exact (order 8)", "leapfrog", "Euler")}
LEAPFROG = dps.PresymplecticLeapfrog()


def scaled_error(hamiltonian, solver, h, t1):
    """|f(q_l) - f(q(t_l))| exp(eta_2), which by the theorem is of order h^r."""
    steps = round(t1 / h)
    # The exact solution, by a scheme of order eight, at the same times.
    parts = max(1, round(h / 0.05))
    _, (exact, _), _ = solve(hamiltonian, HIGH, 1.0, t1, steps * parts)
    ts, (q, _), _ = solve(hamiltonian, solver, 1.0, t1, steps)
    error = jnp.abs(q**2 - exact[parts - 1 :: parts] ** 2) / 2
    return ts, error * jnp.exp(jax.vmap(hamiltonian.log_scale)(ts))


def hamiltonian_errors(h, t1):
    steps = round(t1 / h)
    _, _, exact = solve(DAMPED, HIGH, 10.0, t1, steps)
    ts, _, H = solve(DAMPED, LEAPFROG, 10.0, t1, steps)
    return ts, jnp.abs(H - exact)


def largest(ts, errors, start, end):
    return float(jnp.max(jnp.where((ts > start) & (ts <= end), errors, 0)))


def decay_rate(solver, h, t1=100.0):
    """The rate at which the energy of the damped oscillator decays."""
    _, (q, p), _ = solve(DAMPED, solver, 10.0, t1, round(t1 / h))
    energies = (q**2 + p**2) / 2
    return energies, -jnp.log(energies[-1] / 50) / t1


def main():
    options = parser(__doc__).parse_args()
    t1 = 80.0 if options.quick else 800.0
    hs = [0.1 / 2**k for k in range(3 if options.quick else 4)]
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    rows = []
    for system_name, hamiltonian in SYSTEMS.items():
        for name, solver in SCHEMES.items():
            runs = [scaled_error(hamiltonian, solver, h, 10.0) for h in hs]
            # Relative to the bound by f itself, so that all are far below one.
            unit = 0.5 * np.exp(hamiltonian.log_scale(jnp.array(10.0)))
            sizes = [largest(*run, 0, 10) / unit for run in runs]
            rows.append(
                (
                    f"{system_name}, {name}: error in f times exp(eta2), over [0, 10]",
                    f"of order {solver.order(None)}",
                    f"slope {slope(hs, sizes, 1e-12):.2f}",
                )
            )
    for (name, hamiltonian), end in zip(SYSTEMS.items(), (t1, t1, 40), strict=True):
        h = hs[1]
        ts, errors = scaled_error(hamiltonian, LEAPFROG, h, end)
        middle = end / 2
        rows.append(
            (
                f"{name}, leapfrog: error in f times exp(eta2) / h^2",
                "bounded, for exponentially long times",
                f"at most {largest(ts, errors, 0, 10) / h**2:.2g} on [0, 10], "
                f"{largest(ts, errors, 0, middle) / h**2:.2g} on [0, {middle:g}], "
                f"{largest(ts, errors, 0, end) / h**2:.2g} on [0, {end:g}]",
            )
        )
        window = round(2 / h)
        axes[0].loglog(
            envelope(ts, window), envelope(errors, window) / h**2, label=name
        )
    axes[0].loglog([20, t1], [1, t1 / 20], "k:", lw=0.8, label="proportional to time")
    axes[0].set(
        title=f"leapfrog, h = {hs[1]:g}",
        xlabel="time t",
        ylabel=r"error in f, times $e^{\eta_2} / h^2$",
        ylim=(1e-3, 1e6),
    )
    axes[0].legend(fontsize=8)

    ts, errors = hamiltonian_errors(0.02, t1)
    axes[1].loglog(envelope(ts, 100), envelope(errors, 100), label="leapfrog, h = 0.02")
    axes[1].loglog(
        [10, t1], [0.002, 0.0002 * t1], "k:", lw=0.8, label="proportional to time"
    )
    axes[1].set(
        title="damped, gamma = 0.2, q(0) = 10",
        xlabel="time t",
        ylabel="error in the Hamiltonian",
    )
    axes[1].legend(fontsize=8)
    rows.append(
        (
            "damped, leapfrog, h = 0.02: error in the Hamiltonian",
            "bounded, for exponentially long times",
            f"at most {largest(ts, errors, 0, 10):.2g} on [0, 10], "
            f"{largest(ts, errors, 0, t1 / 2):.2g} on [0, {t1 / 2:g}], "
            f"{largest(ts, errors, 0, t1):.2g} on [0, {t1:g}]",
        )
    )

    h = 0.1
    for name, solver in METHODS.items():
        energies, rate = decay_rate(solver, h)
        rows.append(
            (
                f"damped, {name}, h = {h}: rate of decay",
                KEPT.get(name, "not the continuous one"),
                f"{rate:.4f}",
            )
        )
        axes[2].semilogy(
            h * np.arange(1, len(energies) + 1),
            energies,
            label=f"{name}: {rate:.3f}",
            lw=1,
        )
    axes[2].set(
        title=f"damped, gamma = 0.2: decay at h = {h}",
        xlabel="time t",
        ylabel="energy",
    )
    axes[2].legend(fontsize=8)
    report("rates", fig, rows, options)


if __name__ == "__main__":
    main()
