import math
from typing import ClassVar, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._misc import cast_to, tree_add, tree_sum
from .._scan import scan_stages
from .._term import State, View
from ._base import AbstractPresymplecticSolver, Clock, pull_back, stage_table
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
from ._variables import Shared, Swapped


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractSplitting(AbstractPresymplecticSolver[PyTree]):
    """Exact drifts and kicks by turns, each with a fraction of the step of its own."""

    tableau: AbstractVar[SplittingTableau]

    @property
    def is_symmetric(self) -> bool:
        return self.tableau.fractions == self.tableau.fractions[::-1]

    @property
    def reverse(self) -> "AbstractSplitting":
        backwards = self.tableau.fractions[::-1]
        return (
            self
            if self.is_symmetric
            else Splitting(self.tableau._replace(fractions=backwards))
        )

    def order(self, terms):
        return self.tableau.order

    def variables(self, view: View) -> View | Swapped | Shared:
        """The variables to step in, after a check that this scheme can do the system.

        Mostly those of the state. Where the potential is quadratic instead of the
        kinetic energy, their roles are swapped.
        """
        hamiltonian, name = view.hamiltonian, type(self).__name__
        if not hamiltonian.is_split:
            raise ValueError(
                f"`{name}` needs a Hamiltonian split into a kinetic part and a "
                f"potential, but this `{type(hamiltonian).__name__}` is not. "
                "If it is a sum of the two, give its parts: `SeparableHamiltonian("
                "kinetic, potential)` or `ConformalHamiltonian(kinetic, potential, "
                "damping)`. For any other use `PresymplecticCoupled()`."
            )
        if hamiltonian.is_quadratic or not self.tableau.quadratic:
            return view
        if hamiltonian.has_quadratic_potential:
            return Swapped(view)
        raise ValueError(
            f"`{name}` keeps its order only for a kinetic energy quadratic in the "
            "momentum, and known to be: write it as `QuadraticKinetic(mass)`; or for a "
            "potential known to be quadratic, `QuadraticPotential(stiffness)`. For any "
            "other use `BlanesMoan4()` or `BlanesMoan6()`."
        )

    def start(self, view: View, t, y: State):
        inner = self.variables(view)
        # The force that ends a step starts the next, if the step starts with a kick.
        if not self.tableau.kick_first:
            return None
        return inner.potential_force(t, inner.enter(t, y))

    def advance(self, view: View, t0, t1, h, y: State, carry: PyTree):
        inner = self.variables(view)
        y = inner.enter(t0, y)
        fractions = self.tableau.fractions
        kick_first = self.tableau.kick_first
        if kick_first:
            y = kick(y, fractions[0] * h, carry)
            fractions = fractions[1:]
        drifts, kicks = fractions[0::2], fractions[1::2]
        clock, order = Clock(t0, t1, h), self.tableau.order

        def stage(state, moves):
            start, end, drift, impulse = moves
            y, _ = state
            y = inner.drift(clock(start), drift * h, y, order)
            force = inner.potential_force(clock(end), y)
            return (kick(y, impulse * h, force), force if kick_first else None), None

        table = stage_table(drifts, h)
        paired = *(x[: len(kicks)] for x in table), cast_to(np.array(kicks), h)
        (y, carry), _ = scan_stages(stage, (y, carry), paired)
        if not kick_first:
            start, _, drift = (x[-1] for x in table)
            y = inner.drift(clock(start), drift * h, y, order)
        return inner.leave(t1, y), carry, None

    def pull_back(self, view: View, wanted: PyTree, t0, t1, h, end, bar):
        if self.variables(view) is not view:
            return super().pull_back(view, wanted, t0, t1, h, end, bar)
        fractions, kick_first = self.tableau.fractions, self.tableau.kick_first
        clock, order = Clock(t0, t1, h), self.tableau.order
        drifts, kicks = fractions[kick_first::2], fractions[1 + kick_first :: 2]
        table = stage_table(drifts, h)
        gradient = jtu.tree_map(jnp.zeros_like, eqx.filter(view, wanted))
        (y, force), (y_bar, force_bar) = end, bar

        # Move by move, as `advance` made them, so that none is made more often than it
        # must be.
        def drift(start, end, length):
            there = lambda view, y: view.drift(clock(start), length * h, y, order)
            back = lambda y: view.drift(clock(end), -length * h, y, order)
            return back, there

        def stage(state, moves):
            (y, y_bar, force_bar), gradient = state
            *times, impulse = moves
            back, there = drift(*times)
            t = clock(times[1])

            def undo(y):
                return back(kick(y, -impulse * h, view.potential_force(t, y)))

            def redo(view, y):
                y = there(view, y)
                force = view.potential_force(t, y)
                return kick(y, impulse * h, force), force

            pulled = pull_back(undo, redo, view, wanted, y, (y_bar, force_bar))
            y, more, y_bar = pulled
            # Only the last force is carried on.
            none = jtu.tree_map(jnp.zeros_like, force_bar)
            return ((y, y_bar, none), tree_sum(gradient, more)), None

        if not kick_first:
            pulled = pull_back(*drift(*(x[-1] for x in table)), view, wanted, y, y_bar)
            y, more, y_bar = pulled
            gradient = tree_sum(gradient, more)
            force_bar = jtu.tree_map(jnp.zeros_like, y[1])
        paired = *(x[: len(kicks)] for x in table), cast_to(np.array(kicks), h)
        state = (y, y_bar, force_bar), gradient
        ((y, y_bar, _), gradient), _ = scan_stages(stage, state, paired, reverse=True)
        if kick_first:
            force = view.potential_force(t0, y)
            first = fractions[0] * h
            y = kick(y, -first, force)
            _, pull = jax.vjp(lambda y, force: kick(y, first, force), y, force)
            y_bar, force_bar = pull(y_bar)
        else:
            force, force_bar = end[1], bar[1]
        return (y, force), gradient, (y_bar, force_bar)

    def slope(self, view: View, t, y: State, carry: PyTree) -> State:
        # What is carried is all of the force only if none of it is kinetic, and if it
        # is a force.
        known = view.is_separable and self.variables(view) is view
        return view.slope(t, y, force=carry if known else None)


class Splitting(AbstractSplitting):
    """Any splitting into exact drifts and kicks, by a tableau of your own.

    Order as the tableau claims; one force evaluation per kick, and one less if the step
    starts with a kick. Uses Hermite interpolation for dense/ts output, of 3rd order, or
    of 5th if the order of the scheme exceeds 4.

    For Hamiltonians whose kinetic part has a known flow. Where it has, these schemes
    are far more accurate than compositions at equal cost.
    """

    tableau: SplittingTableau = eqx.field(static=True)

    def __init__(self, tableau: SplittingTableau):
        """**Arguments:**

        - `tableau`: a [`diffrax_presym.SplittingTableau`][].

        **Raises:**

        `ValueError` if the drifts or the kicks do not sum to one, or do not take turns
        from the first move to a last of the same kind; or if the order is not a
        positive integer.
        """
        if not isinstance(tableau, SplittingTableau):
            raise ValueError(
                "`Splitting` needs a tableau, `Splitting(SplittingTableau(order, "
                f"kick_first, quadratic, fractions))`, but got {tableau!r}."
            )
        if not isinstance(tableau.order, int) or tableau.order < 1:
            raise ValueError(
                "`SplittingTableau(order=...)` must be a positive integer, but got "
                f"{tableau.order!r}."
            )
        fractions = tuple(float(x) for x in tableau.fractions)
        first, second = fractions[0::2], fractions[1::2]
        sums = math.fsum(first), math.fsum(second)
        if len(first) != len(second) + 1 or any(not abs(x - 1) < 1e-12 for x in sums):
            names = ("kicks", "drifts")[:: 1 if tableau.kick_first else -1]
            raise ValueError(
                "`SplittingTableau(fractions=...)` needs drifts that sum to one and "
                "kicks that sum to one, by turns, an odd number of moves in all; but "
                f"got {len(first)} {names[0]} that sum to {sums[0]} and {len(second)} "
                f"{names[1]} that sum to {sums[1]}. To scale them, divide each kind by "
                "its sum."
            )
        self.tableau = tableau._replace(fractions=fractions)


class Strang(AbstractSplitting):
    """Strang's splitting: kick, drift, kick; the leapfrog with an exact drift.

    2nd order and symmetric. One force evaluation per step. Uses 3rd order Hermite
    interpolation for dense/ts output, at no cost for a separable Hamiltonian and of two
    more for any other.

    For any Hamiltonian with a kinetic part of known flow, above all
    [`diffrax_presym.BregmanHamiltonian`][], for which it is explicit where
    [`diffrax_presym.PresymplecticLeapfrog`][] is not.

    ??? cite "Reference"

        ```bibtex
        @article{strang1968construction,
            author={Strang, Gilbert},
            title={On the construction and comparison of difference schemes},
            journal={SIAM Journal on Numerical Analysis},
            volume={5},
            number={3},
            pages={506--517},
            year={1968},
        }
        ```
    """

    tableau: ClassVar[SplittingTableau] = STRANG


class BlanesMoan4(AbstractSplitting):
    """Blanes and Moan's fourth-order splitting S6, for any kinetic energy.

    4th order and symmetric. Six force evaluations per step. Uses 3rd order
    Hermite interpolation for dense/ts output, at the cost of two more.

    For any Hamiltonian with a kinetic part of known flow, such as a relativistic one.
    If that or the potential is quadratic, [`diffrax_presym.BlanesMoanRKN4`][] is faster
    still.

    ??? cite "Reference"

        ```bibtex
        @article{blanes2002practical,
            author={Blanes, Sergio and Moan, Per Christian},
            title={Practical symplectic partitioned {R}unge--{K}utta and
                   {R}unge--{K}utta--{N}ystr{\\"o}m methods},
            journal={Journal of Computational and Applied Mathematics},
            volume={142},
            number={2},
            pages={313--330},
            year={2002},
        }
        ```
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_4


class BlanesMoan6(AbstractSplitting):
    """Blanes and Moan's sixth-order splitting S10, for any kinetic energy.

    6th order and symmetric. Ten force evaluations per step. Uses 5th order Hermite
    interpolation for dense/ts output, at the cost of the force and its derivative along
    the flow at both ends.

    For any Hamiltonian with a kinetic part of known flow. If that or the potential is
    quadratic, [`diffrax_presym.TunedRKN6`][] is faster still.

    Source: Blanes and Moan (2002), see [`diffrax_presym.BlanesMoan4`][].
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_6


class BlanesMoanRKN4(AbstractSplitting):
    """Blanes and Moan's fourth-order Runge--Kutta--Nyström splitting SRKN 6b.

    4th order and symmetric. Six force evaluations per step. Uses 3rd order Hermite
    interpolation for dense/ts output, at no cost.

    For quadratic kinetic energies, or quadratic potentials, which it takes advantage
    of: the first choice for moderate accuracy.

    Source: Blanes and Moan (2002), see [`diffrax_presym.BlanesMoan4`][].
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_RKN_4


class BlanesMoanRKN6(AbstractSplitting):
    """Blanes and Moan's sixth-order Runge--Kutta--Nyström splitting SRKN 14a.

    6th order and symmetric. Fourteen force evaluations per step. Uses 5th order
    Hermite interpolation for dense/ts output, at the cost of the force and its
    derivative along the flow at both ends.

    For quadratic kinetic energies, or quadratic potentials, which it takes advantage
    of. [`diffrax_presym.TunedRKN6`][] is more accurate where motions oscillate.

    Source: Blanes and Moan (2002), see [`diffrax_presym.BlanesMoan4`][].
    """

    tableau: ClassVar[SplittingTableau] = BLANES_MOAN_RKN_6


class BlanesCasasRKN8(AbstractSplitting):
    """The eighth-order Runge--Kutta--Nyström splitting of Blanes, Casas et al.

    8th order and symmetric. Nineteen force evaluations per step. Uses 5th order
    Hermite interpolation for dense/ts output, at the cost of the force and its
    derivative along the flow at both ends.

    For quadratic kinetic energies, or quadratic potentials, which it takes advantage
    of: the first choice towards the limit of `float64`.

    ??? cite "Reference"

        ```bibtex
        @misc{blanes2022symmetric,
            author={Blanes, Sergio and Casas, Fernando and
                    Escorihuela-Tom{\\`a}s, Alejandro},
            title={{R}unge--{K}utta--{N}ystr{\\"o}m symplectic splitting methods of
                   order 8},
            year={2022},
            eprint={2202.01541},
            archivePrefix={arXiv},
            primaryClass={math.NA},
        }
        ```
    """

    tableau: ClassVar[SplittingTableau] = BLANES_CASAS_RKN_8


class TunedRKN6(AbstractSplitting):
    """A sixth-order Runge--Kutta--Nyström splitting, tuned for oscillations.

    6th order and symmetric. Fourteen force evaluations per step. Uses 5th order Hermite
    interpolation for dense/ts output, at the cost of two derivatives of the force along
    the flow.

    For quadratic kinetic energies, or quadratic potentials. With the same number of
    evaluations as [`diffrax_presym.BlanesMoanRKN6`][] it errs much less where motions
    oscillate about equilibria, as most do: the first choice from six digits on.

    Its coefficients are of this package: they fulfil the conditions of order 6, and
    make small what errors are left to an oscillator, over a range of frequencies, and
    at the next order to any force, `benchmarks/tuning.py`.
    """

    tableau: ClassVar[SplittingTableau] = TUNED_RKN_6


class TunedLinear8(AbstractSplitting):
    r"""A splitting for linear forces, with steps of half a period and more.

    8th order and symmetric for linear forces and constant friction. Fourteen force
    evaluations per step. Uses 5th order Hermite interpolation for dense/ts output, at
    the cost of two more and of two of the derivative of the force along the flow.

    For damped waves, networks of springs, quadratic objectives: anything whose force is
    linear in the positions, a matrix or a stencil. Per evaluation nothing else here
    takes steps as long: at step times highest frequency of 0.26 for each evaluation, or
    3.6 for a step, the error of a step is 1e-9. Its coefficients are tuned for a range
    of frequencies rather than for ever shorter steps. The friction is split between
    positions and momenta, $q = e^{-\eta / 2} x$, in which the motion is again that of
    oscillators, so that constant friction costs no accuracy up to rates of twice the
    highest frequency.

    Of 4th order, and worse than [`diffrax_presym.TunedRKN6`][], where the force is not
    linear, or it or the friction depends on time. Not for friction $\gamma / t$ from
    $t = 0$. Such long steps are longer than interpolation can follow: to save at many
    times, let the steps end there, with `diffrax.StepTo`.

    Its coefficients are of this package: `benchmarks/tuning.py`.
    """

    tableau: ClassVar[SplittingTableau] = TUNED_LINEAR_8

    def variables(self, view: View) -> Shared:
        kinetic = view.hamiltonian.quadratic_kinetic
        if kinetic is None:
            raise ValueError(
                "`TunedLinear8` needs a mass that does not depend on time, and known: "
                "write `ConformalHamiltonian(QuadraticKinetic(mass), potential, "
                "damping)` or `SeparableHamiltonian(QuadraticKinetic(mass), "
                "potential)`. For any other use `TunedRKN6()` or `BlanesMoan6()`."
            )
        return Shared(view, kinetic)


def kick(y: State, h, force: PyTree) -> State:
    q, p = y
    return q, tree_add(p, h, force)
