from collections.abc import Callable

import jax
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import check_callable, scalar_fn
from .._friction._base import AbstractFriction
from .._friction._damping import as_laws
from .._numbers import Scalar, Time
from ._base import AbstractSystem, P, Q
from ._split import AbstractSplit


class Hamiltonian(AbstractSystem):
    """Any energy `E(t, q, p)`, with friction and any other force.

    For energies that are not a sum `T(t, p) + V(t, q)`, which `MechanicalSystem` takes:
    use `PresymplecticGauss`. If part of its motion has a known flow, such as along
    Kepler's orbits, pass that as a split: splittings are then explicit.

    !!! warning

        Damping acts on the momentum `p` of the energy, which is not always the mass
        times the velocity. With a vector potential, `E = |p - A(q)|^2 / 2`, or in
        general coordinates, it is not friction of the velocity, and the result depends
        on the choice of `A`. For a charge in a magnetic field with friction use
        `ViscousDamping`, for a mass matrix that depends on the positions
        `LagrangianSystem`.
    """

    fn: Callable
    friction: tuple[AbstractFriction, ...] | None  # Equinox fails on `()` in a term
    external: Callable | None
    known: tuple[AbstractSplit, ...] | None

    def __init__(self, energy, friction=None, *, force=None, splits=()):
        """**Arguments:**

        - `energy`: the energy, a function `E(t, q, p, args)` that returns a scalar.
        - `friction`: a law of friction by rates or by place, such as `ConstantDamping`,
            or a list of laws. The mass is not known, so that friction per velocity has
            to be written as `force`. Defaults to none.
        - `force`: any further force, a function `f(t, q, v, args)` of the velocity `v`,
            as for `MechanicalSystem`. Defaults to none.
        - `splits`: pairs of exact flows into which the motion splits, a tuple of
            `extend.AbstractSplit`, the best first. Linear friction is part of their
            drifts; they are not used with any other friction or force. Defaults to
            none.

        **Raises:**

        `ValueError` if any of these is of the wrong kind, and when the solve is traced
        if a function returns values of the wrong shape.
        """
        check_callable(energy, "energy", "E(t, q, p, args)")
        check_callable(force, "force", "f(t, q, v, args)", optional=True)
        self.fn = energy
        self.friction = as_laws(friction) or None
        self.external = force
        sequence = isinstance(splits, tuple | list)
        if not sequence or not all(isinstance(x, AbstractSplit) for x in splits):
            raise ValueError(
                "`Hamiltonian(splits=...)` must be a tuple of `extend.AbstractSplit`, "
                f"but got {splits!r}."
            )
        self.known = tuple(splits) or None
        _ = self.parts  # An error if a law does not fit the system.

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return self.friction or ()

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        _, *other = self.parts
        if any(other) or self.external is not None:
            return ()
        return self.known or ()

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        return scalar_fn(self.fn, "The energy")(t, q, p, args)

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return jax.grad(self.energy, argnums=2)(t, q, p, args)

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return self.velocity_and_force(t, q, p, args)[1]

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        slope, velocity = jax.grad(self.energy, argnums=(1, 2))(t, q, p, args)
        force, state = tree.scale(-1, slope), (t, q, p, velocity, args)
        return velocity, self.add_forces(force, self.external, *state)
