from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Inexact, PyTree

from .. import _tree as tree
from .._numbers import cast_to, State
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, advance, Point, Scheme
from ._engine import AbstractMove, forward, Outcome, prepare, Span, Stage
from ._multistep_tables import multistep_table, MultistepTable, RHO
from ._splitting import BlanesCasasRKN8, find_split


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
    momentum: PyTree[tree.Sum]  # the mean over the step
    force: PyTree  # at the end of the step
    filter: PyTree[Inexact[Array, "lags ..."]]  # the state of the filter of forces
    dropped: Inexact[Array, ""]  # how many times a history was dropped


class _Data(NamedTuple):
    """What a step needs of time alone."""

    decay: PyTree  # of the shared split
    smooth: Bool[Array, ""] | None  # whether the friction is, for the method
    one_step: PyTree  # of the one-step scheme


class Multistep(AbstractMove):
    """A step of the method, or of the one-step scheme at the start."""

    order: int = eqx.field(static=True)

    @property
    def table(self) -> MultistepTable:
        return multistep_table(RHO[self.order])

    def _one_step(self, system: System, span: Span, data: _Data, y: State) -> Outcome:
        moves = _ONE_STEP.scheme(system).moves
        return forward(moves, system, span, data.one_step, (y, None))

    def prepare(self, system: System, span: Span) -> _Data:
        t0, _, h = span
        decay = system.split("shared").prepare(system, t0, h, self.order)
        law, friction, smooth = system.one_rate, system.friction, None
        if law is not None and friction is not None:
            if friction.is_singular(t0) is not None:
                rate, change = jax.jvp(law.rate, (t0,), (jnp.ones_like(t0),))
                # False also where it is not a number, at a singularity.
                smooth = _ROUGH * jnp.abs(change * h) <= jnp.abs(rate)
        moves = _ONE_STEP.scheme(system).moves
        return _Data(decay, smooth, prepare(moves, system, span))

    def apply(self, system: System, span: Span, data: _Data, stage: Stage) -> Outcome:
        (y, old), (t0, t1, h), table = stage, span, self.table
        split, decay = system.split("shared"), _decay(data)
        known = lax.stop_gradient(_known(data, span, old))
        starting = known < table.order - 1
        lasting = old.count > table.order - 1
        nothing = tree.zeros(old.p_lost)
        lost = old.q_lost, tree.where(lasting, nothing, old.p_lost)
        q, p = tree.to_sums(y, lost)
        # A kick by the filtered force, and a drift.
        newest = float(table.forces[0])
        kick = jtu.tree_map(lambda s, f: s[0] + newest * f, old.filter, old.force)
        z = system.add((q, old.momentum), (None, tree.scale(h, kick)))
        z = split.drift(system, t0, h, data.decay, z)

        def start(_):
            # The same from a step of the other scheme.
            (first, _), _ = self._one_step(system, span, data, (q, p))
            change = tree.sub(first[0], decay(q))
            mean = tree.scale(1 / h, split.times_mass(system, change))
            kick = tree.scale(1 / h, tree.sub(mean, decay(tree.values(old.momentum))))
            return _stack((*first, _as_sums(mean), _as_sums(kick)))

        # In the frame of the end of the step, as that of its start may not exist.
        taken = _stack((z[0], p, z[1], _as_sums(decay(kick))))
        taken = _either(starting, start, lambda taken: taken, taken)
        q, first_p, momentum, kick = _unstack(taken)
        force, B, R = decay(old.force), table.forces[1:], table.kicks[1:]

        def remember(s, force, kick):
            later = jnp.concatenate([s[1:], jnp.zeros_like(s[:1])])
            return later + (_outer(B, force) - _outer(R, kick))

        filter = jtu.tree_map(remember, decay(old.filter), force, tree.values(kick))
        force = split.force(system, t1, (q, momentum))
        p1 = self._momentum(system, t1, h, q, momentum, force, filter)
        kept = tree.where(known == table.order - 1, tree.values(p), old.p_lost)
        p_lost = tree.rounding_errors(first_p)
        p1 = tree.where(starting, (tree.values(first_p), p_lost), (p1, nothing))
        p1 = jtu.tree_map(tree.Sum, *p1)
        lost = tree.rounding_errors(q), tree.where(starting, p_lost, kept)
        # Of a history that is not used any more the end of the step knows nothing.
        dropped = (known < old.count) & (old.count >= table.order)
        new = _Carry(
            *(known + 1, cast_to(h, old.h), *lost, momentum, force, filter),
            old.dropped + jnp.where(dropped, 1, 0),
        )
        return (tree.from_sums((q, p1), y), new), None

    def undo(self, system: System, span: Span, data: _Data, stage: Stage) -> Outcome:
        (y, new), (t1, t0, h), table = stage, span, self.table
        split, decay = system.split("shared"), _decay(data)
        known = new.count - 1
        starting = known < table.order - 1
        nothing = tree.zeros(new.p_lost)
        lost = new.q_lost, tree.where(starting, new.p_lost, nothing)
        q, p = tree.to_sums(y, lost)
        z = split.drift(system, t1, h, data.decay, (q, new.momentum))
        force = split.force(system, t0, z)
        # The oldest force and kick have left the filter, so its last entry is known.
        filter, B, R = decay(new.filter), table.forces, table.kicks
        kick = jtu.tree_map(lambda s, f: float(B[-1]) * f - s[-1], filter, force)

        def forget(s, force, kick):
            s = s - (_outer(B[1:], force) - _outer(R[1:], kick))
            return jnp.concatenate([(kick - float(B[0]) * force)[None], s[:-1]])

        filter = jtu.tree_map(forget, filter, force, kick)
        _, momentum = system.add(z, (None, tree.scale(h, kick)))
        p0 = self._momentum(system, t0, -h, z[0], momentum, force, filter)
        first_step = known == table.order - 1
        p0 = tree.where(first_step, new.p_lost, p0)

        def start(_):
            # It is symmetric: a step backwards undoes it.
            (first, _), _ = self._one_step(system, span, data, (q, p))
            return _stack(first)

        taken = _stack((z[0], _as_sums(p0)))
        taken = _either(starting, start, lambda taken: taken, taken)
        q, p = _unstack(taken)
        # The rounding error of a momentum not computed by the one-step scheme is zero.
        kept = tree.where(starting | first_step, tree.rounding_errors(p), new.p_lost)
        lost = tree.rounding_errors(q), kept
        # In the steps at the start the first entry of the filter, which is not used
        # there, is not that of before.
        history = momentum, force, filter
        count, length = jnp.maximum(known, 0), cast_to(-h, new.h)
        old = _Carry(count, length, *lost, *history, new.dropped)
        return (tree.from_sums((q, p), y), old), None

    def _momentum(self, system, t, h, q, momentum, force, filter) -> PyTree:
        """The mechanical momentum at the end of a step."""
        weights = [float(w) for w in self.table.momentum]

        def gain(s, force):
            return sum(w * x for w, x in zip(weights, (*s, force), strict=True))

        gained = jtu.tree_map(gain, filter, force)
        z = tree.values(q), tree.add(tree.values(momentum), h, gained)
        return system.split("shared").leave(system, t, z)[1]


def _known(data: _Data, span: Span, carry: _Carry) -> Array:
    """The number of steps in the history, -1 where it cannot start yet."""
    t0, t1, h = span
    # Of the times of all steps so far, which were rounded where they are largest.
    largest = jnp.maximum(
        jnp.maximum(jnp.abs(t0), jnp.abs(t1)), jnp.abs(h) * carry.count
    )
    ulp = jnp.finfo(h.dtype).eps * largest
    change = jnp.abs(h - carry.h)
    same = (change <= 8 * ulp) & (change <= 1e-3 * jnp.abs(h))
    known = jnp.where(same, carry.count, 0)
    return known if data.smooth is None else jnp.where(data.smooth, known, -1)


def _decay(data: _Data) -> Callable:
    """From the frame of the start of the span to that of its end."""
    if data.decay is None:
        return lambda x: x
    return lambda x: tree.add(x, data.decay, tree.values(x))


def _outer(column: np.ndarray, x: Array) -> Array:
    return cast_to(column, x).reshape(-1, *(1,) * x.ndim) * x[None]


def _stack(sums: tuple[PyTree[tree.Sum], ...]) -> PyTree:
    """Several trees of sums as one tree of arrays."""
    leaf = lambda *x: jnp.stack([y for s in x for y in (s.value, s.lost)])
    return jtu.tree_map(leaf, *sums, is_leaf=tree.is_sum)


def _unstack(rows: PyTree) -> list[PyTree[tree.Sum]]:
    count = len(jtu.tree_leaves(rows)[0])
    pair = lambda i: jtu.tree_map(lambda x: tree.Sum(x[i], x[i + 1]), rows)
    return [pair(i) for i in range(0, count, 2)]


def _as_sums(x: PyTree) -> PyTree[tree.Sum]:
    return jtu.tree_map(lambda x: tree.Sum(x, jnp.zeros_like(x)), x)


def _either(condition: Bool[Array, ""], if_true: Callable, if_false: Callable, x: Any):
    """`lax.cond`, of which a batch mostly needs the second branch only.

    Under `vmap`, `lax.cond` alone would always compute both branches.
    """
    some = lambda x: lax.cond(condition, if_true, if_false, x)
    return lax.cond(eqxi.unvmap_any(condition), some, if_false, x)


class SymmetricMultistep(AbstractPresymplecticSolver):
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

    In the frame that positions and momenta share, $q = e^{-\eta / 2} x$, where friction
    is a force, a step is a kick and a drift. The kick is by a filtered force: a linear
    combination of the last forces and kicks. It is the method
    $\sum_j \alpha_j x_{n+j} = h^2 \sum_j \beta_j x''_{n+j}$ written for increments,
    which are summed with compensation, so that rounding errors are those of the force.
    The momentum at a step is computed from the same history to the same order, and is
    not fed back.

    The first `order - 1` steps, each step of another length than the one before it, the
    steps after a jump and those close to a singularity of the friction are steps of
    [`diffrax_presym.BlanesCasasRKN8`][], of 19 evaluations. So no force is evaluated
    outside of the steps. Each step is reversible to rounding, and
    [`diffrax_presym.FixedStepAdjoint`][] takes its gradient, but with an error refuses
    to go back through a change of the step after the first `order - 1` steps.

    ??? cite "Reference"

        ```bibtex
        @article{quinlan1990symmetric,
            author={Quinlan, Gerald D. and Tremaine, Scott},
            title={Symmetric multistep methods for the numerical integration of
                planetary orbits}, journal={The Astronomical Journal}, volume={100},
            number={5}, pages={1694--1700}, year={1990}}
        @misc{quinlan1999resonances,
            author={Quinlan, Gerald D.},
            title={Resonances and instabilities in symmetric multistep methods},
            year={1999}, eprint={astro-ph/9901136}, archivePrefix={arXiv}}
        ```
    """

    multistep_order: int = eqx.field(static=True)

    def __init__(self, order: int = 8):
        r"""**Arguments:**

        - `order`: 8, 10 or 12. Defaults to 8, which allows the longest steps; below
            errors of 1e-5 orders 10 and 12 are often faster. The coefficients of orders
            8 and 10 are of this package, from `benchmarks/multistep.py`; those of order
            12 of Quinlan and Tremaine (1990).

        **Raises:**

        `ValueError` if the order is not one of these, and when the solve is traced if
        the system has no constant mass, or friction without a smooth rate.
        """
        if type(order) is not int or order not in RHO:
            instead = "Write `SymmetricMultistep(8)`, for example."
            if type(order) is int and order < 8:
                instead = "For lower orders use `BlanesMoanRKN4()` or `TunedRKN6()`."
            raise ValueError(
                "`SymmetricMultistep(order)` must be 8, 10 or 12, but got "
                f"{order!r}. {instead}"
            )
        self.multistep_order = order

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return self.multistep_order

    def scheme(self, system: System) -> Scheme:
        find_split(self, "shared", system)
        count = self.multistep_order - 2

        def start(system: System, t: Array, y: State) -> _Carry:
            nothing = tree.zeros(y[1])
            many = lambda x: jnp.zeros((count, *x.shape), x.dtype)
            zero = jnp.zeros((), jnp.result_type(t))
            history = _as_sums(nothing), nothing, jtu.tree_map(many, nothing)
            return _Carry(zero, zero, nothing, nothing, *history, zero)

        def between(system: System, t0: Array, start: Point, t: Array) -> State:
            # A shorter step is always one of the one-step scheme.
            span = Span(t0, t, t - t0)
            scheme = _ONE_STEP.scheme(system)
            return advance(scheme, system, span, (start[0], None))[0][0]

        return Scheme(
            Multistep(self.multistep_order),
            start=start,
            between=between,
            undoable=lambda start, end: start.dropped == end.dropped,
            not_composable=(
                "Compositions of unequal steps are not possible with "
                "`SymmetricMultistep`, which has the order of its table and needs "
                "equal steps. Compose `PresymplecticLeapfrog()` instead."
            ),
        )
