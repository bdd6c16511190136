"""Ways to run a solve, and to differentiate it."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps

from ._system import JUMP


IRREGULAR = np.array([0.0, 0.04, 0.31, 0.3101, 0.77, 0.9, 1.0])  # of the span


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to run `n` steps: `run(problem, n, y0)` returns what was saved.

    That is a list of pairs of times and states. `n` is traced unless `prescribed`.
    """

    name: str
    run: Callable
    own: bool = True  # whether it uses the loop of the package
    prescribed: bool = False
    between: bool = False  # whether steps end at `JUMP`, which is said
    equal: bool = True  # whether all steps have one length
    end: bool = True  # whether the last of what it returns is the end of the solve
    order: bool = (
        True  # whether the error is that of the scheme, so that it has an order
    )
    backwards: bool = False

    def __repr__(self):
        return self.name


MAX_STEPS = 512


@dataclasses.dataclass(frozen=True)
class Problem:
    """A solve, but for the number of steps and the initial state."""

    system: Any
    solver: Any
    t0: Any
    t1: Any
    adjoint: Any

    def solve(self, dt0, y0, saveat, **options):
        options = {"t0": self.t0, "t1": self.t1, "args": None} | options
        return dfx.diffeqsolve(
            self.system,
            self.solver,
            **{"dt0": dt0, "y0": y0, "saveat": saveat, "adjoint": self.adjoint},
            **{"max_steps": MAX_STEPS, "throw": False} | options,
        )

    def length(self, n):
        return (self.t1 - self.t0) / n

    def times(self, fractions):
        dtype = jnp.result_type(self.t0)
        return self.t0 + (self.t1 - self.t0) * jnp.asarray(fractions, dtype)


def _saved(saveat):
    def run(problem, n, y0):
        sol = problem.solve(problem.length(n), y0, saveat(problem))
        return [(sol.ts, sol.ys)], sol.result

    return run


def _everything(problem, n, y0):
    ts = problem.times(IRREGULAR)
    subs = [
        dfx.SubSaveAt(t0=True, steps=2, ts=ts[1:-1]),
        dfx.SubSaveAt(ts=ts[2:4], fn=lambda t, y, args: jax.tree.map(jnp.asarray, y)),
        dfx.SubSaveAt(t1=True),
    ]
    sol = problem.solve(problem.length(n), y0, dfx.SaveAt(subs=subs))
    return list(zip(sol.ts, sol.ys, strict=True)), sol.result


def _unequal(problem, n, y0):
    u = np.linspace(0, 1, n + 1)
    ts = problem.times(u + 0.3 * np.sin(2 * np.pi * u) / (2 * np.pi))
    ts = ts.at[-1].set(problem.t1)
    controller, saveat = dfx.StepTo(ts=ts), dfx.SaveAt(ts=problem.times(IRREGULAR))
    sol = problem.solve(None, y0, saveat, stepsize_controller=controller)
    return [(sol.ts, sol.ys)], sol.result


def _between(problem, n, y0, backwards=False):
    """With spans of one step, and of two or so, beside the others."""
    times = jnp.asarray([1.25, JUMP + 0.004, JUMP], jnp.result_type(problem.t0))
    ends = (problem.t1, problem.t0) if backwards else (problem.t0, problem.t1)
    sol = problem.solve(
        -problem.length(n) if backwards else problem.length(n),
        y0,
        dfx.SaveAt(ts=problem.times(IRREGULAR)[:: -1 if backwards else 1], t1=True),
        t0=ends[0],
        t1=ends[1],
        stepsize_controller=dps.StepsBetween(times),
    )
    return [(sol.ts, sol.ys)], sol.result


def _adaptive(problem, n, y0):
    solver = dfx.HalfSolver(problem.solver)
    tolerance = 1 / n**3
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    problem = dataclasses.replace(problem, solver=solver)
    sol = problem.solve(
        problem.length(8.0), y0, dfx.SaveAt(t1=True), stepsize_controller=controller
    )
    return [(sol.ts, sol.ys)], sol.result


def _step_density(saveat):
    def run(problem, n, y0):
        density = lambda t, y, args: (
            1 / (1 + 0.2 * sum(jnp.sum(x**2) for x in jax.tree.leaves(y[0])))
        )
        controller = dps.StepDensityController(problem.length(n), density)
        options = {"stepsize_controller": controller}
        sol = problem.solve(None, y0, saveat(problem), **options)
        if not isinstance(sol.ts, list):
            return [(sol.ts, sol.ys)], sol.result
        return list(zip(sol.ts, sol.ys, strict=True)), sol.result

    return run


def _times_and_steps(problem):
    times = dfx.SubSaveAt(ts=problem.times(IRREGULAR))
    return dfx.SaveAt(subs=[times, dfx.SubSaveAt(steps=3, t1=True)])


def _chunks(problem, n, y0):
    """The second half from the solver state at the end of the first."""
    middle, h = problem.t0 + (problem.t1 - problem.t0) / 2, problem.length(n)
    save = dfx.SaveAt(t1=True, solver_state=True, made_jump=True)
    first = problem.solve(h, y0, save, t1=middle)
    y = jax.tree.map(lambda x: x[-1], first.ys)
    second = problem.solve(
        h,
        y,
        dfx.SaveAt(t1=True),
        t0=middle,
        solver_state=first.solver_state,
        made_jump=first.made_jump,
    )
    result = dfx.RESULTS.where(
        first.result == dfx.RESULTS.successful, second.result, first.result
    )
    return [(first.ts, first.ys), (second.ts, second.ys)], result


def _backwards(problem, n, y0):
    sol = problem.solve(
        *(-problem.length(n), y0, dfx.SaveAt(ts=problem.times(IRREGULAR)[::-1])),
        **{"t0": problem.t1, "t1": problem.t0},
    )
    return [(sol.ts, sol.ys)], sol.result


def _batch(problem, n, y0):
    saveat = dfx.SaveAt(ts=problem.times(IRREGULAR))

    def one(k, y0):
        sol = problem.solve(problem.length(n * k), y0, saveat)
        return sol.ts, sol.ys, sol.result

    k = jnp.array([1, 2], jnp.result_type(problem.t0))
    ts, ys, result = jax.vmap(one)(k, jax.tree.map(lambda x: jnp.stack([x, x]), y0))
    row = lambda i: jax.tree.map(lambda x: x[i], (ts, ys))
    failed = result != dfx.RESULTS.successful
    worst = jax.tree.map(lambda x: x[jnp.argmax(failed)], result)
    return [row(0), row(1)], worst


def _dense(problem, n, y0):
    saveat = dfx.SaveAt(dense=True, t1=True)
    sol = problem.solve(problem.length(n), y0, saveat)
    ts = problem.times(IRREGULAR)
    return [(ts, jax.vmap(sol.evaluate)(ts)), (sol.ts, sol.ys)], sol.result


_at_times = _saved(lambda problem: dfx.SaveAt(ts=problem.times(IRREGULAR)))
_last = lambda _: dfx.SaveAt(t1=True)
_at_end = _saved(_last)

WAYS = [
    Way("Diffrax's loop, end", _at_end, own=False),
    Way("Diffrax's loop, times", _at_times, own=False),
    Way("Diffrax's loop, dense", _dense, own=False),
    Way("Diffrax's loop, chunks", _chunks, own=False),
    Way("HalfSolver", _adaptive, own=False, equal=False, order=False),
    Way("Diffrax's loop, density", _step_density(_last), own=False, equal=False),
    Way("Diffrax's loop, between", _between, own=False, between=True, equal=False),
    Way("end", _at_end),
    Way("every second step", _saved(lambda _: dfx.SaveAt(steps=2)), end=False),
    Way("times", _at_times),
    Way("everything", _everything),
    Way("unequal steps", _unequal, prescribed=True, equal=False),
    Way("between", _between, between=True, equal=False),
    Way(
        *("between, backwards", partial(_between, backwards=True)),
        **{"between": True, "equal": False, "end": False, "backwards": True},
    ),
    Way("step density", _step_density(_times_and_steps), equal=False),
    Way("chunks", _chunks),
    Way("backwards", _backwards, end=False, backwards=True),
    Way("batch", _batch, end=False),
]


# Gradients: the adjoint, and whether it is for the loop of the package.


@dataclasses.dataclass(frozen=True)
class Gradient:
    name: str
    adjoint: Callable | None
    own: bool

    def __repr__(self):
        return self.name


GRADIENTS = [
    Gradient("reversal", dps.FixedStepAdjoint, True),
    Gradient("checkpoints", lambda: dps.FixedStepAdjoint("checkpoints"), True),
    Gradient("forward mode", lambda: dps.FixedStepAdjoint("forward"), True),
    Gradient("Diffrax's checkpoints", dfx.RecursiveCheckpointAdjoint, False),
    Gradient("Diffrax's forward mode", dfx.ForwardMode, False),
]
