import abc
import bisect
from functools import partial
from typing import ClassVar, Generic, NamedTuple, TYPE_CHECKING, TypeVar

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._interpolation import HermiteInterpolation, inner_points
from .._misc import cast_to, tree_scale
from .._split import State
from .._system import check_state, System
from .._term import as_system
from ._engine import (
    first_failure,
    forward,
    Move,
    Moves,
    Outcome,
    Result,
    Span,
    Stage,
    time_lengths,
)
from ._estimate import no_error_estimate


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


_Carry = TypeVar("_Carry")

# Points within a step that dense output uses, from the order up to which they suffice.
_ORDERS, _INNER_POINTS = (2, 4, 10, 14), (0, 1, 3, 5, 7)


class Tabulated(NamedTuple):
    """A solver state, and what friction computes once for steps of one length."""

    carry: PyTree
    table: PyTree


def signed(lengths: np.ndarray, both: bool) -> np.ndarray:
    """Lengths forwards or in both directions of time, in order."""
    return np.unique(np.concatenate([-lengths, lengths]) if both else lengths)


class AbstractPresymplecticSolver(dfx.AbstractSolver[_Carry], Generic[_Carry]):
    """A one-step scheme for the term [`diffrax_presym.HamiltonianTerm`][].

    A scheme defines its initial solver state and its step; `diffrax.diffeqsolve`
    handles saving, events, adjoints and the direction of time. No scheme has an error
    estimate: [`diffrax_presym.choose_step`][] finds the step for a tolerance. For
    adaptive steps, wrap the scheme in `diffrax.HalfSolver`.
    """

    # Not `HamiltonianTerm`, so that other terms reach the error message of `as_system`.
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = HermiteInterpolation

    @property
    @abc.abstractmethod
    def is_symmetric(self) -> bool:
        """Whether the scheme is its own adjoint method."""

    @abc.abstractmethod
    def order(self, terms) -> int:
        """The order of the scheme."""

    @abc.abstractmethod
    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        """One step from `t0` to `t1`, in physical time.

        `h` is their difference, which may be more accurate than `t1 - t0`.
        """

    def start(self, system: System, t: Array, y: State) -> _Carry:
        """The initial solver state, empty by default."""
        return None  # pyright: ignore[reportReturnType]

    def slope(self, system: System, t: Array, y: State, carry: _Carry) -> State:
        """The full vector field at an end of a step, for dense output."""
        return system.slope(t, y)

    @property
    def reverse(self) -> "AbstractPresymplecticSolver[_Carry] | None":
        """The adjoint method, or `None` if there is none.

        Its step backwards undoes a step of this scheme.
        """
        return self if self.is_symmetric else None

    def undoable(self, start: _Carry, end: _Carry) -> Array | None:
        """Whether steps between two solver states can be undone; `None` if always."""
        return None

    def moves(self, system: System) -> Moves:
        """The moves of a step; by default the whole step is one move."""
        return step_of(self)

    def step_length(self, t0: Array, t1: Array) -> Array:
        """The length of a step of the solve."""
        return t1 - t0

    def composition_error(self) -> str | None:
        """An error message if the scheme does not allow compositions of unequal steps.

        These cancel errors only if the errors are even in the step size.
        """
        if self.is_symmetric:
            return None
        return (
            f"Compositions need a symmetric base, which `{type(self).__name__}` is "
            "not. Compose `PresymplecticLeapfrog()` instead."
        )

    def lengths(self, system: System) -> np.ndarray:
        """The lengths of the stages over which friction acts, in units of the step."""
        return time_lengths(self.moves(system))

    def init(self, terms, t0, t1, y0, args) -> _Carry:
        system = as_system(terms, args)
        check_state(y0)
        t0, t1 = system.time(t0), system.time(t1)
        carry = self.start(system, t0, y0)
        if system.friction is None or not system.friction.has_table(y0[1]):
            return carry
        if not len(self.lengths(system)):
            return carry
        h = self.step_length(t0, t1)
        system = self.tabulated(system, h, y0)
        return Tabulated(carry, system.table)  # pyright: ignore[reportReturnType]

    def tabulated(
        self, system: System, h: Array, y: State, both: bool = False
    ) -> System:
        """The system, with what friction computes once for steps of this length.

        In `both` directions of time, or forwards alone.
        """
        if system.friction is None:
            return system
        times = cast_to(signed(self.lengths(system), both), h) * h
        return system.with_table(system.friction.tabulate(y[1], times))

    def fitted(self, system: System, t: Array, h: Array, y: State) -> System:
        """The same if the system has a table already, of a step of any length."""
        table = system.table
        if table is None:
            return system
        forwards = self.lengths(system)
        both = len(table.times) > len(forwards)
        lengths = signed(forwards, both)
        # Neighbours must not be mistaken for each other.
        gap, eps = np.min(np.diff(lengths), initial=1.0), jnp.finfo(h.dtype).eps
        rounding = jnp.minimum(4 * eps * jnp.abs(t), float(gap) / 8 * jnp.abs(h))
        errors = jnp.abs(cast_to(lengths, h) * h - table.times)
        fits = jnp.all(errors <= rounding + 4 * eps * jnp.abs(h))
        known = lambda: table.assume(True)
        compute = lambda: self.tabulated(system, h, y, both).table
        return system.with_table(lax.cond(fits, known, compute))

    def attempt(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        """One step, with a failure if its end is invalid."""
        y, carry, result = self.advance(system, t0, t1, h, y, carry)
        return y, carry, first_failure(result, system.check(t1, y))

    def between(
        self, system: System, t0: Array, start: tuple[State, _Carry], t: Array
    ) -> State:
        """The state at `t` within a step from `t0`, in full order.

        By default a shorter step of the scheme from the start of the step.
        """
        h = self.step_length(t0, t)
        if system.table is not None:
            system = self.tabulated(system, h, start[0])
        return self.advance(system, t0, t, h, *start)[0]

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        system = as_system(terms, args)
        if solver_state is None:
            needed = eqx.filter_eval_shape(self.init, terms, t0, t1, y0, args)
            if jtu.tree_leaves(needed):
                raise ValueError(
                    f"`{type(self).__name__}` has a solver state for this system, but "
                    "got `solver_state=None`. Write `solver_state = solver.init(terms, "
                    "t0, t1, y0, args)` before the first step, and pass on the one "
                    "that each step returns."
                )
        if not isinstance(solver_state, Tabulated):
            return self._step(system, t0, t1, y0, solver_state, made_jump)
        carry, table = solver_state
        times = system.time(t0), system.time(t1)
        h = self.step_length(*times)
        system = self.fitted(system.with_table(table), times[1], h, y0)
        out = self._step(system, t0, t1, y0, carry, made_jump)
        y1, error, dense_info, carry, result = out
        return y1, error, dense_info, Tabulated(carry, system.table), result

    def _step(self, system: System, t0, t1, y0, solver_state, made_jump):
        t0, t1 = system.time(t0), system.time(t1)
        carry = solver_state
        # After a jump the solver state is stale. Mostly `made_jump` is the Python bool
        # `False`, and nothing is traced.
        if made_jump is not False and jtu.tree_leaves(carry):
            restart = lambda: self.start(system, t0, y0)
            carry = lax.cond(made_jump, restart, lambda: solver_state)
        span = Span(t0, t1, self.step_length(t0, t1))
        y1, new_carry, result = self.attempt(system, *span, y0, carry)
        dense_info = self.dense_info(system, span, (y0, carry), (y1, new_carry))
        result = dfx.RESULTS.successful if result is None else result
        return y1, no_error_estimate(y1), dense_info, new_carry, result

    def dense_info(
        self,
        system: System,
        span: Span,
        start: tuple[State, _Carry],
        end: tuple[State, _Carry],
    ) -> dict[str, State]:
        """The data for the interpolation of a step, from its two ends."""
        t0, t1, h = span
        (y0, _), (y1, _) = start, end
        slope0, slope1 = self.slope(system, t0, *start), self.slope(system, t1, *end)
        info = dict(y0=y0, y1=y1, k0=tree_scale(h, slope0), k1=tree_scale(h, slope1))
        # The order of a scheme does not depend on the term.
        number = _INNER_POINTS[bisect.bisect_left(_ORDERS, self.order(None))]
        if number == 0:
            return info

        def at(fraction):
            t = t0 + fraction * h
            y = self.between(system, t0, start, t)
            return y, tree_scale(h, system.slope(t, y))

        return info | dict(inner=lax.map(at, cast_to(inner_points(number), h)))

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


class AbstractMoveSolver(AbstractPresymplecticSolver[_Carry], Generic[_Carry]):
    """A scheme given by a list of invertible moves."""

    @abc.abstractmethod
    def moves(self, system: System) -> Moves:
        """The moves of a step; an error if the scheme does not support the system."""

    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        moves, span = self.moves(system), Span(t0, t1, h)
        (y, carry), result = forward(moves, system, span, (y, carry))
        return y, carry, result

    @property
    def reverse(self) -> "AbstractPresymplecticSolver[_Carry] | None":
        return self if self.is_symmetric else AdjointMethod(self)


class AbstractWrapper(AbstractMoveSolver[_Carry], Generic[_Carry]):
    """A scheme that wraps another one and shares its properties."""

    base: AbstractVar[AbstractPresymplecticSolver]

    def __check_init__(self):
        if not isinstance(self.base, AbstractPresymplecticSolver):
            raise ValueError(
                "`base` must be a presymplectic solver, for example "
                f"`PresymplecticLeapfrog()`, but got {self.base!r}."
            )

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric

    @property
    def reverse(self) -> AbstractPresymplecticSolver[_Carry] | None:
        return None if self.base.reverse is None else super().reverse

    def order(self, terms) -> int:
        return self.base.order(terms)

    def start(self, system: System, t: Array, y: State) -> PyTree:
        return self.base.start(system, t, y)

    def slope(self, system: System, t: Array, y: State, carry: PyTree) -> State:
        return self.base.slope(system, t, y, carry)

    def step_length(self, t0: Array, t1: Array) -> Array:
        return self.base.step_length(t0, t1)

    def undoable(self, start: PyTree, end: PyTree) -> Array | None:
        return self.base.undoable(start, end)

    def composition_error(self) -> str | None:
        return self.base.composition_error() or super().composition_error()


class AdjointMethod(AbstractWrapper[_Carry], Generic[_Carry]):
    """The adjoint method of a list of moves: their inverses in reverse order."""

    base: AbstractPresymplecticSolver[_Carry]

    @property
    def is_symmetric(self) -> bool:
        return False

    @property
    def reverse(self) -> AbstractPresymplecticSolver[_Carry]:
        return self.base

    def moves(self, system: System) -> Moves:
        return self.base.moves(system).inverse


def step_of(solver: AbstractPresymplecticSolver) -> Move:
    """The whole step of a scheme as one move."""

    def step(solver, system: System, span: Span, stage: Stage) -> Outcome:
        y, carry, result = solver.advance(system, *span, *stage)
        return (y, carry), result

    # Inverted only after a check that there is an adjoint method.
    return Move(partial(step, solver), partial(step, solver.reverse), is_step=True)
