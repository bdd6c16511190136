"""Mechanics with a mass matrix that depends on the positions."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._checks import check_callable, describe, scalar_fn
from .._forms import Matrix, solve_positive, Vector, WRITTEN_OUT
from .._friction._base import AbstractFriction, Mechanics
from .._friction._damping import as_laws
from .._numbers import cast_to, Scalar, Time
from ._base import AbstractSystem
from ._split import AbstractSplit


class LagrangianSystem(AbstractSystem):
    """A mechanical system with a mass matrix `M(t, q)`: robots, chains, linkages.

    The Lagrangian is `L = v · M(t, q) v / 2 - V(t, q)`, and the state of a solve is
    `(q, p)`, a vector of joint positions and the momenta `p = M(t, q) v`. The equations
    of motion are

    `q' = v = M^-1 p` and `p' = ∂L/∂q - C v + f(t, q, v)`.

    `∂L / ∂q` is taken at constant `v`, so that one factorisation of `M` gives both
    velocity and force, and no derivative is taken through it. The energy is
    `E = p · M^-1 p / 2 + V`.

    Not separable: use `PresymplecticGauss`. With friction at one rate for all momenta
    the conformal structure is preserved. Friction per velocity and a `force` are part
    of the force to the solvers of this package; with either the solvers keep their
    order and symmetry.

    A mass matrix that is not positive definite gives a velocity of NaN. Solvers of this
    package check the mass matrix at the end of every step: a solve fails, with a
    `RESULTS` that is not successful, where it is not positive definite or not symmetric
    to rounding. Other Diffrax solvers do not check the symmetry.

    !!! example

        ```python
        # Two links of unit length and mass, angles measured from the vertical.
        def mass_matrix(t, q, args):
            c = jnp.cos(q[0] - q[1])
            return jnp.array([[2.0, c], [c, 1.0]])

        def potential(t, q, args):
            return -9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

        system = LagrangianSystem(mass_matrix, potential, ViscousDamping(0.1))
        y0 = system.from_velocity(0.0, (jnp.array([1.0, 2.0]), jnp.zeros(2)))
        sol = diffeqsolve(
            system, PresymplecticGauss(6), t0=0.0, t1=10.0, dt0=0.05, y0=y0,
        )
        ```
    """

    mass_fn: Callable
    potential: Callable
    friction: tuple[AbstractFriction, ...] | None  # Equinox fails on `()` in a term
    external: Callable | None

    def __init__(self, mass_matrix, potential, friction=None, force=None):
        """**Arguments:**

        - `mass_matrix`: a function `M(t, q, args)` of a vector `q` of shape `(n,)` that
            returns a symmetric positive definite matrix of shape `(n, n)`. In units of
            mass for a position, of moment of inertia for an angle.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns one
            number.
        - `friction`: a law of friction, or a list: most often `ViscousDamping` with
            coefficients in units of force per velocity (torque per angular velocity for
            an angle). A damper acts on the angle of its joint: if `q` are angles from
            the vertical, and `J @ q` those of the joints, write `ViscousDamping(J.T @
            jnp.diag(dampers) @ J)`. Defaults to no friction.
        - `force`: any further generalised force, a function `f(t, q, v, args)` of the
            velocity `v` that returns an array of shape `(n,)`: a motor, a controller,
            drag. Defaults to none.

        **Raises:**

        `ValueError` if a function is not one, or the friction not a law; and when the
        solve is traced if `q` is not a vector, or if the mass matrix, the friction or
        the force is of the wrong shape.
        """
        check_callable(mass_matrix, "mass_matrix", "M(t, q, args)")
        check_callable(potential, "potential", "V(t, q, args)")
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        self.mass_fn = mass_matrix
        self.potential = potential
        self.friction = as_laws(friction) or None
        self.external = force
        _ = self.parts  # An error if a law does not fit the system.

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return self.friction or ()

    @property
    def mechanics(self) -> Mechanics:
        return Mechanics(mass_varies=True)

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        return ()

    def mass_matrix(self, t: Time, q: Vector, args: PyTree = None) -> Matrix:
        """The mass matrix, in the precision of `q`."""
        if not hasattr(q, "shape") or jnp.ndim(q) != 1:
            raise ValueError(
                "`LagrangianSystem` needs positions `q` and momenta `p` that are "
                f"vectors, arrays of shape (n,), but got {describe(q)}. Join them by "
                "`jnp.concatenate` or `jax.flatten_util.ravel_pytree`."
            )
        M, n = self.mass_fn(t, q, args), len(q)
        if not hasattr(M, "shape") or jnp.shape(M) != (n, n):
            raise ValueError(
                f"`mass_matrix` must return an array of shape ({n}, {n}) for a `q` of "
                f"shape ({n},), but returned {describe(M)}."
            )
        return cast_to(M, q)

    def from_velocity(
        self, t: Time, y: tuple[Vector, Vector], args: PyTree = None
    ) -> tuple[Vector, Vector]:
        """The state `(q, p)`, with `p = M(t, q) v`, of positions and velocities.

        **Arguments:**

        - `t`, `args`: time and arguments, as for a solve.
        - `y`: positions and velocities `(q, v)`, each of shape `(n,)`.

        **Returns:**

        The state `(q, p)`.
        """
        q, v = y
        return q, self.mass_matrix(t, q, args) @ v

    def energy(self, t: Time, q: Vector, p: Vector, args: PyTree = None) -> Scalar:
        v = self.velocity(t, q, p, args)
        return p @ v / 2 + self._potential(t, q, args)

    def velocity(self, t: Time, q: Vector, p: Vector, args: PyTree = None) -> Vector:
        return solve_positive(self.mass_matrix(t, q, args), p)

    def force(self, t: Time, q: Vector, p: Vector, args: PyTree = None) -> Vector:
        return self.velocity_and_force(t, q, p, args)[1]

    def force_at(
        self, t: Time, q: Vector, p: Vector, v: Vector, args: PyTree = None
    ) -> Vector:
        if len(q) <= WRITTEN_OUT:
            # The compiler shares what this has in common with another velocity here.
            v = self.velocity(t, q, p, args)

        def lagrangian(q):
            kinetic = v @ (self.mass_matrix(t, q, args) @ v) / 2
            return kinetic - self._potential(t, q, args)

        force = jax.grad(lagrangian)(q)
        return self.add_forces(force, self.external, t, q, p, v, args)

    def _potential(self, t, q, args):
        return cast_to(scalar_fn(self.potential, "The potential")(t, q, args), q)

    def is_valid(
        self, t: Time, q: Vector, p: Vector, args: PyTree = None
    ) -> Bool[Array, ""]:
        M = self.mass_matrix(t, q, args)
        rounding = 1e3 * float(jnp.finfo(M.dtype).eps) * jnp.max(jnp.abs(M), initial=0)
        symmetric = jnp.all(jnp.abs(M - M.T) <= rounding)
        return symmetric & tree.all_finite((q, solve_positive(M, p)))
