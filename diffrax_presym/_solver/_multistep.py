from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Inexact, PyTree

from .._misc import (
    cast_to,
    is_sum,
    rounding_errors,
    Sum,
    tree_add,
    tree_scale,
    tree_sub,
    values,
)
from .._split import SharedSplit, State
from .._system import System
from . import _engine as engine
from ._base import AbstractMoveSolver, AbstractPresymplecticSolver, AdjointMethod
from ._engine import Move, Moves, Span, Stage
from ._multistep_tables import (
    check_rho,
    multistep_table,
    MultistepTable,
    RHO,
)
from ._splitting import BlanesCasasRKN8


# The scheme of the first steps.
_ONE_STEP = BlanesCasasRKN8()
# The steps after a singularity of the friction in which the forces of the shared split
# vary too fast for the method.
_ROUGH = 32


class _Carry(NamedTuple):
    """The solver state."""

    count: Inexact[Array, ""]  # steps since the start; a float, as all leaves are
    h: Inexact[Array, ""]  # the length of the last step, zero if there was none
    q_lost: PyTree  # the rounding error of the position
    # The rounding error of the momentum in the steps at the start. After these, the
    # momentum at their end, from which a gradient by reversal goes back.
    p_lost: PyTree
    # In the variables of the shared split, in the frame of the end of the last step:
    momentum: PyTree[Sum]  # the mean over the step
    force: PyTree  # at the end of the step
    filter: PyTree[Inexact[Array, "lags ..."]]  # the state of the filter of forces
    dropped: Inexact[Array, ""]  # how many times a history was dropped


class SymmetricMultistep(AbstractMoveSolver[_Carry]):
    r"""A symmetric multistep method: high order with one force evaluation per step.

    8th, 10th or 12th order. One force evaluation per step. An output between two steps
    is a step of the eighth-order scheme below, of 19 evaluations: in the loop of
    Diffrax, dense/ts output takes five or seven of them in each step.

    For a kinetic energy $\tfrac12 \, p \cdot M^{-1} p$ with constant mass, any
    potential and any scalar friction, with constant steps, at errors of 1e-6 and less:
    where the force is most of the cost and none of its frequencies is much higher than
    the others, as for planets, molecules and nonlinear lattices. Not for stiff springs
    next to soft ones or waves on a grid, where [`diffrax_presym.TunedRKN6`][] or
    [`diffrax_presym.TunedLinear8`][] take longer steps per evaluation, nor for adaptive
    steps.

    Symmetric, but not symplectic: no form is conserved. Of a symmetric method the error
    in the energy stays small over long times if the motion is regular and the step is
    short enough (Hairer, Lubich and Wanner, chapter XV). Every method has steps at
    which it is unstable or resonates with the motion, and rarely a warning of it other
    than the energy: halve the step to see whether an error is that of the scheme.

    In the variables of [`diffrax_presym.SharedSplit`][], where friction is a force, a
    step is a kick and a drift. The kick is by a filtered force: a linear combination of
    the last forces and kicks. It is the method
    $\sum_j \alpha_j x_{n+j} = h^2 \sum_j \beta_j x''_{n+j}$ written for increments,
    which are summed with compensation, so that rounding errors are those of the force.
    The momentum at a step is computed from the same history to the same order, and is
    not fed back.

    The first `order - 1` steps, each step of another length than the one before it, the
    steps after a jump and those close to a singularity of the friction are steps of
    [`diffrax_presym.BlanesCasasRKN8`][], of 19 evaluations. So no force is evaluated
    outside of the steps. Each step is reversible to rounding, and
    [`diffrax_presym.ReversibleAdjoint`][] takes its gradient, but with an error refuses
    to go back through a change of the step after the first `order - 1` steps.

    ??? cite "Reference"

        ```bibtex
        @article{quinlan1990symmetric,
            author={Quinlan, Gerald D. and Tremaine, Scott},
            title={Symmetric multistep methods for the numerical integration of
                   planetary orbits},
            journal={The Astronomical Journal},
            volume={100},
            number={5},
            pages={1694--1700},
            year={1990},
        }

        @misc{quinlan1999resonances,
            author={Quinlan, Gerald D.},
            title={Resonances and instabilities in symmetric multistep methods},
            year={1999},
            eprint={astro-ph/9901136},
            archivePrefix={arXiv},
        }
        ```
    """

    rho: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, order: int = 8, rho: Sequence[float] | None = None):
        r"""**Arguments:**

        - `order`: 8, 10 or 12. Defaults to 8, which allows the longest steps.
        - `rho`: the coefficients $\alpha_0, \dots, \alpha_{k/2}$ of a method of your
            own with $k$ = `order` steps, the first half including the middle one, with
            $\alpha_0 = 1$. Its $\beta_j$ follow from the conditions of order. For
            example `(1, -2, 2, -2, 2)` is method 8A of Quinlan (1999). Defaults to
            `None`: for orders 8 and 10, coefficients of this package, from
            `benchmarks/multistep.py`; for order 12, Quinlan and Tremaine (1990).

        **Raises:**

        `ValueError` if the order is not one of these or `rho` does not have
        `order / 2 + 1` coefficients of a stable method: a double root at one, and all
        others simple and on the unit circle. When the solve is traced, `ValueError` if
        the Hamiltonian has no constant mass.
        """
        if type(order) is not int or order not in RHO:
            instead = "Write `SymmetricMultistep(8)`, for example."
            if type(order) is int and order < 8:
                instead = "For lower orders use `BlanesMoanRKN4()` or `TunedRKN6()`."
            raise ValueError(
                "`SymmetricMultistep(order)` must be 8, 10 or 12, but got "
                f"{order!r}. {instead}"
            )
        self.rho = RHO[order] if rho is None else check_rho(order, rho)

    @property
    def is_symmetric(self) -> bool:
        return True

    @property
    def reverse(self) -> AbstractPresymplecticSolver[_Carry]:
        # Not this scheme itself: backwards, a step removes itself from the history.
        return AdjointMethod(self)

    @property
    def table(self) -> MultistepTable:
        return multistep_table(self.rho)

    def order(self, terms) -> int:
        return self.table.order

    def composition_error(self) -> str:
        return (
            "Compositions of unequal steps are not possible with "
            "`SymmetricMultistep`, which has the order of its table and needs equal "
            "steps. Compose `PresymplecticLeapfrog()` instead."
        )

    def split(self, system: System) -> SharedSplit:
        """The split in which friction is a force; an error if there is none."""
        split = system.split("shared")
        if isinstance(split, SharedSplit):
            return split
        raise ValueError(
            "`SymmetricMultistep` needs a second-order equation with a constant mass, "
            "and friction with one rate for all momenta, with a derivative: that of a "
            "function eta(t) may jump. Write "
            "`ConformalHamiltonian(QuadraticKinetic(mass), potential, damping)` or "
            "`SeparableHamiltonian(QuadraticKinetic(mass), potential)`. For this "
            f"`{system.name}` use `TunedRKN6()`, `BlanesMoan6()` or "
            "`PresymplecticGauss()`."
        )

    def start(self, system: System, t: Array, y: State) -> _Carry:
        self.split(system)
        count, nothing = self.table.order - 2, system.zeros(y[1])
        many = jtu.tree_map(lambda x: jnp.zeros((count, *x.shape), x.dtype), nothing)
        zero = jnp.zeros((), jnp.result_type(t))
        sums = _as_sums(nothing)
        return _Carry(zero, zero, nothing, nothing, sums, nothing, many, zero)

    def undoable(self, start: _Carry, end: _Carry) -> Array:
        return start.dropped == end.dropped

    def moves(self, system: System) -> Moves:
        split = self.split(system)

        def forward(system: System, span: Span, stage: Stage):
            return _Step(system, split, self.table, span).forward(stage), None

        def backward(system: System, span: Span, stage: Stage):
            return _Step(system, split, self.table, span).backward(stage), None

        return Move(forward, backward)

    def between(
        self, system: System, t0: Array, start: tuple[State, _Carry], t: Array
    ) -> State:
        # A shorter step is always one of the one-step scheme.
        h = self.step_length(t0, t)
        return _ONE_STEP.advance(system, t0, t, h, start[0], None)[0]


class _Step:
    """A step of the method, or of the one-step scheme at the start."""

    def __init__(self, system: System, split: SharedSplit, table, span: Span):
        self.system, self.split, self.table, self.span = system, split, table, span

    def forward(self, stage: Stage) -> Stage:
        (y, old), (t0, t1, h) = stage, self.span
        system, split, decay = self.system, self.split, self._decay
        known = lax.stop_gradient(self._known(old))
        starting = known < self.table.order - 1
        lasting = old.count > self.table.order - 1
        nothing = jtu.tree_map(jnp.zeros_like, old.p_lost)
        q, p = _to_sums(y, old.q_lost, _pick(lasting, nothing, old.p_lost))
        # A kick by the filtered force, and a drift.
        newest = float(self.table.forces[0])
        kick = jtu.tree_map(lambda s, f: s[0] + newest * f, old.filter, old.force)
        z = q, system.add(old.momentum, h, kick)
        z = split.drift(system, t0, h, z, self.table.order)

        def start(_):
            # The same from a step of the other scheme.
            moves = _ONE_STEP.moves(system)
            (first, _), _ = engine.forward(moves, system, self.span, ((q, p), None))
            change = system.subtract(first[0], decay(q))
            mean = tree_scale(1 / h, self._times_mass(change))
            kick = tree_scale(1 / h, tree_sub(mean, decay(values(old.momentum))))
            return _stack((*first, _as_sums(mean), _as_sums(kick)))

        # In the frame of the end of the step, as that of its start may not exist.
        taken = _stack((z[0], p, z[1], _as_sums(decay(kick))))
        taken = _either(starting, start, lambda taken: taken, taken)
        q, first_p, momentum, kick = _unstack(taken)
        force, B, R = decay(old.force), self.table.forces[1:], self.table.kicks[1:]

        def remember(s, force, kick):
            later = jnp.concatenate([s[1:], jnp.zeros_like(s[:1])])
            return later + (_outer(B, force) - _outer(R, kick))

        filter = jtu.tree_map(remember, decay(old.filter), force, values(kick))
        force = split.force(system, t1, (q, momentum))
        p1 = self._momentum(t1, h, q, momentum, force, filter)
        kept = _pick(known == self.table.order - 1, values(p), old.p_lost)
        p_lost = rounding_errors(first_p)
        p1 = _pick(starting, (values(first_p), p_lost), (p1, nothing))
        p1 = jtu.tree_map(Sum, *p1)
        lost = rounding_errors(q), _pick(starting, p_lost, kept)
        # Of a history that is not used any more the end of the step knows nothing.
        dropped = (known < old.count) & (old.count >= self.table.order)
        new = _Carry(
            *(known + 1, cast_to(h, old.h), *lost, momentum, force, filter),
            old.dropped + jnp.where(dropped, 1, 0),
        )
        return _from_sums((q, p1), y), new

    def backward(self, stage: Stage) -> Stage:
        (y, new), (t1, t0, h) = stage, self.span
        system, split, decay = self.system, self.split, self._decay
        known = new.count - 1
        starting = known < self.table.order - 1
        nothing = jtu.tree_map(jnp.zeros_like, new.p_lost)
        q, p = _to_sums(y, new.q_lost, _pick(starting, new.p_lost, nothing))
        z = split.drift(system, t1, h, (q, new.momentum), self.table.order)
        force = split.force(system, t0, z)
        # The oldest force and kick have left the filter, so its last entry is known.
        filter, B, R = decay(new.filter), self.table.forces, self.table.kicks
        kick = jtu.tree_map(lambda s, f: float(B[-1]) * f - s[-1], filter, force)

        def forget(s, force, kick):
            s = s - (_outer(B[1:], force) - _outer(R[1:], kick))
            return jnp.concatenate([(kick - float(B[0]) * force)[None], s[:-1]])

        filter = jtu.tree_map(forget, filter, force, kick)
        momentum = system.add(z[1], h, kick)
        p0 = self._momentum(t0, -h, z[0], momentum, force, filter)
        first_step = known == self.table.order - 1
        p0 = _pick(first_step, new.p_lost, p0)

        def start(_):
            moves = _ONE_STEP.moves(system).inverse
            (first, _), _ = engine.forward(moves, system, self.span, ((q, p), None))
            return _stack(first)

        taken = _stack((z[0], _as_sums(p0)))
        taken = _either(starting, start, lambda taken: taken, taken)
        q, p = _unstack(taken)
        # The rounding error of a momentum not computed by the one-step scheme is zero.
        kept = _pick(starting | first_step, rounding_errors(p), new.p_lost)
        lost = rounding_errors(q), kept
        # The rest of the history is of no use in the steps at the start.
        history = new.momentum, new.force, new.filter
        momentum, force, filter = _pick(starting, history, (momentum, force, filter))
        count, length = jnp.maximum(known, 0), cast_to(-h, new.h)
        old = _Carry(count, length, *lost, momentum, force, filter, new.dropped)
        return _from_sums((q, p), y), old

    def _known(self, carry: _Carry) -> Array:
        """The number of steps in the history, -1 where it cannot start yet."""
        t0, t1, h = self.span
        ulp = jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        change = jnp.abs(h - carry.h)
        same = (change <= 8 * ulp) & (change <= 1e-3 * jnp.abs(h))
        known = jnp.where(same, carry.count, 0)
        half, friction = self.split.half, self.system.friction
        if half is None or friction is None or friction.is_singular(t0) is None:
            return known
        rate, change = jax.jvp(half.rate, (t0,), (jnp.ones_like(t0),))
        # False also where it is not a number, at a singularity.
        smooth = _ROUGH * jnp.abs(change * h) <= jnp.abs(rate)
        return jnp.where(smooth, known, -1)

    def _decay(self, x: PyTree) -> PyTree:
        """From the frame of the start of the span to that of its end."""
        half, (t0, _, h) = self.split.half, self.span
        return x if half is None else tree_add(x, 1, half.decay(t0, h, values(x)))

    def _times_mass(self, velocity: PyTree) -> PyTree:
        return self.split.kinetic.momentum(velocity)

    def _momentum(self, t, h, q, momentum, force, filter) -> PyTree:
        """The mechanical momentum at the end of a step."""
        weights = [float(w) for w in self.table.momentum]

        def gain(s, force):
            return sum(w * x for w, x in zip(weights, (*s, force), strict=True))

        gained = jtu.tree_map(gain, filter, force)
        z = values(q), tree_add(values(momentum), h, gained)
        return self.split.from_split(self.system, t, z)[1]


def _pick(condition: Bool[Array, ""], x: PyTree, y: PyTree) -> PyTree:
    return jtu.tree_map(partial(jnp.where, condition), x, y)


def _outer(column: np.ndarray, x: Array) -> Array:
    return cast_to(column, x).reshape(-1, *(1,) * x.ndim) * x[None]


def _stack(sums: tuple[PyTree[Sum], ...]) -> PyTree:
    """Several trees of sums as one tree of arrays."""
    leaf = lambda *x: jnp.stack([y for s in x for y in (s.value, s.lost)])
    return jtu.tree_map(leaf, *sums, is_leaf=is_sum)


def _unstack(rows: PyTree) -> list[PyTree[Sum]]:
    count = len(jtu.tree_leaves(rows)[0])
    pair = lambda i: jtu.tree_map(lambda x: Sum(x[i], x[i + 1]), rows)
    return [pair(i) for i in range(0, count, 2)]


def _as_sums(x: PyTree) -> PyTree[Sum]:
    return jtu.tree_map(lambda x: Sum(x, jnp.zeros_like(x)), x)


def _to_sums(y: State, *lost: PyTree) -> State:
    # Within `Compensated` the leaves are sums already.
    leaf = lambda x, lost: x if is_sum(x) else Sum(x, lost)
    return jtu.tree_map(leaf, y, lost, is_leaf=is_sum)


def _from_sums(sums: State, like: State) -> State:
    leaf = lambda x, new: new if is_sum(x) else new.value
    return jtu.tree_map(leaf, like, sums, is_leaf=is_sum)


def _either(condition: Bool[Array, ""], if_true: Callable, if_false: Callable, x: Any):
    """`lax.cond`, of which a batch mostly needs the second branch only.

    Under `vmap`, `lax.cond` alone would always compute both branches.
    """
    some = lambda x: lax.cond(condition, if_true, if_false, x)
    return lax.cond(eqxi.unvmap_any(condition), some, if_false, x)
