"""The two oscillators with exact solutions, and their Hamiltonians."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper._common import parser, report
from examples.schemes import (
    DAMPED,
    damped_exact,
    DECAYING,
    decaying_exact,
)


SYSTEMS = {
    "damped oscillator": (DAMPED, damped_exact, 10.0),
    "decaying oscillator": (DECAYING, decaying_exact, 1.0),
}
HIGH = dps.BlanesCasasRKN8()


def solve(hamiltonian, solver, q0, t1, steps):
    """Times, states and values of the Hamiltonian at `steps` equal steps."""
    sol = dfx.diffeqsolve(
        hamiltonian,
        solver,
        t0=0.0,
        t1=t1,
        dt0=t1 / steps,
        y0=(jnp.array(q0), jnp.array(0.0)),
        saveat=dfx.SaveAt(steps=True),
        max_steps=steps,
    )
    assert sol.ts is not None and sol.ys is not None
    return sol.ts, sol.ys, jax.vmap(hamiltonian.canonical)(sol.ts, *sol.ys)


def defect(hamiltonian, exact, q0):
    """The difference of the exact solution to a scheme of order eight."""
    ts, (q, p), _ = solve(hamiltonian, HIGH, q0, 50.0, 1000)
    q_exact, p_exact = exact(np.asarray(ts))
    return max(np.max(np.abs(q - q_exact)), np.max(np.abs(p - p_exact)))


def main():
    options = parser(__doc__).parse_args()
    fig, axes = plt.subplots(2, 3, figsize=(11, 5.5), layout="constrained")
    ts = jnp.linspace(0, 50, 2001)
    rows = []
    for row, (name, (hamiltonian, exact, q0)) in zip(
        axes, SYSTEMS.items(), strict=True
    ):
        q, p = exact(np.asarray(ts))
        # The paper shows the canonical momentum, which grows as the motion decays.
        P = jax.vmap(hamiltonian.to_canonical)(ts, p)
        H = np.asarray(jax.vmap(hamiltonian.canonical)(ts, q, p))
        for ax, curve, label in zip(
            row,
            (q, P, H),
            ("position q", "canonical momentum", "Hamiltonian H"),
            strict=True,
        ):
            ax.plot(ts, curve, lw=1)
            ax.set(xlabel="time t", ylabel=label)
        row[1].set_title(name)
        rows.append(
            (
                f"{name}: exact solution",
                "exact",
                f"order 8 with h = 0.05 agrees to {defect(hamiltonian, exact, q0):.0e}"
                " over [0, 50]",
            )
        )
        early, late = ts <= 10, ts >= 40
        says = {
            "damped oscillator": "varies with time, is not conserved",
            "decaying oscillator": "oscillates and grows very fast with t",
        }[name]
        rows.append(
            (
                f"{name}: the Hamiltonian",
                says,
                f"between {H[early].min():.3g} and {H[early].max():.3g} on [0, 10], "
                f"{H[late].min():.3g} and {H[late].max():.3g} on [40, 50]; "
                f"the momentum grows from {np.abs(P[early]).max():.3g} to "
                f"{np.abs(P[late]).max():.3g}",
            )
        )
    report("exact_solutions", fig, rows, options)


if __name__ == "__main__":
    main()
