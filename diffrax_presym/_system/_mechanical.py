"""Mechanical systems with any friction."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._compositions import spans
from .._friction._base import AbstractFriction, Linear, Mechanics, Parts
from .._friction._damping import as_laws
from .._friction._drag import Drag
from .._friction._fit import fit_friction, has_one_rate
from .._friction._linear import LinearFriction
from .._friction._log_scale import Linear as LinearScale
from .._misc import (
    all_finite,
    check_callable,
    Scalar,
    scalar_fn,
    Time,
    tree_scale,
    tree_sum,
    tree_zeros,
)
from ._base import AbstractKineticSystem, add_forces, momentum_of, P, Q
from ._kinetic import AbstractKinetic, as_kinetic, QuadraticKinetic
from ._potential import AbstractPotential, as_potential, QuadraticPotential
from ._split import AbstractSplit, KineticSplit, PotentialSplit, SharedSplit


class MechanicalSystem(AbstractKineticSystem):
    r"""A mechanical system with a kinetic and a potential energy, any friction and any
    other force,

    $$q' = v = \frac{\partial T}{\partial p}, \qquad
    p' = -\frac{\partial V}{\partial q} + F_\mathrm{friction} + f(t, q, v).$$

    The laws of friction, which may be combined in a list:

    | friction | law |
    |---|---|
    | one rate, or one for each degree of freedom | [`diffrax_presym.ConstantDamping`][], [`diffrax_presym.LogDamping`][], [`diffrax_presym.PowerDamping`][], `eta(t)` |
    | force per velocity: dashpots, a matrix, a magnetic field | [`diffrax_presym.ViscousDamping`][], [`diffrax_presym.RayleighDamping`][] |
    | a rate or coefficients that depend on place | [`diffrax_presym.PositionDamping`][], [`diffrax_presym.ViscousDamping`][] |
    | a power of the speed | [`diffrax_presym.Drag`][] |
    | any other | `force` |

    The first two are linear, and exact in the drift. Every scheme of this package keeps
    its order, and phase volume contracts exactly. With friction by place or by speed
    use [`diffrax_presym.BlanesMoan4`][] or [`diffrax_presym.BlanesMoan6`][]. A `force`
    that depends on the velocity has no exact flow: use
    [`diffrax_presym.PresymplecticGauss`][].

    For a mass matrix that depends on the positions write
    [`diffrax_presym.LagrangianSystem`][], for any other energy
    [`diffrax_presym.Hamiltonian`][].

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
    friction: tuple[AbstractFriction, ...]
    external: Callable | None

    def __init__(self, kinetic, potential, friction=None, *, force=None):
        """**Arguments:**

        - `kinetic`: the kinetic energy, for example
            [`diffrax_presym.QuadraticKinetic`][], or a function `T(t, p, args)` that
            returns a scalar.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns a
            scalar, a [`diffrax_presym.QuadraticPotential`][], or a
            [`diffrax_presym.ForceField`][] for a force that has none.
        - `friction`: a law of friction, or a list of laws that act together. A function
            `eta(t)` is the integral of a rate of damping. Defaults to no friction.
        - `force`: any further force, a function `f(t, q, v, args)` of the velocity `v`,
            of the structure and shape of `q`: a motor, a controller, a contact. It is
            added to that of the potential. Defaults to none. A force that does not
            depend on the velocity is better part of the potential, or a
            [`diffrax_presym.ForceField`][].

        **Raises:**

        `ValueError` if a law or a function is not one, or if a law needs a mass or a
        stiffness that is not known; and when the solve is traced, if a function has the
        wrong arguments or returns values of the wrong shape.
        """
        self.kinetic = as_kinetic(kinetic)
        self.potential = as_potential(potential)
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        self.friction = as_laws(friction)
        self.external = force
        _ = self.parts  # An error if a law does not fit the system.

    @property
    def mechanics(self) -> Mechanics:
        stiffness = None
        if isinstance(self.potential, QuadraticPotential):
            stiffness = self.potential.stiffness
            stiffness = jnp.ones(()) if stiffness is None else stiffness
        if isinstance(self.kinetic, QuadraticKinetic):
            return Mechanics(self.kinetic.mass, stiffness)
        return Mechanics(None, stiffness, has_mass=False)

    @property
    def parts(self) -> Parts:
        each = [law.parts(self.mechanics) for law in self.friction]
        return sum(each, Parts())  # pyright: ignore

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
        force = self.potential_force(t, q, p, args)
        forces = self.friction, self.mechanics, self.external
        return velocity, add_forces(force, *forces, t, q, p, velocity, args)

    def from_velocity(
        self, t: Time, y: tuple[Q, Q], args: PyTree = None
    ) -> tuple[Q, P]:
        """The state `(q, p)` of positions and velocities `(q, v)`."""
        if isinstance(self.kinetic, QuadraticKinetic):
            return y[0], self.kinetic.momentum(y[1])
        return momentum_of(self, t, *y, args)

    def potential_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.potential.force(t, q, args)

    def friction_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        forces = self.friction, self.mechanics, None
        state = t, q, p, self.velocity(t, q, p, args), args
        force = add_forces(tree_zeros(p), *forces, *state)
        friction = self.fit_friction(p)
        return force if friction is None else friction.net_force(t, force, p)

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        # The flow of drag backwards in time ends after a finite time.
        parts = self.parts
        return all_finite((q, p)) if parts.drags or parts.local_drags else None

    # The moves.

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        parts = self.parts
        if self.external is not None:
            return ()
        if parts.local or parts.local_drags:
            return (KineticSplit(separable=False, nystrom=False, local=True),)
        if parts.drags:
            return (KineticSplit(separable=False, nystrom=False),)
        kinetic = self.kinetic
        splits: list[AbstractSplit] = [KineticSplit(True, kinetic.is_quadratic)]
        if isinstance(self.potential, QuadraticPotential):
            splits.append(PotentialSplit())
        smooth = all(part.log_scale.is_smooth for part in parts.linear)
        # Other energies quadratic in `p` may have a mass that depends on time.
        if isinstance(kinetic, QuadraticKinetic) and has_one_rate(parts) and smooth:
            splits.append(SharedSplit())
        return tuple(splits)

    @property
    def drift_is_autonomous(self) -> bool:
        return self.kinetic.is_autonomous

    def prepare_drift(
        self, friction: LinearFriction | None, t: Time, h: Time, order: int
    ) -> PyTree:
        drags = self.parts.drags
        if not drags:
            return self.kinetic.prepare(friction, t, h, order)
        if friction is None and len(drags) == 1:
            return None
        prepare = lambda s, h: self.kinetic.prepare(friction, t + s, h, order)
        starts, lengths = spans(order, h)
        return starts, lengths, jax.vmap(prepare)(starts, lengths)

    def drift(
        self,
        friction: LinearFriction | None,
        t: Time,
        h: Time,
        data: Any,
        q: Q,
        p: P,
        args: PyTree,
    ) -> tuple[Q, P | None]:
        drags, mass = self.parts.drags, self.mechanics.mass
        if not drags:
            return self.kinetic.flow(friction, t, h, data, p, args)
        if friction is None and len(drags) == 1:
            return drags[0].flow(h, p, mass)

        def stage(changes, row):
            (dq, dp), (s, h, data) = changes, row
            dp = self._slowed(drags, h / 2, p, dp)
            flow = self.kinetic.flow(friction, t + s, h, data, tree_sum(p, dp), args)
            dq = tree_sum(dq, flow[0])
            dp = dp if flow[1] is None else tree_sum(dp, flow[1])
            return (dq, self._slowed(drags[::-1], h / 2, p, dp)), None

        return lax.scan(stage, (tree_zeros(p), tree_zeros(p)), data)[0]

    def _slowed(self, drags: tuple[Drag, ...], h: Time, p: P, dp: P) -> P:
        """The change of `p` after more drag over a time `h`."""
        for drag in drags:
            dp = tree_sum(dp, drag.flow(h, tree_sum(p, dp), self.mechanics.mass)[1])
        return dp

    def local_friction(self, t: Time, q: Q, p: P, args: PyTree) -> PyTree:
        """The numbers at a place of the friction that depends on place."""
        parts = self.parts
        forms = [
            jtu.tree_map(jnp.asarray, part.form(t, q, args)) for part in parts.local
        ]
        drags = [drag.at(t, q, args) for drag in parts.local_drags]
        return forms, [(drag.coefficient, drag.medium) for drag in drags]

    def local_kick(
        self, t: Time, h: Time, p: P, force: P, local: PyTree, order: int
    ) -> P:
        """The change of `p` at a fixed place, by a force and the friction there.

        Exact with linear friction alone, otherwise of the given order in `h`.
        """
        parts, (forms, numbers) = self.parts, local
        pairs = zip(parts.local, forms, strict=True)
        linear = [Linear(LinearScale(), x, part.per_velocity) for part, x in pairs]
        friction = fit_friction(linear, self.mechanics, p)
        drags = tuple(
            eqx.tree_at(lambda x: (x.coefficient, x.medium), drag, x, is_leaf=_is_none)
            for drag, x in zip(parts.local_drags, numbers, strict=True)
        )

        def pushed(h: Time, p: P) -> P:
            if friction is None:
                return tree_scale(h, force)
            data = friction.prepare(t, h, order)
            return tree_sum(friction.decay(data, p), friction.respond(data, force))

        if not drags:
            return pushed(h, p)

        def stage(dp, h):
            dp = self._slowed(drags, h / 2, p, dp)
            dp = tree_sum(dp, pushed(h, tree_sum(p, dp)))
            return self._slowed(drags[::-1], h / 2, p, dp), None

        return lax.scan(stage, tree_zeros(p), spans(order, h)[1])[0]


_is_none = lambda x: x is None
