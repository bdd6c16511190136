"""Systems on manifolds whose free motion is known."""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import check_callable, describe, match
from .._compositions import lengths, over_stages
from .._forms import divide, momentum
from .._friction._base import AbstractFriction, MASS, Mechanics
from .._friction._damping import as_laws
from .._friction._fit import has_rates
from .._friction._linear import LinearFriction
from .._numbers import as_time, cast_to, Scalar, State, Time
from .._results import TURNS_TOO_FAR
from ._base import AbstractSystem, P, Q
from ._force_split import AbstractForceSplit
from ._manifolds import AbstractManifold, unitless
from ._potential import AbstractPotential, as_potential, ForceField
from ._split import AbstractSplit


_is_manifold = lambda x: isinstance(x, AbstractManifold)


class ManifoldSystem(AbstractSystem):
    """A mechanical system on a manifold whose free motion is known, with friction.

    Positions are in ambient coordinates. Drifts are free motions along geodesics, which
    friction at a rate shortens; other linear friction that depends on time alone is
    composed with them, or if constant part of the kicks of `BlanesMoan4` and
    `BlanesMoan6`. Kicks are tangential, and those by other friction or a `force` of the
    velocity solve an equation for the momentum, symmetric and to the order of the
    scheme. `Strang`, `BlanesMoan4`, `BlanesMoan6` and compositions keep their order; so
    does `TunedRKN6`, which is faster, and other Runge--Kutta--Nyström schemes, if
    friction is at one rate for each array of momenta and there is no `force`. Positions
    stay on the manifold to rounding. Start from
    `system.project(t0, y0)`. In Diffrax's loop save values between steps by
    `SaveAt(ts=ts, fn=system.project)`.

    !!! example

        ```python
        # A rigid body that floats: 7 positions and 6 momenta.
        body = (Euclidean(mass=2.0), Attitude(jnp.array([1.0, 1.2, 2.0])))
        weight = lambda t, q, args: q[0][2] + rotation_matrix(q[1])[2, 2]
        system = ManifoldSystem(body, weight, ConstantDamping(0.1))
        q0 = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
        p0 = jnp.zeros(3), jnp.array([0.1, 1.0, 0.0])
        sol = diffeqsolve(system, Strang(), t0=0.0, t1=9.0, dt0=0.01, y0=(q0, p0))
        ```
    """

    manifold: PyTree[AbstractManifold]
    potential: AbstractPotential
    friction: tuple[AbstractFriction, ...] | None
    external: Callable | None
    is_constrained: ClassVar[bool] = True
    drift_is_autonomous: ClassVar[bool] = True

    def __init__(self, manifold, potential, friction=None, *, force=None):
        """**Arguments:**

        - `manifold`: where the positions are, such as `Sphere()`, or a pytree of
            manifolds for positions of that structure.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns a
            scalar; or a `ForceField` of forces on the momenta, and torques along the
            axes of bodies.
        - `friction`: a law of friction, or a list, with coefficients and rates for
            the entries of momenta. Of a `Sphere` or a `Stiefel` one rate if it depends
            on time alone. Defaults to none.
        - `force`: any further force, a function `f(t, q, v, args)` of the velocity
            `v`, of the structure and shape of `p`: a motor, a controller, friction
            between bodies. For an `Attitude` the velocity is angular, and the force a
            torque, along the axes of the body; elsewhere its part along the manifold
            acts. As of `MechanicalSystem`. Defaults to none.

        **Raises:**

        `ValueError` if any is of the wrong kind; and when the solve is traced, if a
        state or what a function returns has the wrong shape.
        """
        leaves = jtu.tree_leaves(manifold, is_leaf=_is_manifold)
        if not leaves or not all(map(_is_manifold, leaves)):
            raise ValueError(
                "`ManifoldSystem(manifold, ...)` needs a manifold such as `Sphere()`, "
                f"or a pytree of manifolds, but got {manifold!r}."
            )
        self.manifold, self.potential = manifold, as_potential(potential)
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        self.friction, self.external = as_laws(friction) or None, force
        _ = self.parts  # An error if a law does not fit the system.

    def map(self, fn: Callable, *trees: PyTree) -> PyTree:
        """A function of each manifold and of parts of other trees."""
        return jtu.tree_map(fn, self.manifold, *trees, is_leaf=_is_manifold)

    def _each(self, method: str, *trees: PyTree) -> PyTree:
        return self.map(lambda m, *x: getattr(m, method)(*x), *trees)

    def pair(self, pairs: PyTree) -> State:
        """A pair of trees from a tree of pairs."""
        return self.map(lambda _, x: x[0], pairs), self.map(lambda _, x: x[1], pairs)

    @property
    def is_free(self) -> bool:
        return all(jtu.tree_leaves(self.map(lambda m: m.is_free)))

    def turning(self, q: Q, p: P) -> Scalar:
        return tree.largest(self._each("turning", q, p))

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return self.friction or ()

    @property
    def mechanics(self) -> Mechanics:
        return Mechanics(self.map(lambda m: m.mass))

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        parts, kick_by = self.parts, "force"
        if parts.local:
            # By the exponential of a rate, which is not along every manifold.
            kick_by = "friction" if self.is_free else "momentum"
        if self.external is not None or parts.drags or parts.forces:
            kick_by = "momentum"
        # Other friction would be part of the kicks, or make a drift several.
        is_drift = kick_by == "force" and has_rates(parts)
        nystrom = {"nystrom"} if is_drift else set()
        kinds = frozenset({"any"} | nystrom)
        return (ManifoldSplit(kinds=kinds, kick_by=kick_by, is_resolved=self.is_free),)

    def check_state(self, y: PyTree) -> None:
        wanted = jtu.tree_structure(self.manifold, is_leaf=_is_manifold)
        fits = type(y) is tuple and len(y) == 2
        fits = fits and all(jtu.tree_structure(x) == wanted for x in y)
        if fits:
            manifolds = jtu.tree_leaves(self.manifold, is_leaf=_is_manifold)
            rows = zip(manifolds, *map(jtu.tree_leaves, y), strict=True)
            fits = all(m.momenta(jnp.shape(q)) == jnp.shape(p) for m, q, p in rows)
        floating = lambda x: jnp.issubdtype(jnp.result_type(x), jnp.floating)
        if not fits or not all(map(floating, jtu.tree_leaves(y))):
            raise ValueError(
                "The state must be a pair `(q, p)` of floating arrays for each "
                "manifold of `ManifoldSystem`, of one shape, but for an `Attitude` "
                "quaternions and three momenta for each body of its `inertia`, and for "
                "a `Stiefel` one matrix with no more columns than rows. Got "
                f"{describe(y)}. Write `y0=(q0, p0)`."
            )

    def violation(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """By how much a state is off the manifold, or its momentum not tangential."""
        return tree.largest(self._miss(t, q, p))

    def off_manifold(self, t: Time, h: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        place, momentum = self._miss(t, q, p)
        # Where momenta are to be tangential they are velocities.
        each = lambda miss, p: unitless(miss, tree.largest(p), as_time(h))
        return tree.largest((place, jtu.tree_map(each, momentum, p)))

    def _miss(self, t: Time, q: Q, p: P) -> State:
        return tree.sub(self.project(t, (q, p)), (q, p))

    def project(self, t: Time, y: State, args: PyTree = None) -> State:
        """A state on the manifold, from one near it, with a tangential momentum; not a
        number of a vector of length zero."""
        self.check_state(y)
        return self.pair(self._each("project", *y))

    def fit_friction(self, p: P) -> LinearFriction | None:
        friction = super().fit_friction(p)
        if friction is not None and not (self.is_free or friction.is_one_rate):
            raise ValueError(
                "Friction on a `Sphere` or a `Stiefel` must be at one rate. Write "
                "`ConstantDamping(rate)` with a number, or a pytree of numbers for "
                "several manifolds."
            )
        return friction

    def from_velocity(self, t: Time, y: tuple[Q, P], args: PyTree = None) -> State:
        """The state `(q, p)` of positions and velocities `(q, v)`, which of an
        `Attitude` are angular velocities along the axes of the body."""
        return y[0], momentum(self.mechanics.mass, y[1], MASS, "v")

    def to_velocity(self, t: Time, y: State, args: PyTree = None) -> tuple[Q, P]:
        """Positions and velocities `(q, v)` of a state `(q, p)`, of an `Attitude`
        angular ones along the axes of the body: save them by
        `SaveAt(..., fn=system.to_velocity)`."""
        return y[0], self._along_axes(y[1])

    # The vector field.

    def _along_axes(self, p: P) -> P:
        """The velocities that momenta have, of bodies along their axes."""
        return divide(self.mechanics.mass, p, MASS, "p")

    def _tangential(self, q: Q, force: P) -> P:
        """The part along the manifold of forces on the momenta."""
        return self.map(lambda m, q, x: m.project(q, x)[1], q, force)

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        v = self._along_axes(p)
        with jax.numpy_dtype_promotion("standard"):
            return tree.dot(p, v) / 2 + self.potential(t, q, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return self._each("velocity", q, p)

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.velocity_and_force(t, q, p, args)[1]

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        velocity, force = self.pair(self._each("rates", q, p))
        force = tree.add(force, self.kick(t, q, p, args))
        return velocity, self.add_forces(force, self.external, t, q, p, velocity, args)

    def add_forces(
        self, force: P, external: Callable | None, t: Time, q: Q, p: P, v: Q, args
    ) -> P:
        """As of any system, of velocities that are along the axes of bodies."""
        if external is None and not any(self.parts[1:]):
            return force
        state = t, q, p, self._along_axes(p), args
        other = super().add_forces(tree.zeros(p), external, *state)
        return tree.add(force, self._tangential(q, other))

    def to_momentum(self, q: Q, force: Q) -> P:
        """The rate of change of the momenta by a force in ambient coordinates."""
        return self._each("pull", q, force)

    def kick(self, t: Time, q: Q, p: P, args: PyTree) -> P:
        """The rate of change of the momenta by the potential."""
        if not isinstance(self.potential, ForceField):
            return self.to_momentum(q, self.potential.force(t, q, args))
        force = match(self.potential.fn(t, q, args), p, "`force`", "`p`")
        return self._tangential(q, force)


class ManifoldSplit(AbstractForceSplit):
    """The free motion, with friction, and tangential kicks."""

    kinds: frozenset[str] = eqx.field(static=True)
    kick_by: str = eqx.field(static=True)
    # Of others, derivatives along the motion take as long as a shorter step.
    is_resolved: bool = eqx.field(static=True)

    @property
    def failure(self):
        return super().failure if self.kick_by == "momentum" else TURNS_TOO_FAR

    def quadrature(self, system, order) -> int:
        return 0 if system.friction is None or system.friction.is_known else order

    def in_kicks(self, system, order) -> bool:
        # Composed with a drift to a higher order it would be several drifts.
        friction = system.friction
        if friction is None or friction.is_one_rate:
            return False
        return order > 2 and friction.is_autonomous

    def prepare(self, system, t, h, order) -> PyTree:
        friction, once = system.friction, jnp.reshape(h, 1)
        if friction is None or self.in_kicks(system, order):
            return once, None
        shortens = friction.is_one_rate
        h = once if shortens else lengths(order, h)
        starts, prepare = t + jnp.cumsum(h) - h, partial(friction.prepare, order=order)
        halves = lambda t, h: (prepare(t, h / 2), prepare(t + h / 2, h / 2))
        return h, jax.vmap(prepare if shortens else halves)(starts, h)

    def drift(self, system, t, h, data, y) -> State:
        def stage(y, row):
            q, p = self._stage(system, *row, *tree.values(y))
            return system.add(y, tree.sub((q, p), tree.values(y)))

        return over_stages(stage, y, data)

    def _stage(self, system, h, data, q, p) -> State:
        term, friction = system.term, system.friction
        if data is None or not friction.is_one_rate:
            flow = lambda m, q, p: m.flow(q, p, cast_to(h, p))
            move = lambda q, p: term.pair(term.map(flow, q, p))
            if data is None:
                return move(q, p)
            q, p = move(q, tree.add(p, friction.decay(data[0], p)))
            return q, tree.add(p, friction.decay(data[1], p))
        # Friction at a rate: a shorter time, and a slower motion.
        flow = lambda m, q, p, effect: m.flow(q, p, cast_to(effect.carried, p))
        q, p = term.pair(term.map(flow, q, p, data.leaves))
        return q, tree.add(p, friction.decay(data, p))

    def place_force(self, system, t, y) -> PyTree:
        return system.term.kick(t, *tree.values(y), system.args)
