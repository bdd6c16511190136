"""The interface between solvers and terms."""

from typing import Any, TypeVar

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, PyTree

from ._friction import AbstractFriction
from ._friction._base import Time
from ._hamiltonian import AbstractHamiltonian
from ._misc import cast_to, describe, tree_add, tree_sub, values
from ._split import AbstractSplit, State


_T = TypeVar("_T")
# Also the result where the energy is not defined.
NONFINITE: Any = dfx.RESULTS.nonfinite  # pyright: ignore[reportAttributeAccessIssue]


class System(eqx.Module):
    """A term as solvers use it, in physical time.

    The leaves of a state `(q, p)` are arrays or, with compensated summation, `Sum`s. So
    states are updated with `add` and read with `values`; the other methods take states
    of either kind.
    """

    hamiltonian: AbstractHamiltonian
    args: PyTree
    direction: int | Array

    def time(self, t: ArrayLike) -> Array:
        """The physical time, which runs backwards where `direction` is -1."""
        return jnp.asarray(t) * cast_to(self.direction, t)

    # States.

    def add(self, x: PyTree, h: ArrayLike, dx: PyTree) -> PyTree:
        """`x + h * dx`, for a state or part of one."""
        return tree_add(x, h, dx)

    def subtract(self, x: PyTree, y: PyTree) -> PyTree:
        """The difference of two states, or parts of these, as arrays."""
        return tree_sub(x, y)

    def values(self, x: _T) -> _T:
        """The arrays of a state, or part of one."""
        return values(x)

    def zeros(self, x: PyTree) -> PyTree:
        """Arrays of zeros like a state, or part of one."""
        return jtu.tree_map(jnp.zeros_like, values(x))

    # The vector field.

    @property
    def name(self) -> str:
        """The class of the Hamiltonian, for errors."""
        return type(self.hamiltonian).__name__

    @property
    def friction(self) -> AbstractFriction | None:
        return self.hamiltonian.friction

    @property
    def table(self) -> PyTree:
        """What `with_table` was given, or `None`."""
        return self.hamiltonian.friction_table

    def with_table(self, table: PyTree) -> "System":
        """The same system, whose friction uses the result of its `tabulate`."""
        return System(self.hamiltonian.with_table(table), self.args, self.direction)

    def velocity(self, t: Time, y: State) -> PyTree:
        """The velocity, which is the derivative of `q`."""
        return self.hamiltonian.velocity(t, *values(y), self.args)

    def force(self, t: Time, y: State) -> PyTree:
        """The force on `p`, without friction."""
        y = values(y)
        return _stored(self.hamiltonian.force(t, *y, self.args), t, y)

    def velocity_and_force(self, t: Time, y: State) -> State:
        """The vector field without friction."""
        q, p = y = values(y)
        velocity, force = self.hamiltonian.velocity_and_force(t, q, p, self.args)
        return velocity, _stored(force, t, y)

    def slope(self, t: Time, y: State, force: PyTree | None = None) -> State:
        """The full vector field, with friction. Reuses a given force."""
        y = values(y)
        if force is None:
            velocity, force = self.velocity_and_force(t, y)
        else:
            velocity = self.velocity(t, y)
        if self.friction is not None:
            force = self.friction.net_force(t, force, y[1])
        return velocity, force

    def check(self, t: Time, y: State) -> dfx.RESULTS | None:
        """A failure where the energy is not defined; `None` if that is not checked."""
        valid = self.hamiltonian.is_valid(t, *values(y), self.args)
        if valid is None:
            return None
        return dfx.RESULTS.where(valid, dfx.RESULTS.successful, NONFINITE)

    # Moves.

    def move_frame(self, t: Time, h: Time, p: PyTree) -> PyTree:
        """`p` from the frame of `t` to the frame of `t + h`: friction alone."""
        if self.friction is None:
            return p
        return tree_add(p, 1, self.friction.decay(t, h, values(p)))

    def drift(self, t: Time, h: Time, y: State, order: int) -> State:
        """The flow of the kinetic part, where it is known, friction included."""
        q, p = y
        dq, dp = self.hamiltonian.kinetic_flow(t, h, *values(y), self.args, order)
        p = self.move_frame(t, h, p)
        return tree_add(q, 1, dq), p if dp is None else tree_add(p, 1, dp)

    def potential_force(self, t: Time, y: State) -> PyTree:
        """The force of a kick, without that of the kinetic part."""
        y = values(y)
        return _stored(self.hamiltonian.potential_force(t, *y, self.args), t, y)

    def split(self, kind: str) -> AbstractSplit | None:
        """The first split of a kind, see `_split.py`; `None` if there is none."""
        splits = (split for split in self.hamiltonian.splits if kind in split.kinds)
        return next(splits, None)

    @property
    def is_separable(self) -> bool:
        """Whether the velocity depends on `p` alone, and the force on `q`."""
        return self.split("separable") is not None


def _stored(force: PyTree, t: Time, y: State) -> PyTree:
    # A selection, which always gives the force, makes XLA store it. Otherwise XLA
    # recomputes an elementwise force wherever it is used.
    return jtu.tree_map(lambda f, q: jnp.where(t == t, f, q), force, y[0])


def check_state(y: PyTree) -> None:
    wanted = "The state must be a pair `(q, p)` of positions and momenta"
    if type(y) is not tuple or len(y) != 2:
        raise ValueError(f"{wanted}, but got {describe(y)}. Write `y0=(q0, p0)`.")
    q, p = y
    if describe(q) != describe(p):
        raise ValueError(
            f"{wanted} of one structure, shape and precision, but got q of "
            f"{describe(q)} and p of {describe(p)}."
        )
    for leaf in jtu.tree_leaves(y):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"{wanted} in real floating point, but got {describe(q)}. Convert "
                "them with `jnp.asarray(x, float)`, a complex number to its real and "
                "imaginary parts."
            )
