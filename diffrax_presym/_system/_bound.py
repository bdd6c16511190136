"""The interface between solvers and systems."""

from collections.abc import Callable
from typing import Any, TypeVar

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, PyTree

from .. import _tree as tree
from .._friction._base import Parts
from .._friction._linear import LinearFriction
from .._numbers import as_time, cast_to, State, Time
from .._results import ENERGY_NOT_DEFINED, NONFINITE
from ._base import AbstractSystem
from ._split import AbstractSplit


_T = TypeVar("_T")


class System(eqx.Module):
    """A system as solvers use it: bound to its arguments and to a direction of time,
    with the friction of momenta of one shape.

    The leaves of a state `(q, p)` are arrays or, with compensated summation, `Sum`s. So
    states are updated with `add` and read with `values`; the other methods take states
    of either kind.
    """

    term: Any  # an `AbstractSystem`
    args: PyTree
    direction: int | Array
    parts: Parts  # of its friction
    splits: tuple[AbstractSplit, ...]
    friction: LinearFriction | None  # linear, that depends on time alone

    def __init__(self, term: AbstractSystem, args: PyTree, direction, y: State):
        self.term, self.args, self.direction = term, args, direction
        self.parts, self.splits = term.parts, term.splits
        self.friction = term.fit_friction(tree.values(y)[1])

    def factorised(self, y: State) -> "System":
        """The same, with what would else be computed in every step."""
        term = self.term.factorised(tree.values(y)[1])
        return eqx.tree_at(lambda x: x.term, self, term)

    def time(self, t: ArrayLike) -> Array:
        """The physical time, which runs backwards where `direction` is -1."""
        t = as_time(t)
        return t * cast_to(self.direction, t)

    # States.

    def add(self, y: State, dy: tuple[PyTree, PyTree]) -> State:
        """The state displaced by `dy`, of which either part may be `None`."""
        return self.term.add(y, dy)

    def values(self, x: _T) -> _T:
        """The arrays of a state, or part of one."""
        return tree.values(x)

    # The vector field.

    @property
    def name(self) -> str:
        """The class of the system, for errors."""
        return type(self.term).__name__

    def velocity(self, t: Time, y: State) -> PyTree:
        """The velocity, which is the derivative of `q`."""
        return self.term.velocity(t, *tree.values(y), self.args)

    def force(self, t: Time, y: State) -> PyTree:
        """The force on `p`, without linear friction."""
        return self.term.force(t, *tree.values(y), self.args)

    def force_at(self, t: Time, y: State, v: PyTree) -> PyTree:
        """The same, at a known velocity."""
        return self.term.force_at(t, *tree.values(y), v, self.args)

    def velocity_and_force(self, t: Time, y: State) -> State:
        """The vector field without linear friction."""
        return self.term.velocity_and_force(t, *tree.values(y), self.args)

    def slope(self, t: Time, y: State, force: PyTree | None = None) -> State:
        """The full vector field, with friction. Reuses a given force."""
        y = tree.values(y)
        if force is None:
            velocity, force = self.velocity_and_force(t, y)
        else:
            velocity = self.velocity(t, y)
        if self.friction is not None:
            force = self.friction.net_force(t, force, y[1])
        return velocity, force

    def check(self, t: Time, y: State) -> dfx.RESULTS | None:
        """A failure where the energy is not defined; `None` if that is not checked."""
        y = tree.values(y)
        valid = self.term.is_valid(t, *y, self.args)
        if valid is None:
            return None
        where, finite = dfx.RESULTS.where, tree.all_finite(y)
        failure = where(finite, ENERGY_NOT_DEFINED, NONFINITE)
        return where(valid, dfx.RESULTS.successful, failure)

    # Friction.

    @property
    def external(self) -> Callable | None:
        """A user's force of the velocity."""
        return getattr(self.term, "external", None)

    @property
    def has_unknown_friction(self) -> bool:
        """Whether there is friction, or a force of the velocity, that depends on the
        state."""
        return any(self.parts[1:]) or self.external is not None

    def prepare_decay(self, t: Time, h: Time) -> PyTree:
        """What the decay of a momentum from `t` to `t + h` needs of time alone."""
        return None if self.friction is None else self.friction.prepare(t, h, 1)

    def decay(self, data: PyTree, y: State) -> State:
        """The momentum in the frame of the end of a span: friction alone."""
        if self.friction is None:
            return y
        return self.add(y, (None, self.friction.decay(data, tree.values(y[1]))))

    def move_frame(self, data: PyTree, p: PyTree) -> PyTree:
        """The same for momenta alone, or forces, as arrays."""
        if self.friction is None:
            return p
        return jtu.tree_map(jnp.add, p, self.friction.decay(data, p))

    # Splits.

    def split(self, kind: str) -> Any:
        """The first split of a kind, see `_split.py`; `None` if there is none."""
        return next((split for split in self.splits if kind in split.kinds), None)

    @property
    def prepares_once(self) -> bool:
        """Whether what is prepared for a drift depends on its length alone."""
        return self.term.drift_is_autonomous and (
            self.friction is None or self.friction.is_autonomous
        )


System.__init__.__doc__ = "**Arguments:** its fields, if any."


def bind(terms: PyTree, args: PyTree, y: State) -> System:
    """The system of the term that `diffeqsolve` passes to a solver."""
    term, direction = unwrap(terms)
    return System(term, args, direction, y)


def unwrap(terms: PyTree) -> tuple[AbstractSystem, Any]:
    """The system, and the direction of time; `ValueError` if it is another term."""
    term, direction = terms, 1
    # Diffrax wraps a term to solve backwards in time. The wrapper is private, so it is
    # recognised by its two attributes.
    if hasattr(term, "term") and hasattr(term, "direction"):
        term, direction = term.term, term.direction
    if isinstance(term, AbstractSystem):
        return term, direction
    if type(term).__name__ == "AdjointTerm":
        raise ValueError(
            "`BacksolveAdjoint()` solves the adjoint equations, which are not "
            "Hamiltonian, with the same solver. Write "
            "`BacksolveAdjoint(solver=diffrax.Tsit5())`, or use the default "
            "`RecursiveCheckpointAdjoint()`."
        )
    raise ValueError(
        "Presymplectic solvers need a system such as `MechanicalSystem(kinetic, "
        f"potential)`, but got `{type(term).__name__}`. For a force without a "
        "potential write `MechanicalSystem(kinetic, ForceField(force))`."
    )
