"""Friction by coefficients, the force per velocity, and friction by place."""

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import check_callable
from .._forms import as_form, is_operator, multiply
from .._numbers import Time
from ._base import (
    AbstractFriction,
    COEFFICIENTS,
    DAMPING,
    Form,
    LinearPart,
    Mechanics,
    Parts,
)
from ._log_scale import LinearScale


_FORMS = (
    "a number, an array, a matrix, a pytree of these or a `lineax` operator, or a "
    "function `C(t, q, args)`"
)


def needs_mass(mechanics: Mechanics, name: str) -> None:
    if not mechanics.has_mass:
        raise ValueError(
            f"`{name}` is friction per velocity, and needs to know the mass. Write "
            "`MechanicalSystem(kinetic, potential, friction)`, give a system of your "
            "own the property `mechanics`, or write the friction as a rate, "
            "`ConstantDamping(rate)`."
        )


def arrays(form: PyTree, name: str) -> PyTree:
    """What a function returned, as arrays."""
    if form is None:
        raise ValueError(f"{name} must return numbers, but returned None.")
    return jtu.tree_map(jnp.asarray, form)


_FUNCTION = "The function of friction"


class ViscousDamping(AbstractFriction):
    """Friction `-C v` by a coefficient `C`, in units of force per velocity: dashpots,
    viscous drag, magnetic fields, Coriolis forces.

    For friction at a rate, in units of one over time, write `ConstantDamping`. For
    `MechanicalSystem`, `LagrangianSystem`, and bodies of a `ManifoldSystem`. In the
    first, with `QuadraticKinetic`, the flow of drift and friction is exact, by
    `exp(-h C M^-1)` and its integral, so that no scheme loses its order by it. A
    symmetric positive matrix `C` damps; an antisymmetric one does no work, and the
    energy is kept: the force `e v × B` on a charge `e` in a uniform magnetic field `B`,
    and the Coriolis force `-2 m Ω × v` in a frame that rotates with `Ω`.

    With numbers or arrays the cost is that of `ConstantDamping`, unless the mass is a
    matrix that is not diagonal: then `C M^-1` is one too. With matrices and equal
    steps, in the loop of `FixedStepAdjoint`, exponentials for all stages are computed
    once for a solve, and a drift is two products with a matrix. Elsewhere, as with
    `StepsBetween` and in Diffrax's own loop, a drift takes up to fifteen products, the
    fewer the weaker the friction over it, and more if that is strong.

    Rayleigh damping, `C = α M + β K`, is a list of two laws: `[ConstantDamping(alpha),
    ViscousDamping(beta * K)]`.

    If `C` depends on time or place, by a function, the friction is part of the kicks,
    and exact there at fixed positions: as `PositionDamping`. With any other kinetic
    energy a kick solves an equation for the momentum, as for a `force=f`: use
    `BlanesMoan4` or `BlanesMoan6`, or over many turns in a magnetic field
    `PresymplecticGauss(8)`.

    !!! example

        ```python
        def cross_matrix(a):
            return jnp.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])

        e, B = 1.5, jnp.array([0.0, 0.1, 3.0])
        magnetic = ViscousDamping(e * cross_matrix(B))
        m, Omega = 2.0, jnp.array([0.0, 0.2, 0.3])
        coriolis = ViscousDamping(2 * m * cross_matrix(Omega))
        ```
    """

    coefficients: Form | Callable
    per_velocity: ClassVar[bool] = True

    def __init__(self, coefficients):
        """**Arguments:**

        - `coefficients`: `C`, in units of force per velocity (torque per angular
            velocity for an angle), of any sign, in any of these forms.
            - A number: the same for every degree of freedom.
            - An array with as many dimensions as `p`, and broadcastable to it: a
                coefficient for each degree of freedom.
            - A square matrix, with `p` a vector; not necessarily symmetric.
            - An array with one dimension more than `p`: a matrix for each vector over
                the last axis of `p`. For the same matrix of `n` particles in three
                dimensions, with `p` of shape `(n, 3)`, pass shape `(1, 3, 3)`. Of
                shape `(3, 3)`, for three particles, it would be taken for coefficients
                of entries; that of a magnetic field makes the solve fail then.
            - A pytree of the structure of `p`, whose leaves are any of the above.
            - A `lineax.AbstractLinearOperator`, with `p` a vector. It is used as its
                matrix.
            - A function `C(t, q, args)` that returns any of the above but operators.

        **Raises:**

        `ValueError` if a coefficient is not a finite real number or array; and when the
        solve is traced, if a shape does not fit `p`.
        """
        if coefficients is None:
            raise ValueError(
                f"{COEFFICIENTS} must be {_FORMS}, but got None. For one force per "
                "velocity write `ViscousDamping(1.0)`."
            )
        if callable(coefficients) and not is_operator(coefficients):
            check_callable(coefficients, COEFFICIENTS[1:-1], "C(t, q, args)")
            self.coefficients = coefficients
        else:
            self.coefficients = as_form(coefficients, COEFFICIENTS)

    @property
    def _function(self) -> Callable | None:
        """Of time and place, if they are no constants."""
        x = self.coefficients
        return x if callable(x) and not is_operator(x) else None

    def parts(self, mechanics: Mechanics) -> Parts:
        if mechanics.mass_varies:
            return Parts(forces=(self,))
        needs_mass(mechanics, "ViscousDamping")
        if self._function is not None:
            return Parts(local=(self,))
        return Parts((LinearPart(LinearScale(), self.coefficients, per_velocity=True),))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        product = multiply(self.at(t, q, args), v, COEFFICIENTS, "v")
        return tree.scale(-1, product)

    def at(self, t: Time, q: PyTree, args: PyTree) -> Form:
        """The coefficients at a time and a place."""
        if self._function is None:
            return self.coefficients
        return arrays(self._function(t, q, args), _FUNCTION)


class PositionDamping(AbstractFriction):
    """Friction `-Γ(t, q) p` at a rate that depends on place: absorbing layers, media,
    contact with a fluid.

    For `MechanicalSystem`. The friction is part of the kicks, which are exact at fixed
    positions: `p` to `exp(-h Γ) p` plus the momentum gained. `Strang`, `BlanesMoan4`
    and `BlanesMoan6` keep their order, and contract phase volume by the friction at the
    kicks. Runge--Kutta--Nyström splittings such as `TunedRKN6` would not, and refuse
    it.

    The function is evaluated once per kick. A matrix is exponentiated in every kick.
    For friction per velocity write `ViscousDamping` with a function. Where the rate
    does not depend on place `ConstantDamping` is more efficient.
    """

    rate: Callable
    per_velocity: ClassVar[bool] = False

    def __init__(self, rate: Callable):
        """**Arguments:**

        - `rate`: the rate `Γ`, in units of one over time, a function `rate(t, q, args)`
            that returns a number; an array with as many dimensions as `p` that
            broadcasts to it, a rate for each degree of freedom; a square matrix, with
            `p` a vector; or a pytree of the structure of `p` of these.

        **Raises:**

        `ValueError` if it is not a function, and when the solve is traced if it returns
        values of the wrong shape.
        """
        instead = (
            " For a rate that does not depend on place write `ConstantDamping(rate)`."
        )
        name = "PositionDamping(rate)"
        check_callable(rate, name, "rate(t, q, args)", instead=instead)
        self.rate = rate

    def parts(self, mechanics: Mechanics) -> Parts:
        return Parts(local=(self,))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        return tree.scale(-1, multiply(self.at(t, q, args), p, DAMPING, "p"))

    def at(self, t: Time, q: PyTree, args: PyTree) -> PyTree:
        """The rates at a time and a place."""
        return arrays(self.rate(t, q, args), _FUNCTION)
