"""Which states of a solve are kept for its gradient, and the way back between them."""

import math

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._scheme._base import Point
from ._backward import Backward, BackwardState
from ._problem import Problem
from ._rows import stops_due
from ._tracks import AbstractTrack, Track
from ._variable import Kept


_NOT_RECOMPUTED = (
    "`FixedStepAdjoint` recomputed the states of this solve with an error beyond its "
    "`tol`: damping or instability amplifies rounding backwards in time, or steps are "
    "too long to be undone. Keep more states, `FixedStepAdjoint(checkpoints=...)`: if "
    "there are as many as steps, nothing is recomputed. Or write "
    '`FixedStepAdjoint("checkpoints")`, which needs `max_steps`. With `throw=False`, '
    "and for members of a batch, the gradient is NaN instead."
)


class Reversal(eqx.Module):
    """By running the scheme backwards between kept states."""

    most: int = eqx.field(static=True)  # of these
    apart: int = eqx.field(static=True)  # least steps between, if not all are kept
    tol: float | None
    inverse_error: float = eqx.field(static=True)  # of the scheme
    # `None`: an error, but NaN for the members of a batch.
    throw: bool | None = eqx.field(static=True)

    def limit(self, y: PyTree) -> tuple[float, float]:
        """The largest allowed error of a recomputed state, and that of a step back."""
        eps = float(max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(y)))
        eps = max(eps, self.inverse_error)
        return eps ** (2 / 3) if self.tol is None else self.tol, eps

    def places(self, problem: Problem) -> Array:
        """The steps whose starting states are kept, in order; those that are not are
        after the last step."""
        most, last = self.most + 1, jnp.asarray(problem.last)
        # If all are kept, no step is inverted.
        parts = jnp.where(last <= most, last, -(-last // self.apart))
        if problem.growth is not None:
            # Each part may amplify rounding up to the limit.
            allowed, eps = self.limit(problem.start[0])
            needed = 2 * problem.growth / max(math.log(allowed / eps), 1)
            # Infinite or undefined growth needs as many as there are.
            needed = jnp.where(needed < most, needed, most)
            parts = jnp.maximum(parts, jnp.ceil(needed).astype(parts.dtype))
        parts = jnp.clip(parts, 1, most)
        every = jnp.maximum(-(-last // parts), 1)
        # All members of a batch keep the same, if there is room for it.
        least = tree.smallest_member(every)
        room = most * least >= tree.largest_member(last)
        return jnp.arange(most) * jnp.where(room, least, every)

    def track(self, problem: Problem) -> AbstractTrack:
        if problem.steps.are_known:
            return _track(self.places(problem), problem)
        return Kept(self.most + 1, problem.start)

    def pull_back(self, backward: Backward) -> BackwardState:
        problem, trace = backward.problem, backward.trace
        places, states = self.places(problem), trace.kept
        if not problem.steps.are_known:
            places, states = states
        undo = problem.undo
        assert undo is not None
        at = backward.end()
        # Positions and momenta are compared in units of their largest values. The
        # solver state may be pure rounding, and is not compared.
        units = jtu.tree_map(
            lambda x, y: jnp.maximum(tree.largest(x), tree.largest(y)),
            *(problem.start[0], at.point[0]),
        )

        def size(y):
            scaled = jtu.tree_map(
                lambda x, u: (tree.largest(x) / jnp.where(u > 0, u, 1)).astype(float),
                *(y, units),
            )
            return jtu.tree_reduce(jnp.maximum, scaled)

        def part(x):
            at, worst, j = x
            j, end = j - 1, at.point[0]
            first, known = places[j], jtu.tree_map(lambda x: x[j], states)

            def start(n: Array, point: Point) -> Point:
                # A kept state is the start of its step, which need not be inverted.
                back = lambda: undo(n, point)
                if trace.before is not None:
                    back = lambda back=back: lax.cond(
                        n == trace.n - 1, lambda: trace.before, back
                    )
                return lax.cond(n == first, lambda: known, back)

            at = backward.back_to(at, first, start)
            miss = size(tree.sub(*at.ends))
            largest = jnp.maximum(size(known[0]), size(end))
            miss = miss / jnp.where(largest > 0, largest, 1)  # at rest at the origin
            return at, jnp.maximum(worst, miss), j

        parts = _parts(backward, places)
        zero = jnp.zeros_like(size(at.point[0]))
        at, miss, _ = lax.while_loop(lambda x: x[2] > 0, part, (at, zero, parts))
        at = backward.start(at)
        # A solve that diverged has a gradient of NaN anyway.
        missed = ~(miss <= self.limit(at.point[0])[0]) & tree.all_finite(trace.end[0])
        if self.throw is None:
            missed = _error_unless_batched(missed)
        elif self.throw:
            missed = eqx.error_if(missed, missed, _NOT_RECOMPUTED)
        nan = lambda x: jnp.where(missed, jnp.nan, x)
        where = lambda at: (at.gradient, at.bar)
        return eqx.tree_at(where, at, jtu.tree_map(nan, where(at)))


@jax.custom_batching.custom_vmap
def _error_unless_batched(missed: Bool[Array, ""]) -> Bool[Array, ""]:
    return eqx.error_if(missed, missed, _NOT_RECOMPUTED)


@_error_unless_batched.def_vmap
def _(axis_size, in_batched, missed):
    return missed, True


class Checkpoints(eqx.Module):
    """By computing the steps again from kept states."""

    max_steps: int | None = eqx.field(static=True)
    number: int | None = eqx.field(static=True)  # of states to keep

    @property
    def length(self) -> int:
        """The number of steps between two kept states."""
        most = self.max_steps
        if most is None:
            raise ValueError(
                "A gradient by checkpoints, the default of `FixedStepAdjoint` for a "
                "scheme without an inverse, needs to know how many steps to allocate "
                "memory for. Pass `diffeqsolve(..., max_steps=...)`, or use a scheme "
                'with an inverse and `FixedStepAdjoint("reversal")`.'
            )
        parts = math.isqrt(most) if self.number is None else self.number + 1
        return max(-(-most // max(parts, 1)), 1)

    def places(self, problem: Problem) -> Array:
        length = self.length
        number = max(-(-(self.max_steps or 0) // length), 1)
        return jnp.arange(number) * length

    def track(self, problem: Problem) -> AbstractTrack:
        return _track(self.places(problem), problem)

    def pull_back(self, backward: Backward) -> BackwardState:
        places, states = self.places(backward.problem), backward.trace.kept
        length = self.length

        def part(x):
            at, j = x
            j = j - 1
            first = places[j]
            known = jtu.tree_map(lambda x: x[j], states)
            stack = lambda x: jnp.broadcast_to(x, (length, *jnp.shape(x)))

            def again(n, x):
                point, points = x
                point = backward.problem.functions.step(n, point)[0]
                put = lambda xs, x: lax.dynamic_update_index_in_dim(
                    xs, x, n + 1 - first, 0
                )
                return point, jtu.tree_map(put, points, point)

            begin = known, jtu.tree_map(stack, known)
            _, points = lax.fori_loop(first, at.n - 1, again, begin)
            start = lambda n, _: jtu.tree_map(lambda x: x[n - first], points)
            return backward.back_to(at, first, start), j

        at = backward.end()
        parts = _parts(backward, places)
        at, _ = lax.while_loop(lambda x: x[1] > 0, part, (at, parts))
        return backward.start(at)


def _track(places: Array, problem: Problem) -> AbstractTrack:
    """The states at the starts of steps, as far as these are taken."""
    last, value = problem.last, lambda place, point: point
    stops = stops_due(places, places < last, last + 1)
    return Track(stops, places, value, problem.start)


def _parts(backward: Backward, places: Array) -> Array:
    """The number of parts between kept states on the way back."""
    number = jnp.maximum(jnp.sum(places < backward.trace.n), 1)
    # Members of a batch go together. Those that ended before a part have none there.
    known = backward.problem.steps.are_known
    return tree.largest_member(number) if known else number
