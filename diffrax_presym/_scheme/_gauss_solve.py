"""The solution of the equations of the stages of Gauss collocation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, Inexact, PyTree, Shaped

from .. import _tree as tree
from .._friction._linear import Effects
from .._implicit import largest_change, lowest
from .._numbers import cast_to, Scalar, State
from .._results import NOT_CONVERGED, ROOT_NOT_FOUND
from .._system._bound import System
from ._collocation import gauss_table
from ._engine import Span


# Velocities and forces of all stages, times weight and length of the step, the forces
# in the frame of its middle.
Slopes = PyTree[Shaped[Array, "stages ..."]]
# Positions and momenta of all stages, in that frame.
StageValues = PyTree[Shaped[Array, "stages ..."]]


class Frames(NamedTuple):
    """The decays of momenta between the frames of a step; `None` without friction."""

    to_middle: Effects  # from the start
    from_middle: Effects  # to the end
    whole: Effects
    inwards: Effects  # from each stage to the middle
    outwards: Effects  # from the middle to each stage
    share: Scalar  # of the friction that the frames move with


class GaussStep(eqx.Module):
    """The equations of the stages of one step."""

    number: int = eqx.field(static=True)
    base: State  # the state at the start, in the frame of the middle
    base_lost: State
    h: Array
    # Of positions and momenta, in this frame, the last also of velocities.
    slopes: Callable[..., Slopes]
    velocities: Callable[..., PyTree]
    forces: Callable[..., PyTree]

    def __init__(
        self,
        system: System,
        number: int,
        frames: Frames | None,
        span: Span,
        base: State,
        base_lost: State,
    ):
        table, t0, h = gauss_table(number), span.t0, span.h
        both = (None, None) if frames is None else (frames.outwards, frames.inwards)
        self.number, self.h, self.base, self.base_lost = number, h, base, base_lost
        rest = None
        if frames is not None and system.friction is not None:
            rest = system.friction.scaled(1 - frames.share)

        def net(t, weight, both, p, force):
            if rest is not None:
                force = rest.net_force(t, force, p)
            return tree.scale(weight, system.move_frame(both[1], force))

        def slope(t, weight, both, q, p):
            p = system.move_frame(both[0], p)
            velocity, force = system.velocity_and_force(t, (q, p))
            return tree.scale(weight, velocity), net(t, weight, both, p, force)

        def velocity(t, weight, both, q, p):
            p = system.move_frame(both[0], p)
            return tree.scale(weight, system.velocity(t, (q, p)))

        def force(t, weight, both, q, p, v):
            p = system.move_frame(both[0], p)
            v = tree.scale(1 / jnp.where(weight == 0, 1, weight), v)
            return net(t, weight, both, p, system.force_at(t, (q, p), v))

        times, weights = t0 + cast_to(table.nodes, h) * h, cast_to(table.weights, h) * h

        # Traced once, with all that it depends on, to be differentiated.
        def convert(one, *state):
            many = lambda x: jnp.broadcast_to(x, (number, *x.shape))
            of_all = lambda *state: jax.vmap(one)(times, weights, both, *state)
            return eqx.filter_closure_convert(of_all, *jtu.tree_map(many, state))

        self.slopes, self.velocities = convert(slope, *base), convert(velocity, *base)
        self.forces = convert(force, *base, base[0])

    def stages(self, slopes: Slopes) -> StageValues:
        q, p = slopes
        return self._stages(0, q), self._stages(1, p)

    def _stages(self, i: int, slopes: PyTree) -> PyTree:
        mu = gauss_table(self.number).mu

        def leaf(y, lost, x):
            # Before and after the product, or XLA computes an entry again for each use.
            x = matrix_product(mu, lax.optimization_barrier(x))
            # Add the small terms first.
            return lax.optimization_barrier(y[None] + (lost[None] + x))

        return jtu.tree_map(leaf, self.base[i], self.base_lost[i], slopes)

    def iterate(
        self, slopes: Slopes, stages: StageValues
    ) -> tuple[Slopes, StageValues]:
        """Better slopes and stages: momenta by the forces, then positions by the
        velocities at these, which halves the iterations."""
        q, p = stages
        forces = self.forces(q, p, slopes[0])
        p = self._stages(1, forces)
        velocities = self.velocities(q, p)
        return (velocities, forces), (self._stages(0, velocities), p)

    def residual(self, slopes: Slopes) -> Slopes:
        return tree.sub(self.slopes(*self.stages(slopes)), slopes)


def matrix_product(matrix, x):
    # A sum, which XLA fuses with what is around it, unlike its products of matrices.
    matrix = cast_to(matrix, x)
    return jnp.sum(
        matrix.reshape(*matrix.shape, *(1,) * (x.ndim - 1)) * x[None], axis=1
    )


class _Search(NamedTuple):
    """The state of a fixed-point iteration."""

    stages: StageValues
    slopes: Slopes
    # One array, as XLA would make a kernel for each number. Changes are those of the
    # stages, in units of their rounding.
    record: Inexact[Array, "9"]


# The entries of the record.
_STATUS = 0  # of the search, one of the following
_GOING, _CONVERGED, _FAILED = 0, 1, 2
_COUNT = 1  # of iterations
_LAST, _BEFORE = 2, 3  # change, and the one before
_LEAST = 4  # change so far
_STALLED = 5  # consecutive iterations without a smaller change
_FRESH = 6  # whether it was restarted without a guess
_POSITIONS, _MOMENTA = 7, 8  # last change of each, by the rounding of its largest entry


# Largest estimated change of another iteration, in units of rounding, to stop.
_NEGLIGIBLE = 1e-3
# Largest change at which stagnation is attributed to rounding.
_ROUNDING = 16.0


def fixed_point(max_iterations: int, tolerance: float, step: GaussStep, guess: Slopes):
    """Fixed-point iteration, to rounding unless a tolerance is given.

    It stops when its changes no longer decrease. The remaining error is rounding, of
    either sign; that of a larger tolerance breaks the symmetry.

    Rounding of a large entry may change a small one by more than its own rounding, such
    as the momentum of a spring at rest far from the origin. Changes that stagnate are
    therefore rounding too if positions, or momenta, are the same to the rounding of the
    largest of them, in two iterations: these may change alternately.
    """
    dtype = step.h.dtype
    number = lambda x: jnp.asarray(x, dtype)
    nothing = jtu.tree_map(jnp.zeros_like, guess)
    eps = float(jnp.finfo(lowest(guess)).eps)
    negligible = max(_NEGLIGIBLE, tolerance / eps)

    def iterate(search: _Search) -> _Search:
        _, count, last, before, least, stalled, fresh, *both = search.record
        slopes, stages = step.iterate(search.slopes, search.stages)
        change = largest_change(stages, search.stages, dtype)
        moved = [
            (tree.largest(tree.sub(x, y)) / (eps * tree.largest(x))).astype(dtype)
            for x, y in zip(stages, search.stages, strict=True)
        ]
        rate = jnp.maximum(change / last, last / before)
        stalled = jnp.where(change < least, 0, stalled + 1)
        settled = jnp.minimum(*map(jnp.maximum, moved, both)) <= 1
        converged = (
            (change == 0)
            | (rate * change <= negligible)
            | ((stalled > 0) & (jnp.maximum(change, last) <= _ROUNDING))
            | ((stalled >= 3) & settled)
        )
        # A guess may be outside of the domain although the state is inside.
        finite = jnp.isfinite(change)
        restart = ~finite & (fresh == 0)
        failed = jnp.where(finite | restart, _GOING, _FAILED)
        status = jnp.where(converged, _CONVERGED, failed)
        least = jnp.minimum(change, least)
        start = lambda x, y: jtu.tree_map(lambda x, y: jnp.where(restart, x, y), x, y)
        entries = start(
            [_GOING, count + 1, 0, 0, jnp.inf, 0, 1, jnp.inf, jnp.inf],
            [status, count + 1, change, last, least, stalled, fresh, *moved],
        )
        record = jnp.stack([number(x) for x in entries])
        stages, slopes = start((step.stages(nothing), nothing), (stages, slopes))
        return _Search(stages, slopes, record)

    def going(search: _Search):
        record = search.record
        return (record[_STATUS] == _GOING) & (record[_COUNT] < max_iterations)

    record = np.zeros(9)
    record[[_LEAST, _POSITIONS, _MOMENTA]] = np.inf
    search = _Search(step.stages(guess), guess, number(record))
    search = lax.while_loop(going, iterate, search)
    results: Any = dfx.RESULTS
    converged = search.record[_STATUS] == _CONVERGED
    return search.slopes, results.where(converged, results.successful, NOT_CONVERGED)


def by_root_finder(
    root_finder: optx.AbstractRootFinder,
    max_steps: int,
    step: GaussStep,
    guess: Slopes,
):
    # Extrapolation of stiff components may be inaccurate.
    sizes = (tree.largest(step.residual(x)) for x in (guess, tree.zeros(guess)))
    better = jnp.less(*sizes)
    guess = jtu.tree_map(lambda x: jnp.where(better, x, 0), guess)
    residual = lambda slopes, _: step.residual(slopes)
    options = {"max_steps": max_steps, "throw": False}
    solution = optx.root_find(residual, root_finder, guess, **options)
    found = solution.result == optx.RESULTS.successful
    results: Any = dfx.RESULTS
    return solution.value, results.where(found, results.successful, ROOT_NOT_FOUND)
