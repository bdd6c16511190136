"""Random quadratic functions minimised by the leapfrog and by Nesterov's method."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tqdm

import diffrax_presym as dps
from examples.paper._common import Nesterov, parser, report
from examples.paper.phase_diagram import (
    largest_step,
    leapfrog,
    modes,
    nesterov,
    potential,
)


GAMMA = 0.7
METHODS = {
    "leapfrog": (dps.PresymplecticLeapfrog(), leapfrog, 0.9),
    "Nesterov": (Nesterov(), nesterov, 0.5),
}
# A has 0.8 n rows in the text, and n / 0.8 in the authors' published script.
SHAPES = {"n / 0.8 rows (script)": 1 / 0.8, "0.8 n rows (text)": 0.8}


HAMILTONIAN = dps.MechanicalSystem(
    dps.QuadraticKinetic(), potential, dps.ConstantDamping(GAMMA)
)


@eqx.filter_jit
def gradient_norms(solver, h, eigenvalues, q0, iterations):
    sol = dfx.diffeqsolve(
        HAMILTONIAN,
        solver,
        t0=0.0,
        t1=iterations * h,
        dt0=h,
        y0=(q0, jnp.zeros_like(q0)),
        args=eigenvalues,
        saveat=dfx.SaveAt(steps=True),
        max_steps=iterations,
    )
    assert sol.ys is not None
    return jnp.linalg.norm(eigenvalues * sol.ys[0], axis=1)


def main():
    options = parser(__doc__).parse_args()
    n, runs, iterations = (100, 5, 200) if options.quick else (1000, 50, 1000)
    fig, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    rows = []
    for ax, (shape, ratio) in zip(axes, SHAPES.items(), strict=True):
        norms = {name: [] for name in METHODS}
        limits = {name: [] for name in METHODS}
        for key in tqdm.tqdm(jax.random.split(jax.random.key(0), runs), desc=shape):
            eigenvalues, q0 = modes(key, round(ratio * n), n)
            for name, (solver, method, h) in METHODS.items():
                norms[name].append(
                    gradient_norms(solver, h, eigenvalues, q0, iterations)
                )
                limits[name].append(largest_step(method, GAMMA, eigenvalues[-1:]))
        for name, (_, _, h) in METHODS.items():
            curves = np.asarray(norms[name])
            mean, std = curves.mean(axis=0), curves.std(axis=0)
            steps = np.arange(1, iterations + 1)
            ax.semilogy(steps, mean, label=f"{name}, h = {h}")
            # The lower bound must be positive on a logarithmic scale.
            low = np.maximum(mean - std, mean / 10)
            ax.fill_between(steps, low, mean + std, alpha=0.3)
            reached = np.argmax(mean < 1e-3) + 1 if (mean < 1e-3).any() else None
            rows.append(
                (
                    f"{name}, h = {h}, {shape}",
                    "converges in all of 50 runs; the leapfrog is faster",
                    f"converges in {(curves[:, -1] < curves[:, 0] / 10).sum()} of "
                    f"{runs} runs; mean gradient {mean[-1]:.1e} ± {std[-1]:.0e} after "
                    f"{iterations} steps, 1e-3 after {reached}",
                )
            )
            rows.append(
                (
                    f"{name}, largest stable h, {shape}",
                    f"{h}, the largest that converged in all runs",
                    f"{min(limits[name]):.3f} in the worst run, "
                    f"{max(limits[name]):.3f} in the best",
                )
            )
        ax.set(title=f"A of {shape}", xlabel="iteration")
    axes[0].set_ylabel("norm of the gradient, mean and deviation")
    axes[0].legend()
    report("random_quadratic", fig, rows, options)


if __name__ == "__main__":
    main()
