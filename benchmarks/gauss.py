"""Gauss collocation for nonseparable energies: time of a solve against its error.

Double pendulum and chain of three hinges with friction in each joint, and
H = (q^2 + 1) (p^2 + 1) / 2; with `PresymplecticCoupled` and Diffrax's `Dopri8`. A dash
is an error that none of the runs reached. The last two rows are ratios of best times.
"""

from functools import partial

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import final_state, reference, relative_error
from _timing import error_curves, time_to

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
GRAVITY = 9.81


def chain_mass(t, q, args):
    """Links of unit length and mass, angles measured from the vertical."""
    n = len(q)
    below = n - np.maximum.outer(np.arange(n), np.arange(n))
    return below * jnp.cos(q[:, None] - q[None, :])


def chain_potential(t, q, args):
    n = len(q)
    return -GRAVITY * jnp.sum((n - np.arange(n)) * jnp.cos(q))


def mixed_energy(t, q, p, args):
    return jnp.sum((q**2 + 1) * (p**2 + 1)) / 2


def chain(n):
    system = dps.LagrangianSystem(chain_mass, chain_potential, friction=0.1)
    return system, (jnp.linspace(1.0, 1.5, n), jnp.zeros(n)), 10.0


PROBLEMS = {
    "double pendulum": chain(2),
    "chain of 3": chain(3),
    "(q^2 + 1)(p^2 + 1)/2": (
        dps.Hamiltonian(mixed_energy),
        (jnp.array([-3.0]), jnp.array([0.0])),
        20.0,
    ),
}
FIXED = {
    **{f"Gauss({s})": (dps.PresymplecticGauss(s), 8 * s) for s in (2, 3, 4, 5, 6, 8)},
    "Coupled(4)": (dps.PresymplecticCoupled(4), 11),
    "Coupled(6)": (dps.PresymplecticCoupled(6), 27),
}
TOLERANCES = 10.0 ** -np.arange(2, 14)


def curves(system, times, y0, exact, repeats, quick):
    """The errors and times of every solver, by its name."""
    span = times[1] - times[0]
    solve = eqx.filter_jit(final_state)

    def run(solver, sweep, adaptive=False):
        return partial(solve, system, solver, times, y0, adaptive=adaptive), sweep

    most, points = (4e3, 4) if quick else (3e4, 16)
    runs = {
        name: run(
            solver,
            [
                jnp.asarray(float(n))
                for n in np.unique(
                    np.geomspace(4 * span / 5, most / cost, points).astype(int)
                )
            ],
        )
        for name, (solver, cost) in FIXED.items()
    }
    tolerances = [jnp.asarray(tol) for tol in TOLERANCES[:: 3 if quick else 1]]
    runs["Dopri8"] = run(dfx.Dopri8(scan_kind="lax"), tolerances, True)
    return error_curves(runs, lambda y: relative_error(y, exact), repeats)


def main():
    options = command_line(__doc__).parse_args()
    for problem, (system, y0, t1) in PROBLEMS.items():
        times = jnp.array([0.0, t1])
        exact = jax.tree.map(lambda y: y[-1], reference(system, y0, times))
        repeats = 2 if options.quick else 7
        found = curves(system, times, y0, exact, repeats, options.quick)
        titles = (f"{target:.0e}:>9.2f" for target in TARGETS)
        table = Table(f"{problem}: milliseconds to an error", "solver:<14", *titles)
        for name, curve in found.items():
            table.row(name, *(_milliseconds(curve, target) for target in TARGETS))
        for other in ("Coupled", "Dopri8"):
            ratios = []
            for target in TARGETS:
                gauss, theirs = (
                    min(time_to(c, target) for n, c in found.items() if kind in n)
                    for kind in ("Gauss", other)
                )
                reached = np.isfinite(gauss) and np.isfinite(theirs)
                ratios.append(theirs / gauss if reached else None)
            table.row(f"{other} / Gauss", *ratios)


def _milliseconds(curve, target):
    seconds = time_to(curve, target)
    return 1e3 * seconds if np.isfinite(seconds) else None


if __name__ == "__main__":
    main()
