"""Gradients of long solves: time and memory of three ways to get them.

The leapfrog, on damped pendulums, whose sines take most of the time, and on springs
with a cubic force, which takes almost none. A ratio is the time of value and gradient,
with respect to the initial state and the damping, over that of the same solve alone.
`FixedStepAdjoint` is compared with Diffrax's `RecursiveCheckpointAdjoint`, its
default, with `FixedStepAdjoint` in batches, and with reverse mode through a `lax.scan`
written by hand, whose number of steps is fixed when it is compiled.
Runs that would take too long or too much memory are
omitted, and those of minutes are made once.

Memory is what XLA reports that the compiled program needs in addition to its arguments.
"""

import functools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from _report import command_line, Table
from _solve import last, solve
from _timing import interleaved

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

T1 = 10.0
REVERSIBLE = dps.FixedStepAdjoint()
CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()
ADJOINTS = {
    "reversible": REVERSIBLE,
    "fixed step": dps.FixedStepAdjoint(),
    "checkpointed": CHECKPOINTED,
}
# Steps times unknowns beyond which a method is not tried.
MOST = {"reversible": 1e10, "checkpointed": 2e7, "scan": 3e7}
LONG = 3e8  # Beyond which a program runs once, without a warm-up.

SYSTEMS = {
    "pendulums": lambda t, q, args: -jnp.sum(jnp.cos(q)),
    "springs": lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 4),
}


def by_diffrax(system, adjoint, steps):
    def loss(y0, gamma):
        hamiltonian = dps.ConformalHamiltonian(
            dps.QuadraticKinetic(), SYSTEMS[system], dps.ConstantDamping(gamma)
        )
        sol = solve(
            hamiltonian,
            dps.PresymplecticLeapfrog(),
            0.0,
            T1,
            T1 / steps,
            y0,
            adjoint=adjoint,
            max_steps=steps,
            throw=True,
        )
        return sum(jnp.sum(y**2) for y in last(sol))

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


def times(system, sizes, counts, repeats):
    table = Table(
        f"Value and gradient over the solve alone, {system}",
        "unknowns:>9",
        "steps:>7",
        "solve, ms:>10.3g",
        *(f"{name}:>13.2f" for name in MOST),
    )
    for n in sizes:
        for steps in counts:
            programs = {
                name: functools.partial(compiled(loss, n), *problem(n))
                for name, loss in methods(system, steps).items()
                if n * steps <= MOST.get(name, MOST["reversible"])
            }
            once = n * steps > LONG
            found = interleaved(programs, 1 if once else repeats, warm_up=not once)
            alone = found["solve"]
            ratios = [found[x].over(alone) if x in found else None for x in MOST]
            table.row(n, steps, alone.median * 1e3, *ratios)


def batches(sizes, counts, repeats):
    """Under `vmap`, saving the end or at 101 times, of one pendulum each."""
    table = Table(
        "Value and gradient over the solve alone, batches of pendulums",
        "batch:>7",
        "steps:>7",
        "saved:>5",
        "solve, ms:>10.3g",
        *(f"{name}:>13.2f" for name in ADJOINTS),
        "checkpointed / reversible:>26.1f",
    )
    hamiltonian = lambda gamma: dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), SYSTEMS["pendulums"], dps.ConstantDamping(gamma)
    )

    def loss(adjoint, steps, saveat, q, gamma):
        sol = solve(
            hamiltonian(gamma),
            dps.PresymplecticLeapfrog(),
            *(0.0, T1, T1 / steps, (q, jnp.zeros_like(q))),
            saveat=saveat,
            adjoint=adjoint,
            max_steps=steps,
        )
        return sum(jnp.sum(y**2) for y in jax.tree.leaves(sol.ys))

    saves = {
        "t1": dfx.SaveAt(t1=True),
        "101": dfx.SaveAt(ts=jnp.linspace(0.0, T1, 101)),
    }
    for batch in sizes:
        for steps in counts:
            if batch * steps > 1e7:
                continue
            q, gamma = jnp.linspace(0.5, 2.0, batch)[:, None], jnp.array(0.1)
            for name, saveat in saves.items():
                programs = {}
                for key, adjoint in {"solve": REVERSIBLE, **ADJOINTS}.items():
                    fn = functools.partial(loss, adjoint, steps, saveat)
                    if key != "solve":
                        fn = jax.value_and_grad(fn, argnums=(0, 1))
                    fn = jax.jit(jax.vmap(fn, in_axes=(0, None)))
                    fn = fn.lower(q, gamma).compile()
                    if key != "checkpointed" or batch * steps <= 1e6:
                        programs[key] = functools.partial(fn, q, gamma)
                found = interleaved(programs, repeats)
                alone = found["solve"]
                ratios = [
                    found[x].over(alone) if x in found else None for x in ADJOINTS
                ]
                last_ratio = None
                if "checkpointed" in found:
                    last_ratio = found["checkpointed"].over(found["reversible"])
                table.row(batch, steps, name, alone.median * 1e3, *ratios, last_ratio)


def memory(n, counts):
    title = f"Memory of value and gradient at {n} unknowns, MB"
    table = Table(title, "steps:>9", *(f"{name}:>13.3f" for name in MOST))
    for steps in counts:
        losses = methods("pendulums", steps)
        used: list[Any] = [compiled(losses[x], n).memory_analysis() for x in MOST]
        table.row(steps, *(analysis.temp_size_in_bytes / 1e6 for analysis in used))


def main():
    parser = command_line(__doc__)
    parser.add_argument("--batches", action="store_true", help="only the batches")
    options = parser.parse_args()
    quick = options.quick
    repeats = 2 if quick else 5
    print(f"{jax.devices()[0].device_kind}, median of {repeats} runs")
    sizes, counts = (1, 1000, 100000), (1000, 10000, 100000)
    if quick:
        sizes, counts = (1,), (1000,)
    if quick:
        batches((1, 64), (100,), repeats)
    else:
        batches((1, 64, 4096), (1000, 10_000), repeats)
    if options.batches:
        return
    for system in SYSTEMS:
        times(system, sizes, counts, repeats)
    memory(1000, (1000, 10000) if quick else (1000, 10000, 100000, 1000000))


if __name__ == "__main__":
    main()
