"""Which states of a solve are kept for its gradient, and the way back between them."""

import math
from typing import Any

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .. import _tree as tree
from ._backward import Backward, Position
from ._run import Problem


# The least number of steps between two kept states, of a gradient by reversal.
_APART = 16


def limit(adjoint: Any, y: PyTree) -> tuple[float, float]:
    """The largest allowed error of a recomputed state, and that of rounding."""
    eps = float(max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(y)))
    return eps ** (2 / 3) if adjoint.tol is None else adjoint.tol, eps


def kept_steps(adjoint: Any, problem: Problem) -> tuple[Array, Any]:
    """The steps whose starting states are kept, in order; those that are not are
    after the last step. And the number of steps between them, if it is known."""
    if adjoint.gradient == "checkpoints":
        most = problem.max_steps
        if most is None:
            raise ValueError(
                "A gradient by checkpoints, the default of `FixedStepAdjoint` for a "
                "scheme without an inverse, needs to know how many steps to allocate "
                "memory for. Pass `diffeqsolve(..., max_steps=...)`, or use a scheme "
                'with an inverse and `FixedStepAdjoint("reversal")`.'
            )
        number = adjoint.checkpoints
        parts = math.isqrt(most) if number is None else number + 1
        length = max(-(-most // max(parts, 1)), 1)
        places = jnp.arange(max(-(-most // length), 1)) * length
        return _places(places, problem.last), length
    most = (128 if adjoint.checkpoints is None else adjoint.checkpoints) + 1
    first, system = _first_invertible(problem), problem.system
    steps = problem.last - first
    parts = -(-steps // _APART)
    if system.friction is not None:
        # Each part may amplify rounding up to the limit.
        t0, t1 = (system.time(problem.steps.time(n)) for n in (first, problem.last))
        allowed, eps = limit(adjoint, problem.start[0])
        growth = system.friction.growth(t0, t1 - t0)
        needed = 2 * growth / max(math.log(allowed / eps), 1)
        # Infinite or undefined growth needs as many as there are.
        needed = jnp.where(needed < most, needed, most)
        parts = jnp.maximum(parts, jnp.ceil(needed).astype(parts.dtype))
    parts = jnp.clip(parts, 1, most)
    places = first + jnp.arange(most) * -(-steps // parts)
    return _places(places, problem.last), None


def pull_back(adjoint: Any, backward: Backward) -> Position:
    places, length = kept_steps(adjoint, backward.problem)
    if length is None:
        return _by_reversal(adjoint, backward, places)
    return _by_checkpoints(backward, places, length)


def _by_reversal(adjoint: Any, backward: Backward, places: Array) -> Position:
    problem, trace = backward.problem, backward.trace
    at, pulls = backward.end()
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
        known = jtu.tree_map(lambda x: x[j], trace.kept)
        at = backward.back_to(at, pulls, places[j], lambda n: None)
        miss = size(tree.sub(at.point[0], known[0]))
        largest = jnp.maximum(size(known[0]), size(end))
        miss = miss / jnp.where(largest > 0, largest, 1)  # at rest at the origin
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
    # A solve that diverged has a gradient of NaN anyway.
    missed = ~(miss <= limit(adjoint, at.point[0])[0]) & tree.all_finite(trace.end[0])
    return eqx.error_if(
        at,
        missed,
        "`FixedStepAdjoint` recomputed the states of this solve with an error "
        "beyond its `tol`: damping or instability amplifies rounding backwards in "
        "time. Keep more states, `FixedStepAdjoint(checkpoints=...)`, or write "
        '`FixedStepAdjoint("checkpoints")`.',
    )


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
