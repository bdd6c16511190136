"""Gradients by keeping states along the way, and recomputing those between them."""

import math

import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._loop import Plan
from ._backward import Backward, Position
from ._base import AbstractFixedStepAdjoint


class FixedStepAdjoint(AbstractFixedStepAdjoint):
    """The fast loop for steps that are known beforehand, with gradients by checkpoints.

    For schemes that [`diffrax_presym.ReversibleAdjoint`][] cannot run backwards, and
    solves whose damping or instability leaves it too little precision. Solves are the
    same. For gradients, states are kept along the way, by default the square root of
    `max_steps` of them, and those between two of them are computed again. The cost is
    one solve more than the vector-Jacobian products, about that of `ReversibleAdjoint`,
    and the memory grows with the square root of the number of steps.

    What is supported is otherwise as for `ReversibleAdjoint`.
    """

    checkpoints: int | None = None

    def __check_init__(self):
        checkpoints = self.checkpoints
        if checkpoints is None:
            return
        if not isinstance(checkpoints, int) or checkpoints < 0:
            raise ValueError(
                "`FixedStepAdjoint(checkpoints=...)` must be a Python integer, zero "
                f"or more, or `None`, but got {checkpoints!r}."
            )

    def _parts(self, plan: Plan) -> tuple[int, int]:
        """The largest number of parts, and the number of steps in each."""
        most = plan.rest["max_steps"]
        if most is None:
            raise ValueError(
                "A gradient by `FixedStepAdjoint` needs to know how many steps to "
                "allocate memory for. Pass `diffeqsolve(..., max_steps=...)`, or use "
                "`ReversibleAdjoint()`."
            )
        parts = math.isqrt(most) if self.checkpoints is None else self.checkpoints + 1
        length = max(-(-most // max(parts, 1)), 1)
        return max(-(-most // length), 1), length

    def keep(self, plan: Plan) -> Array:
        parts, length = self._parts(plan)
        places = jnp.arange(parts) * length
        kept = (places < plan.last) | (places == 0)
        return jnp.where(kept, places, plan.last + 1)

    def back(self, backward: Backward) -> Position:
        trace, plan = backward.trace, backward.plan
        places, (_, length) = self.keep(plan), self._parts(plan)

        def part(x):
            at, j = x
            j = j - 1
            first = places[j]
            known = jtu.tree_map(lambda x: x[j], trace.kept)
            stack = lambda x: jnp.broadcast_to(x, (length, *jnp.shape(x)))

            def again(n, x):
                state, states = x
                state = backward.advance(n, state)
                put = lambda xs, x: lax.dynamic_update_index_in_dim(
                    xs, x, n + 1 - first, 0
                )
                return state, jtu.tree_map(put, states, state)

            begin = known, jtu.tree_map(stack, known)
            _, states = lax.fori_loop(first, at.n - 1, again, begin)
            start = lambda n: jtu.tree_map(lambda x: x[n - first], states)
            return backward.back_to(at, first, start), j

        parts = jnp.maximum(jnp.sum(places < trace.n), 1)
        at, _ = lax.while_loop(lambda x: x[1] > 0, part, (backward.end(), parts))
        return backward.start(at)


FixedStepAdjoint.__init__.__doc__ = """**Arguments:**

- `checkpoints`: the number of states to keep besides the two ends. Defaults to `None`,
    the square root of `max_steps`, with which the memory is least.

**Raises:**

`ValueError` if it is out of range, when the solve is traced if it is not supported, and
when its gradient is traced if `max_steps` is `None`.
"""
