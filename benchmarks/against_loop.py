"""`diffeqsolve` with our schemes against hand-written loops of the same schemes.

Both sides run in one process, compiled and warmed up, by turns; a row gives the median
time per step of each and the median of the ratios. A loop carries time, evaluates the
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
LEAPFROG = dps.PresymplecticLeapfrog()
RKN6 = dps.BlanesMoanRKN6()


def loop_over(step):
    """A loop of `step(t, t_next, y)`, which ends exactly at `steps * DT`."""

    @jax.jit
    def solve(q, p, steps):
        t1 = steps * DT

        def body(state):
            i, t, y = state
            i = i + 1
            t_next = jnp.where(i == steps, t1, i * DT)
            return i, t_next, step(t, t_next, y)

        start = (0, jnp.zeros(()), (q, p))
        return lax.while_loop(lambda state: state[1] < t1, body, start)[2]

    return solve


def leapfrog_loop(potential):
    # Momentum first, with one evaluation of the force. A loop of its own, since the
    # force is carried from step to step.
    force = lambda t, q: -jax.grad(potential, argnums=1)(t, q, None)

    @jax.jit
    def solve(q, p, steps):
        t1 = steps * DT

        def body(state):
            i, t, q, p, f = state
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
            return i, t_next, q, p, f

        start = (0, jnp.zeros(()), q, p, force(0.0, q))
        return lax.while_loop(lambda state: state[1] < t1, body, start)[2:4]

    return solve


def splitting_loop(potential):
    force = lambda t, q: -jax.grad(potential, argnums=1)(t, q, None)
    drifts = jnp.array(RKN6.tableau.fractions[0::2])
    kicks = jnp.array(RKN6.tableau.fractions[1::2])

    def step(t, t_next, y):
        h = t_next - t

        def drift(fraction, y):
            q, p = y
            shrink = jnp.expm1(-GAMMA * fraction * h)
            return q - shrink / GAMMA * p, p + shrink * p

        def stage(y, fractions):
            q, p = drift(fractions[0], y)
            return (q, p + fractions[1] * h * force(t, q)), None

        y, _ = lax.scan(stage, y, (drifts[:-1], kicks))
        return drift(drifts[-1], y)

    return loop_over(step)


def ours(potential, solver, saveat, every=1, max_steps=None, step_to=None):
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(GAMMA)
    )
    term = dps.HamiltonianTerm(hamiltonian)
    controller = dfx.ConstantStepSize() if step_to is None else dfx.StepTo(step_to)

    @jax.jit
    def solve(q, p, steps):
        sol = dfx.diffeqsolve(
            term,
            solver,
            t0=0.0,
            t1=steps * DT if step_to is None else step_to[-1],
            dt0=every * DT if step_to is None else None,
            y0=(q, p),
            saveat=saveat,
            max_steps=max_steps,
            stepsize_controller=controller,
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
    repeats = 3 if quick else 15
    sizes = {1: 100_000, 1000: 10_000, 100_000: 200}
    if quick:
        sizes = {n: steps // 50 for n, steps in sizes.items()}
    print(
        f"{'potential':>9} {'unknowns':>8} {'scheme, saved':>26}"
        f" {'ours, ns':>9} {'loop, ns':>9} {'ratio':>6}"
    )
    for name, potential in POTENTIALS.items():
        leapfrog, splitting = leapfrog_loop(potential), splitting_loop(potential)
        for n, steps in sizes.items():
            q = jnp.linspace(0.5, 1.0, n) if n > 1 else jnp.array(0.5)
            p = jnp.zeros_like(q)
            end = dfx.SaveAt(t1=True)
            points = dfx.SaveAt(ts=jnp.linspace(0, steps * DT, 11))
            grid = jnp.arange(steps + 1) * DT
            ten = dps.Substeps(LEAPFROG, 10)
            cases = {
                "leapfrog, t1": (ours(potential, LEAPFROG, end), leapfrog),
                "leapfrog, t1, StepTo": (
                    ours(potential, LEAPFROG, end, step_to=grid),
                    leapfrog,
                ),
                "leapfrog, t1, Substeps(10)": (ours(potential, ten, end, 10), leapfrog),
                "leapfrog, ts": (ours(potential, LEAPFROG, points), leapfrog),
                "leapfrog, ts, Substeps(10)": (
                    ours(potential, ten, points, 10),
                    leapfrog,
                ),
                "BlanesMoanRKN6, t1": (ours(potential, RKN6, end), splitting),
            }
            if n * steps <= 10_000_000:
                every = dfx.SaveAt(steps=True)
                cases["leapfrog, steps"] = (
                    ours(potential, LEAPFROG, every, max_steps=steps),
                    leapfrog,
                )
            for case, (solve, loop) in cases.items():
                mine, theirs, ratio = compare(solve, loop, q, p, steps, repeats)
                print(
                    f"{name:>9} {n:>8} {case:>26} {mine * 1e9:>9.0f}"
                    f" {theirs * 1e9:>9.0f} {ratio:>6.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
