"""Steps that a controller finds on the way, the same in both directions of time.

The solver state of such a solve has its clock. So a step is a map of the state alone,
as one of a length that is known, and is undone and differentiated like it: with the
dependence of all steps on the states before them.
"""

from functools import reduce
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PyTree

from .. import _tree as tree
from .._scheme._base import advance, check_step, Point
from .._scheme._engine import backward, first_failure, Span
from .._scheme._prepare import prepare
from .._step_size._density import StepDensityController
from ._base import AbstractSteps, MOST_STEPS, Stop
from ._tracks import AbstractTrack, put, stack, where_any


class Clock(NamedTuple):
    """The time that a solve has come to, and the state of its controller."""

    # Steps are not rounded to the precision of the time.
    t: tree.Sum
    control: Float[Array, ""]


def _exact(t: Array) -> tree.Sum:
    return tree.Sum(t, jnp.zeros_like(t))


class VariableSteps(AbstractSteps):
    """Steps of a controller, from one end of a solve to the other."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    controller: StepDensityController
    first: Float[Array, ""] | None  # the length of the first step, if it is given
    are_known: ClassVar[bool] = False

    @property
    def total(self):
        return jnp.asarray(MOST_STEPS)

    @property
    def kinks(self):
        return None  # Nothing is known of jumps.

    def locate(self, ts):
        return jnp.full(ts.shape, MOST_STEPS), jnp.ones(ts.shape, bool)

    def _clock(self, point: Point) -> Clock:
        return point[1][1]

    def _length(self, n: Array, control: Array) -> Float[Array, ""]:
        """Of a step that is not cut off."""
        h = self.controller.step_size(control)
        return h if self.first is None else jnp.where(n == 0, self.first, h)

    def time(self, point: Point) -> tree.Sum:
        return self._clock(point).t

    def begin(self, n, point):
        return self._clock(point).t.value

    def end(self, n, point):
        # The last one is cut off at the end of the solve.
        t, control = self._clock(point)
        end = (t + self._length(n, control)).value
        largest = jnp.maximum(abs(self.t0), abs(self.t1))
        rounding = 4 * float(jnp.finfo(end.dtype).eps) * largest
        return jnp.where(end > self.t1 - rounding, self.t1, end)

    def since_begin(self, n, point, t):
        return _exact(t) - self._clock(point).t

    def previous(self, n, point):
        return self.begin(n, point)

    def ended(self, n, point):
        return self.begin(n, point) >= self.t1

    def next_stop(self, stops, last):
        times = [stop.time for stop in stops if stop.time is not None]
        n = reduce(jnp.minimum, [stop.n for stop in stops], last)
        return Stop(n, reduce(jnp.minimum, times) if times else None)

    def common(self, n, going):
        return n

    def together(self, left, soon):
        return left & ~tree.any_member(soon & ~left)

    def before(self, stop, n, point):
        left = (n < stop.n) & ~self.ended(n, point)
        return left if stop.time is None else left & (self.end(n, point) <= stop.time)

    def at(self, stop, n, point):
        here = n == stop.n
        return here if stop.time is None else here | self.is_within(stop.time, n, point)

    def is_within(self, time: Array, n: Array, point: Point) -> Bool[Array, ""]:
        """Whether a time is before the end of the next step."""
        last = self.ended(n, point) & (time <= self.t1)
        return (time < self.end(n, point)) | last

    def number(self, stop, n):
        return n

    def is_left(self, stop, last, n, point):
        if stop.time is None:
            return jnp.asarray(False)
        return self.is_within(stop.time, n, point)

    def join(self, carry, control):
        return carry, Clock(_exact(self.t0), control)

    def split(self, carry):
        carry, (_, control) = carry
        return carry, control

    def prepare(self, scheme, system, backward):
        return None

    def step(self, scheme, system, n, point, data):
        (y, (carry, (t, control))), end = point, self.end(n, point)
        h, begin, is_last = self._length(n, control), t.value, end >= self.t1
        t1 = _exact(self.t1)
        h = jnp.where(is_last, t1 - t, h)
        t = tree.where(is_last, t1, t + h)
        span, start = Span(*map(system.time, (begin, end, h))), (y, carry)
        (y1, carry), result = advance(scheme, system, span, start)
        result = check_step(scheme, system, span, start, (y1, carry), result)
        *_, control, failed = self.controller.adapt_step_size(
            begin, end, y, y1, system.args, None, 1, control
        )
        return (y1, (carry, Clock(t, control))), first_failure(result, failed)

    def undo(self, scheme, system, n, point, data):
        # But for one that was cut off.
        y, (carry, (t, control)) = point
        control = self.controller.reverse(t.value, y, system.args, control)
        h = self._length(n, control)
        begin = t + -h
        span = Span(*map(system.time, (begin.value, t.value, h)))
        data = prepare(scheme.moves, system, span, backward=True)
        y, carry = backward(scheme.moves, system, span, data, (y, carry))
        return y, (carry, Clock(begin, control))

    def explain(self, scheme, system, n, ends, result):
        return result

    def growth(self, system, last):
        return None

    def without_gradient(self):
        fixed = tree.stop_gradient(self.controller)
        return eqx.tree_at(lambda x: x.controller, self, fixed)


class Kept(AbstractTrack):
    """The states after every so many steps, as many as there is room for."""

    most: int = eqx.field(static=True)
    init: Point

    def start(self):
        zero, one = jnp.zeros((), int), jnp.ones((), int)
        return zero, one, stack(self.init, self.most)

    def due(self, state):
        count, every, _ = state
        return Stop(count * every)

    def visit(self, state, n, point, here):
        keep = lambda state: self._keep(state, n, point, here)
        return where_any(here, keep, state)

    def _keep(self, state: PyTree, n: Array, point: Point, here: Array) -> PyTree:
        count, every, rows = state
        full = (count == self.most) & here
        half = (self.most + 1) // 2
        # Every other one is dropped.
        fewer = lambda x: jnp.concatenate([x[::2], x[half:]])[: self.most]
        rows = lax.cond(full, lambda: jtu.tree_map(fewer, rows), lambda: rows)
        count, every = jnp.where(full, half, count), jnp.where(full, 2 * every, every)
        here &= count * every == n  # Not if an odd number was full.
        rows = put(rows, jnp.minimum(count, self.most - 1), point, here)
        return jnp.where(here, count + 1, count), every, rows

    def rows(self, state):
        count, every, rows = state
        i = jnp.arange(self.most)
        return jnp.where(i < count, i * every, MOST_STEPS), rows
