"""Learn the potential and the friction of a system, and extrapolate in time.

The data are short, noisy trajectories of two coupled pendulums with friction. A neural
network for the potential and a friction coefficient are trained through the solver,
with gradients from `FixedStepAdjoint`. For comparison, a plain neural ODE, with about
as many parameters, learns the whole vector field, solved by Tsit5. Both are then
integrated from new initial states, for twenty times the training time. The energy of
the structured model decays by construction.

    python examples/learn_energy.py [--quick] [--output learn_energy.png]
"""

import argparse
import pathlib

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import diffrax_presym as dps


FRICTION, NOISE = 0.05, 0.02
TRAINED, FOLLOWED, STEP = 4.0, 80.0, 0.1


def pendulums(t, q, args):
    """The sum of the potentials of a batch, of shape (trajectory, pendulum)."""
    apart = q[:, 0] - q[:, 1]
    return jnp.sum(1 - jnp.cos(q)) + jnp.sum(apart**2) / 4


class Structured(eqx.Module):
    """A learned potential and a learned friction coefficient."""

    potential: eqx.nn.MLP
    log_friction: jax.Array

    def __init__(self, key):
        self.potential = eqx.nn.MLP(2, "scalar", 32, 2, jnp.tanh, key=key)
        self.log_friction = jnp.log(0.3)

    def __call__(self, y0, ts):
        potential = lambda t, q, args: jnp.sum(jax.vmap(self.potential)(q))
        return mechanical(potential, jnp.exp(self.log_friction), y0, ts)


class Plain(eqx.Module):
    """A learned vector field."""

    field: eqx.nn.MLP

    def __init__(self, key):
        self.field = eqx.nn.MLP(4, 4, 30, 2, jnp.tanh, key=key)

    def __call__(self, y0, ts):
        field = lambda t, y, args: jax.vmap(self.field)(y)
        y0 = jnp.concatenate(y0, axis=1)
        adjoint = dfx.RecursiveCheckpointAdjoint()
        ys = solve(dfx.ODETerm(field), dfx.Tsit5(), adjoint, y0, ts)
        return jnp.split(ys, 2, axis=-1)


def mechanical(potential, friction, y0, ts):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(friction)
    )
    solver, adjoint = dps.PresymplecticLeapfrog(), dps.FixedStepAdjoint()
    return solve(system, solver, adjoint, y0, ts)


def solve(term, solver, adjoint, y0, ts):
    sol = dfx.diffeqsolve(
        term,
        solver,
        t0=0.0,
        t1=ts[-1],
        dt0=STEP,
        y0=y0,
        saveat=dfx.SaveAt(ts=ts),
        adjoint=adjoint,
        # With a margin, since rounding may add a step.
        max_steps=2 * round(FOLLOWED / STEP),
    )
    assert sol.ys is not None
    return sol.ys


def starts(key, number):
    q0 = jax.random.uniform(key, (number, 2), minval=-2.0, maxval=2.0)
    return q0, jnp.zeros_like(q0)


@eqx.filter_value_and_grad
def loss(model, y0, ts, data):
    errors = [jnp.mean((a - b) ** 2) for a, b in zip(model(y0, ts), data, strict=True)]
    return sum(errors, jnp.zeros(()))


def train(model, y0, ts, data, steps):
    optimiser = optax.adam(optax.cosine_decay_schedule(0.02, steps))
    state = optimiser.init(eqx.filter(model, eqx.is_inexact_array))

    @eqx.filter_jit
    def update(model, state):
        value, gradient = loss(model, y0, ts, data)
        change, state = optimiser.update(gradient, state)
        return eqx.apply_updates(model, change), state, value

    for step in range(steps):
        model, state, value = update(model, state)
        if (step + 1) % (steps // 4) == 0:
            print(f"  step {step + 1:5}: loss {float(value):.2e}", flush=True)
    return model


def energy(ys):
    """Exact energies, of shape (time, trajectory)."""
    q, p = ys
    each = jax.vmap(lambda q, p: jnp.sum(p**2) / 2 + pendulums(0.0, q[None], None))
    return np.asarray(jax.vmap(each)(q, p))


def rms(ys, exact, times):
    pairs = zip(ys, exact, strict=True)
    return float(np.sqrt(np.mean([(a[:times] - b[:times]) ** 2 for a, b in pairs])))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run")
    parser.add_argument("--output", type=pathlib.Path, default="learn_energy.png")
    options = parser.parse_args()
    steps = 20 if options.quick else 2000
    keys = jax.random.split(jax.random.key(0), 5)

    ts = jnp.linspace(0.0, TRAINED, 21)
    y0 = starts(keys[0], 16)
    noise = lambda key, x: x + NOISE * jax.random.normal(key, x.shape)
    seen = mechanical(pendulums, FRICTION, y0, ts)
    data = [noise(key, x) for key, x in zip(keys[1:3], seen, strict=True)]
    models = {"structured": Structured(keys[3]), "plain": Plain(keys[3])}
    for name, model in models.items():
        numbers = sum(x.size for x in jax.tree.leaves(eqx.filter(model, eqx.is_array)))
        print(f"{name}, {numbers} parameters")
        models[name] = train(model, y0, ts, data, steps)

    ts = jnp.linspace(0.0, FOLLOWED, 801)
    y0 = starts(keys[4], 100)
    exact = mechanical(pendulums, FRICTION, y0, ts)
    curves = {"exact": exact} | {name: model(y0, ts) for name, model in models.items()}
    short = int(np.sum(np.asarray(ts) <= TRAINED))
    friction = float(jnp.exp(models["structured"].log_friction))
    print(f"\nfriction {friction:.4f}, exact {FRICTION}; 100 new initial states:")
    # The sum of all increases of the energy between two times, and the final energy.
    columns = ("error to t = 4", "error to t = 80", "energy increase", "energy at 80")
    print(f"{'':12}" + "".join(f"{x:>18}" for x in columns))
    for name, ys in curves.items():
        rises = np.maximum(np.diff(energy(ys), axis=0), 0).sum(axis=0)
        row = rms(ys, exact, short), rms(ys, exact, len(ts)), rises.mean()
        print(
            f"{name:12}" + "".join(f"{x:>18.1e}" for x in (*row, energy(ys)[-1].mean()))
        )

    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    styles = {"exact": "k-", "structured": "C0--", "plain": "C1:"}
    for name, ys in curves.items():
        left.plot(ts, ys[0][:, 0, 0], styles[name], label=name)
        right.semilogy(ts, np.mean(energy(ys), axis=1), styles[name], label=name)
    left.set(xlabel="time", ylabel="angle", title="One pendulum, from an unseen start")
    right.set(xlabel="time", ylabel="energy", title="Mean energy of 100 unseen starts")
    for ax in (left, right):
        ax.axvspan(0, TRAINED, color="0.9", label="trained")
        ax.grid(alpha=0.3)
        ax.margins(x=0)
    right.legend()
    fig.savefig(options.output, dpi=120)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
