"""The solution within a step of Gauss collocation.

The polynomial of a step with s stages meets the solution at the end of the step to
order 2s, but only to order s + 1 within. So it is the first guess of that with 2s
stages, which has the order of the scheme everywhere, and of which each fixed-point
iteration gains an order.
"""

import functools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._misc import cast_to, tree_sub
from .._split import State
from .._system import System
from ._collocation import gauss_table, legendre
from ._engine import Span
from ._extension import AbstractExtension, blend, combine, fraction
from ._gauss_step import contract, GaussStep, implicit, Slopes


class _Segment(NamedTuple):
    """The solution within a step, in the frame of its middle."""

    start: State
    # Stacked: the Legendre coefficients of its derivative, and what their integrals
    # miss at the end.
    sources: PyTree


class GaussExtension(AbstractExtension):
    """The continuous extension of Gauss collocation by fixed-point iteration."""

    def __init__(self, stages: int):
        self.stages = stages
        self.table = gauss_table(2 * stages)
        # Errors between steps are then of the order of those of a step.
        self.iterations = max(4, stages)

    @property
    def evaluations(self) -> int:
        """The evaluations of velocity and force for a step."""
        return len(self.table.nodes) * self.iterations

    def recorded(self, y: State, carry) -> tuple[PyTree, tuple[State, Slopes]]:
        return carry, (y, carry.slopes)

    def segment(
        self, system: System, span: Span, y: State, record: tuple[State, Slopes]
    ) -> _Segment:
        y, (end, slopes) = system.values(y), record
        step_of = lambda table: GaussStep(
            system, table, span.t0, span.h, y, system.zeros(y)
        )
        # They are the solution already, and only get its derivatives.
        coarse, found = step_of(gauss_table(self.stages)), dfx.RESULTS.successful
        slopes, _ = implicit(coarse, lambda slopes: (slopes, found), slopes, contract)
        step = step_of(self.table)
        iterate = lambda _, slopes: step.slopes(step.stages(slopes))
        guess = combine(_finer(self.stages), slopes)
        slopes = jax.lax.fori_loop(0, self.iterations, iterate, guess)
        half = cast_to(0.5, span.h) * span.h
        end = end[0], system.move_frame(span.t1, -half, end[1])
        gained = jtu.tree_map(lambda x: jnp.sum(x, axis=0), slopes)
        missed = tree_sub(tree_sub(end, step.base), gained)
        join = lambda x, last: jnp.concatenate([x, last[None]])
        sources = jtu.tree_map(join, combine(self.table.project, slopes), missed)
        return _Segment(step.base, sources)

    def at(self, system: System, span: Span, segment: _Segment, t: Array) -> State:
        s = fraction(span, t)
        number = len(self.table.nodes)
        values = legendre(number + 1, 2 * s - 1)
        integrals = [s] + [
            (values[k + 1] - values[k - 1]) / (4 * k + 2) for k in range(1, number)
        ]
        weights = jnp.stack([*integrals, blend(s)])
        q, p = jtu.tree_map(jnp.add, segment.start, combine(weights, segment.sources))
        middle = span.t0 + span.h / 2
        return q, system.move_frame(middle, t - middle, p)


@functools.cache
def _finer(stages: int) -> np.ndarray:
    """From the slopes of so many stages to those of twice as many, on the same
    polynomial."""
    coarse, fine = gauss_table(stages), gauss_table(2 * stages)
    values = np.stack(legendre(max(2, stages), 2 * fine.nodes - 1)[:stages])
    return fine.weights[:, None] * (values.T @ coarse.project)
