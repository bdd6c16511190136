"""Drifts and kicks on the constraints of a system."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .. import _tree as tree
from .._compositions import lengths, over_stages
from .._numbers import State, Time
from .._results import CONSTRAINT_NOT_SOLVED, NOT_REVERSIBLE, SUCCESSFUL
from ._bound import System
from ._force_split import AbstractForceSplit
from ._multipliers import find_root, Multipliers
from ._split import AbstractSplit


_ORDER = 2  # of a stage, and so of all that it consists of


def _free(system: System) -> System:
    """The system without constraints."""
    return eqx.tree_at(lambda x: x.term, system, system.term.system)


class ConstrainedSplit(AbstractSplit):
    """The drift and the kick of a split, both on the constraint.

    A drift starts with a momentum along the normals, so that it ends on the constraint.
    It is symmetric, of second order, and composed to the order that is needed. Momenta
    along the normals do not change where it ends, so they are projected at the end of a
    step alone, unless a kick depends on the momentum, or a drift is also inverted.
    A kick that is not linear in the momentum is by forces along the constraint, or it
    would be that of a velocity along the normals, which other forces gain in a step.
    """

    base: AbstractForceSplit
    kinds: ClassVar[frozenset[str]] = frozenset({"any"})

    @property
    def failure(self):
        return self.base.failure

    def leave(self, system, t, y) -> State:
        return self._tangential(system, t, y) if self.base.kick_by == "force" else y

    def _tangential(self, system: System, t: Time, y: State) -> State:
        change = system.term.to_tangent(t, *tree.values(y), system.args)
        return system.add(y, (None, change))

    def prepare(self, system, t, h, order) -> PyTree:
        free, h = _free(system), lengths(order, h)
        starts = t + jnp.cumsum(h) - h
        prepare = jax.vmap(lambda t, h: self.base.prepare(free, t, h, _ORDER))
        back = prepare(starts + h, -h) if system.term.check_inverse else None
        return h, prepare(starts, h), back

    def drift(self, system, t, h, data, y) -> State:
        return self.attempt(system, t, h, data, y)[0]

    def attempt(self, system, t, h, data, y) -> tuple[State, dfx.RESULTS]:
        def stage(state, row):
            (t, y, result), (h, data, back) = state, row
            start = tree.values(y[0])
            y, found = self._stage(system, t, h, data, y)
            failure = dfx.RESULTS.where(found, SUCCESSFUL, CONSTRAINT_NOT_SOLVED)
            if system.term.check_inverse:
                values = lax.stop_gradient(tree.values(y))
                (end, _), found = self._stage(system, t + h, -h, back, values)
                miss = tree.largest(tree.sub(end, start))
                # Of positions near the origin, how far the step goes.
                gone = tree.largest(tree.sub(values[0], start))
                unit = jnp.maximum(tree.largest(end), gone)
                found &= miss <= float(jnp.finfo(unit.dtype).eps) ** (2 / 3) * unit
                other = dfx.RESULTS.where(found, SUCCESSFUL, NOT_REVERSIBLE)
                failure = dfx.RESULTS.where(failure == SUCCESSFUL, other, failure)
            result = dfx.RESULTS.where(result == SUCCESSFUL, failure, result)
            return t + h, y, result

        success = jtu.tree_map(jnp.asarray, SUCCESSFUL)
        end, result = over_stages(stage, (t, y, success), data)[1:]
        if self.base.kick_by == "momentum":
            # Of a kick that was not solved there are no multipliers either.
            kicked = tree.all_finite(y)
            result = dfx.RESULTS.where(kicked, result, SUCCESSFUL)
        return end, result

    def _stage(self, system, t, h, data, y) -> tuple[State, Array]:
        term, free, args, q = system.term, _free(system), system.args, y[0]
        q, normal = tree.values(q), term.normal(t, tree.values(q), args)
        # The unknown are momenta times the length, which may be zero.
        per_length = -1 / jnp.where(h == 0, 1, h)

        def moved(x: Multipliers) -> State:
            start = system.add(y, (None, tree.scale(per_length, normal(x))))
            return self.base.drift(free, t, h, data, start)

        def miss(x: Multipliers) -> Multipliers:
            # In no time they move nothing.
            value = term.value(t + h, tree.values(moved(x)[0]), args)
            return jnp.where(h == 0, x, value)

        like = jnp.zeros_like(term.value(t, q, args))
        x, found = find_root(miss, like, term.linear_solver)
        y = moved(x)
        if self.base.kick_by != "force" or term.check_inverse:
            y = self._tangential(system, t + h, y)
        return y, found

    def force(self, system, t, y) -> PyTree:
        force, q = self.base.force(_free(system), t, y), tree.values(y)[0]
        # What it would gain along the normals may lead to other points of the
        # constraint.
        change = lambda x: system.term.to_tangent(t, q, x, system.args, flow=0.0)
        along = lambda x: tree.add(x, change(x))
        if self.base.kick_by != "friction":
            return along(force)
        force, *friction = force
        return along(force), *friction

    def kick(self, system, t, h, y, force, order) -> State:
        free, q = _free(system), tree.values(y)[0]
        if self.base.kick_by == "force":
            return self.base.kick(free, t, h, y, force, _ORDER)
        if self.base.kick_by == "friction":
            stage = lambda y, h: self._kick_stage(system, t, h, y, force)
            return over_stages(stage, y, lengths(order, h))
        along = system.term.along(t, q, system.args)

        def implicit(y: State, h: Time) -> State:
            at = free, t, h, *tree.values(y), force, _ORDER
            change = self.base.change(*at, once=True, along=along)
            return system.add(y, (None, change(tree.values(y)[1])))

        # Not one kick of the order: that takes three times as long to compile.
        return over_stages(implicit, y, lengths(order, h))

    def _kick_stage(self, system, t, h, y, force) -> State:
        """A kick with friction: two halves, and the multipliers between them."""
        term, free, args = system.term, _free(system), system.args
        q, p = tree.values(y)
        half = self.base.change(free, t, h / 2, q, p, force, _ORDER, once=False)
        first, normal = half(p), term.normal(t, q, args)

        def change(x: Multipliers) -> PyTree:
            dp = tree.sub(first, normal(x))
            return tree.add(dp, half(tree.add(p, dp)))

        rate = lambda x: term.rate(t, q, tree.add(p, change(x)), args)
        like = jnp.zeros_like(term.value(t, q, args))
        x, found = find_root(rate, like, term.linear_solver)
        return system.add(y, (None, tree.invalid_if(~found, change(x))))
