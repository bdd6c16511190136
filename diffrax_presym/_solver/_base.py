"""Kick, drift, and a momentum that moves with its frame: all schemes are made of them.

The state is a pair `(q, p)` with `p` in the frame of the current time. A kick moves `p`
and nothing else. A drift moves `q` and takes time, and so the frame of `p`, along.
"""

import abc
from typing import ClassVar, Generic, Literal, TYPE_CHECKING, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, PyTree

from .._interpolation import HermiteInterpolation
from .._misc import cast_to, check_root_finder, tree_add, tree_scale, tree_sub
from .._term import check_state, State, View, view


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


_Carry = TypeVar("_Carry")
Result = dfx.RESULTS | None  # `None`: nothing that could fail was done


class AbstractPresymplecticSolver(dfx.AbstractSolver[_Carry], Generic[_Carry]):
    """A one-step scheme for the term [`diffrax_presym.HamiltonianTerm`][].

    A scheme says how it starts and how it advances; saving, events, adjoints and the
    direction of time are `diffrax.diffeqsolve`'s, as for any of its own solvers. No
    scheme estimates its error; to adapt the step, wrap it in `diffrax.HalfSolver`.
    """

    # Broader than `HamiltonianTerm`, so that a term of another kind reaches `view` and
    # its error message, which says what to write instead.
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = HermiteInterpolation

    @property
    @abc.abstractmethod
    def is_symmetric(self) -> bool:
        """Whether a step backwards undoes a step."""

    @property
    def reverse(self) -> "AbstractPresymplecticSolver[_Carry] | None":
        """The scheme a step of which, backwards, undoes a step of this one, if any."""
        return self if self.is_symmetric else None

    @abc.abstractmethod
    def order(self, terms) -> int:
        """The order of the scheme."""

    @abc.abstractmethod
    def start(self, view: View, t, y: State) -> _Carry:
        """What the scheme carries from step to step besides the state, at the start."""

    @abc.abstractmethod
    def advance(
        self, view: View, t0, t1, h, y: State, carry: _Carry
    ) -> tuple[State, _Carry, Result]:
        """One step from `t0` to `t1`, in physical time.

        `h` is their difference, to more digits than can be had by subtraction.
        """

    @abc.abstractmethod
    def slope(self, view: View, t, y: State, carry: _Carry) -> State:
        """The full vector field at an end of a step, for dense output."""

    def init(self, terms, t0, t1, y0, args) -> _Carry:
        system = view(terms, args)
        check_state(y0)
        return self.start(system, system.time(t0), y0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        system = view(terms, args)
        t0, t1 = system.time(t0), system.time(t1)
        carry = solver_state
        # A jump makes what was carried stale. It is a Python bool, and nothing is
        # traced, unless a controller or the user says otherwise.
        if made_jump is not False and jtu.tree_leaves(carry):
            restart = lambda: self.start(system, t0, y0)
            carry = lax.cond(made_jump, restart, lambda: solver_state)
        h = t1 - t0
        y1, new_carry, result = self.advance(system, t0, t1, h, y0, carry)
        result = first_failure(result, system.check(t1, y1))
        ends = (y0, carry), (y1, new_carry)
        dense_info = self.dense_info(system, t0, t1, h, *ends)
        result = dfx.RESULTS.successful if result is None else result
        return y1, None, dense_info, new_carry, result

    def dense_info(self, view: View, t0, t1, h, start, end) -> dict[str, State]:
        """What the interpolation of a step needs to know of its two ends."""
        (y0, _), (y1, _) = start, end
        slope0, slope1 = self.slope(view, t0, *start), self.slope(view, t1, *end)
        info = dict(y0=y0, y1=y1, k0=tree_scale(h, slope0), k1=tree_scale(h, slope1))
        # No scheme needs to look at the term to know its order.
        if self.order(None) > 4:
            bend0, bend1 = view.bend(t0, y0, slope0), view.bend(t1, y1, slope1)
            info |= dict(b0=tree_scale(h**2, bend0), b1=tree_scale(h**2, bend1))
        return info

    def pull_back(self, view: View, wanted: PyTree, t0, t1, h, end, bar):
        """Undo a step, and pull cotangents back through it.

        From the state and what is carried at its `end`, and the cotangents of these,
        to those at its start; and the cotangents of what is `wanted` of the view.
        """
        reverse = self.reverse
        assert reverse is not None
        undo = lambda end: reverse.advance(view, t1, t0, -h, *end)[:2]
        redo = lambda view, start: self.advance(view, t0, t1, h, *start)[:2]
        return pull_back(undo, redo, view, wanted, end, bar)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def pull_back(undo, redo, view: View, wanted: PyTree, end, bar):
    """The same for any move `redo`, of which `undo` is the inverse."""
    start = undo(end)
    moved, rest = eqx.partition(view, wanted)
    again = lambda moved, start: redo(eqx.combine(moved, rest), start)
    return start, *jax.vjp(again, moved, start)[1](bar)


class Clock(eqx.Module):
    """The time at a fraction of a step."""

    t0: Array
    t1: Array
    h: Array

    def __call__(self, c):
        # Rounding must not make the last stage miss the end of the step.
        return jnp.where(c == 1, self.t1, self.t0 + c * self.h)


def stage_table(fractions, like) -> tuple[Array, Array, Array]:
    """Where each stage of a step starts and ends, and its length, as fractions of it.

    Constants, to be multiplied by the step inside the loop over the stages: a table
    made anew at each step was measured to take as long as the stages themselves.
    """
    ends = np.cumsum(fractions)
    ends[-1] = 1
    starts = np.concatenate([[0], ends[:-1]])
    lengths = np.array(fractions)
    return cast_to(starts, like), cast_to(ends, like), cast_to(lengths, like)


class AbstractKickDriftSolver(AbstractPresymplecticSolver[_Carry]):
    """A scheme made of the two half-steps of the paper, adjoint to each other.

    Both are explicit for a separable system and implicit for any other.
    """

    first: AbstractVar[Literal["momentum", "position"]]
    root_finder: AbstractVar[optx.AbstractRootFinder | None]
    root_find_max_steps: AbstractVar[int]

    def __check_init__(self):
        if self.first not in ("momentum", "position"):
            raise ValueError(
                f'`first` must be "momentum" or "position", but got {self.first!r}.'
            )
        if self.root_finder is not None:
            check_root_finder(self.root_finder)

    def momentum_first(self, view: View, t, h, y: State, force=None):
        """Kick at `t`, then drift to `t + h` with the velocity frozen at `t`.

        Equation (presymp_euler), A in the design of the schemes. `force` is the force
        at the start, if it is known.
        """
        q, p = y

        def kicked(p_new):
            known = view.force(t, (q, p_new)) if force is None else force
            return tree_add(p, h, known)

        p, result = self._solve(view, kicked, p)
        q = tree_add(q, h, view.velocity(t, (q, p)))
        return (q, view.move_frame(t, h, p)), result

    def position_first(self, view: View, t, h, y: State, t1):
        """Drift to `t1 = t + h` with the velocity frozen at `t1`, then kick at `t1`.

        Equation (presymp_euler2), B in the design of the schemes: B over `h` undoes A
        over `-h`. Returns the force at the end too.
        """
        q, p = y
        p = view.move_frame(t, h, p)
        moved = lambda q_new: tree_add(q, h, view.velocity(t1, (q_new, p)))
        q, result = self._solve(view, moved, q)
        force = view.force(t1, (q, p))
        return (q, tree_add(p, h, force)), force, result

    def _solve(self, view: View, fn, guess: PyTree) -> tuple[PyTree, Result]:
        # The solution of x = fn(x), where fn ignores x if the system is separable.
        if view.is_separable:
            return fn(guess), None
        if self.root_finder is None:
            if view.hamiltonian.is_split:
                instead = "use `Strang()` or `BlanesMoan4()`, which are explicit."
            else:
                instead = (
                    "use `PresymplecticCoupled()`, which is explicit; or, if the "
                    "energy is a sum T(t, p) + V(t, q), give its parts: "
                    "`SeparableHamiltonian(kinetic, potential)` or "
                    "`ConformalHamiltonian(kinetic, potential, damping)`."
                )
            raise ValueError(
                f"This `{type(view.hamiltonian).__name__}` is not separable, so "
                f"`{type(self).__name__}` is implicit. Pass it a root finder, for "
                "example `root_finder=optimistix.Newton(rtol=1e-10, atol=1e-10)`; or "
                + instead
            )
        residual = lambda x, _: tree_sub(fn(x), x)
        solution = optx.root_find(
            residual,
            self.root_finder,
            guess,
            max_steps=self.root_find_max_steps,
            throw=False,
        )
        return solution.value, dfx.RESULTS.promote(solution.result)


def first_failure(result: Result, other: Result) -> Result:
    """The first of two results, unless it is a success."""
    if result is None or other is None:
        return other if result is None else result
    return dfx.RESULTS.where(result == dfx.RESULTS.successful, other, result)
