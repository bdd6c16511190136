"""A solve with steps known beforehand or reversible, as functions of states alone."""

from collections.abc import Callable
from functools import partial

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Int, PyTree

from .. import _tree as tree
from .._numbers import Scalar, State
from .._results import NONFINITE
from .._scheme._base import AbstractPresymplecticSolver, Point
from .._scheme._engine import Result
from .._system._bound import System
from ._base import AbstractSteps, MOST_STEPS
from ._nodes import first_node, Node, node, number_of_derivatives, Stencils
from ._rows import Row, Rows
from ._steps import Steps
from ._variable import VariableSteps
from ._within import End, end_of_step


class _Traced(eqx.Module):
    """A function, traced once, that returns arrays."""

    fn: Callable[..., PyTree]

    def __init__(self, fn: Callable[..., PyTree], *args: PyTree):
        self.fn = eqx.filter_closure_convert(fn, *args)

    def __call__(self, *args: PyTree) -> PyTree:
        # What is known as it is traced, as a number of a user's law of friction, is a
        # number of Python here, which has no cotangent.
        return jtu.tree_map(jnp.asarray, self.fn(*args))


class Functions(eqx.Module):
    """What a solve computes, each traced once.

    Everything that a function of the user closes over is a leaf of these, so that
    gradients reach it, however the function is written.
    """

    # What a solve begins with besides the state, if anything: differentiated here, a
    # member of a batch that fails at its start adds nothing.
    begin: Callable[[State], PyTree] | None
    step: Callable[[Array, Point], tuple[Point, Result]]
    # The state within a step, if any is saved.
    shorter: Callable[[Array, Point, Array], State] | None
    # The state at the start of a step and its derivatives, on a side of it, if values
    # are interpolated.
    node: Callable[[Array, Array, Point], Node] | None
    # The same of a step that varies, with its time, and whether a polynomial can follow
    # the motion within it.
    end: Callable[[Array, Point], tuple[End, Bool[Array, ""]]] | None
    outputs: list[Callable[[Array, State], PyTree]]  # of `SaveAt(fn=...)`


class Problem(eqx.Module):
    """A solve. It is differentiated with respect to the functions and the start."""

    functions: Functions
    start: Point
    undo: Callable[[Array, Point], Point] | None  # the inverse of a step
    # The result of so many steps to an end, from one without its reason.
    explain: Callable[[Array, Point, dfx.RESULTS], dfx.RESULTS]
    growth: Scalar | None  # of rounding errors backwards in time, its logarithm
    steps: AbstractSteps
    rows: list[Rows]
    subs: list[dfx.SubSaveAt]  # without their functions
    max_steps: int | None = eqx.field(static=True)
    progress_meter: dfx.AbstractProgressMeter
    meter: PyTree
    stencils: list[Stencils | None]  # of each output

    def __init__(
        self,
        solver: AbstractPresymplecticSolver,
        system: System,
        subs: list[dfx.SubSaveAt],
        start: Point,
        begin: Callable[[State], PyTree] | None,
        steps: AbstractSteps,
        max_steps: int | None,
        meters: tuple[dfx.AbstractProgressMeter, PyTree],
        reversal: bool,
    ):
        scheme, t0, n = solver.scheme(system), steps.t0, jnp.zeros((), int)
        data = steps.prepare(scheme, system, backward=False)

        def step(n: Array, point: Point) -> tuple[Point, Result]:
            return steps.step(scheme, system, n, point, data)

        def shorter(n: Array, point: Point, t: Array) -> State:
            return steps.shorter(scheme, system, n, point, t)

        def explained(n: Array, end: Point, result: dfx.RESULTS) -> dfx.RESULTS:
            return steps.explain(scheme, system, n, (start, end), result)

        self.rows = [Rows(sub, steps, max_steps) for sub in subs]
        some = any(rows.may_be_inside for rows in self.rows)
        # Where steps end is differentiated as part of the functions.
        self.steps, self.max_steps = steps.without_gradient(), max_steps
        self.stencils = [None] * len(self.rows)
        at_node = at_end = None
        resolved = scheme.is_resolved and solver.order(None) > 2
        if isinstance(steps, Steps) and some and resolved:
            each = number_of_derivatives(solver.order(None))
            first = first_node(system, steps, self.last, start[0])
            nodes = partial(node, scheme, system, steps, each, first)
            at_node = _Traced(nodes, n, n, start)
            for i, rows in enumerate(self.rows):
                if rows.may_be_inside:
                    stencils = Stencils(steps, rows, self.last, first, each)
                    self.stencils[i] = stencils
                    self.rows[i] = rows.known_after(stencils.known(rows))
        known = resolved and not system.has_unknown_friction
        if isinstance(steps, VariableSteps) and some and known:
            rates = None if system.friction is None else system.friction.by_rates()
            end = partial(end_of_step, scheme, system, steps, rates)
            at_end = _Traced(end, n, start)
            turning = system.term.turning(*system.values(start[0]))
            some = system.friction is not None or turning is not None

        interpolates = at_node is not None or at_end is not None

        def output(t: Array, y: State, fn: Callable) -> PyTree:
            # An interpolated attitude is not quite a unit quaternion.
            y = system.term.project(t, y, system.args) if interpolates else y
            return fn(t, y, system.args)

        outputs = [_Traced(partial(output, fn=sub.fn), t0, start[0]) for sub in subs]
        within = _Traced(shorter, n, start, t0) if some else None
        several = within, at_node, at_end, outputs
        begins = None if begin is None else _Traced(begin, start[0])
        self.functions = Functions(begins, _Traced(step, n, start), *several)
        self.start = start
        # Computed, so that it has the sharding of others within `jax.shard_map`.
        result = dfx.RESULTS.where(n < 0, NONFINITE, dfx.RESULTS.successful)
        self.explain = _Traced(explained, n, start, result)
        self.undo = self.growth = None
        if reversal:
            back = steps.prepare(scheme, system, backward=True)
            undo = lambda n, point: steps.undo(scheme, system, n, point, back)
            self.undo = _Traced(undo, n, start)
            self.growth = steps.growth(system, self.last)
        without_fn = lambda sub: eqx.tree_at(lambda x: x.fn, sub, None)
        self.subs = list(map(without_fn, subs))
        self.progress_meter, self.meter = meters

    @property
    def number_interpolated(self) -> Int[Array, ""]:
        """The number of values where a polynomial can follow the solution."""
        stencils = [x for x in self.stencils if x is not None]
        return jnp.asarray(sum(x.number for x in stencils), int)

    @property
    def last(self) -> Int[Array, ""]:
        """The number of steps, if none fails."""
        total = self.steps.total
        if self.max_steps is not None:
            return jnp.minimum(total, self.max_steps)
        # Of steps of length zero, and to a time that is not finite, no number suffices.
        never = self.steps.are_known & (total == MOST_STEPS)
        return jnp.where(never, 0, total)

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
        steps = self.steps
        last, begin = steps.previous(n, start), steps.begin(n, start)
        end = steps.end(n, start)
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
        return lax.cond(inside, step, lambda: start[0])

    def output(
        self,
        i: int,
        functions: Functions,
        row: Row,
        start: Point,
        shorter: bool | None = None,
    ) -> tuple[Array, PyTree, Array]:
        """The time and the value that output `i` saves in a row, from the state at the
        start of its step, and whether that is finite."""
        rows, y = self.rows[i], start[0]
        time, n, inside = row
        time = time if rows.has_times else self.steps.begin(n, start)
        if rows.may_be_inside and functions.shorter is not None:
            y = self.between(functions, n, start, time, inside, shorter)
        return time, functions.outputs[i](time, y), tree.all_finite(y)
