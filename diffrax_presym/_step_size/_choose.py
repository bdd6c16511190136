import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, ArrayLike, Float

from ._convergence import find_steps
from ._law import Trial
from ._solution import check_number, check_times, Solution


class ChosenStep(NamedTuple):
    """A constant step size, chosen by `choose_step`.

    **Attributes:**

    - `dt0`: the step, for the solve; negative if `t1 < t0`. An array, for which
        neither `jax.jit` nor `equinox.filter_jit` compile the solve again.
    - `steps`: the number of steps that the solve takes.
    - `error`: the expected error, relative to the tolerance: at most 1.
    - `order`: the measured order, `nan` if errors are those of rounding, or far below
        the tolerance with the fewest steps.
    - `claimed_order`: the order of the scheme, if the solve tells it: with
        `FixedStepAdjoint`; otherwise `None`.
    - `on_grid`: whether the step divides the spacing of the saved times, or is a
        multiple of it.
    - `smooth`: whether the errors of solves follow the law of convergence. If not, as
        where a force jumps inside of a step, the error of one solve says little about
        that of another, and may be larger than expected.
    - `trials`: the numbers of steps that were tried, and the errors found.
    """

    dt0: Float[Array, ""]
    steps: int
    error: float
    order: float
    claimed_order: int | None
    on_grid: bool
    smooth: bool
    trials: tuple[Trial, ...]

    def __str__(self) -> str:
        # A number of steps may have been tried twice.
        tried = sorted({trial.steps: trial.error for trial in self.trials}.items())
        show = lambda error: f"{error:.1e}" if error < math.inf else "not finite"
        trials = ", ".join(f"{n} steps: {show(error)}" for n, error in tried)
        order = "unknown" if math.isnan(self.order) else f"{self.order:.1f}"
        claim = self.claimed_order
        scheme = "" if claim is None else f", that of the scheme {claim}"
        note = (
            " The errors do not fall as those of a smooth motion, and may be larger "
            "than expected. If force or friction has kinks or jumps at known times, "
            "write `stepsize_controller=StepsBetween(times)`. At unknown times, as "
            "of a force by a mesh or a spline, values between steps suffer most: give "
            "it the saved times, if they are few. With a force that changes fast, as "
            "dry friction that is smoothed, use an adaptive solver. Of a smooth motion "
            "with few steps to a period of a drive errors may be irregular too, and "
            "with a `tolerance` of `PresymplecticGauss` that is not a hundredth of the "
            "error they cease to fall."
        )
        limit = (
            " Steps that are not much longer are unstable, or miss an event: for other "
            "parameters, as in a fit, choose the step with those of the fastest motion."
        )
        # More than by any order of convergence.
        near = [x for x in self.trials if 0.7 * self.steps <= x.steps < self.steps]
        unstable = any(x.error > 1e3 for x in near)
        return (
            f"dt0={self.dt0:.6g}, {self.steps} steps, expected error "
            f"{self.error:.2g} of the tolerance. Measured order {order}{scheme}. "
            f"Errors over the tolerance: {trials}.{'' if self.smooth else note}"
            f"{limit if unstable else ''}"
        )


def choose_step(
    solve: Callable[[Float[Array, ""]], Any],
    t0: ArrayLike,
    t1: ArrayLike,
    *,
    rtol: float,
    atol: float,
    first: ArrayLike | None = None,
    max_steps: int = 1_000_000,
    on_trial: Callable[[Trial], Any] | None = None,
) -> ChosenStep:
    """The constant step size with which a solve reaches a tolerance, per entry of the
    solution.

    Unlike the tolerance of `diffrax.PIDController`, which is for the error of one step,
    this one is for the error of the solution: of each entry of all that is saved,
    `|y - y2| ≤ atol + rtol |y2|` with the exact `y2`. The largest error relative to
    that is aimed at 0.4 to 1.

    `solve` is any function from a step to a `diffrax.Solution`: with any solver, any
    wrapper, `SaveAt`, arguments and events, of which times are compared too. Under
    `jax.jit` it is compiled once, for the choice and for its use.

    The problem is solved with more and more steps, each time about twice as many, until
    three solves agree with an order, by Richardson extrapolation, and the tolerance is
    reached. One or two more solves then have to confirm that errors fall as those of a
    smooth motion, with steps that have another phase; if they do not, the steps are
    doubled once more, and the result has a note: `ChosenStep` with `smooth=False`. Then
    a smaller number of steps is searched, whose errors are measured against the finest
    solve: about as long as ten solves with the chosen step.

    A parameter that scales steps is found in the same way, such as `epsilon` of
    `StepDensityController`: what `solve` is given is then not a step, but the number of
    steps that it takes falls as that grows. Say where to begin: `first=1.0`.

    The step divides the span. A saved time inside of a step costs a step more, or a
    third of one if `FixedStepAdjoint` interpolates it. So if the saved times are on a
    grid that divides the span, and steps that end at all of them cost no more, such a
    step is chosen. The error may then be much smaller than aimed at.

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
    - `first`: of a parameter that is not a step, the value that is tried first, one for
        which a solve takes few steps, or fails. Defaults to a quarter of `t1 - t0`.
    - `max_steps`: the largest number of steps of a trial solve. That is about four
        times the number of steps that can be chosen. If three doublings in succession,
        from 2000 steps or a 500th of it on, bring the tolerance no closer, it is an
        error before that.
    - `on_trial`: a function that is called with each trial as soon as its error is
        known. Write `on_trial=print` to see them all. Defaults to none.

    **Returns:**

    A `ChosenStep`.

    **Raises:**

    `ValueError` if an argument or the solution is not valid or is traced, or if the
    solve does not use its step. `RuntimeError` if the
    tolerance cannot be reached: in this precision, because solves with more steps stop
    converging; within `max_steps`; or because no solve is finite. A solve that fails
    or is not finite is not an error otherwise, but one with a step that is too large;
    other errors of the solve are raised as they are.
    """
    if not callable(solve):
        raise ValueError(
            "`choose_step` needs a function from a step to a solution, but got "
            f"{solve!r}. Write `choose_step(solve, t0, t1, rtol=..., atol=...)` with "
            "`solve = lambda dt0: diffeqsolve(system, solver, t0, t1, dt0, y0, ...)`."
        )
    t0, t1 = check_times(t0, t1, "choose_step")
    tolerances = (
        check_number(rtol, "choose_step(rtol=...)"),
        check_number(atol, "choose_step(atol=...)"),
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
    trials: list[Trial] = []

    def report(trial: Trial):
        trials.append(trial)
        if on_trial is not None:
            on_trial(trial)

    start = (t1 - t0) / 4
    if first is not None:
        start = check_number(first, "choose_step(first=...)", positive=True)
    length = lambda n: jax.device_put(4 * start / n)
    run = lambda n: Solution.of(n, solve, length(n))
    best, order, claimed, smooth, grid = find_steps(
        run, (t0, t1), tolerances, max_steps, report
    )
    every = grid.intervals
    return ChosenStep(
        dt0=length(best.number),
        steps=best.steps,
        error=best.error,
        order=order,
        claimed_order=claimed,
        on_grid=bool(every) and (best.number % every == 0 or every % best.number == 0),
        smooth=smooth,
        trials=tuple(trials),
    )
