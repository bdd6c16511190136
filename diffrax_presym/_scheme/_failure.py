"""Why a solve failed, found where it ends."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, PyTree

from .. import _tree as tree
from .._numbers import State
from .._results import FRICTION_TOO_STRONG, NONFINITE, OFF_MANIFOLD, SUCCESSFUL
from .._system._bound import System
from ._engine import Span


def _is_too_strong(most: float, system: System, span: Span) -> Bool[Array, ""] | None:
    """Whether friction over a step is more than the `most` that is resolved; `None` if
    it never is."""
    if system.friction is None or most == math.inf:
        return None
    friction = tree.stop_gradient(system.friction)
    return friction.over(span.t0, span.h, closely=True) > most


def unless_too_strong(most: float, system: System, span: Span, data: PyTree) -> PyTree:
    """What was prepared for a step, not finite if friction is too strong for it."""
    bad = _is_too_strong(most, system, span)
    return data if bad is None else tree.invalid_if(bad, data)


def explain(
    scheme: Any,
    system: System,
    span: Callable[[Array], Span],
    n: ArrayLike,
    ends: Sequence[tuple[Array, tuple[State, PyTree]]],
    result: Any,
) -> Any:
    """The result of `n` steps of given spans, with its reason if a state is not finite
    because friction was too strong; or the failure of a scheme to take its ends."""
    first, most = jnp.zeros_like(n), scheme.most_friction
    if _is_too_strong(most, system, span(first)) is not None:
        bad = lambda i: jnp.asarray(_is_too_strong(most, system, span(i)))
        failed = result == NONFINITE
        if isinstance(n, int) and n == 1:
            found = failed & bad(first)
        else:  # Only a solve that failed looks for the step.
            more = lambda i: failed & (i < n) & ~bad(i)
            found = failed & (lax.while_loop(more, lambda i: i + 1, first) < n)
        result = dfx.RESULTS.where(found, FRICTION_TOO_STRONG, result)
    result = dfx.RESULTS.where(result == NONFINITE, scheme.failure, result)
    t, point = ends[0]
    y = tree.values(point[0])
    off = system.term.off_manifold(t, span(first).h, *y, system.args)
    if off is not None:
        failure = SUCCESSFUL
        least = float(jnp.finfo(off.dtype).eps) ** 0.5
        for most, entry in OFF_MANIFOLD.items():
            failure = dfx.RESULTS.where(off > max(most, least), entry, failure)
        # Whatever else failed, failed for this reason.
        result = dfx.RESULTS.where(failure == SUCCESSFUL, result, failure)
    if scheme.check is not None:
        for t, point in ends:
            failure = scheme.check(system, t, *point)
            result = dfx.RESULTS.where(result == SUCCESSFUL, failure, result)
    return result
