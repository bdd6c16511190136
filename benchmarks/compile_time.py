"""How long `diffeqsolve` takes to compile with each solver, compared to Tsit5.

The median over compilations of the damped pendulum, interleaved in one process:
tracing, lowering and XLA together, with all caches cleared before each.
"""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
from _report import command_line, Table
from _solve import solve
from _timing import interleaved

import diffrax_presym as dps


SOLVERS = {
    "Tsit5, constant step": dfx.Tsit5(),
    "Dopri8, constant step": dfx.Dopri8(),
    "PresymplecticEuler": dps.PresymplecticEuler(),
    "PresymplecticLeapfrog": dps.PresymplecticLeapfrog(),
    "PresymplecticTao": dps.PresymplecticTao(),
    "PresymplecticYoshida4": dps.PresymplecticYoshida4(),
    "SuzukiYoshida(6)": dps.SuzukiYoshida(6),
    "SuzukiYoshida(8)": dps.SuzukiYoshida(8),
    "Suzuki4": dps.Suzuki4(),
    "SofroniouSpaletta6": dps.SofroniouSpaletta6(),
    "SofroniouSpaletta10": dps.SofroniouSpaletta10(),
    "Substeps(leapfrog, 100)": dps.Substeps(dps.PresymplecticLeapfrog(), 100),
    "BlanesMoan4": dps.BlanesMoan4(),
    "BlanesMoanRKN4": dps.BlanesMoanRKN4(),
    "BlanesMoanRKN6": dps.BlanesMoanRKN6(),
    "BlanesCasasRKN8": dps.BlanesCasasRKN8(),
}


def compiled(solver, saveat):
    potential = lambda t, q, args: -jnp.sum(jnp.cos(q))
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(0.1)
    )
    options = {"saveat": saveat, "max_steps": 4096, "throw": True}
    run = lambda q, p: solve(hamiltonian, solver, 0.0, 1.0, 0.1, (q, p), **options).ys
    q = jnp.array(0.5)
    return jax.jit(run).lower(q, q).compile()


def main():
    quick = command_line(__doc__).parse_args().quick
    saveats = {
        "t1": dfx.SaveAt(t1=True),
        "ts": dfx.SaveAt(ts=jnp.linspace(0, 1, 5)),
    }
    calls = {
        (name, saved): functools.partial(compiled, solver, saveat)
        for name, solver in SOLVERS.items()
        for saved, saveat in saveats.items()
    }
    calls["Tsit5, constant step", "t1"]()
    repeats = 1 if quick else 7
    times = interleaved(calls, repeats, warm_up=False, setup=jax.clear_caches)
    table = Table(None, ":<25", *(f"SaveAt({saved}=...):>21" for saved in saveats))
    for name in SOLVERS:
        cells = []
        for saved in saveats:
            timing, base = times[name, saved], times["Tsit5, constant step", saved]
            cells.append(f"{timing.median:.2f} s {timing.over(base):>8.2f}x")
        table.row(name, *cells)


if __name__ == "__main__":
    main()
