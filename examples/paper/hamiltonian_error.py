"""The error in the Hamiltonian, over time and against the step size."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper._common import growth, parser, report
from examples.paper.exact_solutions import solve, SYSTEMS
from examples.schemes import hamiltonian_error, slope


SCHEMES = {
    "Euler": dps.PresymplecticEuler,
    "leapfrog": dps.PresymplecticLeapfrog,
    "Suzuki-Yoshida": lambda first: dps.SuzukiYoshida(
        4, dps.PresymplecticLeapfrog(first)
    ),
}


def error_over_time(hamiltonian, exact, q0, solver, steps):
    ts, _, H = solve(hamiltonian, solver, q0, 50.0, steps)
    q, p = exact(np.asarray(ts))
    return ts, jnp.abs(H - jax.vmap(hamiltonian.canonical)(ts, q, p))


def envelope(x, n):
    """Maxima over windows of `n` values, to remove oscillations from a plot."""
    return np.asarray(x)[: len(x) // n * n].reshape(-1, n).max(axis=1)


def main():
    options = parser(__doc__).parse_args()
    steps = 3_000 if options.quick else 30_000
    hs = [0.5 / 2**k for k in range(4 if options.quick else 8)]
    fig, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    rows = []
    for row, (name, (hamiltonian, exact, q0)) in zip(
        axes, SYSTEMS.items(), strict=True
    ):
        error = hamiltonian_error(hamiltonian, exact, q0, round(10 / hs[-1]))
        start = q0**2 / 2  # the initial value of the Hamiltonian
        for color, (scheme, solver_cls) in enumerate(SCHEMES.items()):
            for first, style in (("momentum", "-"), ("position", "--")):
                solver = solver_cls(first)
                look = dict(
                    color=f"C{color}", ls=style, label=f"{scheme}, {first} first"
                )
                ts, errors = error_over_time(hamiltonian, exact, q0, solver, steps)
                window = steps // 200
                row[0].semilogy(
                    envelope(ts, window), envelope(errors, window), lw=1, **look
                )
                sizes = [error(solver, h) for h in hs]
                row[1].loglog(hs, sizes, marker="o", ms=4, **look)
                r = solver.order(None)
                if first == "position":
                    row[1].loglog(
                        hs,
                        sizes[-1] * (np.array(hs) / hs[-1]) ** r,
                        "k:",
                        lw=0.8,
                        label="slopes 1, 2, 4" if r == 4 else None,
                    )
                rows.append(
                    (
                        f"{name}, {scheme}, {first} first",
                        f"bounded over [0, 50]; order {r}",
                        f"largest error {float(jnp.max(errors)):.1e}, "
                        f"{growth(ts, errors, 5, 50):.2g} times that on [0, 5]; "
                        f"slope {slope(hs, np.array(sizes) / start, 1e-12):.2f}",
                    )
                )
        row[0].set(
            title=f"{name}, {steps} steps",
            xlabel="time t",
            ylabel="error in the Hamiltonian",
        )
        row[1].set(
            title=f"{name}, over [0, 10]",
            xlabel="step size h",
            ylabel="largest error in the Hamiltonian",
        )
    axes[0, 1].legend(fontsize=8)
    report("hamiltonian_error", fig, rows, options)


if __name__ == "__main__":
    main()
