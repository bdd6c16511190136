"""Growth of the error in the Hamiltonian with Nesterov's method."""

import jax.numpy as jnp
import matplotlib.pyplot as plt

import diffrax_presym as dps
from examples.paper._common import growth, Nesterov, parser, report
from examples.paper.exact_solutions import HIGH, solve
from examples.paper.hamiltonian_error import envelope
from examples.schemes import harmonic, system


METHODS = {
    "Nesterov": Nesterov(),
    "presymplectic Euler": dps.PresymplecticEuler(),
    "presymplectic leapfrog": dps.PresymplecticLeapfrog(),
}


def error_over_time(gamma, solver, steps):
    """The error in H of the paper's damped oscillator, against order eight."""
    hamiltonian = system(harmonic, dps.ConstantDamping(gamma))
    ts, _, H = solve(hamiltonian, solver, 10.0, 50.0, steps)
    _, _, exact = solve(hamiltonian, HIGH, 10.0, 50.0, steps)
    return ts, jnp.abs(H - exact)


def main():
    options = parser(__doc__).parse_args()
    steps = 3_000 if options.quick else 30_000
    fig, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    rows = []
    for ax, gamma in zip(axes, (0.2, -1.0), strict=True):
        for name, solver in METHODS.items():
            ts, errors = error_over_time(gamma, solver, steps)
            window = steps // 200
            ax.semilogy(envelope(ts, window), envelope(errors, window), label=name)
            late = float(jnp.max(errors[ts > 45]))
            grown = growth(ts, errors, 5, 50)
            rows.append(
                (
                    f"gamma = {gamma}, {name}",
                    "grows without bound" if name == "Nesterov" else "bounded",
                    f"{late:.1e} at the end, {grown:.2g} times that on [0, 5]",
                )
            )
        ax.set(
            title=f"gamma = {gamma}, h = {50 / steps:.2g}",
            xlabel="time t",
            ylabel="error in the Hamiltonian",
        )
    axes[1].legend()
    report("nesterov", fig, rows, options)


if __name__ == "__main__":
    main()
