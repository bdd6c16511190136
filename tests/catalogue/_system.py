"""What the catalogue says of a system, and functions that build some."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


START = 0.25  # of all solves, but for those from a singularity
LENGTH = 1.5  # of all solves. Steps are exact in binary.
JUMP = START + LENGTH / 2  # where a force or a rate has one

SPLIT = frozenset({"separable", "any"})
ALL = SPLIT | {"nystrom"}
RATE = ALL | {"shared"}
LINEAR = RATE | {"linear"}
ANY = frozenset({"any"})
NYSTROM = ANY | {"nystrom"}
MASS = np.array([[2.0, 0.3], [0.3, 1.0]])
PLANE = np.array([[1.0, 0.2], [-0.5, 0.3]]), np.array([[0.1, 0.5], [0.2, -0.4]])
TWO = np.array([1.0, -0.4]), np.array([0.3, 0.5])


@dataclasses.dataclass(frozen=True, eq=False)
class System:
    """A system, `build(laws)`, and its force without friction in bare NumPy, flat in
    the order of `ravel_pytree`."""

    name: str
    build: Callable[..., Any]
    force: Callable  # of t, q, p
    y0: tuple = TWO  # near it on a manifold
    mass: Any = 1.0  # a number or a matrix, or `None` if the package knows none
    velocity: Callable | None = None  # of t, q, p, eta(t), where it is not by the mass
    offers: frozenset[str] = RATE  # the splits that it offers without friction
    # The friction that it takes: "all", "velocities", "rates", "joints", "tangential",
    # "one rate" or "none".
    takes: str = "all"
    bodies: bool = False  # whether the last axis are the coordinates of bodies
    start: float = START
    constrained: bool = False  # whether its states are on a manifold
    slow: bool = False  # whether schemes of many stages take minutes to compile
    jumps: bool = False  # whether its force or velocity does, at `JUMP`
    # Where there are multipliers: the force with theirs, of t, q, p and that without.
    react: Callable | None = None

    def __repr__(self):
        return self.name

    @property
    def size(self) -> int:
        """The number of momenta, of which quaternions have more positions."""
        return ravel_pytree(self.y0[1])[0].size

    def by_mass(self, p):
        assert self.mass is not None
        return (
            p / self.mass if np.ndim(self.mass) == 0 else np.linalg.solve(self.mass, p)
        )

    def moves(self, t, q, p, eta):
        """The rates of the positions."""
        fn = self.velocity
        return self.by_mass(p) if fn is None else fn(t, q, p, eta)


def mechanical(kinetic, potential):
    def build(laws, force=None):
        return dps.MechanicalSystem(kinetic, potential, friction=laws, force=force)

    return build


def unit_mass(potential):
    return mechanical(dps.QuadraticKinetic(), potential)


def energy(fn, **options):
    def build(laws, force=None):
        return dps.Hamiltonian(fn, friction=laws, force=force, **options)

    return build


def manifold(of, potential):
    def build(laws, force=None):
        return dps.ManifoldSystem(of, potential, laws, force=force)

    return build


def constrained(free, constraint):
    def build(laws, force=None):
        return dps.ConstrainedSystem(free(laws, force), constraint)

    return build


def one_law(make):
    """A class that takes one scalar law, or none, as `damping`."""

    def build(laws, force=None):
        if force is not None:
            raise ValueError("write `MechanicalSystem`")
        return make(list(laws) or None)

    return build
