import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .._misc import as_parameter, as_positive, cast_to
from .._split import State
from .._system import System
from ._base import AbstractMoveSolver
from ._composition import rows
from ._copies import exchange, move_frames, rotate, separate
from ._engine import Moves, Stages
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
