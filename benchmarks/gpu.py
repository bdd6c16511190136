"""What an accelerator changes: time per step, saved times and gradients.

Run it on a machine with a GPU; on another it measures the CPU. Damped pendulums, in
double precision. The first table is the time per step of long solves, by the number of
unknowns: of Diffrax's solvers with constant steps, of a scheme of this package in
Diffrax's loop, and in that of `FixedStepAdjoint`, as on a GPU and as on a CPU, where
the stages are a loop and each iteration is one step. `compile` is the time to compile
the solve of one unknown, in seconds. The second table saves at 101 times that are not
steps. The third is the value and gradient over the solve alone, the gradient with
respect to the initial state, for a batch of 4096 pendulums.

For the time to an error in batches run `batches.py` on the same machine.
"""

import functools
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import last, solve
from _timing import interleaved

import diffrax_presym as dps
from diffrax_presym import _scan


jax.config.update("jax_enable_x64", True)

T1 = 10.0
HAMILTONIAN = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    dps.ConstantDamping(0.1),
)
OURS = {
    "PresymplecticLeapfrog": dps.PresymplecticLeapfrog(),
    "BlanesMoanRKN4": dps.BlanesMoanRKN4(),
    "TunedRKN6": dps.TunedRKN6(),
}
DIFFRAX = {"Tsit5": dfx.Tsit5(), "Dopri8": dfx.Dopri8()}
FAST, THEIRS = dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()


def start(n):
    return jnp.linspace(0.5, 2.0, n), jnp.zeros(n)


def solution(solver, steps, y0, adjoint, **options):
    if adjoint is THEIRS:
        options |= {"max_steps": steps}
    dt0 = T1 / steps
    return solve(HAMILTONIAN, solver, 0.0, T1, dt0, y0, adjoint=adjoint, **options)


def compiled(fn, y0, as_on_a_cpu=False):
    """A program without arguments, and the seconds it took to compile."""
    platform = _scan.cheap_iterations
    if as_on_a_cpu:
        _scan.cheap_iterations = lambda: True
    jax.clear_caches()
    before = time.perf_counter()
    program = jax.jit(fn).lower(y0).compile()
    taken = time.perf_counter() - before
    _scan.cheap_iterations = platform
    return functools.partial(program, y0), taken


def variants():
    """Name, solver, adjoint, and whether to compile as for a CPU."""
    for name, solver in DIFFRAX.items():
        yield name, solver, THEIRS, False
    for name, solver in OURS.items():
        yield f"{name}, Diffrax's loop", solver, THEIRS, False
        yield f"{name}, as on a CPU", solver, FAST, True
        yield name, solver, FAST, False


def time_per_step(sizes, steps, repeats):
    table = Table(
        "Microseconds per step, by the number of unknowns",
        ":<37",
        *(f"{n}:>9.1f" for n in sizes),
        "compile:>9.1f",
    )
    for name, solver, adjoint, cpu in variants():
        fn = lambda y0, s=solver, a=adjoint: solution(s, steps, y0, a).ys
        row, first = [], None
        for n in sizes:
            program, taken = compiled(fn, start(n), cpu)
            first = taken if first is None else first
            row.append(interleaved({0: program}, repeats)[0].median / steps * 1e6)
        table.row(name, *row, first)


def saved(sizes, steps, repeats):
    ts = np.linspace(0, T1, 102)[1:] * 0.9987
    saveat = dfx.SaveAt(ts=jnp.asarray(ts))
    table = Table(
        f"Milliseconds per solve of {steps} steps, saved at 101 times",
        ":<37",
        *(f"{n}:>9.2f" for n in sizes),
    )
    rows = {name: (solver, THEIRS) for name, solver in DIFFRAX.items()}
    rows |= {name: (solver, FAST) for name, solver in OURS.items()}
    for name, (solver, adjoint) in rows.items():
        fn = lambda y0, s=solver, a=adjoint: solution(s, steps, y0, a, saveat=saveat).ys
        programs = {n: compiled(fn, start(n))[0] for n in sizes}
        times = interleaved(programs, repeats)
        table.row(name, *(times[n].median * 1e3 for n in sizes))


def gradients(n, counts, repeats):
    table = Table(
        f"A batch of {n}: value and gradient over the solve alone, leapfrog",
        "steps:>7",
        "solve, ms:>10.2f",
        "reversible:>11.2f",
        "checkpointed:>13.2f",
    )
    solver = OURS["PresymplecticLeapfrog"]
    for steps in counts:

        def loss(y0, adjoint, steps=steps):
            ys = last(solution(solver, steps, y0, adjoint))
            return sum(jnp.sum(y**2) for y in ys)

        def batch(fn, adjoint):
            return jax.vmap(functools.partial(fn, adjoint=adjoint))

        value_and_grad = jax.value_and_grad(loss)
        reversible = dps.FixedStepAdjoint()
        fns = {
            "solve": batch(loss, reversible),
            "reversible": batch(value_and_grad, reversible),
            "checkpointed": batch(value_and_grad, THEIRS),
        }
        programs = {name: compiled(fn, start(n))[0] for name, fn in fns.items()}
        found = interleaved(programs, repeats)
        ratios = (found[x].over(found["solve"]) for x in ("reversible", "checkpointed"))
        table.row(steps, found["solve"].median * 1e3, *ratios)


def main():
    options = command_line(__doc__).parse_args()
    sizes, steps, repeats = (1, 4096, 1048576), 1000, 5
    counts, batch = (100, 1000, 10000), 4096
    if options.quick:
        sizes, steps, repeats, counts, batch = (1, 256), 100, 2, (100,), 64
    print(f"{jax.devices()[0].device_kind}, median of {repeats} runs")
    time_per_step(sizes, steps, repeats)
    saved(sizes, steps, repeats)
    gradients(batch, counts, repeats)


if __name__ == "__main__":
    main()
