"""Mechanics with a mass matrix that depends on the positions."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax as lx
from jaxtyping import Array, Bool, Inexact, PyTree

from .._forms import as_form, multiply
from .._friction._base import Scalar, Time
from .._misc import all_finite, cast_to, describe, match, scalar_fn
from ._base import AbstractHamiltonian
from ._energy import check_callable


_Vector = Inexact[Array, " n"]
_Matrix = Inexact[Array, "n n"]

# Up to this size a factorisation written out in full was measured faster than LAPACK.
_SMALL = 6

_FRICTION = "`LagrangianSystem(friction=...)`"


class LagrangianSystem(AbstractHamiltonian):
    r"""A mechanical system with a mass matrix $M(t, q)$: robots, chains, linkages.

    The Lagrangian is $L = v \cdot M(t, q) \, v / 2 - V(t, q)$, and the state of a solve
    is $(q, p)$, a vector of joint positions and the momenta $p = M(t, q) \, v$. The
    equations of motion are

    $$q' = v = M^{-1} p, \qquad p' = \partial L / \partial q - C v + f(t, q, v).$$

    $\partial L / \partial q$ is taken at constant $v$, so that one Cholesky
    factorisation gives both velocity and force, and no derivative is taken through it.
    The energy is $E = p \cdot M^{-1} p / 2 + V$.

    Not separable: use [`diffrax_presym.PresymplecticGauss`][]. Without `friction` and
    `force` the system is Hamiltonian, and the structure is preserved. Both are part of
    the force to the solvers of this package; with either the solvers keep their order
    and symmetry. For a friction $\gamma p$, the same for all momenta, use
    `ConformalHamiltonian(energy=system.energy, damping=...)`, which preserves the
    conformal structure.

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

        system = LagrangianSystem(mass_matrix, potential, friction=0.1)
        q0, v0 = jnp.array([1.0, 2.0]), jnp.zeros(2)
        sol = diffeqsolve(
            HamiltonianTerm(system), PresymplecticGauss(6),
            t0=0.0, t1=10.0, dt0=0.05, y0=(q0, system.from_velocity(0.0, q0, v0)),
        )
        ```
    """

    mass_fn: Callable
    potential: Callable
    coefficients: PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None
    force_fn: Callable | None
    damping = None
    splits = ()

    def __init__(self, mass_matrix, potential, friction=None, force=None):
        """**Arguments:**

        - `mass_matrix`: a function `M(t, q, args)` of a vector `q` of shape `(n,)` that
            returns a symmetric positive definite matrix of shape `(n, n)`. In units of
            mass for a position, of moment of inertia for an angle.
        - `potential`: the potential energy, a function `V(t, q, args)` that returns one
            number.
        - `friction`: the coefficients `C` of the friction `-C v`, in units of force per
            velocity (torque per angular velocity for an angle): a number, an array of
            shape `(n,)` with one for each entry of `q`, a matrix of shape `(n, n)` or a
            `lineax.AbstractLinearOperator`. A damper acts on the angle of its joint:
            if `q` are angles from the vertical, and `J @ q` those of the joints, pass
            `J.T @ jnp.diag(dampers) @ J`. Defaults to no friction.
        - `force`: any further generalised force, a function `f(t, q, v, args)` of the
            velocity `v` that returns an array of shape `(n,)`: a motor, a controller,
            drag. Defaults to none.

        **Raises:**

        `ValueError` if a function is not one, or the friction not a real array of at
        most two axes; and when the solve is traced if `q` is not a vector, or if the
        mass matrix, the friction or the force is of the wrong shape.
        """
        check_callable(mass_matrix, "mass_matrix", "M(t, q, args)")
        check_callable(potential, "potential", "V(t, q, args)")
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        if callable(friction):
            raise ValueError(
                "`friction` must be a number, an array or a matrix of coefficients, "
                f"but got {friction!r}. Write friction that is a function as "
                "`force=f`, with `f(t, q, v, args)`."
            )
        self.mass_fn = mass_matrix
        self.potential = potential
        self.coefficients = as_form(friction, _FRICTION, positive=False)
        self.force_fn = force

    def mass_matrix(self, t: Time, q: _Vector, args: PyTree = None) -> _Matrix:
        """The mass matrix, in the precision of `q`."""
        if not isinstance(q, jax.Array) or q.ndim != 1:
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
        self, t: Time, q: _Vector, v: _Vector, args: PyTree = None
    ) -> _Vector:
        """The momentum $p = M(t, q) v$ of a velocity.

        **Arguments:**

        - `t`, `args`: time and arguments, as for a solve.
        - `q`, `v`: positions and velocities, of shape `(n,)`.

        **Returns:**

        The momenta, of shape `(n,)`.
        """
        return self.mass_matrix(t, q, args) @ v

    def to_velocity(
        self, t: Time, q: _Vector, p: _Vector, args: PyTree = None
    ) -> _Vector:
        """The velocity $v = M(t, q)^{-1} p$ of a momentum.

        **Arguments:**

        - `t`, `args`: time and arguments, as for a solve.
        - `q`, `p`: positions and momenta, of shape `(n,)`. For a whole trajectory use
            `jax.vmap`.

        **Returns:**

        The velocities, of shape `(n,)`.
        """
        return _solve_positive(self.mass_matrix(t, q, args), p)

    def energy(self, t: Time, q: _Vector, p: _Vector, args: PyTree = None) -> Scalar:
        v = self.to_velocity(t, q, p, args)
        return p @ v / 2 + self._potential(t, q, args)

    def velocity(self, t: Time, q: _Vector, p: _Vector, args: PyTree = None) -> _Vector:
        return self.to_velocity(t, q, p, args)

    def force(self, t: Time, q: _Vector, p: _Vector, args: PyTree = None) -> _Vector:
        return self.velocity_and_force(t, q, p, args)[1]

    def velocity_and_force(
        self, t: Time, q: _Vector, p: _Vector, args: PyTree = None
    ) -> tuple[_Vector, _Vector]:
        v = self.to_velocity(t, q, p, args)

        def lagrangian(q):
            kinetic = v @ (self.mass_matrix(t, q, args) @ v) / 2
            return kinetic - self._potential(t, q, args)

        force = jax.grad(lagrangian)(q)
        if self.coefficients is not None:
            force = force - multiply(self.coefficients, v, _FRICTION, "q")
        if self.force_fn is not None:
            value = self.force_fn(t, q, v, args)
            force = force + match(value, q, "`force`", "`q`")
        return v, force

    @property
    def is_conservative(self) -> bool:
        """Whether there is neither friction nor a further force."""
        return self.coefficients is None and self.force_fn is None

    def friction_force(
        self, t: Time, q: _Vector, p: _Vector, args: PyTree = None
    ) -> _Vector:
        v = self.to_velocity(t, q, p, args)
        if self.coefficients is None:
            return jnp.zeros_like(v)
        return -multiply(self.coefficients, v, _FRICTION, "q")

    def _potential(self, t, q, args):
        return cast_to(scalar_fn(self.potential, "The potential")(t, q, args), q)

    def is_valid(
        self, t: Time, q: _Vector, p: _Vector, args: PyTree = None
    ) -> Bool[Array, ""]:
        M = self.mass_matrix(t, q, args)
        rounding = 1e3 * float(jnp.finfo(M.dtype).eps) * jnp.max(jnp.abs(M), initial=0)
        symmetric = jnp.all(jnp.abs(M - M.T) <= rounding)
        return symmetric & all_finite((q, _solve_positive(M, p)))

    def kinetic_flow(
        self, t: Time, h: Time, q: _Vector, p: _Vector, args=None, order: int = 8
    ) -> tuple[_Vector, None]:
        raise ValueError(
            "A `LagrangianSystem` has no exact drift, because its mass matrix depends "
            "on the positions. Use `PresymplecticGauss()`, which needs none."
        )


def _solve_positive(M: _Matrix, p: _Vector) -> _Vector:
    """The solution of `M v = p`, NaN if `M` is not positive definite.

    From the lower triangle of `M`, like LAPACK.
    """
    n = len(p)
    if n > _SMALL:
        L = jnp.linalg.cholesky(M, symmetrize_input=False)
        return jsl.cho_solve((L, True), p)
    # Cholesky's factorisation, scalar by scalar.
    L = [[M[i, j] for j in range(i + 1)] for i in range(n)]
    v = [p[i] for i in range(n)]
    inverse = []
    for j in range(n):
        for i in range(j, n):
            for k in range(j):
                L[i][j] = L[i][j] - L[i][k] * L[j][k]
        inverse.append(1 / jnp.sqrt(L[j][j]))
        for i in range(j + 1, n):
            L[i][j] = L[i][j] * inverse[j]
    for i in range(n):
        for k in range(i):
            v[i] = v[i] - L[i][k] * v[k]
        v[i] = v[i] * inverse[i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            v[i] = v[i] - L[k][i] * v[k]
        v[i] = v[i] * inverse[i]
    return jnp.stack(v)
