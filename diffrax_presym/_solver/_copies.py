import math
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact

from .._misc import as_parameter, as_positive, cast_to, tree_add, tree_scale, tree_sub
from .._scan import scan_stages
from .._term import State, View
from ._base import AbstractPresymplecticSolver, Clock, stage_table
from ._tableaus import (
    SOFRONIOU_SPALETTA_6,
    SOFRONIOU_SPALETTA_8,
    SOFRONIOU_SPALETTA_10,
    SUZUKI_4,
)
from ._tao import exchange, largest, move_frame, paired_field, turn


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


_WEIGHTS = {2: (1.0,)} | {
    tableau.order: tableau.weights
    for tableau in (
        SUZUKI_4,
        SOFRONIOU_SPALETTA_6,
        SOFRONIOU_SPALETTA_8,
        SOFRONIOU_SPALETTA_10,
    )
}


class _AbstractCopies(AbstractPresymplecticSolver):
    """Two copies of the system, each the argument of the other's explicit leapfrog,
    that are left to themselves for one composed step."""

    composed_order: AbstractVar[int]

    def __check_init__(self):
        if self.composed_order not in _WEIGHTS:
            raise ValueError(
                f"`{type(self).__name__}(order)` needs an order of 2, 4, 6, 8 or 10, "
                f"but got {self.composed_order!r}."
            )

    def order(self, terms):
        return self.composed_order

    def compose(self, view: View, t0, t1, h, y: State, copy: State):
        clock = Clock(t0, t1, h)

        def stage(state, moves):
            y, copy, field = state
            start, end, weight = moves
            length, half = weight * h, weight * h / 2
            middle = clock(start) + half
            y, copy = exchange(half, field, y, copy)
            y, copy = (move_frame(view, clock(start), half, x) for x in (y, copy))
            field = paired_field(view, middle, copy, y)
            copy, y = exchange(length, field, copy, y)
            y, copy = (move_frame(view, middle, half, x) for x in (y, copy))
            # The next stage begins with it, since the map leaves its arguments alone.
            field = paired_field(view, clock(end), y, copy)
            y, copy = exchange(half, field, y, copy)
            return (y, copy, field), None

        stages = stage_table(_WEIGHTS[self.composed_order], h)
        start = y, copy, paired_field(view, t0, y, copy)
        (y, copy, _), _ = scan_stages(stage, start, stages)
        return y, copy


def _mean(y: State, copy: State) -> State:
    return jtu.tree_map(lambda a, b: (a + b) / 2, y, copy)


class PresymplecticCoupled(_AbstractCopies):
    r"""Two copies of the system, turned about their mean once per composed step.

    Order 2, 4, 6, 8 or 10 as given; 3, 11, 27, 43 or 71 evaluations of velocity and
    force per step. Explicit for every Hamiltonian, symmetric, and conformally
    symplectic in the doubled phase space. Uses Hermite interpolation for dense/ts
    output, of 3rd order, or of 5th if `order` exceeds 4, at further cost.

    For Hamiltonians that are neither separable nor split: the first choice. The idea is
    that of [`diffrax_presym.PresymplecticTao`][], put together differently. There the
    copies are coupled within every stage, by a strength that must suit step and system
    at once. Here they run free for all stages of a step, after which their difference,
    of the order of the local error, is turned by a fixed angle, so that it cannot
    accumulate. The solution is their mean, which feels their difference only in second
    order. No strength is left to choose, and no order is lost. The `solver_state` holds
    half of the difference.
    """

    composed_order: int = eqx.field(static=True)
    angle: Inexact[Array, ""]
    scale: Inexact[Array, ""]

    def __init__(self, order: int = 2, angle=math.pi / 2, scale=1.0):
        r"""**Arguments:**

        - `order`: the order, 2, 4, 6, 8 or 10. Defaults to 2.
        - `angle`: the angle by which the difference of the copies is turned per step,
            in radians. Multiples of $\pi$ let it accumulate. Defaults to $\pi/2$.
        - `scale`: the ratio of the sizes of `q` and `p`, as in turning round an orbit
            one becomes the other. With one that is far off only short steps are stable.
            Defaults to 1.

        **Raises:**

        `ValueError` if the order is none of these, or the angle is not a real number or
        the scale not a positive one.
        """
        self.composed_order = order
        self.angle = as_parameter(angle, "`PresymplecticCoupled(angle=...)`")
        self.scale = as_positive(scale, "`PresymplecticCoupled(scale=...)`")

    @property
    def is_symmetric(self) -> bool:
        return True

    def start(self, view: View, t, y: State) -> State:
        return jtu.tree_map(jnp.zeros_like, y)

    def advance(self, view: View, t0, t1, h, y: State, carry: State):
        # Half before and half after, in the direction of time: a symmetric step.
        angle = jnp.copysign(cast_to(self.angle, h) / 2, h)
        scale = cast_to(self.scale, h)
        half = turn(angle, carry, scale)
        y, copy = tree_add(y, 1, half), tree_sub(y, half)
        y, copy = self.compose(view, t0, t1, h, y, copy)
        half = tree_scale(0.5, tree_sub(y, copy))
        return _mean(y, copy), turn(angle, half, scale), None

    def slope(self, view: View, t, y: State, carry: State) -> State:
        return view.slope(t, y)

    def distance(self, y: State, solver_state: State) -> Array:
        """The largest difference between the copies, in any entry of `q` or `p`.

        **Arguments:**

        - `y`: the state at the end of a solve; not used.
        - `solver_state`: the solver state there, by
            `SaveAt(t1=True, solver_state=True)`.
        """
        return 2 * largest(solver_state)


class PresymplecticProjected(_AbstractCopies):
    r"""Two copies of the system, both set to their mean after each composed step.

    Order 2, 4, 6, 8 or 10 as given; 3, 11, 27, 43 or 71 evaluations of velocity and
    force per step. Explicit for every Hamiltonian. Not symmetric, and symplectic but
    for an error of higher order that shows over very long times. Uses Hermite
    interpolation for dense/ts output, of 3rd order, or of 5th if `order` exceeds 4, at
    further cost.

    For Hamiltonians that are neither separable nor split, over moderate times. As
    accurate as [`diffrax_presym.PresymplecticCoupled`][] at the same cost, and with
    nothing to carry from step to step.

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

        `ValueError` if the order is none of these.
        """
        self.composed_order = order

    @property
    def is_symmetric(self) -> bool:
        return False

    def start(self, view: View, t, y: State) -> None:
        return None

    def advance(self, view: View, t0, t1, h, y: State, carry: None):
        return _mean(*self.compose(view, t0, t1, h, y, y)), None, None

    def slope(self, view: View, t, y: State, carry: None) -> State:
        return view.slope(t, y)
