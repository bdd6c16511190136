"""How long `diffeqsolve` takes to compile with each solver, beside Tsit5.

The median over fresh compilations of the damped pendulum, by turns, in one process:
tracing, lowering and XLA together. Nothing is cached between them.
"""

import argparse
import statistics
import time

import diffrax as dfx
import jax
import jax.numpy as jnp

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


def compile_once(solver, saveat):
    potential = lambda t, q, args: -jnp.sum(jnp.cos(q))
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(0.1)
    )
    term = dps.HamiltonianTerm(hamiltonian)

    def solve(q, p):
        return dfx.diffeqsolve(
            term, solver, t0=0.0, t1=1.0, dt0=0.1, y0=(q, p), saveat=saveat
        ).ys

    jax.clear_caches()
    q = jnp.array(0.5)
    start = time.perf_counter()
    jax.jit(solve).lower(q, q).compile()
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    repeats = 1 if parser.parse_args().quick else 7
    saveats = {
        "t1": dfx.SaveAt(t1=True),
        "ts": dfx.SaveAt(ts=jnp.linspace(0, 1, 5)),
    }
    times = {(name, saved): [] for name in SOLVERS for saved in saveats}
    compile_once(dfx.Tsit5(), saveats["t1"])
    for _ in range(repeats):
        for name, saved in times:
            times[name, saved].append(compile_once(SOLVERS[name], saveats[saved]))
    medians = {key: statistics.median(values) for key, values in times.items()}
    print(f"{'':26}" + "".join(f"{f'SaveAt({s}=...)':>22}" for s in saveats))
    for name in SOLVERS:
        row = f"{name:26}"
        for saved in saveats:
            seconds = medians[name, saved]
            ratio = seconds / medians["Tsit5, constant step", saved]
            row += f"{seconds:>10.2f} s {ratio:>8.2f}x"
        print(row)


if __name__ == "__main__":
    main()
