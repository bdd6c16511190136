"""The loop over steps that are known beforehand, and what is saved.

Diffrax's loop asks after each step whether something is to be saved in it. Here the
steps, and those in which the saved times fall, are known, so that the loop runs from
one to the next without asking. Between steps the solution is a shorter step of the
scheme, of its full order, computed for all saved times at once.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ._misc import cast_to
from ._scan import repeat
from ._solver._engine import Span
from ._system import System


# Numbers in a state from which the outputs between steps are computed one by one,
# rather than all at once, which would take more memory than it saves time.
_LARGE = 512


class Steps:
    """The steps of a solve, as computed by the step size controllers of Diffrax."""

    total: Array

    def __init__(self, stepsize_controller, t0: Array, t1: Array, dt0: Array, **rest):
        controller = stepsize_controller
        self.t0, self.t1, self.dt0 = t0, t1, dt0
        self.ts = controller.ts if isinstance(controller, dfx.StepTo) else None
        if self.ts is not None:
            self.unequal = self.total = jnp.asarray(len(self.ts) - 1)
            return
        up, down = (jnp.asarray(sign * jnp.inf, t0.dtype) for sign in (1, -1))
        self.steps = jnp.ceil((t1 - t0) / jnp.nextafter(dt0, up))
        self.almost = t1
        for _ in range(100):
            self.almost = jnp.nextafter(self.almost, down)
        # Fewer than `steps` where these are so short that the last are made one.
        self.total = self._after((self.almost - t0) / self._span * self.steps, t1)
        # All other steps have the same length; their ends are rounded.
        several = self.total == self.steps.astype(int)
        self.unequal = jnp.where(several, jnp.minimum(2, self.total), self.total)
        self.length = (t1 - t0) / self.steps

    def time(self, n: Array) -> Array:
        """The start of step `n`."""
        if self.ts is not None:
            return self.ts[n]
        t0, t1 = self.t0, self.t1
        number = n.astype(t0.dtype)
        t = t0 + (t1 - t0) * (number / self.steps)
        t = jnp.where((number >= self.steps) | (t > self.almost), t1, t)
        # Only the first step has the length `dt0`.
        return jnp.where(n == 1, jnp.minimum(t0 + self.dt0, t1), t)

    def holding(self, ts: Array) -> Array:
        """The step in which each time is, its end included, its start not."""
        if self.ts is not None:
            return jnp.searchsorted(self.ts[1:], ts).astype(int)
        last = jnp.maximum(self.total - 1, 0)
        n = self._after((ts - self.t0) / self._span * self.steps, ts) - 1
        return jnp.clip(n, 0, last)

    def at(self, n: Array, ts: Array) -> Array:
        """Whether times are the start of step `n`, to rounding.

        Equally spaced times may be computed in another order, and rounded otherwise.
        """
        start = self.time(n)
        largest = jnp.maximum(jnp.abs(self.t0), jnp.abs(start))
        rounding = 4 * jnp.finfo(start.dtype).eps * largest
        length = jnp.maximum(self.time(n + 1) - start, start - self.time(n - 1))
        return jnp.abs(ts - start) <= jnp.minimum(rounding, length / 64)

    @property
    def _span(self) -> Array:
        # A zero span has no steps.
        return jnp.where(self.t1 > self.t0, self.t1 - self.t0, 1)

    def _after(self, about: Array, ts: Array) -> Array:
        """The first of the ends of steps that is not before a time, near a guess."""
        n = jnp.maximum(about.astype(int) - 2, 0)
        for _ in range(5):
            n = jnp.where(self.time(n) < ts, n + 1, n)
        return n


class Output:
    """One of `SaveAt(subs=...)`: in which steps it is saved, and in which rows."""

    def __init__(self, sub: dfx.SubSaveAt, fn: Callable, steps: Steps, last: Array):
        self.fn, self.first, self.every = fn, int(sub.t0), sub.steps
        self.t1 = sub.t1 and sub.steps != 1
        self.ts: Array = jnp.zeros(0) if sub.ts is None else sub.ts
        self.held = self.start = jnp.zeros(0, int)
        self.empty = steps.total == 0
        if sub.ts is not None:
            # The step that each time is in, and the one from whose start it is
            # computed: the next one if that starts at this time. Steps that are not
            # made are after all others.
            step = steps.holding(sub.ts)
            ends = steps.at(step + 1, sub.ts)
            made = step < last
            self.held = jnp.where(made, step, last + 1)
            self.start = jnp.where(made, jnp.where(ends, step + 1, step), last + 1)

    def times(self, n: Array) -> Array:
        """The number of times of `ts` saved in the first `n` steps."""
        number = len(self.held)
        if number == 0:
            return jnp.zeros_like(n)
        # In a solve of zero length all times are at its start.
        times = jnp.searchsorted(self.held, n).astype(int)
        return jnp.where(self.empty, number, times)

    def reached(self, n: Array) -> Array:
        """Which times of `ts` are saved in the first `n` steps."""
        return self.empty | (self.held < n)

    def row_of_step(self, n: Array) -> Array:
        """The row of the state after `n` steps."""
        return self.first + n // self.every - 1 + self.times(n)

    def rows_of_times(self) -> Array:
        """The rows of `ts`."""
        rows = self.first + jnp.arange(len(self.held))
        return rows + self.held // self.every if self.every else rows

    def saved(self, n: Array) -> Array:
        """The number of rows after `n` steps, without that of the end.

        Counted here, since the count of Diffrax may include an end that was not saved.
        """
        return self.first + self.times(n) + (n // self.every if self.every else 0)

    def end_is_separate(self, n: Array) -> Array:
        """Whether the end is not also saved as one of the steps."""
        return n % self.every != 0 if self.every else jnp.asarray(True)


def flatten_subs(saveat: dfx.SaveAt):
    """All of `SaveAt(subs=...)`, and the structure that they are in."""
    is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
    return jtu.tree_flatten(saveat.subs, is_leaf=is_sub)


class Inputs(NamedTuple):
    """The inputs of a solve."""

    start: tuple[PyTree, PyTree]  # the state and the solver state
    parameters: tuple[System, list[Callable]]  # the system, and functions of `SaveAt`
    rest: dict[str, Any]  # inputs that are not differentiated


class Plan:
    """What is known of a solve before its first step."""

    def __init__(self, inputs: Inputs):
        rest, self.start = inputs.rest, inputs.start
        self.rest, self.solver = rest, rest["solver"]
        self.system, fns = inputs.parameters
        self.steps = Steps(**rest)
        self.last = self.steps.total
        if rest["max_steps"] is not None:
            self.last = jnp.minimum(self.last, rest["max_steps"])
        subs, self.structure = flatten_subs(rest["saveat"])
        self.outputs = [
            Output(sub, fn, self.steps, self.last)
            for sub, fn in zip(subs, fns, strict=True)
        ]
        timed = any(len(output.held) for output in self.outputs)
        # Whether outputs between steps are computed at once after the last step, from
        # the states at the starts of these steps.
        self.at_once = timed and _numbers(self.start) <= _LARGE

    @property
    def length(self) -> Array:
        """The length of the steps of equal length, in physical time."""
        zero, length = (
            self.system.time(x) for x in (0 * self.steps.t0, self.steps.length)
        )
        return self.solver.step_length(zero, length)

    def span(self, n: Array) -> Span:
        """Step `n`, in physical time."""
        t0, t1 = (self.system.time(self.steps.time(i)) for i in (n, n + 1))
        h = self.solver.step_length(t0, t1)
        if self.steps.ts is None:
            h = jnp.where(n < self.steps.unequal, h, self.length)
        return Span(t0, t1, h)

    def between(self, system: System, n: Array, start: PyTree, t: Array) -> PyTree:
        """The state at a time in step `n`, from that at the start of the step."""
        begin, end = self.steps.time(n), self.steps.time(n + 1)
        # There is no step of zero length, which friction that is singular at its start
        # would not allow.
        end = jnp.where(end > begin, end, begin + 1)
        at_start = self.steps.at(n, t)
        t0, t = system.time(begin), system.time(jnp.where(at_start, end, t))
        shorter = lambda: self.solver.between(system, t0, start, t)
        return lax.cond(at_start, lambda: start[0], shorter)

    def output(self, i: int, parameters, n: Array, start: PyTree, t: Array) -> PyTree:
        """What is saved at a time in step `n`."""
        system, fns = parameters
        return fns[i](t, self.between(system, n, start, t), system.args)

    def all_outputs(self, i: int, parameters, starts: PyTree) -> PyTree:
        """What is saved at all times of `ts`, from the states at the starts of the
        steps that hold them."""
        steps, ts = self._made(self.outputs[i])
        system, fns = parameters
        between = jax.vmap(partial(self.between, system))
        # Vectorised, a time that is the end of a step would cost as much as others.
        ends = jnp.all(self.steps.at(steps, ts))
        ys = lax.cond(ends, lambda: starts[0], lambda: between(steps, starts, ts))
        return jax.vmap(lambda t, y: fns[i](t, y, system.args))(ts, ys)

    def _made(self, output: Output) -> tuple[Array, Array]:
        """The steps of the saved times, and these. Those that are not made are replaced
        by the start of the solve, where nothing fails."""
        made = output.start <= self.last
        steps = jnp.where(made, output.start, 0)
        return steps, jnp.where(made, output.ts, self.steps.t0)


class Now(NamedTuple):
    """How far a solve has come."""

    n: Array
    state: tuple[PyTree, PyTree]
    result: dfx.RESULTS | None  # `None` if no step can fail
    meter: PyTree
    dense: PyTree


class _Stack(NamedTuple):
    """Values at the starts of given steps, in order, stacked."""

    steps: Array
    value: Callable[[Array, Now], PyTree]
    init: PyTree

    def start(self) -> tuple[PyTree, Array]:
        return _stack(self.init, len(self.steps)), jnp.asarray(0)

    def next(self, state, never: Array) -> Array:
        _, i = state
        return jnp.where(i < len(self.steps), self.steps[i], never)

    def save(self, now: Now, state, hit):
        rows, i = state
        return _set(rows, i, self.value(i, now), hit), i + jnp.where(hit, 1, 0)


class _Every(NamedTuple):
    """What an output saves every few steps, in its final rows."""

    output: Output
    time: Callable[[Array], Array]
    args: PyTree
    rows: PyTree

    def start(self) -> tuple[PyTree, Array]:
        return self.rows, jnp.asarray(1)

    def next(self, state, never: Array) -> Array:
        _, k = state
        return k * self.output.every

    def save(self, now: Now, state, hit):
        rows, k = state
        value = self.output.fn(self.time(now.n), now.state[0], self.args)
        rows = _set(rows, self.output.row_of_step(now.n), value, hit)
        return rows, k + jnp.where(hit, 1, 0)


class Trace(NamedTuple):
    """States of a solve, from which its gradient is computed."""

    n: Array
    end: tuple[PyTree, PyTree]
    # At the starts of the steps with outputs between their ends; `None` if these are
    # not computed at once.
    starts: list[PyTree]
    kept: PyTree


def run(inputs: Inputs, keep: Callable[[Plan], Array] | None = None):
    """The solve: Diffrax's final state, and a trace of it.

    `keep` gives the steps whose starting states are kept.
    """
    plan, init = Plan(inputs), inputs.rest["init_state"]
    args = plan.system.args
    saves = plan.structure.flatten_up_to(init.save_state)
    of_state = lambda i, now: now.state
    stacks, rows = [], []
    for i, (output, save) in enumerate(zip(plan.outputs, saves, strict=True)):
        first = partial(output.fn, plan.steps.t0, plan.start[0], args)
        rows.append(_set(save.ys, 0, first(), True) if output.first else save.ys)
        stack = None
        if len(output.held) and plan.at_once:
            stack = _Stack(output.start, of_state, plan.start)
        elif len(output.held):
            value = lambda j, now, i=i, output=output: plan.output(
                i, inputs.parameters, now.n, now.state, output.ts[j]
            )
            stack = _Stack(output.start, value, first())
        stacks.append(stack)
    every = [
        _Every(output, plan.steps.time, args, ys) if output.every else None
        for output, ys in zip(plan.outputs, rows, strict=True)
    ]
    kept = None if keep is None else _Stack(keep(plan), of_state, plan.start)
    now, (saved, stacked, kept) = _walk(plan, (every, stacks, kept))
    starts = [None if x is None or not plan.at_once else x[0] for x in stacked]
    trace = Trace(now.n, now.state, starts, None if kept is None else kept[0])

    states = []
    for i, (output, save) in enumerate(zip(plan.outputs, saves, strict=True)):
        ys, values = rows[i] if every[i] is None else saved[i][0], None
        if plan.at_once and stacked[i] is not None:
            values = plan.all_outputs(i, inputs.parameters, starts[i])
        elif stacked[i] is not None:
            values = stacked[i][0]
        final = partial(output.fn, plan.steps.time(now.n), now.state[0], args)
        states.append(_assemble(plan, output, save, now, ys, values, final))
    return _final_state(plan, now, plan.structure.unflatten(states)), trace


def _walk(plan: Plan, records: PyTree) -> tuple[Now, PyTree]:
    """All steps, stopping where a record is due."""
    steps, solver, system = plan.steps, plan.solver, plan.system
    init, meter = plan.rest["init_state"], plan.rest["progress_meter"]

    def step(equal: bool, now: Now) -> Now:
        span = plan.span(now.n)
        if equal:
            # What depends on the length alone is computed before the loop.
            span = span._replace(h=plan.length)
        fitted = solver.fitted(system, span.t1, span.h, now.state[0])
        infos = now.dense
        y, carry, result = solver.attempt(fitted, *span, *now.state)
        end = y, carry
        if infos is not None:
            info = solver.dense_info(system, span, now.state, end)
            infos = _set(infos, now.n, info, True)
        done = (steps.time(now.n + 1) - steps.t0) / (steps.t1 - steps.t0)
        return Now(now.n + 1, end, result, meter.step(now.meter, done), infos)

    zero, meters = jnp.asarray(0), init.progress_meter_state
    now = Now(zero, plan.start, None, meters, init.dense_infos)
    can_fail = eqx.filter_eval_shape(partial(step, False), now).result is not None
    if can_fail:
        now = now._replace(result=jtu.tree_map(jnp.asarray, dfx.RESULTS.successful))
    well = lambda now: now.result == dfx.RESULTS.successful

    def advance(equal: bool, stop: Array, now: Now) -> Now:
        left = lambda now: stop - now.n
        return repeat(left, partial(step, equal), now, well if can_fail else None)

    is_record = lambda x: isinstance(x, _Stack | _Every)
    flat, structure = jtu.tree_flatten(records, is_leaf=is_record)
    states = [record.start() for record in flat]
    # The loop stops for nothing else, so that each stop is one of the record's.
    alone = len(flat) == 1
    each = alone and isinstance(flat[0], _Every) and flat[0].output.every == 1
    each = each and not can_fail

    def due(states) -> list[Array]:
        never = plan.last + 1
        pairs = zip(flat, states, strict=True)
        return [record.next(state, never) for record, state in pairs]

    def stop(equal: bool, x):
        now, states = x
        wanted = due(states)
        at = reduce(jnp.minimum, wanted)
        now = step(equal, now) if each else advance(equal, at, now)
        hits = [alone or w == at for w in wanted]
        # What is saved of a solve that has failed is dropped at the end: in a batch all
        # stop at the same steps, and no row is selected.
        now = now._replace(n=at)
        triples = zip(flat, states, hits, strict=True)
        return now, [record.save(now, *rest) for record, *rest in triples]

    def more(last: Array, x):
        return reduce(jnp.minimum, due(x[1])) <= last

    def run(equal: bool, last: Array, now: Now, states):
        if flat:
            both = partial(more, last), partial(stop, equal)
            now, states = lax.while_loop(*both, (now, states))
        return advance(equal, last, now), states

    now, states = run(False, jnp.minimum(steps.unequal, plan.last), now, states)
    if steps.ts is None:
        now, states = run(True, plan.last, now, states)
    return now, jtu.tree_unflatten(structure, states)


def _assemble(plan: Plan, output: Output, save, now: Now, ys, values, final: Callable):
    """Diffrax's record of one output."""
    steps, n, first = plan.steps, now.n, output.first
    ts = _set(save.ts, 0, steps.t0, True) if first else save.ts
    number = len(output.held)

    def put(rows: Array, made: Array, xs: Array, x: Array) -> Array:
        """Rows replaced by those that were made."""
        x = x.astype(xs.dtype)
        if output.every and number:
            return xs.at[jnp.where(made, rows, len(xs))].set(x, mode="drop")
        # All in order. On a CPU a scatter of 200 rows takes as long as a short solve.
        x = _where(made, x, xs[first : first + len(x)])
        return lax.dynamic_update_slice_in_dim(xs, x, first, 0)

    if output.every and now.result is not None:
        reached = jnp.arange(len(ts)) < output.saved(n)
        ys = jtu.tree_map(partial(_where, reached), ys, save.ys)
    if output.every:
        ends = output.every * jnp.arange(1, len(ts) - first + 1)
        ts = put(output.row_of_step(ends), ends <= n, ts, steps.time(ends))
    if number:
        place = partial(put, output.rows_of_times(), output.reached(n))
        ts, ys = place(ts, output.ts), jtu.tree_map(place, ys, values)
    saved = output.saved(n)
    if output.t1:
        separate = output.end_is_separate(n)
        ts = _set(ts, saved, steps.time(n), separate)
        ys = _set(ys, saved, final(), separate)
        saved = saved + 1
    return eqx.tree_at(
        lambda save: (save.ts, save.ys, save.save_index, save.saveat_ts_index),
        save,
        (ts, ys, saved, output.times(n)),
    )


def _final_state(plan: Plan, now: Now, save_state):
    init, n = plan.rest["init_state"], now.n
    result = dfx.RESULTS.successful if now.result is None else now.result
    short = n < plan.steps.total
    result = dfx.RESULTS.where(
        (result == dfx.RESULTS.successful) & short,
        dfx.RESULTS.max_steps_reached,
        result,
    )
    get = lambda state: (
        state.y,
        state.solver_state,
        state.tprev,
        state.num_steps,
        state.num_accepted_steps,
        state.result,
        state.save_state,
        state.progress_meter_state,
    )
    new = (*now.state, plan.steps.time(n), n, n, result, save_state, now.meter)
    state = eqx.tree_at(get, init, new, is_leaf=lambda x: x is None)
    # The first of its numbers counts the steps.
    count, *rest = jtu.tree_leaves(init.controller_state)
    structure = jtu.tree_structure(init.controller_state)
    count = count + jnp.asarray(n, jnp.result_type(count))
    controller = jtu.tree_unflatten(structure, [count, *rest])
    state = eqx.tree_at(lambda state: state.controller_state, state, controller)
    if plan.rest["saveat"].dense:
        index = jnp.arange(len(init.dense_ts))
        ts = jnp.where(index <= n, plan.steps.time(index), init.dense_ts)
        get = lambda state: (state.dense_ts, state.dense_infos, state.dense_save_index)
        state = eqx.tree_at(get, state, (ts, now.dense, n))
    return state


def _numbers(state: PyTree) -> int:
    """How many numbers a state has."""
    return sum(jnp.size(x) for x in jtu.tree_leaves(state))


def _where(rows: Array, x: Array, y: Array) -> Array:
    """The rows of one array, or of another."""
    return jnp.where(rows.reshape(-1, *(1,) * (x.ndim - 1)), x, y)


def _stack(value: PyTree, number: int) -> PyTree:
    """Rows of one value."""
    stack = lambda x: jnp.broadcast_to(x, (number, *jnp.shape(x)))
    return jtu.tree_map(stack, value)


def _set(rows: PyTree, i: Array | int, value: PyTree, hit) -> PyTree:
    """Rows with one of them replaced if `hit`, which may be known beforehand."""

    def leaf(xs, x):
        if hit is not True:
            x = jnp.where(hit, x, xs[i])
        return lax.dynamic_update_index_in_dim(xs, cast_to(x, xs), i, 0)

    return jtu.tree_map(leaf, rows, value)
