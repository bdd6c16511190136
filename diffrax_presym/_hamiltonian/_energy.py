from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._misc import all_finite, match, scalar_fn, tree_add
from ._base import AbstractHamiltonian, P, Q
from ._damping import AbstractDamping, move_frame, Scalar, Time
from ._kinetic import (
    AbstractKinetic,
    as_kinetic,
    integrate_velocity,
    QuadraticKinetic,
)
from ._potential import QuadraticPotential


def _check_callable(fn, name: str, signature: str, optional: bool = False):
    if not callable(fn) and not (optional and fn is None):
        raise ValueError(f"`{name}` must be a function `{signature}`, but got {fn!r}.")


def check_potential(potential):
    # These can be called with as many arguments, but mean something else: the arguments
    # are in the wrong order, or an energy that is not separable was given by position.
    if isinstance(potential, AbstractDamping | AbstractKinetic):
        raise ValueError(
            "`potential` must be a function `V(t, q, args)`, but got "
            f"{potential!r}. The order is `(kinetic, potential, damping)`; an energy "
            "that is not separable is passed by name, "
            "`ConformalHamiltonian(energy=energy, damping=damping)`."
        )
    _check_callable(potential, "potential", "V(t, q, args)")


class SeparableHamiltonian(AbstractHamiltonian):
    r"""The energy $E = T(t, p) + V(t, q)$, without damping.

    Every scheme of this package is explicit for it. Both parts may depend on time.
    """

    kinetic: AbstractKinetic
    potential: Callable
    velocity_fn: Callable | None
    force_fn: Callable | None
    damping = None

    def __init__(self, kinetic, potential, *, velocity=None, force=None):
        r"""**Arguments:**

        - `kinetic`: the kinetic energy, for example
            [`diffrax_presym.QuadraticKinetic`][], or a function `T(t, p, args)` that
            returns one number.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns one
            number.
        - `velocity`: the velocity $\partial T / \partial p$ by hand, a function
            `velocity(t, p, args)`. Defaults to that of `kinetic`, by automatic
            differentiation if need be.
        - `force`: the force $-\partial V / \partial q$ by hand, a function
            `force(t, q, args)`. Defaults to automatic differentiation.

        **Raises:**

        `ValueError` if any of these is of the wrong kind, and when the solve is traced
        if a function returns values of the wrong shape.
        """
        check_potential(potential)
        _check_callable(velocity, "velocity", "velocity(t, p, args)", optional=True)
        _check_callable(force, "force", "force(t, q, args)", optional=True)
        self.kinetic = as_kinetic(kinetic)
        self.potential = potential
        self.velocity_fn = velocity
        self.force_fn = force

    @property
    def is_separable(self) -> bool:
        return True

    @property
    def is_split(self) -> bool:
        return True

    @property
    def is_quadratic(self) -> bool:
        return self.velocity_fn is None and self.kinetic.is_quadratic

    @property
    def has_quadratic_potential(self) -> bool:
        return self.force_fn is None and isinstance(self.potential, QuadraticPotential)

    @property
    def quadratic_kinetic(self) -> QuadraticKinetic | None:
        if self.velocity_fn is None and isinstance(self.kinetic, QuadraticKinetic):
            return self.kinetic
        return None

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        kinetic = scalar_fn(self.kinetic, "The kinetic energy")(t, p, args)
        potential = scalar_fn(self.potential, "The potential")(t, q, args)
        with jax.numpy_dtype_promotion("standard"):
            return kinetic + potential

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        if self.velocity_fn is None:
            return self.kinetic.velocity(t, p, args)
        return match(self.velocity_fn(t, p, args), p, "`velocity`", "`p`")

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        if self.force_fn is not None:
            return match(self.force_fn(t, q, args), q, "`force`", "`q`")
        if isinstance(self.potential, QuadraticPotential):
            slope = self.potential.gradient(q)
        else:
            potential = scalar_fn(self.potential, "The potential")
            slope = jax.grad(potential, argnums=1)(t, q, args)
        return jtu.tree_map(jnp.negative, slope)

    def drift(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, P]:
        return self.damped_drift(t, h, q, p, args, order, None)

    def damped_drift(self, t, h, q, p, args, order, damping):
        """The drift of the same energy in a moving frame."""
        if self.velocity_fn is None:
            dq = self.kinetic.displacement(t, h, p, args, damping, order)
        else:
            velocity = lambda t, p, args: self.velocity(t, q, p, args)
            dq = integrate_velocity(velocity, t, h, p, args, damping, order)
        return tree_add(q, 1, dq), move_frame(damping, t, h, p)


class Hamiltonian(AbstractHamiltonian):
    r"""Any energy $E(t, q, p)$, without damping; not taken to be separable.

    Euler and leapfrog are implicit for it and need a root finder;
    [`diffrax_presym.PresymplecticCoupled`][] is explicit.
    If the energy is a sum $T(t, p) + V(t, q)$, write
    [`diffrax_presym.SeparableHamiltonian`][] instead.
    """

    energy_fn: Callable
    velocity_fn: Callable | None
    force_fn: Callable | None
    damping = None

    def __init__(self, energy, *, velocity=None, force=None):
        r"""**Arguments:**

        - `energy`: the energy, a function `E(t, q, p, args)` that returns one number.
        - `velocity`: the velocity $\partial E / \partial p$ by hand, a function
            `velocity(t, q, p, args)`. Defaults to automatic differentiation.
        - `force`: the force $-\partial E / \partial q$ by hand, a function
            `force(t, q, p, args)`. Defaults to automatic differentiation.

        **Raises:**

        `ValueError` if any of these is not a function, and when the solve is traced if
        a function returns values of the wrong shape.
        """
        _check_callable(energy, "energy", "E(t, q, p, args)")
        _check_callable(velocity, "velocity", "velocity(t, q, p, args)", optional=True)
        _check_callable(force, "force", "force(t, q, p, args)", optional=True)
        self.energy_fn = energy
        self.velocity_fn = velocity
        self.force_fn = force

    @property
    def is_separable(self) -> bool:
        return False

    @property
    def is_split(self) -> bool:
        return False

    @property
    def is_quadratic(self) -> bool:
        return False

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        return scalar_fn(self.energy_fn, "The energy")(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        if self.velocity_fn is None:
            return jax.grad(self.energy, argnums=2)(t, q, p, args)
        return match(self.velocity_fn(t, q, p, args), p, "`velocity`", "`p`")

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        if self.force_fn is None:
            slope = jax.grad(self.energy, argnums=1)(t, q, p, args)
            return jtu.tree_map(jnp.negative, slope)
        return match(self.force_fn(t, q, p, args), q, "`force`", "`q`")

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        if self.velocity_fn is None and self.force_fn is None:
            slopes = jax.grad(self.energy, argnums=(1, 2))(t, q, p, args)
            return slopes[1], jtu.tree_map(jnp.negative, slopes[0])
        return self.velocity(t, q, p, args), self.force(t, q, p, args)

    def is_valid(self, t, q, p, args=None):
        return all_finite((q, p))

    def drift(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, P]:
        return self.damped_drift(t, h, q, p, args, order, None)

    def damped_drift(self, t, h, q, p, args, order, damping):
        raise ValueError(
            "`Hamiltonian(energy)` has no exact drift, because it is not split into a "
            "kinetic and a potential part. Write `SeparableHamiltonian(kinetic, "
            "potential)` if it is, or use a solver such as `PresymplecticCoupled()`."
        )
