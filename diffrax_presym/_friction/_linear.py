"""Linear friction of one system: prepared for a span of time, applied to momenta."""

import functools
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._numbers import as_time, Scalar, Time
from ._leaf import EntryFriction, MatrixFriction, reduce_any


_T = TypeVar("_T")
_LeafFriction = EntryFriction | MatrixFriction


class Effects(eqx.Module):
    """What was prepared of linear friction, for each leaf."""

    leaves: PyTree
    is_fixed: bool = eqx.field(static=True, default=False)


class LinearFriction(eqx.Module):
    """Linear friction `p' = F - Γ(t) p` of momenta of one structure.

    `prepare` gives what depends on time alone, for a span; the other methods apply it.
    Changes rather than new momenta are returned, for compensated summation.
    """

    leaves: PyTree[_LeafFriction]
    precision: float = eqx.field(static=True)  # the relative rounding of a momentum

    def _map(self, fn: Callable, *trees: PyTree) -> PyTree:
        """Of the friction of each leaf, and leaves of other trees."""
        return jtu.tree_map(fn, self.leaves, *trees, is_leaf=_is_leaf)

    def _each(self, fn: Callable[[_LeafFriction], _T]) -> list[_T]:
        """Of the friction of each leaf."""
        return [fn(leaf) for leaf in jtu.tree_leaves(self.leaves, is_leaf=_is_leaf)]

    def _largest(self, fn: Callable[[_LeafFriction], Scalar]) -> Scalar:
        return functools.reduce(jnp.maximum, self._each(fn))

    @property
    def is_autonomous(self) -> bool:
        """Whether what is prepared depends on the length of a span alone."""
        return all(self._each(lambda leaf: leaf.is_autonomous))

    @property
    def is_known(self) -> bool:
        """Whether what it does is known in closed form."""
        return all(self._each(lambda leaf: leaf.is_known))

    @property
    def is_one_rate(self) -> bool:
        """Whether all entries of each leaf decay alike, whatever the momentum."""
        return all(self._each(lambda leaf: leaf.is_one_rate))

    def prepare(self, t: Time, h: Time, order: int) -> Effects:
        """What it does from `t` to `t + h`; of at least the given order in `h` where it
        is not known in closed form."""
        return Effects(self._map(lambda leaf: leaf.prepare(t, h, order)))

    def over_step(
        self, t: Time, h: Time
    ) -> tuple["LinearFriction", Bool[Array, ""]] | None:
        """The same for spans within a step, faster, and whether it is right to
        rounding; `None` if it is known in closed form."""
        if self.is_known:
            return None
        replace = lambda leaf: leaf if leaf.is_known else leaf.over_step(t, h)
        fast = LinearFriction(self._map(replace), self.precision)
        decay = lambda leaf: leaf.within if isinstance(leaf, EntryFriction) else None
        each = [x.converged for x in fast._each(decay) if x is not None]
        return fast, functools.reduce(jnp.logical_and, each)

    def fix(self, effects: list[Effects]) -> list[Effects]:
        """What was prepared for many spans at once, to be applied many times: matrices
        are exponentiated."""
        if not effects:
            return []
        each = [x.leaves for x in effects]
        fixed = self._map(lambda leaf, *each: leaf.fix(each), *each)
        part = lambda i: self._map(lambda _, x: x[i], fixed)
        return [Effects(part(i), is_fixed=True) for i in range(len(effects))]

    def flow(self, effects: Effects, p: PyTree) -> tuple[PyTree, PyTree]:
        """The change of `p` by friction alone, and the integral of `p` meanwhile."""
        structure = jtu.tree_structure(p)
        flow = lambda leaf, effect, p: leaf.flow(effect, p)
        both = structure.flatten_up_to(self._map(flow, effects.leaves, p))
        change, carried = map(structure.unflatten, zip(*both, strict=True))
        return change, carried

    def decay(self, effects: Effects, p: PyTree) -> PyTree:
        """The change of `p` by friction alone."""
        decay = lambda leaf, effect, p: leaf.decay(effect, p)
        return self._map(decay, effects.leaves, p)

    def respond(self, effects: Effects, force: PyTree) -> PyTree:
        """The momentum left by a constant force."""
        respond = lambda leaf, effect, force: leaf.respond(effect, force)
        return self._map(respond, effects.leaves, force)

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        """The force less the friction, `F - Γ(t) p`."""
        net = lambda leaf, force, p: leaf.net_force(t, force, p)
        return self._map(net, force, p)

    def growth(self, t: Time, h: Time) -> Scalar:
        """The logarithm of the factor by which errors of `p` grow from `t + h` back to
        `t`."""
        return self._largest(lambda leaf: leaf.growth(t, h))

    def over(self, t: Time, h: Time, closely: bool = False) -> Scalar:
        """The largest friction over a span: the logarithm of the factor by which a
        momentum decays or grows, for matrices a bound from below, which takes another
        product to be close. Friction that falls with time is strong for some steps
        only, and is not counted."""
        return self._largest(lambda leaf: leaf.over(t, h, closely))

    def strength(self, t: Time, h: Time) -> Scalar:
        """The logarithm of the factor by which friction that lasts makes momenta decay
        over a span, in either direction."""
        t, h = as_time(t), as_time(h)
        first = jnp.minimum(t, t + h)
        return self._largest(lambda leaf: leaf.strength(first, jnp.abs(h)))

    def is_smooth(self, t: Time) -> Bool[Array, ""]:
        """Whether its rates have two derivatives at `t`."""
        each = self._each(lambda leaf: leaf.is_smooth(t))
        return functools.reduce(jnp.logical_and, each)

    def scaled(self, factor: Scalar) -> "LinearFriction":
        """A part of it."""
        leaves = self._map(lambda leaf: leaf.scaled(factor))
        return LinearFriction(leaves, self.precision)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether it is infinite at `t`; `None` if it never is."""
        return reduce_any(self._each(lambda leaf: leaf.is_singular(t)))

    def by_rates(self, start: Time | None = None) -> "LinearFriction":
        """The same with a rate in place of each matrix, that of the fastest decay or
        rotation, or a bound of it.

        Of motion from a `start`, without rates that are infinite there like one over
        the time since: it starts at rest, and never has the part that decays.
        """
        leaves = self._map(lambda leaf: leaf.by_rates(start))
        return LinearFriction(leaves, self.precision)


_is_leaf = lambda x: isinstance(x, _LeafFriction)
