import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .._misc import as_parameter, as_positive, cast_to, largest
from .._split import State
from .._system import System
from ._base import AbstractMoveSolver, AbstractPresymplecticSolver
from ._composition import rows
from ._copies import exchange, move_frames, rotate, separate
from ._engine import forward, Moves, Result, Span, Stages
from ._tableaus import (
    SOFRONIOU_SPALETTA_6,
    SOFRONIOU_SPALETTA_8,
    SOFRONIOU_SPALETTA_10,
    SUZUKI_4,
)


_WEIGHTS = {2: (1.0,)} | {
    tableau.order: tableau.weights
    for tableau in (
        SUZUKI_4,
        SOFRONIOU_SPALETTA_6,
        SOFRONIOU_SPALETTA_8,
        SOFRONIOU_SPALETTA_10,
    )
}


def _free_step(order: int, rotated: Callable[[Array, State], State]) -> Stages:
    """One composed step of two uncoupled copies.

    The leapfrog of both, with arguments from each other. Its state is their mean and
    half of their difference.
    """
    moves = (
        *(exchange(known=True), move_frames, exchange(second=True)),
        # The next stage reuses its field, since its arguments do not change.
        *(move_frames, exchange()),
    )
    table = [(0, 0, 0.5), (0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5), (1, 1, 0.5)]
    stages = Stages([Stages(moves, table)], rows(_WEIGHTS[order]))
    apart = separate(rotated)
    moves = apart, stages, apart.inverse
    return Stages(moves, [(0, 0, 1), (0, 1, 1), (1, 1, 1)])


def _check_order(order, name: str) -> int:
    if order not in _WEIGHTS:
        raise ValueError(
            f"`{name}(order)` needs an order of 2, 4, 6, 8 or 10, but got {order!r}."
        )
    return order


class PresymplecticCoupled(AbstractMoveSolver[State]):
    r"""Two copies of the system, rotated about their mean once per composed step.

    Order 2, 4, 6, 8 or 10 as given; 3, 11, 27, 43 or 71 evaluations of velocity and
    force per step. Explicit for every Hamiltonian, symmetric, and conformally
    symplectic in the doubled phase space. Uses Hermite interpolation for dense/ts
    output, at the cost of up to three more steps.

    The first choice for Hamiltonians that are neither separable nor split.
    [`diffrax_presym.PresymplecticTao`][] couples the copies within every stage, by a
    strength that must suit both step and system. Here they are uncoupled for all stages
    of a step. Then their difference, of the order of the local error, is rotated by a
    fixed angle, so that it does not accumulate. The solution is their mean, which
    depends on the difference only in second order. There is no strength to choose, and
    no order is lost. The `solver_state` holds half of the difference. A solve fails,
    with `RESULTS.nonlinear_divergence`, if the copies differ by more than their size,
    or than they move in a step: the coupling is not stable with strong friction that is
    part of the force. Then use shorter steps or
    [`diffrax_presym.PresymplecticGauss`][].
    """

    composed_order: int = eqx.field(static=True)
    angle: Inexact[Array, ""]
    scale: Inexact[Array, ""]

    def __init__(self, order: int = 2, angle=math.pi / 2, scale=1.0):
        r"""**Arguments:**

        - `order`: the order, 2, 4, 6, 8 or 10. Defaults to 2.
        - `angle`: the angle by which the difference of the copies is rotated per step,
            in radians. At multiples of $\pi$ it accumulates. Defaults to $\pi/2$.
        - `scale`: the ratio of the sizes of `q` and `p`, which the rotation mixes. If
            it is far off, only short steps are stable. Defaults to 1.

        **Raises:**

        `ValueError` if the order is not one of these, the angle is not a real number or
        the scale is not positive.
        """
        self.composed_order = _check_order(order, "PresymplecticCoupled")
        self.angle = as_parameter(angle, "`PresymplecticCoupled(angle=...)`")
        self.scale = as_positive(scale, "`PresymplecticCoupled(scale=...)`")

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return self.composed_order

    def start(self, system: System, t: Array, y: State) -> State:
        return system.zeros(y)

    def moves(self, system: System) -> Moves:
        return _free_step(self.composed_order, self._rotated)

    def _rotated(self, h: Array, half: State) -> State:
        # Half of the angle before and half after, with the sign of `h`, for symmetry.
        angle = jnp.copysign(cast_to(self.angle, h) / 2, h)
        return rotate(angle, half, cast_to(self.scale, h))

    def composition_error(self) -> str | None:
        return (
            "`PresymplecticCoupled` composes its own stages, and rotates its copies "
            "only at the ends of a step. Write `PresymplecticCoupled(order)`."
        )

    def distance(self, y: State, solver_state: State) -> Array:
        """The largest difference between the copies, in any entry of `q` or `p`.

        **Arguments:**

        - `y`: the state at the end of a solve; not used.
        - `solver_state`: the solver state there, from
            `SaveAt(t1=True, solver_state=True)`.
        """
        return 2 * largest(solver_state)


class PresymplecticProjected(AbstractPresymplecticSolver[None]):
    r"""Two copies of the system, both set to their mean after each composed step.

    Order 2, 4, 6, 8 or 10 as given; 3, 11, 27, 43 or 71 evaluations of velocity and
    force per step. Explicit for every Hamiltonian. Not symmetric, and symplectic up to
    an error of higher order, which matters over very long times. Uses Hermite
    interpolation for dense/ts output, at the cost of up to three more steps.

    For Hamiltonians that are neither separable nor split, over moderate times. As
    accurate as [`diffrax_presym.PresymplecticCoupled`][] at the same cost, and without
    a solver state.

    ??? cite "Reference"

        ```bibtex
        @article{pihajoki2015explicit,
            author={Pihajoki, Pauli},
            title={Explicit methods in extended phase space for inseparable
                   {H}amiltonian problems},
            journal={Celestial Mechanics and Dynamical Astronomy},
            volume={121},
            number={3},
            pages={211--231},
            year={2015},
        }

        @article{luo2017explicit,
            author={Luo, Junjie and Wu, Xin and Huang, Guoqing and Liu, Fuyao},
            title={Explicit symplectic-like integrators with midpoint permutations for
                   spinning compact binaries},
            journal={The Astrophysical Journal},
            volume={834},
            number={1},
            pages={64},
            year={2017},
        }
        ```
    """

    composed_order: int = eqx.field(static=True)

    def __init__(self, order: int = 2):
        """**Arguments:**

        - `order`: the order, 2, 4, 6, 8 or 10. Defaults to 2.

        **Raises:**

        `ValueError` if the order is not one of these.
        """
        self.composed_order = _check_order(order, "PresymplecticProjected")

    @property
    def is_symmetric(self) -> bool:
        return False

    def order(self, terms) -> int:
        return self.composed_order

    def advance(
        self, system: System, t0: Array, t1: Array, h: Array, y: State, carry: None
    ) -> tuple[State, None, Result]:
        # The difference of the copies is dropped, so the step is not invertible.
        moves = _free_step(self.composed_order, lambda h, half: half)
        stage = y, system.zeros(y)
        (y, _), result = forward(moves, system, Span(t0, t1, h), stage)
        return y, None, result
