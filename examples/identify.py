"""Identify masses, friction and springs of a chain from noisy measurements.

Three masses are attached in a row to a wall, by hardening springs. They are released
from rest at known positions, and their positions are measured at a hundred times, with
noise. All parameters are estimated by least squares: BFGS with gradients from
`FixedStepAdjoint`, on a growing time horizon, since a fit to all data at once ends in
a local minimum. The curvature at the minimum gives the standard errors of the estimates
and of the predictions, which are confirmed by repetitions with new noise.

A chain with twice the masses and springs twice as stiff has the same positions. So the
first mass is given.

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
# Logarithms are fitted, so that the parameters stay positive.
LOGS = np.log(list(TRUTH.values()))
GUESS = np.log([1.0, 1.0, 0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
# Fractions of the time interval of the data that are fitted in turn.
PARTS = (0.1, 0.3, 1.0)
# Predictions are made at all of these times, and measurements at some.
GRID = np.linspace(0, 3 * DURATION, 801)


def potential(t, q, args):
    spring, hardening = args
    stretch = jnp.diff(q, axis=-1, prepend=0.0)
    return jnp.sum(spring * stretch**2 / 2 + hardening * stretch**4 / 4)


def positions(logs, starts, ts, adjoint, step=STEP):
    """The positions of the masses, for every release."""
    mass, friction, *springs = jnp.split(jnp.exp(logs), [2, 3, 6])
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(jnp.concatenate([jnp.ones(1), mass])[None]),
        potential,
        dps.ConstantDamping(friction[0]),
    )
    sol = dfx.diffeqsolve(
        system,
        dps.BlanesMoanRKN4(),
        t0=0.0,
        t1=ts[-1],
        dt0=step,
        # One state for all releases, as they have the same damping.
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
    """The least squares fit to the first part of the data, from an initial guess."""
    seen = (ts <= part * DURATION)[:, None, None]

    def misfit(logs, _):
        miss = positions(logs, starts, ts, dps.FixedStepAdjoint()) - data
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
    """Positions on the whole grid, and their derivatives in the parameters."""
    forward = dps.FixedStepAdjoint("forward")

    def twice(logs):
        q = positions(logs, starts, jnp.asarray(GRID), forward, step)
        return q, q

    # Forward mode, as there are more outputs than inputs.
    jacobian, q = jax.jacfwd(twice, has_aux=True)(logs)
    return q, jacobian


def judge(logs, starts, seen, data):
    """The residual of a fit, and its estimates and predictions with standard errors."""
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
    # The last mass, for the first release.
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
    # The data are computed with smaller steps.
    truth = np.asarray(predict(LOGS, starts, STEP / 5)[0])
    seen = np.sort(rng.choice(np.sum(GRID <= DURATION), MEASURED, replace=False))
    ts = GRID[seen]
    measure = lambda noise: truth[seen] + noise * rng.standard_normal(truth[seen].shape)

    print("Residuals of the fits, in units of the noise: ", end="")
    print("all data at once, growing horizons")
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

    print("\nEstimates, their standard errors and z-scores")
    heads = "".join(f"{f'noise {x}':>12}{'error':>8}{'z-score':>8}" for x in noises)
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
    print(f"\n{repeats} repetitions with noise {noise}: root mean square ", end="")
    print(f"z-score {np.sqrt(np.mean(off**2)):.2f},")
    one, two = np.mean(off < 1), np.mean(off < 2)
    print(f"{one:.0%} within one standard error, {two:.0%} within two")
    picture(options.output, fits, truth, seen)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
