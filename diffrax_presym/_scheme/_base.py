import abc
import bisect
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .. import _tree as tree
from .._interpolation import HermiteInterpolation, inner_points
from .._numbers import cast_to, State
from .._results import NONFINITE
from .._system._bound import bind, System, unwrap
from ._engine import (
    AbstractMove,
    first_failure,
    forward,
    inverse,
    leaves,
    Moves,
    MoveSequence,
    Result,
    Span,
)
from ._failure import explain, unless_too_strong
from ._moves import Drift, Enter, Kick
from ._prepare import prepare
from ._strong_friction import Pattern


# Points within a step that dense output uses, from the order up to which they suffice.
_ORDERS, _INNER_POINTS = (2, 4, 10, 14), (0, 1, 3, 5, 7)

Point = tuple[State, PyTree]  # a state and the solver state


class Scheme(NamedTuple):
    """What a solver does with a system."""

    # Between the ends of a step, where `ends` changes the variables, and back.
    inner: Moves
    ends: AbstractMove | None = None
    # The initial solver state, of the system, a time and a state.
    start: Callable[[System, Array, State], PyTree] = lambda system, t, y: None
    # The solver state at a time on one side of a kink, from that there; `None` if it is
    # the same on both.
    at_kink: Callable[[System, Array, State, PyTree], PyTree] | None = None
    # From the solver state the force that ends a step, if it is known.
    end_force: Callable[[PyTree], PyTree | None] = lambda carry: None
    # Whether a step can be inverted from its end.
    is_invertible: bool = True
    # To which relative error, where it is not rounding.
    inverse_error: float = 0.0
    # Whether a step uses those before it, so that it must start again at a kink.
    has_history: bool = False
    # Whether a step solves equations by iteration.
    is_implicit: bool = False
    # Whether the ends of steps show the motion between them.
    is_resolved: bool = True
    # Why steps of unequal length must not be composed: these cancel errors only if the
    # errors are even in the step size.
    not_composable: str | None = None
    # A failure where a state and its solver state are wrong, before a step or after it.
    check: Callable[[System, Array, State, PyTree], dfx.RESULTS] | None = None
    # The most friction over a step that it resolves.
    most_friction: float = math.inf
    failure: Any = NONFINITE  # the reason if a state is not finite
    # The maps that it consists of, if these are known.
    pattern: Pattern = ()

    @property
    def moves(self) -> Moves:
        """All moves of a step."""
        if self.ends is None:
            return self.inner
        moves = self.ends, self.inner, inverse(self.ends)
        return MoveSequence(moves, [(0, 0, 0), (0, 1, 1), (1, 1, 0)])


class AbstractPresymplecticSolver(dfx.AbstractSolver):
    """A scheme for a system such as `MechanicalSystem`.

    A scheme defines its moves; `diffrax.diffeqsolve` handles saving, events, adjoints
    and the direction of time. No scheme has an error estimate: `choose_step` finds the
    step for a tolerance. For adaptive steps, wrap the scheme in `diffrax.HalfSolver`. A
    step whose end is not finite makes the solve fail.
    """

    # Not `AbstractSystem`, so that other terms reach the error message of `bind`.
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
    def scheme(self, system: System) -> Scheme:
        """What the solver does with a system; `ValueError` if it does not support it,
        or would lose its order."""

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        term, _ = unwrap(terms)  # An error if it is another term.
        term.check_state(y0)
        system = bind(terms, args, y0)
        scheme = self.scheme(system)
        check_moves(self, system, scheme)
        return scheme.start(system, system.time(t0), y0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        system = bind(terms, args, y0)
        t0, t1 = system.time(t0), system.time(t1)
        scheme, span = self.scheme(system), Span(t0, t1, t1 - t0)
        if made_jump is not False:
            # To a function of time `t0` may still be before the jump.
            span = span._replace(t0=t0 + jnp.where(made_jump, span.rounding, 0))
        restart = lambda: scheme.start(system, span.t0, y0)
        carry = solver_state
        if carry is None and jtu.tree_leaves(eqx.filter_eval_shape(restart)):
            raise ValueError(
                f"`{type(self).__name__}` has a solver state for this system, but got "
                "`solver_state=None`. Write `solver_state = solver.init(terms, t0, t1, "
                "y0, args)` before the first step, and pass on the one that each step "
                "returns."
            )
        # After a jump the solver state is stale. Mostly `made_jump` is the Python bool
        # `False`, and nothing is traced.
        if made_jump is not False and jtu.tree_leaves(carry):
            carry = lax.cond(made_jump, restart, lambda: solver_state)
        start = y0, carry
        end, result = advance(scheme, system, span, start)
        info = dense_info(self, scheme, system, span, start, end)
        result = check_step(scheme, system, span, start, end, result)
        return end[0], None, info, end[1], result

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


AbstractPresymplecticSolver.__init__.__doc__ = "**Arguments:** its fields, if any."


def advance(
    scheme: Scheme, system: System, span: Span, start: Point, data: PyTree = None
) -> tuple[Point, Result]:
    """One step; `data` is what was prepared for it, if it was."""
    if data is None:
        data = prepare(scheme.moves, system, span)
        data = unless_too_strong(scheme.most_friction, system, span, data)
    end, result = forward(scheme.moves, system, span, data, start)
    return end, first_failure(result, system.check(span.t1, system.values(end[0])))


def check_step(
    scheme: Scheme, system: System, span: Span, start: Point, end: Point, result: Result
) -> dfx.RESULTS:
    """The result of a step, a failure also if its end is not finite."""
    finite = dfx.RESULTS.where(
        tree.all_finite(end[0]), dfx.RESULTS.successful, NONFINITE
    )
    result = first_failure(result, finite)
    ends = (span.t0, start), (span.t1, end)
    return explain(scheme, system, lambda _: span, 1, ends, result)


def between(scheme: Scheme, system: System, span: Span, start: Point) -> State:
    """The state at the end of a part of a step, in full order: a shorter step."""
    return advance(scheme, system, span, start)[0][0]


def dense_info(
    solver: AbstractPresymplecticSolver,
    scheme: Scheme,
    system: System,
    span: Span,
    start: Point,
    end: Point,
) -> dict[str, PyTree]:
    """The data for the interpolation of a step, from its two ends; derivatives are
    those within it, where a force may jump at these."""
    t0, t1, h = span
    slope = lambda t, x: system.slope(t, x[0], scheme.end_force(x[1]))
    y0, y1 = (system.values(x[0]) for x in (start, end))
    ends = (t0, start), (t1 - span.rounding, end)
    k0, k1 = (tree.scale(h, slope(*x)) for x in ends)
    info = dict(y0=y0, y1=y1, k0=k0, k1=k1)
    # The order of a scheme does not depend on the term.
    number = _INNER_POINTS[bisect.bisect_left(_ORDERS, solver.order(None))]
    if number == 0:
        return info

    def at(fraction):
        t = t0 + fraction * h
        y = between(scheme, system, Span(t0, t, t - t0), start)
        return y, tree.scale(h, system.slope(t, y))

    return info | dict(inner=lax.map(at, cast_to(inner_points(number), h)))


def refuse_constrained(solver: AbstractPresymplecticSolver, system: System) -> None:
    """An error if the states of a system lie on a manifold that a scheme leaves."""
    if system.term.is_constrained:
        raise ValueError(
            f"`{type(solver).__name__}` would leave the manifold of this "
            f"`{system.name}`. Use `Strang()`, `BlanesMoan4()` or `BlanesMoan6()`, or "
            "compositions such as `SofroniouSpaletta(6, Strang())`."
        )


def check_moves(
    solver: AbstractPresymplecticSolver, system: System, scheme: Scheme
) -> None:
    """An error if the moves of a scheme, which may be a user's, do not fit a system."""
    moves = leaves(scheme.moves)
    if not all(move.keeps_manifold for move in moves):
        refuse_constrained(solver, system)
    entered = [move.kind for move in moves if isinstance(move, Enter)]
    for move in moves:
        if not isinstance(move, Drift | Kick) or move.kind in entered:
            continue
        split = system.split(move.kind)
        if split is not None and split.has_variables:
            raise ValueError(
                f"The moves of `{type(solver).__name__}` are those of a split of "
                f"`{system.name}` that has variables of its own. Write `Scheme(moves, "
                f'ends=Enter("{move.kind}"))`.'
            )


def check_base(base) -> None:
    # An instance of `HalfSolver` is one of the class of the solver in it.
    if isinstance(base, dfx.HalfSolver):
        raise ValueError(
            "`base` must be a presymplectic solver, but got a `HalfSolver`. Wrap the "
            "whole, `HalfSolver(Compensated(Strang()))`."
        )
    if not isinstance(base, AbstractPresymplecticSolver):
        raise ValueError(
            "`base` must be a presymplectic solver, for example "
            f"`PresymplecticLeapfrog()`, but got {base!r}."
        )
