"""A solve with steps that are known beforehand, as functions of states alone."""

from collections.abc import Callable
from functools import partial

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Int, PyTree

from .. import _tree as tree
from .._numbers import Scalar, State
from .._scheme._base import AbstractPresymplecticSolver, advance, between, Point
from .._scheme._engine import backward, is_autonomous, prepare, prepare_once, Result
from .._scheme._failure import explain, unless_too_strong
from .._system._bound import System
from ._steps import Rows, Steps


# Numbers in a state from which the outputs between steps are computed one by one,
# rather than all at once, which would take more memory than it saves time.
_LARGE = 512


class Functions(eqx.Module):
    """What a solve computes, each traced once.

    Everything that a function of the user closes over is a leaf of these, so that
    gradients reach it, however the function is written.
    """

    step: Callable[[Array, Point], tuple[Point, Result]]
    # The state within a step, if any is saved.
    shorter: Callable[[Array, Point, Array], State] | None
    outputs: list[Callable[[Array, State], PyTree]]  # of `SaveAt(fn=...)`


class Problem(eqx.Module):
    """A solve. It is differentiated with respect to the functions and the start."""

    functions: Functions
    start: Point
    undo: Callable[[Array, Point], Point] | None  # the inverse of a step
    # The result of so many steps to an end, from one without its reason.
    explain: Callable[[Array, Point, dfx.RESULTS], dfx.RESULTS]
    growth: Scalar | None  # of rounding errors backwards in time, its logarithm
    steps: Steps
    rows: list[Rows]
    subs: list[dfx.SubSaveAt]  # without their functions
    max_steps: int | None = eqx.field(static=True)
    progress_meter: dfx.AbstractProgressMeter
    meter: PyTree
    # Whether outputs between steps are computed all at once after the last step, from
    # the states at the starts of these steps. In implicit schemes they would all
    # iterate as often as the slowest.
    at_once: bool = eqx.field(static=True)

    def __init__(
        self,
        solver: AbstractPresymplecticSolver,
        system: System,
        subs: list[dfx.SubSaveAt],
        start: Point,
        steps: Steps,
        max_steps: int | None,
        meters: tuple[dfx.AbstractProgressMeter, PyTree],
        reversal: bool,
    ):
        scheme, t0, n = solver.scheme(system), steps.t0, jnp.asarray(0)
        once = steps.are_equal and is_autonomous(scheme.moves, system)

        def prepared(backward: bool) -> PyTree:
            if not once:
                return None
            span, most = steps.span(system, n), scheme.most_friction
            data = prepare_once(scheme.moves, system, span, backward)
            return data if backward else unless_too_strong(most, system, span, data)

        data = prepared(False)

        def step(n: Array, point: Point) -> tuple[Point, Result]:
            return advance(scheme, system, steps.span(system, n), point, data)

        def shorter(n: Array, point: Point, t: Array) -> State:
            t0, t = system.time(steps.time(n)), system.time(t)
            return between(scheme, system, t0, point, t)

        def explained(n: Array, end: Point, result: dfx.RESULTS) -> dfx.RESULTS:
            time = lambda n: system.time(steps.time(n))
            ends = (time(0 * n), start), (time(n), end)
            span = partial(steps.span, system)
            return explain(scheme, system, span, n, ends, result)

        self.rows = [Rows(sub, steps, max_steps) for sub in subs]
        some = any(rows.may_be_inside for rows in self.rows)
        convert = eqx.filter_closure_convert
        outputs = [
            convert(lambda t, y, fn=sub.fn: fn(t, y, system.args), t0, start[0])
            for sub in subs
        ]
        within = convert(shorter, n, start, t0) if some else None
        self.functions = Functions(convert(step, n, start), within, outputs)
        self.start, self.steps, self.max_steps = start, steps, max_steps
        traced = jtu.tree_map(jnp.asarray, dfx.RESULTS.successful)
        self.explain = convert(explained, n, start, traced)
        self.undo = self.growth = None
        if reversal:
            back = prepared(True)

            def undo(n: Array, point: Point) -> Point:
                span, data = steps.span(system, n), back
                if not once:
                    data = prepare(scheme.moves, system, span, backward=True)
                return backward(scheme.moves, system, span, data, point)

            self.undo = convert(undo, n, start)
            if system.friction is not None:
                # The first step after a kept state is not inverted.
                first = jnp.minimum(1, self.last)
                begin, end = (system.time(steps.time(n)) for n in (first, self.last))
                growth = system.friction.growth(begin, end - begin)
                self.growth = lax.stop_gradient(growth)
        without_fn = lambda sub: eqx.tree_at(lambda x: x.fn, sub, None)
        self.subs = list(map(without_fn, subs))
        self.progress_meter, self.meter = meters
        size = sum(jnp.size(x) for x in jtu.tree_leaves(start))
        self.at_once = size <= _LARGE and not scheme.is_implicit

    @property
    def last(self) -> Int[Array, ""]:
        """The number of steps, if none fails."""
        total = self.steps.total
        return total if self.max_steps is None else jnp.minimum(total, self.max_steps)

    def between(
        self,
        functions: Functions,
        n: Array,
        start: Point,
        t: Array,
        inside: Array,
        shorter: bool | None = None,
    ) -> PyTree:
        """The state at a time `inside` step `n`, or at its start; that of the `shorter`
        step or of the start if it is known which."""
        last, begin, end = (self.steps.time(n + i) for i in (-1, 0, 1))
        # A batch computes the shorter step at the start of a step too, and after the
        # last one. Its result is not used, but it must be one that succeeds: half of a
        # step, the last one at the end of the solve, as friction that is singular at
        # its start would not allow none.
        ended = end <= begin
        begin, end = jnp.where(ended, last, begin), jnp.where(ended, begin, end)
        length = jnp.where(end > begin, end - begin, 1)
        t = jnp.where(inside, t, begin + length / 2)
        assert functions.shorter is not None
        within = functions.shorter
        step = lambda: within(jnp.where(ended, n - 1, n), start, t)
        if shorter is not None:
            return step() if shorter else start[0]
        if self.at_once:
            # Under `jax.vmap` a `lax.cond` computes both, and copies what both share,
            # such as matrices of friction, for each row.
            return tree.where(inside, step(), start[0])
        return lax.cond(inside, step, lambda: start[0])

    def output(
        self,
        i: int,
        functions: Functions,
        j: Array,
        start: Point,
        shorter: bool | None = None,
    ) -> PyTree:
        """What output `i` saves in row `j`, from the state at the start of its step,
        and whether that is finite."""
        rows, y = self.rows[i], start[0]
        if rows.may_be_inside:
            at = rows.stop[j], start, rows.time[j], rows.inside[j]
            y = self.between(functions, *at, shorter)
        return functions.outputs[i](rows.time[j], y), tree.all_finite(y)

    def outputs(self, i: int, functions: Functions, starts: PyTree, n: Array) -> PyTree:
        """What output `i` saves in all rows, from the states at the starts of their
        steps, of `n` steps; and whether all states are finite."""
        rows = self.rows[i]
        # Rows that are not taken repeat the first, or what is saved at the start, so
        # that nothing fails of which a gradient takes zero times.
        taken = rows.taken(n)
        row, some = (
            jnp.where(taken, jnp.arange(len(rows)), jnp.argmax(taken)),
            jnp.any(taken),
        )
        starts = jtu.tree_map(lambda x: x[row], starts)
        time = jnp.where(some, rows.time[row], self.steps.t0)
        stop = jnp.where(some, rows.stop[row], 0)
        inside = some & rows.inside[row]
        ys = starts[0]
        if rows.may_be_inside:
            each = jax.vmap(partial(self.between, functions))
            # At once, a time that is the end of a step would cost as much as others.
            within = lambda: each(stop, starts, time, inside)
            ys = lax.cond(jnp.any(inside), within, lambda: ys)
        return jax.vmap(functions.outputs[i])(time, ys), tree.all_finite(ys)
