"""Linear friction of one system: prepared for a span of time, applied to momenta."""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree, Shaped

from .._misc import Scalar, Time
from ._log_scale import (
    Exponents,
)
from ._rates import CoupledFriction, Effect, EntryFriction, Ravel, reduce_any


class Effects(eqx.Module):
    """What was prepared of linear friction, for each leaf."""

    leaves: list[Effect | Exponents]


class LinearFriction(eqx.Module):
    r"""Linear friction $p' = F - \Gamma(t) \, p$ of momenta of one shape.

    `prepare` gives what depends on time alone, for a span; the other methods apply it.
    Changes rather than new momenta are returned, for compensated summation.
    """

    parts: tuple[EntryFriction | CoupledFriction, ...]
    ravel: Ravel

    @property
    def is_autonomous(self) -> bool:
        """Whether what is prepared depends on the length of a span alone."""
        return all(part.is_autonomous for part in self.parts)

    @property
    def precision(self) -> float:
        """The rounding error of a momentum, relative to it."""
        return max(float(jnp.finfo(dtype).eps) for _, dtype in self.ravel.shapes)

    def prepare(self, t: Time, h: Time, order: int) -> Effects:
        """What it does from `t` to `t + h`; of at least the given order in `h` where it
        is not known in closed form."""
        return Effects([part.prepare(t, h, order) for part in self.parts])

    def prepare_decays(self, t: Shaped[Array, " spans"], h: Array) -> Effects:
        """What decays over several spans need, in a form to be applied many times."""
        return Effects([part.prepare_decays(t, h) for part in self.parts])

    def fix(self, effects: Effects) -> Effects:
        """What was prepared for many spans at once, to be applied many times."""
        rows = zip(self.parts, effects.leaves, strict=True)
        return Effects([part.fix(x) for part, x in rows])

    def _each(self, fn: str, effects: Effects, x: PyTree):
        rows = zip(self.parts, effects.leaves, self.ravel.leaves(x), strict=True)
        return [getattr(part, fn)(effect, leaf) for part, effect, leaf in rows]

    def flow(self, effects: Effects, p: PyTree) -> tuple[PyTree, PyTree]:
        """The change of `p` by friction alone, and the integral of `p` meanwhile."""
        both = self._each("flow", effects, p)
        change, carried = (self.ravel.unflatten(x) for x in zip(*both, strict=True))
        return change, carried

    def decay(self, effects: Effects, p: PyTree) -> PyTree:
        """The change of `p` by friction alone."""
        return self.ravel.unflatten(self._each("decay", effects, p))

    def respond(self, effects: Effects, force: PyTree) -> PyTree:
        """The momentum left by a constant force."""
        return self.ravel.unflatten(self._each("respond", effects, force))

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        r"""The force less the friction, $F - \Gamma(t) \, p$."""
        leaves = zip(self.ravel.leaves(force), self.ravel.leaves(p), strict=True)
        rows = zip(self.parts, leaves, strict=True)
        return self.ravel.unflatten([part.net_force(t, *pair) for part, pair in rows])

    def amplification(self, t: Time, h: Time) -> Scalar:
        """The factor by which errors of `p` grow from `t + h` back to `t`."""
        each = [part.amplification(t, h) for part in self.parts]
        return functools.reduce(jnp.maximum, each)

    def contraction(self, t: Time, h: Time, p: PyTree) -> Scalar:
        r"""The integral of the trace of $\Gamma$ from `t` to `t + h`: phase volume
        contracts by the exponential of it."""
        rows = zip(self.parts, self.ravel.leaves(p), strict=True)
        return functools.reduce(
            jnp.add, [part.contraction(t, h, x) for part, x in rows]
        )

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        """Whether it is infinite at `t`; `None` if it never is."""
        return reduce_any([part.is_singular(t) for part in self.parts])
