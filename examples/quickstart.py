"""Joints with dampers, saved at given times: a tolerance asked for, and kept.

Six pendulums are joined by springs, with a different damper at each joint. For three
tolerances `choose_step` finds the step of `TunedRKN6`, and the solution at 501 times is
compared with one by Diffrax's `Dopri8` with a much smaller tolerance. The table shows
the error that was asked for, predicted and found; the time of the solve, beside the
faster of Diffrax's adaptive `Tsit5` and `Dopri8` within the tolerance; and the time of
a gradient with respect to all dampers. Saves one figure. `--quick` asks for one
tolerance.
"""

import argparse
import pathlib
import statistics
import time
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt


jax.config.update("jax_enable_x64", True)

DAMPERS = jnp.array([0.02, 0.3, 0.02, 0.1, 0.02, 0.02])
Y0 = jnp.array([2.0, 0.0, 0.5, 0.0, -0.5, 1.0]), jnp.zeros(6)
T1, SAVED = 50.0, 501
TS = jnp.linspace(0, T1, SAVED)
SOLVER = dps.TunedRKN6()


def system(dampers):
    return dps.MechanicalSystem(
        kinetic=dps.QuadraticKinetic(),
        potential=lambda t, q, args: jnp.sum(jnp.diff(q) ** 2) - jnp.sum(jnp.cos(q)),
        friction=dps.ViscousDamping(dampers),
    )


@jax.jit
def solve(dt0, dampers=DAMPERS):
    return dfx.diffeqsolve(
        *(system(dampers), SOLVER, 0.0, T1, dt0, Y0),
        saveat=dfx.SaveAt(ts=TS),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


@jax.jit
def saved(dt0):
    return solve(dt0).ys


@partial(jax.jit, static_argnums=0)
def adaptive(solver, tolerance):
    return dfx.diffeqsolve(
        *(system(DAMPERS), solver, 0.0, T1, None, Y0),
        saveat=dfx.SaveAt(ts=TS),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000,
    ).ys


@jax.jit
def gradient(dt0):
    """Of the energy left at the end, with respect to the dampers."""

    def left(dampers):
        q, p = solve(dt0, dampers).ys
        return system(dampers).energy(T1, q[-1], p[-1])

    return jax.grad(left)(DAMPERS)


def errors(ys, exact):
    """At each of the saved times, the largest."""
    each = jax.tree.map(lambda y, e: np.max(np.abs(y - e), axis=1), ys, exact)
    return np.maximum(*each)


def seconds(calls, repeats=9):
    """Median times of calls that take turns, after one to compile."""
    taken = {name: [] for name in calls}
    for i in range(repeats + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            if i:
                taken[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in taken.items()}


def diffrax_at(error, exact):
    """The calls of Diffrax's solvers whose error is just below that asked for."""
    calls = {}
    for solver in (dfx.Tsit5(), dfx.Dopri8()):
        for tolerance in 10.0 ** -np.arange(2, 13, 0.5):
            call = partial(adaptive, solver, tolerance)
            if np.max(errors(call(), exact)) <= error:
                calls[type(solver).__name__] = call
                break
    return calls


def picture(path, ys, curves):
    q, _ = ys
    energy = dps.diagnostics.energy(system(DAMPERS), TS, ys)
    lost = dps.diagnostics.energy_lost(system(DAMPERS), TS, ys)
    fig, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    for k, damper in enumerate(DAMPERS):
        axes[0].plot(TS, q[:, k] + 4 * k, lw=0.9, label=f"{damper:g}")
    axes[0].set(title="Angles of the joints, shifted by 4 each", xlabel="time")
    axes[0].legend(title="damper", fontsize=7, title_fontsize=7, loc="upper right")
    for tolerance, (_, error) in curves.items():
        (line,) = axes[1].semilogy(TS[1:], error[1:], lw=0.9)
        axes[1].axhline(tolerance, color=line.get_color(), ls="--", lw=0.9)
    axes[1].set(title="Error (solid) and tolerance (dashed)", xlabel="time")
    axes[2].plot(TS, energy, label="energy")
    axes[2].plot(TS, lost, label="lost to the dampers")
    axes[2].plot(TS, energy + lost, "k:", label="sum")
    axes[2].set(title="Energy balance", xlabel="time")
    axes[2].legend(fontsize=8)
    fig.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="quickstart.png")
    options = parser.parse_args()
    exact: Any = adaptive(dfx.Dopri8(), 1e-13)
    print(f"Six joints with dampers to t = {T1:g}, saved at {SAVED} times")
    print(
        f"{'asked':>7} {'predicted':>10} {'found':>8} {'steps':>6} {'solve':>8} "
        f"{'Diffrax within it':>23} {'gradient of 6 dampers':>22}"
    )
    curves, ys = {}, None
    for tolerance in (1e-6,) if options.quick else (1e-3, 1e-6, 1e-9):
        chosen = dps.choose_step(solve, 0.0, T1, rtol=0.0, atol=tolerance)
        ys = saved(chosen.dt0)
        error = errors(ys, exact)
        curves[tolerance] = ys, error
        calls = diffrax_at(tolerance, exact)
        times = seconds(
            calls
            | {
                "ours": partial(saved, chosen.dt0),
                "gradient": partial(gradient, chosen.dt0),
            }
        )
        name = min(calls, key=times.__getitem__)
        ms = {name: 1e3 * taken for name, taken in times.items()}
        ratio, cost = ms[name] / ms["ours"], ms["gradient"] / ms["ours"]
        print(
            f"{tolerance:7.0e} {chosen.error * tolerance:10.1e} {np.max(error):8.1e} "
            f"{chosen.steps:6} {ms['ours']:5.2f} ms "
            f"{ms[name]:7.2f} ms, {name + ',':7} x{ratio:3.1f} "
            f"{ms['gradient']:12.2f} ms, x{cost:3.1f}",
            flush=True,
        )
        assert np.max(error) <= tolerance
    picture(options.output, ys, curves)
    print(f"Figure saved to {options.output}")


if __name__ == "__main__":
    main()
