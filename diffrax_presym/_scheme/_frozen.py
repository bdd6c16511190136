"""The schemes of the paper, made of two half-steps that are adjoint to each other."""

from typing import Literal

import equinox as eqx
import optimistix as optx

from .._checks import check_root_finder
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, Scheme
from ._engine import inverse, Stages
from ._moves import FrozenDrift, FrozenKick


def _momentum_first(solver, system: System, known: bool = False) -> Stages:
    """A kick at `t`, then a drift to `t + h` with the velocity frozen at `t`: equation
    (presymp_euler), here A. Its inverse is position first, a drift with the velocity
    frozen at `t + h`, then a kick there: equation (presymp_euler2), here B.

    Both are explicit for separable systems; for others their first move is implicit.
    The force of the kick may be known.
    """
    if solver.root_finder is None and not system.is_separable:
        if system.split("any") is None:
            instead = (
                "use `PresymplecticGauss()`, which needs none; or, if the energy is a "
                "sum T(t, p) + V(t, q), give its parts: `MechanicalSystem(kinetic, "
                "potential)`."
            )
        else:
            instead = "use `Strang()` or `BlanesMoan4()`, which are explicit."
        raise ValueError(
            f"This `{system.name}` is not separable, so `{type(solver).__name__}` is "
            "implicit. Pass it a root finder, for example "
            "`root_finder=optimistix.Newton(rtol=1e-10, atol=1e-10)`; or " + instead
        )
    implicit = solver.root_finder, solver.root_find_max_steps
    moves = FrozenKick(*implicit, known), FrozenDrift(*implicit)
    return Stages(moves, [(0, 0, 1), (0, 1, 1)])


def _check(solver) -> None:
    if solver.first not in ("momentum", "position"):
        raise ValueError(
            f'`first` must be "momentum" or "position", but got {solver.first!r}.'
        )
    if solver.root_finder is not None:
        check_root_finder(solver.root_finder)


_ARGUMENTS = """**Arguments:**

- `first`: what is updated first, `"momentum"` (the default) or `"position"`.
- `root_finder`: an Optimistix root finder, used only if the system is not separable,
    and then required. Its tolerances limit how well the structure is preserved.
    Defaults to `None`.
- `root_find_max_steps`: the maximum number of steps of a root find. Defaults to 32.

**Raises:**

`ValueError` if `first` or `root_finder` is invalid; and when the solve is traced, if
the system is not separable and no root finder is given.
"""


class PresymplecticEuler(AbstractPresymplecticSolver):
    """Presymplectic Euler's method.

    1st order. One force evaluation per step, explicit for separable systems and
    implicit for any other. Uses 3rd order Hermite interpolation for dense/ts output.

    The cheapest scheme. Not symmetric: the two variants are adjoint to each other.
    [`diffrax_presym.PresymplecticLeapfrog`][] has second order at the same cost; use
    Euler only where this map itself is wanted, for example as an optimiser.

    Equations (presymp_euler) and (presymp_euler2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(static=True, default="momentum")
    root_finder: optx.AbstractRootFinder | None = None
    root_find_max_steps: int = eqx.field(static=True, default=32)

    def __check_init__(self):
        _check(self)

    @property
    def is_symmetric(self) -> bool:
        return False

    def order(self, terms) -> int:
        return 1

    def scheme(self, system: System) -> Scheme:
        moves = _momentum_first(self, system)
        moves = moves if self.first == "momentum" else inverse(moves)
        return Scheme(moves, is_implicit=not system.is_separable)


PresymplecticEuler.__init__.__doc__ = _ARGUMENTS


class PresymplecticLeapfrog(AbstractPresymplecticSolver):
    """The presymplectic leapfrog, also known as Störmer--Verlet.

    2nd order and symmetric. One force evaluation per step, explicit for separable
    systems and implicit for any other. Uses 3rd order Hermite interpolation for
    dense/ts output.

    For large steps and low accuracy, such as in optimisation: no scheme of this cost is
    stable at longer steps. For more than a few digits, schemes of higher order are
    cheaper; [`diffrax_presym.TunedRKN6`][] is the default choice.

    With `first="momentum"` the last force of a step is reused by the next step and by
    dense output. With `first="position"` the error is often smaller, but dense output
    costs two more force evaluations per step.

    !!! warning

        With `first="momentum"` the `solver_state` is the force at the end of the last
        step. After an event the solution ends inside that step. To continue from there,
        pass only the state `y` (the default), or the `solver_state` with
        `made_jump=True`.

    Equations (presymp_leapfrog) and (presymp_leapfrog2) of França, Jordan
    and Vidal (2021).
    """

    first: Literal["momentum", "position"] = eqx.field(static=True, default="momentum")
    root_finder: optx.AbstractRootFinder | None = None
    root_find_max_steps: int = eqx.field(static=True, default=32)

    def __check_init__(self):
        _check(self)

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return 2

    def scheme(self, system: System) -> Scheme:
        halves = [(0, 0.5, 0.5), (0.5, 1, 0.5)]
        if self.first == "momentum":
            # The last force of a step is reused only if it does not depend on `p`. In
            # both directions the first kick is by the force known from the last one.
            known = system.is_separable
            A = _momentum_first(self, system, known)
            moves = Stages([A, inverse(A)], halves)
            if not known:
                return Scheme(moves, is_implicit=True)
            force = lambda system, t, y: system.force(t, y)
            return Scheme(moves, start=force, end_force=lambda carry: carry)
        A = _momentum_first(self, system)
        B = A.inverse
        if not system.is_separable:
            return Scheme(Stages([B, A], halves), is_implicit=True)
        # Two kicks at the same position are merged.
        (kick, drift), (drift_end, _) = A.moves, B.moves
        table = [(0, 0.5, 0.5), (0.5, 0.5, 1), (0.5, 1, 0.5)]
        return Scheme(Stages([drift_end, kick, drift], table))


PresymplecticLeapfrog.__init__.__doc__ = _ARGUMENTS
