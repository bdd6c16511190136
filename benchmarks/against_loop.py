"""`diffeqsolve` with our schemes against hand-written loops of the same schemes.

Through the loop of `FixedStepAdjoint`. The other side is what a person would write for
speed: the force by hand, the damping of a step computed once, its moves fused, and
outputs where they are known to be: at the end, at all steps, or at 100 times that are
steps. On both sides the number of steps is known when they are compiled. A row gives
the median time per step of each side, and the median of the ratios of interleaved runs.
"""

import functools

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import LAST, last, solve
from _timing import interleaved

import diffrax_presym as dps


GAMMA = 0.1
DT = 0.01
POTENTIALS = {
    "quadratic": (lambda t, q, args: jnp.sum(q**2) / 2, lambda q: -q),
    "pendulum": (lambda t, q, args: -jnp.sum(jnp.cos(q)), lambda q: -jnp.sin(q)),
}
LEAPFROG, RKN6 = dps.PresymplecticLeapfrog(), dps.TunedRKN6()
OUTPUTS = 100


def leapfrog_step(force):
    decay = np.exp(-GAMMA * DT)

    def step(y):
        q, p, f = y
        p = p + DT / 2 * f
        q = q + DT / 2 * (1 + decay) * p
        f = force(q)
        return q, decay * p + DT / 2 * f, f

    return step, lambda q, p: (q, p, force(q))


def splitting_step(force):
    fractions = np.array(RKN6.tableau.fractions)
    drifts, kicks = fractions[0::2], fractions[1::2]
    shrink = np.expm1(-GAMMA * DT * drifts)
    numbers = jnp.asarray(np.stack([shrink[:-1] / -GAMMA, 1 + shrink[:-1], DT * kicks]))

    def step(y):
        def stage(y, numbers):
            q, p = y
            q, p = q + numbers[0] * p, numbers[1] * p
            return (q, p + numbers[2] * force(q)), None

        (q, p), _ = lax.scan(stage, y, numbers.T)
        return q + shrink[-1] / -GAMMA * p, (1 + shrink[-1]) * p

    return step, lambda q, p: (q, p)


def by_hand(scheme, potential, saved, steps):
    step, start = scheme(POTENTIALS[potential][1])

    @jax.jit
    def run(q, p):
        if saved == "t1":
            y = lax.fori_loop(0, steps, lambda _, y: step(y), start(q, p))
            return y[:2]
        inner = 1 if saved == "steps" else steps // OUTPUTS

        def save(y, _):
            y = lax.fori_loop(0, inner, lambda _, y: step(y), y)
            return y, y[:2]

        return lax.scan(save, start(q, p), None, length=steps // inner)[1]

    return run


def ours(solver, potential, saved, steps):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), POTENTIALS[potential][0], dps.ConstantDamping(GAMMA)
    )
    ts = DT * (steps // OUTPUTS) * jnp.arange(1, OUTPUTS + 1)
    saveat = {"steps": dfx.SaveAt(steps=True), "ts": dfx.SaveAt(ts=ts)}
    options = {"saveat": saveat.get(saved, LAST), "throw": True}
    options |= {"max_steps": steps} if saved == "steps" else {}

    @jax.jit
    def run(q, p):
        problem = system, solver, 0.0, steps * DT, DT, (q, p)
        sol = solve(*problem, adjoint=dps.FixedStepAdjoint(), **options)
        return last(sol) if saved == "t1" else sol.ys

    return run


def main():
    quick = command_line(__doc__).parse_args().quick
    repeats = 3 if quick else 9
    sizes = {1: 20_000, 1000: 1_000, 100_000: 100}
    if quick:
        sizes = {n: max(steps // 50, OUTPUTS) for n, steps in sizes.items()}
    table = Table(
        None,
        *("potential:>9", "unknowns:>8", "scheme:>9", "saved:>6"),
        *("ours, ns:>11.0f", "loop, ns:>11.0f", "ratio:>6.2f"),
    )
    schemes = {
        "leapfrog": (LEAPFROG, leapfrog_step, 1),
        "TunedRKN6": (RKN6, splitting_step, 10),
    }
    for potential in POTENTIALS:
        for n, most in sizes.items():
            q = jnp.linspace(0.5, 1.0, n) if n > 1 else jnp.array(0.5)
            y0 = q, jnp.zeros_like(q)
            for name, (solver, scheme, fewer) in schemes.items():
                steps = max(most // fewer, OUTPUTS)
                for saved in ("t1", "steps", "ts"):
                    if saved == "steps" and n * steps > 10_000_000:
                        continue
                    sides = (
                        ours(solver, potential, saved, steps),
                        by_hand(scheme, potential, saved, steps),
                    )
                    calls = [functools.partial(side, *y0) for side in sides]
                    ends = [jax.tree.leaves(call()) for call in calls]
                    for a, b in zip(*ends, strict=True):
                        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)
                    mine, loop = interleaved(dict(enumerate(calls)), repeats).values()
                    times = (side.median / steps * 1e9 for side in (mine, loop))
                    table.row(potential, n, name, saved, *times, mine.over(loop))


if __name__ == "__main__":
    main()
