"""`diffeqsolve` with our schemes against hand-written loops of the same schemes.

A row gives the median time per step of each side, and the median of the ratios of
interleaved runs. A loop carries time, evaluates the damping at each step, and does
nothing else.
"""

import functools

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
from _report import command_line, Table
from _solve import last, solve
from _timing import interleaved

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

    @jax.jit
    def run(q, p, steps):
        t1, dt0, controller = steps * DT, every * DT, dfx.ConstantStepSize()
        if step_to is not None:
            t1, dt0, controller = step_to[-1], None, dfx.StepTo(step_to)
        options = {"saveat": saveat, "max_steps": max_steps, "throw": True}
        sol = solve(
            hamiltonian, solver, 0.0, t1, dt0, (q, p), None, controller, **options
        )
        return last(sol)

    return run


def main():
    quick = command_line(__doc__).parse_args().quick
    repeats = 3 if quick else 15
    sizes = {1: 100_000, 1000: 10_000, 100_000: 200}
    if quick:
        sizes = {n: steps // 50 for n, steps in sizes.items()}
    table = Table(
        None,
        "potential:>9",
        "unknowns:>8",
        "scheme, saved:>26",
        "ours, ns:>9.0f",
        "loop, ns:>9.0f",
        "ratio:>6.2f",
    )
    ten = dps.Substeps(LEAPFROG, 10)
    for name, potential in POTENTIALS.items():
        leapfrog, splitting = leapfrog_loop(potential), splitting_loop(potential)
        for n, steps in sizes.items():
            q = jnp.linspace(0.5, 1.0, n) if n > 1 else jnp.array(0.5)
            y0 = q, jnp.zeros_like(q)
            solver_of = functools.partial(ours, potential)
            end = dfx.SaveAt(t1=True)
            points = dfx.SaveAt(ts=jnp.linspace(0, steps * DT, 11))
            grid = jnp.arange(steps + 1) * DT
            cases = {
                "leapfrog, t1": solver_of(LEAPFROG, end),
                "leapfrog, t1, StepTo": solver_of(LEAPFROG, end, step_to=grid),
                "leapfrog, t1, Substeps(10)": solver_of(ten, end, 10),
                "leapfrog, ts": solver_of(LEAPFROG, points),
                "leapfrog, ts, Substeps(10)": solver_of(ten, points, 10),
                "BlanesMoanRKN6, t1": solver_of(RKN6, end),
            }
            if n * steps <= 10_000_000:
                every = dfx.SaveAt(steps=True)
                cases["leapfrog, steps"] = solver_of(LEAPFROG, every, max_steps=steps)
            for case, solver in cases.items():
                sides = solver, splitting if "RKN6" in case else leapfrog
                calls = [functools.partial(side, *y0, steps) for side in sides]
                mine, loop = interleaved(dict(enumerate(calls)), repeats).values()
                times = (side.median / steps * 1e9 for side in (mine, loop))
                table.row(name, n, case, *times, mine.over(loop))


if __name__ == "__main__":
    main()
