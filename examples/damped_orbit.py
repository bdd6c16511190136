"""The energy of a damped orbit over hundreds of periods, at equal cost.

Prints the error of the energy of Diffrax's `Tsit5` and `Dopri8`, and of `TunedRKN6`
with fewer evaluations of the force, and saves a figure. `--quick` runs fewer periods.
"""

import argparse
import math
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

PERIOD, ECCENTRICITY = 2 * math.pi, 0.3
SPEED = math.sqrt((1 - ECCENTRICITY) / (1 + ECCENTRICITY))
APOCENTRE = jnp.array([1 + ECCENTRICITY, 0.0]), jnp.array([0.0, SPEED])
# A solver, its step or tolerance, and the evaluations of its step.
SOLVES = {
    "Tsit5": (dfx.Tsit5(), None, 1e-4, 6),
    "Dopri8": (dfx.Dopri8(), None, 1e-4, 13),
    "TunedRKN6": (dps.TunedRKN6(), PERIOD / 8, None, 14),
}
EXACT = dfx.Dopri8(), None, 1e-12, 13


def potential(t, q, args):
    return -1 / jnp.sqrt(q @ q)


def solve(periods: int, solver, dt0, tolerance, evaluations: int):
    """The energies at the end of each period, and the evaluations in one."""
    # In all solves the energy falls from -1/2 to about -2/3.
    friction = dps.ConstantDamping(math.log(4 / 3) / (2 * PERIOD * periods))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)
    ts = jnp.linspace(0.0, PERIOD * periods, periods + 1)
    if tolerance is None:
        control, adjoint = dfx.ConstantStepSize(), dps.FixedStepAdjoint()
    else:
        control = dfx.PIDController(rtol=tolerance, atol=tolerance)
        adjoint = dfx.RecursiveCheckpointAdjoint()
    sol = dfx.diffeqsolve(
        system,
        solver,
        0.0,
        ts[-1],
        dt0,
        APOCENTRE,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=control,
        adjoint=adjoint,
        max_steps=10**6,
    )
    assert sol.ys is not None
    energy = dps.diagnostics.energy(system, ts, sol.ys)
    return np.asarray(energy), int(sol.stats["num_steps"]) * evaluations / periods


def picture(path: pathlib.Path, exact, found):
    fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    colours = dict(zip(SOLVES, ("tab:orange", "tab:green", "tab:blue"), strict=True))
    for name, (energy, count) in found.items():
        label = f"{name}, {count:.0f} evaluations a period"
        left.plot(energy, color=colours[name], lw=2, label=label)
        error = np.abs(energy - exact)[1:]
        right.semilogy(range(1, len(exact)), error, color=colours[name], lw=2)
    left.plot(exact, color="black", lw=1, ls=(0, (4, 4)), label="exact")
    left.set(title="The energy of an orbit with weak friction", ylabel="energy")
    right.set(title="Its error", ylabel="error")
    left.legend(frameon=False, fontsize=9)
    for ax in (left, right):
        ax.set(xlabel="periods", xlim=(0, len(exact) - 1))
        ax.spines[["top", "right"]].set_visible(False)
    fig.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="damped_orbit.png")
    options = parser.parse_args()
    periods = 20 if options.quick else 200
    exact, _ = solve(periods, *EXACT)
    found = {name: solve(periods, *given) for name, given in SOLVES.items()}
    print(f"An orbit with friction over {periods} periods")
    print("solver     evaluations a period  largest error of the energy")
    for name, (energy, count) in found.items():
        print(f"{name:10} {count:20.0f}  {np.max(np.abs(energy - exact)):27.1e}")
    picture(options.output, exact, found)
    print(f"Figure saved to {options.output}")


if __name__ == "__main__":
    main()
