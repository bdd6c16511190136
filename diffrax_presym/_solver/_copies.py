"""The moves of schemes with two copies of the system, explicit for any energy.

The copies are each the argument of the other, and live in one moving frame. The state
of a step in progress is `y, (copy, field)`, with the velocity and force of the last
exchange.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike

from .._misc import tree_add, tree_scale, values
from .._split import State
from .._system import System
from ._engine import Move, Outcome, Span, Stage


def paired_field(system: System, t: Array, y: State, copy: State) -> State:
    """Velocity and force where `q` is of one copy and `p` of the other."""
    at = (y[0], copy[1])
    return system.velocity(t, at), system.force(t, at)


def exchange(second: bool = False, known: bool = False) -> Move:
    """The flow of `H(t, q, p_copy)`, equation (tao_map1), or with the `second` of the
    two copies in the role of the first."""

    def move(known: bool, system: System, span: Span, stage: Stage) -> Outcome:
        y, (copy, carried) = stage
        (q, p), (q_copy, p_copy) = (copy, y) if second else (y, copy)
        if known:
            field = carried
        else:
            field = paired_field(system, span.t0, (q, p), (q_copy, p_copy))
        velocity, force = field
        first = q, system.add(p, span.h, force)
        other = system.add(q_copy, span.h, velocity), p_copy
        if second:
            return (other, (first, carried)), None
        return (first, (other, field)), None

    # The map leaves its own arguments alone.
    return Move(partial(move, known), partial(move, False))


def _move_frames(system: System, span: Span, stage: Stage) -> Outcome:
    (q, p), ((q_copy, p_copy), field) = stage
    p, p_copy = (system.move_frame(span.t0, span.h, x) for x in (p, p_copy))
    return ((q, p), ((q_copy, p_copy), field)), None


move_frames = Move(_move_frames, _move_frames)


def coupling(angle: Callable[[Array], Array]) -> Move:
    """The flow of the coupling, which rotates the difference: equation (tao_map2)."""

    def move(system: System, span: Span, stage: Stage) -> Outcome:
        y, (copy, field) = stage
        half = tree_scale(0.5, system.subtract(y, copy))
        change = tree_add(rotate(angle(span.h), half), -1, half)
        return (system.add(y, 1, change), (system.add(copy, -1, change), field)), None

    return Move(move, move)


def separate(rotated: Callable[[Array, State], State]) -> Move:
    """From a mean to two copies, by half of their difference, rotated; the inverse
    joins them."""

    def apart(system: System, span: Span, stage: Stage) -> Outcome:
        y, half = stage
        half = rotated(span.h, half)
        y, copy = system.add(y, 1, half), system.add(y, -1, half)
        return (y, (copy, paired_field(system, span.t0, y, copy))), None

    def join(system: System, span: Span, stage: Stage) -> Outcome:
        y, (copy, _) = stage
        half = tree_scale(0.5, system.subtract(y, copy))
        return (system.add(y, -1, half), rotated(span.h, half)), None

    return Move(apart, join)


def rotate(angle: Array, y: State, scale: ArrayLike = 1.0) -> State:
    """`q` and `p` rotated into each other, with `q` in units of `scale`.

    Both change at once. One after the other they would still look right in the energy,
    and not be symplectic.
    """
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    q, p = y
    q1 = tree_add(tree_scale(cos, q), sin * scale, p)
    return q1, tree_add(tree_scale(cos, p), -sin / scale, q)


def largest(x: State) -> Array:
    """The largest of all entries, without its sign."""
    sizes = jtu.tree_map(lambda x: jnp.max(jnp.abs(x), initial=0), values(x))
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.maximum, sizes)
