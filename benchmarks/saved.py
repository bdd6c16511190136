"""What saved values cost, and their errors between steps.

Chains of damped pendulums to t = 50, by steps for errors of about 1e-3 and 1e-6: the
time of a solve that is saved at 201 times over that of the end alone, what that is for
a value in steps (`each`), and the time of the gradient of the sum of squares of what is
saved over that of the end. `spread` is the
largest error at all times over that at the ends of steps, of positions and of momenta,
against steps eight times shorter by another scheme. Then a batch of pendulums whose
saved times, steps or ends differ, over one in which they do not. `--quick` leaves out
the largest.
"""

from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import LAST
from _timing import interleaved

import diffrax_presym as dps


T1, SAVED = 50.0, 201
TS = jnp.linspace(0.0, T1, SAVED)
SOLVERS = {
    "BlanesMoanRKN4": (dps.BlanesMoanRKN4(), (50, 200)),
    "TunedRKN6": (dps.TunedRKN6(), (50, 100)),
    "BlanesCasasRKN8": (dps.BlanesCasasRKN8(), (50, 100)),
    "Suzuki4": (dps.Suzuki4(), (100, 500)),
    "PresymplecticGauss(3)": (dps.PresymplecticGauss(3), (50, 125)),
    "PresymplecticLeapfrog": (dps.PresymplecticLeapfrog(), (1000, 10000)),
}


def potential(t, q, args):
    return jnp.sum(jnp.diff(q) ** 2) / 4 - jnp.sum(jnp.cos(q))


def solve(solver, n, saveat, y0) -> Any:
    friction = dps.ConstantDamping(0.02)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)
    return dfx.diffeqsolve(
        *(system, solver, 0.0, T1, T1 / n, y0),
        saveat=saveat,
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    ).ys


def spread(solver, n, y0):
    ts = jnp.linspace(0.0, T1, 4 * n + 1)
    saved = lambda solver, n: solve(solver, n, dfx.SaveAt(ts=ts), y0)
    exact = saved(dps.BlanesMoanRKN6(), 8 * max(n, 100))
    for y, z in zip(saved(solver, n), exact, strict=True):
        each = np.max(np.abs(np.asarray(y - z)), axis=1)
        yield np.max(each[::4]), np.max(each) / np.max(each[::4])


def batches(quick):
    members, repeats = (64, 5) if quick else (1000, 21)
    y0 = jnp.linspace(0.5, 1.5, members)[:, None], jnp.zeros((members, 1))
    each, rng = jnp.linspace(0.8, 1.0, members), np.random.default_rng(0)
    times = jnp.asarray(np.sort(T1 * rng.uniform(size=(members, SAVED))))
    friction = dps.ConstantDamping(0.02)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)

    def one(y0, ts, step, end) -> Any:
        return dfx.diffeqsolve(
            *(system, dps.TunedRKN6(), 0.0, end * T1, step / 2, y0),
            saveat=dfx.SaveAt(ts=ts * end),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        ).ys

    known = {"times": TS, "steps": 1.0, "ends": 1.0}
    own = {"times": times, "steps": each, "ends": each}
    calls = {}
    for name in ("none", *known):
        args = [own[x] if x == name else known[x] for x in known]
        axes = [0 if x == name else None for x in known]
        value = jax.vmap(one, (0, *axes))
        square = lambda y0, *args, value=value: jnp.sum(value(y0, *args)[0] ** 2)
        calls[name] = partial(jax.jit(value), y0, *args)
        calls["gradient", name] = partial(jax.jit(jax.grad(square)), y0, *args)
    found = interleaved(calls, repeats)
    caption = f"A batch of {members}, whose members differ in"
    table = Table(caption, "what:<8", "saved:>6.1f", "gradient:>8.1f")
    for name in known:
        gradient = found["gradient", name].over(found["gradient", "none"])
        table.row(name, found[name].over(found["none"]), gradient)


def main():
    options = command_line(__doc__).parse_args()
    columns = "unknowns:>8", "steps:>6", "saved:>6.1f", "each:>5.2f", "gradient:>8.1f"
    table = Table("", "scheme:<21", *columns, "error:>8.0e", "spread:>10")
    for name, (solver, numbers) in SOLVERS.items():
        for size in (1, 6, 100) if options.quick else (1, 6, 100, 1000):
            y0 = jnp.linspace(0.5, 1.5, size), jnp.zeros(size)
            for n in numbers:
                calls = {}
                for key, saveat in (("end", LAST), ("ts", dfx.SaveAt(ts=TS))):
                    run = partial(solve, solver, n, saveat)
                    square = lambda y0, run=run: jnp.sum(run(y0)[0] ** 2)
                    calls[key] = partial(jax.jit(run), y0)
                    calls["gradient", key] = partial(jax.jit(jax.grad(square)), y0)
                times = interleaved(calls, 5 if options.quick else 21)
                saved = times["ts"].over(times["end"])
                gradient = times["gradient", "ts"].over(times["gradient", "end"])
                errors, ratios = zip(*spread(solver, n, y0), strict=True)
                worst = " ".join(f"{x:.1f}" for x in ratios)
                each = (saved - 1) * n / SAVED
                table.row(name, size, n, saved, each, gradient, max(errors), worst)
    batches(options.quick)


if __name__ == "__main__":
    main()
