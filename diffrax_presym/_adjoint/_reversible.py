"""Gradients by running the scheme backwards.

The inverse of a list of moves is the list of their inverses in reverse order. So the
states of a solve need not be stored for its gradient: each is recomputed from the next
one, and cotangents are pulled back through the step between them.
"""

import math

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._loop import Plan
from .._misc import all_finite, as_positive, largest, tree_sub
from ._backward import Backward, Position
from ._base import AbstractFixedStepAdjoint
from ._rule import refuse


# The least number of steps between two kept states.
_APART = 16


class ReversibleAdjoint(AbstractFixedStepAdjoint):
    r"""Exact gradients in constant memory, by running the scheme backwards; and, with
    or without gradients, the fast loop for steps that are known beforehand.

    Saved times cost little, and between steps the solution has the full order of the
    scheme: it is a shorter step of the scheme itself.

    The gradient is that of the discrete solution ("discretise, then optimise"). It
    agrees with that of [`diffrax_presym.FixedStepAdjoint`][] to rounding, and costs two
    to four solves for any number of steps.

    For every solver of this package with an adjoint method, with
    `diffrax.ConstantStepSize` or `diffrax.StepTo` and any `SaveAt`, and with respect to
    `y0`, `args`, the term, and everything that a function of these or of
    `SaveAt(fn=...)` closes over. Events, adaptive steps and derivatives with respect to
    times are errors; use `diffrax.RecursiveCheckpointAdjoint` for these. For second
    derivatives use forward mode over reverse mode, `jax.jvp` of `jax.grad`.

    Damping loses information: backwards in time rounding errors grow by $e^{\eta(t_1) -
    \eta(t_0)}$. So states are kept along the way, more with more damping, from which
    the backward pass restarts. The error of the recomputed states is measured at each
    kept state, and one beyond `tol` raises an error.
    """

    checkpoints: int = 128
    tol: float | None = None

    def __check_init__(self):
        if not isinstance(self.checkpoints, int) or self.checkpoints < 0:
            raise ValueError(
                "`ReversibleAdjoint(checkpoints=...)` must be a Python integer, zero "
                f"or more, but got {self.checkpoints!r}."
            )
        if self.tol is not None:
            as_positive(self.tol, "`ReversibleAdjoint(tol=...)`")

    def check(self, solver) -> None:
        if solver.reverse is None:
            what = f"`{type(solver).__name__}`, which has no known adjoint method"
            instead = "`diffrax_presym.FixedStepAdjoint()`"
            raise ValueError(refuse(self, what, instead))

    def limit(self, y: PyTree) -> tuple[float, float]:
        """The largest allowed error of a recomputed state, and that of rounding."""
        eps = float(max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(y)))
        return eps ** (2 / 3) if self.tol is None else self.tol, eps

    def keep(self, plan: Plan) -> Array:
        first, most = _first_known(plan), self.checkpoints + 1
        steps = plan.last - first
        parts = -(-steps // _APART)
        friction, system = plan.system.friction, plan.system
        if friction is not None:
            # Each part may amplify rounding up to the limit.
            t0, t1 = (system.time(plan.steps.time(n)) for n in (first, plan.last))
            (_, p), _ = plan.start
            limit, eps = self.limit(plan.start[0])
            amplified = jnp.log(friction.amplification(t0, t1 - t0, p))
            needed = 2 * amplified / max(math.log(limit / eps), 1)
            # Infinite or undefined amplification needs as many as there are.
            needed = jnp.where(needed < most, needed, most)
            parts = jnp.maximum(parts, jnp.ceil(needed).astype(parts.dtype))
        parts = jnp.clip(parts, 1, most)
        places = first + jnp.arange(most) * -(-steps // parts)
        kept = (places < plan.last) | (jnp.arange(most) == 0)
        return jnp.where(kept, places, plan.last + 1)

    def back(self, backward: Backward) -> Position:
        plan, trace = backward.plan, backward.trace
        places, states = self.keep(plan), trace.kept
        first, at = places[0], backward.end()
        # Positions and momenta are compared in units of their largest values. The
        # solver state may be pure rounding, and is not compared.
        units = jtu.tree_map(
            lambda x, y: jnp.maximum(largest(x), largest(y)), plan.start[0], at.state[0]
        )

        def size(state):
            scaled = jtu.tree_map(
                lambda x, u: (largest(x) / jnp.where(u > 0, u, 1)).astype(float),
                *(state[0], units),
            )
            return jtu.tree_reduce(jnp.maximum, scaled)

        def part(x):
            at, worst, j = x
            j, end = j - 1, at.state
            known = jtu.tree_map(lambda x: x[j], states)
            at = backward.back_to(at, places[j], lambda n: None)
            miss = size(tree_sub(at.state, known))
            miss = miss / jnp.maximum(size(known), size(end))
            return at._replace(state=known), jnp.maximum(worst, miss), j

        parts = jnp.maximum(jnp.sum(places < trace.n), 1)
        zero = jnp.zeros_like(size(at.state))
        at, miss, _ = lax.while_loop(lambda x: x[2] > 0, part, (at, zero, parts))
        if _is_singular(plan) is not None:
            # The first step cannot be inverted, and is pulled back from its start.
            redo = lambda at: backward.step(at, plan.start)
            at = lax.cond((first > 0) & (at.n > 0), redo, lambda at: at, at)
            at = backward.back_to(at, jnp.asarray(0), lambda n: None)
        at = backward.start(at)
        undoable = plan.solver.undoable(plan.start[1], trace.end[1])
        if undoable is not None:
            at = eqx.error_if(
                at,
                ~undoable,
                "`ReversibleAdjoint` cannot undo this solve: its steps change in "
                "length, or its friction abruptly, and there a multistep method starts "
                "again without its history. Use steps of one length, or "
                "`diffrax_presym.FixedStepAdjoint()`.",
            )
        # A solve that diverged has a gradient of NaN anyway.
        missed = ~(miss <= self.limit(at.state[0])[0]) & all_finite(trace.end[0])
        bar, gradient = eqx.error_if(
            (at.bar, at.gradient),
            missed,
            "`ReversibleAdjoint` recomputed the states of this solve with an error "
            "beyond its `tol`: damping or instability amplifies rounding backwards in "
            "time. Keep more states, `ReversibleAdjoint(checkpoints=...)`, or use "
            "`diffrax_presym.FixedStepAdjoint()`.",
        )
        return at._replace(bar=bar, gradient=gradient)


def _is_singular(plan: Plan) -> Array | None:
    """Whether friction is infinite at the start; `None` if it never is."""
    friction = plan.system.friction
    if friction is None:
        return None
    return friction.is_singular(plan.system.time(plan.steps.t0))


def _first_known(plan: Plan) -> Array:
    """The first step that can be inverted.

    A step from a singularity of the friction loses `p`, and cannot be inverted.
    """
    singular = _is_singular(plan)
    if singular is None:
        return jnp.asarray(0)
    return jnp.where(singular & (plan.last > 0), 1, 0)


ReversibleAdjoint.__init__.__doc__ = r"""**Arguments:**

- `checkpoints`: the maximum number of states to keep besides the two ends, which
    determines the memory. Defaults to 128, enough for an increment of $\eta$ of 1000 in
    `float64`, and of a few hundred in `float32`.
- `tol`: the largest error of a recomputed state, relative to the size of the state.
    Defaults to the precision of the state to the power 2/3: 4e-11 in `float64`, 2e-5
    in `float32`.

**Raises:**

`ValueError` if either is out of range, and when the solve is traced if it is not
supported. `RuntimeError` when the gradient is computed, if the error at a known state
exceeds `tol`.
"""
