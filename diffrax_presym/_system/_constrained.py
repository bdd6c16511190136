"""Mechanical systems with holonomic constraints."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import check_callable, describe
from .._friction._base import AbstractFriction, Mechanics
from .._friction._linear import LinearFriction
from .._numbers import as_time, Scalar, State, Time
from ._base import AbstractSystem, P, Q
from ._constrained_split import ConstrainedSplit
from ._force_split import AbstractForceSplit
from ._kinetic import QuadraticKinetic
from ._manifold import ManifoldSystem
from ._manifolds import size, unitless
from ._mechanical import MechanicalSystem
from ._multipliers import (
    as_matrix,
    find_root,
    is_regular,
    LinearMap,
    Multipliers,
    solve,
)
from ._split import AbstractSplit


class ConstrainedSystem(AbstractSystem):
    """A mechanical system, or bodies, with holonomic constraints `g(t, q) = 0`,

    `q' = M^-1 p` and `p' = F - Γ p - G^T λ` with `G = ∂g/∂q`,

    whose multipliers `λ` keep `g` and its rate of change `G M^-1 p + ∂g / ∂t` zero, to
    rounding.

    `Strang` is then RATTLE (Andersen 1983): symmetric, of second order, with exact
    friction, and conformally symplectic if that is one rate. Compositions,
    `Suzuki4(Strang())` or `SofroniouSpaletta(6, Strang())`, are of higher order; so are
    `BlanesMoan4` and `BlanesMoan6`, whose drifts are compositions, for expensive
    forces. Other schemes are refused.

    A step whose multipliers are not found fails. Start from `system.project(t0, y0,
    args)`. In Diffrax's loop save values between steps by `SaveAt(ts=ts,
    fn=system.project)`.

    !!! example

        ```python
        # A spherical pendulum in Cartesian coordinates.
        weight = lambda t, q, args: 9.81 * q[2]
        rod = lambda t, q, args: q @ q - 1.0
        free = MechanicalSystem(QuadraticKinetic(), weight, ConstantDamping(0.1))
        system = ConstrainedSystem(free, rod)
        y0 = system.project(0.0, (jnp.array([0.6, 0.0, -0.8]), jnp.ones(3)))
        sol = diffeqsolve(system, Strang(), t0=0.0, t1=10.0, dt0=0.01, y0=y0)
        ```
    """

    system: MechanicalSystem | ManifoldSystem
    constraint: Callable
    linear_solver: lx.AbstractLinearSolver | None
    check_inverse: bool = eqx.field(static=True)
    is_constrained: ClassVar[bool] = True
    drift_is_autonomous: ClassVar[bool] = True

    def __init__(
        self,
        system: MechanicalSystem | ManifoldSystem,
        constraint: Callable,
        *,
        linear_solver: lx.AbstractLinearSolver | None = None,
        check_inverse: bool = False,
    ):
        """**Arguments:**

        - `system`: a `MechanicalSystem` with a quadratic kinetic energy, or a
            `ManifoldSystem`, such as rigid bodies that are joined; with any friction
            and any forces of the velocity.
        - `constraint`: a function `g(t, q, args)` that returns an array, zero where the
            constraints hold, or a scalar. A solve fails from a state where it is not
            zero to 1e-8, so scale it, `q @ q / length**2 - 1`; or where its rate of
            change is not, relative to that along other directions at the same speed.
        - `linear_solver`: a Lineax solver for the multipliers. Defaults to `None`, by
            their matrix. For a chain, in which constraints share coordinates with their
            neighbours alone, and neither mass nor friction joins others, the cost of
            `lineax.Tridiagonal()` is linear. Not for symmetric matrices alone, such as
            `lineax.CG`, of which `lineax.Normal` makes one for any.
        - `check_inverse`: whether steps are also inverted, and fail if that ends
            elsewhere: for Monte Carlo methods. It doubles the cost. Defaults to
            `False`.

        **Raises:**

        `ValueError` if any is of the wrong kind, if the system has another kinetic
        energy, and when the solve is traced if the constraint returns something else. A
        solve from a state that is off the constraint fails.
        """
        if not isinstance(system, MechanicalSystem | ManifoldSystem):
            raise ValueError(
                "`ConstrainedSystem(system, constraint)` needs a `MechanicalSystem` or "
                f"a `ManifoldSystem`, but got {type(system).__name__}. Write the "
                "constraint in Cartesian coordinates, in which the mass is constant."
            )
        if isinstance(system, MechanicalSystem) and not isinstance(
            system.kinetic, QuadraticKinetic
        ):
            raise ValueError(
                "`ConstrainedSystem` needs a constant mass, `QuadraticKinetic(mass)`."
            )
        check_callable(constraint, "constraint", "g(t, q, args)")
        if not isinstance(linear_solver, lx.AbstractLinearSolver | None):
            raise ValueError(
                "`linear_solver` must be a Lineax solver such as "
                f"`lineax.Tridiagonal()`, but got {linear_solver!r}."
            )
        self.system, self.constraint = system, constraint
        self.linear_solver, self.check_inverse = linear_solver, check_inverse

    # As the system without constraints.

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return self.system.laws

    @property
    def mechanics(self) -> Mechanics:
        return self.system.mechanics

    def fit_friction(self, p: P) -> LinearFriction | None:
        return self.system.fit_friction(p)

    def factorised(self, p: P) -> "ConstrainedSystem":
        return eqx.tree_at(lambda x: x.system, self, self.system.factorised(p))

    def check_state(self, y: PyTree) -> None:
        self.system.check_state(y)

    def add_forces(
        self, force: P, external: Callable | None, t: Time, q: Q, p: P, v: Q, args
    ) -> P:
        return self.system.add_forces(force, external, t, q, p, v, args)

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        return self.system.energy(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return self.system.velocity(t, q, p, args)

    def from_velocity(self, t: Time, y: tuple[Q, P], args: PyTree = None) -> State:
        return self.system.from_velocity(t, y, args)

    def to_velocity(self, t: Time, y: State, args: PyTree = None) -> tuple[Q, P]:
        return self.system.to_velocity(t, y, args)

    # The constraint.

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        (split, *_) = self.system.splits
        assert isinstance(split, AbstractForceSplit)
        return (ConstrainedSplit(split),)

    def value(self, t: Time, q: Q, args: PyTree) -> Multipliers:
        """The constraints, as a vector."""
        value = self.constraint(t, q, args)
        leaves = jtu.tree_leaves(value)
        dtype = jnp.result_type(*map(jnp.result_type, leaves)) if leaves else int
        if len(leaves) != 1 or not jnp.issubdtype(dtype, jnp.floating):
            raise ValueError(
                "`constraint` must return a real array, with an entry for each "
                f"constraint, but returned {describe(value)}. Use `jnp.stack`."
            )
        return jnp.ravel(leaves[0])

    def rate(self, t: Time, q: Q, p: P, args: PyTree, flow: float = 1.0) -> Multipliers:
        """The rate of change of the constraints at a momentum, or, if time does not
        `flow`, that of a change of momentum."""
        dt, v = jnp.full_like(t, flow), self.velocity(t, q, p, args)
        value = lambda t, q: self.value(t, q, args)
        return jax.jvp(value, (t, q), (dt, v))[1]

    def normal(self, t: Time, q: Q, args: PyTree) -> Callable[[Multipliers], P]:
        """The map from multipliers to momenta, `G^T`."""
        pull = jax.vjp(lambda q: self.value(t, q, args), q)[1]
        if isinstance(self.system, ManifoldSystem):
            to_momentum = self.system.to_momentum
            return lambda x: to_momentum(q, pull(x)[0])
        return lambda x: pull(x)[0]

    def _matrix(self, t: Time, q: Q, args: PyTree) -> LinearMap:
        """The map `G M^-1 G^T`."""
        normal = self.normal(t, q, args)
        return lambda x: self.rate(t, q, normal(x), args, flow=0.0)

    def along(self, t: Time, q: Q, args: PyTree) -> Callable[[P], P]:
        """The map from a force to its part along the constraints."""
        gradient = jax.linearize(lambda q: self.value(t, q, args), q)[1]
        rate = lambda force: gradient(self.velocity(t, q, force, args))
        normal, solver = self.normal(t, q, args), self.linear_solver
        like = jnp.zeros_like(self.value(t, q, args))
        matrix = as_matrix(self._matrix(t, q, args), like, solver)
        return lambda force: tree.sub(force, normal(solve(matrix, rate(force), solver)))

    def to_tangent(self, t: Time, q: Q, p: P, args: PyTree, flow: float = 1.0) -> P:
        """The change of a momentum that makes it tangential; as of a force, if time
        does not `flow`."""
        return self._reaction(t, q, self.rate(t, q, p, args, flow), args)

    def _reaction(self, t: Time, q: Q, miss: Multipliers, args: PyTree) -> P:
        linear = self._matrix(t, q, args)
        x = solve(linear, miss, self.linear_solver)
        return tree.scale(-1, self.normal(t, q, args)(x))

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        t, friction = as_time(t), self.fit_friction(p)
        v, force = self.system.velocity_and_force(t, q, p, args)
        net = force if friction is None else friction.net_force(t, force, p)
        rate, along = (
            lambda t, q, p: self.rate(t, q, p, args),
            (jnp.ones_like(t), v, net),
        )
        _, gained = jax.jvp(rate, (t, q, p), along)
        return v, tree.add(force, self._reaction(t, q, gained, args))

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.velocity_and_force(t, q, p, args)[1]

    def violation(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """The largest entry of the constraints and of their rates of change, or by how
        much the state is off the manifold of the system."""
        t, other = as_time(t), self.system.violation(t, q, p, args)
        both = [self.value(t, q, args), self.rate(t, q, p, args)]
        return tree.largest(both if other is None else [*both, other])

    def off_manifold(self, t: Time, h: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        other = self.system.off_manifold(t, h, q, p, args)
        rate, value = self.rate(t, q, p, args), lambda t, q: self.value(t, q, args)
        # The size of a rate is that along other directions at the same speeds.
        v = self.velocity(t, q, p, args)
        speeds = lambda v: jnp.broadcast_to(size(jnp.atleast_1d(v)), v.shape or (1,))
        speed, structure = ravel_pytree(jtu.tree_map(speeds, v))
        angles = jnp.arange(1, 1 + speed.size).astype(speed.dtype)
        other_way = structure(speed * jnp.cos(angles))
        other_way = jtu.tree_map(lambda x, v: jnp.reshape(x, v.shape), other_way, v)
        along = jnp.full_like(t, 2), other_way
        here, usual = jax.jvp(value, (t, q), along)
        both = [here, unitless(rate, usual, as_time(h))]
        return tree.largest(both if other is None else [*both, other])

    @eqx.filter_jit  # Outside of a solve, it would be compiled again by each call.
    def project(self, t: Time, y: State, args: PyTree = None) -> State:
        """The state with positions moved along `M^-1 G^T` until the constraints hold,
        and the nearest momentum for which their rates of change are zero.

        **Raises:**

        `RuntimeError` if the constraints are redundant there, or the positions are too
        far from them.
        """
        self.check_state(y)
        t, (q, p) = as_time(t), self.system.project(t, y, args)
        normal = self.normal(t, q, args)

        def moved(x: Multipliers) -> Q:
            change = self.velocity(t, q, normal(x), args)
            return self.system.project(t, (tree.sub(q, change), p), args)[0]

        zero = jnp.zeros_like(self.value(t, q, args))
        regular = is_regular(self._matrix(t, q, args), zero, self.linear_solver)
        miss = lambda x: self.value(t, moved(x), args)
        x, found = find_root(miss, zero, self.linear_solver)
        q = eqx.error_if(moved(x), ~regular, _REDUNDANT)
        q = eqx.error_if(q, ~found, _TOO_FAR)
        q, p = self.system.project(t, (q, p), args)
        return q, tree.add(p, self.to_tangent(t, q, p, args))


_REDUNDANT = (
    "The constraints are redundant: at this state their gradients are linearly "
    "dependent. Omit those that follow from the others. With `lineax.Tridiagonal()` "
    "also those of a chain whose mass joins more than neighbours: use the default "
    "`linear_solver=None`."
)
_TOO_FAR = (
    "`project` did not find positions that satisfy the constraints. Start nearer to "
    "them."
)
