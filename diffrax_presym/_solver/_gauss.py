from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Inexact

from .._misc import cast_to, check_root_finder, is_sum, rounding_errors, Sum
from .._split import State
from .._system import System
from ._base import AbstractPresymplecticSolver
from ._collocation import gauss_table, MAX_STAGES
from ._gauss_step import (
    by_root_finder,
    contract,
    factorise,
    fixed_point,
    GaussStep,
    implicit,
    Slopes,
)
from ._moves import root_find


class _Carry(NamedTuple):
    """The solver state."""

    lost: State  # the rounding error of the state so far
    slopes: Slopes  # of the last step, for the initial guess
    h: Inexact[Array, ""]  # the length of the last step, zero if there was none


class PresymplecticGauss(AbstractPresymplecticSolver[_Carry]):
    r"""Gauss collocation, in the frame that moves with the momentum.

    Order 2 to 16, twice the number of stages, and symmetric. Implicit for every
    Hamiltonian: a step takes one evaluation of velocity and force for all stages at
    once, by `jax.vmap`, in each of 3 to 15 iterations. Uses Hermite interpolation for
    dense/ts output, at the cost of one to two more steps, or of up to seven with a root
    finder.

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
        step = GaussStep(system, gauss_table(self.stages), t0, h, *parts)
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

    def _solve(self, step: "GaussStep", guess: Slopes) -> tuple[Slopes, dfx.RESULTS]:
        if self.root_finder is None:
            limits = self.max_iterations, self.tolerance
            find = lambda guess: fixed_point(step, guess, *limits)
        else:
            by_finder = root_find(self.root_finder, self.max_iterations)
            find = lambda guess: by_root_finder(step, guess, by_finder)
        return implicit(step, find, guess, self._tangent)

    @property
    def _tangent(self):
        return contract if self.root_finder is None else factorise


def _check_number(x, most: int | None, name: str) -> None:
    # `True` is an integer too.
    if type(x) is not int or x < 1 or (most is not None and x > most):
        wanted = "at least 1" if most is None else f"from 1 to {most}"
        raise ValueError(f"{name} must be a Python integer {wanted}, but got {x!r}.")
