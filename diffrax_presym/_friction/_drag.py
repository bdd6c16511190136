"""Friction that depends on the speed."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Inexact, PyTree

from .._forms import fit_form, is_operator
from .._misc import as_parameter, cast_to, Scalar, Time
from ._base import AbstractFriction, Mechanics, Parts
from ._damping import as_numbers, Numbers
from ._exponential import expm1, expm1_ratio, log1p_ratio
from ._rates import MASS
from ._viscous import needs_mass


_COEFFICIENT = "`Drag(coefficient)`"
_FOR_BODIES = (
    "Drag acts on bodies, whose velocities are the last axis of `p`: for `n` bodies in "
    "three dimensions use states of shape `(n, 3)`, for `n` bodies on a line `(n, 1)`."
)


class Drag(AbstractFriction):
    r"""Drag $-c \, |v|^{k-1} \, v$ of each body, where $|v|$ is its speed: air drag
    ($k = 2$), Stokes drag ($k = 1$), or any power from 1 on.

    For [`diffrax_presym.MechanicalSystem`][], with
    [`diffrax_presym.QuadraticKinetic`][] and one mass for each body. Bodies are the
    vectors over the last axis of `p`. Without a force a body keeps its direction, and
    its speed and distance have a closed form, which is part of the drift.
    [`diffrax_presym.Strang`][], [`diffrax_presym.BlanesMoan4`][] and
    [`diffrax_presym.BlanesMoan6`][] keep their order;
    Runge--Kutta--Nyström splittings would not, and refuse it. No structure is kept but
    the symmetry. In a wind or a current, give the velocity $w$ of the `medium`: the
    drag is then $-c \, |v - w|^{k-1} \, (v - w)$.

    If the coefficient or the medium is a function, the drag is part of the kicks.
    There, and where other friction is added, its flow is a symmetric composition, of
    the order of the scheme, of flows that are known, without further evaluations of the
    force.

    Schemes of order above 2 have stages backwards in time, during which drag
    accelerates. A solve fails if the momentum that a body loses over such a stage
    exceeds what it has left; take shorter steps.
    """

    coefficient: Numbers | Callable
    exponent: Scalar
    medium: Numbers | Callable | None

    def __init__(self, coefficient, exponent: ArrayLike = 2.0, medium=None):
        r"""**Arguments:**

        - `coefficient`: $c$, in units of force per velocity to the power $k$: a number;
            an array with as many dimensions as `p` and a last axis of length 1, one for
            each body; a pytree of the structure of `p` of these; or a function
            `c(t, q, args)` that returns one of these. Of any sign; negative
            accelerates.
        - `exponent`: the power $k$ of the speed, a number of at least 1. Defaults to 2.
        - `medium`: the velocity $w$ of the medium: an array that broadcasts to `p`, a
            pytree of the structure of `p` of these, or a function `w(t, q, args)` that
            returns one of these. Defaults to `None`, at rest.

        **Raises:**

        `ValueError` if the exponent is known to be less than 1, or a coefficient is not
        a finite real number; and when the solve is traced, if a shape does not fit
        bodies over the last axis of `p`, or the masses are not known.
        """
        if not callable(coefficient):
            coefficient = as_numbers(coefficient, _COEFFICIENT)
        exponent = as_parameter(exponent, "`Drag(..., exponent)`")
        valid = isinstance(exponent, Tracer) or bool(np.all(np.asarray(exponent) >= 1))
        if not valid or (jnp.ndim(exponent) and not isinstance(exponent, Tracer)):
            raise ValueError(
                "`Drag(..., exponent)` must be a number of at least 1, the power of "
                f"the speed in the force, but got {exponent}. A smaller power "
                "stops a body in finite time; write it as "
                "`MechanicalSystem(..., force=f)` and make it smooth at rest."
            )
        if not callable(medium) and medium is not None:
            medium = as_numbers(medium, "`Drag(..., medium=...)`")
        self.coefficient = coefficient
        self.exponent = exponent
        self.medium = medium

    @property
    def is_local(self) -> bool:
        """Whether the coefficient or the medium depends on place."""
        return callable(self.coefficient) or callable(self.medium)

    def parts(self, mechanics: Mechanics) -> Parts:
        if mechanics.mass_varies:
            raise ValueError(
                "`Drag` acts on bodies, not on joints. Write the force that it exerts "
                "on the joints as `force=f`, with a function `f(t, q, v, args)`."
            )
        needs_mass(mechanics, "Drag")
        return Parts(local_drags=(self,)) if self.is_local else Parts(drags=(self,))

    def at(self, t: Time, q: PyTree, args: PyTree) -> "Drag":
        """The drag with the coefficient and the medium at a place."""

        def value(x):
            return jtu.tree_map(jnp.asarray, x(t, q, args)) if callable(x) else x

        numbers = value(self.coefficient), value(self.medium)
        where = lambda x: (x.coefficient, x.medium)
        return eqx.tree_at(where, self, numbers, is_leaf=lambda x: x is None)

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        drag = self.at(t, q, args)

        def leaf(v: Array, c: Array, w: Array) -> Array:
            v = v - w
            return -c * _power_of_speed(v, cast_to(self.exponent, v) - 1) * v

        coefficients = _per_body(drag.coefficient, v, _COEFFICIENT)
        return jtu.tree_map(leaf, v, coefficients, _of_medium(drag.medium, v))

    def flow(self, h: Time, p: PyTree, mass: PyTree) -> tuple[PyTree, PyTree]:
        """The displacements, and the changes of `p`, over a time `h` of motion by drag
        alone."""
        columns = (
            *(p, _per_body(mass, p, MASS)),
            _per_body(self.coefficient, p, _COEFFICIENT),
            _of_medium(self.medium, p),
        )
        leaves = zip(*map(jtu.tree_leaves, columns), strict=True)
        dq, dp = zip(*(self._flow(h, *x) for x in leaves), strict=True)
        structure = jtu.tree_structure(p)
        return structure.unflatten(dq), structure.unflatten(dp)

    def _flow(
        self, h: Time, p: Array, mass: Array, c: Array, w: Array
    ) -> tuple[Array, Array]:
        # The speed decays like (1 + (k - 1) x)^(-1 / (k - 1)), with x the time in units
        # of that in which it would be lost at its initial rate.
        k, h, v = cast_to(self.exponent, p), cast_to(h, p), p / mass - w
        x = c / mass * _power_of_speed(v, k - 1) * h
        ratio = log1p_ratio((k - 1) * x)
        lost = x * ratio  # logarithm of the ratio of the speeds
        distance = ratio * expm1_ratio((k - 2) * lost)
        return h * (distance * v + w), expm1(-lost) * (mass * v)


def _of_medium(medium, p: PyTree) -> PyTree:
    if medium is None:
        return jtu.tree_map(lambda x: jnp.zeros((), x.dtype), p)
    if jtu.treedef_is_leaf(jtu.tree_structure(medium)):
        medium = jtu.tree_map(lambda _: medium, p)

    def leaf(x: Array, w: Array) -> Array:
        # With fewer dimensions, one velocity for all bodies.
        shape = (1,) * (x.ndim - w.ndim) + w.shape
        fits = zip(shape, x.shape, strict=False)
        if len(shape) > x.ndim or any(a not in (1, b) for a, b in fits):
            raise ValueError(
                f"`Drag(..., medium=...)` of shape {w.shape} does not fit `p` of shape "
                f"{x.shape}. Pass the velocity of the medium, which broadcasts to `p`."
            )
        return cast_to(w, x).reshape(shape)

    return jtu.tree_map(leaf, p, medium)


def _per_body(form, p: PyTree, name: str) -> PyTree:
    if is_operator(form):
        raise ValueError(f"{name} is an operator, but drag needs a mass for each body.")

    def check(x, form):
        shape = jnp.shape(x)
        wanted = (*shape[:-1], 1)
        if not shape:
            raise ValueError(f"{_FOR_BODIES} This `p` is a scalar; use shape `(1,)`.")
        if jnp.ndim(form) > len(shape) or (jnp.ndim(form) and form.shape[-1] != 1):
            raise ValueError(
                f"{name} of shape {form.shape} differs within a body, for `p` of shape "
                f"{shape}. {_FOR_BODIES} Pass a number, or an array that broadcasts to "
                f"{wanted}, one for each body; or write the drag as "
                "`MechanicalSystem(..., force=f)`."
            )
        return form

    return jtu.tree_map(check, p, fit_form(form, p, name, "p"))


@jax.custom_jvp
def _power_of_speed(v: Inexact[Array, "*bodies d"], power: Array) -> Array:
    """The speed of each body, to a power of at least 0, of shape `(*bodies, 1)`."""
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    moving = square > 0
    at_rest = jnp.where(power == 0, 1, 0).astype(square.dtype)
    return jnp.where(moving, jnp.where(moving, square, 1) ** (power / 2), at_rest)


@_power_of_speed.defjvp
def _power_of_speed_jvp(x, dx):
    (v, power), (dv, dpower) = x, dx
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    moving = square > 0
    square = jnp.where(moving, square, 1)
    value = _power_of_speed(v, power)
    along = power * jnp.sum(v * dv, axis=-1, keepdims=True) / square
    # At rest the derivative may be infinite, but its product with the velocity is zero.
    slope = jnp.where(moving, value * (along + dpower * jnp.log(square) / 2), 0)
    return value, slope
