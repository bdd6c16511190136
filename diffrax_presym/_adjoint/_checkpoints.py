"""The gradient of a solve, with checkpoints if necessary."""

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._misc import largest, tree_sub
from ._backward import Backward
from ._types import Position


def gradient(
    backward: Backward, checkpoints: int, tol: float | None
) -> tuple[PyTree, PyTree]:
    """The cotangents of the initial state, and of the parameters."""
    final = backward.final
    eps = max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(final.y))
    limit = float(eps) ** (2 / 3) if tol is None else tol
    most = checkpoints + 1
    end = backward.end()
    states = _Checkpoints(backward, most)
    hopeless = ~(states.amplification() * float(eps) <= limit)

    def again(x):
        _, miss, tried = x
        return (tried == 0) | (~(miss <= limit) & (tried < most))

    def attempt(x):
        _, _, tried = x
        parts = jnp.where((tried == 0) & ~hopeless, 1, most)
        return *states.back_to_start(end, parts), parts

    nothing = (end, jnp.zeros(()), jnp.asarray(0))
    start, miss, _ = lax.while_loop(again, attempt, nothing)
    start = backward.start(states.first_step(start))
    # A solve that diverged has a gradient of NaN anyway.
    finite = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(final.y)]
    missed = ~(miss <= limit) & jnp.all(jnp.stack(finite))
    return eqx.error_if(
        (start.bar, start.gradient),
        missed,
        "`ReversibleAdjoint` recomputed the states of this solve with an error beyond "
        "its `tol`: damping or instability amplifies rounding backwards in time. Keep "
        "more states, `ReversibleAdjoint(checkpoints=...)`, or use "
        "`diffrax.RecursiveCheckpointAdjoint()`.",
    )


class _Checkpoints:
    """Known states, between which the backward pass runs in parts."""

    def __init__(self, backward: Backward, most: int):
        self.backward, self.most, first = backward, most, backward.first
        # A step from a singularity of the friction loses `p` and cannot be inverted. It
        # is recomputed forwards from the initial state instead.
        system, t0 = backward.system, backward.span(jnp.asarray(0)).t0
        friction = system.friction
        self.singular = None if friction is None else friction.is_singular(t0)
        self.known, self.skipped = first, jnp.asarray(0)
        if self.singular is not None:
            self.singular = self.singular & (backward.final.num_steps > 0)
            self.skipped = jnp.where(self.singular, 1, 0)
            redo = lambda: backward.advance(jnp.asarray(0), first)
            self.known = lax.cond(self.singular, redo, lambda: first)

    def first_step(self, at: Position) -> Position:
        """The step that cannot be inverted, if there is one."""
        if self.singular is None:
            return at
        redo = lambda at: self.backward.step(at, start=self.backward.first)
        return lax.cond(self.singular, redo, lambda at: at, at)

    def amplification(self) -> Array:
        """The factor by which friction amplifies rounding from the end to the start."""
        system, final = self.backward.system, self.backward.final
        if system.friction is None:
            return jnp.ones(())
        start = self.backward.time(self.skipped)
        t0, t1 = system.time(start), system.time(final.tprev)
        return system.friction.amplification(t0, t1 - t0)

    def back_to_start(self, at: Position, parts: Array) -> tuple[Position, Array]:
        """Back to the start in several parts, each from a known state.

        Also returns the largest error of a recomputed state, measured at the known
        states.
        """
        length = -(-(at.n - self.skipped) // parts)
        starts = lambda j: jnp.minimum(self.skipped + j * length, at.n)

        def keep(j, states):
            last = jtu.tree_map(lambda x: x[j - 1], states)
            advance = self.backward.advance
            state = lax.fori_loop(starts(j - 1), starts(j), advance, last)
            return jtu.tree_map(lambda x, s: x.at[j].set(s), states, state)

        states = jtu.tree_map(
            lambda x: jnp.broadcast_to(x, (self.most, *x.shape)), self.known
        )
        states = lax.fori_loop(1, parts, keep, states)
        # Positions and momenta are compared in units of their largest values. The
        # solver state may be pure rounding, and is not compared.
        units = jtu.tree_map(
            lambda x, y: jnp.maximum(largest(x), largest(y)),
            *(states[0], at.state[0]),
        )

        def size(state):
            scaled = jtu.tree_map(
                lambda x, u: (largest(x) / jnp.where(u > 0, u, 1)).astype(float),
                *(state[0], units),
            )
            return jtu.tree_reduce(jnp.maximum, scaled)

        def part(i, x):
            at, worst = x
            j = parts - 1 - i
            end, known = at.state, jtu.tree_map(lambda x: x[j], states)
            at = lax.while_loop(lambda at: at.n > starts(j), self.backward.step, at)
            miss = size(tree_sub(at.state, known))
            miss = miss / jnp.maximum(size(known), size(end))
            return at._replace(state=known), jnp.maximum(worst, miss)

        zero = jnp.zeros_like(size(self.known))
        return lax.fori_loop(0, parts, part, (at, zero))
