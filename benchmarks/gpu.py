"""What an accelerator changes: time per step, and saved times.

Run it on a machine with a GPU; on another it measures the CPU. Damped pendulums, in
double precision. The first table is the time per step of long solves, by the number of
unknowns: of Diffrax's solvers with constant steps, of a scheme of this package in
Diffrax's loop, and in that of `FixedStepAdjoint`. `compile` is the time to compile the
solve of one unknown, in seconds. The second table saves at 101 times that are not
steps.

For the time to an error in batches run `batches.py` on the same machine, and for
gradients `gradients.py --batches`.
"""

import functools
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import LAST, solve
from _timing import interleaved

import diffrax_presym as dps


T1 = 10.0
SYSTEM = dps.MechanicalSystem(
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
ROWS = {name: (solver, THEIRS) for name, solver in DIFFRAX.items()}
ROWS |= {f"{name}, Diffrax's loop": (solver, THEIRS) for name, solver in OURS.items()}
ROWS |= {name: (solver, FAST) for name, solver in OURS.items()}


def compiled(solver, steps, adjoint, n, saveat):
    """A program without arguments, and the seconds it took to compile."""
    y0, most = (jnp.linspace(0.5, 2.0, n), jnp.zeros(n)), {}
    if adjoint is THEIRS:
        most = {"max_steps": steps}
    options = {"adjoint": adjoint, "saveat": saveat} | most
    run = lambda y0: solve(SYSTEM, solver, 0.0, T1, T1 / steps, y0, **options).ys
    jax.clear_caches()
    before = time.perf_counter()
    program = jax.jit(run).lower(y0).compile()
    return functools.partial(program, y0), time.perf_counter() - before


def measure(name, sizes, steps, repeats, saveat=LAST):
    """The seconds of a solve by the number of unknowns, and to compile the first."""
    solver, adjoint = ROWS[name]
    programs = {n: compiled(solver, steps, adjoint, n, saveat) for n in sizes}
    found = interleaved({n: call for n, (call, _) in programs.items()}, repeats)
    return [found[n].median for n in sizes], programs[sizes[0]][1]


def main():
    quick = command_line(__doc__).parse_args().quick
    sizes, steps, repeats = (1, 4096, 1048576), 1000, 5
    if quick:
        sizes, steps, repeats = (1, 256), 100, 2
    print(f"Median of {repeats} runs")
    caption = "Microseconds per step, by the number of unknowns"
    columns = [f"{n}:>9.1f" for n in sizes]
    table = Table(caption, ":<37", *columns, "compile:>9.1f")
    for name in ROWS:
        seconds, taken = measure(name, sizes, steps, repeats)
        table.row(name, *(1e6 * x / steps for x in seconds), taken)
    saveat = dfx.SaveAt(ts=jnp.asarray(np.linspace(0, T1, 102)[1:] * 0.9987))
    caption = f"Milliseconds per solve of {steps} steps, saved at 101 times"
    table = Table(caption, ":<37", *(f"{n}:>9.2f" for n in sizes))
    for name in (*DIFFRAX, *OURS):
        seconds, _ = measure(name, sizes, steps, repeats, saveat)
        table.row(name, *(1e3 * x for x in seconds))


if __name__ == "__main__":
    main()
