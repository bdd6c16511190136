import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, PyTree

from .._split import State
from ._grid import intervals


# The error that is aimed at, and that with which the search ends, over the tolerance.
AIM, ENOUGH = 0.6, 0.4


class Trial(NamedTuple):
    """A solve made to choose a step."""

    steps: int
    # The estimated error over the tolerance; infinite if the solve is not finite.
    error: float


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

    A measured order well below that of the scheme means that errors are dominated by
    the interpolation between steps, or that the force is not smooth.
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
    it is given: choose a step anew for another initial state or other parameters, or
    for the most difficult one of a batch.

    !!! example

        ```python
        ts = jnp.linspace(0, 100, 201)
        step = choose_step(
            term, TunedRKN6(), 0.0, 100.0, y0, rtol=1e-6, atol=1e-6, ts=ts
        )
        sol = diffeqsolve(
            term, TunedRKN6(), 0.0, 100.0, step.dt0, y0,
            saveat=SaveAt(ts=ts), max_steps=step.steps,
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
    - `adjoint`: the `adjoint` of the solve, if solutions between steps depend on it.
        Defaults to that of Diffrax.

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
    t0, t1, ts = _times(t0, t1, ts)
    # Times on a much finer grid only, such as 0.3 and 7.7, are irregular.
    grid = 1 if ts is None else intervals(ts, t0, t1, min(4 * ts.size + 4, max_steps))
    span = np.float64(t1) - np.float64(t0)
    # Times and the step in one precision: the step must not promote the state.
    step_of = lambda n: jnp.asarray(span / n, t0.dtype)
    times = jax.tree.map(jnp.asarray, (t0, t1, ts))
    adjoint = dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint

    def solve(n: int) -> "Solution":
        ys, finite = _solve(term, solver, times, step_of(n), y0, args, adjoint)
        return Solution(n, [np.asarray(y) for y in jax.tree.leaves(ys)], bool(finite))

    order: Any = solver.order(term)
    convergence = _Convergence(solver, order, tolerances, max_steps)
    for n in _numbers(1 if grid is None else grid):
        if n > max_steps:
            raise RuntimeError(convergence.exceeds())
        if convergence.add(solve(n)):
            break

    steps, error = _smallest(convergence, solve, grid)
    return ChosenStep(
        dt0=float(step_of(steps)),
        steps=steps,
        error=error,
        order=convergence.order,
        claimed_order=order,
        on_grid=grid is not None and (steps % grid == 0 or grid % steps == 0),
        trials=tuple(convergence.trials),
    )


class Solution(NamedTuple):
    steps: int
    # With a leading axis of saved times.
    leaves: list[np.ndarray]
    finite: bool


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
    finite = [jnp.all(jnp.isfinite(y)) for y in jax.tree.leaves(sol.ys)]
    return sol.ys, jnp.all(jnp.stack(finite)) & (sol.result == dfx.RESULTS.successful)


def scaled_error(
    leaves: list[np.ndarray], exact: list[np.ndarray], rtol: float, atol: float
) -> float:
    """The largest error over all times, in the norm of Diffrax, over the tolerance."""
    squares, count = 0.0, 0
    for y, y_exact in zip(leaves, exact, strict=True):
        y_exact = np.asarray(y_exact, float)
        error = np.abs(np.asarray(y, float) - y_exact)
        scale = atol + rtol * np.abs(y_exact)
        # Where both vanish, as for a coordinate at rest, there is no error.
        scaled = np.divide(
            *(error, scale), out=np.where(error > 0, np.inf, 0.0), where=scale > 0
        )
        squares = squares + np.sum(scaled.reshape(len(y), -1) ** 2, axis=1)
        count += scaled[0].size
    return float(np.sqrt(np.max(squares) / count))


class _Convergence:
    """The differences of solves with more and more steps, and what follows from them.

    Of the solutions only the last is kept.
    """

    def __init__(self, solver, order, tolerances, max_steps):
        self.solver, self.claimed, self.max_steps = solver, order, max_steps
        self.tolerances = tolerances
        self.trials: list[Trial] = []
        self.order = math.nan
        self.finest: Solution | None = None
        self._difference = math.inf
        self._least, self._regular, self._stalls = math.inf, False, 0

    def add(self, solution: Solution) -> bool:
        """Whether the tolerance is reached, by the last solution but one."""
        coarse, self.finest = self.finest, solution
        if coarse is None:
            return False
        last, self._difference = self._difference, self._distance(coarse, solution)
        before, self.order = self.order, math.nan
        if self.trials and 0 < self._difference and last < math.inf:
            ratio = coarse.steps / self.trials[-1].steps
            self.order = math.log(last / self._difference) / math.log(ratio)
        error = self.correct(coarse.steps, self._difference)
        self.trials.append(Trial(coarse.steps, error))
        # An order far above the claim is that of leaving an unstable step behind.
        regular = max(self.claimed / 2, 0.75) <= self.order <= 2 * self.claimed + 1
        slow = self.order >= 0.75 and before >= 0.75
        # Differences of three solves below the tolerance: of rounding, or exact.
        agree = max(last, self._difference) <= 0.5
        if error <= 1 and (regular or slow or agree):
            if agree and not (regular or slow):
                self.order = math.nan
            return True
        if all(0.75 < order / self.claimed < 1.25 for order in (before, self.order)):
            self._check_affordable(coarse.steps, error)
        self._check_rounding(regular or slow, coarse, solution)
        return False

    def measure(self, solution: Solution) -> float:
        """The error of another solution, over the tolerance."""
        error = self.correct(solution.steps, self._distance(solution, self.finest))
        self.trials.append(Trial(solution.steps, error))
        return error

    def correct(self, steps: int, difference: float) -> float:
        """The error, from the difference to the finest solution."""
        assert self.finest is not None
        known = 0.75 <= self.order < math.inf
        order = self.order if known else self.claimed
        return difference / (1 - (steps / self.finest.steps) ** order)

    def exceeds(self) -> str:
        """The error message where more steps than `max_steps` are needed."""
        if len(self.trials) < 2:
            return (
                f"`choose_step(max_steps={self.max_steps})` is too few steps to find "
                "an error: at least three solves are needed."
            )
        steps, error = self.trials[-1]
        if not error < math.inf:
            return (
                f"`choose_step` found no finite solution with up to {self.max_steps} "
                "steps. Check that the solution exists up to `t1` and that the force "
                "is finite along it, or allow more steps: `max_steps=...`."
            )
        if not self.order >= self.claimed / 2:
            return (
                f"`choose_step` found no regular convergence with up to "
                f"{self.max_steps} steps: with {steps} steps the error is {error:.1e} "
                f"times the tolerance, and the measured order is {self.order:.1f} "
                f"instead of {self.claimed}. Check that the force is smooth, and that "
                "the motion is not chaotic: otherwise use a shorter time span or a "
                "larger tolerance."
            )
        return (
            f"`choose_step` needs more than {self.max_steps} steps: with {steps} steps "
            f"the error is {error:.1e} times the tolerance, and the measured order "
            f"{self.order:.1f}. {self._instead()}"
        )

    def _check_affordable(self, steps: int, error: float):
        needed = steps * error ** (1 / self.order)
        if needed > 2 * self.max_steps:
            raise RuntimeError(
                f"`choose_step` needs about {needed:.1e} steps, but `max_steps` is "
                f"{self.max_steps}: with {steps} steps the error is {error:.1e} times "
                f"the tolerance, and the measured order {self.order:.1f}. "
                f"{self._instead()}"
            )

    def _instead(self):
        return (
            "Use a scheme of higher order, for example `TunedRKN6()`, a larger "
            "tolerance, or allow more steps: `max_steps=...`."
        )

    def _check_rounding(self, converges: bool, coarse: Solution, fine: Solution):
        """An error if solves have stopped converging."""
        self._regular = self._regular or converges
        self._stalls = self._stalls + 1 if self.order < 0.5 else 0
        if self._difference < self._least:
            self._least, self._at = self._difference, coarse.steps
        eps = max(np.finfo(y.dtype).eps for y in fine.leaves)
        largest = [max(np.max(np.abs(y)), 1e-300) for y in fine.leaves]
        change = max(
            np.max(np.abs(np.asarray(a, float) - b)) / c
            for a, b, c in zip(coarse.leaves, fine.leaves, largest, strict=True)
        )
        if self._regular and self._stalls >= 2 and change < eps**0.25:
            precision = fine.leaves[0].dtype
            more = (
                ""
                if type(self.solver).__name__ == "Compensated"
                else f"`Compensated({type(self.solver).__name__}(...))`, "
            )
            double = (
                "double precision (`jax.config.update('jax_enable_x64', True)`), "
                if precision == np.float32
                else ""
            )
            raise RuntimeError(
                f"`choose_step` cannot reach this tolerance in {precision}: rounding "
                f"leaves an error of {self._least:.1e} times the tolerance with "
                f"{self._at} steps, and more steps do not reduce it. Use {more}"
                f"{double}or a larger tolerance."
            )

    def _distance(self, solution: Solution, finest: Solution | None) -> float:
        assert finest is not None
        if not (solution.finite and finest.finite):
            return math.inf
        return scaled_error(solution.leaves, finest.leaves, *self.tolerances)


def _numbers(grid: int) -> Iterator[int]:
    """Numbers of steps to try, each about twice the last.

    Those above the grid are its multiples by 1, 3, 7, 15, ... No two in succession have
    a common divisor beyond the grid: otherwise all solves might see the same phase of a
    force that is periodic in time, and agree on a wrong solution.
    """
    numbers = [grid]
    while numbers[-1] > 10:
        numbers.append((numbers[-1] - 1) // 2)
    yield from (n for n in reversed(numbers) if n > 3)
    multiple = 3
    while True:
        if multiple * grid > 3:
            yield multiple * grid
        multiple = 2 * multiple + 1


def _smallest(
    convergence: _Convergence, solve: Callable[[int], Solution], grid: int | None
) -> tuple[int, float]:
    """The smallest number of steps that reaches the tolerance, and its error."""
    measure = lambda n: convergence.measure(solve(n))
    *trials, high = convergence.trials
    low = next((t for t in reversed(trials) if t.error > 1), Trial(0, math.inf))
    every = lambda low, high: np.arange(low + 1, high)
    steepest = 1.5 * convergence.claimed
    if grid is None:
        return _search(every, low, high, measure, steepest)
    if high.steps >= grid:
        multiples = lambda low, high: grid * np.arange(low // grid + 1, high // grid)
        return _search(multiples, low, high, measure, steepest)
    best = _search(every, low, high, measure, steepest)
    for n in range(best.steps, min(2 * best.steps, grid) + 1):
        if grid % n == 0:
            error = best.error if n == best.steps else measure(n)
            if error <= 1:
                return Trial(n, error)
    return best


def _search(
    between: Callable[[int, int], np.ndarray],
    low: Trial,
    high: Trial,
    measure: Callable[[int], float],
    steepest: float,
) -> Trial:
    """A smaller number of steps than `high` that reaches the tolerance."""
    for _ in range(6):
        numbers = between(low.steps, high.steps)
        if high.error >= ENOUGH or not numbers.size:
            break
        # By the law of convergence, between the two on a log scale. Where the larger
        # step is unstable, errors fall faster than that.
        error, slope = max(high.error, 1e-8), steepest
        if low.steps and low.error < math.inf:
            slope = math.log(low.error / error) / math.log(high.steps / low.steps)
            slope = min(slope, steepest)
        guess = high.steps * (error / AIM) ** (1 / slope)
        n = int(numbers[np.argmin(np.abs(numbers - guess))])
        trial = Trial(n, measure(n))
        low, high = (low, trial) if trial.error <= 1 else (trial, high)
    return high


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


def _times(t0, t1, ts):
    """The times in the precision in which `diffeqsolve` takes them, checked."""
    given = [t for t in (t0, t1, ts) if t is not None]
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*given)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    t0, t1 = np.asarray(t0, dtype), np.asarray(t1, dtype)
    if t0.shape or t1.shape or not np.isfinite(t1 - t0) or t0 == t1:
        raise ValueError(
            "`choose_step` needs two different finite times `t0` and `t1`, but got "
            f"{t0} and {t1}."
        )
    if ts is None:
        return t0, t1, None
    ts = np.asarray(ts, dtype)
    if ts.ndim != 1 or not ts.size:
        raise ValueError(
            "`choose_step(ts=...)` must be an array of times of shape `(times,)`, but "
            f"has shape {ts.shape}. For `t1` alone write `ts=None`."
        )
    direction = np.sign(t1 - t0)
    if not np.all(direction * np.diff(ts) >= 0):
        raise ValueError(
            "`choose_step(ts=...)` must be sorted in the direction from `t0` to `t1`. "
            f"Write `ts=jnp.sort(ts){'' if direction > 0 else '[::-1]'}`."
        )
    outside = ~((direction * ts >= direction * t0) & (direction * ts <= direction * t1))
    if np.any(outside):
        raise ValueError(
            f"`choose_step(ts=...)` must lie between `t0` and `t1`, {t0} and {t1}, but "
            f"has {ts[outside][0]}."
        )
    return t0, t1, ts
