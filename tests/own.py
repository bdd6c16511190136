"""A law, a split and moves as a user writes them: public names alone."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

import diffrax_presym as dps
from diffrax_presym import extend


class CubicDrag(extend.AbstractFriction):
    """The friction `-c |v|^2 v` of each body, with its exact flow."""

    c: float = 0.3

    def parts(self, mechanics):
        if mechanics.mass_varies or not mechanics.has_mass:
            raise ValueError("The mass is not known. Write the drag as `force=f`.")
        return extend.Parts(drags=(self,))

    def at(self, t, q, args):
        return self

    def force(self, t, q, p, v, args):
        leaf = lambda v: -self.c * jnp.sum(v * v, axis=-1, keepdims=True) * v
        return jax.tree.map(leaf, v)

    def decay(self, h, p, mass):
        one = jnp.ones(()) if mass is None else mass

        def leaf(p, m):
            if m.ndim > p.ndim:
                raise ValueError("Drag needs bodies. Write it as `force=f`.")
            m, h_ = m.astype(p.dtype), h.astype(p.dtype)
            x = 2 * self.c / m * jnp.sum((p / m) ** 2, axis=-1, keepdims=True) * h_
            return p * (1 / jnp.sqrt(1 + x) - 1)

        return jax.tree.map(lambda p: leaf(p, one), p)


_FREE = dps.QuadraticKinetic()


class QuarticSplit(extend.AbstractSplit):
    """A free drift with friction, and a kick by a quartic potential."""

    kinds: ClassVar = frozenset({"any", "nystrom"})

    def prepare(self, system, t, h, order):
        return _FREE.prepare(system.friction, t, h, order)

    def drift(self, system, t, h, data, y):
        p = system.values(y)[1]
        return system.add(y, _FREE.flow(system.friction, t, h, data, p, system.args))

    def force(self, system, t, y):
        return -(system.values(y)[0] ** 3)


class DrivenKick(extend.AbstractMove):
    """A kick, and one by `cos(t)` prepared less `cos(t)` as it is."""

    kick: extend.Kick = extend.Kick("any", 2)
    keeps_manifold: ClassVar[bool] = True

    def prepare(self, system, span):
        return jnp.cos(span.t0)

    def apply(self, system, span, data, stage):
        stage, result = self.kick.apply(system, span, None, stage)
        extra, (y, carry) = span.h * (data - jnp.cos(span.t0)), stage
        push = lambda p: jnp.broadcast_to(extra.astype(p.dtype), p.shape)
        return (system.add(y, (None, jax.tree.map(push, y[1]))), carry), result

    def undo(self, system, span, data, stage):
        return self.apply(system, span, data, stage)


class SpringKick(extend.AbstractMove):
    """A kick by a spring whose stiffness the move holds."""

    stiffness: Any

    def apply(self, system, span, data, stage):
        y, carry = stage
        force = -self.stiffness * system.values(y)[0]
        return (system.add(y, (None, span.h * force)), carry), None

    def undo(self, system, span, data, stage):
        return self.apply(system, span, data, stage)


class _Leapfrog(extend.AbstractPresymplecticSolver):
    @property
    def is_symmetric(self):
        return True

    def order(self, terms):
        return 2

    def _scheme(self, kick, ends=None):
        drift = extend.Drift("any", 2)
        table = [(0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5)]
        return extend.Scheme(extend.MoveSequence([drift, kick, drift], table), ends)


class DrivenLeapfrog(_Leapfrog):
    def scheme(self, system):
        if system.split("any") is None:
            raise ValueError("Use `PresymplecticGauss()`: the system has no split.")
        return self._scheme(DrivenKick(), extend.Enter("any"))


class BareLeapfrog(_Leapfrog):
    """Whose moves do not say where they start from."""

    def scheme(self, system):
        return self._scheme(extend.Kick("any", 2))


class SpringLeapfrog(_Leapfrog):
    """Of a system with the stiffness for `args`."""

    def scheme(self, system):
        return self._scheme(SpringKick(system.args))
