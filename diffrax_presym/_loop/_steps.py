"""The steps of a solve that are known beforehand."""

from functools import partial, reduce
from typing import Any, ClassVar

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import _tree as tree
from .._numbers import rounding_of
from .._scheme._base import advance, between, Point, Scheme
from .._scheme._engine import backward, is_autonomous, Span
from .._scheme._failure import explain, unless_too_strong
from .._scheme._prepare import prepare, prepare_once
from .._system._bound import System
from ._base import (
    AbstractSteps,
    follows,
    MOST_CONSTANT,
    MOST_FRICTION,
    MOST_STEPS,
    Stop,
)


_OTHER_ENDS = (
    "The first and the last time of `diffrax.StepTo(ts)` must be `t0` and `t1` of the "
    "solve. Write `StepTo(jnp.concatenate([t0, ts, t1]))`, or use "
    "`StepsBetween(ts)`, which ignores times that are not between the two."
)


class Steps(AbstractSteps):
    """Steps that are equal between given times, the ends of a solve if there are none,
    or prescribed ones."""

    are_known: ClassVar[bool] = True

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    count: Int[Array, ""]
    starts: Float[Array, " parts"]  # of the spans of equal steps
    first: Int[Array, " parts"]  # the first step of each of them
    length: Float[Array, " parts"]  # of its steps
    ts: Float[Array, " ends"] | None  # of prescribed steps

    def __init__(
        self,
        t0,
        t1,
        dt0,
        times: Float[Array, " times"] | None = None,
        ts: Float[Array, " ends"] | None = None,
    ):
        self.t0, self.t1, self.ts = t0, t1, None
        if ts is not None:
            ends = (ts[0] == t0) & (ts[-1] == t1)
            self.ts = eqx.error_if(ts, ~ends, _OTHER_ENDS)
            self.count = jnp.full((), len(ts) - 1)
            self.starts, self.first = t0[None], jnp.zeros(1, int)
            self.length = jnp.zeros_like(self.starts)
            return
        self.starts, ends = t0[None], t1[None]
        if times is not None:
            inner = jnp.clip(times.astype(t0.dtype), t0, t1)
            self.starts = jnp.concatenate([self.starts, inner])
            ends = jnp.concatenate([inner, ends])
        spans, most = ends - self.starts, MOST_STEPS
        # As few equal steps as are not longer than `dt0`, but for the rounding of the
        # ends of their span.
        eps = float(jnp.finfo(t0.dtype).eps)
        rounding = eps * (jnp.abs(self.starts) + jnp.abs(ends) + spans)
        numbers = jnp.ceil((spans - jnp.minimum(rounding, dt0 / 4)) / dt0)
        # One step if `dt0` is infinite.
        numbers = jnp.where(spans > 0, jnp.maximum(numbers, 1), numbers)
        finite = jnp.isfinite(numbers)
        # A time that is not finite is never reached, with steps of the given length.
        counts = jnp.where(finite, jnp.where(finite, numbers, 0).astype(int), most)
        several = jnp.where(finite, jnp.maximum(numbers, 1), 1)
        self.length = jnp.where(finite, spans / several, dt0)
        last = counts if len(counts) == 1 else jnp.cumsum(counts)
        # No step begins at a time that is not finite.
        self.count = jnp.where(jnp.isfinite(t0), last[-1], 0)
        self.first = last - counts

    @property
    def total(self):
        return self.count

    @property
    def are_equal(self) -> bool:
        return self.ts is None and len(self.starts) == 1

    @property
    def kinks(self):
        if len(self.starts) == 1:
            return None
        # Not at the start of the solve, before which nothing is defined.
        return jnp.where(self.first[1:] > 0, self.first[1:], -1)

    def _part(self, n: Int[Array, "..."]) -> Any:
        if len(self.starts) == 1:
            return 0
        return jnp.searchsorted(self.first, n, side="right").astype(int) - 1

    def _starts(self, n: Int[Array, ""], k: Any) -> Bool[Array, ""]:
        """Whether step `n` is the first of span `k`, which follows another."""
        return (n == self.first[k]) & (n > 0)

    def is_kink(self, n: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether step `n` starts at one of the given times."""
        return self._starts(n, self._part(n))

    def time(self, n: Int[Array, "..."]) -> Float[Array, "..."]:
        """The start of step `n`."""
        if self.ts is not None:
            return self.ts[n]
        return self._within(self._part(n), n)

    def _within(self, k: Any, n: Int[Array, "..."]) -> Float[Array, "..."]:
        """The start of step `n`, one of span `k`."""
        t = self.starts[k] + self.length[k] * (n - self.first[k]).astype(self.t0.dtype)
        return jnp.where(n >= self.total, self.t1, t)

    @property
    def ratio(self) -> Float[Array, ""]:
        """The largest ratio of neighbouring steps, unless steps may end between."""
        if self.ts is None:
            return jnp.ones_like(self.t0)
        lengths = jnp.diff(self.ts)
        pair = jnp.abs(jnp.log(lengths[1:] / lengths[:-1]))
        return jnp.exp(jnp.max(pair, initial=0.0))

    def smooth_part(self, n: Int[Array, " rows"]) -> tuple[Array, Array]:
        """The first and the last end of steps without one of the given times between,
        around the starts of steps."""
        k = self._part(jnp.minimum(n, jnp.maximum(self.total - 1, 0)))
        return self.first[k], jnp.append(self.first[1:], self.total)[k]

    def lengths(self, n: Int[Array, " rows"]) -> Float[Array, " rows"]:
        """The lengths of steps, or 1 of one that there is not."""
        n = jnp.clip(n, 0, jnp.maximum(self.total - 1, 0))
        if self.ts is None:
            length = jnp.broadcast_to(self.length[self._part(n)], n.shape)
        else:
            length = self.ts[n + 1] - self.ts[n]
        return jnp.where(length > 0, length, 1)

    @property
    def longest(self) -> Float[Array, ""]:
        return jnp.max(self.length if self.ts is None else jnp.diff(self.ts))

    def weak_from(self, system: System, last: Array) -> Int[Array, ""]:
        """The first step from which on polynomials can follow the motion."""
        friction = system.friction
        assert friction is not None
        most = MOST_CONSTANT if friction.is_autonomous else MOST_FRICTION
        start = system.time(self.t0)
        singular = friction.is_singular(start)
        friction = friction.by_rates(start)

        def after(n: Array, first: Array) -> Array:
            t0, _, h = self.span(system, n)
            found = follows(friction, t0, h, most)
            if singular is not None:
                found &= ~singular | (n > 0)
            return jnp.where(found, first, n + 1)

        zero = jnp.zeros((), int)
        if self.are_equal and friction.is_autonomous:
            return jnp.where(after(zero, zero) == 0, 0, last)
        return lax.fori_loop(0, last, after, zero)

    def span(self, system: System, n: Int[Array, ""]) -> Span:
        """Step `n`, in physical time."""
        # In a batch, members that are done repeat a step, which must not fail.
        n = jnp.maximum(jnp.minimum(n, self.total - 1), 0)
        if self.ts is not None:
            t0, t1 = system.time(self.ts[n]), system.time(self.ts[n + 1])
            return Span(t0, t1, t1 - t0)
        k, end = self._part(n), n + 1
        t0, t1 = self._within(k, n), self._within(k, end)
        if len(self.starts) > 1:
            # Found by one search, and the end of the last step in a span to rounding.
            after = jnp.minimum(k + 1, len(self.starts) - 1)
            last = end == self.first[after]
            t1 = jnp.where(last, self.starts[after], t1)
            span = Span(*map(system.time, (t0, t1, self.length[k])))
            # Beside a kink on their side of it.
            other = span.rounding
            t0 = span.t0 + jnp.where(self._starts(n, k), other, 0)
            return span._replace(t0=t0, t1=span.t1 - jnp.where(last, other, 0))
        return Span(*map(system.time, (t0, t1, self.length[k])))

    def renewed(
        self, scheme: Scheme, system: System, n: Array, t: Array, point: Point
    ) -> Point:
        """The start of step `n`, at a kink with a solver state from one side of it."""
        y, carry = point
        if self.kinks is None or scheme.at_kink is None:
            return point
        new = scheme.at_kink
        kink = self.is_kink(n)
        return y, lax.cond(kink, lambda: new(system, t, y, carry), lambda: carry)

    def begin(self, n, point):
        return self.time(n)

    def end(self, n, point):
        return self.time(n + 1)

    def since_begin(self, n, point, t):
        return t - self.time(n)

    def previous(self, n, point):
        return self.time(n - 1)

    def ended(self, n, point):
        return n >= self.total

    def next_stop(self, stops, last):
        return Stop(reduce(jnp.minimum, [stop.n for stop in stops], last))

    def common(self, n, going):
        return tree.smallest_member(jnp.where(going, n, MOST_STEPS))

    def together(self, left, soon):
        return left

    def before(self, stop, n, point):
        return n < stop.n

    def at(self, stop, n, point):
        return n == stop.n

    def number(self, stop, n):
        return stop.n  # the same for all members of a batch

    def is_left(self, stop, last, n, point):
        return stop.n <= last

    def join(self, carry, control):
        return carry

    def split(self, carry):
        return carry, None

    def _prepares_once(self, scheme: Scheme, system: System) -> bool:
        return self.are_equal and is_autonomous(scheme.moves, system)

    def prepare(self, scheme, system, backward):
        if not self._prepares_once(scheme, system):
            return None
        span = self.span(system, jnp.zeros((), int))
        data = prepare_once(scheme.moves, system, span, backward)
        if backward:
            return data
        return unless_too_strong(scheme.most_friction, system, span, data)

    def step(self, scheme, system, n, point, data):
        span = self.span(system, n)
        point = self.renewed(scheme, system, n, span.t0, point)
        return advance(scheme, system, span, point, data)

    def undo(self, scheme, system, n, point, data):
        span = self.span(system, n)
        point = self.renewed(scheme, system, n + 1, span.t1, point)
        if not self._prepares_once(scheme, system):
            data = prepare(scheme.moves, system, span, backward=True)
        return backward(scheme.moves, system, span, data, point)

    def shorter(self, scheme, system, n, point, t):
        t0, since = self.span(system, n).t0, self.since_begin(n, point, t)
        point = self.renewed(scheme, system, n, t0, point)
        return between(scheme, system, Span(t0, *map(system.time, (t, since))), point)

    def explain(self, scheme, system, n, ends, result):
        times = [system.time(self.time(i)) for i in (0 * n, n)]
        timed = list(zip(times, ends, strict=True))
        n = 1 if self._prepares_once(scheme, system) else n  # All steps are alike.
        return explain(scheme, system, partial(self.span, system), n, timed, result)

    def growth(self, system, last):
        if system.has_unknown_friction:
            return jnp.full_like(self.t0, jnp.inf)
        if system.friction is None:
            return None
        # The first step after a kept state is not inverted.
        first = jnp.minimum(jnp.ones((), int), last)
        begin, end = (system.time(self.time(n)) for n in (first, last))
        return lax.stop_gradient(system.friction.growth(begin, end - begin))

    def without_gradient(self):
        return self

    def locate(
        self, ts: Float[Array, " times"]
    ) -> tuple[Int[Array, " times"], Bool[Array, " times"]]:
        """The step at whose start each time is, or the one that it is inside of; and
        whether it is inside.

        Equally spaced times may be computed in another order, and rounded otherwise: a
        time is the start of a step if it is so to rounding.
        """
        if self.ts is None:
            k: Any = 0
            if len(self.starts) > 1:
                k = jnp.searchsorted(self.starts[1:], ts).astype(int)
            length = jnp.where(self.length > 0, self.length, 1)[k]
            n = self.first[k] + jnp.round((ts - self.starts[k]) / length).astype(int)
            n = jnp.clip(n, 0, self.total)
        else:
            after = jnp.clip(jnp.searchsorted(self.ts, ts), 1, len(self.ts) - 1)
            before, next = self.ts[after - 1], self.ts[after]
            length = next - before
            n = jnp.where(ts - before < next - ts, after - 1, after).astype(int)
        start = self.time(n)
        inside = jnp.abs(ts - start) > rounding_of(self.t0, start, length)
        inside &= self.total > 0
        return jnp.where(inside & (ts < start), n - 1, n), inside
