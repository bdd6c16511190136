"""Gradients of long solves: time and memory, by four ways to get them.

The leapfrog, all in one process, compiled and warmed up, by turns, medians; on damped
pendulums, whose sines take most of the time, and on springs with a cubic force, which
takes next to none. A ratio is the time of value and gradient, with respect to the
initial state and the damping, over that of the same solve alone. Beside
`ReversibleAdjoint` stand Diffrax's `RecursiveCheckpointAdjoint`, its default, and
reverse mode through a `lax.scan` written by hand, whose number of steps is fixed when
it is compiled. Runs that would take too long or too much memory are left out, and those
of minutes are made once.

Memory is what XLA says that the compiled program needs besides its arguments.
"""

import argparse
import statistics
import time
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

T1 = 10.0
REVERSIBLE = dps.ReversibleAdjoint()
CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()
# Steps times unknowns beyond which a method is not tried.
MOST = {"reversible": 1e10, "checkpointed": 2e7, "scan": 3e7}
LONG = 3e8  # beyond which a program runs once, and is its own warm-up


SYSTEMS = {
    "pendulums": lambda t, q, args: -jnp.sum(jnp.cos(q)),
    "springs": lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 4),
}


def by_diffrax(system, adjoint, steps):
    def loss(y0, gamma):
        hamiltonian = dps.ConformalHamiltonian(
            dps.QuadraticKinetic(), SYSTEMS[system], dps.ConstantDamping(gamma)
        )
        sol = dfx.diffeqsolve(
            dps.HamiltonianTerm(hamiltonian),
            dps.PresymplecticLeapfrog(),
            t0=0.0,
            t1=T1,
            dt0=T1 / steps,
            y0=y0,
            adjoint=adjoint,
            max_steps=steps,
        )
        return jnp.sum(
            jnp.array([jnp.sum(y[-1] ** 2) for y in jax.tree.leaves(sol.ys)])
        )

    return loss


def by_scan(system, steps):
    """The same scheme as one would write it."""
    h = T1 / steps
    slope = jax.grad(lambda q: SYSTEMS[system](0.0, q, None))

    def loss(y0, gamma):
        decay = jnp.exp(-gamma * h / 2)

        def step(y, _):
            q, p = y
            p = decay * (p - h / 2 * slope(q))
            q = q + h * p / 2 * (1 + decay) / decay
            p = decay * p - h / 2 * slope(q)
            return (q, p), None

        y, _ = jax.lax.scan(step, y0, length=steps)
        return sum(jnp.sum(x**2) for x in y)

    return loss


def methods(system, steps):
    with_gradient = lambda loss: jax.value_and_grad(loss, argnums=(0, 1))
    return {
        "solve": by_diffrax(system, REVERSIBLE, steps),
        "reversible": with_gradient(by_diffrax(system, REVERSIBLE, steps)),
        "checkpointed": with_gradient(by_diffrax(system, CHECKPOINTED, steps)),
        "scan": with_gradient(by_scan(system, steps)),
    }


def problem(n):
    return (jnp.linspace(0.5, 2.0, n), jnp.zeros(n)), jnp.array(0.1)


def compiled(loss, n):
    return jax.jit(loss).lower(*problem(n)).compile()


def seconds(program, inputs):
    start = time.perf_counter()
    jax.block_until_ready(program(*inputs))
    return time.perf_counter() - start


def times(system, sizes, counts, repeats):
    names = list(MOST)
    print(f"Value and gradient over the solve alone, {system}")
    print(f"{'unknowns':>9} {'steps':>7} {'solve, ms':>10}", end="")
    print("".join(f"{name:>14}" for name in names))
    for n in sizes:
        inputs = problem(n)
        for steps in counts:
            programs = {
                name: compiled(loss, n)
                for name, loss in methods(system, steps).items()
                if n * steps <= MOST.get(name, MOST["reversible"])
            }
            once = n * steps > LONG
            rounds = [
                {name: seconds(program, inputs) for name, program in programs.items()}
                for _ in range(1 if once else repeats + 1)
            ]
            rounds = rounds[0 if once else 1 :]  # the first warms up
            median = {
                name: statistics.median(r[name] for r in rounds) for name in programs
            }
            row = "".join(
                f"{median[name] / median['solve']:>14.2f}"
                if name in median
                else f"{'-':>14}"
                for name in names
            )
            print(f"{n:>9} {steps:>7} {median['solve'] * 1e3:>10.3g}{row}", flush=True)


def memory(n, counts):
    print(f"Memory of value and gradient at {n} unknowns, MB")
    print(f"{'steps':>9}" + "".join(f"{name:>14}" for name in MOST))
    for steps in counts:
        row = ""
        for name, loss in methods("pendulums", steps).items():
            if name in MOST:
                analysis: Any = compiled(loss, n).memory_analysis()
                used = analysis.temp_size_in_bytes
                row += f"{used / 1e6:>14.3f}"
        print(f"{steps:>9}{row}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    quick = parser.parse_args().quick
    print(f"{jax.devices()[0].device_kind}, median of {2 if quick else 5} runs\n")
    sizes, counts = (1, 1000, 100000), (1000, 10000, 100000)
    if quick:
        sizes, counts = (1,), (1000,)
    for system in SYSTEMS:
        times(system, sizes, counts, 2 if quick else 5)
        print()
    memory(1000, (1000, 10000) if quick else (1000, 10000, 100000, 1000000))


if __name__ == "__main__":
    main()
