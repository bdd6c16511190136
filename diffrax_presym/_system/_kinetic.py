import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Inexact, PyTree

from .. import _tree as tree
from .._checks import as_positive, check_callable, scalar_fn
from .._forms import as_mass, divide, inverse, is_symmetric, momentum, multiply
from .._friction._base import MASS
from .._friction._exponential import gauss_legendre
from .._friction._linear import LinearFriction
from .._numbers import cast_to, Scalar, Time


class AbstractKinetic(eqx.Module):
    """A kinetic energy `T(t, p, args)`, its velocity, and its exact flow."""

    # Whether its flow depends on time by the length of its span alone.
    is_autonomous: eqx.AbstractVar[bool]

    @property
    @abc.abstractmethod
    def is_quadratic(self) -> bool:
        """Whether the velocity is linear in `p`."""

    @abc.abstractmethod
    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        """The kinetic energy of the whole system, a scalar."""

    @abc.abstractmethod
    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        """The velocity `∂T / ∂p`."""

    def flow_is_known(self, friction: LinearFriction | None) -> bool:
        """Whether its flow is known in closed form."""
        return False

    def prepare(
        self, friction: LinearFriction | None, t: Time, h: Time, order: int
    ) -> PyTree:
        """What the flow from `t` to `t + h` needs of time alone, of at least the given
        order in `h` if it is not known in closed form.

        By default nodes and weights of the integral of any velocity, with the decay of
        the momentum up to each node and to the end.
        """
        nodes, weights = gauss_legendre(h, order)
        if friction is None:
            return nodes, weights, None, None
        each = jax.vmap(lambda s: friction.prepare(t, s, order))(nodes)
        return nodes, weights, each, friction.prepare(t, h, order)

    def flow(
        self,
        friction: LinearFriction | None,
        t: Time,
        h: Time,
        data: Any,
        p: PyTree,
        args: PyTree,
    ) -> tuple[PyTree, PyTree | None]:
        """The integral of the velocity from `t` to `t + h`, with only friction acting
        on `p`, and the change of `p` by it."""
        nodes, weights, each, whole = data

        def add(total, row):
            s, weight, data = row
            left = p if friction is None else tree.add(p, friction.decay(data, p))
            part = tree.scale(weight, self.velocity(t + s, left, args))
            return tree.add(total, part), None

        rows = nodes, weights, each
        total, _ = lax.scan(add, tree.zeros(p), rows, unroll=True)
        return total, None if friction is None else friction.decay(whole, p)

    @abc.abstractmethod
    def rescale(self, s: Scalar) -> "AbstractKinetic":
        """The kinetic energy `T_s(p) = exp(-2s) T(exp(s) p)`, without overflow."""


AbstractKinetic.__init__.__doc__ = "**Arguments:** its fields, if any."


_OF_POSITIONS = (
    " For a mass matrix that depends on the positions write `LagrangianSystem`, for a "
    "mass that depends on time the kinetic energy as a function `T(t, p, args)`."
)


class QuadraticKinetic(AbstractKinetic):
    """The kinetic energy `T(p) = p · M^-1 p / 2`."""

    mass: PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None
    symmetric: bool = eqx.field(static=True)
    inverse: PyTree[Inexact[Array, "..."]] | None  # of a mass with a matrix, if known

    def __init__(self, mass=None):
        """**Arguments:**

        - `mass`: the mass, positive, in any of these forms. Defaults to `None`.
            - `None`: unit mass.
            - A number: the same mass for every degree of freedom.
            - An array with as many dimensions as `p`, and broadcastable to it: a mass
                for each degree of freedom. For `n` particles in three dimensions, with
                `p` of shape `(n, 3)`, pass masses of shape `(n, 1)`.
            - A square matrix, with `p` a vector: symmetric and positive definite.
            - An array with one dimension more than `p`: such a matrix for each vector
                over the last axis of `p`.
            - A pytree of the structure of `p`, whose leaves are any of the above.
            - A symmetric `lineax.AbstractLinearOperator` acting on `p`'s space.

            A test particle without mass has no momentum. Let `p` be the momentum per
            unit mass of all bodies, `QuadraticKinetic()` with
            `ForceField(acceleration)`; the energy is that of a second system, of the
            bodies with mass.

        **Raises:**

        `ValueError` if a mass is known not to be positive; and when the solve is
        traced, if its shape does not fit `p`, or if it is a matrix that was not
        symmetric when this was made. That is not checked of traced arrays, nor of
        operators other than `lineax.MatrixLinearOperator`.
        """
        self.mass = as_mass(mass, MASS, _OF_POSITIONS)
        self.symmetric, self.inverse = is_symmetric(mass), None

    is_quadratic: ClassVar[bool] = True
    is_autonomous: ClassVar[bool] = True

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        energy = tree.dot(p, self.velocity(t, p, args))
        return energy / 2

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        if self.inverse is not None:
            return multiply(self.inverse, p, MASS, "p")
        return divide(self.mass, p, MASS, "p", self.symmetric)

    def factorised(self, p: PyTree) -> "QuadraticKinetic":
        """The same, with the inverse of the mass if that has a matrix."""
        known = inverse(self.mass, p, MASS, "p")
        return eqx.tree_at(
            lambda x: x.inverse, self, known, is_leaf=lambda x: x is None
        )

    def momentum(self, v: PyTree) -> PyTree:
        """The momentum `M v` of a velocity."""
        return momentum(self.mass, v, MASS, "q", self.symmetric)

    def flow_is_known(self, friction) -> bool:
        return friction is None or friction.is_known

    def prepare(self, friction, t, h, order):
        return None if friction is None else friction.prepare(t, h, order)

    def flow(self, friction, t, h, data, p, args):
        if friction is None:
            return tree.scale(h, self.velocity(t, p, args)), None
        change, carried = friction.flow(data, p)
        return self.velocity(t, carried, args), change

    def rescale(self, s: Scalar) -> "QuadraticKinetic":
        return self


class RelativisticKinetic(AbstractKinetic):
    """The kinetic energy `T(p) = c sqrt(p · p + m^2 c^2)` of one particle.

    All entries of `p` together are the momentum of one particle, whose speed never
    exceeds `c`. As a kinetic energy for optimisation, equation (rel_ham) of França,
    Jordan and Vidal (2021), it bounds the size of a step.
    """

    mass: Scalar
    speed: Scalar

    def __init__(self, mass: ArrayLike = 1.0, speed: ArrayLike = 1.0):
        """**Arguments:**

        - `mass`: the rest mass `m`, a positive number. Defaults to 1.
        - `speed`: the speed of light `c`, a positive number. Defaults to 1.

        **Raises:**

        `ValueError` if either is known not to be positive.
        """
        self.mass = as_positive(mass, "`RelativisticKinetic(mass=...)`")
        self.speed = as_positive(speed, "`RelativisticKinetic(speed=...)`")

    def _scaled(self, p):
        """The momentum and `m c` in units of the largest of them, their squares, and
        the unit. Without units the squares would overflow."""
        unit = tree.largest(p)
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
        p = tree.scale(1 / unit, p)
        return p, tree.dot(p, p), (rest / unit) ** 2, unit

    is_quadratic: ClassVar[bool] = False
    is_autonomous: ClassVar[bool] = True

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        _, square, rest, unit = self._scaled(p)
        return cast_to(self.speed, unit) * unit * jnp.sqrt(square + rest)

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        p, square, rest, unit = self._scaled(p)
        return tree.scale(cast_to(self.speed, unit) / jnp.sqrt(square + rest), p)

    def momentum(self, v: PyTree) -> PyTree:
        """The momentum of a velocity below the speed of light."""
        square = tree.dot(*(tree.scale(1 / self.speed, v),) * 2)
        return tree.scale(cast_to(self.mass, square) / jnp.sqrt(1 - square), v)

    def flow(self, friction, t, h, data, p, args):
        if friction is None:
            return tree.scale(h, self.velocity(t, p, args)), None
        return super().flow(friction, t, h, data, p, args)

    def rescale(self, s: Scalar) -> "RelativisticKinetic":
        speed = self.speed * cast_to(jnp.exp(-s), self.speed)
        # Where it is infinite the velocity is that of the quadratic energy.
        speed = jnp.minimum(speed, float(jnp.finfo(speed.dtype).max) ** 0.5)
        return eqx.tree_at(lambda k: k.speed, self, speed)


class CallableKinetic(AbstractKinetic):
    """Any function `T(t, p, args)` as a kinetic energy, differentiated by JAX."""

    fn: Callable
    is_quadratic: ClassVar[bool] = False
    is_autonomous: ClassVar[bool] = True

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        return self.fn(t, p, args)

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        return jax.grad(scalar_fn(self.fn, "The kinetic energy"), argnums=1)(t, p, args)

    def rescale(self, s: Scalar) -> "CallableKinetic":
        def rescaled(t, p, args):
            energy = self.fn(t, tree.scale(jnp.exp(s), p), args)
            return tree.scale(jnp.exp(-2 * s), energy)

        return CallableKinetic(rescaled)


def as_kinetic(kinetic) -> AbstractKinetic:
    if isinstance(kinetic, AbstractKinetic):
        return kinetic
    if callable(kinetic):
        check_callable(kinetic, "kinetic", "T(t, p, args)")
        return CallableKinetic(kinetic)
    raise ValueError(
        "`kinetic` must be a kinetic energy or a function `T(t, p, args)`, but got "
        f"{kinetic!r}. For a mass write `QuadraticKinetic(mass)`."
    )
