"""Why a solve failed, found where it ends."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, PyTree

from .. import _tree as tree
from .._numbers import State
from .._results import _SUCCESSFUL, FRICTION_TOO_STRONG, NONFINITE
from .._system._bound import System
from ._engine import Span


def _is_too_strong(most: float, system: System, span: Span) -> Bool[Array, ""] | None:
    """Whether friction over a step is more than the `most` that is resolved; `None` if
    it never is."""
    if system.friction is None or most == math.inf:
        return None
    arrays, other = eqx.partition(system.friction, eqx.is_array)
    friction = eqx.combine(lax.stop_gradient(arrays), other)
    return friction.over(span.t0, span.h) > most


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
    if scheme.check is not None:
        for t, point in ends:
            failure = scheme.check(system, t, *point)
            result = dfx.RESULTS.where(result == _SUCCESSFUL, failure, result)
    return result
