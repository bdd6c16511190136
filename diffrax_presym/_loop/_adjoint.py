"""The loop of the package, as an adjoint of Diffrax."""

from functools import partial, reduce
from typing import Literal

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import as_positive
from .._numbers import State
from .._scheme._base import Point, Scheme
from .._step_size._density import StepDensityController
from .._system._bound import bind
from . import _diffrax as private
from ._backward import Backward
from ._kept import Checkpoints, Reversal
from ._one_function import as_one_function
from ._problem import Problem
from ._pull import pulls
from ._run import run, saved_rows
from ._steps_between import known_steps
from ._supported import check_history, check_supported, KNOWN
from ._variable import VariableSteps


# Of the states kept by default; the last, the steps between them if not all are kept.
_MOST_KEPT, _FEWEST_KEPT, _MOST_BYTES, _APART = 128, 16, 2**24, 16


class FixedStepAdjoint(dfx.AbstractAdjoint):
    """The loop for steps that are known beforehand or reversible, and exact gradients
    in it: the recommended way to solve.

    Between steps the solution is a Hermite interpolation of degree 15, or 11 of schemes
    of order four, from four ends of steps, and within the steps of
    `StepDensityController` of degree 7 from the two ends of a step. Its error may be
    larger than that at the ends within long steps of schemes with many stages,
    `TunedRKN6`, `PresymplecticGauss` and compositions of compositions; and with a force
    of few derivatives, as of a mesh or a spline, for which steps may end at the saved
    times, `StepsBetween(ts)`. Across kinks in time it is wrong: give these to
    `StepsBetween`, also where steps of one length end at all of them. Where it cannot
    follow the motion, it is a shorter step: of schemes up to order two, of
    `TunedLinear8`, of splits of a user, of systems with constraints or on a `Sphere` or
    a `Stiefel`, of bodies that turn by more than 1.5 radians in a step, in spans of
    fewer than three steps, where neighbouring steps of `diffrax.StepTo` differ by more
    than a factor of two, and where friction over a step is more than 1.5, or a
    matrix turns momenta by more than as many radians, or 0.5 if its rate depends on
    time, unless the motion starts where it is infinite; and where that has no second
    derivative. Interpolated attitudes of bodies are normalised. The
    number of interpolated values is `sol.stats["interpolated"]`. How strong friction by
    place or by speed, of a `LagrangianSystem` or in a `force` is, is estimated at the
    start of the solve alone (a relaxation of 1 over a step): if it grows, use
    `choose_step` with the same saved times. With `StepDensityController` values with
    such friction are shorter steps. The force must have two derivatives by `jax.jvp`.

    A solve whose final or saved states are not finite fails; of an explicit scheme it
    ends at the next saved time or end of a step that is used for one, as other steps
    are not checked. For a time of `SaveAt(ts=...)` that is NaN, a gap in measured
    times, nothing is saved: the row stays infinite, as after the end of a solve.

    For every solver of this package, with `diffrax.ConstantStepSize`, `StepsBetween`,
    `diffrax.StepTo` or `StepDensityController`, and any `SaveAt` but dense output. With
    variable steps `ts=` and `steps=` need two of `SaveAt(subs=...)`, and the times of
    `steps=` have derivatives. With a constant step the steps are all equal: as few as
    are not longer than `dt0`. (Diffrax takes the first of the length `dt0`, if that
    does not divide the time of the solve; and its times may differ in the last bit.)
    Events, dense output and adaptive steps are errors; use
    `diffrax.RecursiveCheckpointAdjoint` for these.

    The gradient is that of the discrete solution ("discretise, then optimise"), with
    respect to `y0`, `args`, the system, the solver, and everything that a function of
    these or of `SaveAt(fn=...)` closes over; derivatives with respect to times are
    errors. By default the scheme is run backwards: memory does not depend on the number
    of steps, and a gradient costs two to five solves. Damping loses information:
    backwards in time rounding errors grow by `exp(η(t1) - η(t0))`. So states are kept
    along the way, more with more damping, from which the backward pass restarts: a kept
    state is the start of its step, and with as many as steps none is recomputed, as in
    short solves. Where the measured error of the others is beyond `tol` the gradient is
    NaN, of that member of a batch alone; outside of a batch that is an error, unless
    the solve has `throw=False`. By `gradient="checkpoints"`, and for schemes without an
    inverse, steps between kept states are computed again instead; the memory grows with
    the square root of their number. For second derivatives use forward mode over
    reverse mode, `jax.jvp` of `jax.grad`. Forward mode alone, `jax.jvp` and
    `jax.jacfwd`, is by `gradient="forward"`: for many outputs of few inputs.
    """

    gradient: Literal["reversal", "checkpoints", "forward"] | None = None
    checkpoints: int | None = None
    tol: float | None = None
    throw: bool | None = None

    def __check_init__(self):
        if self.gradient not in (None, "reversal", "checkpoints", "forward"):
            raise ValueError(
                '`FixedStepAdjoint(gradient=...)` must be "reversal", "checkpoints", '
                f'"forward" or `None`, but got {self.gradient!r}.'
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
        unsupported = event, saveat, passed_controller_state
        check_supported(solver, stepsize_controller, *unsupported)
        subs, structure = private.flatten_subs(saveat)
        if self.gradient == "forward":
            fixed = partial(eqxi.nondifferentiable, msg=_TIMES)
            t0, t1, dt0 = fixed((t0, t1, dt0))
            if isinstance(stepsize_controller, KNOWN):
                stepsize_controller = fixed(stepsize_controller)
            at = lambda sub: eqx.tree_at(lambda sub: sub.ts, sub, replace_fn=fixed)
            subs = [sub if sub.ts is None else at(sub) for sub in subs]
        y, carry, made_jump, meter, control = private.start_of(init_state)
        # Of friction at a place it has the user's objects, whose fields may be numbers.
        carry = jtu.tree_map(jnp.asarray, carry)
        system = bind(terms, args, y).factorised(y)
        scheme = solver.scheme(system)
        check_history(solver, scheme, stepsize_controller)
        way = self._way(solver, scheme, (y, carry), max_steps, throw)
        restart = lambda y: scheme.start(system, system.time(t0), y)
        if made_jump is not False:
            # The solver state is stale, and is recomputed before the first step.
            carry = lax.cond(made_jump, restart, lambda _: carry, y)
        if isinstance(stepsize_controller, StepDensityController):
            steps = VariableSteps(t0, t1, stepsize_controller, dt0)
        else:
            steps = known_steps(stepsize_controller, t0, t1, dt0)
        start, known = steps.join(carry, control), (carry, control)

        def begin(y: State) -> PyTree:
            """What a solve begins with besides the state."""
            carry, control = known
            if not passed_solver_state:
                carry = restart(y)
            if isinstance(steps, VariableSteps) and not passed_controller_state:
                about = dt0, args, solver.func, None
                _, control = steps.controller.init(terms, t0, t1, y, *about)
            return steps.join(carry, control)

        problem = Problem(
            solver,
            system,
            subs,
            (y, start),
            begin if jtu.tree_leaves(start) else None,
            steps,
            max_steps,
            (progress_meter, meter),
            reversal=isinstance(way, Reversal),
        )
        final, interpolated = _final_state(problem, way, init_state, structure)
        about = {"order": solver.order(terms), "interpolated": interpolated}
        return final, about

    def _way(
        self, solver, scheme: Scheme, start: Point, max_steps: int | None, throw: bool
    ) -> "Reversal | Checkpoints | None":
        """How the gradient is taken, `None` if forwards; an error if the scheme does
        not allow it."""
        if self.gradient == "forward":
            return None
        if self.gradient == "reversal" and not scheme.is_invertible:
            raise ValueError(
                f"A step of `{type(solver).__name__}` has no known inverse. Write "
                "`FixedStepAdjoint()`, which takes its gradient by checkpoints."
            )
        number, apart = self.checkpoints, 1
        if scheme.is_invertible and self.gradient != "checkpoints":
            raises = self.throw if self.throw is not None or throw else False
            if number is None:
                # As large memory is slow to get, also where few of them are used.
                arrays = map(jnp.asarray, jtu.tree_leaves(start))
                room = _MOST_BYTES // sum(max(x.nbytes, 1) for x in arrays)
                number, apart = min(max(room, _FEWEST_KEPT), _MOST_KEPT), _APART
            return Reversal(number, apart, self.tol, scheme.inverse_error, raises)
        return Checkpoints(max_steps, number)


FixedStepAdjoint.__init__.__doc__ = """**Arguments:**

- `gradient`: `"reversal"`, by running the scheme backwards, `"checkpoints"`, by
    computing steps again, or `"forward"`, for forward mode. Defaults to `None`: by
    reversal if the scheme has an inverse.
- `checkpoints`: the maximum number of states to keep besides the two ends, which
    determines the memory. Defaults to `None`: for reversal 128, or of a large state
    as many as need 16 MB, but at least 16; for checkpoints the square root of
    `max_steps`, with which the memory is least.
- `tol`: the largest error of a state recomputed by reversal, relative to the size of
    the state. Defaults to the precision of the state to the power 2/3: 4e-11 in
    `float64`, 2e-5 in `float32`; or, if larger, to that power of the `tolerance` of
    `PresymplecticGauss`.
- `throw`: whether a gradient by reversal that is lost to rounding is an error (`True`),
    also of one member of a batch, or NaN (`False`). Defaults to `None`: an error unless
    it is of a batch or the solve has `throw=False`.

**Raises:**

`ValueError` if any is out of range, and when the solve is traced if it is not
supported. `RuntimeError` when the gradient is computed, if the error of a recomputed
state exceeds `tol` and that is not NaN instead; and of a solve by `diffrax.StepTo`
whose times do not start at `t0` and end at `t1`.
"""


_TIMES = (
    "`FixedStepAdjoint` does not support derivatives with respect to times (`t0`, "
    "`t1`, `dt0`, `ts`). Use `diffrax.RecursiveCheckpointAdjoint()` instead, or in "
    "forward mode `diffrax.ForwardMode()`."
)
_BACKWARD = (
    '`FixedStepAdjoint("forward")` is for forward mode, `jax.jvp` and `jax.jacfwd`. '
    "For `jax.grad` write `FixedStepAdjoint()`."
)


def _final_state(
    problem: Problem, way: Reversal | Checkpoints | None, init_state, structure
):
    """Diffrax's state at the end of the solve."""
    inputs = problem, private.saved_buffers(init_state, structure)
    if way is None:
        out = eqxi.nondifferentiable_backward(_forwards(*inputs), msg=_BACKWARD)
    else:
        out, counts = eqx.partition(_solve(inputs, way), eqx.is_inexact_array)
        # To JAX all outputs of a custom rule have derivatives, even integers.
        out = eqx.combine(out, eqxi.nondifferentiable_backward(counts))
    end, saved, n, result, meter, interpolated = out
    carry, control = problem.steps.split(end[1])
    final = private.final_state(
        init_state,
        structure,
        y=end[0],
        solver_state=carry,
        control=control,
        t=problem.steps.begin(n, end),
        steps=n,
        result=result,
        meter=meter,
        saved=saved,
    )
    return final, interpolated


def _forwards(problem: Problem, buffers):
    # The two passes of a gradient were measured to gain nothing by it.
    return as_one_function(lambda: _outputs(problem, buffers, run(problem)))


@eqx.filter_custom_vjp
def _solve(inputs, way: Reversal | Checkpoints):
    return _forwards(*inputs)


def _outputs(problem: Problem, buffers, out):
    """What Diffrax needs of a solve."""
    (progress, result, values), trace = out
    each = zip(trace.rows, buffers, values, strict=True)
    saved = [saved_rows(problem, i, *x, progress) for i, x in enumerate(each)]
    # Otherwise, of a batch of what is saved alone, JAX would add up the gradients of
    # the motion, or refuse to.
    point, saved = tree.all_batched((progress.point, saved))
    return point, saved, progress.n, result, progress.meter, trace.interpolated


@_solve.def_fwd
def _solve_fwd(perturbed, inputs, way: Reversal | Checkpoints):
    moved, (problem, buffers) = perturbed[0], inputs
    if any(jtu.tree_leaves((moved.steps, moved.rows, moved.subs))):
        raise ValueError(_TIMES)
    out = run(problem, way.track(problem))
    return _outputs(problem, buffers, out), out[1]


@_solve.def_bwd
def _solve_bwd(trace, bars, perturbed, inputs, way: Reversal | Checkpoints):
    # JAX passes what is known, as a number of a law of friction, as one of Python.
    trace, (problem, buffers) = jtu.tree_map(
        lambda x: jnp.asarray(x) if isinstance(x, float) else x, (trace, inputs)
    )
    problem = eqx.tree_at(lambda problem: problem.rows, problem, trace.rows)
    (_, carry_bar), saved_bars, *_ = bars
    zeros = lambda like, bar: jtu.tree_map(
        lambda x, b: jnp.zeros_like(x) if b is None else b,
        *(eqx.filter(like, eqx.is_inexact_array), bar),
    )
    carry_bar = zeros(problem.start[1], carry_bar)
    saved_bars = [
        zeros(saved, bar[:2]) for saved, bar in zip(buffers, saved_bars, strict=True)
    ]
    bars = saved_bars, carry_bar, pulls(problem)
    backward = Backward(problem, trace, perturbed[0].functions, *bars)
    at = backward.begin(way.pull_back(backward))
    # What is not used of a solve that failed, as a member of a batch, adds nothing.
    used = [jnp.any(x != 0) for x in jtu.tree_leaves((saved_bars, carry_bar))]
    used = reduce(jnp.logical_or, used, jnp.asarray(False))
    none = lambda x: jtu.tree_map(lambda _: None, x)
    where = lambda x: (x.functions, x.start[0], x.start[1])
    found = jtu.tree_map(lambda x: jnp.where(used, x, 0), (at.gradient, at.bar[0]))
    # What the solve begins with besides was pulled back: no zeros, which JAX would. But
    # JAX 0.6 has no derivative of a linear solve, as of multipliers, by none.
    nothing = none(problem.start[1])
    if jax.__version_info__ < (0, 7):
        nothing = zeros(problem.start[1], nothing)
    found = *found, nothing
    gradient = eqx.tree_at(where, none(problem), found, is_leaf=_none)
    return gradient, none(buffers)


_none = lambda x: x is None
