"""Restricted Boltzmann machines that learn the Ising model.

Gradients by contrastive divergence are stochastic: a force whose random key depends on
the step. Gradient descent is Euler's method, and the presymplectic optimisers are
solvers of this package. Each evaluates one gradient per step. All temperatures are
batched.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper import _ising as ising
from examples.paper._common import parser, report


SIZE, HIDDEN, BATCH = 8, 400, 100
SHOWN = 14  # index of the temperature at which the paper shows the loss: T = 2.83


class Data(eqx.Module):
    """Spins 0 and 1, of shape (temperature, batch, sample, spin); and the step size.

    Time is measured in steps, which are added without rounding in single precision. So
    `h` is a factor of velocity and force.
    """

    batches: jax.Array
    key: jax.Array
    h: float


def initial(key, temperatures):
    """Initial parameters as in the authors' script, for each temperature."""
    keys = jax.random.split(key, 3)
    normal = lambda key, *shape: jax.random.normal(
        key, (temperatures, *shape), jnp.float32
    )
    return {
        "weights": 0.1 * normal(keys[0], SIZE**2, HIDDEN),
        "visible": 0.5 + 0.5 * normal(keys[1], SIZE**2),
        "hidden": 0.5 + 0.5 * normal(keys[2], HIDDEN),
    }


def to_hidden(q, visible):
    return jax.nn.sigmoid(visible @ q["weights"] + q["hidden"])


def to_visible(q, hidden):
    return jax.nn.sigmoid(hidden @ q["weights"].T + q["visible"])


def draw(uniform, probability):
    return (uniform < probability).astype(probability.dtype)


def gibbs(q, visible, uniform):
    """One Gibbs step; `uniform` contains one random number for each spin."""
    hidden = draw(uniform[:, SIZE**2 :], to_hidden(q, visible))
    return draw(uniform[:, : SIZE**2], to_visible(q, hidden))


def uniforms(key, visible):
    return jax.random.uniform(key, (*visible.shape[:-1], SIZE**2 + HIDDEN), jnp.float32)


def ascent(q, visible, uniform):
    """Minus the gradient by one step of contrastive divergence, summed over a batch."""
    again = gibbs(q, visible, uniform)
    hidden, hidden_again = to_hidden(q, visible), to_hidden(q, again)
    return {
        "weights": visible.T @ hidden - again.T @ hidden_again,
        "visible": jnp.sum(visible - again, axis=0),
        "hidden": jnp.sum(hidden - hidden_again, axis=0),
    }


def force(t, q, data):
    step = jnp.floor(t).astype(int)  # from its start or its middle
    batch = data.batches[:, step % data.batches.shape[1]]
    uniform = uniforms(jax.random.fold_in(data.key, step), batch)
    return jax.tree.map(lambda x: data.h * x, jax.vmap(ascent)(q, batch, uniform))


def classical(t, p, data):
    return data.h * sum(jnp.sum(p**2) for p in jax.tree.leaves(p)) / 2


def relativistic(t, p, data):
    """Equation (rel_ham), c = 5 and m = 1, for weights and biases separately."""
    c = 5.0
    each = [
        jnp.sqrt(jnp.sum(p**2, axis=tuple(range(1, p.ndim))) + c**2)
        for p in jax.tree.leaves(p)
    ]
    return data.h * c * sum(map(jnp.sum, each))


def loss(t, q, data):
    """Mean squared reconstruction error of a batch, as in the authors' script."""
    batch = data.batches[:, 0]
    uniform = uniforms(jax.random.fold_in(data.key, t.astype(int)), batch)
    again = jax.vmap(gibbs)(q, batch, uniform)
    return jnp.mean((batch - again) ** 2, axis=(1, 2))


def presymplectic(kinetic, mu):
    damping = dps.ConstantDamping(-2 * np.log(mu))  # mu is the factor of half a step
    return dps.MechanicalSystem(kinetic, dps.ForceField(force), damping)


METHODS = {
    "gradient descent": (dfx.ODETerm(force), dfx.Euler(), 5e-3),
    "leapfrog": (
        presymplectic(classical, 0.98),
        dps.PresymplecticLeapfrog(),
        2.5e-2,
    ),
    "relativistic leapfrog": (
        presymplectic(relativistic, 0.99),
        dps.PresymplecticLeapfrog("position"),
        2.8e-2,
    ),
}


@eqx.filter_jit
def train(term, solver, q0, data, epochs, every):
    """The losses after each `every` epochs, and the trained machines."""
    y0 = q0
    if isinstance(term, dps.MechanicalSystem):
        y0 = (q0, jax.tree.map(jnp.zeros_like, q0))
    position = lambda y: y[0] if isinstance(y, tuple) else y
    steps = epochs * data.batches.shape[1]
    each = every * data.batches.shape[1]
    sol = dfx.diffeqsolve(
        term,
        solver,
        t0=jnp.float32(0),
        t1=jnp.float32(steps),
        dt0=jnp.float32(1),
        y0=y0,
        args=data,
        max_steps=steps,
        saveat=dfx.SaveAt(
            subs=(
                dfx.SubSaveAt(
                    steps=each, fn=lambda t, y, args: loss(t, position(y), args)
                ),
                dfx.SubSaveAt(t1=True, fn=lambda t, y, args: position(y)),
            )
        ),
        adjoint=dfx.ForwardMode(),
        progress_meter=dfx.TqdmProgressMeter(refresh_steps=each),
    )
    assert sol.ys is not None
    losses, q = sol.ys
    return losses, jax.tree.map(lambda x: x[-1], q)


@eqx.filter_jit
def model_energies(key, q, visible, steps):
    """Energies of samples of a machine, from the second half of a Markov chain."""

    def step(visible, key):
        visible = jax.vmap(gibbs)(q, visible, uniforms(key, visible))
        return visible, lattice_energy(visible)

    _, energies = jax.lax.scan(step, visible, jax.random.split(key, steps))
    return jnp.concatenate(energies[steps // 2 :: 10], axis=1)


@eqx.filter_jit
def reconstructed_energies(key, q, visible):
    """Energies as in the authors' script: of rounded reconstructions of the data."""
    uniform = uniforms(key, visible).at[..., : SIZE**2].set(0.5)
    return lattice_energy(jax.vmap(gibbs)(q, visible, uniform))


def lattice_energy(visible):
    return ising.energy(2 * visible.reshape(*visible.shape[:-1], SIZE, SIZE) - 1)


def take(tree, those):
    return jax.tree.map(lambda x: x[those], tree)


def reached(losses, level, every):
    below = np.flatnonzero(np.asarray(losses) <= level)
    return f"after {(below[0] + 1) * every} iterations" if len(below) else "never"


def main():
    arguments = parser(__doc__)
    arguments.add_argument(
        "--every", type=int, default=1, help="only every n-th of the temperatures"
    )
    options = arguments.parse_args()
    quick = options.quick
    stride = 8 if quick else options.every
    # Those of the paper, always including the one whose loss it shows.
    temperatures = jnp.linspace(0.5, 4.5, 25)[SHOWN % stride :: stride]
    chains, samples, burn_in = (50, 20, 100) if quick else (500, 200, 512)
    training, epochs, every = (200, 40, 10) if quick else (2000, 2000, 10)
    keys = jax.random.split(jax.random.key(0), 6)
    per_temperature = jax.vmap(ising.estimates, in_axes=(0, 0, None))

    spins = ising.metropolis(keys[0], temperatures, SIZE, chains, samples, burn_in)
    chosen = jax.random.choice(keys[1], spins.shape[1], (training,), replace=False)
    visible = (spins[:, chosen].reshape(-1, training, SIZE**2) > 0).astype(jnp.float32)
    batches = visible.reshape(-1, training // BATCH, BATCH, SIZE**2)
    exact = jax.vmap(ising.exact, in_axes=(0, None))(temperatures, SIZE)
    observed = {
        "Metropolis": per_temperature(ising.energy(spins), temperatures, SIZE),
        "training data": per_temperature(
            ising.energy(spins[:, chosen]), temperatures, SIZE
        ),
    }

    shown = SHOWN // stride
    q0 = initial(keys[2], len(temperatures))
    losses = {}
    for name, (term, solver, h) in METHODS.items():
        # The paper shows the relativistic method at one temperature only.
        those = slice(shown, shown + 1) if name.startswith("rel") else slice(None)
        print(f"{name}, {len(temperatures[those])} temperatures")
        data = Data(batches[those], keys[3], h)
        curve, q = train(term, solver, take(q0, those), data, epochs, every)
        losses[name] = np.asarray(curve[:, shown if those == slice(None) else 0])
        if those == slice(None):
            drawn = model_energies(keys[4], q, visible[:, :1000], 40 if quick else 400)
            observed[f"{name}, samples"] = per_temperature(drawn, temperatures, SIZE)
            again = reconstructed_energies(keys[5], q, visible)
            observed[f"{name}, reconstructions"] = per_temperature(
                again, temperatures, SIZE
            )

    rows = [
        ("critical temperature", "2.27", f"{ising.CRITICAL_TEMPERATURE:.4f}"),
        (
            "setup",
            "25 temperatures, 1e5 lattices each, 2000 of them for training, 2000 "
            "iterations",
            f"{len(temperatures)} temperatures, {spins.shape[1]} lattices each, "
            f"{training} of them for training, {epochs} iterations of "
            f"{training // BATCH} steps",
        ),
    ]
    for name, curve in losses.items():
        says = "the slowest" if name == "gradient descent" else "faster"
        says = "the fastest" if name.startswith("rel") else says
        # An average, as single values are noisy.
        final = curve[-max(1, len(curve) // 10) :].mean()
        best = losses["gradient descent"][-max(1, len(curve) // 10) :].mean()
        rows.append(
            (
                f"{name}: loss at T = {temperatures[shown]:.2f}",
                says,
                f"{curve[0]:.3f} after {every} iterations, {final:.3f} at the end; "
                "reaches the final loss of gradient descent "
                f"{reached(curve, best, every)}",
            )
        )
    for name, (energies, heat_capacities) in observed.items():
        errors = [
            float(jnp.sqrt(jnp.mean((x - y) ** 2)))
            for x, y in zip((energies, heat_capacities), exact, strict=True)
        ]
        rows.append(
            (
                f"{name}: errors in energy and heat capacity per spin",
                SAYS.get(name, "not shown"),
                "{:.4f} and {:.4f}, root mean square over temperatures".format(*errors),
            )
        )
    fig = picture(temperatures, observed, losses, every, temperatures[shown])
    report("boltzmann_machine", fig, rows, options)


SAYS = {
    "gradient descent, reconstructions": "near Monte Carlo",
    "leapfrog, reconstructions": "nearer Monte Carlo than gradient descent",
}


def picture(temperatures, observed, losses, every, shown):
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    fine = jnp.linspace(0.5, 4.5, 201)
    curves = jax.vmap(ising.exact, in_axes=(0, None))(fine, SIZE)
    looks = {
        "Metropolis": dict(color="k", marker="+", ls=""),
        "gradient descent, reconstructions": dict(color="C1", marker="s", ls=""),
        "leapfrog, reconstructions": dict(color="C0", marker="o", ls=""),
        "gradient descent, samples": dict(color="C1", ls=":"),
        "leapfrog, samples": dict(color="C0", ls="--"),
    }
    for ax, i, label in zip(axes, (0, 1), ("energy", "heat capacity"), strict=False):
        ax.plot(fine, curves[i], color="0.6", label="exact (Kaufman)")
        for name, look in looks.items():
            look = dict(ms=5, mfc="none", label=name) | look
            ax.plot(temperatures, observed[name][i], **look)
        ax.axvline(ising.CRITICAL_TEMPERATURE, color="0.8", lw=0.8)
        ax.set(xlabel="temperature T", ylabel=f"{label} per spin")
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, fontsize=8, ncols=6, loc="outside lower left")
    for name, curve in losses.items():
        axes[2].semilogy(every * np.arange(1, len(curve) + 1), curve, label=name)
    axes[2].set(
        title=f"T = {shown:.2f}",
        xlabel="iteration (a pass over the data)",
        ylabel="reconstruction error",
    )
    axes[2].legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main()
