"""The moves of schemes with two copies of the system, explicit for any energy.

Each copy takes arguments from the other, and both share one moving frame. The state
within a step is `y, (copy, field)`, with the velocity and force of the last exchange.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._misc import largest, tree_add, tree_scale
from .._split import State
from .._system import System
from ._engine import Move, Outcome, Span, Stage


def paired_field(system: System, t: Array, y: State, copy: State) -> State:
    """Velocity and force at `q` of one copy and `p` of the other."""
    at = (y[0], copy[1])
    return system.velocity(t, at), system.force(t, at)


def exchange(second: bool = False, known: bool = False) -> Move:
    """The flow of `H(t, q, p_copy)`, equation (tao_map1), or of `H(t, q_copy, p)`, for
    the `second` copy."""

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

    # The map does not change the arguments of its field: its inverse is the same map.
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
    """From the mean and half of the difference, rotated, to two copies; the inverse
    joins them."""

    def apart(system: System, span: Span, stage: Stage) -> Outcome:
        y, half = stage
        half = rotated(span.h, half)
        y, copy = system.add(y, 1, half), system.add(y, -1, half)
        return (y, (copy, paired_field(system, span.t0, y, copy))), None

    def join(system: System, span: Span, stage: Stage) -> Outcome:
        y, (copy, field) = stage
        half = tree_scale(0.5, system.subtract(y, copy))
        y = system.add(y, -1, half)
        result = _distance_check(system, span.h, y, half, field)
        return (y, rotated(span.h, half)), result

    return Move(apart, join)


def _distance_check(system: System, h: Array, y: State, half: State, field: State):
    """A failure once the copies have parted.

    They are separate trajectories, and their mean is none, if they are further from
    each other than they are large, or move in a step: what oscillates passes zero.
    """
    state, rates = system.values(y), system.values(field)
    with jax.numpy_dtype_promotion("standard"):
        sizes = [
            jnp.maximum(largest(x), jnp.abs(h) * largest(rate))
            for x, rate in zip(state, rates, strict=True)
        ]
        # Rounding may be larger than what is at rest.
        eps = max(float(jnp.finfo(x.dtype).eps) for x in sizes)
        rounding = eps ** (1 / 3) * jnp.maximum(*sizes)
        pairs = zip(half, sizes, strict=True)
        q, p = (2 * largest(x) > jnp.maximum(size, rounding) for x, size in pairs)
    failure: Any = dfx.RESULTS.nonlinear_divergence
    return dfx.RESULTS.where(q | p, failure, dfx.RESULTS.successful)


def rotate(angle: Array, y: State, scale: ArrayLike = 1.0) -> State:
    """`q` and `p` rotated into each other, with `q` in units of `scale`.

    Both are updated at once. Sequential updates would not be symplectic, although the
    energy would look right.
    """
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    q, p = y
    q1 = tree_add(tree_scale(cos, q), sin * scale, p)
    return q1, tree_add(tree_scale(cos, p), -sin / scale, q)
