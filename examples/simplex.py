"""Minimisation over the probability simplex without projections.

The weights of a mixture are fitted to data by maximum likelihood. Bregman dynamics with
the entropic mirror map stays in the simplex, to rounding; without a mirror map it does
not. Prints a table and saves one figure. `--quick` runs a smaller version.
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

ENTROPIC = dps.EntropyMirror(simplex=True)


def mixture(components, samples):
    """The likelihoods of samples of a mixture under each of its components."""
    random = np.random.default_rng(1)
    centers = np.linspace(-2, 2, components)
    # Half of the components have no samples, so the optimum is on the boundary.
    weights = random.dirichlet(np.ones(components)) * (np.arange(components) % 2 == 0)
    chosen = random.choice(components, samples, p=weights / weights.sum())
    x = centers[chosen] + 0.7 * random.normal(size=samples)
    return jnp.array(np.exp(-((x[:, None] - centers) ** 2) / 2 / 0.7**2))


def surprise(t, q, args):
    return -jnp.mean(jnp.log(args @ q))


@jax.jit
def mirror_descent(likelihoods, rate, steps):
    """Exponentiated gradient, for comparison: one gradient per step."""

    def update(_, q):
        return jax.nn.softmax(
            jnp.log(q) - rate * jax.grad(surprise, 1)(0.0, q, likelihoods)
        )

    n = likelihoods.shape[1]
    return jax.lax.fori_loop(0, steps, update, jnp.full(n, 1 / n))


def descend(mirror_map, likelihoods, q0, h, steps):
    """Positions along Bregman dynamics, one gradient per step."""
    hamiltonian = dps.BregmanHamiltonian(
        mirror_map, surprise, dps.PolynomialScaling(2.0, 0.25)
    )
    sol = dfx.diffeqsolve(
        hamiltonian,
        dps.Strang(),
        t0=h,
        t1=h * (steps + 1),
        dt0=h,
        y0=(q0, jnp.zeros_like(q0)),
        args=likelihoods,
        saveat=dfx.SaveAt(t0=True, steps=True, fn=lambda t, y, args: y[0]),
        max_steps=steps + 1,
        throw=False,
    )
    q = np.asarray(sol.ys)
    return q[np.all(np.isfinite(q), axis=1)]


def corners(n=3):
    angles = np.pi / 2 + 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(angles), np.sin(angles)], 1)


def picture(path, gaps, triangle, paths):
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for name, gap in gaps.items():
        axes[0].loglog(np.arange(1, len(gap) + 1), gap, label=name)
    axes[0].set(
        title="maximum likelihood over the simplex",
        xlabel="gradients",
        ylabel="f − f*",
        ylim=(1e-9, None),
    )
    axes[0].grid(alpha=0.3)
    axes[0].legend()
    edges = corners()
    grid = np.random.default_rng(0).dirichlet(np.ones(3), 20_000)
    levels = np.array(jax.vmap(lambda q: surprise(0.0, q, triangle))(jnp.array(grid)))
    axes[1].tricontourf(*(grid @ edges).T, levels, 20, cmap="Greys", alpha=0.5)
    axes[1].plot(*edges[[0, 1, 2, 0]].T, "k", lw=1)
    for i, path_ in enumerate(paths):
        axes[1].plot(*(path_ @ edges).T, lw=1.5, color=f"C{i}")
        axes[1].plot(*(path_[0] @ edges).T, "o", color=f"C{i}", ms=5)
    axes[1].set(title="paths on a simplex of three, from the dots", aspect="equal")
    axes[1].axis("off")
    fig.savefig(path, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="simplex.png")
    options = parser.parse_args()
    components, steps = (20, 300) if options.quick else (50, 3000)
    likelihoods = mixture(components, 500)
    uniform = jnp.full(components, 1 / components)
    # The minimum, from a long run.
    final = descend(ENTROPIC, likelihoods, uniform, 0.5, 20 * steps)[-1]
    least = surprise(0.0, jnp.array(final), likelihoods)
    value = jax.jit(jax.vmap(lambda q: surprise(0.0, q, likelihoods)))
    runs = {
        "entropic mirror, Strang": descend(ENTROPIC, likelihoods, uniform, 0.5, steps),
        "no mirror, Strang": descend(
            dps.EuclideanMirror(), likelihoods, uniform, 0.05, steps
        ),
    }
    gaps = {name: np.asarray(value(q) - least) for name, q in runs.items()}
    counts = np.unique(np.geomspace(1, steps, 60).astype(int))
    descent = [mirror_descent(likelihoods, 1.0, k) for k in counts]
    descent_gap = np.asarray(value(jnp.stack(descent)) - least)
    print(f"Weights of {components} components, {steps} gradients: f - f* at the end,")
    print("and the smallest weight and the largest |sum - 1| along the solution\n")
    for name, q in runs.items():
        off = np.max(np.abs(q.sum(1) - 1))
        gap = f"{gaps[name][-1]:.1e}" if off < 1e-6 else "left"
        print(f"{name:28}{gap:>10}{q.min():>12.1e}{off:>12.1e}")
    print(f"{'mirror descent':28}{descent_gap[-1]:>10.1e}")
    triangle = mixture(3, 100)
    starts = np.random.default_rng(4).dirichlet(np.ones(3), 5)
    paths = [descend(ENTROPIC, triangle, jnp.array(q), 0.25, 200) for q in starts]
    inside = all(np.all(q > 0) for q in paths)
    print(f"\nPaths on the simplex of three stay inside: {inside}")
    gaps = {"Bregman dynamics, entropic, Strang": gaps["entropic mirror, Strang"]}
    gaps["mirror descent"] = np.interp(np.arange(1, steps + 1), counts, descent_gap)
    picture(options.output, gaps, triangle, paths)
    print(f"\nFigure saved to {options.output}")


if __name__ == "__main__":
    main()
