"""Mechanical systems with any friction."""

from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import PyTree

from .._checks import check_callable, scalar_fn
from .._friction._base import AbstractFriction, Mechanics
from .._friction._damping import as_laws
from .._friction._fit import has_one_rate
from .._numbers import Scalar, Time
from ._base import AbstractSystem, P, Q
from ._kinetic import (
    AbstractKinetic,
    as_kinetic,
    QuadraticKinetic,
    RelativisticKinetic,
)
from ._mechanical_splits import KineticSplit, PotentialSplit, SharedSplit
from ._potential import AbstractPotential, as_potential, QuadraticPotential
from ._split import AbstractSplit


class MechanicalSystem(AbstractSystem):
    """A mechanical system with a kinetic and a potential energy, any friction and any
    other force,

    `q' = v = ∂T/∂p` and `p' = -∂V/∂q + F_friction + f(t, q, v)`.

    The laws of friction, which may be combined in a list:

    | friction | law |
    |---|---|
    | one rate, or one for each degree of freedom | `ConstantDamping`, `LogDamping`, `PowerDamping`, `eta(t)` |
    | force per velocity: dashpots, a matrix, a magnetic field | `ViscousDamping` |
    | a rate or coefficients that depend on place | `PositionDamping`, `ViscousDamping` |
    | a power of the speed | `Drag` |
    | any other | `force` |

    The first two are linear, and exact in the drift of a `QuadraticKinetic`: no scheme
    loses its order by them, and in one-step schemes phase volume contracts exactly.
    With the others use `BlanesMoan4` or `BlanesMoan6`. A kick by a `force` solves an
    equation for the momentum alone, to the order of the scheme and symmetric; if the
    force is too stiff for the step, the solve fails.

    For a mass matrix that depends on the positions write `LagrangianSystem`, for any
    other energy `Hamiltonian`.

    !!! example

        ```python
        # Three wheels on a shaft, with a damper in each of its elastic sections.
        sections = jnp.eye(3) - jnp.eye(3, k=-1)
        shaft = lambda t, q, args: jnp.sum(1 - jnp.cos(sections @ q))
        dampers = sections.T @ jnp.diag(jnp.array([0.1, 0.2, 0.5])) @ sections
        system = MechanicalSystem(
            QuadraticKinetic(mass=2.0), shaft, friction=ViscousDamping(dampers)
        )
        sol = diffeqsolve(
            system, TunedRKN6(), t0=0.0, t1=10.0, dt0=0.5, y0=(jnp.ones(3), jnp.zeros(3)),
        )
        ```
    """  # noqa: E501

    kinetic: AbstractKinetic
    potential: AbstractPotential
    friction: tuple[AbstractFriction, ...] | None  # Equinox fails on `()` in a term
    external: Callable | None

    def __init__(self, kinetic, potential, friction=None, *, force=None):
        """**Arguments:**

        - `kinetic`: the kinetic energy, for example `QuadraticKinetic`, or a function
            `T(t, p, args)` that returns a scalar.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns a
            scalar, a `QuadraticPotential`, or a `ForceField` for a force that has none.
        - `friction`: a law of friction, or a list of laws that act together. A function
            `eta(t)` is the integral of a rate of damping. Defaults to no friction.
        - `force`: any further force, a function `f(t, q, v, args)` of the velocity `v`,
            of the structure and shape of `q`: a motor, a controller, a contact. It is
            added to that of the potential. Above order 2 it is differentiated by `v` in
            forward mode. Defaults to none. A force that does not depend on the velocity
            is better part of the potential, or a `ForceField`.

        **Raises:**

        `ValueError` if a law or a function is not one, or if a law needs a mass or a
        stiffness that is not known; and when the solve is traced, if a function has the
        wrong arguments or returns values of the wrong shape.
        """
        self.potential = as_potential(potential)
        self.kinetic = as_kinetic(kinetic)
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        self.friction = as_laws(friction) or None
        self.external = force
        _ = self.parts  # An error if a law does not fit the system.

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return self.friction or ()

    @property
    def mechanics(self) -> Mechanics:
        if isinstance(self.kinetic, QuadraticKinetic):
            return Mechanics(self.kinetic.mass, inverse=self.kinetic.inverse)
        return Mechanics(mass_varies=True)

    def factorised(self, p: P) -> "MechanicalSystem":
        if not isinstance(self.kinetic, QuadraticKinetic):
            return self
        return eqx.tree_at(lambda x: x.kinetic, self, self.kinetic.factorised(p))

    # The vector field.

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        with jax.numpy_dtype_promotion("standard"):
            kinetic = scalar_fn(self.kinetic, "The kinetic energy")(t, p, args)
            return kinetic + self.potential(t, q, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return self.kinetic.velocity(t, p, args)

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.velocity_and_force(t, q, p, args)[1]

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        velocity = self.velocity(t, q, p, args)
        force = self.potential.force(t, q, args)
        state = t, q, p, velocity, args
        return velocity, self.add_forces(force, self.external, *state)

    def from_velocity(
        self, t: Time, y: tuple[Q, Q], args: PyTree = None
    ) -> tuple[Q, P]:
        """The state `(q, p)` of positions and velocities `(q, v)`."""
        if isinstance(self.kinetic, QuadraticKinetic | RelativisticKinetic):
            return y[0], self.kinetic.momentum(y[1])
        return super().from_velocity(t, y, args)

    # The moves.

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        parts = self.parts
        if self.external is not None or parts.forces:
            return (KineticSplit(frozenset({"any"}), "momentum"),)
        if parts.local or parts.drags:
            return (KineticSplit(frozenset({"any"}), "friction"),)
        kinetic = self.kinetic
        nystrom = {"nystrom"} if kinetic.is_quadratic else set()
        kinds = frozenset({"separable", "any"} | nystrom)
        splits: list[AbstractSplit] = [KineticSplit(kinds)]
        shared = {"shared"}
        if isinstance(self.potential, QuadraticPotential):
            splits.append(PotentialSplit())
            shared.add("linear")
        constant = all(part.log_scale.is_autonomous for part in parts.linear)
        # Other energies quadratic in `p` may have a mass that depends on time.
        known = isinstance(kinetic, QuadraticKinetic)
        if known and constant and has_one_rate(parts):
            splits.append(SharedSplit(frozenset(shared)))
        return tuple(splits)

    @property
    def drift_is_autonomous(self) -> bool:
        return self.kinetic.is_autonomous
