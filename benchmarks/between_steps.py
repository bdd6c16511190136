"""Errors at steps and between them, of every scheme at steps that the docs recommend.

A damped pendulum of large amplitude to t = 20, saved at eight times in each step:
through Diffrax's own loop, which interpolates, and through that of `ReversibleAdjoint`,
which takes shorter steps, or where forces take long (100 copies of the pendulum) uses
the continuous extension of the scheme. The error is the largest entry of the difference
to a solution by `SofroniouSpaletta10` with small steps.

A second table is the time of solves that save 201 times, of pendulums by `TunedRKN6`,
of chains of rods by `PresymplecticGauss(6, tolerance=1e-9)`, and of oscillators of
which the energy is a product by `PresymplecticGauss(4, tolerance=1e-6)`: of the solve
that saves its end alone, and with shorter steps over that with the extension, each in
pairs of runs.
"""

import functools
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import solve
from _timing import interleaved
from gauss import rods

import diffrax_presym as dps
from diffrax_presym._solver import _splitting


jax.config.update("jax_enable_x64", True)

T1 = 20.0
Y0 = jnp.array([2.0]), jnp.array([0.3])
SYSTEM = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    dps.ConstantDamping(0.05),
)
SCHEMES = {
    "PresymplecticLeapfrog": (dps.PresymplecticLeapfrog(), (0.5, 0.1)),
    "PresymplecticYoshida4": (dps.PresymplecticYoshida4(), (0.5, 0.25)),
    "Suzuki4": (dps.Suzuki4(), (1.0, 0.25)),
    "SofroniouSpaletta6": (dps.SofroniouSpaletta6(), (1.0, 0.5)),
    "SofroniouSpaletta8": (dps.SofroniouSpaletta8(), (1.0, 0.5)),
    "SofroniouSpaletta10": (dps.SofroniouSpaletta10(), (2.0, 1.0)),
    "BlanesMoan4": (dps.BlanesMoan4(), (1.0, 0.25)),
    "BlanesMoan6": (dps.BlanesMoan6(), (1.0, 0.5)),
    "BlanesMoanRKN4": (dps.BlanesMoanRKN4(), (1.0, 0.25)),
    "BlanesMoanRKN6": (dps.BlanesMoanRKN6(), (1.0, 0.5)),
    "TunedRKN6": (dps.TunedRKN6(), (2.0, 1.0, 0.5)),
    "BlanesCasasRKN8": (dps.BlanesCasasRKN8(), (1.0, 0.5)),
    "TunedLinear8": (dps.TunedLinear8(), (0.5,)),
    "PresymplecticTao": (dps.PresymplecticTao(5.0), (0.1,)),
    "PresymplecticCoupled(4)": (dps.PresymplecticCoupled(4), (0.25,)),
    "PresymplecticGauss(4)": (dps.PresymplecticGauss(4), (1.0, 0.5)),
    "PresymplecticGauss(8)": (dps.PresymplecticGauss(8), (2.0, 1.0)),
}
OURS = dps.ReversibleAdjoint()
LOOPS = {
    "Diffrax's": (dfx.RecursiveCheckpointAdjoint(), 1),
    "ours": (OURS, 1),
    "extension": (OURS, 100),
}
INSIDE = 8


def run(solver, dt0, saveat, adjoint, copies):
    y0 = tuple(jnp.repeat(x, copies) for x in Y0)
    return solve(SYSTEM, solver, 0.0, T1, dt0, y0, saveat=saveat, adjoint=adjoint).ys


def saved(solver, dt0, ts, adjoint, copies):
    saveat = dfx.SaveAt(ts=ts)
    ys = jax.jit(lambda: run(solver, dt0, saveat, adjoint, copies))()
    return np.concatenate([y[:, :1] for y in ys], axis=1)


def errors(quick):
    table = Table(
        None,
        "scheme:<24",
        "step:>5",
        "loop:>10",
        "at steps:>9.1e",
        "anywhere:>9.1e",
        "ratio:>6.2f",
    )
    for name, (solver, steps) in SCHEMES.items():
        kinds = _splitting.AbstractSplitting, dps.PresymplecticGauss
        extended = isinstance(solver, kinds)
        extended = extended and not isinstance(solver, dps.TunedLinear8)
        for h in steps[:1] if quick else steps:
            ts = jnp.linspace(0.0, T1, round(T1 / h) * INSIDE + 1)
            fine = saved(dps.SofroniouSpaletta10(), 0.02, ts, *LOOPS["ours"])
            for loop, (adjoint, copies) in LOOPS.items():
                if loop == "ours" or (not quick and (copies == 1 or extended)):
                    error = np.abs(saved(solver, h, ts, adjoint, copies) - fine)
                    at, anywhere = np.max(error[::INSIDE]), np.max(error)
                    table.row(name, h, loop, at, anywhere, anywhere / at)


class Timed(NamedTuple):
    solver: dps.AbstractPresymplecticSolver
    system: dps.AbstractHamiltonian
    y0: tuple[jax.Array, ...]
    t1: float


def pendulums(copies):
    y0 = tuple(jnp.repeat(x, copies) for x in Y0)
    return Timed(dps.TunedRKN6(), SYSTEM, y0, T1)


def linkage(links):
    gauss = dps.PresymplecticGauss(6, tolerance=1e-9)
    return Timed(gauss, rods(links), (jnp.ones(links), jnp.zeros(links)), 5.0)


def products(copies):
    energy = lambda t, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)) / 2
    gauss = dps.PresymplecticGauss(4, tolerance=1e-6)
    y0 = jnp.linspace(0.5, 1.0, copies), jnp.zeros(copies)
    return Timed(gauss, dps.Hamiltonian(energy), y0, 10.0)


TIMED = {
    "100 pendulums": pendulums(100),
    "1000 pendulums": pendulums(1000),
    "2 rods": linkage(2),
    "3 rods": linkage(3),
    "10 products": products(10),
    "40 products": products(40),
}


def times(quick):
    table = Table(
        None,
        "system:<14",
        "steps:>5d",
        "end alone, us:>13.0f",
        "201 times, us:>13.0f",
        "shorter steps over that:>23.1f",
    )
    none = lambda *args: None
    for name in list(TIMED)[::2] if quick else TIMED:
        solver, system, y0, t1 = TIMED[name]
        method: Any = type(solver)
        extension = method.extension
        ts = dfx.SaveAt(ts=jnp.linspace(0, t1, 201))
        saveats = {"end": dfx.SaveAt(t1=True), "shorter": ts, "extended": ts}
        for steps in (25, 50, 100, 200):
            calls = {}
            for k, (kind, saveat) in enumerate(saveats.items()):
                method.extension = none if kind == "shorter" else extension
                # Solves of equal arguments would be traced once.
                options = dict(saveat=saveat, adjoint=OURS, max_steps=4096 + k)
                run = functools.partial(
                    solve, system, solver, 0.0, t1, t1 / steps, y0, **options
                )
                calls[kind] = jax.jit(lambda run=run: run().ys)
                calls[kind]()
            measured = interleaved(calls, 9 if quick else 31)
            extended = measured["extended"]
            table.row(
                name,
                steps,
                1e6 * measured["end"].median,
                1e6 * extended.median,
                measured["shorter"].over(extended),
            )


def main():
    quick = command_line(__doc__).parse_args().quick
    errors(quick)
    times(quick)


if __name__ == "__main__":
    main()
