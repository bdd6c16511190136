import abc
from functools import partial
from typing import ClassVar, Generic, TypeVar

import diffrax as dfx
import jax.lax as lax
import jax.tree_util as jtu
from jaxtyping import Array

from .._interpolation import HermiteInterpolation
from .._misc import tree_scale
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
)


_Carry = TypeVar("_Carry")


class AbstractPresymplecticSolver(dfx.AbstractSolver[_Carry], Generic[_Carry]):
    """A one-step scheme for the term [`diffrax_presym.HamiltonianTerm`][].

    A scheme says how it starts and how it advances; saving, events, adjoints and the
    direction of time are `diffrax.diffeqsolve`'s, as for any of its own solvers. No
    scheme estimates its error; to adapt the step, wrap it in `diffrax.HalfSolver`.
    """

    # Broader than `HamiltonianTerm`, so that a term of another kind reaches `as_system`
    # and its error message, which says what to write instead.
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = HermiteInterpolation

    @property
    @abc.abstractmethod
    def is_symmetric(self) -> bool:
        """Whether a step backwards undoes a step."""

    @abc.abstractmethod
    def order(self, terms) -> int:
        """The order of the scheme."""

    @abc.abstractmethod
    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        """One step from `t0` to `t1`, in physical time.

        `h` is their difference, to more digits than subtraction gives.
        """

    def start(self, system: System, t: Array, y: State) -> _Carry:
        """What the scheme carries from step to step besides the state, at the start.

        Nothing, by default.
        """
        return None  # pyright: ignore[reportReturnType]

    def slope(self, system: System, t: Array, y: State, carry: _Carry) -> State:
        """The full vector field at an end of a step, for dense output."""
        return system.slope(t, y)

    @property
    def reverse(self) -> "AbstractPresymplecticSolver[_Carry] | None":
        """The adjoint method: a step of it backwards undoes a step of this scheme.

        `None` if there is none that is known.
        """
        return self if self.is_symmetric else None

    def moves(self, system: System) -> Moves:
        """The moves of a step: one, unless the scheme is a list of moves."""
        return step_of(self)

    def step_length(self, t0: Array, t1: Array) -> Array:
        """The difference of the ends of a step of the solve."""
        return t1 - t0

    def composition_error(self) -> str | None:
        """Why the scheme cannot be composed by steps of unequal length, if so.

        These cancel errors only if the errors are even in the length of the step.
        """
        if self.is_symmetric:
            return None
        return (
            f"Compositions need a symmetric base, which `{type(self).__name__}` is "
            "not. Compose `PresymplecticLeapfrog()` instead."
        )

    def distance(self, y: State, solver_state: _Carry) -> Array:
        """The largest difference between copies of the system, if there are any."""
        raise ValueError(
            f"`{type(self).__name__}` keeps no copies of the system, so there is no "
            "distance between them. Use `PresymplecticCoupled()`, for example."
        )

    def init(self, terms, t0, t1, y0, args) -> _Carry:
        system = as_system(terms, args)
        check_state(y0)
        return self.start(system, system.time(t0), y0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        system = as_system(terms, args)
        t0, t1 = system.time(t0), system.time(t1)
        carry = solver_state
        # A jump makes what was carried stale. It is a Python bool, and nothing is
        # traced, unless a controller or the user says otherwise.
        if made_jump is not False and jtu.tree_leaves(carry):
            restart = lambda: self.start(system, t0, y0)
            carry = lax.cond(made_jump, restart, lambda: solver_state)
        h = self.step_length(t0, t1)
        y1, new_carry, result = self.advance(system, t0, t1, h, y0, carry)
        result = first_failure(result, system.check(t1, y1))
        ends = (y0, carry), (y1, new_carry)
        dense_info = self.dense_info(system, t0, t1, h, *ends)
        result = dfx.RESULTS.successful if result is None else result
        return y1, None, dense_info, new_carry, result

    def dense_info(
        self,
        system: System,
        t0: Array,
        t1: Array,
        h: Array,
        start: tuple[State, _Carry],
        end: tuple[State, _Carry],
    ) -> dict[str, State]:
        """What the interpolation of a step needs to know of its two ends."""
        (y0, _), (y1, _) = start, end
        slope0, slope1 = self.slope(system, t0, *start), self.slope(system, t1, *end)
        info = dict(y0=y0, y1=y1, k0=tree_scale(h, slope0), k1=tree_scale(h, slope1))
        # No scheme needs to look at the term to know its order.
        if self.order(None) > 4:
            second0 = system.second_derivative(t0, y0, slope0)
            second1 = system.second_derivative(t1, y1, slope1)
            info |= dict(b0=tree_scale(h**2, second0), b1=tree_scale(h**2, second1))
        return info

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


class AbstractMoveSolver(AbstractPresymplecticSolver[_Carry], Generic[_Carry]):
    """A scheme that is a list of moves, each of which can be undone."""

    @abc.abstractmethod
    def moves(self, system: System) -> Moves:
        """The moves of a step, after a check that the scheme can step this system."""

    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        moves, span = self.moves(system), Span(t0, t1, h)
        (y, carry), result = forward(moves, system, span, (y, carry))
        return y, carry, result

    @property
    def reverse(self) -> "AbstractPresymplecticSolver[_Carry] | None":
        return self if self.is_symmetric else AdjointMethod(self)


class AdjointMethod(AbstractMoveSolver[_Carry], Generic[_Carry]):
    """The adjoint method of a list of moves: their inverses in the opposite order."""

    base: AbstractPresymplecticSolver[_Carry]

    @property
    def is_symmetric(self) -> bool:
        return False

    @property
    def reverse(self) -> AbstractPresymplecticSolver[_Carry]:
        return self.base

    def order(self, terms) -> int:
        return self.base.order(terms)

    def start(self, system: System, t: Array, y: State) -> _Carry:
        return self.base.start(system, t, y)

    def slope(self, system: System, t: Array, y: State, carry: _Carry) -> State:
        return self.base.slope(system, t, y, carry)

    def moves(self, system: System) -> Moves:
        return self.base.moves(system).inverse


def step_of(solver: AbstractPresymplecticSolver) -> Move:
    """A whole step of a scheme that is no list of moves."""

    def step(solver, system: System, span: Span, stage: Stage) -> Outcome:
        y, carry, result = solver.advance(system, *span, *stage)
        return (y, carry), result

    # Undone only after a check that there is an adjoint method.
    return Move(partial(step, solver), partial(step, solver.reverse))
