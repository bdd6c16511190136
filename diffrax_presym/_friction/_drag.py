"""Friction that depends on the speed."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact, PyTree

from .._checks import check_callable
from .._forms import fit_form, is_operator
from .._numbers import cast_to, Time
from ._base import AbstractFriction, MASS, Mechanics, Parts
from ._damping import as_numbers, Numbers
from ._viscous import arrays, needs_mass


_COEFFICIENT = "`Drag(coefficient)`"
_FOR_BODIES = (
    "Drag acts on bodies, whose velocities are the last axis of `p`: for `n` bodies in "
    "three dimensions use states of shape `(n, 3)`, for `n` bodies on a line `(n, 1)`."
)


class Drag(AbstractFriction):
    """Drag `-c |v| v` of each body by the square of its speed `|v|`: of air and water.
    (Stokes drag, by the speed, is `ViscousDamping`.)

    For `MechanicalSystem`, with `QuadraticKinetic` and one mass for each body, and for
    `ManifoldSystem`, where that of an `Attitude` is a torque by its angular velocity.
    Bodies are the vectors over the last axis of `p`. Drag is part of the kicks: a
    symmetric composition, of the order of the scheme, of the force and of drag alone,
    which keeps the direction and has a closed form; on manifolds, of an implicit kick.
    The force is evaluated once per kick. `Strang`, `BlanesMoan4` and `BlanesMoan6` keep
    their order; Runge--Kutta--Nyström splittings would not, and refuse it. No structure
    is kept but the symmetry. Of a few bodies the same drag as
    `MechanicalSystem(..., force=f)` is faster. In a wind or a current, give the
    velocity `w` of the `medium`: the drag is then `-c |v - w| (v - w)`.

    Schemes of order above 2 have stages backwards in time, during which drag
    accelerates. A solve fails if the momentum that a body loses over such a stage
    exceeds what it has left; take shorter steps.
    """

    coefficient: Numbers | Callable
    medium: Numbers | Callable | None

    def __init__(self, coefficient, medium=None):
        """**Arguments:**

        - `coefficient`: `c`, in units of force per velocity squared: a number; an array
            with as many dimensions as `p` and a last axis of length 1, one for each
            body; a pytree of the structure of `p` of these; or a function `c(t, q,
            args)` that returns one of these. Of any sign; negative accelerates.
        - `medium`: the velocity `w` of the medium: an array that broadcasts to `p`, a
            pytree of the structure of `p` of these, or a function `w(t, q, args)` that
            returns one of these. Defaults to `None`, at rest.

        **Raises:**

        `ValueError` if a coefficient is not a finite real number; and when the solve is
        traced, if a shape does not fit bodies over the last axis of `p`, or the masses
        are not constant.
        """
        self.coefficient = _as_given(coefficient, _COEFFICIENT, "c(t, q, args)")
        if medium is not None:
            medium = _as_given(medium, "`Drag(..., medium=...)`", "w(t, q, args)")
        self.medium = medium

    def parts(self, mechanics: Mechanics) -> Parts:
        needs_mass(mechanics, "Drag")
        if mechanics.mass_varies:
            raise ValueError(
                "`Drag` acts on bodies of constant mass, `QuadraticKinetic(mass)`. "
                "Write its force on joints or relativistic particles as `force=f`, "
                "with a function `f(t, q, v, args)`."
            )
        return Parts(drags=(self,))

    def at(self, t: Time, q: PyTree, args: PyTree) -> "Drag":
        """The drag with the coefficient and the medium at a place."""

        def value(x):
            return arrays(x(t, q, args), "A function of `Drag`") if callable(x) else x

        numbers = value(self.coefficient), value(self.medium)
        where = lambda x: (x.coefficient, x.medium)
        return eqx.tree_at(where, self, numbers, is_leaf=lambda x: x is None)

    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        drag = self.at(t, q, args)

        def leaf(v: Array, c: Array, w: Array) -> Array:
            v = v - w
            return -c * _speed(v) * v

        coefficients = _per_body(drag.coefficient, v, _COEFFICIENT)
        return jtu.tree_map(leaf, v, coefficients, _of_medium(drag.medium, v))

    def decay(self, h: Time, p: PyTree, mass: PyTree) -> PyTree:
        """The change of `p` over a time `h` of drag alone, at a place."""

        def leaf(p: Array, mass: Array, c: Array, w: Array) -> Array:
            # The speed decays like 1 / (1 + x), with x the time in units of that in
            # which it would be lost at its initial rate.
            v = p / mass - w
            x = c / mass * _speed(v) * cast_to(h, p)
            return jnp.where(x > -1, -x / (1 + x), jnp.nan) * (mass * v)

        coefficients = _per_body(self.coefficient, p, _COEFFICIENT)
        medium = _of_medium(self.medium, p)
        return jtu.tree_map(leaf, p, _per_body(mass, p, MASS), coefficients, medium)


def _as_given(x, name: str, signature: str) -> Numbers | Callable:
    if not callable(x):
        return as_numbers(x, name)
    check_callable(x, name[1:-1], signature)
    return x


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


def _speed(v: Inexact[Array, "*bodies d"]) -> Inexact[Array, "*bodies 1"]:
    """The speed of each body, with a derivative of zero at rest."""
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    moving = square > 0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1)), 0)
