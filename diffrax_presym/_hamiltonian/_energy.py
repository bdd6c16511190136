from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._friction import AbstractDamping, AbstractFriction, is_scalar
from .._friction._base import Scalar, Time
from .._misc import all_finite, match, scalar_fn
from .._split import AbstractSplit, KineticSplit, PotentialSplit, SharedSplit
from ._base import AbstractHamiltonian, P, Q
from ._kinetic import (
    AbstractKinetic,
    as_kinetic,
    integrate_velocity,
    QuadraticKinetic,
)
from ._potential import QuadraticPotential


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


def check_callable(fn, name: str, signature: str, optional: bool = False):
    if not callable(fn) and not (optional and fn is None):
        raise ValueError(f"`{name}` must be a function `{signature}`, but got {fn!r}.")


def check_potential(potential):
    # These are callable too, but mean that the arguments are in the wrong order, or
    # that a nonseparable energy was passed by position.
    if isinstance(potential, AbstractDamping | AbstractKinetic):
        raise ValueError(
            "`potential` must be a function `V(t, q, args)`, but got "
            f"{potential!r}. The order is `(kinetic, potential, damping)`; for a "
            "nonseparable energy write "
            "`ConformalHamiltonian(energy=energy, damping=damping)`."
        )
    check_callable(potential, "potential", "V(t, q, args)")


class SeparableEnergy(eqx.Module):
    """A sum of a kinetic and a potential energy."""

    kinetic: AbstractKinetic
    potential: Callable
    velocity_fn: Callable | None
    force_fn: Callable | None

    def __init__(self, kinetic, potential, velocity=None, force=None):
        check_potential(potential)
        check_callable(velocity, "velocity", "velocity(t, p, args)", optional=True)
        check_callable(force, "force", "force(t, q, args)", optional=True)
        self.kinetic = as_kinetic(kinetic)
        self.potential = potential
        self.velocity_fn = velocity
        self.force_fn = force

    def __call__(self, t: Time, q: Q, p: P, args: PyTree) -> Scalar:
        kinetic = scalar_fn(self.kinetic, "The kinetic energy")(t, p, args)
        potential = scalar_fn(self.potential, "The potential")(t, q, args)
        with jax.numpy_dtype_promotion("standard"):
            return kinetic + potential

    def velocity(self, t: Time, q: Q, p: P, args: PyTree) -> Q:
        return self._velocity(t, p, args)

    def _velocity(self, t: Time, p: P, args: PyTree) -> Q:
        if self.velocity_fn is None:
            return self.kinetic.velocity(t, p, args)
        return match(self.velocity_fn(t, p, args), p, "`velocity`", "`p`")

    def force(self, t: Time, q: Q, p: P, args: PyTree) -> P:
        if self.force_fn is not None:
            return match(self.force_fn(t, q, args), q, "`force`", "`q`")
        if isinstance(self.potential, QuadraticPotential):
            slope = self.potential.gradient(q)
        else:
            potential = scalar_fn(self.potential, "The potential")
            slope = jax.grad(potential, argnums=1)(t, q, args)
        return jtu.tree_map(jnp.negative, slope)

    def velocity_and_force(self, t: Time, q: Q, p: P, args: PyTree) -> tuple[Q, P]:
        return self.velocity(t, q, p, args), self.force(t, q, p, args)

    def splits(self, friction: AbstractFriction | None) -> tuple[AbstractSplit, ...]:
        kinetic = self.kinetic if self.velocity_fn is None else None
        nystrom = kinetic is not None and kinetic.is_quadratic
        kinetic_split = KineticSplit(separable=True, nystrom=nystrom)
        splits: list[AbstractSplit] = [kinetic_split]
        if self.force_fn is None and isinstance(self.potential, QuadraticPotential):
            splits.append(PotentialSplit())
        # Other energies quadratic in `p` may have a mass that depends on time.
        if isinstance(kinetic, QuadraticKinetic) and is_scalar(friction):
            if friction is None or friction.is_smooth:
                splits.append(SharedSplit(kinetic, friction))
        return tuple(splits)

    def displacement(self, t: Time, h: Time, p: P, args: PyTree, friction, order) -> Q:
        if self.velocity_fn is None:
            return self.kinetic.displacement(t, h, p, args, friction, order)
        return integrate_velocity(self._velocity, t, h, p, args, friction, order)

    def is_valid(self, q: Q, p: P) -> None:
        return None


class GeneralEnergy(eqx.Module):
    """Any function of time, positions and momenta."""

    fn: Callable
    velocity_fn: Callable | None
    force_fn: Callable | None

    def __init__(self, energy, velocity=None, force=None):
        check_callable(energy, "energy", "E(t, q, p, args)")
        check_callable(velocity, "velocity", "velocity(t, q, p, args)", optional=True)
        check_callable(force, "force", "force(t, q, p, args)", optional=True)
        self.fn = energy
        self.velocity_fn = velocity
        self.force_fn = force

    def __call__(self, t: Time, q: Q, p: P, args: PyTree) -> Scalar:
        return scalar_fn(self.fn, "The energy")(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree) -> Q:
        if self.velocity_fn is None:
            return jax.grad(self.__call__, argnums=2)(t, q, p, args)
        return match(self.velocity_fn(t, q, p, args), p, "`velocity`", "`p`")

    def force(self, t: Time, q: Q, p: P, args: PyTree) -> P:
        if self.force_fn is None:
            slope = jax.grad(self.__call__, argnums=1)(t, q, p, args)
            return jtu.tree_map(jnp.negative, slope)
        return match(self.force_fn(t, q, p, args), q, "`force`", "`q`")

    def velocity_and_force(self, t: Time, q: Q, p: P, args: PyTree) -> tuple[Q, P]:
        if self.velocity_fn is not None or self.force_fn is not None:
            return self.velocity(t, q, p, args), self.force(t, q, p, args)
        slopes = jax.grad(self.__call__, argnums=(1, 2))(t, q, p, args)
        return slopes[1], jtu.tree_map(jnp.negative, slopes[0])

    def splits(self, friction: AbstractFriction | None) -> tuple[AbstractSplit, ...]:
        return ()

    def displacement(self, t: Time, h: Time, p: P, args: PyTree, friction, order) -> Q:
        raise ValueError(
            "`Hamiltonian(energy)` has no exact drift, because it is not split into a "
            "kinetic and a potential part. Write `SeparableHamiltonian(kinetic, "
            "potential)`, or use a solver such as `PresymplecticCoupled()`."
        )

    def is_valid(self, q: Q, p: P) -> Bool[Array, ""]:
        return all_finite((q, p))


class AbstractMechanicalHamiltonian(AbstractHamiltonian):
    """An energy and a damping law."""

    E: AbstractVar[SeparableEnergy | GeneralEnergy]

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        return self.E(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return self.E.velocity(t, q, p, args)

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.E.force(t, q, p, args)

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        return self.E.velocity_and_force(t, q, p, args)

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        return self.E.splits(self.friction)

    def kinetic_flow(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, None]:
        return self.E.displacement(t, h, p, args, self.friction, order), None

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        return self.E.is_valid(q, p)


class SeparableHamiltonian(AbstractMechanicalHamiltonian):
    r"""The energy $E = T(t, p) + V(t, q)$, without damping.

    Every scheme of this package but [`diffrax_presym.PresymplecticMidpoint`][] is
    explicit for it. Both parts may depend on time.
    """

    E: SeparableEnergy
    damping = None

    def __init__(self, kinetic, potential, *, velocity=None, force=None):
        r"""**Arguments:**

        - `kinetic`: the kinetic energy, for example
            [`diffrax_presym.QuadraticKinetic`][], or a function `T(t, p, args)` that
            returns a scalar.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns a
            scalar.
        - `velocity`: a function `velocity(t, p, args)` for $\partial T / \partial p$.
            Defaults to that of `kinetic`, by automatic differentiation if necessary.
        - `force`: the force $-\partial V / \partial q$, a function
            `force(t, q, args)`. Defaults to automatic differentiation.

        **Raises:**

        `ValueError` if any of these has the wrong type, and when the solve is traced if
        a function returns values of the wrong shape.
        """
        self.E = SeparableEnergy(kinetic, potential, velocity, force)

    @property
    def kinetic(self) -> AbstractKinetic:
        return self.E.kinetic

    @property
    def potential(self) -> Callable:
        return self.E.potential


class Hamiltonian(AbstractMechanicalHamiltonian):
    r"""Any energy $E(t, q, p)$, without damping, treated as nonseparable.

    Euler and leapfrog are implicit for it and need a root finder;
    [`diffrax_presym.PresymplecticCoupled`][] is explicit. For a sum $T(t, p) + V(t, q)$
    write [`diffrax_presym.SeparableHamiltonian`][] instead.
    """

    E: GeneralEnergy
    damping = None

    def __init__(self, energy, *, velocity=None, force=None):
        r"""**Arguments:**

        - `energy`: the energy, a function `E(t, q, p, args)` that returns a scalar.
        - `velocity`: the velocity $\partial E / \partial p$, a function
            `velocity(t, q, p, args)`. Defaults to automatic differentiation.
        - `force`: the force $-\partial E / \partial q$, a function
            `force(t, q, p, args)`. Defaults to automatic differentiation.

        **Raises:**

        `ValueError` if any of these is not a function, and when the solve is traced if
        a function returns values of the wrong shape.
        """
        self.E = GeneralEnergy(energy, velocity, force)
