"""Masses, friction and springs of a chain, from noisy measurements of its motion.

Three masses hang in a row from a wall, on springs that harden. They are released from
rest at known places, and where they are is measured at a hundred times, with noise. All
parameters are found by least squares: BFGS with gradients from `ReversibleAdjoint`, on
a horizon that grows, since the whole of it at once has minima that are only local. The
curvature at the least squares tells how sure the estimates are, and how far into the
future they can be trusted. Measurements made anew, many times, tell whether that is so.

Positions cannot tell a chain from one of twice the masses on springs twice as strong.
So the first mass is given.

    python examples/identify.py [--quick] [--output identify.png]
"""

import argparse
import pathlib

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

STEP, DURATION, RELEASES, MEASURED = 0.1, 30.0, 4, 100
TRUTH = {
    "mass 2": 2.0,
    "mass 3": 0.5,
    "friction": 0.04,
    "spring 1": 1.0,
    "spring 2": 2.0,
    "spring 3": 1.5,
    "hardening 1": 1.0,
    "hardening 2": 0.5,
    "hardening 3": 2.0,
}
# Fitted are logarithms, so that parameters stay positive.
LOGS = np.log(list(TRUTH.values()))
GUESS = np.log([1.0, 1.0, 0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
# Of the time of the data: how much is fitted, first and last.
PARTS = (0.1, 0.3, 1.0)
# Predicted is at all of these times, and measured at some.
GRID = np.linspace(0, 3 * DURATION, 801)


def potential(t, q, args):
    spring, hardening = args
    stretch = jnp.diff(q, axis=-1, prepend=0.0)
    return jnp.sum(spring * stretch**2 / 2 + hardening * stretch**4 / 4)


def positions(logs, starts, ts, adjoint, step=STEP):
    """Where the masses are, after every release."""
    mass, friction, *springs = jnp.split(jnp.exp(logs), [2, 3, 6])
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(jnp.concatenate([jnp.ones(1), mass])[None]),
        potential,
        dps.ConstantDamping(friction[0]),
    )
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(hamiltonian),
        dps.BlanesMoanRKN4(),
        t0=0.0,
        t1=ts[-1],
        dt0=step,
        # One state for all: the releases share a friction, and so a frame.
        y0=(starts, jnp.zeros_like(starts)),
        args=springs,
        saveat=dfx.SaveAt(ts=ts, fn=lambda t, y, args: y[0]),
        adjoint=adjoint,
        max_steps=None,
    )
    assert sol.ys is not None
    return sol.ys


@jax.jit
def fit(logs, starts, ts, data, part):
    """The least squares of the first part of the data, from a guess."""
    seen = (ts <= part * DURATION)[:, None, None]

    def misfit(logs, _):
        miss = positions(logs, starts, ts, dps.ReversibleAdjoint()) - data
        return jnp.sum(jnp.where(seen, miss**2, 0)) / jnp.sum(seen)

    solution = optx.minimise(
        misfit,
        optx.BFGS(rtol=1e-8, atol=1e-8),
        logs,
        options=dict(autodiff_mode="bwd"),
        max_steps=200,
        throw=False,
    )
    return solution.value


@jax.jit
def predict(logs, starts, step):
    """Positions on the whole grid, and their derivatives by the parameters."""

    def twice(logs):
        q = positions(logs, starts, jnp.asarray(GRID), dfx.ForwardMode(), step)
        return q, q

    # More outputs than inputs: forward mode.
    jacobian, q = jax.jacfwd(twice, has_aux=True)(logs)
    return q, jacobian


def judge(logs, starts, seen, data):
    """What a fit leaves, how sure it is, what it predicts, and how sure that is."""
    q, jacobian = map(np.asarray, predict(logs, starts, STEP))
    left = np.sqrt(np.sum((q[seen] - data) ** 2) / (data.size - logs.size))
    used = np.reshape(jacobian[seen], (-1, logs.size))
    covariance = left**2 * np.linalg.inv(used.T @ used)
    spread = np.sqrt(np.einsum("...i,ij,...j", jacobian, covariance, jacobian))
    return left, np.sqrt(np.diag(covariance)), q, spread


def picture(path, fits, truth, seen):
    fig, (left, right) = plt.subplots(
        1, 2, figsize=(12, 4.4), width_ratios=(2, 1), layout="constrained"
    )
    # The last mass, after the first release.
    at = np.s_[:, 0, 2]
    noise, (data, _, _, _, q, spread) = next(iter(fits.items()))
    left.axvspan(0, DURATION, color="0.94", label="time of the data")
    left.plot(GRID[seen], data[at], "C3.", ms=5, label=f"data, noise {noise}")
    left.plot(GRID, truth[at], "k", lw=0.8, label="truth")
    band = (q[at] - 2 * spread[at], q[at] + 2 * spread[at])
    left.fill_between(GRID, *band, color="C0", alpha=0.5, label="prediction")
    left.set(xlabel="time", ylabel="place of mass 3", xlim=(0, GRID[-1]))
    left.set_title("Prediction, two standard errors to either side")
    left.legend(loc="lower right", ncols=4, fontsize="small")
    left.set_ylim(bottom=1.45 * np.min(truth[at]))
    for i, (noise, (_, logs, _, error, *_)) in enumerate(fits.items()):
        ratio, rows = np.exp(logs - LOGS), np.arange(len(TRUTH)) + 0.25 * i
        bars = dict(xerr=2 * error * ratio, fmt="o", ms=4, capsize=3)
        right.errorbar(ratio, rows, **bars, label=f"noise {noise}")
    right.axvline(1, color="k", lw=0.8)
    right.set_yticks(range(len(TRUTH)), list(TRUTH))
    right.invert_yaxis()
    right.set(xlabel="estimate / truth", title="Estimates, two standard errors")
    right.legend(fontsize="small")
    fig.savefig(path, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run")
    parser.add_argument("--output", type=pathlib.Path, default="identify.png")
    options = parser.parse_args()
    noises, repeats = ([0.1], 3) if options.quick else ([0.1, 0.03], 100)

    rng = np.random.default_rng(0)
    starts = rng.uniform(-1, 1, size=(RELEASES, 3))
    # Nature takes smaller steps.
    truth = np.asarray(predict(LOGS, starts, STEP / 5)[0])
    seen = np.sort(rng.choice(np.sum(GRID <= DURATION), MEASURED, replace=False))
    ts = GRID[seen]
    measure = lambda noise: truth[seen] + noise * rng.standard_normal(truth[seen].shape)

    print("What fits leave, in units of the noise: to all at once, on growing horizons")
    fits = {}
    for noise in noises:
        data = measure(noise)
        at_once = fit(GUESS, starts, ts, data, PARTS[-1])
        logs = GUESS
        for part in PARTS:
            logs = fit(logs, starts, ts, data, part)
        fits[noise] = data, np.asarray(logs), *judge(logs, starts, seen, data)
        left = judge(at_once, starts, seen, data)[0], fits[noise][2]
        print(f"{noise:<12}" + "".join(f"{x / noise:10.3f}" for x in left))

    print("\nEstimates, their standard errors, and by how many of these they are off")
    heads = "".join(f"{f'noise {x}':>12}{'error':>8}{'off by':>8}" for x in noises)
    print(f"{'':12}{'truth':>8}{heads}")
    for i, (name, true) in enumerate(TRUTH.items()):
        print(f"{name:12}{true:8.3f}", end="")
        for _, logs, _, error, *_ in fits.values():
            value, off = np.exp(logs[i]), (logs[i] - LOGS[i]) / error[i]
            print(f"{value:12.4f}{value * error[i]:8.4f}{off:8.1f}", end="")
        print()

    noise, off = noises[0], []
    for _ in range(repeats):
        data = measure(noise)
        logs = fit(fits[noise][1], starts, ts, data, PARTS[-1])
        off.append((logs - LOGS) / judge(logs, starts, seen, data)[1])
    off = np.abs(off)
    print(f"\nMeasured anew {repeats} times, with noise {noise}: off by", end=" ")
    print(f"{np.sqrt(np.mean(off**2)):.2f} standard errors in the mean square,")
    print(f"{np.mean(off < 1):.0%} within one, {np.mean(off < 2):.0%} within two")
    picture(options.output, fits, truth, seen)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
