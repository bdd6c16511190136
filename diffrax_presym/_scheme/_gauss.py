"""Gauss collocation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Inexact, PyTree

from .. import _tree as tree
from .._checks import check_root_finder
from .._implicit import contract, implicit, solve_linear
from .._numbers import cast_to, State
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, refuse_constrained, Scheme
from ._collocation import gauss_table, legendre, MAX_STAGES
from ._engine import AbstractMove, Outcome, Span, StepState
from ._gauss_solve import (
    by_root_finder,
    fixed_point,
    Frames,
    GaussStep,
    matrix_product,
    Slopes,
)


class _Carry(NamedTuple):
    """The solver state."""

    lost: State  # the rounding error of the state so far
    slopes: Slopes  # of the last step, for the initial guess
    h: Inexact[Array, ""]  # the length of the last step, zero if there was none


class Collocation(AbstractMove):
    """A step of Gauss collocation. Backwards in time it is its own inverse."""

    number: int = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder | None
    max_iterations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def prepare(self, system: System, span: Span) -> Frames | None:
        if system.friction is None:
            return None
        (t0, _, h), nodes = span, cast_to(gauss_table(self.number).nodes, span.h)
        half, to_middle = h / 2, (cast_to(0.5, h) - nodes) * h
        middle = t0 + half
        starts, lengths = jnp.stack([t0, middle, t0]), jnp.stack([half, half, h])
        repeat = jnp.broadcast_to(middle, nodes.shape)
        starts = jnp.concatenate([starts, t0 + nodes * h, repeat])
        lengths = jnp.concatenate([lengths, to_middle, -to_middle])
        friction = system.friction
        # Frames that move with more of it grow exponentially over a step, which
        # polynomials do not follow. The rest of it is part of the force.
        limit, strength = min(1.0, self.number / 2), friction.strength(t0, h)
        share = jnp.where(strength > limit, limit / jnp.maximum(strength, limit), 1)
        friction = friction.scaled(share)
        decays = jax.vmap(lambda t, h: friction.prepare(t, h, 1))(starts, lengths)
        (effects,) = friction.fix([decays])
        rows = lambda rows: jtu.tree_map(lambda x: x[rows], effects)
        inwards, outwards = slice(3, 3 + len(nodes)), slice(3 + len(nodes), None)
        both = rows(inwards), rows(outwards)
        return Frames(rows(0), rows(1), rows(2), *both, share)

    def is_autonomous(self, system: System) -> bool:
        return system.prepares_once

    def apply(
        self, system: System, span: Span, data: Frames | None, stage: StepState
    ) -> Outcome:
        y, carry = stage
        sums = tree.to_sums(y, carry.lost)
        values, lost = system.values(sums), tree.rounding_errors(sums)
        to_middle = None if data is None else data.to_middle
        move = lambda y: (y[0], system.move_frame(to_middle, y[1]))
        step = GaussStep(system, self.number, data, span, move(values), move(lost))
        slopes, result = self._solve(step, self._guess(system, data, span, carry))
        sums = system.add(sums, _change(system, data, slopes, values[1]))
        # The solution depends on none of it, except by rounding.
        h = cast_to(span.h, carry.h)
        carry = lax.stop_gradient(_Carry(tree.rounding_errors(sums), slopes, h))
        return (tree.from_sums(sums, y), carry), result

    undo = apply  # of the reversed span

    def _guess(
        self, system: System, data: Frames | None, span: Span, carry: _Carry
    ) -> Slopes:
        """The slopes of the last step, extrapolated; zero if there was none."""
        table, (q, p) = gauss_table(self.number), carry.slopes
        known = carry.h != 0
        ratio = span.h / jnp.where(known, carry.h, 1)
        # Do not extrapolate far beyond the last step.
        ratio = jnp.where(jnp.abs(ratio) < 2, ratio, 0)
        nodes = cast_to(table.nodes, ratio)
        ahead = jnp.stack(legendre(max(2, len(nodes)), 1 + 2 * ratio * nodes))
        weights = ratio * cast_to(table.weights, ratio)
        project = cast_to(table.project, ratio)
        matrix = weights[:, None] * matrix_product(ahead[: len(nodes)].T, project)
        if data is not None:
            # Backwards in time the slopes are those of this step.
            # About the decay from the middle of the last step.
            moved = jax.vmap(lambda p: system.move_frame(data.whole, p))(p)
            p = tree.where(ratio > 0, moved, p)
        guess = jtu.tree_map(lambda x: matrix_product(matrix, x), (q, p))
        return tree.where(known, guess, tree.zeros(guess))

    def _solve(self, step: GaussStep, guess: Slopes):
        if self.root_finder is None:
            limits = self.max_iterations, self.tolerance
            find, tangent = eqx.Partial(fixed_point, *limits), contract
        else:
            find = eqx.Partial(by_root_finder, self.root_finder, self.max_iterations)
            how = lx.AutoLinearSolver(well_posed=True)
            tangent = eqx.Partial(solve_linear, solver=how)
        return implicit(step, guess, find=find, tangent=tangent)


def _change(
    system: System, data: Frames | None, slopes: Slopes, p0: PyTree
) -> tuple[PyTree, PyTree]:
    """The change of the state over the step."""
    q, p = jtu.tree_map(lambda x: jnp.sum(x, axis=0), slopes)
    if data is None or system.friction is None:
        return q, p
    p = system.move_frame(data.from_middle, p)
    return q, jtu.tree_map(jnp.add, p, system.friction.decay(data.whole, p0))


class PresymplecticGauss(AbstractPresymplecticSolver):
    r"""Gauss collocation, in the frame that moves with the momentum.

    Order 2 to 16, twice the number of stages, and symmetric. Implicit for every
    Hamiltonian: a step takes one evaluation of velocity and force for all stages at
    once, by `jax.vmap`, in each of 3 to 20 iterations. Uses Hermite interpolation for
    dense/ts output, in Diffrax's own loop at the cost of up to seven more steps.

    For energies that are neither separable nor split, and for mechanics with a mass
    matrix, `LagrangianSystem`. Conformally symplectic to rounding: with friction of log
    scale `η` the Jacobian of a step satisfies `J^T Ω J = exp(η(t0) - η(t1)) Ω`. All
    quadratic invariants are preserved too. Six to eight stages and long steps for
    errors of 1e-9 and less. Separable and split systems have explicit schemes, which
    cost less.

    The iteration stops when its changes no longer decrease, so that the remaining error
    is rounding without a preferred sign, and the state is updated by compensated
    summation: over long times the energy error is a random walk of rounding errors. The
    `solver_state` holds the rounding error of the sum and the slopes of the last step,
    which are extrapolated to give the initial guess of the next.

    The fixed-point iteration, the default, converges for a step times the largest
    frequency of the system below about one to two. A step for which it does not
    converge fails with a `RESULTS`. For stiff energies pass a root finder.

    Friction of more than 1 over a step, the rate times its length (1/2 for one stage),
    is divided: the frame moves with that much of it, the rest is part of the force.
    Order and symmetry are kept, and errors of positions and of slow motion stay small
    for any strength; a momentum that friction stops at once is lost within a few steps.
    But the step is no longer conformally symplectic to rounding, and from a strength of
    about 4 on it needs a root finder.

    Derivatives are those of the implicit function, not of the iterations, in forward
    and in reverse mode; `FixedStepAdjoint` takes gradients in constant memory.

    ??? cite "Reference"

        Section II.1.3 and chapter VIII of Hairer, Lubich and Wanner, see the
        references. Stopping rule, coefficients and sums are after

        ```bibtex
        @article{antonana2017reducing,
            author={Anto{\~n}ana, Mikel and Makazaga, Joseba and Murua, Ander},
            title={Reducing and monitoring round-off error propagation for symplectic
                implicit {R}unge--{K}utta schemes}, journal={Numerical Algorithms},
            volume={76}, number={4}, pages={861--880}, year={2017}}
        @article{hairer2008achieving,
            author={Hairer, Ernst and McLachlan, Robert I. and Razakarivony, Alain},
            title={Achieving {B}rouwer's law with implicit {R}unge--{K}utta methods},
            journal={BIT Numerical Mathematics}, volume={48}, number={2},
            pages={231--243}, year={2008}}
        ```

        and the evaluation of all stages at once after

        ```bibtex
        @misc{antonana2025simd,
            author={Anto{\~n}ana, Mikel and Makazaga, Joseba and Murua, Ander},
            title={{SIMD}-vectorized implicit symplectic integrators can outperform
                explicit symplectic ones}, year={2025}, eprint={2511.03655},
            archivePrefix={arXiv}}
        ```
    """

    stages: int = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder | None
    max_iterations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        stages: int = 4,
        root_finder: optx.AbstractRootFinder | None = None,
        max_iterations: int = 100,
        tolerance: float = 0.0,
    ):
        """**Arguments:**

        - `stages`: the number of stages, 1 to 8; the order is twice as high. Defaults
            to 4. One stage is the implicit midpoint rule.
        - `root_finder`: an Optimistix root finder for the equations of the stages, for
            example `optimistix.Newton(rtol=1e-10, atol=1e-10)`, which solves a dense
            linear system of all stages. Its tolerances bound how well the structure is
            preserved. Defaults to `None`, fixed-point iteration to rounding.
        - `max_iterations`: the most iterations a step may take, of fixed-point
            iteration or root finder. Defaults to 100.
        - `tolerance`: the relative change of the stages below which the fixed-point
            iteration may end, a Python float. Symmetry and structure are then kept to
            this tolerance only, and so are steps that `FixedStepAdjoint` takes
            backwards. Over a few periods a hundredth of the error that is wanted
            saves up to two thirds of the iterations; over hundreds the errors of the
            steps add up. Defaults to 0, for iteration to rounding.

        **Raises:**

        `ValueError` if a number is out of range, or `root_finder` of the wrong kind. A
        step whose iteration does not converge, or leaves the finite numbers, makes the
        solve fail with a result whose message says what to change.
        """
        _check_number(stages, MAX_STAGES, "`PresymplecticGauss(stages)`")
        if root_finder is not None:
            check_root_finder(root_finder)
        self.stages = stages
        self.root_finder = root_finder
        _check_number(max_iterations, None, "`PresymplecticGauss(max_iterations=...)`")
        self.max_iterations = max_iterations
        if not (isinstance(tolerance, float | int) and 0 <= tolerance < 1):
            raise ValueError(
                "`PresymplecticGauss(tolerance=...)` must be a Python float of at "
                f"least 0 and less than 1, but got {tolerance!r}."
            )
        if tolerance and root_finder is not None:
            raise ValueError(
                "`PresymplecticGauss(root_finder, tolerance=...)` takes the tolerance "
                "from the root finder, such as `optimistix.Newton(rtol, atol)`."
            )
        self.tolerance = float(tolerance)

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms):
        return 2 * self.stages

    def scheme(self, system: System) -> Scheme:
        refuse_constrained(self, system)
        limits = self.max_iterations, self.tolerance
        move = Collocation(self.stages, self.root_finder, *limits)

        def start(system: System, t: Array, y: State) -> _Carry:
            y = system.values(y)
            many = lambda x: jnp.zeros((self.stages, *x.shape), x.dtype)
            zero = jnp.zeros((), jnp.result_type(t))
            return _Carry(tree.zeros(y), jtu.tree_map(many, y), zero)

        return Scheme(move, start=start, is_implicit=True, inverse_error=self.tolerance)


def _check_number(x, most: int | None, name: str) -> None:
    # `True` is an integer too.
    if type(x) is not int or x < 1 or (most is not None and x > most):
        wanted = "at least 1" if most is None else f"from 1 to {most}"
        raise ValueError(f"{name} must be a Python integer {wanted}, but got {x!r}.")
