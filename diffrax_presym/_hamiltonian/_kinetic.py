import abc
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Inexact, PyTree

from .._forms import as_form, divide, multiply
from .._friction import AbstractDamping, AbstractFriction
from .._friction._base import Scalar, Time
from .._friction._functions import gauss_legendre, quadrature
from .._misc import (
    as_positive,
    cast_to,
    largest,
    scalar_fn,
    tree_add,
    tree_dot,
    tree_scale,
    tree_sum,
)


class AbstractKinetic(eqx.Module):
    """A kinetic energy `T(t, p, args)` and its velocity."""

    @property
    @abc.abstractmethod
    def is_quadratic(self) -> bool:
        """Whether the velocity is linear in `p`."""

    @abc.abstractmethod
    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        """The kinetic energy of the whole system, a scalar."""

    @abc.abstractmethod
    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        r"""The velocity $\partial T / \partial p$."""

    @abc.abstractmethod
    def displacement(
        self,
        t: Time,
        h: Time,
        p: PyTree,
        args: PyTree,
        friction: AbstractFriction | None,
        order: int,
    ) -> PyTree:
        """The integral of the velocity from `t` to `t + h`, with only friction acting
        on `p`.

        Exact if known in closed form, otherwise of the given order in `h`.
        """

    @abc.abstractmethod
    def rescale(self, s: Scalar) -> "AbstractKinetic":
        r"""The kinetic energy $T_s(p) = e^{-2s} \, T(e^s p)$, without overflow."""


_MASS = "`QuadraticKinetic(mass)`"


class QuadraticKinetic(AbstractKinetic):
    r"""The kinetic energy $T(p) = \tfrac12 \, p \cdot M^{-1} p$."""

    mass: PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None

    def __init__(self, mass=None):
        """**Arguments:**

        - `mass`: the mass, positive, in any of these forms. Defaults to `None`.
            - `None`: unit mass.
            - A number: the same mass for every degree of freedom.
            - An array with as many dimensions as `p`, and broadcastable to it: a mass
                for each degree of freedom. For `n` particles in three dimensions, with
                `p` of shape `(n, 3)`, pass masses of shape `(n, 1)`.
            - A square matrix, with `p` a vector: symmetric and positive definite.
            - A pytree of the structure of `p`, whose leaves are any of the above.
            - A `lineax.AbstractLinearOperator` acting on `p`'s space.

        **Raises:**

        `ValueError` if a mass is known not to be positive, or if its shape does not fit
        `p` (when the solve is traced).
        """
        self.mass = as_form(mass, _MASS, positive=True)

    @property
    def is_quadratic(self) -> bool:
        return True

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        energy = tree_dot(p, self.velocity(t, p, args))
        return energy / 2

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        return divide(self.mass, p, _MASS, "p")

    def momentum(self, v: PyTree) -> PyTree:
        """The momentum $M v$ of a velocity."""
        return multiply(self.mass, v, _MASS, "q")

    def displacement(self, t, h, p, args, friction, order):
        if friction is None:
            return tree_scale(h, self.velocity(t, p, args))
        return self.velocity(t, friction.carry(t, h, p, order), args)

    def rescale(self, s: Scalar) -> "QuadraticKinetic":
        return self


class RelativisticKinetic(AbstractKinetic):
    r"""The kinetic energy $T(p) = c \sqrt{p \cdot p + m^2 c^2}$ of one particle.

    All entries of `p` together are the momentum of one particle, whose speed never
    exceeds $c$. As a kinetic energy for optimisation, equation (rel_ham) of França,
    Jordan and Vidal (2021), it bounds the size of a step.
    """

    mass: Scalar
    speed: Scalar

    def __init__(self, mass: ArrayLike = 1.0, speed: ArrayLike = 1.0):
        """**Arguments:**

        - `mass`: the rest mass $m$, a positive number. Defaults to 1.
        - `speed`: the speed of light $c$, a positive number. Defaults to 1.

        **Raises:**

        `ValueError` if either is known not to be positive.
        """
        self.mass = as_positive(mass, "`RelativisticKinetic(mass=...)`")
        self.speed = as_positive(speed, "`RelativisticKinetic(speed=...)`")

    def _scaled(self, p):
        """The momentum and `m c` in units of the largest of them, their squares, and
        the unit. Without units the squares would overflow."""
        unit = largest(p)
        rest = cast_to(self.mass, unit) * cast_to(self.speed, unit)
        if rest.shape != ():
            raise ValueError(
                "`RelativisticKinetic` is the energy of one particle with one mass and "
                f"one speed of light, but these have shape {rest.shape}. For several "
                "particles write their energy as a function `T(t, p, args)`."
            )
        # Neither results nor derivatives depend on the unit.
        rest = jnp.maximum(rest, jnp.finfo(rest.dtype).tiny)
        unit = lax.stop_gradient(jnp.maximum(unit, rest))
        p = tree_scale(1 / unit, p)
        return p, tree_dot(p, p), (rest / unit) ** 2, unit

    @property
    def is_quadratic(self) -> bool:
        return False

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        _, square, rest, unit = self._scaled(p)
        return cast_to(self.speed, unit) * unit * jnp.sqrt(square + rest)

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        p, square, rest, unit = self._scaled(p)
        return tree_scale(cast_to(self.speed, unit) / jnp.sqrt(square + rest), p)

    def displacement(self, t, h, p, args, friction, order):
        if friction is None:
            return tree_scale(h, self.velocity(t, p, args))
        if not (isinstance(friction, AbstractDamping) and friction.is_scalar):
            return integrate_velocity(self.velocity, t, h, p, args, friction, order)
        p, square, rest, unit = self._scaled(p)

        # The momentum keeps its direction, so only a scalar has to be integrated.
        def speed(s):
            left = 1 + cast_to(friction.decay(t, s, jnp.ones_like(s)), square)
            return left / jnp.sqrt(square * left**2 + rest)

        length = cast_to(self.speed, unit) * quadrature(speed, h, order)
        return tree_scale(length, p)

    def rescale(self, s: Scalar) -> "RelativisticKinetic":
        speed = self.speed * cast_to(jnp.exp(-s), self.speed)
        return eqx.tree_at(lambda k: k.speed, self, speed)


class CallableKinetic(AbstractKinetic):
    """Any function `T(t, p, args)` as a kinetic energy, differentiated by JAX."""

    fn: Callable

    @property
    def is_quadratic(self) -> bool:
        return False

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        return self.fn(t, p, args)

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        return jax.grad(scalar_fn(self.fn, "The kinetic energy"), argnums=1)(t, p, args)

    def displacement(self, t, h, p, args, friction, order):
        return integrate_velocity(self.velocity, t, h, p, args, friction, order)

    def rescale(self, s: Scalar) -> "CallableKinetic":
        def rescaled(t, p, args):
            energy = self.fn(t, tree_scale(jnp.exp(s), p), args)
            return tree_scale(jnp.exp(-2 * s), energy)

        return CallableKinetic(rescaled)


def integrate_velocity(velocity, t, h, p, args, friction, order) -> PyTree:
    """The displacement under any velocity `velocity(t, p, args)`, by quadrature."""

    def term(s, weight):
        left = p if friction is None else tree_add(p, 1, friction.decay(t, s, p))
        return tree_scale(weight, velocity(t + s, left, args))

    # Node by node, to save memory.
    return functools.reduce(tree_sum, map(term, *gauss_legendre(h, order)))


def as_kinetic(kinetic) -> AbstractKinetic:
    if isinstance(kinetic, AbstractKinetic):
        return kinetic
    if callable(kinetic):
        return CallableKinetic(kinetic)
    raise ValueError(
        "`kinetic` must be a kinetic energy or a function `T(t, p, args)`, but got "
        f"{kinetic!r}. For a mass write `QuadraticKinetic(mass)`."
    )
