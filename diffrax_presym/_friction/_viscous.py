"""Friction by coefficients, the force per velocity."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, PyTree

from .._forms import as_form, is_operator, multiply
from .._misc import as_finite, cast_to, Scalar, Time, tree_scale, tree_sum
from ._base import AbstractFriction, Form, Linear, Local, Mechanics, Parts
from ._damping import AbstractDamping, as_friction
from ._log_scale import Linear as LinearScale
from ._rates import COEFFICIENTS


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
    about ten products, more under strong friction. For sparse matrices above some
    hundreds of degrees of freedom pass a `lineax.FunctionLinearOperator`: no matrix is
    stored (but by [`diffrax_presym.PresymplecticGauss`][], whose iteration applies it
    often).

    If $C$ is a function of time and place, the friction is part of the kicks, and
    exact there at fixed positions: as [`diffrax_presym.PositionDamping`][].
    """

    coefficients: Form | Callable
    law: AbstractDamping | None

    def __init__(self, coefficients, law=None):
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
            - A `lineax.AbstractLinearOperator` acting on `p`'s space. One that is
                given by a matrix is exponentiated as a matrix, any other by products.
            - A function `C(t, q, args)` that returns any of the above but operators.
        - `law`: a damping law of one rate such as [`diffrax_presym.LogDamping`][], or a
            function `eta(t)`, whose rate multiplies constant coefficients. Defaults to
            `None`, a rate of one.

        **Raises:**

        `ValueError` if a coefficient is not a finite real number or array, or a law is
        given with a function; and when the solve is traced, if a shape does not fit
        `p` or the mass is not known.
        """
        if coefficients is None:
            raise ValueError(
                f"{COEFFICIENTS} must be {_FORMS}, but got None. For one force per "
                "velocity write `ViscousDamping(1.0)`."
            )
        local = callable(coefficients) and not is_operator(coefficients)
        if local and law is not None:
            raise ValueError(
                "`ViscousDamping(C, law)` with a function `C(t, q, args)` takes no "
                "`law`. Multiply the coefficients that the function returns by the "
                "rate."
            )
        if not local:
            coefficients = as_form(coefficients, COEFFICIENTS, positive=False)
        self.coefficients = coefficients
        self.law = None if law is None else _as_damping(law)

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
        terms = ((LinearScale(), None),) if self.law is None else self.law.terms
        scaled = lambda factor: _scaled(factor, coefficients)
        return Parts(tuple(Linear(x, scaled(factor), True) for x, factor in terms))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        form: Any = self.coefficients
        form = form(t, q, args) if self.is_local else form
        force = tree_scale(-1, multiply(form, v, COEFFICIENTS, "v"))
        return force if self.law is None else tree_scale(self.law.rate(t), force)


def _as_damping(law) -> AbstractDamping:
    law = as_friction(law, "`ViscousDamping(law=...)`")
    if not isinstance(law, AbstractDamping):
        raise ValueError(
            "`ViscousDamping(C, law)` needs a law of one rate such as "
            f"`LogDamping(gamma)`, but got {law!r}. For several laws pass a list: "
            "`friction=[ViscousDamping(C), law]`."
        )
    for _, factor in law.terms:
        if jtu.tree_map(jnp.shape, factor) != ():
            raise ValueError(
                "The law in `ViscousDamping(C, law)` must have one rate for all "
                "momenta. Multiply the coefficients by the numbers."
            )
    return law


def _scaled(factor, form: Form) -> Form:
    if factor is None or form is None:
        return form if factor is None else factor
    if is_operator(form):
        return form * factor
    return jtu.tree_map(lambda x: x * cast_to(factor, x), form)


class RayleighDamping(AbstractFriction):
    r"""Rayleigh damping, $C = \alpha M + \beta K$.

    For [`diffrax_presym.MechanicalSystem`][], with a kinetic energy of known mass $M$.
    The stiffness $K$ is that of a [`diffrax_presym.QuadraticPotential`][], or given. A
    mode of frequency $\omega$ is damped with the ratio
    $\alpha / 2 \omega + \beta \omega / 2$. Exact in the drift, as
    [`diffrax_presym.ViscousDamping`][], at the same cost.

    ??? cite "Reference"

        ```bibtex
        @book{rayleigh1877theory,
            author={Strutt, John William (Lord Rayleigh)},
            title={The Theory of Sound},
            volume={1},
            publisher={Macmillan},
            year={1877},
        }
        ```
    """

    alpha: Scalar
    beta: Scalar
    stiffness: Form

    def __init__(self, alpha: ArrayLike, beta: ArrayLike = 0.0, stiffness=None):
        r"""**Arguments:**

        - `alpha`: the coefficient of the mass, in units of one over time.
        - `beta`: the coefficient of the stiffness, in units of time. Defaults to 0.
        - `stiffness`: the stiffness $K$ in the forms of
            [`diffrax_presym.QuadraticPotential`][], for a potential of another kind.
            Defaults to `None`, that of the potential.

        **Raises:**

        `ValueError` if `alpha` or `beta` is not a finite real number, or if the
        stiffness is neither given nor known, when the system is made.
        """
        name = "`RayleighDamping({})`"
        self.alpha = as_finite(alpha, name.format("alpha"))
        self.beta = as_finite(beta, name.format("..., beta"))
        self.stiffness = as_form(
            stiffness, name.format("..., stiffness"), positive=False
        )

    def parts(self, mechanics: Mechanics) -> Parts:
        if mechanics.mass_varies:
            return Parts(forces=(self,))
        needs_mass(mechanics, "RayleighDamping")
        of_mass = Linear(LinearScale(), self.alpha)
        if not isinstance(self.beta, Tracer) and not np.any(np.asarray(self.beta)):
            return Parts((of_mass,))
        stiffness = self.stiffness
        if stiffness is None:
            if mechanics.stiffness is None:
                raise ValueError(
                    "`RayleighDamping(alpha, beta)` needs a stiffness, which this "
                    "potential does not have. Write `RayleighDamping(alpha, beta, "
                    "stiffness)`, or the potential as `QuadraticPotential(stiffness)`."
                )
            stiffness = mechanics.stiffness
        of_springs = Linear(LinearScale(), _scaled(self.beta, stiffness), True)
        return Parts((of_mass, of_springs))

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        if self.stiffness is None:
            raise ValueError(
                "`RayleighDamping` needs its stiffness here. Write "
                "`RayleighDamping(alpha, beta, stiffness)`."
            )
        springs = multiply(self.stiffness, v, COEFFICIENTS, "v")
        return tree_sum(tree_scale(-self.alpha, p), tree_scale(-self.beta, springs))
