"""The steps of a solve that are known beforehand, and in which of them it is saved."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._scheme._engine import Span
from .._system._bound import System


class Steps(eqx.Module):
    """Steps of one length, which divides the time of the solve, or prescribed ones."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    total: Int[Array, ""]
    length: Float[Array, ""]  # of steps of one length
    ts: Float[Array, " ends"] | None  # of prescribed steps

    def __init__(self, controller: dfx.AbstractStepSizeController, t0, t1, dt0):
        self.t0, self.t1, self.ts = t0, t1, None
        if isinstance(controller, dfx.StepTo):
            self.ts = controller.ts
            self.total = jnp.asarray(len(controller.ts) - 1)
            self.length = jnp.zeros_like(t0)
            return
        # As few equal steps as are not longer than `dt0`, but for rounding.
        eps, most = float(jnp.finfo(t0.dtype).eps), jnp.iinfo(int).max // 2
        number = jnp.ceil((t1 - t0) / dt0 * (1 - 2 * eps))
        finite = jnp.isfinite(number)
        # A time that is not finite is never reached, with steps of the given length.
        self.total = jnp.where(finite, number, 0).astype(int)
        self.total = jnp.where(finite, self.total, most)
        several = jnp.where(finite, jnp.maximum(number, 1), 1)
        self.length = jnp.where(finite, (t1 - t0) / several, dt0)

    @property
    def are_equal(self) -> bool:
        return self.ts is None

    def time(self, n: Int[Array, "..."]) -> Float[Array, "..."]:
        """The start of step `n`."""
        if self.ts is not None:
            return self.ts[n]
        t = self.t0 + self.length * n.astype(self.t0.dtype)
        return jnp.where(n >= self.total, self.t1, t)

    def span(self, system: System, n: Int[Array, ""]) -> Span:
        """Step `n`, in physical time."""
        t0, t1 = system.time(self.time(n)), system.time(self.time(n + 1))
        return Span(t0, t1, system.time(self.length) if self.are_equal else t1 - t0)

    def containing(self, ts: Float[Array, " times"]) -> Int[Array, " times"]:
        """The step in which each time is, its end included, its start not."""
        if self.ts is not None:
            return jnp.searchsorted(self.ts[1:], ts).astype(int)
        length = jnp.where(self.length > 0, self.length, 1)
        n = jnp.ceil((ts - self.t0) / length).astype(int) - 1
        # The quotient is rounded.
        n = jnp.where(self.time(n) >= ts, n - 1, n)
        n = jnp.where(self.time(n + 1) < ts, n + 1, n)
        return jnp.clip(n, 0, jnp.maximum(self.total - 1, 0))

    def is_start(
        self, n: Int[Array, " times"], ts: Float[Array, " times"]
    ) -> Bool[Array, " times"]:
        """Whether times are the start of step `n`, to rounding.

        Equally spaced times may be computed in another order, and rounded otherwise.
        """
        start = self.time(n)
        largest = jnp.maximum(jnp.abs(self.t0), jnp.abs(start))
        rounding = 4 * jnp.finfo(start.dtype).eps * largest
        length = jnp.maximum(self.time(n + 1) - start, start - self.time(n - 1))
        return jnp.abs(ts - start) <= jnp.minimum(rounding, length / 64)


class Rows(eqx.Module):
    """What one of `SaveAt(subs=...)` saves between the ends of a solve, in order."""

    time: Float[Array, " rows"]
    stop: Int[Array, " rows"]  # the step from whose start it is computed
    inside: Bool[Array, " rows"]  # whether it is within that step
    of_ts: Bool[Array, " rows"]  # whether it is of `ts`
    may_be_inside: bool = eqx.field(static=True)

    def __init__(self, sub: dfx.SubSaveAt, steps: Steps, max_steps: int | None):
        times, stops, insides = [], [], []
        self.may_be_inside = sub.ts is not None and len(sub.ts) > 0
        if sub.ts is not None:
            n = steps.containing(sub.ts)
            ends = steps.is_start(n + 1, sub.ts) & (steps.total > 0)
            times.append(sub.ts)
            stops.append(jnp.where(ends, n + 1, n))
            insides.append(~ends & ~steps.is_start(n, sub.ts) & (steps.total > 0))
        number = 0 if sub.ts is None else len(sub.ts)
        if sub.steps:
            assert max_steps is not None  # as Diffrax has checked
            n = sub.steps * jnp.arange(1, max_steps // sub.steps + 1)
            times.append(steps.time(n))
            stops.append(n)
            insides.append(jnp.zeros_like(n, bool))
        join = lambda x: jnp.concatenate(x) if x else jnp.zeros(0, int)
        time, stop, inside = map(join, (times, stops, insides))
        of_ts = jnp.arange(len(time)) < number
        if len(times) > 1:
            # Diffrax saves the times in a step before its end.
            order = jnp.lexsort((~of_ts, jnp.where(stop > steps.total, jnp.inf, time)))
            time, stop, inside, of_ts = (x[order] for x in (time, stop, inside, of_ts))
        self.time, self.stop, self.inside, self.of_ts = time, stop, inside, of_ts

    def __len__(self) -> int:
        return len(self.time)

    def reached(self, n: Int[Array, ""]) -> Bool[Array, " rows"]:
        """Which rows are known after `n` steps."""
        return self.stop + jnp.where(self.inside, 1, 0) <= n
