"""The solves of the benchmarks, in double precision, and the reference solution."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

LAST = dfx.SaveAt(t1=True)
CONSTANT = dfx.ConstantStepSize()
# A motion that escapes would never end.
MOST = 10**5


def solve(
    *problem,
    controller: dfx.AbstractStepSizeController = CONSTANT,
    saveat=LAST,
    **options,
) -> dfx.Solution:
    """`diffeqsolve`; a failure is a result."""
    options = {"max_steps": None, "throw": False, "saveat": saveat} | options
    return dfx.diffeqsolve(*problem, stepsize_controller=controller, **options)


def last(sol) -> Any:
    """The final state of a solve."""
    return jax.tree.map(lambda y: y[-1], sol.ys)


def states(
    term,
    solver,
    times,
    y0,
    x,
    args=None,
    *,
    adaptive=False,
    density=None,
    count=False,
    **options,
) -> Any:
    """What is saved in `x` equal steps, or in adaptive ones with tolerance `x`: by
    default the final state; if they `count`, also how many steps it took, and how many
    values between these are interpolated.

    Solvers of this package run in the loop of `FixedStepAdjoint`. With a step density
    the steps vary, and the first is one of `x` equal ones. The result is not a number
    where the solve failed.
    """
    t0, t1 = times
    dt0 = None if adaptive else (t1 - t0) / x
    if adaptive:
        options["controller"] = dfx.PIDController(rtol=x, atol=x)
        options["max_steps"] = MOST
    elif density is not None:
        epsilon, dt0 = dt0 / density(t0, y0, args), None
        options["controller"] = dps.StepDensityController(epsilon, density)
        options["max_steps"] = MOST
    if isinstance(solver, dps.extend.AbstractPresymplecticSolver) and not adaptive:
        options.setdefault("adjoint", dps.FixedStepAdjoint())
    sol = solve(term, solver, t0, t1, dt0, y0, args, **options)
    good = sol.result == dfx.RESULTS.successful
    ys = sol.ys if "saveat" in options else last(sol)
    ys = jax.tree.map(lambda y: jnp.where(good, y, jnp.nan), ys)
    if not count:
        return ys
    # No constant beside it: one makes Diffrax's solves with saved times slower.
    return ys, sol.stats["num_steps"], sol.stats.get("interpolated")


def relative_error(y, exact):
    """The largest error, relative to the largest entry of the solution."""
    y, exact = (
        np.concatenate([*map(np.ravel, jax.tree.leaves(x))]) for x in (y, exact)
    )
    return np.max(np.abs(y - exact)) / np.max(np.abs(exact))


def integrated(rates, y0, t1) -> Any:
    """The solution at `t1` of `y' = rates(t, y, args)`, by SciPy's DOP853: quicker to
    compile than `reference`, and less accurate, about 1e-12."""
    flat, unravel = ravel_pytree(y0)
    slope = jax.jit(lambda t, y: ravel_pytree(rates(t, unravel(y), None))[0])
    field = lambda t, y: np.asarray(slope(t, y))
    options: Any = {"method": "DOP853", "rtol": 3e-14, "atol": 1e-14}
    ys = scipy.integrate.solve_ivp(field, (0.0, t1), flat, **options).y
    return unravel(jnp.asarray(ys[:, -1]))


def reference_end(system, y0, t0, t1, args=None, **options) -> Any:
    """The solution at `t1`, by `reference`."""
    ys = reference(system, y0, [t0, t1], args, **options)
    return jax.tree.map(lambda y: y[0], ys)


def reference(
    system, y0, times, args=None, *, tolerance=1e-12, batch=False, longest=0.25
) -> Any:
    """The solution at all times after the first, independent of what is measured.

    A `batch` of initial states has a leading axis, and so has its solution.

    Gragg, Bulirsch and Stoer's extrapolation of order 10, with compensated summation.
    Steps are halved until the solution changes by less than `tolerance`, relative to
    its largest entry. The finer one is returned, so that its error is of rounding:
    measured against extended precision below 4e-15 on the problems of `problems.py`,
    and 1e-14 to 2e-13 on the Kepler problem, whose orbit amplifies it.
    """
    y0, times = jax.tree.map(jnp.asarray, y0), jnp.asarray(times)
    axes = (None, 0, None, None, None)
    solution = eqx.filter_vmap(_extrapolated, in_axes=axes) if batch else _extrapolated
    solution = eqx.filter_jit(solution)
    # Steps end at the times, so that longer ones would not differ when halved.
    longest = min(longest, float(np.min(np.diff(times))))
    least, change = longest / 2500, np.inf
    ys = solution(system, y0, times, args, longest)
    while not change < tolerance:
        longest /= 2
        if longest < least:
            raise RuntimeError(f"No reference solution: halving changes it by {change}")
        before, ys = ys, solution(system, y0, times, args, longest)
        change = relative_error(before, ys)
    return ys


LEVELS = 5


def _extrapolated(system, y0, times, args, longest):
    y0, unravel = ravel_pytree(y0)
    slope = lambda t, y: ravel_pytree(system.vf(t, unravel(y), args))[0]

    def modified_midpoint(t, t_next, y, low, n):
        # In terms of the change from `y`, to round it and not `y` itself. Numbers of
        # substeps are powers of two, which divide the step exactly.
        s = (t_next - t) / n

        def substep(k, state):
            before, now = state
            return now, before + 2 * s * slope(t + k * s, y + (now + low))

        state = jnp.zeros_like(y), s * slope(t, y + low)
        before, now = jax.lax.fori_loop(1, n, substep, state)
        return (before + now + s * slope(t_next, y + (now + low))) / 2

    def step(state, t_end):
        t, y, low = state
        t_next = jnp.minimum(t + longest, t_end)
        table = [modified_midpoint(t, t_next, y, low, 2 << k) for k in range(LEVELS)]
        for j in range(1, LEVELS):
            for k in range(LEVELS - 1, j - 1, -1):
                table[k] = table[k] + (table[k] - table[k - 1]) / (4**j - 1)
        change = table[-1] + low
        return t_next, y + change, change - ((y + change) - y)

    def advance(state, t_end):
        going = lambda state: state[0] < t_end
        state = jax.lax.while_loop(going, lambda s: step(s, t_end), state)
        return state, state[1]

    start = times[0], y0, jnp.zeros_like(y0)
    return jax.vmap(unravel)(jax.lax.scan(advance, start, times[1:])[1])
