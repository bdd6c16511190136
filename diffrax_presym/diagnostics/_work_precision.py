import functools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PyTree

from .._adjoint import FixedStepAdjoint
from .._solver import (
    AbstractPresymplecticSolver,
    BlanesCasasRKN8,
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoanRKN4,
    PresymplecticCoupled,
    PresymplecticGauss,
    PresymplecticLeapfrog,
    SofroniouSpaletta8,
    TunedLinear8,
    TunedRKN6,
)
from .._split import State
from .._step_size._choose import as_times
from .._step_size._convergence import find_steps, scaled_error, Solution
from .._step_size._grid import intervals
from .._term import HamiltonianTerm
from ._count import counted, Counter


# The explicit schemes for energies that separate or split, those for any energy where
# none of them accepts the system, and the solvers of Diffrax. They are made when they
# are needed: an import must not choose the devices of JAX.
SEPARABLE = {
    "PresymplecticLeapfrog": PresymplecticLeapfrog,
    "BlanesMoanRKN4": BlanesMoanRKN4,
    "BlanesMoan4": BlanesMoan4,
    "TunedRKN6": TunedRKN6,
    "BlanesMoan6": BlanesMoan6,
    "BlanesCasasRKN8": BlanesCasasRKN8,
    "SofroniouSpaletta8": SofroniouSpaletta8,
    "TunedLinear8": TunedLinear8,
}
NONSEPARABLE = {
    "PresymplecticCoupled(2)": functools.partial(PresymplecticCoupled, 2),
    "PresymplecticCoupled(4)": functools.partial(PresymplecticCoupled, 4),
    "PresymplecticCoupled(6)": functools.partial(PresymplecticCoupled, 6),
    "PresymplecticGauss(4)": functools.partial(PresymplecticGauss, 4),
    "PresymplecticGauss(6)": functools.partial(PresymplecticGauss, 6),
}
DIFFRAX = {"Tsit5": dfx.Tsit5, "Dopri8": dfx.Dopri8}

# Evaluations of more constant steps than these are extrapolated.
COUNTED_STEPS = 1000
# Of an adaptive solve.
MOST_STEPS = 1_000_000


class WorkPrecisionRun(NamedTuple):
    """One solve of [`diffrax_presym.diagnostics.work_precision`][].

    **Attributes:**

    - `solver`: the name, followed by "adaptive" where the step size was.
    - `rtol`: the tolerance that was asked for.
    - `error`: the error found, to be compared with `rtol`.
    - `seconds`: the time of the compiled solve, a median.
    - `evaluations`: the number of force evaluations.
    - `steps`: the number of steps, rejected ones included.
    """

    solver: str
    rtol: float
    error: float
    seconds: float
    evaluations: int
    steps: int


class WorkPrecision(NamedTuple):
    """The measurements of [`diffrax_presym.diagnostics.work_precision`][].

    **Attributes:**

    - `rtol`: the tolerance.
    - `runs`: a [`diffrax_presym.diagnostics.WorkPrecisionRun`][] for each solver and
        each tolerance that it reached.
    - `left_out`: the solvers that were left out or missed a tolerance, and why.
    """

    rtol: float
    runs: tuple[WorkPrecisionRun, ...]
    left_out: Mapping[str, str]

    @property
    def fastest(self) -> str:
        """The name of the fastest solver that reaches the tolerance."""
        return min(self._at(self.rtol), key=lambda run: run.seconds).solver

    def __str__(self) -> str:
        lines = []
        for rtol in sorted({run.rtol for run in self.runs}, reverse=True):
            runs = sorted(self._at(rtol), key=lambda run: run.seconds)
            width = max(len(run.solver) for run in self.runs)
            label = f"to an error of {rtol:.0e}"
            columns = f"{'error':>9}{'steps':>9}{'evaluations':>13}{'us':>11}"
            lines += [f"{label:<{max(width, 24)}}{columns}"]
            for run in runs:
                cells = (
                    f"{run.error:9.1e}{run.steps:9d}{run.evaluations:13d}"
                    f"{run.seconds * 1e6:11.0f}"
                )
                lines += [f"{run.solver:<{max(width, 24)}}{cells}"]
            lines += [""]
        for name, why in self.left_out.items():
            lines += [f"not measured: {name}: {why.split('. ')[0].rstrip('.')}."]
        lines += [f"fastest to {self.rtol:.0e}: {self.fastest}"]
        return "\n".join(lines)

    def figure(self):
        """A figure of time against error, log-log. Needs Matplotlib."""
        try:
            from matplotlib.figure import Figure
        except ImportError as e:
            raise ImportError(
                "`WorkPrecision.figure()` needs Matplotlib, which is not installed. "
                "Run `pip install matplotlib`, or use the numbers in `runs`."
            ) from e
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        ax = figure.add_subplot()
        for i, name in enumerate(dict.fromkeys(run.solver for run in self.runs)):
            runs = [run for run in self.runs if run.solver == name]
            style = "s--" if name.startswith(tuple(DIFFRAX)) else "o-"
            seconds = [run.seconds * 1e6 for run in runs]
            errors = [run.error for run in runs]
            ax.loglog(errors, seconds, style, ms=4, lw=1, label=name, color=f"C{i}")
        ax.axvline(self.rtol, color="0.5", ls=":", lw=1)
        ax.invert_xaxis()
        ax.grid(alpha=0.3)
        ax.set(xlabel="largest error at the saved times, relative")
        ax.set(ylabel="time of a solve (microseconds)")
        figure.legend(loc="outside right upper", fontsize=8)
        return figure

    def _at(self, rtol: float) -> list[WorkPrecisionRun]:
        return [run for run in self.runs if run.rtol == rtol]


def work_precision(
    term: HamiltonianTerm,
    t0: ArrayLike,
    t1: ArrayLike,
    y0: State,
    *,
    rtol: float,
    atol: float | None = None,
    ts: ArrayLike | None = None,
    args: PyTree = None,
    solvers: Mapping[str, dfx.AbstractSolver] | None = None,
    decades: int = 1,
    repeats: int = 7,
    max_steps: int = 200_000,
) -> WorkPrecision:
    """Which solver is the fastest on this problem: error against time.

    Every suitable solver is run so that the error of the solution is just below the
    tolerance: those of this package and Diffrax's with the constant step of
    [`diffrax_presym.choose_step`][], whose definition of the error is used, and
    Diffrax's also with an adaptive step, whose tolerance is varied until the error of
    the solution fits. Errors are measured against `diffrax.Dopri8` with a much smaller
    tolerance and steps that end at each saved time, which `diffrax.Tsit5` must confirm.
    Solvers of this package use the loop of [`diffrax_presym.FixedStepAdjoint`][].

    A time is the median over rounds in which all solvers take turns, compiled and
    warmed up. It is that of this machine, which should not be busy otherwise. The
    result is printed. With the default solvers it takes about a minute, most of it to
    compile.

    !!! example

        ```text
        result = diagnostics.work_precision(
            term, 0.0, 100.0, y0, rtol=1e-6, ts=jnp.linspace(0, 100, 201)
        )
        print(result.fastest)
        result.figure().savefig("work_precision.png")
        ```

    **Arguments:**

    - `term`, `t0`, `t1`, `y0`, `args`: as in `diffeqsolve`.
    - `rtol`, `atol`: the tolerance, as in [`diffrax_presym.choose_step`][]; `rtol` must
        be positive, and `atol` defaults to the same number.
    - `ts`: the times at which the solution is saved. Defaults to `None`, for `t1`
        alone.
    - `solvers`: the solvers to compare, by name. Defaults to those that accept the
        system: explicit schemes of orders 2 to 8 if the energy separates, those for any
        energy otherwise, and Diffrax's `Tsit5` and `Dopri8`.
    - `decades`: how many decades around the tolerance are measured too, on either side.
    - `repeats`: the number of rounds.
    - `max_steps`: the largest number of steps of a solve. A solver that needs more to
        reach a tolerance is left out there.

    **Returns:**

    A [`diffrax_presym.diagnostics.WorkPrecision`][].

    **Raises:**

    `ValueError` if an argument is not valid, or no solver accepts the problem.
    `RuntimeError` if no reference solution is
    found to this precision, or no solver reaches the tolerance.
    """
    if not isinstance(term, HamiltonianTerm):
        raise ValueError(
            f"`work_precision` needs a `HamiltonianTerm`, but got {term!r}. Write "
            "`HamiltonianTerm(hamiltonian)`."
        )
    if not rtol > 0:
        raise ValueError(
            f"`work_precision(rtol=...)` must be positive, but got {rtol!r}. Write for "
            "example `rtol=1e-6`."
        )
    t0, t1, ts = as_times(t0, t1, ts, "work_precision")
    ts = np.asarray([t1], t1.dtype) if ts is None else ts
    problem = Problem(term, t0, t1, y0, args, ts, rtol, rtol if atol is None else atol)
    levels = [10.0**k for k in range(decades, -decades - 1, -1)]
    left_out: dict[str, str] = {}
    methods = _methods(problem, solvers, left_out)
    reasons = lambda: "; ".join(f"{name}: {why}" for name, why in left_out.items())
    if not methods:
        raise ValueError(f"No solver accepts this problem. {reasons()}")
    exact = _reference(problem, levels[-1])

    points: dict[tuple[str, float], tuple[Method, Any, Solution]] = {}
    for method in methods:
        for level in levels:
            try:
                x = method.tune(level, exact, max_steps)
            except RuntimeError as e:
                left_out[f"{method.name} at {level * rtol:.0e}"] = str(e)
                continue
            points[method.name, level] = method, x, method.solve(x)
    if not any(level == 1 for _, level in points):
        raise RuntimeError(f"No solver reaches {rtol=} within `max_steps`. {reasons()}")

    calls = {key: method.call(x) for key, (method, x, _) in points.items()}
    seconds = _interleaved(calls, repeats)
    runs = tuple(
        WorkPrecisionRun(
            solver=name,
            rtol=level * rtol,
            error=problem.error(solution, exact) * rtol,
            seconds=seconds[name, level],
            evaluations=method.evaluations(x, solution.steps),
            steps=solution.steps,
        )
        for (name, level), (method, x, solution) in points.items()
    )
    result = WorkPrecision(rtol, runs, left_out)
    print(result)
    return result


class Problem(NamedTuple):
    term: HamiltonianTerm
    t0: np.ndarray
    t1: np.ndarray
    y0: State
    args: PyTree
    ts: np.ndarray
    rtol: float
    atol: float

    def solve(self, term, solver, dt0, controller):
        constant = isinstance(controller, dfx.ConstantStepSize)
        known = constant and isinstance(solver, AbstractPresymplecticSolver)
        return dfx.diffeqsolve(
            *(term, solver, self.t0, self.t1, dt0, self.y0, self.args),
            saveat=dfx.SaveAt(ts=jnp.asarray(self.ts)),
            stepsize_controller=controller,
            # The loop that is recommended for this solver.
            adjoint=FixedStepAdjoint() if known else dfx.RecursiveCheckpointAdjoint(),
            # Tolerances may be below rounding, where adaptive steps would not end.
            max_steps=None if constant else MOST_STEPS,
            throw=False,
        )

    def error(self, solution: Solution, exact: Solution) -> float:
        if not (solution.finite and exact.finite):
            return math.inf
        return scaled_error(solution.leaves, exact.leaves, self.rtol, self.atol)

    def controller(self, factor) -> dfx.PIDController:
        return dfx.PIDController(rtol=factor * self.rtol, atol=factor * self.atol)


class Method:
    """A solver, whose effort is set by a number of steps, or by a tolerance."""

    def __init__(self, name: str, problem: Problem, solver, adaptive: bool):
        self.problem, self.solver, self.adaptive = problem, solver, adaptive
        self.name = f"{name}, adaptive" if adaptive else name
        self._run = self._compiled(problem.term)

    def _compiled(self, term) -> Callable:
        problem, span = self.problem, self.problem.t1 - self.problem.t0
        arrays, static = eqx.partition((problem, term, self.solver), eqx.is_array)

        @jax.jit
        def run(arrays, x):
            problem, term, solver = eqx.combine(arrays, static)
            if self.adaptive:
                controller, dt0 = problem.controller(x), None
            else:
                controller, dt0 = dfx.ConstantStepSize(), span / x
            sol = problem.solve(term, solver, dt0, controller)
            done = sol.result == dfx.RESULTS.successful
            return sol.ys, done, sol.stats["num_steps"]

        return functools.partial(run, arrays)

    @functools.cached_property
    def _counting(self) -> tuple[Counter, Callable]:
        counter = Counter()
        hamiltonian = counted(self.problem.term.hamiltonian, counter)
        return counter, self._compiled(HamiltonianTerm(hamiltonian))

    def call(self, x) -> Callable:
        """The compiled solve as a function without arguments."""
        return functools.partial(self._run, jnp.asarray(x, self.problem.t0.dtype))

    def solve(self, x) -> Solution:
        ys, done, steps = self.call(x)()
        return Solution.of(int(steps), ys, done)

    def tune(self, level: float, exact: Solution, max_steps: int):
        """The number of steps, or the tolerance, for an error just below the level."""
        if self.adaptive:
            return self._tolerance(level, exact, max_steps)
        problem = self.problem
        tolerances = level * problem.rtol, level * problem.atol
        order = self.solver.order(problem.term)
        grid = intervals(problem.ts, problem.t0, problem.t1)
        trial, _ = find_steps(self.solve, self.name, order, tolerances, grid, max_steps)
        return trial.steps

    def _tolerance(self, level: float, exact: Solution, max_steps: int):
        factor, best = level, None
        for _ in range(12):
            solution = self.solve(factor)
            error = self.problem.error(solution, exact) / level
            if error <= 1 and (best is None or factor > best):
                best = factor
            if 0.4 <= error <= 1 or solution.steps > max_steps:
                break
            # The error of the solution is about proportional to the tolerance.
            change = 0.6 / error if 0 < error < math.inf else 0.1
            factor *= min(max(change, 1e-3), 1e2)
            if best is not None and change < 1 and factor <= best:
                break
        if best is None:
            raise RuntimeError(
                "The error of the solution does not reach the tolerance."
            )
        return best

    def evaluations(self, x, steps: int) -> int:
        """The number of force evaluations."""
        if self.adaptive or steps <= COUNTED_STEPS:
            return self._count(x)
        few, many = self._count(COUNTED_STEPS // 2), self._count(COUNTED_STEPS)
        per_step = (many - few) / (COUNTED_STEPS - COUNTED_STEPS // 2)
        return round(many + per_step * (steps - COUNTED_STEPS))

    def _count(self, x) -> int:
        counter, run = self._counting
        counter.count = 0
        jax.block_until_ready(run(jnp.asarray(x, self.problem.t0.dtype)))
        return counter.count


def _methods(problem: Problem, solvers, left_out: dict[str, str]) -> list[Method]:
    """The solvers that accept the system."""

    def accepted(solvers: Mapping[str, Any]) -> dict[str, Any]:
        good = {}
        for name, solver in solvers.items():
            solve = lambda solver=solver: (
                problem.solve(
                    problem.term,
                    solver,
                    problem.t1 - problem.t0,
                    dfx.ConstantStepSize(),
                ).ys
            )
            try:
                eqx.filter_eval_shape(solve)
            except ValueError as e:
                left_out[name] = str(e)
            else:
                good[name] = solver
        return good

    if solvers is None:
        made = lambda makers: {name: make() for name, make in makers.items()}
        ours = accepted(made(SEPARABLE)) or accepted(made(NONSEPARABLE))
        solvers = ours | made(DIFFRAX)
    else:
        solvers = accepted(solvers)
    methods = []
    for name, solver in solvers.items():
        if isinstance(solver, dfx.AbstractAdaptiveSolver):
            methods.append(Method(name, problem, solver, adaptive=True))
        methods.append(Method(name, problem, solver, adaptive=False))
    return methods


def _reference(problem: Problem, level: float) -> Solution:
    """A solution with an error far below the level, confirmed by another solver."""

    @eqx.filter_jit
    def solve(solver, problem, factor):
        controller = dfx.ClipStepSizeController(
            problem.controller(factor), step_ts=jnp.asarray(problem.ts)
        )
        sol = problem.solve(problem.term, solver, None, controller)
        return sol.ys, sol.result == dfx.RESULTS.successful

    rounding = max(
        jnp.finfo(jnp.result_type(y)).eps for y in jax.tree.leaves(problem.y0)
    )
    difference = math.inf
    for factor in (1e-3, 1e-4, 1e-5):
        factor = max(factor * level, 10 * rounding / problem.rtol)
        factor = jnp.asarray(factor, problem.t0.dtype)
        exact, other = (
            Solution.of(0, *solve(solver, problem, factor))
            for solver in (dfx.Dopri8(), dfx.Tsit5())
        )
        difference = problem.error(other, exact) / level
        if difference <= 0.05:
            return exact
    raise RuntimeError(
        "`work_precision` found no reference solution: `Dopri8` and `Tsit5` with much "
        f"smaller tolerances differ by {difference:.1e} times the smallest tolerance, "
        f"{level * problem.rtol:.0e}. Use a larger `rtol`, fewer `decades`, a shorter "
        "time span, or double precision."
    )


def _interleaved(calls: Mapping[Any, Callable], repeats: int) -> dict[Any, float]:
    """The median time of each call, all of them taking turns."""
    seconds = {key: [] for key in calls}
    for _ in range(repeats):
        for key, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds[key].append(time.perf_counter() - start)
    return {key: float(np.median(each)) for key, each in seconds.items()}
