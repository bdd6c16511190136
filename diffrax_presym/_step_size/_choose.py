import math
from collections.abc import Callable
from itertools import takewhile
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ._convergence import doubling, find_steps, Solution, Trial
from ._grid import intervals


class ChosenStep(NamedTuple):
    """A constant step size, chosen by [`diffrax_presym.choose_step`][].

    **Attributes:**

    - `dt0`: the step, for the solve; negative if `t1 < t0`. An array, for which
        neither `jax.jit` nor `equinox.filter_jit` compile the solve again.
    - `steps`: the number of steps that the solve takes.
    - `error`: the expected error, relative to the tolerance: at most 1.
    - `order`: the measured order, `nan` if errors are below rounding.
    - `claimed_order`: the order of the scheme, if the solve tells it: with
        [`diffrax_presym.FixedStepAdjoint`][]; otherwise `None`.
    - `on_grid`: whether the step divides the spacing of the saved times, or is a
        multiple of it.
    - `trials`: the numbers of steps that were tried, and the errors found.
    """

    dt0: Float[Array, ""]
    steps: int
    error: float
    order: float
    claimed_order: int | None
    on_grid: bool
    trials: tuple[Trial, ...]

    def __str__(self) -> str:
        # A number of steps may have been tried twice.
        tried = sorted({trial.steps: trial.error for trial in self.trials}.items())
        show = lambda error: f"{error:.1e}" if error < math.inf else "not finite"
        trials = ", ".join(f"{n} steps: {show(error)}" for n, error in tried)
        order = "below rounding" if math.isnan(self.order) else f"{self.order:.1f}"
        claim = self.claimed_order
        scheme = "" if claim is None else f", that of the scheme {claim}"
        note = ""
        if claim is not None and self.order < claim / 2 and claim > 2:
            note = (
                " The order is lower than that of the scheme: the force or the "
                "friction is not smooth. If it has kinks or jumps at known times, "
                "write `stepsize_controller=StepsBetween(times)`."
            )
        return (
            f"dt0={self.dt0:.6g}, {self.steps} steps, expected error "
            f"{self.error:.2g} of the tolerance. Measured order {order}{scheme}. "
            f"Errors over the tolerance: {trials}.{note}"
        )


def choose_step(
    solve: Callable[[Float[Array, ""]], Any],
    t0: ArrayLike,
    t1: ArrayLike,
    *,
    rtol: float,
    atol: float,
    max_steps: int = 1_000_000,
) -> ChosenStep:
    r"""The constant step size with which a solve reaches a tolerance, per entry of the
    solution.

    Unlike the tolerance of `diffrax.PIDController`, which is for the error of one step,
    this one is for the error of the solution: of each entry of all that is saved,
    $|y - \bar y| \le \mathtt{atol} + \mathtt{rtol} \, |\bar y|$ with the exact
    $\bar y$. The largest error relative to that is aimed at 0.4 to 1.

    `solve` is any function from a step to a `diffrax.Solution`: with any solver, any
    wrapper, `SaveAt`, arguments and events, of which times are compared too. Under
    `jax.jit` it is compiled once, for the choice and for its use.

    The problem is solved with more and more steps, each time about twice as many, until
    three solves agree with an order, by Richardson extrapolation, and the tolerance is
    reached. Then a smaller number of steps is searched, whose errors are measured
    against the finest solve: about as long as ten solves with the chosen step.

    The step divides the span. If the saved times are on a grid that divides the span,
    the step also divides the spacing of the grid or is a multiple of it, unless this
    takes more than twice as many steps. The error may then be much smaller than aimed
    at.

    It needs concrete numbers, so it is called outside of `jax.jit`. It knows only the
    solve that it is given: for other parameters choose another step, and in a batch
    that of its most difficult member.

    !!! example

        ```python
        system = MechanicalSystem(
            QuadraticKinetic(), lambda t, q, args: -jnp.sum(jnp.cos(q))
        )

        @jax.jit
        def solve(dt0):
            return diffeqsolve(
                system, TunedRKN6(), 0.0, 20.0, dt0, (jnp.ones(1), jnp.zeros(1)),
                adjoint=FixedStepAdjoint(), max_steps=None,
            )

        step = choose_step(solve, 0.0, 20.0, rtol=1e-4, atol=1e-4)
        sol = solve(step.dt0)
        ```

    **Arguments:**

    - `solve`: a function of the step `dt0`, a scalar with the sign of `t1 - t0`, that
        returns a `diffrax.Solution`. It should be jitted, and allow enough steps:
        `max_steps=None`.
    - `t0`, `t1`: the start and the end of the solve.
    - `rtol`, `atol`: the relative and the absolute tolerance, not negative and not
        both zero. The latter in the units of the state: entries that pass through zero
        need one.
    - `max_steps`: the largest number of steps of a trial solve. That is about four
        times the number of steps that can be chosen.

    **Returns:**

    A [`diffrax_presym.ChosenStep`][].

    **Raises:**

    `ValueError` if an argument is not valid or is traced. `RuntimeError` if the
    tolerance cannot be reached: in this precision, because solves with more steps stop
    converging; within `max_steps`; or because no solve is finite. A solve that fails
    or is not finite is not an error otherwise, but one with a step that is too large.
    """
    if not callable(solve):
        raise ValueError(
            "`choose_step` needs a function from a step to a solution, but got "
            f"{solve!r}. Write `choose_step(solve, t0, t1, rtol=..., atol=...)` with "
            "`solve = lambda dt0: diffeqsolve(system, solver, t0, t1, dt0, y0, ...)`."
        )
    t0, t1 = check_times(t0, t1, "choose_step")
    tolerances = (
        check_tolerance(rtol, "choose_step(rtol=...)"),
        check_tolerance(atol, "choose_step(atol=...)"),
    )
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
    length = lambda n: jax.device_put((t1 - t0) / n)
    run = lambda n: Solution.of(n, solve, length(n))
    # Of a solve that fails, the saved times are not known.
    tried = map(run, takewhile(lambda n: n <= max_steps, doubling(4)))
    first = next((x for x in tried if x.finite), None)
    grid = None
    if first is not None:
        if not np.all(np.abs(first.ts - t0) <= abs(t1 - t0) * (1 + 1e-6)):
            raise ValueError(
                f"`choose_step(solve, t0, t1)` needs the times of the solve, but got "
                f"{t0} and {t1}, and the solve saves at times up to "
                f"{np.max(np.abs(first.ts - t0)):.6g} from `t0`."
            )
        grid = intervals(first.ts, t0, t1)
    best, convergence = find_steps(run, tolerances, grid, max_steps)
    return ChosenStep(
        dt0=length(best.number),
        steps=best.steps,
        error=best.error,
        order=convergence.order,
        claimed_order=convergence.claimed,
        on_grid=grid is not None
        and (best.number % grid == 0 or grid % best.number == 0),
        trials=tuple(convergence.trials),
    )


def check_times(t0, t1, name: str) -> tuple[float, float]:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((t0, t1))):
        raise ValueError(
            f"`{name}` solves the problem several times, and needs concrete numbers, "
            "but got traced ones. Call it outside of `jax.jit`, `jax.grad` and "
            "`jax.vmap`, and pass its result to the transformed function."
        )
    if np.shape(t0) or np.shape(t1) or not np.isfinite(t1 - t0) or t0 == t1:
        raise ValueError(
            f"`{name}` needs two different finite times `t0` and `t1`, but got "
            f"{t0} and {t1}."
        )
    return float(t0), float(t1)


def check_tolerance(x, name: str) -> float:
    try:
        value = float(x)
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value < math.inf:
        raise ValueError(
            f"`{name}` must be a number that is not negative, but got {x!r}."
        )
    return value
