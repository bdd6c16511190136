"""The flow of a momentum alone, by forces that depend on it."""

import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._implicit import contract, implicit, largest_change, lowest
from .._numbers import as_time, Time


_Force = Callable[[PyTree], PyTree]  # of the momentum


class _Equation(eqx.Module):
    """The change of a momentum is a part from the start, and one from the end."""

    p: PyTree
    start: PyTree
    end: _Force

    def residual(self, change: PyTree) -> PyTree:
        new = tree.add(self.start, self.end(tree.add(self.p, change)))
        return tree.sub(new, change)


def force_flow(
    force: _Force, h: Time, p: PyTree, order: int
) -> tuple[PyTree, Bool[Array, ""]]:
    """The change of a momentum by a force over a length `h`, and whether it was found.

    Of at least the given order, and symmetric: the length `-h` is the inverse. By `p_1
    - p_0 = Σ_j c_j h^j (g_0^(j-1) - (-1)^j g_1^(j-1))` with `k` derivatives at both
    ends and the coefficients of the Padé approximation of the exponential, of order
    `2 k`. Collocation would have more unknowns, and a guess that is worse.
    """
    k, h = (order + 1) // 2, as_time(h)
    taylor = [h**j / math.factorial(j) for j in range(1, k + 1)]
    pade = [math.comb(k, j) / math.comb(2 * k, j) * x for j, x in enumerate(taylor, 1)]
    at_end = [(-1) ** j * x for j, x in enumerate(pade)]
    series = lambda weights, x: functools.reduce(tree.add, map(tree.scale, weights, x))
    # A gradient computes them again: to keep all that they consist of takes three times
    # as long to compile.
    derivatives = lambda p: _derivatives(force, p, k)
    derivatives = jax.checkpoint(derivatives, prevent_cse=False)
    end = lambda p: series(at_end, derivatives(p))
    # Traced once, with all that it depends on, to be differentiated.
    end, known = eqx.filter_closure_convert(end, p), derivatives(p)
    equation, guess = _Equation(p, series(pade, known), end), series(taylor, known)
    change, found = implicit(equation, guess, find=_iterate, tangent=contract)
    if k > 1:
        # The inverse does not converge to a start where the slope is too large, and a
        # force that is flat at the end of the step may hide that.
        sizes = [tree.dot(x, x) for x in tree.stop_gradient(known[:2])]
        found &= h * h * sizes[1] <= _STIFF**2 * sizes[0]
    return change, found


def _derivatives(force: _Force, p: PyTree, number: int) -> list[PyTree]:
    """A force and its derivatives along the motion of the momentum by it."""
    if number == 1:
        return [force(p)]
    # Each with one derivative more, of which the first is that of the force: evaluated
    # one by one, their derivatives would have half as much code again.
    lower = lambda p: _derivatives(force, p, number - 1)
    (known, *_), changes = jax.jvp(lower, (p,), (force(p),))
    # Of a speed, at rest, it is not finite, and nothing else is known of it.
    finite = lambda x: jnp.where(jnp.isfinite(x), x, 0)
    return [known, *jtu.tree_map(finite, changes)]


_NEGLIGIBLE = 1 / 8  # largest estimated change of another iteration to stop
_ROUNDING = 16.0  # largest change at which stagnation is attributed to rounding
_STALLED = 4  # iterations without a smaller change, after which a larger one may be
_MOST = 128  # iterations
_STIFF = 4.0  # slope times length, about twice that at which iterations diverge


def _iterate(equation: _Equation, guess: PyTree) -> tuple[PyTree, Bool[Array, ""]]:
    """Fixed-point iteration to rounding: kicks are so short that it takes a few."""
    first = jnp.full_like(tree.largest(guess), _ROUNDING)
    # Forces that balance each other leave the rounding of the largest of them.
    rounding = float(jnp.finfo(lowest(guess)).eps) ** (-1 / 2)

    def ends(change):
        # A momentum that changes its sign may be far smaller at one of its ends than
        # the rounding errors of its change.
        new = tree.add(equation.p, change)
        return jtu.tree_map(lambda *x: jnp.stack(x), equation.p, new)

    def iterate(state):
        found, moved, _, least, stalled, count = state
        new = tree.add(found, equation.residual(found))
        change = largest_change(ends(new), ends(found), first.dtype)
        stalled = jnp.where(change < least, 0, stalled + 1)
        return new, change, moved, jnp.minimum(change, least), stalled, count + 1

    def converged(state) -> Bool[Array, ""]:
        _, moved, before, _, stalled, _ = state
        stagnates = (moved < _ROUNDING) & (moved >= before)
        stagnates |= (stalled >= _STALLED) & (moved < rounding)
        return (moved * (moved / before) <= _NEGLIGIBLE) | stagnates

    going = lambda x: ~converged(x) & jnp.isfinite(x[1]) & (x[-1] < _MOST)
    none = jnp.asarray(0)
    start = guess, first, first, jnp.full_like(first, jnp.inf), none, none
    state = lax.while_loop(going, iterate, start)
    return state[0], converged(state)
