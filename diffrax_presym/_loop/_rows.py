"""What is saved of a solve, and in which of its steps."""

from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._base import AbstractSteps
from ._steps import Steps


class Row(NamedTuple):
    """What is known of a row before the solve; or of all rows, stacked."""

    time: Float[Array, "..."]
    stop: Int[Array, "..."]
    inside: Bool[Array, "..."]


def stops_due(
    stops: Int[Array, " rows"], due: Bool[Array, " rows"], never: Array
) -> Int[Array, " rows+1"]:
    """Those of the first rows, which are due, and then one that is never reached."""
    return jnp.append(jnp.where(due, stops, never), never)


class Rows(eqx.Module):
    """What one of `SaveAt(subs=...)` saves between the ends of a solve, in order."""

    time: Float[Array, " rows"]  # zero until it is found, unless it `has_times`
    # The step from whose start it is computed; -1 if its time is not a number, a gap in
    # measured times, for which nothing is saved.
    stop: Int[Array, " rows"]
    inside: Bool[Array, " rows"]  # whether it is within that step
    known: Int[Array, " rows"]  # the number of steps after which it is known
    of_ts: Bool[Array, " rows"]  # whether it is of `ts`
    may_be_inside: bool = eqx.field(static=True)
    # Not if they are at the ends of steps that are not known beforehand.
    has_times: bool = eqx.field(static=True)

    def __init__(self, sub: dfx.SubSaveAt, steps: AbstractSteps, max_steps: int | None):
        times, stops, insides = [], [], []
        self.may_be_inside = sub.ts is not None and len(sub.ts) > 0
        self.has_times = steps.are_known or not sub.steps
        if sub.ts is not None:
            times.append(sub.ts)
            gap, (stop, inside) = jnp.isnan(sub.ts), steps.locate(sub.ts)
            stops.append(jnp.where(gap, -1, stop))
            insides.append(inside & ~gap)
        number = 0 if sub.ts is None else len(sub.ts)
        if sub.steps:
            assert max_steps is not None  # As has been checked.
            n = sub.steps * jnp.arange(1, max_steps // sub.steps + 1)
            unknown = jnp.zeros(n.shape, steps.t0.dtype)
            times.append(steps.time(n) if isinstance(steps, Steps) else unknown)
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
        self.known = stop + jnp.where(inside, 1, 0)

    def known_after(self, number: Int[Array, " rows"]) -> "Rows":
        """The same, of which each is known after another number of steps."""
        return eqx.tree_at(lambda self: self.known, self, number)

    def at(self, time: Float[Array, " rows"]) -> "Rows":
        """The same, of which the times have been found."""
        return eqx.tree_at(lambda self: self.time, self, time)

    def found(self, stop: Array, inside: Array) -> "Rows":
        """The same, of which the steps have been found."""
        gap = jnp.isnan(self.time)
        stop, inside = jnp.where(gap, -1, stop), inside & ~gap
        new = stop, inside, stop + jnp.where(inside, 1, 0)
        return eqx.tree_at(lambda self: (self.stop, self.inside, self.known), self, new)

    @property
    def each(self) -> Row:
        """All rows."""
        return Row(self.time, self.stop, self.inside)

    def __len__(self) -> int:
        return len(self.time)

    def reached(self, n: Int[Array, ""]) -> Bool[Array, " rows"]:
        """Which rows are known after `n` steps."""
        return self.known <= n

    def first_left(self, n: Int[Array, ""]) -> Int[Array, ""]:
        """The first row that is not known after `n` steps: gaps after it are."""
        return jnp.argmin(jnp.append(self.reached(n), False)).astype(int)

    def taken(self, n: Int[Array, ""]) -> Bool[Array, " rows"]:
        """Which of these have a value."""
        return self.reached(n) & (self.stop >= 0)
