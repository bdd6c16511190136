import itertools
import math
from typing import ClassVar, TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, PyTree

from .._compositions import substeps
from .._numbers import State
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, Scheme
from ._engine import inverse, Moves, MoveSequence
from ._find_split import find_split
from ._moves import Drift, Enter, Kick
from ._strong_friction import friction_limit
from ._tableaus import (
    BLANES_CASAS_RKN_8,
    BLANES_MOAN_4,
    BLANES_MOAN_6,
    BLANES_MOAN_RKN_4,
    BLANES_MOAN_RKN_6,
    SplittingTableau,
    STRANG,
    TUNED_LINEAR_8,
    TUNED_RKN_6,
)


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractSplitting(AbstractPresymplecticSolver):
    """Exact drifts and kicks alternately, each over a fraction of the step."""

    tableau: AbstractVar[SplittingTableau]

    @property
    def is_symmetric(self) -> bool:
        return self.tableau.fractions == self.tableau.fractions[::-1]

    def order(self, terms) -> int:
        return self.tableau.order

    def scheme(self, system: System) -> Scheme:
        split, tableau = find_split(self, self.tableau.kind, system), self.tableau
        kind, order, first = tableau.kind, tableau.order, tableau.kick_first
        drift, kick = Drift(kind, order), Kick(kind, order)
        drifts = substeps(tableau.fractions[first::2])
        kicks = tableau.fractions[not first :: 2]
        names, by = split.names, split.quadrature(system, order)
        parts = zip(itertools.cycle(names[:: 1 if first else -1]), tableau.fractions)
        pattern = tuple((name, part, by) for name, part in parts)
        most = friction_limit(system, pattern, order)
        moves: list[Moves] = [drift]
        spans = [tuple(drifts[-1])]
        if len(drifts) > 1:
            ends, inner = drifts[:-1, 1], kicks[first : first + len(drifts) - 1]
            table = drifts[:-1], np.stack([ends, ends, inner], axis=-1)
            moves.insert(0, MoveSequence([drift, kick], np.stack(table, axis=1)))
            spans.insert(0, (0, 1, 1))
        if first:
            # The force of the last kick is that of the first kick of the next step.
            start = Kick(kind, order, known=True)
            moves = [start, *moves, inverse(start)]
            spans = [(0, 0, kicks[0]), *spans, (1, 1, kicks[-1])]
        scheme = Scheme(
            MoveSequence(moves, spans),
            Enter(kind) if split.has_variables else None,
            is_resolved=kind != "linear" and split.is_resolved,
            most_friction=most,
            failure=split.failure,
            pattern=pattern,
        )
        if not first:
            return scheme
        start = lambda system, t, y, *_: first_force(system, kind, t, y)
        return scheme._replace(
            start=start,
            at_kink=start,
            # Otherwise a kick is by a part of the force only.
            end_force=lambda carry: carry if "separable" in split.kinds else None,
        )


def first_force(system: System, kind: str, t: Array, y: State) -> PyTree:
    """The force with which a scheme that starts with a kick starts."""
    split = system.split(kind)
    return split.force(system, t, split.enter(system, t, y))


class Splitting(AbstractSplitting):
    """A splitting into exact drifts and kicks, given by a tableau.

    Order as stated by the tableau; one force evaluation per kick, and one less if the
    step starts with a kick. Uses Hermite interpolation for dense/ts output, in
    Diffrax's own loop at the cost of up to seven more steps.

    For systems whose kinetic part has a known flow, where it is far more accurate
    than a composition at equal cost.
    """

    tableau: SplittingTableau = eqx.field(static=True)

    def __init__(self, tableau: SplittingTableau):
        """**Arguments:**

        - `tableau`: a `SplittingTableau`.

        **Raises:**

        `ValueError` if the drifts or the kicks do not sum to one, if the first and the
        last move are of different kinds, or if the order is not a positive integer.
        """
        if not isinstance(tableau, SplittingTableau):
            raise ValueError(
                "`Splitting` needs a tableau, `Splitting(SplittingTableau(order, "
                f"kick_first, kind, fractions))`, but got {tableau!r}."
            )
        if not isinstance(tableau.order, int) or tableau.order < 1:
            raise ValueError(
                "`SplittingTableau(order=...)` must be a positive integer, but got "
                f"{tableau.order!r}."
            )
        if tableau.kind not in ("separable", "any", "nystrom", "linear"):
            raise ValueError(
                '`SplittingTableau(kind=...)` must be "separable", "any", "nystrom" or '
                f'"linear", but got {tableau.kind!r}.'
            )
        fractions = tuple(float(x) for x in tableau.fractions)
        first, second = fractions[0::2], fractions[1::2]
        sums = math.fsum(first), math.fsum(second)
        if len(first) != len(second) + 1 or any(not abs(x - 1) < 1e-12 for x in sums):
            names = ("kicks", "drifts")[:: 1 if tableau.kick_first else -1]
            raise ValueError(
                "`SplittingTableau(fractions=...)` needs an odd number of moves, "
                "alternately drifts that sum to one and kicks that sum to one, but got "
                f"{len(first)} {names[0]} that sum to {sums[0]} and {len(second)} "
                f"{names[1]} that sum to {sums[1]}. To scale them, divide each kind by "
                "its sum."
            )
        self.tableau = tableau._replace(fractions=fractions)


class Strang(AbstractSplitting):
    """Strang's splitting: kick, drift, kick; the leapfrog with an exact drift.

    2nd order and symmetric. One force evaluation per step. Uses 3rd order Hermite
    interpolation for dense/ts output in Diffrax's own loop, at the cost of two more
    unless the system is separable; in that of `FixedStepAdjoint` a saved time between
    steps is a shorter step.

    For any system with a kinetic part of known flow, especially `BregmanHamiltonian`,
    for which it is explicit and `PresymplecticLeapfrog` is not. Stable under any
    friction: with a rate `γ` and an exact drift positions are right, and momenta at the
    ends of steps `(x / 2) coth(x / 2)` times too large, `x = h γ`.

    ??? cite "Reference"

        ```bibtex
        @article{strang1968construction,
            author={Strang, Gilbert},
            title={On the construction and comparison of difference schemes},
            journal={SIAM Journal on Numerical Analysis}, volume={5}, number={3},
            pages={506--517}, year={1968}}
        ```
    """

    tableau: ClassVar[SplittingTableau] = STRANG


class BlanesMoan4(AbstractSplitting):
    """Blanes and Moan's fourth-order splitting S6, for any kinetic energy.

    4th order and symmetric. Six force evaluations per step. Uses Hermite interpolation
    for dense/ts output, in Diffrax's own loop at the cost of another step.

    For any system with a kinetic part of known flow, such as a relativistic one. If the
    kinetic energy or the potential is quadratic, `BlanesMoanRKN4` is more efficient.

    ??? cite "Reference"

        ```bibtex
        @article{blanes2002practical,
            author={Blanes, Sergio and Moan, Per Christian},
            title={Practical symplectic partitioned {R}unge--{K}utta and
                {R}unge--{K}utta--{N}ystr{\\"o}m methods},
            journal={Journal of Computational and Applied Mathematics}, volume={142},
            number={2}, pages={313--330}, year={2002}}
        ```
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_4


class BlanesMoan6(AbstractSplitting):
    """Blanes and Moan's sixth-order splitting S10, for any kinetic energy.

    6th order and symmetric. Ten force evaluations per step. Uses Hermite interpolation
    for dense/ts output, in Diffrax's own loop at the cost of three more steps.

    For any system with a kinetic part of known flow. If the kinetic energy or the
    potential is quadratic, `TunedRKN6` is more efficient.

    Source: Blanes and Moan (2002), see `BlanesMoan4`.
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_6


class BlanesMoanRKN4(AbstractSplitting):
    """Blanes and Moan's fourth-order Runge--Kutta--Nyström splitting SRKN 6b.

    4th order and symmetric. Six force evaluations per step. Uses Hermite interpolation
    for dense/ts output, in Diffrax's own loop at the cost of another step.

    For quadratic kinetic energies or quadratic potentials, at low accuracy, where steps
    of `TunedRKN6` are too long.

    Source: Blanes and Moan (2002), see `BlanesMoan4`.
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_RKN_4


class BlanesMoanRKN6(AbstractSplitting):
    """Blanes and Moan's sixth-order Runge--Kutta--Nyström splitting SRKN 14a.

    6th order and symmetric. Fourteen force evaluations per step. Uses Hermite
    interpolation for dense/ts output, in Diffrax's own loop at the cost of three more
    steps.

    For quadratic kinetic energies or quadratic potentials. For oscillations `TunedRKN6`
    is more accurate.

    Source: Blanes and Moan (2002), see `BlanesMoan4`.
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_RKN_6


class BlanesCasasRKN8(AbstractSplitting):
    """The eighth-order Runge--Kutta--Nyström splitting of Blanes, Casas et al.

    8th order and symmetric. Nineteen force evaluations per step. Uses Hermite
    interpolation for dense/ts output, in Diffrax's own loop at the cost of three more
    steps.

    For quadratic kinetic energies or quadratic potentials: for errors of 1e-9 or
    smaller, of motions that are not oscillations about an equilibrium.

    ??? cite "Reference"

        ```bibtex
        @misc{blanes2022symmetric,
            author={Blanes, Sergio and Casas, Fernando and Escorihuela-Tom{\\`a}s,
                Alejandro},
            title={{R}unge--{K}utta--{N}ystr{\\"o}m symplectic splitting methods of
                order 8}, year={2022}, eprint={2202.01541}, archivePrefix={arXiv},
            primaryClass={math.NA}}
        ```
    """

    tableau: ClassVar[SplittingTableau] = BLANES_CASAS_RKN_8


class TunedRKN6(AbstractSplitting):
    """A sixth-order Runge--Kutta--Nyström splitting, tuned for oscillations.

    6th order and symmetric. Fourteen force evaluations per step. Uses Hermite
    interpolation for dense/ts output, in Diffrax's own loop at the cost of three more
    steps.

    For quadratic kinetic energies, also of rigid bodies and on manifolds, or quadratic
    potentials: the first choice, with `choose_step`. For oscillations about equilibria
    its error is much smaller than that of `BlanesMoanRKN6` at equal cost.

    Source: this package, `benchmarks/tuning.py`. The coefficients satisfy the
    conditions of order 6, and reduce the remaining error for oscillators over a range
    of frequencies and, at the next order, for any force.

    Its steps are long. Between them, interpolated by `FixedStepAdjoint`, the error may
    be 10 to 350 times that at their ends, which `choose_step` takes into account.
    """

    tableau: ClassVar[SplittingTableau] = TUNED_RKN_6


class TunedLinear8(AbstractSplitting):
    """A splitting for linear forces, with steps of half a period or more.

    8th order and symmetric for linear forces and constant friction. Fourteen force
    evaluations per step. Uses Hermite interpolation for dense/ts output, in Diffrax's
    own loop at the cost of three more steps.

    For forces linear in the positions, by a matrix or a stencil, written as
    `QuadraticPotential`: damped waves, networks of springs, quadratic objectives. It
    allows the longest steps per force evaluation: the error of a step is 1e-9 if the
    step times the highest frequency is 3.6, or 0.26 per evaluation. Its coefficients
    are tuned for a range of frequencies rather than for short steps. With friction
    split between positions and momenta, `q = exp(-γ t / 2) x`, the motion of `x` is
    again an oscillation, so that constant friction costs no accuracy up to rates of
    twice the highest frequency.

    Any other system is refused. Interpolation over such long steps is inaccurate, so in
    the loop of `FixedStepAdjoint` a saved time between steps is a shorter step of the
    scheme; use that loop.

    Source: this package, `benchmarks/tuning.py`.
    """

    tableau: ClassVar[SplittingTableau] = TUNED_LINEAR_8
