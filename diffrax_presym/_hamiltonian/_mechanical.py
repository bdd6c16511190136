"""Mechanical systems with any friction."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._compositions import composed
from .._friction import (
    AbstractDamping,
    AbstractFriction,
    as_damping,
    as_friction,
    Drag,
    PositionDamping,
    RayleighDamping,
    ViscousDamping,
    ViscousFriction,
)
from .._friction._base import Scalar, Time
from .._misc import all_finite, match, tree_scale, tree_sub, tree_sum
from .._split import AbstractSplit, KineticSplit, LocalSplit
from ._base import AbstractHamiltonian, P, Q
from ._energy import check_callable, GeneralEnergy, SeparableEnergy
from ._kinetic import QuadraticKinetic
from ._potential import QuadraticPotential


Law: TypeAlias = (
    AbstractDamping | ViscousDamping | RayleighDamping | PositionDamping | Drag
)


class MechanicalSystem(AbstractHamiltonian):
    r"""A mechanical system with any friction and any other force,

    $$q' = v = \frac{\partial E}{\partial p}, \qquad
    p' = -\frac{\partial E}{\partial q} + F_\mathrm{friction} + f(t, q, v).$$

    The laws of friction, which may be combined:

    | friction | law |
    |---|---|
    | one rate, or one for each degree of freedom | [`diffrax_presym.ConstantDamping`][], [`diffrax_presym.LogDamping`][], [`diffrax_presym.MixedDamping`][], `eta(t)` |
    | force per velocity: dashpots, a matrix, a magnetic field | [`diffrax_presym.ViscousDamping`][], [`diffrax_presym.RayleighDamping`][] |
    | a rate or coefficients that depend on place | [`diffrax_presym.PositionDamping`][], [`diffrax_presym.ViscousDamping`][] |
    | a power of the speed | [`diffrax_presym.Drag`][] |
    | any other | `force` |

    The first two are linear, and exact in the drift. Every scheme of this package keeps
    its order, and phase volume contracts exactly. With friction by place or by speed
    use [`diffrax_presym.BlanesMoan4`][] or [`diffrax_presym.BlanesMoan6`][]. A `force`
    or an `energy` has no exact flows: use [`diffrax_presym.PresymplecticGauss`][].

    For the conformal systems of the paper, with one rate of damping, write
    [`diffrax_presym.ConformalHamiltonian`][]; for a mass matrix that depends on the
    positions, [`diffrax_presym.LagrangianSystem`][].

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
            HamiltonianTerm(system), TunedRKN6(),
            t0=0.0, t1=10.0, dt0=0.5, y0=(jnp.ones(3), jnp.zeros(3)),
        )
        ```
    """  # noqa: E501

    E: SeparableEnergy | GeneralEnergy
    laws: tuple[Law, ...]
    external: Callable | None
    table: PyTree

    def __init__(
        self, kinetic=None, potential=None, friction=(), *, force=None, energy=None
    ):
        """Write either `MechanicalSystem(kinetic, potential, ...)` or
        `MechanicalSystem(energy=energy, ...)`.

        **Arguments:**

        - `kinetic`, `potential`: a separable energy, as for
            [`diffrax_presym.SeparableHamiltonian`][].
        - `friction`: a law of friction, or a list of laws that act together. A function
            `eta(t)` is the integral of a rate of damping. Defaults to no friction.
        - `force`: any further force, a function `f(t, q, v, args)` of the velocity `v`,
            of the structure and shape of `q`: a motor, a controller, a contact.
            Defaults to none. A force that does not depend on the velocity is better
            part of the potential, or of [`diffrax_presym.VectorField`][].
        - `energy`: an energy that is not separable, as for
            [`diffrax_presym.Hamiltonian`][]. Its mass is not known, so that friction
            per velocity has to be written as `force`.

        **Raises:**

        `ValueError` if both or neither form of the energy is given, if a law or a
        function is not one, or if a law needs a mass or a stiffness that is not known;
        and when the solve is traced, if a shape does not fit the state.
        """
        if energy is None and kinetic is not None and potential is not None:
            self.E = SeparableEnergy(kinetic, potential)
        elif energy is not None and kinetic is None and potential is None:
            self.E = GeneralEnergy(energy)
        else:
            raise ValueError(
                "`MechanicalSystem` needs either `kinetic` and `potential`, or "
                "`energy`. Write `MechanicalSystem(kinetic, potential, friction=law)` "
                "or `MechanicalSystem(energy=energy, friction=law)`."
            )
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        laws = friction if isinstance(friction, list | tuple) else [friction]
        self.laws = tuple(map(_as_law, laws))
        self.external = force
        self.table = None
        for law in self.laws:
            self._check(law)

    def _check(self, law: Law) -> None:
        name = type(law).__name__
        needs_mass = isinstance(law, ViscousDamping | RayleighDamping | Drag)
        if needs_mass and self._kinetic is None:
            raise ValueError(
                f"`{name}` is friction per velocity, and needs to know the mass. Write "
                "the kinetic energy as `QuadraticKinetic(mass)`; or write the friction "
                "as `MechanicalSystem(..., force=f)`, with a function "
                "`f(t, q, v, args)` such as `lambda t, q, v, args: -C @ v`."
            )
        if isinstance(law, RayleighDamping) and not law.without_stiffness:
            known = isinstance(self._potential, QuadraticPotential)
            if law.stiffness is None and not known:
                raise ValueError(
                    "`RayleighDamping(alpha, beta)` needs a stiffness, which this "
                    "potential does not have. Write `RayleighDamping(alpha, beta, "
                    "stiffness)`, or the potential as `QuadraticPotential(stiffness)`."
                )

    # Its parts.

    @property
    def _kinetic(self) -> QuadraticKinetic | None:
        """The kinetic energy, if its mass is known."""
        kinetic = self.E.kinetic if isinstance(self.E, SeparableEnergy) else None
        return kinetic if isinstance(kinetic, QuadraticKinetic) else None

    @property
    def _mass(self):
        return None if self._kinetic is None else self._kinetic.mass

    @property
    def _potential(self):
        return self.E.potential if isinstance(self.E, SeparableEnergy) else None

    @property
    def _linear(self) -> list[AbstractDamping | ViscousDamping | RayleighDamping]:
        """The linear friction that does not depend on place."""
        kinds = (AbstractDamping, ViscousDamping, RayleighDamping)
        return [x for x in self.laws if isinstance(x, kinds) and not _is_local(x)]

    @property
    def _local(self) -> list[PositionDamping | ViscousDamping | Drag]:
        """The friction that depends on place."""
        kinds = (PositionDamping, ViscousDamping, Drag)
        return [x for x in self.laws if isinstance(x, kinds) and _is_local(x)]

    @property
    def _drags(self) -> list[Drag]:
        """The drag that does not depend on place."""
        return [x for x in self.laws if isinstance(x, Drag) and not _is_local(x)]

    @property
    def friction(self) -> AbstractFriction | None:
        """The linear friction that does not depend on place, part of every drift."""
        stiffness = getattr(self._potential, "stiffness", None)
        friction = as_friction(self._linear, self._mass, stiffness)
        if self._drags and isinstance(friction, ViscousFriction):
            # The drift is then composed of the two.
            return friction.over_parts()
        if friction is None or self.table is None:
            return friction
        return friction.with_table(self.table)

    @property
    def is_linear(self) -> bool:
        """Whether all friction is linear and does not depend on place."""
        return self.external is None and len(self._linear) == len(self.laws)

    @property
    def friction_table(self) -> PyTree:
        return self.table

    def with_table(self, table: PyTree) -> "MechanicalSystem":
        is_none = lambda x: x is None
        return eqx.tree_at(lambda x: x.table, self, table, is_leaf=is_none)

    @property
    def damping(self) -> AbstractDamping | None:
        """The damping law, if that is all of the friction."""
        friction = self.friction
        if len(self._linear) < len(self.laws) or isinstance(friction, ViscousFriction):
            raise ValueError(
                "Only one rate of damping for all momenta has a log scale and a "
                "canonical momentum, but this `MechanicalSystem` has other friction. "
                "Use `energy(t, q, p)` and `diagnostics.power_lost`."
            )
        assert friction is None or isinstance(friction, AbstractDamping)
        return friction

    # The vector field.

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        return self.E(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return self.E.velocity(t, q, p, args)

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.velocity_and_force(t, q, p, args)[1]

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        """The velocity, and the force without the friction that is part of drifts."""
        velocity, force = self.E.velocity_and_force(t, q, p, args)
        force = self._with_friction(t, q, p, args, force)
        if self.external is not None:
            external = self.external(t, q, velocity, args)
            force = tree_sum(force, match(external, q, "`force`", "`q`"))
        return velocity, force

    def potential_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.E.force(t, q, p, args)

    def friction_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        zero = jtu.tree_map(jnp.zeros_like, p)
        force = self._with_friction(t, q, p, args, zero)
        friction = self.friction
        return force if friction is None else friction.net_force(t, force, p)

    def _with_friction(self, t: Time, q: Q, p: P, args: PyTree, force: P) -> P:
        """A force, and the friction that depends on place or on speed."""
        friction, drags = self._at(self.local_values(t, q, args))
        if friction is not None:
            force = friction.net_force(t, force, p)
        for drag in (*drags, *self._drags):
            force = tree_sum(force, drag.force(p, self._mass))
        return force

    # The moves.

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        if self.external is not None or isinstance(self.E, GeneralEnergy):
            return ()
        if self._local:
            return (LocalSplit(),)
        if self._drags:
            return (KineticSplit(separable=False, nystrom=False),)
        return self.E.splits(self.friction)

    def kinetic_flow(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, P | None]:
        friction, drags = self.friction, self._drags
        linear = lambda t, h, p: self.E.displacement(t, h, p, args, friction, order)
        if not drags:
            return linear(t, h, p), None
        if friction is None and len(drags) == 1:
            return drags[0].flow(h, p, self._mass)

        def step(s, h, changes):
            dq, dp = changes
            dp = self._slowed(drags, h / 2, p, dp)
            here = tree_sum(p, dp)
            dq = tree_sum(dq, linear(t + s, h, here))
            if friction is not None:
                dp = tree_sum(dp, friction.decay(t + s, h, here))
            return dq, self._slowed(drags[::-1], h / 2, p, dp)

        zero = jtu.tree_map(jnp.zeros_like, p)
        dq, dp = composed(order, step, jnp.asarray(h), (zero, zero))
        return dq, dp if friction is None else tree_sub(dp, friction.decay(t, h, p))

    def _slowed(self, drags: list[Drag], h: Time, p: P, dp: P) -> P:
        """The change of `p` after more drag over a time `h`."""
        for drag in drags:
            _, more = drag.flow(h, tree_sum(p, dp), self._mass)
            dp = tree_sum(dp, more)
        return dp

    def local_values(self, t: Time, q: Q, args: PyTree) -> tuple[PyTree, ...]:
        """The values at a place of the friction that depends on place."""

        def value(law):
            if isinstance(law, PositionDamping):
                return law.rate(t, q, args)
            coefficients = law.coefficients if _is_viscous(law) else law.coefficient
            return coefficients(t, q, args)

        return tuple(jtu.tree_map(jnp.asarray, value(law)) for law in self._local)

    def _at(self, values: tuple[PyTree, ...]) -> tuple[ViscousFriction | None, list]:
        """The linear friction and the drag of these values."""
        pairs = list(zip(self._local, values, strict=True))
        drags = [law.of(x) for law, x in pairs if isinstance(law, Drag)]
        rates = tuple(x for law, x in pairs if isinstance(law, PositionDamping))
        coefficients = tuple(x for law, x in pairs if _is_viscous(law))
        if not rates and not coefficients:
            return None, drags
        return ViscousFriction(rates, coefficients, self._mass), drags

    def kick(
        self, t: Time, h: Time, p: P, force: P, values: tuple[PyTree, ...], order: int
    ) -> P:
        """The change of `p` at a fixed place, by a force and the friction there.

        Exact with linear friction alone, otherwise of the given order in `h`.
        """
        friction, drags = self._at(values)

        def linear(h, p):
            if friction is None:
                return tree_scale(h, force)
            gained = friction.respond(t, h, force, order)
            return tree_sum(friction.decay(t, h, p), gained)

        if not drags:
            return linear(h, p)

        def step(s, h, dp):
            dp = self._slowed(drags, h / 2, p, dp)
            dp = tree_sum(dp, linear(h, tree_sum(p, dp)))
            return self._slowed(drags[::-1], h / 2, p, dp)

        zero = jtu.tree_map(jnp.zeros_like, p)
        return composed(order, step, jnp.asarray(h), zero)

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        # The flow of drag backwards in time ends after a finite time.
        if any(isinstance(law, Drag) for law in self.laws):
            return all_finite((q, p))
        return self.E.is_valid(q, p)


def _is_local(law: Law) -> bool:
    if isinstance(law, PositionDamping):
        return True
    if isinstance(law, ViscousDamping):
        return law.is_local
    return isinstance(law, Drag) and law.is_local


def _is_viscous(law: Law) -> bool:
    return isinstance(law, ViscousDamping)


def _as_law(law) -> Law:
    if isinstance(law, ViscousDamping | RayleighDamping | PositionDamping | Drag):
        return law
    if isinstance(law, AbstractDamping) or callable(law):
        return as_damping(law, "`friction`")
    raise ValueError(
        "`friction` must be a law of friction or a list of laws, but got "
        f"{law!r}. For one rate, or a rate for each degree of freedom, write "
        "`ConstantDamping(rate)`; for coefficients, force per velocity, "
        "`ViscousDamping(coefficients)`."
    )
