"""`diffeqsolve` with our leapfrog against a hand-written loop of the same scheme.

Both sides run in one process, compiled and warmed up, by turns; a row gives the median
time per step of each and the median of the ratios. The loop carries time, evaluates the
damping at each step, and does nothing else.
"""

import argparse
import statistics
import time

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

GAMMA = 0.1
DT = 0.01
POTENTIALS = {
    "quadratic": lambda t, q, args: jnp.sum(q**2) / 2,
    "pendulum": lambda t, q, args: -jnp.sum(jnp.cos(q)),
}


def hand_loop(potential):
    force = lambda t, q: -jax.grad(potential, argnums=1)(t, q, None)

    @jax.jit
    def solve(q, p, steps):
        t1 = steps * DT

        def cond(state):
            return state[0] < t1

        def body(state):
            t, i, q, p, f = state
            i = i + 1
            t_next = jnp.where(i == steps, t1, i * DT)
            half = (t_next - t) / 2
            decay = jnp.exp(-GAMMA * half)
            p = p + half * f
            q = q + half * p
            p = decay * p
            p = decay * p
            q = q + half * p
            f = force(t_next, q)
            p = p + half * f
            return t_next, i, q, p, f

        start = (jnp.zeros(()), 0, q, p, force(0.0, q))
        return lax.while_loop(cond, body, start)[2:4]

    return solve


def ours(potential, solver, saveat, every=1, max_steps=None):
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(GAMMA)
    )
    term = dps.HamiltonianTerm(hamiltonian)

    @jax.jit
    def solve(q, p, steps):
        sol = dfx.diffeqsolve(
            term,
            solver,
            t0=0.0,
            t1=steps * DT,
            dt0=every * DT,
            y0=(q, p),
            saveat=saveat,
            max_steps=max_steps,
        )
        return jax.tree.map(lambda x: x[-1], sol.ys)

    return solve


def compare(solve, loop, q, p, steps, repeats):
    def timed(fn):
        start = time.perf_counter()
        jax.block_until_ready(fn(q, p, steps))
        return (time.perf_counter() - start) / steps

    for fn in (solve, loop):
        timed(fn)
    pairs = [(timed(solve), timed(loop)) for _ in range(repeats)]
    medians = [statistics.median(side) for side in zip(*pairs, strict=True)]
    return *medians, statistics.median(a / b for a, b in pairs)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    quick = parser.parse_args().quick
    repeats = 3 if quick else 21
    sizes = {1: 200_000, 1000: 20_000, 100_000: 300}
    if quick:
        sizes = {n: steps // 100 for n, steps in sizes.items()}
    leapfrog = dps.PresymplecticLeapfrog()
    print(
        f"{'potential':>10} {'unknowns':>8} {'saved':>34} {'ours':>10} {'loop':>10}"
        f" {'ratio':>6}"
    )
    for name, potential in POTENTIALS.items():
        loop = hand_loop(potential)
        for n, steps in sizes.items():
            q = jnp.linspace(0.5, 1.0, n) if n > 1 else jnp.array(0.5)
            p = jnp.zeros_like(q)
            ts = jnp.linspace(0, steps * DT, 11)
            cases = {
                "t1": ours(potential, leapfrog, dfx.SaveAt(t1=True)),
                "t1, position first": ours(
                    potential,
                    dps.PresymplecticLeapfrog("position"),
                    dfx.SaveAt(t1=True),
                ),
                "ts, 11 points": ours(potential, leapfrog, dfx.SaveAt(ts=ts)),
                "ts, 11 points, Substeps(10)": ours(
                    potential,
                    dps.Substeps(leapfrog, 10),
                    dfx.SaveAt(ts=ts),
                    every=10,
                ),
            }
            if n * steps <= 30_000_000:
                cases["steps"] = ours(
                    potential, leapfrog, dfx.SaveAt(steps=True), max_steps=steps
                )
            for saved, solve in cases.items():
                mine, theirs, ratio = compare(solve, loop, q, p, steps, repeats)
                print(
                    f"{name:>10} {n:>8} {saved:>34} {mine * 1e9:>7.0f} ns"
                    f" {theirs * 1e9:>7.0f} ns {ratio:>6.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
