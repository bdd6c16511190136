"""Gauss collocation for energies that do not separate: speed against error.

Double pendulum and chain of three hinges with friction in each joint, and
H = (q^2 + 1) (p^2 + 1) / 2. Each table holds the least time of a solve, in
milliseconds, with an error at the final time of at most that in the column, relative to
the largest entry of the solution; "-" where none of the runs is so accurate. Times are
the least of several, compiled and warmed up, of all solvers alternately.
"""

import argparse
import time
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

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


@eqx.filter_jit
def solve(system, solver, t1, dt0, y0, controller):
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(system),
        solver,
        *(0.0, t1, dt0, y0),
        stepsize_controller=controller,
        max_steps=None,
        throw=False,
    )
    return ravel_pytree(sol.ys)[0], sol.result == dfx.RESULTS.successful


def runs(t1, most) -> dict[str, list[Any]]:
    """`{name: [(solver, dt0, controller), ...]}`, from long steps to short ones."""
    found: dict[str, list[Any]] = {
        name: [
            (solver, t1 / n, dfx.ConstantStepSize())
            for n in np.unique(np.geomspace(4 * t1 / 5, most / cost, 16).astype(int))
        ]
        for name, (solver, cost) in FIXED.items()
    }
    dopri = dfx.Dopri8(scan_kind="lax")
    found["Dopri8"] = [
        (dopri, 0.01, dfx.PIDController(rtol=tol, atol=tol)) for tol in TOLERANCES
    ]
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--most", type=float, default=3e4, help="evaluations of a run")
    options = parser.parse_args()
    for problem, (system, y0, t1) in PROBLEMS.items():
        controller = dfx.PIDController(rtol=1e-14, atol=1e-14)
        exact = np.asarray(solve(system, dfx.Dopri8(), t1, 0.01, y0, controller)[0])
        check = dps.PresymplecticGauss(8)
        finest = jnp.asarray(t1 / 1000)
        other, _ = solve(system, check, t1, finest, y0, dfx.ConstantStepSize())
        size = np.max(np.abs(exact))
        print(f"\n{problem}; references differ by {np.max(np.abs(other - exact)):.0e}")
        errors, times = {}, {}
        sweeps = runs(t1, options.most)
        for name, sweep in sweeps.items():
            for i, (solver, dt0, controller) in enumerate(sweep):
                args = system, solver, t1, jnp.asarray(dt0), y0, controller
                y, solved = jax.block_until_ready(solve(*args))
                if solved:
                    errors[name, i] = np.max(np.abs(np.asarray(y) - other)) / size
                    times[name, i] = np.inf
                sweep[i] = args
        for _ in range(options.repeats):
            for name, i in errors:
                start = time.perf_counter()
                jax.block_until_ready(solve(*sweeps[name][i]))
                spent = time.perf_counter() - start
                times[name, i] = min(times[name, i], spent)
        print(f"{'milliseconds to':16}" + "".join(f"{x:>10.0e}" for x in TARGETS))
        best = {}
        for name in sweeps:
            row = f"  {name:14}"
            for x in TARGETS:
                least = [times[k] for k in errors if k[0] == name and errors[k] <= x]
                best[name, x] = min(least, default=np.inf)
                row += f"{1e3 * best[name, x]:>10.2f}" if least else f"{'-':>10}"
            print(row)
        gauss = [min(best[n, x] for n in sweeps if "Gauss" in n) for x in TARGETS]
        for other_name in ("Coupled", "Dopri8"):
            others = [
                min(best[n, x] for n in sweeps if other_name in n) for x in TARGETS
            ]
            ratios = (f"{b / a:>10.1f}" for a, b in zip(gauss, others, strict=True))
            print(f"  {other_name + '/Gauss':14}" + "".join(ratios))
        jax.clear_caches()


if __name__ == "__main__":
    main()
