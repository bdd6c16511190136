"""Learn the friction of an optimiser, by differentiating through all of its steps.

The optimiser is the heavy ball method on random quadratic functions, by two hundred
steps of the leapfrog. The friction is piecewise constant in time. The mean logarithm of
the final objective, relative to its initial value, is minimised by BFGS with gradients
from `FixedStepAdjoint`. The learned law is then compared, on new problems, with the
best constant friction and with Nesterov's, 3 / t.

    python examples/learn_damping.py [--quick] [--output learn_damping.png]
"""

import argparse
import pathlib

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

# The highest frequency is one; the leapfrog is stable up to steps of two.
STEP, T0 = 1.0, 1.0


class Pieces(eqx.Module):
    """A damping law whose rate is constant between knots."""

    knots: jax.Array
    logs: jax.Array

    def __call__(self, t):
        lengths = jnp.diff(self.knots)
        eta = jnp.cumsum(jnp.exp(self.logs) * lengths)
        return jnp.interp(t, self.knots, jnp.concatenate([jnp.zeros(1), eta]))


def problems(seed, number, dimension=30):
    """Log-uniform curvatures, and initial positions."""
    rng = np.random.default_rng(seed)
    least = 10.0 ** -rng.uniform(2, 4, size=(number, 1))
    curvatures = least ** rng.uniform(size=(number, dimension))
    return jnp.asarray(curvatures), jnp.asarray(rng.standard_normal(curvatures.shape))


def potential(t, q, curvatures):
    return jnp.sum(curvatures * q**2) / 2


def objectives(damping, batch, steps):
    """The logarithm of the relative objective, for every problem and time."""
    curvatures, q0 = batch
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)
    each = lambda q: jnp.log(jnp.sum(curvatures * q**2, axis=-1))
    sol = dfx.diffeqsolve(
        system,
        dps.PresymplecticLeapfrog(),
        t0=T0,
        t1=T0 + steps * STEP,
        dt0=STEP,
        # One state for all problems, as they have the same damping.
        y0=(q0, jnp.zeros_like(q0)),
        args=curvatures,
        saveat=dfx.SaveAt(t0=True, steps=True, fn=lambda t, y, args: each(y[0])),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=steps,
    )
    assert sol.ys is not None
    return sol.ys - sol.ys[0]


@eqx.filter_jit
def mean(damping, batch, steps):
    return jnp.mean(objectives(damping, batch, steps)[-1])


def learn(knots, start, batch, steps, most):
    """Optimise the rates between the knots, from a constant rate."""
    solution = optx.minimise(
        lambda logs, _: mean(Pieces(knots, logs), batch, steps),
        optx.BFGS(rtol=1e-4, atol=1e-4),
        jnp.full(len(knots) - 1, jnp.log(start)),
        options=dict(autodiff_mode="bwd"),
        max_steps=most,
        throw=False,
    )
    return Pieces(knots, solution.value)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run")
    parser.add_argument("--output", type=pathlib.Path, default="learn_damping.png")
    options = parser.parse_args()
    steps, number, most = (60, 20, 8) if options.quick else (200, 200, 100)

    seen, unseen = problems(0, number), problems(1, number)
    rates = np.geomspace(0.003, 1.0, 13 if options.quick else 41)
    constants = [mean(dps.ConstantDamping(rate), seen, steps) for rate in rates]
    best = rates[np.argmin(constants)]
    knots = T0 + jnp.linspace(0, steps * STEP, (6 if options.quick else 12) + 1)
    learned = learn(knots, best, seen, steps, most)

    laws = {
        f"constant, {best:.3f}": dps.ConstantDamping(best),
        "Nesterov, 3 / t": dps.LogDamping(3.0),
        "learned": learned,
    }
    print(f"Relative objective after {steps} steps, mean over {number} problems")
    print(f"{'friction':20}{'training':>12}{'test':>12}")
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    ts = T0 + STEP * np.arange(steps + 1)
    for name, law in laws.items():
        left_over = [np.exp(mean(law, batch, steps)) for batch in (seen, unseen)]
        print(f"{name:20}" + "".join(f"{x:>12.1e}" for x in left_over))
        curve = np.mean(objectives(law, unseen, steps), axis=1)
        left.semilogy(ts, np.exp(curve), label=name)
        # Between the steps, where every law is differentiable.
        middle = jnp.asarray(ts[:-1] + ts[1:]) / 2
        right.plot(middle, jax.vmap(jax.grad(law.__call__))(middle))
    left.set(xlabel="time", ylabel="relative objective", title="Test problems")
    right.set(xlabel="time", ylabel="rate of friction", yscale="log", title="Friction")
    left.legend()
    for ax in (left, right):
        ax.grid(alpha=0.3)
    fig.savefig(options.output, dpi=120)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
