"""Manifolds whose free motion is known, in ambient coordinates."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Inexact

from .._checks import as_positive
from .._numbers import cast_to
from ._free_rotation import free_momentum, root, sinc


Both = tuple[Array, Array]  # positions and momenta


class AbstractManifold(eqx.Module):
    """Where an array of positions is, and how it moves there without forces."""

    # Whether `flow` is exact; otherwise it is symmetric, of second order.
    is_exact: eqx.AbstractClassVar[bool]
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

    def momenta(self, q: tuple[int, ...]) -> tuple[int, ...]:
        """The shape of the momenta of positions of a shape. By default the same."""
        return q


AbstractManifold.__init__.__doc__ = "**Arguments:** its fields, if any."


class Euclidean(AbstractManifold):
    """Flat space, as a factor of a product."""

    mass: Inexact[Array, "..."]
    is_exact: ClassVar[bool] = True
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


def _inner(x: Array, y: Array) -> Array:
    return jnp.sum(x * y, axis=-1, keepdims=True)


def _size(x: Array) -> Array:
    """The length of vectors, with a derivative where it is zero."""
    return root(_inner(x, x))


class Sphere(AbstractManifold):
    """Vectors of length one, over the last axis."""

    is_exact: ClassVar[bool] = True
    is_free: ClassVar[bool] = False
    mass: ClassVar[float] = 1.0

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        speed = _size(p)
        c, d = jnp.cos(s * speed), s * sinc(s * speed)
        return self.project(c * q + d * p, c * p - d * speed**2 * q)

    def velocity(self, q: Array, p: Array) -> Array:
        return p

    def pull(self, q: Array, force: Array) -> Array:
        return force - _inner(force, q) * q

    def project(self, q: Array, p: Array) -> Both:
        q = q / _size(q)
        return q, self.pull(q, p)


class Stiefel(AbstractManifold):
    """Matrices whose columns are orthonormal, in the metric of the ambient space: with
    as many rows as columns rotations, or reflections. The geodesics are those of
    Edelman, Arias and Smith (1998), SIAM J. Matrix Anal. Appl. 20, 303.
    """

    is_exact: ClassVar[bool] = True
    is_free: ClassVar[bool] = False
    mass: ClassVar[float] = 1.0

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        expm, a, k = jax.scipy.linalg.expm, q.T @ p, q.shape[1]
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
        q = q * jnp.sign(jnp.diagonal(r))[None]
        return q, self.pull(q, p)


def _multiply(x: Array, y: Array) -> Array:
    """The product of quaternions."""
    a, b, u, v = x[..., :1], y[..., :1], x[..., 1:], y[..., 1:]
    vector = a * v + b * u + jnp.cross(u, v)
    return jnp.concatenate([a * b - _inner(u, v), vector], axis=-1)


def _exponential(angle: Array) -> Array:
    """The quaternion of a rotation about an axis."""
    half = _size(angle) / 2
    return jnp.concatenate([jnp.cos(half), angle / 2 * sinc(half)], axis=-1)


# Where the angle of a free rotation is known, in units of the step, and its end.
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(8))
_TIMES = np.append(0.5 + _NODES, 1.0)


class Attitude(AbstractManifold):
    """The attitude of a rigid body: a quaternion of length one, over the last axis, the
    real part first. Its momentum is the angular momentum along the principal axes of
    the body, three numbers.

    The free rotation is by Jacobi's elliptic functions, and one integral by quadrature:
    right to rounding while the body turns by two radians in a step. A potential takes
    the matrix, `rotation_matrix(q)`.

    ??? cite "Reference"

        ```bibtex
        @article{celledoni2008exact,
            author={Celledoni, Elena and Fass{\\`o}, Francesco and S{\\"a}fstr{\\"o}m,
                Niklas and Zanna, Antonella},
            title={The exact computation of the free rigid body motion and its use in
                splitting methods}, journal={SIAM Journal on Scientific Computing},
            volume={30}, number={4}, pages={2084--2112}, year={2008}}
        ```
    """

    inertia: Float[Array, "*bodies 3"]
    is_exact: ClassVar[bool] = True
    is_free: ClassVar[bool] = True

    def __init__(self, inertia):
        """**Arguments:**

        - `inertia`: the three principal moments of inertia, positive, in any order; for
            several bodies of shape `(n, 3)`.
        """
        self.inertia = as_positive(inertia, "`Attitude(inertia)`")
        if jnp.shape(self.inertia)[-1:] != (3,):
            raise ValueError(
                "`Attitude(inertia)` needs three principal moments, but got the shape "
                f"{jnp.shape(self.inertia)}. Diagonalise a matrix, `jnp.linalg.eigh`, "
                "and write positions in the body along its eigenvectors."
            )

    @property
    def mass(self) -> Inexact[Array, "..."]:
        return self.inertia

    def momenta(self, q: tuple[int, ...]) -> tuple[int, ...]:
        return (*q[:-1], 3)

    def flow(self, q: Array, p: Array, s: Array) -> Both:
        inverse = jnp.broadcast_to(1 / cast_to(self.inertia, p), p.shape)
        # The rotation takes the momentum at the end to that at the start: the shortest
        # one does, and then one about it by an angle, which is an integral. A small one
        # is that by the mean velocity, as neither is defined for a body at rest.
        limit = float(jnp.finfo(p.dtype).eps) ** (2 / 3)
        fastest = jnp.max(inverse, axis=-1, keepdims=True)
        is_small = _inner(p, p) * (s * fastest) ** 2 <= limit

        def after(x: Array) -> tuple[Array, Array, Array]:
            """The momentum, its product with both, and the rate of the angle."""
            later = free_momentum(p, inverse, x * s)
            both = p + later
            product = jnp.where(is_small, 1, _inner(p, both))
            return later, product, _inner(both, later * inverse) / product

        later, product, rate = jax.vmap(after)(cast_to(_TIMES, p))
        end, mean = later[-1], jnp.tensordot(cast_to(_WEIGHTS, p), rate[:-1], 1)
        about = _exponential(s * jnp.where(is_small, (p + end) / 2 * inverse, p * mean))
        shortest = jnp.concatenate([product[-1], jnp.cross(end, p)], axis=-1)
        unit = jnp.array([1.0, 0.0, 0.0, 0.0], p.dtype)
        shortest = jnp.where(is_small, unit, shortest)
        turn = _multiply(about, shortest / _size(shortest))
        return self.project(_multiply(q, turn), end)

    def velocity(self, q: Array, p: Array) -> Array:
        turn = p / cast_to(self.inertia, p) / 2
        return _multiply(
            q, jnp.concatenate([jnp.zeros_like(q[..., :1]), turn], axis=-1)
        )

    def rates(self, q: Array, p: Array) -> Both:
        turn = jnp.cross(p, p / cast_to(self.inertia, p))
        return self.velocity(q, p), turn

    def pull(self, q: Array, force: Array) -> Array:
        inverse = jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)
        return _multiply(inverse, force)[..., 1:] / 2

    def project(self, q: Array, p: Array) -> Both:
        return q / _size(q), p


def rotation_matrix(q: Float[Array, "*bodies 4"]) -> Float[Array, "*bodies 3 3"]:
    """The matrix of a quaternion, from the coordinates of a body to those of space: for
    potentials of an `Attitude`.

    **Arguments:**

    - `q`: quaternions of length one, over the last axis, the real part first.
    """
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
