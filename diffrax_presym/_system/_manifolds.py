"""Manifolds whose free motion is known, in ambient coordinates."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact

from .._checks import as_positive
from .._friction._exponential import exponential
from .._numbers import cast_to


Both = tuple[Array, Array]  # positions and momenta


class AbstractManifold(eqx.Module):
    """Where an array of positions is, and how it moves there without forces."""

    # Whether any momentum is one of the manifold.
    is_free: eqx.AbstractClassVar[bool]
    # As of `QuadraticKinetic`.
    mass: eqx.AbstractVar[Inexact[Array, "..."] | float]

    @abc.abstractmethod
    def flow(self, q: Array, p: Array, s: Array) -> Both:
        """The free motion over a time `s`."""

    @abc.abstractmethod
    def velocity(self, q: Array, p: Array) -> Array:
        """The rate of change of the positions, linear in the momentum."""

    @abc.abstractmethod
    def pull(self, q: Array, force: Array) -> Array:
        """The rate of change of the momentum by an ambient force, `-dV/dq`."""

    @abc.abstractmethod
    def project(self, q: Array, p: Array) -> Both:
        """A state on the manifold, from one near it."""

    def rates(self, q: Array, p: Array) -> Both:
        """The rates of change of positions and momenta in the free motion."""
        zero, one = jnp.zeros((), p.dtype), jnp.ones((), p.dtype)
        return jax.jvp(lambda s: self.flow(q, p, s), (zero,), (one,))[1]

    def turning(self, q: Array, p: Array) -> Array:
        """The rates at which a position that `is_free` turns, by default zero."""
        return jnp.zeros((), p.dtype)

    def momenta(self, q: tuple[int, ...]) -> tuple[int, ...] | None:
        """The shape of the momenta of positions of a shape, by default the same; `None`
        if positions do not have that shape."""
        return q


AbstractManifold.__init__.__doc__ = "**Arguments:** its fields, if any."


class Euclidean(AbstractManifold):
    """Flat space, as a factor of a product."""

    mass: Inexact[Array, "..."]
    is_free: ClassVar[bool] = True

    def __init__(self, mass: ArrayLike = 1.0):
        """**Arguments:**

        - `mass`: a number, or an array with as many dimensions as `p` that broadcasts
            to it. Defaults to 1.
        """
        self.mass = as_positive(mass, "`Euclidean(mass)`")

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        return q + s * self.velocity(q, p), p

    def velocity(self, q: Array, p: Array) -> Array:
        return p / cast_to(self.mass, p)

    def pull(self, q: Array, force: Array) -> Array:
        return force

    def project(self, q: Array, p: Array) -> Both:
        return q, p


def unitless(miss: Array, size: Array, h: Array) -> Array:
    """A miss of velocities relative to their size; zero if over a step `h` it is that
    of rounding, as of a body at rest."""
    least = float(jnp.finfo(miss.dtype).eps) ** 0.75
    return jnp.where(jnp.abs(h * miss) > least, miss / size, 0)


# XLA on a CPU computes again for each use what it takes for cheap, but for a barrier.
once = lax.optimization_barrier


def inner(x: Array, y: Array) -> Array:
    return jnp.sum(x * y, axis=-1, keepdims=True)


def size(x: Array) -> Array:
    """The length of vectors, with a derivative where it is zero."""
    square = inner(x, x)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def sinc(x: Array) -> Array:
    return jnp.sinc(x / jnp.pi)


def _cos_and_sinc(square: Array) -> Both:
    """Of an angle, by its square, with all derivatives at rest."""
    near = square < 1e-2
    x, angle = jnp.where(near, square, 0), jnp.sqrt(jnp.where(near, 1, square))
    c = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
    d = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    far = jnp.cos(angle), jnp.sin(angle) / angle
    return jnp.where(near, c, far[0]), jnp.where(near, d, far[1])


class Sphere(AbstractManifold):
    """Vectors of length one, over the last axis."""

    is_free: ClassVar[bool] = False
    mass: ClassVar[float] = 1.0

    def momenta(self, q: tuple[int, ...]) -> tuple[int, ...] | None:
        return q or None

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        square = inner(p, p)
        c, d = once(_cos_and_sinc(s**2 * square))
        return self.project(c * q + s * d * p, c * p - s * d * square * q)

    def velocity(self, q: Array, p: Array) -> Array:
        return p

    def pull(self, q: Array, force: Array) -> Array:
        return force - inner(force, q) * q

    def project(self, q: Array, p: Array) -> Both:
        q = q / size(q)
        return q, self.pull(q, p)


class Stiefel(AbstractManifold):
    """Matrices whose columns are orthonormal, in the metric of the ambient space: with
    as many rows as columns rotations, or reflections. The geodesics are those of
    Edelman, Arias and Smith (1998), SIAM J. Matrix Anal. Appl. 20, 303.
    """

    is_free: ClassVar[bool] = False
    mass: ClassVar[float] = 1.0

    def momenta(self, q: tuple[int, ...]) -> tuple[int, ...] | None:
        return q if len(q) == 2 and q[0] >= q[1] else None

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        expm, a, k = exponential, q.T @ p, q.shape[1]
        a = (a - a.T) / 2
        if q.shape[0] == k:
            q = q @ expm(s * a)
            p = q @ a
        else:
            row = jnp.concatenate([a, -p.T @ p], axis=1)
            other = jnp.concatenate([jnp.eye(k, dtype=q.dtype), a], axis=1)
            both = jnp.concatenate([q, p], axis=1)
            both = both @ expm(s * jnp.concatenate([row, other]))
            back = expm(-s * a)
            q, p = both[:, :k] @ back, both[:, k:] @ back
        # A step of Newton's method, as they are orthonormal but for rounding.
        q = q @ (3 * jnp.eye(k, dtype=q.dtype) - q.T @ q) / 2
        return q, self.pull(q, p)

    def velocity(self, q: Array, p: Array) -> Array:
        return p

    def pull(self, q: Array, force: Array) -> Array:
        both = q.T @ force
        return force - q @ (both + both.T) / 2

    def project(self, q: Array, p: Array) -> Both:
        q, r = jnp.linalg.qr(q)
        q = jnp.where(jnp.diagonal(r)[None] < 0, -q, q)
        return q, self.pull(q, p)
