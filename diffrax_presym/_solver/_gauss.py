import functools
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Inexact, PyTree, Shaped

from .._misc import (
    cast_to,
    check_root_finder,
    is_sum,
    largest,
    rounding_errors,
    Sum,
    tree_add,
    tree_scale,
    tree_sub,
    tree_sum,
)
from .._split import State
from .._system import System
from ._base import AbstractPresymplecticSolver
from ._collocation import (
    gauss_table,
    GaussTable,
    legendre,
    MAX_STAGES,
)
from ._moves import root_find, RootFind


# Velocities and forces of all stages, times weight and length of the step, the forces
# in the frame of its middle.
Slopes = PyTree[Shaped[Array, "stages ..."]]
# Positions and momenta of all stages, in that frame.
Stages = PyTree[Shaped[Array, "stages ..."]]


class _Carry(NamedTuple):
    """The solver state."""

    lost: State  # the rounding error of the state so far
    slopes: Slopes  # of the last step, for the initial guess
    h: Inexact[Array, ""]  # the length of the last step, zero if there was none


class PresymplecticGauss(AbstractPresymplecticSolver[_Carry]):
    r"""Gauss collocation, in the frame that moves with the momentum.

    Order 2 to 16, twice the number of stages, and symmetric. Implicit for every
    Hamiltonian: a step takes one evaluation of velocity and force for all stages at
    once, by `jax.vmap`, in each of 3 to 15 iterations. Uses
    Hermite interpolation for dense/ts output, at the cost of up to five more steps.

    For Hamiltonians that are neither separable nor split, and for mechanics with a mass
    matrix, [`diffrax_presym.LagrangianSystem`][]. Conformally symplectic to rounding:
    with friction of log scale $\eta$ the Jacobian of a step satisfies
    $J^\top \Omega J = e^{\eta(t_0) - \eta(t_1)} \Omega$. All quadratic invariants are
    preserved too. Six to eight stages and long steps for errors of 1e-9 and less.
    Separable and split Hamiltonians have explicit schemes, which cost less.

    The iteration stops when its changes no longer decrease, so that the remaining error
    is rounding without a preferred sign, and the state is updated by compensated
    summation: over long times the energy error is a random walk of rounding errors. The
    `solver_state` holds the rounding error of the sum and the slopes of the last step,
    which are extrapolated to give the initial guess of the next.

    The fixed-point iteration, the default, converges for a step times the largest
    frequency of the system below about one to two. A step for which it does not
    converge fails with a `RESULTS`. For stiff energies pass a root finder.

    Derivatives are those of the implicit function, not of the iterations, in forward
    and in reverse mode; [`diffrax_presym.ReversibleAdjoint`][] takes gradients in
    constant memory.

    ??? cite "Reference"

        Section II.1.3 and chapter VIII of Hairer, Lubich and Wanner, see the
        references. Stopping rule, coefficients and sums are after

        ```bibtex
        @article{antonana2017reducing,
            author={Anto{\~n}ana, Mikel and Makazaga, Joseba and Murua, Ander},
            title={Reducing and monitoring round-off error propagation for symplectic
                   implicit {R}unge--{K}utta schemes},
            journal={Numerical Algorithms},
            volume={76},
            number={4},
            pages={861--880},
            year={2017},
        }

        @article{hairer2008achieving,
            author={Hairer, Ernst and McLachlan, Robert I. and Razakarivony, Alain},
            title={Achieving {B}rouwer's law with implicit {R}unge--{K}utta methods},
            journal={BIT Numerical Mathematics},
            volume={48},
            number={2},
            pages={231--243},
            year={2008},
        }
        ```

        and the evaluation of all stages at once after

        ```bibtex
        @misc{antonana2025simd,
            author={Anto{\~n}ana, Mikel and Makazaga, Joseba and Murua, Ander},
            title={{SIMD}-vectorized implicit symplectic integrators can outperform
                   explicit symplectic ones},
            year={2025},
            eprint={2511.03655},
            archivePrefix={arXiv},
        }
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
            this tolerance only, and so are steps that `ReversibleAdjoint` takes
            backwards, whose `tol` must be larger. A hundredth of the error that is
            wanted saves up to half of the iterations. Defaults to 0, for iteration to
            rounding.

        **Raises:**

        `ValueError` if a number is out of range, or `root_finder` of the wrong kind. A
        step whose iteration does not converge makes the solve fail, with
        `RESULTS.nonlinear_max_steps_reached`, or with `RESULTS.nonlinear_divergence` if
        it leaves the finite numbers.
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

    def start(self, system: System, t: Array, y: State) -> _Carry:
        y = system.values(y)
        many = lambda x: jnp.zeros((self.stages, *jnp.shape(x)), jnp.result_type(x))
        return _Carry(
            system.zeros(y), jtu.tree_map(many, y), jnp.zeros((), jnp.result_type(t))
        )

    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: _Carry
    ) -> tuple[State, _Carry, dfx.RESULTS]:
        # Within `Compensated` the leaves are sums already.
        sums = jtu.tree_map(
            lambda x, lost: x if is_sum(x) else Sum(x, lost),
            *(y, carry.lost),
            is_leaf=is_sum,
        )
        parts = system.values(sums), rounding_errors(sums)
        step = _Step(system, gauss_table(self.stages), t0, h, *parts)
        guess = step.extrapolate(carry.slopes, carry.h)
        slopes, result = self._solve(step, guess)
        sums = system.add(sums, 1, step.change(slopes))
        y = jtu.tree_map(
            lambda x, new: new if is_sum(x) else new.value,
            *(y, sums),
            is_leaf=is_sum,
        )
        # The solution depends on none of it, except by rounding.
        carry = _Carry(rounding_errors(sums), slopes, cast_to(h, carry.h))
        return y, lax.stop_gradient(carry), result

    def _solve(self, step: "_Step", guess: Slopes) -> tuple[Slopes, dfx.RESULTS]:
        if self.root_finder is None:
            limits = self.max_iterations, self.tolerance
            find = lambda guess: _iterate(step, guess, *limits)
        else:
            by_finder = root_find(self.root_finder, self.max_iterations)
            find = lambda guess: _find_root(step, guess, by_finder)
        return _implicit(step, find, guess, self._tangent)

    @property
    def _tangent(self):
        return _contract if self.root_finder is None else _factorise


def _check_number(x, most: int | None, name: str) -> None:
    # `True` is an integer too.
    if type(x) is not int or x < 1 or (most is not None and x > most):
        wanted = "at least 1" if most is None else f"from 1 to {most}"
        raise ValueError(f"{name} must be a Python integer {wanted}, but got {x!r}.")


class _Step:
    """The equations of the stages of one step."""

    def __init__(self, system: System, table: GaussTable, t0, h, y: State, lost: State):
        self.system, self.table = system, table
        self.t0, self.h, self.y, self.lost = t0, h, y, lost
        self.middle = t0 + h / 2
        # The times of the stages, and from there to the middle.
        self.times = t0 + cast_to(table.nodes, h) * h
        self.to_middle = cast_to(1 / 2 - table.nodes, h) * h
        self.weights = cast_to(table.weights, h) * h
        to_frame = lambda y: (y[0], system.move_frame(t0, h / 2, y[1]))
        self.base, self.base_lost = to_frame(y), to_frame(lost)

    def extrapolate(self, slopes: Slopes, last_h) -> Slopes:
        """An initial guess, from the slopes of the last step and its length."""
        q, p = slopes
        half = last_h / 2
        forward = lambda p: self.system.move_frame(self.t0 - half, half + self.h / 2, p)
        ratio = self.h / jnp.where(last_h == 0, 1, last_h)
        # Do not extrapolate far beyond the last step.
        ratio = jnp.where(jnp.abs(ratio) < 2, ratio, 0)
        nodes = cast_to(self.table.nodes, ratio)
        ahead = jnp.stack(legendre(max(2, len(nodes)), 1 + 2 * ratio * nodes))
        project = cast_to(self.table.project, ratio)
        weights = ratio * cast_to(self.table.weights, ratio)
        matrix = weights[:, None] * _dot(ahead[: len(nodes)].T, project)
        return jtu.tree_map(lambda x: _dot(matrix, x), (q, jax.vmap(forward)(p)))

    def stages(self, slopes: Slopes) -> Stages:
        # Add the small terms first.
        gained = jtu.tree_map(lambda x: _dot(self.table.mu, x), slopes)
        add = lambda y, lost, x: y[None] + (lost[None] + x)
        return jtu.tree_map(add, self.base, self.base_lost, gained)

    def slopes(self, stages: Stages) -> Slopes:
        system = self.system

        def one(t, to_middle, weight, q, p):
            p = system.move_frame(self.middle, -to_middle, p)
            velocity, force = system.velocity_and_force(t, (q, p))
            force = system.move_frame(t, to_middle, force)
            return tree_scale(weight, (velocity, force))

        return jax.vmap(one)(self.times, self.to_middle, self.weights, *stages)

    def residual(self, slopes: Slopes) -> Slopes:
        return tree_sub(self.slopes(self.stages(slopes)), slopes)

    def change(self, slopes: Slopes) -> State:
        """The change of the state over the step."""
        q, p = jtu.tree_map(lambda x: jnp.sum(x, axis=0), slopes)
        p = self.system.move_frame(self.middle, self.h / 2, p)
        friction = self.system.friction
        if friction is not None:
            p = tree_add(p, 1, friction.decay(self.t0, self.h, self.y[1]))
        return q, p


# Up to so many entries a product written out, which XLA fuses with what is around it,
# was measured up to 1.8 times faster per step than one by its library of products.
_SMALL = 16


def _dot(matrix, x):
    matrix = cast_to(matrix, x)
    if x.size > _SMALL:
        return jnp.tensordot(matrix, x, 1, precision=lax.Precision.HIGHEST)
    columns = matrix.T.reshape(len(x), -1, *(1 for _ in x.shape[1:]))
    terms = (column * row[None] for column, row in zip(columns, x, strict=True))
    return functools.reduce(jnp.add, terms)


def _implicit(step: _Step, find, guess: Slopes, tangent):
    """The slopes that are found, with the derivatives of the implicit function.

    `find` returns them and a result.
    """

    def as_float(residual, guess):
        slopes, result = find(guess)
        # `custom_root` gives integers a derivative of the wrong type.
        code, kind = jtu.tree_flatten(result)
        kinds.append(kind)
        return slopes, [jnp.asarray(x, jnp.float32) for x in code]

    kinds = []
    slopes, code = lax.custom_root(
        step.residual, guess, as_float, tangent, has_aux=True
    )
    code = [lax.stop_gradient(x).astype(jnp.int32) for x in code]
    return slopes, jtu.tree_unflatten(kinds[-1], code)


class _Search(NamedTuple):
    """The state of a fixed-point iteration."""

    stages: Stages
    slopes: Slopes
    # One array, as XLA would make a kernel for each number. Changes are those of the
    # stages, in units of their rounding.
    record: Inexact[Array, "7"]


# The entries of the record.
_STATUS = 0  # of the search, one of the following
_GOING, _CONVERGED, _FAILED = 0, 1, 2
_COUNT = 1  # of iterations
_LAST, _BEFORE = 2, 3  # change, and the one before
_LEAST = 4  # change so far
_STALLED = 5  # consecutive iterations without a smaller change
_FRESH = 6  # whether it was restarted without a guess


# Largest estimated change of another iteration, in units of rounding, to stop.
_NEGLIGIBLE = 1e-3
# Largest change at which stagnation is attributed to rounding.
_ROUNDING = 16.0


def _iterate(step: _Step, guess: Slopes, max_iterations: int, tolerance: float):
    """Fixed-point iteration, to rounding unless a tolerance is given.

    It stops when its changes no longer decrease. The remaining error is rounding, of
    either sign; that of a larger tolerance breaks the symmetry.
    """
    dtype = step.h.dtype
    number = lambda x: jnp.asarray(x, dtype)
    nothing = jtu.tree_map(jnp.zeros_like, guess)
    eps = float(jnp.finfo(_lowest(guess)).eps)
    loose, negligible = eps ** (-1 / 3), max(_NEGLIGIBLE, tolerance / eps)

    def iterate(search: _Search) -> _Search:
        _, count, last, before, least, stalled, fresh = search.record
        slopes = step.slopes(search.stages)
        stages = step.stages(slopes)
        q, p = (_change(*x, dtype) for x in zip(stages, search.stages, strict=True))
        change = jnp.maximum(q, p)
        # Positions and momenta may each depend on the other alone, so that changes
        # decrease over two iterations.
        rate = jnp.maximum(change / last, last / before)
        stalled = jnp.where(change < least, 0, stalled + 1)
        # A component that is at rest changes by rounding alone.
        converged = (
            (change == 0)
            | (rate * change <= negligible)
            | ((stalled > 0) & (change <= _ROUNDING))
            | ((stalled >= 3) & (jnp.minimum(q, p) <= loose))
        )
        # A guess may be outside of the domain although the state is inside.
        finite = jnp.isfinite(change)
        restart = ~finite & (fresh == 0)
        failed = jnp.where(finite | restart, _GOING, _FAILED)
        status = jnp.where(converged, _CONVERGED, failed)
        least = jnp.minimum(change, least)
        start = lambda x, y: jtu.tree_map(lambda x, y: jnp.where(restart, x, y), x, y)
        record = start(
            [_GOING, count + 1, 0, 0, jnp.inf, 0, 1],
            [status, count + 1, change, last, least, stalled, fresh],
        )
        record = jnp.stack([number(x) for x in record])
        return _Search(start(step.stages(nothing), stages), slopes, record)

    def going(search: _Search):
        record = search.record
        return (record[_STATUS] == _GOING) & (record[_COUNT] < max_iterations)

    record = np.zeros(7)
    record[_LEAST] = np.inf
    search = _Search(step.stages(guess), guess, number(record))
    search = lax.while_loop(going, iterate, search)
    status = search.record[_STATUS]
    results: Any = dfx.RESULTS
    failure = results.where(
        status == _FAILED,
        results.nonlinear_divergence,
        results.nonlinear_max_steps_reached,
    )
    converged = status == _CONVERGED
    return search.slopes, results.where(converged, results.successful, failure)


def _find_root(step: _Step, guess: Slopes, find: RootFind):
    nothing = jtu.tree_map(jnp.zeros_like, guess)
    # Extrapolation of stiff components may be inaccurate.
    sizes = (largest(step.residual(x)) for x in (guess, nothing))
    better = jnp.less(*sizes)
    guess = jtu.tree_map(lambda x: jnp.where(better, x, 0), guess)
    return find(lambda slopes: step.slopes(step.stages(slopes)), guess)


def _lowest(x: PyTree):
    """The lowest precision of the leaves."""
    dtypes = [leaf.dtype for leaf in jtu.tree_leaves(x)]
    return max(dtypes, key=lambda dtype: float(jnp.finfo(dtype).eps))


def _change(x: PyTree, y: PyTree, dtype) -> Inexact[Array, ""]:
    """The largest difference, in units of the rounding of the largest entry."""

    def leaf(x, y):
        info = jnp.finfo(x.dtype)
        size = float(info.eps) * jnp.max(jnp.abs(x), initial=0)
        change = jnp.max(jnp.abs(x - y), initial=0)
        return cast_to(change / jnp.maximum(size, float(info.tiny)), dtype)

    return jtu.tree_reduce(jnp.maximum, jtu.tree_map(leaf, x, y), jnp.zeros((), dtype))


def _contract(g, y: Slopes) -> Slopes:
    """Solve a linear system of a residual by the same iteration."""

    def solve(g, b):
        # x = x + g(x) - b
        def iterate(state):
            x, _, least, stalled, count = state
            new = tree_sub(tree_sum(x, g(x)), b)
            change, size = largest(tree_sub(new, x)), largest(new)
            stalled = jnp.where(change < least, 0, stalled + 1)
            going = (change > eps / 8 * size) & (stalled < 3)
            return new, going, jnp.minimum(change, least), stalled, count + 1

        start = tree_scale(-1, b)
        eps = float(jnp.finfo(_lowest(b)).eps)
        state = (
            start,
            jnp.array(True),
            jnp.asarray(jnp.inf, largest(b).dtype),
            jnp.asarray(0),
            jnp.asarray(0),
        )
        x, going, least, *_ = lax.while_loop(
            lambda state: state[1] & (state[-1] < 200), iterate, state
        )
        # Never numbers as if nothing had happened.
        solved = ~going & (least <= eps ** (1 / 2) * largest(x))
        return jtu.tree_map(lambda x: jnp.where(solved, x, jnp.nan), x)

    return lax.custom_linear_solve(g, y, solve, transpose_solve=solve)


def _factorise(g, y: Slopes) -> Slopes:
    """The same by a factorisation of the matrix."""
    operator = lx.FunctionLinearOperator(g, jax.eval_shape(lambda: y))
    return lx.linear_solve(operator, y, lx.AutoLinearSolver(well_posed=True)).value
