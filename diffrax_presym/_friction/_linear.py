"""Linear friction of one system: prepared for a span of time, applied to momenta."""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._numbers import as_time, Scalar, Time
from ._leaf import EntryFriction, MatrixFriction, reduce_any
from ._over_step import FrictionOverStep


class Effects(eqx.Module):
    """What was prepared of linear friction, for each leaf."""

    leaves: PyTree
    is_fixed: bool = eqx.field(static=True, default=False)


class LinearFriction(eqx.Module):
    """Linear friction `p' = F - Γ(t) p` of momenta of one structure.

    `prepare` gives what depends on time alone, for a span; the other methods apply it.
    Changes rather than new momenta are returned, for compensated summation.
    """

    leaves: PyTree[EntryFriction | MatrixFriction | FrictionOverStep]
    precision: float = eqx.field(static=True)  # the relative rounding of a momentum

    def _map(self, method: str, *trees: PyTree) -> PyTree:
        """A method of the friction of each leaf, with leaves of other trees."""
        call = lambda leaf, *x: getattr(leaf, method)(*x)
        return jtu.tree_map(call, self.leaves, *trees, is_leaf=_is_leaf)

    def _each(self, method: str, *args) -> list[Any]:
        """A method of the friction of each leaf, with the same arguments."""
        leaves = jtu.tree_leaves(self.leaves, is_leaf=_is_leaf)
        return [getattr(leaf, method)(*args) for leaf in leaves]

    @property
    def is_autonomous(self) -> bool:
        """Whether what is prepared depends on the length of a span alone."""
        leaves = jtu.tree_leaves(self.leaves, is_leaf=_is_leaf)
        return all(leaf.is_autonomous for leaf in leaves)

    @property
    def is_known(self) -> bool:
        """Whether what it does is known in closed form."""
        leaves = jtu.tree_leaves(self.leaves, is_leaf=_is_leaf)
        return all(leaf.is_known for leaf in leaves)

    @property
    def is_one_rate(self) -> bool:
        """Whether all entries of each leaf decay alike, whatever the momentum."""
        leaves = jtu.tree_leaves(self.leaves, is_leaf=_is_leaf)
        return all(leaf.is_one_rate for leaf in leaves)

    def prepare(self, t: Time, h: Time, order: int) -> Effects:
        """What it does from `t` to `t + h`; of at least the given order in `h` where it
        is not known in closed form."""
        prepare = lambda leaf: leaf.prepare(t, h, order)
        return Effects(jtu.tree_map(prepare, self.leaves, is_leaf=_is_leaf))

    def over_step(
        self, t: Time, h: Time
    ) -> tuple["LinearFriction", Bool[Array, ""]] | None:
        """The same for spans within a step, faster, and whether it is right to
        rounding; `None` if it is known in closed form."""
        if self.is_known:
            return None
        replace = lambda leaf: leaf if leaf.is_known else FrictionOverStep(leaf, t, h)
        leaves = jtu.tree_map(replace, self.leaves, is_leaf=_is_leaf)
        fast = LinearFriction(leaves, self.precision)
        leaves = jtu.tree_leaves(leaves, is_leaf=_is_leaf)
        each = [x.converged for x in leaves if isinstance(x, FrictionOverStep)]
        return fast, functools.reduce(jnp.logical_and, each)

    def fix(self, effects: list[Effects]) -> list[Effects]:
        """What was prepared for many spans at once, to be applied many times: matrices
        are exponentiated."""
        if not effects:
            return []
        fix = lambda leaf, *each: leaf.fix(each)
        each = [x.leaves for x in effects]
        fixed = jtu.tree_map(fix, self.leaves, *each, is_leaf=_is_leaf)
        part = lambda i: jtu.tree_map(
            lambda _, x: x[i], self.leaves, fixed, is_leaf=_is_leaf
        )
        return [Effects(part(i), is_fixed=True) for i in range(len(effects))]

    def flow(self, effects: Effects, p: PyTree) -> tuple[PyTree, PyTree]:
        """The change of `p` by friction alone, and the integral of `p` meanwhile."""
        structure = jtu.tree_structure(p)
        both = structure.flatten_up_to(self._map("flow", effects.leaves, p))
        change, carried = map(structure.unflatten, zip(*both, strict=True))
        return change, carried

    def decay(self, effects: Effects, p: PyTree) -> PyTree:
        """The change of `p` by friction alone."""
        return self._map("decay", effects.leaves, p)

    def respond(self, effects: Effects, force: PyTree) -> PyTree:
        """The momentum left by a constant force."""
        return self._map("respond", effects.leaves, force)

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        """The force less the friction, `F - Γ(t) p`."""
        net = lambda leaf, force, p: leaf.net_force(t, force, p)
        return jtu.tree_map(net, self.leaves, force, p, is_leaf=_is_leaf)

    def growth(self, t: Time, h: Time) -> Scalar:
        """The logarithm of the factor by which errors of `p` grow from `t + h` back to
        `t`."""
        return functools.reduce(jnp.maximum, self._each("growth", t, h))

    def angle(self, h: Time) -> Scalar:
        """At least half of the angle by which momenta turn over a span."""
        return functools.reduce(jnp.maximum, self._each("angle", h))

    def over(self, t: Time, h: Time) -> Scalar:
        """The largest friction over a span: the logarithm of the factor by which a
        momentum decays or grows. Friction that falls with time is strong for some steps
        only, and is not counted."""
        return functools.reduce(jnp.maximum, self._each("over", t, h))

    def strength(self, t: Time, h: Time) -> Scalar:
        """The logarithm of the factor by which friction that lasts makes momenta decay
        over a span, in either direction."""
        t, h = as_time(t), as_time(h)
        first = jnp.minimum(t, t + h)
        return functools.reduce(jnp.maximum, self._each("strength", first, jnp.abs(h)))

    def is_smooth(self, t: Time) -> Bool[Array, ""]:
        """Whether its rates have two derivatives at `t`."""
        return functools.reduce(jnp.logical_and, self._each("is_smooth", t))

    def scaled(self, factor: Scalar) -> "LinearFriction":
        """A part of it."""
        scale = lambda leaf: leaf.scaled(factor)
        leaves = jtu.tree_map(scale, self.leaves, is_leaf=_is_leaf)
        return LinearFriction(leaves, self.precision)

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether it is infinite at `t`; `None` if it never is."""
        return reduce_any(self._each("is_singular", t))


_LEAVES = EntryFriction | MatrixFriction | FrictionOverStep
_is_leaf = lambda x: isinstance(x, _LEAVES)
