"""Symmetric multistep methods."""

import operator
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Inexact, PyTree

from .. import _tree as tree
from .._compositions import mirror
from .._numbers import cast_to, State
from .._results import MULTISTEP_UNSTABLE, OTHER_HISTORY
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, Scheme
from ._engine import AbstractMove, forward, Outcome, Span, StepState
from ._find_split import find_split
from ._prepare import prepare
from ._splitting import BlanesCasasRKN8


class MultistepTable(NamedTuple):
    """A method as a filter of forces, in the order from the newest to the oldest.

    `ρ(z) = (z - 1)^2 R(z)`, so that a step is a kick and a drift, with a kick `a_n`
    that is a filtered force: `Σ_i R_i a_{n-i} = Σ_i σ_{i+1} g_{n-i}`.
    """

    forces: tuple[float, ...]  # sigma, without its two zeros
    kicks: tuple[float, ...]  # R
    # The momentum at a step less its mean over the step, divided by the length of the
    # step: from the state of the filter and the newest force.
    momentum: tuple[float, ...]


# `benchmarks/multistep.py`. Few steps resonate or are unstable on Kepler orbits.
_TABLES = {
    8: MultistepTable(
        mirror(
            *(1.526021262639387, -0.9721002873134881),
            *(5.67654076170947, -3.226897119550738),
        ),
        mirror(1.0, 0.9931, 1.78042878, 1.68696879452),
        (
            -0.011430731336082377,
            *mirror(0.16305503063921867, 0.12675577521022127, 0.14679720288248382),
            0.30673520799443355,
        ),
    ),
    10: MultistepTable(
        mirror(
            *(1.601815111786648, -2.828109681370836, 9.31132817790303),
            *(-13.412873894912394, 18.154766233313925),
        ),
        mirror(1.0, 0.2082, 1.21238771, 0.660218827938, 1.3374725842508208),
        (
            0.04898943780758026,
            *mirror(
                *(0.179202501435868, 0.16024525694963412),
                *(0.16746384302176753, 0.1627823110573822),
            ),
            0.2952298626462146,
        ),
    ),
}
# Over a step, by order. Of an oscillator with step times frequency 0.01, which friction
# slows down, the rate is then right to one digit; its error does not decrease with it.
_MOST_FRICTION = {8: 1.07, 10: 1.23}
# The scheme of the first steps, and of steps of another length.
_ONE_STEP = BlanesCasasRKN8()


class _Carry(NamedTuple):
    """The solver state: the history, in the frame of the end of the last step."""

    steps: Inexact[Array, ""]  # of one length so far; a float, as all leaves are
    h: Inexact[Array, ""]  # that of the first of them, zero if there was no step
    momentum: PyTree  # the mean over the last step
    force: PyTree
    filter: PyTree[Inexact[Array, "lags ..."]]  # the state of the filter of forces


class Multistep(AbstractMove):
    """A step of the method, or of the one-step scheme if the history is too short."""

    order: int = eqx.field(static=True)

    def prepare(self, system: System, span: Span) -> PyTree:
        decay = system.split("shared").prepare(system, span.t0, span.h, self.order)
        return decay, prepare(_ONE_STEP.scheme(system).moves, system, span)

    def is_autonomous(self, system: System) -> bool:
        return system.prepares_once

    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        (y, old), (t0, t1, h), table = stage, span, _TABLES[self.order]
        (decay, data), split = data, system.split("shared")
        # From the frame of the start of the step to that of its end.
        move = lambda x: x if decay is None else tree.add_scaled(x, decay, x)
        steps, length = _steps(span, old)
        is_short = steps < self.order - 1

        def one_step(y: State) -> tuple[PyTree, PyTree]:
            """The kick that takes the position where a step of the other scheme takes
            it, and the change of the momentum in that."""
            moves, y = _ONE_STEP.scheme(system).moves, tree.to_sums(y, tree.zeros(y))
            (end, _), _ = forward(moves, system, span, data, (y, None))
            free, _ = split.drift(system, t0, h, decay, (y[0], old.momentum))
            kick = system.term.kinetic.momentum(tree.sub(end[0], free))
            kick = tree.scale(1 / (h * h * move(jnp.ones_like(h))), kick)
            return kick, tree.sub(end[1], y[1])

        # A batch computes it if one of its members needs it.
        zeros = lambda y: (tree.zeros(y[1]), tree.zeros(y[1]))
        kick, gained = lax.cond(eqxi.unvmap_any(is_short), one_step, zeros, y)
        add = lambda s, f: s[0] + table.forces[0] * f
        kick = tree.where(is_short, kick, jtu.tree_map(add, old.filter, old.force))
        z = system.add((y[0], old.momentum), (None, tree.scale(h, kick)))
        q, momentum = split.drift(system, t0, h, decay, z)

        def remember(s, force, kick):
            later = jnp.concatenate([s[1:], jnp.zeros_like(s[:1])])
            return later + _outer(table.forces, force) - _outer(table.kicks, kick)

        history = map(move, (old.filter, old.force, kick))
        filter = jtu.tree_map(remember, *history)
        force = split.force(system, t1, (q, momentum))
        end = self._momentum(system, t1, h, q, momentum, (filter, force))
        change = tree.where(is_short, gained, tree.sub(end, tree.values(y[1])))
        _, p = system.add(y, (None, change))
        new = _Carry(steps + 1, length, momentum, force, filter)
        return ((q, p), new), None

    def undo(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        raise NotImplementedError  # The history before a change of length is lost.

    def _momentum(
        self, system: System, t: Array, h: Array, q: PyTree, mean: PyTree, history
    ) -> PyTree:
        """The momentum at the end of a step, from its mean over the step."""
        coefficients = _TABLES[self.order].momentum
        weigh = lambda s, f: sum(map(operator.mul, coefficients, (*s, f)))
        end = tree.add_scaled(tree.values(mean), h, jtu.tree_map(weigh, *history))
        return system.split("shared").leave(system, t, (tree.values(q), end))[1]

    def check(self, system: System, t: Array, y: State, carry: _Carry) -> dfx.RESULTS:
        """A failure if the history is not that of the state, or if it alternates."""
        (q, p), h = system.values(y), jnp.abs(carry.h)
        # As velocities and accelerations, where light bodies count beside heavy ones.
        size = lambda p: tree.largest(system.velocity(t, (q, p)))
        mean, force = map(system.values, (carry.momentum, carry.force))
        eps = max(float(jnp.finfo(x.dtype).eps) for x in jtu.tree_leaves(p))
        end = self._momentum(system, t, carry.h, q, mean, (carry.filter, force))
        rounding = jnp.minimum(8 * eps * jnp.abs(t), 1e-3 * h)
        with jax.numpy_dtype_promotion("standard"):
            # The momentum is computed from the history, but for the first steps.
            least = eps**0.5 * (size(p) + size(end)) + 2 * rounding * size(force)
            other = (carry.steps >= self.order) & (size(tree.sub(p, end)) > least)
            # A kick is the mean of the force over about a step. Where the method is
            # unstable both alternate from step to step, and a kick is at least 1.5
            # times the force. Where a force passes through zero the momentum does not.
            next_kick = lambda s, f: s[0] + _TABLES[self.order].forces[0] * f
            kick = jtu.tree_map(next_kick, carry.filter, force)
            least = (h**2 * (size(kick) + size(force)) + h * size(mean)) / 6
            least += eps**0.5 * tree.largest(q)
            unstable = h**2 * size(tree.sub(kick, force)) > least
        unstable &= carry.steps >= self.order - 1
        success: Any = dfx.RESULTS.successful
        result = dfx.RESULTS.where(unstable, MULTISTEP_UNSTABLE, success)
        return dfx.RESULTS.where(other, OTHER_HISTORY, result)


def _outer(column: tuple[float, ...], x: Array) -> Array:
    """All but the first of a column, times an array."""
    return cast_to(np.array(column[1:]), x).reshape(-1, *(1,) * x.ndim) * x[None]


def _steps(span: Span, carry: _Carry) -> tuple[Array, Array]:
    """How many steps had the length of this one, but for the rounding of times; and the
    length of the first of them."""
    h = jnp.abs(span.h)
    largest = jnp.abs(span.t0) + h * carry.steps
    rounding = 8 * float(jnp.finfo(h.dtype).eps) * largest
    same = jnp.abs(span.h - carry.h) <= jnp.minimum(rounding, 1e-3 * h)
    first = same & (carry.steps > 0)
    return jnp.where(same, carry.steps, 0), jnp.where(first, carry.h, span.h)


class SymmetricMultistep(AbstractPresymplecticSolver):
    """A symmetric multistep method: high order with one force evaluation per step.

    8th or 10th order. One force evaluation per step. The first `order - 1` steps, and
    as many after a jump or a change of the length of the steps, are steps of
    `BlanesCasasRKN8`, of 19 evaluations; their order is 8, and their error far below
    that of the method. Dense/ts output in Diffrax's own loop takes three of them in
    each step; that of `FixedStepAdjoint` none.

    For a `QuadraticKinetic`, any potential and at most one constant rate of friction,
    with steps of one length, at errors of 1e-6 and less: where the force is most of the
    cost and no frequency is much higher than the others, as for planets and molecules.
    Not for stiff springs next to soft ones, strong friction, steps that vary, nor for
    few unknowns and cheap forces, for which `TunedRKN6` is faster.

    Symmetric, but not symplectic: the error in the energy stays small over long times
    if the motion is regular and the step is short enough (Hairer, Lubich and Wanner,
    chapter XV). It is stable for a step times the highest frequency below 0.63 at order
    8 and 0.48 at order 10, but on eccentric orbits not at all steps below that: not
    with 24 to the period at an eccentricity of 0.2. Beyond, forces alternate from step
    to step, more and more: a solve that ends so fails. At some steps the method
    resonates with the motion: if half the step does not reduce the error as the order
    says, change it by some per cent. A `solver_state` that is not that of `y0` makes a
    solve fail too. A step has no inverse: `FixedStepAdjoint` takes the gradient by
    checkpoints, for which it needs `max_steps`.

    With half of the friction taken out of positions and half out of momenta,
    `q = exp(-γ t / 2) x`, friction is a force, and errors grow with the distance from
    the origin. A step is a kick, by a weighted sum of the last forces and kicks, and a
    drift: the method `Σ_j α_j x_{n+j} = h^2 Σ_j β_j x''_{n+j}` written for increments.
    The momentum at a step is computed from the same history.

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
        """**Arguments:**

        - `order`: 8 or 10. Defaults to 8, which allows the longest steps; with 90 steps
            or more to the shortest period, 10 is more accurate. The coefficients are of
            this package, `benchmarks/multistep.py`.

        **Raises:**

        `ValueError` if the order is not one of these, and when the solve is traced if
        the mass is not constant or friction is not at one constant rate.
        """
        if type(order) is not int or order not in _TABLES:
            raise ValueError(
                f"`SymmetricMultistep(order)` must be 8 or 10, but got {order!r}. At "
                "other orders use `BlanesMoanRKN4()` or `TunedRKN6()`."
            )
        self.multistep_order = order

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return self.multistep_order

    def scheme(self, system: System) -> Scheme:
        find_split(self, "shared", system)

        def start(system: System, t: Array, y: State) -> _Carry:
            zero, lags = jnp.zeros((), jnp.result_type(t)), self.multistep_order - 2
            none = tree.zeros(y[1])
            many = jtu.tree_map(lambda x: jnp.zeros((lags, *x.shape), x.dtype), none)
            momentum = jtu.tree_map(jnp.zeros_like, y[1])
            return _Carry(zero, zero, momentum, none, many)

        move = Multistep(self.multistep_order)
        return Scheme(
            move,
            start=start,
            check=move.check,
            most_friction=_MOST_FRICTION[self.multistep_order],
            is_invertible=False,
            has_history=True,
            not_composable=(
                "Compositions of unequal steps are not possible with "
                "`SymmetricMultistep`, which needs steps of one length. Compose "
                "`PresymplecticLeapfrog()` instead."
            ),
        )
