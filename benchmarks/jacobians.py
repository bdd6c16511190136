"""Jacobians by forward mode: in the loop of the package, and in that of Diffrax.

Of all that is saved by a few parameters, as a least-squares fit needs them: an
oscillator with three parameters and 150 times, as in the how-to page of a fit; 13
masses with dampers, a matrix, by their strength, saved at the 400 times of a sampled
force; and a chain of 100 by the dampers of its two ends. Times are those of a solve in
the loop of the package, and of the Jacobians over that; errors those of the Jacobian,
relative to its largest entry, by central differences.
"""

from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _timing import interleaved

import diffrax_presym as dps


UNIT = dps.QuadraticKinetic()
SOLVER = dps.TunedRKN6()


def oscillator(parameters):
    friction, stiffness, cubic = parameters
    potential = lambda t, q, args: jnp.sum(stiffness * q**2 / 2 + cubic * q**4 / 4)
    system = dps.MechanicalSystem(UNIT, potential, dps.ConstantDamping(friction))
    return system, (jnp.array([1.5]), jnp.zeros(1))


def masses(parameters):
    (strength,), n = parameters, 13
    K = 2 * jnp.eye(n) - jnp.eye(n, k=1) - jnp.eye(n, k=-1)
    potential = lambda t, q, args: 50 * q @ K @ q - jnp.sum(q) * jnp.sin(6 * t)
    system = dps.MechanicalSystem(UNIT, potential, dps.ViscousDamping(strength * K))
    return system, (jnp.zeros(n), jnp.full(n, 0.1))


def chain(parameters):
    n = 100
    rates = jnp.zeros(n).at[jnp.array([0, n - 1])].set(parameters)
    potential = lambda t, q, args: jnp.sum(jnp.diff(q, prepend=0, append=0) ** 2) / 2
    system = dps.MechanicalSystem(UNIT, potential, dps.ViscousDamping(rates))
    return system, (jnp.exp(-((jnp.arange(n) - 30.0) ** 2) / 20), jnp.zeros(n))


IRREGULAR = np.sort(np.random.default_rng(1).uniform(0.0, 25.0, 150))
# The system of some parameters, these, the times, and the longest step.
PROBLEMS = {
    "oscillator": (oscillator, [0.15, 2.0, 0.5], IRREGULAR, 0.5),
    "masses": (masses, [0.3], np.linspace(0.0, 4.0, 401), 0.01),
    "chain of 100": (chain, [0.5, 0.3], np.linspace(0.0, 100.0, 101), 0.5),
}


def saved(build, ts, dt0, adjoint, parameters):
    system, y0 = build(parameters)
    sol: Any = dfx.diffeqsolve(
        *(system, SOLVER, 0.0, float(ts[-1]), dt0, y0),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        adjoint=adjoint,
        max_steps=1000,
    )
    return sol.ys[0]


def main():
    args = command_line(__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    titles = "solve, ms:>9.2f", "own loop:>8.1f", "Diffrax's:>9.1f", "error:>8.0e"
    table = Table("Jacobians", "problem:<12", *titles)
    for name, (build, parameters, ts, dt0) in PROBLEMS.items():
        run, at = partial(saved, build, ts, dt0), jnp.array(parameters)
        own, theirs = dps.FixedStepAdjoint("forward"), dfx.ForwardMode()
        solve = jax.jit(partial(run, dps.FixedStepAdjoint()))
        fns = {"solve": solve} | {
            key: jax.jit(jax.jacfwd(partial(run, adjoint)))
            for key, adjoint in (("own", own), ("Diffrax's", theirs))
        }
        calls = {key: partial(fn, at) for key, fn in fns.items()}
        found = interleaved(calls, 3 if args.quick else 21)
        pairs = [(solve(at + x), solve(at - x)) for x in 1e-5 * jnp.eye(at.size)]
        central = jnp.stack([(y - z) / 2e-5 for y, z in pairs], axis=-1)
        error = jnp.max(jnp.abs(found["own"].result - central))
        ratios = [found[key].over(found["solve"]) for key in ("own", "Diffrax's")]
        table.row(
            *(name, found["solve"].median * 1e3, *ratios),
            float(error / jnp.max(jnp.abs(central))),
        )


if __name__ == "__main__":
    main()
