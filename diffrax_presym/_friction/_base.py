"""What every law of friction declares: the parts it adds to the motion."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import lineax as lx
from jaxtyping import Array, Inexact, PyTree

from .._numbers import Time
from ._log_scale import AbstractLogScale


# A number, an array, a matrix, a pytree of these, or an operator; `None` is one.
Form = PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None


# The names of forms, for errors.
MASS = "`QuadraticKinetic(mass)`"
COEFFICIENTS = "`ViscousDamping(coefficients)`"
DAMPING = "The damping"


class Mechanics(NamedTuple):
    """What friction needs to know of a system.

    **Attributes:**

    - `mass`: as in `QuadraticKinetic`; `None` is one.
    - `has_mass`: whether the mass is known.
    - `mass_varies`: whether it depends on positions or momenta, as the mass of joints
        or of relativistic particles: no drift is exact.
    - `inverse`: that of the mass, if that has a matrix and the inverse is known.
    """

    mass: Any = None
    has_mass: bool = True
    mass_varies: bool = False
    inverse: Any = None


class LinearPart(NamedTuple):
    """Friction at a rate that depends on time alone, part of every drift."""

    log_scale: AbstractLogScale
    form: Form
    per_velocity: bool = False  # a coefficient, rather than a rate
    may_couple: bool = False  # whether a rate may be a matrix


class Parts(NamedTuple):
    """What a law of friction, or several, add to the motion of a system: tuples of
    laws, by where they act.

    **Attributes:**

    - `linear`: rates that depend on time alone, part of every drift.
    - `local`: linear in the momentum, by place, part of every kick: each with `at(t, q,
        args)`, which gives the rates at a place.
    - `drags`: by the speed of bodies, part of every kick: each with `at(t, q, args)`,
        the law at a place, and `decay(h, p, mass)`, the change of `p` by it alone over
        a time `h`.
    - `forces`: any other law, part of the force.
    """

    linear: tuple[LinearPart, ...] = ()
    local: tuple[Any, ...] = ()
    drags: tuple[Any, ...] = ()
    forces: tuple[Any, ...] = ()

    def __add__(self, other: "Parts") -> "Parts":  # pyright: ignore
        both = zip(self, other, strict=True)
        return Parts(*(x + y for x, y in both))  # pyright: ignore


class AbstractFriction(eqx.Module):
    """A law of friction, for the argument `friction=` of a system.

    Where it acts in a step depends on what it is: linear friction that depends on time
    alone is part of the drifts, and exact; friction by place or by speed is part of the
    kicks.
    """

    @abc.abstractmethod
    def parts(self, mechanics: Mechanics) -> Parts:
        """The parts of the motion that it adds; `ValueError` if it needs to know more
        of the system."""

    @abc.abstractmethod
    def force(self, t: Time, q: PyTree, p: PyTree, v: PyTree, args: PyTree) -> PyTree:
        """The force of the friction on momenta `p` and velocities `v`."""


AbstractFriction.__init__.__doc__ = "**Arguments:** its fields, if any."
