import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._checks import check_callable, match, scalar_fn
from .._numbers import Scalar
from ._kinetic import QuadraticKinetic


class AbstractMirrorMap(eqx.Module):
    """A convex function `h`, with `∇h`, its inverse `∇h^*` and its domain.

    A point `q` has the mirror image `∇h(q)`, to which momenta are added. Methods work
    relative to a point, because differences of mirror images lose most of their digits
    in `float32`.
    """

    # Whether `∇h` is linear.
    is_quadratic: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def __call__(self, q: PyTree) -> Scalar:
        """The value `h(q)`, a scalar."""

    @abc.abstractmethod
    def gradient(self, q: PyTree) -> PyTree:
        """The mirror image `∇h(q)`."""

    @abc.abstractmethod
    def inverse(self, w: PyTree) -> PyTree:
        """The point `∇h^*(w)` with mirror image `w`."""

    def contains(self, q: PyTree) -> Bool[Array, ""]:
        """Whether `q` is inside the domain. False if `q` is not finite."""
        return tree.all_finite(q)

    # Relative to `inverse(gradient(q))`, which may differ from `q` by rounding, so that
    # the step of a zero momentum is exactly zero.

    def step(self, q: PyTree, p: PyTree) -> PyTree:
        """The mirror step `∇h^*(∇h(q) + p) - q`; not finite where undefined."""
        image = self.gradient(q)
        end, start = self.inverse(tree.add(image, p)), self.inverse(image)
        return tree.sub(end, start)

    def change(self, q: PyTree, dq: PyTree) -> PyTree:
        """The difference `∇h(q + dq) - ∇h(q)`."""
        return tree.sub(self.gradient(tree.add(q, dq)), self.gradient(q))

    def project(self, p: PyTree) -> PyTree:
        """`p` without the component that has no effect, if there is one."""
        return p


AbstractMirrorMap.__init__.__doc__ = "**Arguments:** its fields, if any."


class EuclideanMirror(AbstractMirrorMap):
    """The mirror map `h(q) = q · M q / 2`, with a linear `∇h`.

    Bregman dynamics is then separable, the quadratic case of the paper, and every
    one-step scheme for separable energies applies.
    """

    kinetic: QuadraticKinetic
    is_quadratic = True

    def __init__(self, mass=None):
        """**Arguments:**

        - `mass`: the mass matrix, in any form of `QuadraticKinetic`. Defaults to
            `None`, unit mass.

        **Raises:**

        `ValueError` if a mass is known not to be positive, or if its shape does not fit
        the state (when the solve is traced).
        """
        self.kinetic = QuadraticKinetic(mass)

    def __call__(self, q: PyTree) -> Scalar:
        return tree.dot(q, self.gradient(q)) / 2

    def gradient(self, q: PyTree) -> PyTree:
        return self.kinetic.momentum(q)

    def inverse(self, w: PyTree) -> PyTree:
        return self.kinetic.velocity(jnp.zeros(()), w)

    def step(self, q: PyTree, p: PyTree) -> PyTree:
        return self.inverse(p)

    def change(self, q: PyTree, dq: PyTree) -> PyTree:
        return self.gradient(dq)


class EntropyMirror(AbstractMirrorMap):
    """The negative entropy `h(q) = Σ_i q_i log q_i`, for positive numbers.

    Mirror descent with it is multiplicative. With `simplex=True` its domain is the
    probability simplex, where `∇h^*` is the softmax: positions stay positive and sum to
    one, to rounding, without projection. A constant added to all momenta of a simplex
    has no effect. It is removed from every force, so that the sum of momenta that start
    at rest remains zero.
    """

    simplex: bool = eqx.field(static=True)
    is_quadratic = False

    def __init__(self, simplex: bool = False):
        """**Arguments:**

        - `simplex`: whether the last axis of every array in the state is a point of the
            probability simplex. Defaults to `False`, any positive numbers.
        """
        self.simplex = simplex

    def __call__(self, q: PyTree) -> Scalar:
        # On the simplex the linear part is constant, and omitted.
        linear = 0 if self.simplex else 1
        image = jtu.tree_map(lambda qi: jnp.log(qi) - linear, q)
        return tree.dot(q, image)

    def gradient(self, q: PyTree) -> PyTree:
        return jtu.tree_map(jnp.log, q)

    def inverse(self, w: PyTree) -> PyTree:
        return jtu.tree_map(jax.nn.softmax if self.simplex else jnp.exp, w)

    def contains(self, q: PyTree) -> Bool[Array, ""]:
        positive = lambda q: jnp.where(q > 0, q, jnp.nan)
        return tree.all_finite(jtu.tree_map(positive, q))

    def step(self, q: PyTree, p: PyTree) -> PyTree:
        def leaf(q, p):
            if self.simplex:
                p = p - jax.nn.logsumexp(p, axis=-1, b=q, keepdims=True)
            return q * jnp.expm1(p)

        return jtu.tree_map(leaf, q, p)

    def change(self, q: PyTree, dq: PyTree) -> PyTree:
        return jtu.tree_map(lambda q, dq: jnp.log1p(dq / q), q, dq)

    def project(self, p: PyTree) -> PyTree:
        if not self.simplex:
            return p
        return jtu.tree_map(lambda p: p - jnp.mean(p, axis=-1, keepdims=True), p)


class MirrorMap(AbstractMirrorMap):
    """A mirror map given by a function `h`.

    `∇h` is by automatic differentiation. Where its inverse has no closed form, let
    `inverse` find a root with `optimistix.root_find`. Its domain is where `h` is
    finite.
    """

    is_quadratic = False
    fn: Callable
    inverse_fn: Callable

    def __init__(self, h, inverse):
        """**Arguments:**

        - `h`: a strictly convex function `h(q)` that returns a scalar.
        - `inverse`: the inverse `∇h^*` of the gradient, a function `inverse(w)`.

        **Raises:**

        `ValueError` if any of these is not a function.
        """
        check_callable(h, "h", "h(q)")
        check_callable(inverse, "inverse", "inverse(w)")
        self.fn = h
        self.inverse_fn = inverse

    def __call__(self, q: PyTree) -> Scalar:
        return scalar_fn(self.fn, "The mirror map")(q)

    def gradient(self, q: PyTree) -> PyTree:
        return jax.grad(self.__call__)(q)

    def inverse(self, w: PyTree) -> PyTree:
        return match(self.inverse_fn(w), w, "`inverse`", "`w`")

    def contains(self, q: PyTree) -> Bool[Array, ""]:
        return tree.all_finite((q, self(q)))
