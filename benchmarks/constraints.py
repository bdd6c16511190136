"""Chains of links in the plane, in Cartesian coordinates with constraints.

Time per step against the number of links, of `Strang` (RATTLE) with the matrix of all
multipliers and with its three diagonals, `lineax.Tridiagonal()`, and of a gradient by
reversal; then the time to an error of a chain of ten links beside the same chain in
angles, with `PresymplecticGauss` and Diffrax's `Dopri8`. `--quick` measures fewer.
"""

import argparse
import time
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
jax.config.update("jax_enable_x64", True)
GRAVITY = 9.81


def links(t, q, args):
    """The squared lengths of the links, less one, from the point of support."""
    each = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0)
    return jnp.sum(each**2, axis=1) - 1


def chain(solver=None):
    weight = lambda t, q, args: GRAVITY * jnp.sum(q[:, 1])
    friction = dps.ConstantDamping(0.1)
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), weight, friction)
    return dps.ConstrainedSystem(free, links, linear_solver=solver)


def positions(angles):
    links = jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=1)
    return jnp.cumsum(links, axis=0)


def at_rest(n):
    q = positions(jnp.linspace(1.0, 1.5, n))
    return q, jnp.zeros_like(q)


def in_angles(n):
    def mass(t, q, args):
        below = n - np.maximum.outer(np.arange(n), np.arange(n))
        return below * jnp.cos(q[:, None] - q[None, :])

    weight = lambda t, q, args: -GRAVITY * jnp.sum((n - np.arange(n)) * jnp.cos(q))
    return dps.LagrangianSystem(mass, weight, dps.ConstantDamping(0.1))


def fastest(fn, *args, repeat=3):
    jax.block_until_ready(fn(*args))
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        jax.block_until_ready(fn(*args))
        times.append(time.perf_counter() - start)
    return min(times)


def end(system, solver, y0, t1, steps):
    return diffeqsolve(
        *(system, solver, 0.0, t1, t1 / steps, y0),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    ).ys


def scaling(numbers, steps=200, h=1e-3):
    print("microseconds per step of Strang")
    print(f"{'links':>6} {'matrix':>9} {'diagonals':>10} {'gradient':>9}")
    for n in numbers:
        cells = []
        for solver in (None, lx.Tridiagonal()):
            if solver is None and n > 200:
                cells.append(np.nan)
                continue
            solve = lambda y0, s=solver: end(
                chain(s), dps.Strang(), y0, steps * h, steps
            )
            cells.append(fastest(jax.jit(solve), at_rest(n)))
        loss = lambda y0: jnp.sum(
            end(chain(lx.Tridiagonal()), dps.Strang(), y0, steps * h, steps)[0]
        )
        cells.append(fastest(jax.jit(jax.grad(loss)), at_rest(n)))
        times = [f"{1e6 * x / steps:.0f}" for x in cells]
        print(f"{n:6d} {times[0]:>9} {times[1]:>10} {times[2]:>9}", flush=True)


def work_precision(n=10, t1=2.0):
    angles = in_angles(n)
    start = jnp.linspace(1.0, 1.5, n), jnp.zeros(n)
    exact = positions(end(angles, dps.PresymplecticGauss(6), start, t1, 800)[0][-1])
    print(f"\nchain of {n} links, {t1} s: milliseconds, error of the positions")
    rows = [
        ("SofroniouSpaletta 6 of Strang", dps.SofroniouSpaletta(6, dps.Strang())),
        ("Suzuki4 of Strang", dps.Suzuki4(dps.Strang())),
        ("BlanesMoan4", dps.BlanesMoan4()),
    ]
    for name, solver in rows:
        for steps in (25, 50, 100, 200):
            solve = jax.jit(
                lambda y0, s=solver, k=steps: end(
                    chain(lx.Tridiagonal()), s, y0, t1, k
                )[0][-1]
            )
            error = np.max(np.abs(solve(at_rest(n)) - exact))
            print(f"{name:32} {1e3 * fastest(solve, at_rest(n)):8.1f} {error:9.1e}")
    for steps in (50, 100, 200):
        solve = jax.jit(
            lambda y0, k=steps: positions(
                end(angles, dps.PresymplecticGauss(4), y0, t1, k)[0][-1]
            )
        )
        error = np.max(np.abs(solve(start) - exact))
        print(
            f"{'angles, PresymplecticGauss(4)':32} {1e3 * fastest(solve, start):8.1f} "
            f"{error:9.1e}"
        )
    for tolerance in (1e-5, 1e-7, 1e-9):
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        solve = jax.jit(
            lambda y0, c=controller: positions(
                diffeqsolve(
                    *(angles, dfx.Dopri8(), 0.0, t1, 0.01, y0),
                    stepsize_controller=c,
                    max_steps=100_000,
                ).ys[0][-1]
            )
        )
        error = np.max(np.abs(solve(start) - exact))
        print(f"{'angles, Dopri8':32} {1e3 * fastest(solve, start):8.1f} {error:9.1e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    scaling([25, 50, 100] if quick else [25, 50, 100, 200, 400, 800])
    if not quick:
        work_precision()


if __name__ == "__main__":
    main()
