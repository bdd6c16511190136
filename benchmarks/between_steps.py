"""Errors at steps and between them, of every scheme at steps that the docs recommend.

A damped pendulum of large amplitude to t = 20, saved at eight times in each step:
through Diffrax's own loop, which interpolates, and through that of `ReversibleAdjoint`,
which takes shorter steps. The error is the largest entry of the difference to a
solution by `SofroniouSpaletta10` with small steps.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import solve

import diffrax_presym as dps


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
LOOPS = {
    "Diffrax's": dfx.RecursiveCheckpointAdjoint(),
    "ours": dps.ReversibleAdjoint(),
}
INSIDE = 8


def saved(solver, dt0, ts, adjoint):
    run = lambda: solve(
        SYSTEM, solver, 0.0, T1, dt0, Y0, saveat=dfx.SaveAt(ts=ts), adjoint=adjoint
    )
    return np.concatenate(jax.jit(lambda: run().ys)(), axis=1)


def main():
    quick = command_line(__doc__).parse_args().quick
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
        for h in steps[:1] if quick else steps:
            ts = jnp.linspace(0.0, T1, round(T1 / h) * INSIDE + 1)
            fine = saved(dps.SofroniouSpaletta10(), 0.02, ts, LOOPS["ours"])
            for loop, adjoint in LOOPS.items():
                if not quick or loop == "ours":
                    error = np.abs(saved(solver, h, ts, adjoint) - fine)
                    at, anywhere = np.max(error[::INSIDE]), np.max(error)
                    table.row(name, h, loop, at, anywhere, anywhere / at)


if __name__ == "__main__":
    main()
