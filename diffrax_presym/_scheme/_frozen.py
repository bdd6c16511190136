"""The schemes of the paper, made of two half-steps that are adjoint to each other."""

from typing import Any, Literal

import equinox as eqx

from .._system._bound import System
from ._base import AbstractPresymplecticSolver, Scheme
from ._engine import inverse, MoveSequence
from ._find_split import find_split
from ._moves import FrozenDrift, Kick
from ._splitting import first_force
from ._strong_friction import part_of, Pattern


def _momentum_first(solver, system: System, known: bool = False) -> MoveSequence:
    """A kick at `t`, then a drift to `t + h` with the velocity frozen at `t`: equation
    (presymp_euler), here A. Its inverse is position first, a drift with the velocity
    frozen at `t + h`, then a kick there: equation (presymp_euler2), here B.

    The force of the kick may be known.
    """
    find_split(solver, "separable", system)
    kick = Kick("separable", 1, known)
    return MoveSequence([kick, FrozenDrift()], [(0, 0, 1), (0, 1, 1)])


_EULER: Pattern = (("kick", 1.0, 0), ("move", 1.0, 0), ("decay", 1.0, 0))
_HALF = part_of(_EULER, 0.5)


def _check(first: Any) -> Any:
    if first not in ("momentum", "position"):
        raise ValueError(
            f'`first` must be "momentum" or "position", but got {first!r}.'
        )
    return first


_ARGUMENTS = """**Arguments:**

- `first`: what is updated first, `"momentum"` (the default) or `"position"`.

**Raises:**

`ValueError` if `first` is invalid; and when the solve is traced, if the system is not
separable.
"""


class PresymplecticEuler(AbstractPresymplecticSolver):
    """Presymplectic Euler's method.

    1st order. One force evaluation per step. Uses 3rd order Hermite interpolation for
    dense/ts output in Diffrax's own loop; in that of `FixedStepAdjoint` a saved time
    between steps is a shorter step.

    For separable systems, for which the method is explicit; for others it would be
    implicit. The cheapest scheme. Not symmetric: the two variants are adjoint to each
    other. `PresymplecticLeapfrog` has second order at the same cost; use Euler only
    where this map itself is wanted, for example as an optimiser. Under strong friction,
    `x = h γ`, the slow motion is `x / (1 - exp(-x))` times too fast, and the momentum
    `x / (exp(x) - 1)` times what it should be; with `first="position"` the two factors
    are exchanged.

    Equations (presymp_euler) and (presymp_euler2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(
        static=True, default="momentum", converter=_check
    )

    @property
    def is_symmetric(self) -> bool:
        return False

    def order(self, terms) -> int:
        return 1

    def scheme(self, system: System) -> Scheme:
        moves = _momentum_first(self, system)
        if self.first == "momentum":
            return Scheme(moves, pattern=_EULER)
        return Scheme(inverse(moves), pattern=_EULER[::-1])


PresymplecticEuler.__init__.__doc__ = _ARGUMENTS


class PresymplecticLeapfrog(AbstractPresymplecticSolver):
    """The presymplectic leapfrog, also known as Störmer--Verlet.

    2nd order and symmetric. One force evaluation per step. Uses 3rd order Hermite
    interpolation for dense/ts output in Diffrax's own loop; in that of
    `FixedStepAdjoint` a saved time between steps is a shorter step.

    For separable systems, for which the method is explicit; for others it would be
    implicit. For large steps and low accuracy, such as in optimisation: no scheme of
    this cost is stable at longer steps. For more than a few digits, schemes of higher
    order are cheaper; `TunedRKN6` is the default choice.

    With `first="momentum"` the last force of a step is reused by the next step and by
    dense output. With `first="position"` the error is often smaller, but dense output
    costs two more force evaluations per step.

    !!! warning

        With `first="momentum"` the `solver_state` is the force at the end of the last
        step. After an event the solution ends inside that step. To continue from there,
        pass only the state `y` (the default), or the `solver_state` with
        `made_jump=True`.

    Stable under any friction, at a rate `γ` with `x = h γ`: the slow motion is
    `(x / 2) coth(x / 2)` times too fast, and the momentum too large by this factor,
    with `first="position"` `(x / 2) / sinh(x / 2)` times what it should be.

    With a mass `m` and a constant rate `γ` a step of `h` from `t` is, with
    `d = exp(-γ h)`,

        p_half = p - h / 2 * grad V(t, q)
        q_end = q + h / 2 * (1 + d) * p_half / m
        p_end = d * p_half - h / 2 * grad V(t + h, q_end)

    and with `first="position"`, with `s = exp(-γ h / 2)`,

        q_half = q + h / 2 * s * p / m
        p_end = s**2 * p - h * s * grad V(t + h / 2, q_half)
        q_end = q_half + h / 2 * p_end / (s * m)

    Equations (presymp_leapfrog) and (presymp_leapfrog2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(
        static=True, default="momentum", converter=_check
    )

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return 2

    def scheme(self, system: System) -> Scheme:
        if self.first == "momentum":
            # In both directions the first kick is by the force known from the last one.
            A = _momentum_first(self, system, known=True)
            moves = MoveSequence([A, inverse(A)], [(0, 0.5, 0.5), (0.5, 1, 0.5)])
            start = lambda system, t, y, *_: first_force(system, "separable", t, y)
            return Scheme(
                moves,
                start=start,
                at_kink=start,
                end_force=lambda carry: carry,
                pattern=_HALF + _HALF[::-1],
            )
        # Two kicks at the same position are merged.
        kick, drift = _momentum_first(self, system).moves
        table = [(0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5)]
        moves = MoveSequence([inverse(drift), kick, drift], table)
        return Scheme(moves, pattern=_HALF[::-1] + _HALF)


PresymplecticLeapfrog.__init__.__doc__ = _ARGUMENTS
