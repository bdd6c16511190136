"""Friction by coefficients, the force per velocity."""

from collections.abc import Callable
from typing import Any

from jaxtyping import PyTree

from .. import _tree as tree
from .._forms import as_form, is_operator, multiply
from .._numbers import Time
from ._base import (
    AbstractFriction,
    COEFFICIENTS,
    Form,
    Linear,
    Local,
    Mechanics,
    Parts,
)
from ._log_scale import Linear as LinearScale


_FORMS = (
    "a number, an array, a matrix, a pytree of these or a `lineax` operator, or a "
    "function `C(t, q, args)`"
)


def needs_mass(mechanics: Mechanics, name: str) -> None:
    if not mechanics.has_mass:
        raise ValueError(
            f"`{name}` is friction per velocity, and needs to know the mass. Write the "
            "kinetic energy as `QuadraticKinetic(mass)`; or write the friction as "
            "`force=f`, with a function `f(t, q, v, args)` such as "
            "`lambda t, q, v, args: -C @ v`."
        )


class ViscousDamping(AbstractFriction):
    r"""Friction $-C v$ by a coefficient $C$, in units of force per velocity: dashpots,
    viscous drag, magnetic fields, Coriolis forces.

    For friction at a rate, in units of one over time, write
    [`diffrax_presym.ConstantDamping`][]. For [`diffrax_presym.MechanicalSystem`][] with
    a kinetic energy of known mass, and [`diffrax_presym.LagrangianSystem`][]. In the
    first the flow of drift and friction is exact, by $e^{-h C M^{-1}}$ and its
    integral, so that every scheme keeps its order. A symmetric positive matrix $C$
    damps; an antisymmetric one does no work, and the energy is kept. The force
    $e \, v \times B$ on a charge $e$ in a uniform magnetic field $B$ is
    `ViscousDamping(e * jnp.array([[0, -B[2], B[1]], [B[2], 0, -B[0]],
    [-B[1], B[0], 0]]))`, and the Coriolis force in a frame that rotates with $\Omega$
    has $2 m \Omega$ in place of $e B$ with the opposite sign.

    With numbers or arrays the cost is that of
    [`diffrax_presym.ConstantDamping`][]. With matrices and equal steps, in the loop of
    [`diffrax_presym.FixedStepAdjoint`][], exponentials for all stages are computed once
    for a solve, and a drift is two products with a matrix. Elsewhere a drift takes
    about fifteen products, more under strong friction.

    Rayleigh damping, $C = \alpha M + \beta K$, is a list of two laws:
    `[ConstantDamping(alpha), ViscousDamping(beta * K)]`.

    If $C$ depends on time or place, by a function, the friction is part of the kicks,
    and exact there at fixed positions: as [`diffrax_presym.PositionDamping`][].
    """

    coefficients: Form | Callable

    def __init__(self, coefficients):
        r"""**Arguments:**

        - `coefficients`: $C$, in units of force per velocity (torque per angular
            velocity for an angle), of any sign, in any of these forms.
            - A number: the same for every degree of freedom.
            - An array with as many dimensions as `p`, and broadcastable to it: a
                coefficient for each degree of freedom.
            - A square matrix, with `p` a vector; not necessarily symmetric.
            - An array with one dimension more than `p`: a matrix for each vector over
                the last axis of `p`. For the same matrix of `n` particles in three
                dimensions, with `p` of shape `(n, 3)`, pass shape `(1, 3, 3)`.
            - A pytree of the structure of `p`, whose leaves are any of the above.
            - A `lineax.AbstractLinearOperator`, with `p` a vector. It is used as its
                matrix.
            - A function `C(t, q, args)` that returns any of the above but operators.

        **Raises:**

        `ValueError` if a coefficient is not a finite real number or array; and when the
        solve is traced, if a shape does not fit `p` or the mass is not known.
        """
        if coefficients is None:
            raise ValueError(
                f"{COEFFICIENTS} must be {_FORMS}, but got None. For one force per "
                "velocity write `ViscousDamping(1.0)`."
            )
        if not callable(coefficients) or is_operator(coefficients):
            coefficients = as_form(coefficients, COEFFICIENTS, positive=False)
        self.coefficients = coefficients

    @property
    def is_local(self) -> bool:
        """Whether the coefficients depend on place."""
        return callable(self.coefficients) and not is_operator(self.coefficients)

    def parts(self, mechanics: Mechanics) -> Parts:
        coefficients: Any = self.coefficients
        if mechanics.mass_varies:
            return Parts(forces=(self,))
        needs_mass(mechanics, "ViscousDamping")
        if self.is_local:
            return Parts(local=(Local(coefficients, per_velocity=True),))
        return Parts((Linear(LinearScale(), coefficients, per_velocity=True),))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        form: Any = self.coefficients
        form = form(t, q, args) if self.is_local else form
        return tree.scale(-1, multiply(form, v, COEFFICIENTS, "v"))
