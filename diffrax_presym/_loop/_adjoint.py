"""The loop for steps that are known beforehand, as an adjoint of Diffrax."""

import math
from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._misc import all_finite, as_positive, largest, tree_sub
from .._scheme._base import AbstractPresymplecticSolver
from .._system._bound import bind
from . import _diffrax as private
from ._backward import Backward, Position
from ._closures import closure_to_pytree
from ._run import Problem, run, saved_rows
from ._steps import Rows, Steps, StepsBetween


# The least number of steps between two kept states, of a gradient by reversal.
_APART = 16


class FixedStepAdjoint(dfx.AbstractAdjoint):
    r"""The loop for steps that are known beforehand, and exact gradients in it: the
    recommended way to solve, with or without gradients.

    Saved times cost little, and between steps the solution has the full order of the
    scheme: it is a shorter step of the scheme itself. A solve whose final or saved
    states are not finite fails.

    For every solver of this package, with `diffrax.ConstantStepSize`,
    [`diffrax_presym.StepsBetween`][] or `diffrax.StepTo`, and any `SaveAt`. With a
    constant step the steps are all equal: as few as are not longer than `dt0`. (Diffrax
    takes the first of the length `dt0`, if that does not divide the time of the solve;
    and its times may differ in the last bit.) Events and adaptive steps are errors; use
    `diffrax.RecursiveCheckpointAdjoint` for these.

    The gradient is that of the discrete solution ("discretise, then optimise"), with
    respect to `y0`, `args`, the system, and everything that a function of these or of
    `SaveAt(fn=...)` closes over; derivatives with respect to times are errors. By
    default the scheme is run backwards: memory does not depend on the number of steps,
    and a gradient costs two to four solves. Damping loses information: backwards in
    time rounding errors grow by $e^{\eta(t_1) - \eta(t_0)}$. So states are kept along
    the way, more with more damping, from which the backward pass restarts. The error of
    the recomputed states is measured at each kept state, and one beyond `tol` raises an
    error. By `gradient="checkpoints"` the steps between kept states are computed again
    instead; the memory then grows with the square root of the number of steps. For
    second derivatives use forward mode over reverse mode, `jax.jvp` of `jax.grad`; for
    forward mode alone `diffrax.ForwardMode()`.
    """

    gradient: Literal["reversal", "checkpoints"] = "reversal"
    checkpoints: int | None = None
    tol: float | None = None

    def __check_init__(self):
        if self.gradient not in ("reversal", "checkpoints"):
            raise ValueError(
                '`FixedStepAdjoint(gradient=...)` must be "reversal" or "checkpoints", '
                f"but got {self.gradient!r}."
            )
        number = self.checkpoints
        if number is not None and (type(number) is not int or number < 0):
            raise ValueError(
                "`FixedStepAdjoint(checkpoints=...)` must be a Python integer, zero "
                f"or more, or `None`, but got {number!r}."
            )
        if self.tol is not None:
            as_positive(self.tol, "`FixedStepAdjoint(tol=...)`")

    def loop(
        self,
        *,
        args,
        terms,
        solver,
        stepsize_controller,
        event,
        saveat,
        t0,
        t1,
        dt0,
        max_steps,
        init_state,
        throw,
        passed_solver_state,
        passed_controller_state,
        progress_meter,
    ):
        del throw, passed_solver_state
        y, carry, made_jump = private.start_of(init_state)
        system = bind(terms, args, y)
        _check(solver, stepsize_controller, event, passed_controller_state)
        scheme = solver.scheme(system)
        if self.gradient == "reversal" and not scheme.is_invertible:
            raise ValueError(
                f"A step of `{type(solver).__name__}` has no known inverse. Write "
                '`FixedStepAdjoint("checkpoints")`.'
            )
        if made_jump is not False:
            # The solver state is stale, and is recomputed before the first step.
            restart = lambda: scheme.start(system, system.time(t0), y)
            carry = lax.cond(made_jump, restart, lambda: carry)
        subs, structure = private.flatten_subs(saveat)
        fns = [sub.fn for sub in subs]
        # Closures of functions are differentiated too.
        system, fns = closure_to_pytree((system, fns))
        steps = Steps(stepsize_controller, t0, t1, dt0)
        dense_ts, dense_infos = private.dense_buffers(init_state)
        bare = [
            eqx.tree_at(lambda x: x.fn, sub, None, is_leaf=lambda x: x is None)
            for sub in subs
        ]
        problem = Problem(
            system,
            fns,
            (y, carry),
            steps,
            [Rows(sub, steps, max_steps) for sub in subs],
            bare,
            solver,
            max_steps,
            dense_infos,
            progress_meter,
            private.meter_of(init_state),
        )
        buffers = private.saved_buffers(init_state, structure)
        out, counts = eqx.partition(
            _solve((problem, buffers), self), eqx.is_inexact_array
        )
        # To JAX all outputs of a custom rule have derivatives, even integers.
        end, saved, dense, n, result, meter = eqx.combine(
            out, eqxi.nondifferentiable_backward(counts)
        )
        if dense is not None:
            index = jnp.arange(len(dense_ts))
            dense = jnp.where(index <= n, steps.time(index), dense_ts), dense
        final = private.final_state(
            private.without_start(init_state),
            structure,
            y=end[0],
            solver_state=end[1],
            t=steps.time(n),
            steps=n,
            result=result,
            meter=meter,
            saved=saved,
            dense=dense,
        )
        return final, {"order": solver.order(terms)}

    # Which states are kept for a gradient.

    def _limit(self, y: PyTree) -> tuple[float, float]:
        """The largest allowed error of a recomputed state, and that of rounding."""
        eps = float(max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(y)))
        return eps ** (2 / 3) if self.tol is None else self.tol, eps

    def _keep(self, problem: Problem) -> tuple[Array, Any]:
        """The steps whose starting states are kept, in order; those that are not are
        after the last step. And the number of steps between them, if it is known."""
        if self.gradient == "checkpoints":
            most = problem.max_steps
            if most is None:
                raise ValueError(
                    'A gradient by `FixedStepAdjoint("checkpoints")` needs to know how '
                    "many steps to allocate memory for. Pass `diffeqsolve(..., "
                    'max_steps=...)`, or use `FixedStepAdjoint("reversal")`.'
                )
            number = self.checkpoints
            parts = math.isqrt(most) if number is None else number + 1
            length = max(-(-most // max(parts, 1)), 1)
            places = jnp.arange(max(-(-most // length), 1)) * length
            return _places(places, problem.last), length
        most = (128 if self.checkpoints is None else self.checkpoints) + 1
        first, system = _first_invertible(problem), problem.system
        steps = problem.last - first
        parts = -(-steps // _APART)
        if system.friction is not None:
            # Each part may amplify rounding up to the limit.
            t0, t1 = (system.time(problem.steps.time(n)) for n in (first, problem.last))
            limit, eps = self._limit(problem.start[0])
            amplified = jnp.log(system.friction.amplification(t0, t1 - t0))
            needed = 2 * amplified / max(math.log(limit / eps), 1)
            # Infinite or undefined amplification needs as many as there are.
            needed = jnp.where(needed < most, needed, most)
            parts = jnp.maximum(parts, jnp.ceil(needed).astype(parts.dtype))
        parts = jnp.clip(parts, 1, most)
        places = first + jnp.arange(most) * -(-steps // parts)
        return _places(places, problem.last), None

    def _back(self, backward: Backward) -> Position:
        places, length = self._keep(backward.problem)
        if length is None:
            return self._by_reversal(backward, places)
        return _by_checkpoints(backward, places, length)

    def _by_reversal(self, backward: Backward, places: Array) -> Position:
        problem, trace = backward.problem, backward.trace
        at, pulls = backward.end()
        # Positions and momenta are compared in units of their largest values. The
        # solver state may be pure rounding, and is not compared.
        units = jtu.tree_map(
            lambda x, y: jnp.maximum(largest(x), largest(y)),
            *(problem.start[0], at.point[0]),
        )

        def size(y):
            scaled = jtu.tree_map(
                lambda x, u: (largest(x) / jnp.where(u > 0, u, 1)).astype(float),
                *(y, units),
            )
            return jtu.tree_reduce(jnp.maximum, scaled)

        def part(x):
            at, worst, j = x
            j, end = j - 1, at.point[0]
            known = jtu.tree_map(lambda x: x[j], trace.kept)
            at = backward.back_to(at, pulls, places[j], lambda n: None)
            miss = size(tree_sub(at.point[0], known[0]))
            miss = miss / jnp.maximum(size(known[0]), size(end))
            at = eqx.tree_at(lambda at: at.point, at, known)
            return at, jnp.maximum(worst, miss), j

        parts = jnp.maximum(jnp.sum(places < trace.n), 1)
        zero = jnp.zeros_like(size(at.point[0]))
        at, miss, _ = lax.while_loop(lambda x: x[2] > 0, part, (at, zero, parts))
        if _is_singular(problem) is not None:
            # The first step cannot be inverted, and is pulled back from its start.
            redo = lambda at: backward.step(at, problem.start)
            at = lax.cond((places[0] > 0) & (at.n > 0), redo, lambda at: at, at)
            at = backward.back_to(at, pulls, jnp.asarray(0), lambda n: None)
        at = backward.start(at)
        undoable = backward.scheme.undoable
        if undoable is not None:
            at = eqx.error_if(
                at,
                ~undoable(problem.start[1], trace.end[1]),
                "`FixedStepAdjoint` cannot undo this solve: its steps change in "
                "length, or its friction abruptly, and there a multistep method starts "
                "again without its history. Use steps of one length, or "
                '`FixedStepAdjoint("checkpoints")`.',
            )
        # A solve that diverged has a gradient of NaN anyway.
        missed = ~(miss <= self._limit(at.point[0])[0]) & all_finite(trace.end[0])
        return eqx.error_if(
            at,
            missed,
            "`FixedStepAdjoint` recomputed the states of this solve with an error "
            "beyond its `tol`: damping or instability amplifies rounding backwards in "
            "time. Keep more states, `FixedStepAdjoint(checkpoints=...)`, or write "
            '`FixedStepAdjoint("checkpoints")`.',
        )


FixedStepAdjoint.__init__.__doc__ = r"""**Arguments:**

- `gradient`: `"reversal"` (the default), by running the scheme backwards, or
    `"checkpoints"`, by computing steps again.
- `checkpoints`: the maximum number of states to keep besides the two ends, which
    determines the memory. Defaults to `None`: for reversal 128, enough for an increment
    of $\eta$ of 1000 in `float64`, and of a few hundred in `float32`; for checkpoints
    the square root of `max_steps`, with which the memory is least.
- `tol`: the largest error of a state recomputed by reversal, relative to the size of
    the state. Defaults to the precision of the state to the power 2/3: 4e-11 in
    `float64`, 2e-5 in `float32`.

**Raises:**

`ValueError` if any is out of range, and when the solve is traced if it is not
supported. `RuntimeError` when the gradient is computed, if the error at a kept state
exceeds `tol`.
"""


def _places(places: Array, last: Array) -> Array:
    return jnp.where((places < last) | (jnp.arange(len(places)) == 0), places, last + 1)


def _by_checkpoints(backward: Backward, places: Array, length: int) -> Position:
    def part(x):
        at, j = x
        j = j - 1
        first = places[j]
        known = jtu.tree_map(lambda x: x[j], backward.trace.kept)
        stack = lambda x: jnp.broadcast_to(x, (length, *jnp.shape(x)))

        def again(n, x):
            point, points = x
            point = backward.advance(n, point)
            put = lambda xs, x: lax.dynamic_update_index_in_dim(xs, x, n + 1 - first, 0)
            return point, jtu.tree_map(put, points, point)

        begin = known, jtu.tree_map(stack, known)
        _, points = lax.fori_loop(first, at.n - 1, again, begin)
        start = lambda n: jtu.tree_map(lambda x: x[n - first], points)
        return backward.back_to(at, pulls, first, start), j

    at, pulls = backward.end()
    parts = jnp.maximum(jnp.sum(places < backward.trace.n), 1)
    at, _ = lax.while_loop(lambda x: x[1] > 0, part, (at, parts))
    return backward.start(at)


def _is_singular(problem: Problem) -> Array | None:
    """Whether friction is infinite at the start; `None` if it never is."""
    friction, system = problem.system.friction, problem.system
    if friction is None:
        return None
    return friction.is_singular(system.time(problem.steps.t0))


def _first_invertible(problem: Problem) -> Array:
    """The first step that can be inverted: one from a singularity of the friction loses
    `p`."""
    singular = _is_singular(problem)
    if singular is None:
        return jnp.asarray(0)
    return jnp.where(singular & (problem.last > 0), 1, 0)


def _check(solver, controller, event, passed_controller_state) -> None:
    what, instead = None, "`diffrax.RecursiveCheckpointAdjoint()`"
    if not isinstance(solver, AbstractPresymplecticSolver):
        what = f"`{type(solver).__name__}`, only solvers of this package"
    elif not isinstance(controller, dfx.ConstantStepSize | dfx.StepTo | StepsBetween):
        what = (
            f"`{type(controller).__name__}`, only `ConstantStepSize`, `StepTo` and "
            "`StepsBetween`"
        )
    elif event is not None:
        what = "events"
    elif passed_controller_state:
        what = "a `controller_state`"
    if what is not None:
        raise ValueError(
            f"`FixedStepAdjoint` does not support {what}. Use {instead} instead."
        )


@eqx.filter_custom_vjp
def _solve(inputs, adjoint: FixedStepAdjoint):
    problem, buffers = inputs
    return _outputs(problem, buffers, run(problem)[0])


def _outputs(problem: Problem, buffers, out):
    """What Diffrax needs of a solve."""
    progress, result, values = out
    saved = [
        saved_rows(problem, i, *buffer, rows, progress)
        for i, (buffer, rows) in enumerate(zip(buffers, values, strict=True))
    ]
    return progress.point, saved, progress.dense, progress.n, result, progress.meter


@_solve.def_fwd
def _solve_fwd(perturbed, inputs, adjoint: FixedStepAdjoint):
    moved, (problem, buffers) = perturbed[0], inputs
    fixed = moved.steps, moved.rows, moved.subs, moved.solver
    if any(jtu.tree_leaves(fixed)):
        raise ValueError(
            "`FixedStepAdjoint` does not support derivatives with respect to times "
            "(`t0`, `t1`, `dt0`, `ts`) or to the solver. Use "
            "`diffrax.RecursiveCheckpointAdjoint()` instead."
        )
    keep, _ = adjoint._keep(problem)
    out, trace = run(problem, keep)
    return _outputs(problem, buffers, out), trace


@_solve.def_bwd
def _solve_bwd(trace, bars, perturbed, inputs, adjoint: FixedStepAdjoint):
    (problem, buffers), moved = inputs, perturbed[0]
    (_, carry_bar), saved_bars, dense_bar, *_ = bars
    zeros = lambda like, bar: jtu.tree_map(
        lambda x, b: jnp.zeros_like(x) if b is None else b,
        *(eqx.filter(like, eqx.is_inexact_array), bar),
    )
    carry_bar = zeros(problem.start[1], carry_bar)
    saved_bars = [
        zeros(ys, bar[1]) for (_, ys), bar in zip(buffers, saved_bars, strict=True)
    ]
    if problem.dense is not None:
        dense_bar = zeros(problem.dense, dense_bar)
    wanted = moved.system, moved.fns
    backward = Backward(problem, trace, wanted, (saved_bars, carry_bar, dense_bar))
    at = adjoint._back(backward)
    none = lambda tree: jtu.tree_map(lambda _: None, tree)
    where = lambda x: (x.system, x.fns, x.start)
    gradient = eqx.tree_at(
        where, none(problem), (*at.gradient, at.bar), is_leaf=lambda x: x is None
    )
    return gradient, none(buffers)
