import math
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, PyTree

from .._split import State
from ._convergence import find_steps, Solution, Trial
from ._grid import intervals


class ChosenStep(NamedTuple):
    """A constant step size, chosen by [`diffrax_presym.choose_step`][].

    **Attributes:**

    - `dt0`: the step, for `diffeqsolve`; negative if `t1 < t0`.
    - `steps`: the number of steps of the solve, for its `max_steps`.
    - `error`: the expected error, relative to the tolerance: at most 1.
    - `order`: the measured order, `nan` if errors are below rounding.
    - `claimed_order`: the order of the scheme.
    - `on_grid`: whether the step divides the spacing of `ts`, or is a multiple of it.
    - `trials`: the numbers of steps that were tried, and the errors found.

    A measured order well below that of the scheme means that the force is not smooth,
    or for a solver of Diffrax that its interpolation between steps is less accurate.
    """

    dt0: float
    steps: int
    error: float
    order: float
    claimed_order: int
    on_grid: bool
    trials: tuple[Trial, ...]

    def __str__(self) -> str:
        trials = ", ".join(f"{n} steps: {e:.1e}" for n, e in self.trials)
        order = "below rounding" if math.isnan(self.order) else f"{self.order:.1f}"
        return (
            f"dt0={self.dt0:.6g}, {self.steps} steps, expected error "
            f"{self.error:.2g} of the tolerance. Measured order {order}, that of the "
            f"scheme {self.claimed_order}. Errors over the tolerance: {trials}."
        )


def choose_step(
    term: dfx.AbstractTerm,
    solver: dfx.AbstractSolver,
    t0: ArrayLike,
    t1: ArrayLike,
    y0: State,
    *,
    rtol: float,
    atol: float,
    ts: ArrayLike | None = None,
    args: PyTree = None,
    max_steps: int = 1_000_000,
    adjoint: dfx.AbstractAdjoint | None = None,
) -> ChosenStep:
    r"""The constant step size with which a solve reaches a tolerance.

    Unlike the tolerance of `diffrax.PIDController`, which is for the error of one step,
    this one is for the error of the solution. With the norm of Diffrax, at the time $t$
    it is

    $$\Big( \frac{1}{2 n} \sum_{i=1}^{2 n} \Big( \frac{y_i(t) - \bar y_i(t)}
    {\mathtt{atol} + \mathtt{rtol} \, |\bar y_i(t)|} \Big)^2 \Big)^{1/2} \le 1,$$

    with the sum over all entries of the state, the solution $y$ and the exact one
    $\bar y$. The largest error over `ts`, or that at `t1`, is aimed at 0.4 to 1.

    The problem is solved with more and more steps, each time about twice as many. From
    the differences, by Richardson extrapolation, follow the errors and the order. Once
    three solves agree with an order and the tolerance is reached, a smaller number of
    steps is searched, whose errors are measured against the finest solve. All of this
    takes about as long as ten solves with the chosen step, and compiles once.

    The step divides the span. If `ts` are regular, on a grid that divides the span, the
    step also divides the spacing of the grid or is a multiple of it, unless this takes
    more than twice as many steps. As numbers of steps are then multiples or divisors of
    that of the grid, the error may be much smaller than aimed at.

    It needs concrete numbers, so it is called outside of `jax.jit`. It knows only what
    it is given: choose another step for another initial state or other parameters, and
    in a batch that of its most difficult member.

    !!! example

        ```text
        ts = jnp.linspace(0, 100, 201)
        problem, adjoint = (term, TunedRKN6(), 0.0, 100.0), FixedStepAdjoint()
        step = choose_step(*problem, y0, rtol=1e-6, atol=1e-6, ts=ts, adjoint=adjoint)
        sol = diffeqsolve(
            *problem, step.dt0, y0, saveat=SaveAt(ts=ts), adjoint=adjoint,
            max_steps=step.steps,
        )
        ```

    **Arguments:**

    - `term`, `solver`, `t0`, `t1`, `y0`, `args`: as in `diffeqsolve`. Solves backwards,
        with `t1 < t0`, have a negative step.
    - `rtol`, `atol`: the relative and the absolute tolerance, not negative and not
        both zero. The latter in the units of the state: entries that pass through zero
        need one.
    - `ts`: the times at which the solution will be saved, as in `SaveAt(ts=ts)`.
        Defaults to `None`, for `t1` alone.
    - `max_steps`: the largest number of steps of a trial solve. That is about four
        times the number of steps that can be chosen.
    - `adjoint`: the `adjoint` of the solve, on which solutions between steps may
        depend, such as [`diffrax_presym.FixedStepAdjoint`][]. Defaults to that of
        Diffrax.

    **Returns:**

    A [`diffrax_presym.ChosenStep`][].

    **Raises:**

    `ValueError` if an argument is not valid or is traced. `RuntimeError` if the
    tolerance cannot be reached: in this precision, because solves with more steps stop
    converging; within `max_steps`; or because no solve is finite. A solve that is not
    finite is not an error otherwise, but one with a step that is too large.
    """
    _check_concrete(term, solver, t0, t1, y0, rtol, atol, ts, args)
    tolerances = _tolerance(rtol, "rtol"), _tolerance(atol, "atol")
    if not any(tolerances):
        raise ValueError(
            "`choose_step` needs a positive tolerance, but got `rtol=0` and `atol=0`. "
            "Write for example `rtol=1e-6, atol=1e-6`."
        )
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ValueError(
            "`choose_step(max_steps=...)` must be a positive integer, but got "
            f"{max_steps!r}."
        )
    t0, t1, ts = as_times(t0, t1, ts, "choose_step")
    grid = 1 if ts is None else intervals(ts, t0, t1)
    span = np.float64(t1) - np.float64(t0)
    # Times and the step in one precision: the step must not promote the state.
    step_of = lambda n: jnp.asarray(span / n, t0.dtype)
    times = jax.tree.map(jnp.asarray, (t0, t1, ts))
    adjoint = dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint

    def solve(n: int) -> Solution:
        ys, finite = _solve(term, solver, times, step_of(n), y0, args, adjoint)
        return Solution.of(n, ys, finite)

    order: Any = solver.order(term)
    (steps, error), convergence = find_steps(
        solve, type(solver).__name__, order, tolerances, grid, max_steps
    )
    return ChosenStep(
        dt0=float(step_of(steps)),
        steps=steps,
        error=error,
        order=convergence.order,
        claimed_order=order,
        on_grid=grid is not None and (steps % grid == 0 or grid % steps == 0),
        trials=tuple(convergence.trials),
    )


@eqx.filter_jit
def _solve(term, solver, times, dt0, y0, args, adjoint):
    t0, t1, ts = times
    sol = dfx.diffeqsolve(
        *(term, solver, t0, t1, dt0, y0, args),
        saveat=dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts),
        adjoint=adjoint,
        max_steps=None,
        throw=False,
    )
    return sol.ys, sol.result == dfx.RESULTS.successful


def _check_concrete(*values):
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(values)):
        raise ValueError(
            "`choose_step` solves the problem several times, and needs concrete "
            "numbers, but got traced ones. Call it outside of `jax.jit`, `jax.grad` "
            "and `jax.vmap`, and pass its `dt0` to the transformed function."
        )


def _tolerance(x, name: str) -> float:
    try:
        value = float(x)
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value < math.inf:
        raise ValueError(
            f"`choose_step({name}=...)` must be a number that is not negative, but got "
            f"{x!r}."
        )
    return value


def as_times(t0, t1, ts, name: str):
    """The times in the precision in which `diffeqsolve` takes them, checked."""
    given = [t for t in (t0, t1, ts) if t is not None]
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*given)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    t0, t1 = np.asarray(t0, dtype), np.asarray(t1, dtype)
    if t0.shape or t1.shape or not np.isfinite(t1 - t0) or t0 == t1:
        raise ValueError(
            f"`{name}` needs two different finite times `t0` and `t1`, but got "
            f"{t0} and {t1}."
        )
    if ts is None:
        return t0, t1, None
    ts = np.asarray(ts, dtype)
    if ts.ndim != 1 or not ts.size:
        raise ValueError(
            f"`{name}(ts=...)` must be an array of times of shape `(times,)`, but "
            f"has shape {ts.shape}. For `t1` alone write `ts=None`."
        )
    direction = np.sign(t1 - t0)
    if not np.all(direction * np.diff(ts) >= 0):
        raise ValueError(
            f"`{name}(ts=...)` must be sorted in the direction from `t0` to `t1`. "
            f"Write `ts=jnp.sort(ts){'' if direction > 0 else '[::-1]'}`."
        )
    outside = ~((direction * ts >= direction * t0) & (direction * ts <= direction * t1))
    if np.any(outside):
        raise ValueError(
            f"`{name}(ts=...)` must lie between `t0` and `t1`, {t0} and {t1}, but "
            f"has {ts[outside][0]}."
        )
    return t0, t1, ts
