"""The scheme of Tao, with two copies of the system, explicit for any energy.

Each copy takes arguments from the other, and both share one moving frame. The state
within a step is `y, (copy, field)`, with the velocity and force of the last exchange.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, PyTree

from .. import _tree as tree
from .._checks import as_positive
from .._numbers import cast_to, State
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, refuse_constrained, Scheme
from ._engine import AbstractMove, MoveSequence, Outcome, Span, StepState


# Over a step: the momentum of the slow motion of an overdamped oscillator is then twice
# what it should be. Friction 3 / t from rest is within it.
_MOST_FRICTION = 3.2


class Exchange(AbstractMove):
    """The flow of `H(t, q, p_copy)`, equation (tao_map1), or of `H(t, q_copy, p)`, for
    the `second` copy. The field may be known, from the last exchange."""

    second: bool = eqx.field(static=True, default=False)
    known: bool = eqx.field(static=True, default=False)

    def apply(
        self, system: System, span: Span, data: None, stage: StepState
    ) -> Outcome:
        if not self.known:
            # The map does not change the arguments of its field: it is its own inverse.
            return self.undo(system, span, data, stage)
        return self._by(stage[1][1], system, span, stage), None

    def undo(self, system: System, span: Span, data: None, stage: StepState) -> Outcome:
        y, (copy, _) = stage
        one, other = (copy, y) if self.second else (y, copy)
        field = system.velocity_and_force(span.t0, (one[0], other[1]))
        return self._by(field, system, span, stage), None

    def _by(
        self, field: State, system: System, span: Span, stage: StepState
    ) -> StepState:
        y, (copy, carried) = stage
        velocity, force = tree.scale(span.h, field)
        if self.second:
            y, copy = system.add(y, (velocity, None)), system.add(copy, (None, force))
            return y, (copy, carried)
        y, copy = system.add(y, (None, force)), system.add(copy, (velocity, None))
        return y, (copy, field)


class MoveFrames(AbstractMove):
    """Friction alone, of both copies."""

    def prepare(self, system: System, span: Span) -> PyTree:
        return system.prepare_decay(span.t0, span.h)

    def is_autonomous(self, system: System) -> bool:
        return system.prepares_once

    def apply(
        self, system: System, span: Span, data: PyTree, stage: StepState
    ) -> Outcome:
        y, (copy, field) = stage
        return (system.decay(data, y), (system.decay(data, copy), field)), None

    undo = apply  # of the reversed span


class Coupling(AbstractMove):
    """The difference of the copies, rotated: equation (tao_flow)."""

    strength: Inexact[Array, ""] | None

    def prepare(self, system: System, span: Span) -> Array:
        h = span.h
        if self.strength is None:
            return jnp.copysign(cast_to(3 * np.pi / 8, h), h)
        return 2 * cast_to(self.strength, h) * h

    def is_autonomous(self, system: System) -> bool:
        return True

    def apply(
        self, system: System, span: Span, data: Array, stage: StepState
    ) -> Outcome:
        y, (copy, field) = stage
        half = tree.scale(0.5, tree.sub(y, copy))
        change = tree.add_scaled(rotate(data, half), -1, half)
        copy = system.add(copy, tree.scale(-1, change))
        return (system.add(y, change), (copy, field)), None

    undo = apply  # of the reversed span


def rotate(angle: Array, y: State) -> State:
    """`q` and `p` rotated into each other.

    Both are updated at once. Sequential updates would not be symplectic, although the
    energy would look right.
    """
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    q, p = y
    q1 = tree.add_scaled(tree.scale(cos, q), sin, p)
    return q1, tree.add_scaled(tree.scale(cos, p), -sin, q)


class PresymplecticTao(AbstractPresymplecticSolver):
    """Tao's augmented integrator, explicit for every Hamiltonian.

    2nd order, symmetric, and conformally symplectic in the doubled phase space. Three
    evaluations of velocity and force per step. Uses 3rd order Hermite interpolation for
    dense/ts output in Diffrax's own loop, at the cost of two more; in that of
    `FixedStepAdjoint` a saved time between steps is a shorter step.

    The phase space is doubled: the copy `(q2, p2)` replaces the arguments that would
    make the scheme implicit, and a harmonic coupling of strength `ξ` keeps it close.
    Both copies share one moving frame, in which the coupling acts unscaled, so that it
    stays of the size of the dynamics under damping. The solution is the original, and
    the `solver_state` holds the copy.

    The scheme of the paper for nonseparable Hamiltonians. `PresymplecticGauss` is
    faster to almost any error, preserves the structure in the phase space itself, and
    has no coupling to choose. A step of more friction than 3.2, the rate times its
    length, makes a solve fail.

    If the step is too long or the copies separate, a solve ends with
    `RESULTS.nonfinite` or has no accuracy: compare its energies. Take shorter steps, or
    a stronger coupling.

    ??? cite "Reference"

        Equations (tao_ham) to (tao_flow) of França, Jordan and Vidal (2021), after

        ```bibtex
        @article{tao2016explicit,
            author={Tao, Molei},
            title={Explicit symplectic approximation of nonseparable {H}amiltonians:
                Algorithm and long time performance}, journal={Physical Review E},
            volume={94}, number={4}, pages={043303}, year={2016}}
        ```
    """

    coupling: Inexact[Array, ""] | None

    def __init__(self, coupling=None):
        """**Arguments:**

        - `coupling`: the strength `ξ` of the coupling, positive, in units of one over
            time. A few times the highest frequency of the system is a good value. Avoid
            `2 ξ h` near a multiple of `π`, where the coupling resonates with the step.
            Defaults to `None`, which is `ξ = 3π / 16h`, half-way between resonance and
            copies that drift apart. That is one angle per step of any length, so not
            for use inside a `Composition`, nor with `diffrax.HalfSolver`, whose error
            estimate then does not vanish with the step.

        **Raises:**

        `ValueError` if `coupling` is known not to be positive, and when the solve is
        traced if it is not a scalar.
        """
        if coupling is not None:
            coupling = as_positive(coupling, "`PresymplecticTao(coupling)`")
        self.coupling = coupling

    @property
    def is_symmetric(self) -> bool:
        return True

    def order(self, terms) -> int:
        return 2

    def scheme(self, system: System) -> Scheme:
        refuse_constrained(self, system)
        if self.coupling is not None and jnp.shape(self.coupling) != ():
            raise ValueError(
                "`PresymplecticTao(coupling)` must be a scalar, but has shape "
                f"{jnp.shape(self.coupling)}. To compare several, use `jax.vmap`."
            )
        frames = MoveFrames()
        # The last map does not change its arguments: the next step reuses its field.
        moves = (
            *(Exchange(known=True), frames, Exchange(second=True)),
            Coupling(self.coupling),
            *(Exchange(second=True), frames, Exchange()),
        )
        table = [
            *((0, 0, 0.5), (0, 0.5, 0.5), (0.5, 0.5, 0.5)),
            (0.5, 0.5, 1),
            *((0.5, 0.5, 0.5), (0.5, 1, 0.5), (1, 1, 0.5)),
        ]

        def at_kink(system: System, t: Array, y: State, carry: PyTree) -> PyTree:
            """The field of the first exchange, of the same copy."""
            copy, _ = carry
            return copy, system.velocity_and_force(t, (y[0], copy[1]))

        not_composable = None
        if self.coupling is None:
            not_composable = (
                "Inside a composition `PresymplecticTao` needs a coupling that does "
                "not change with the step size, or the order is lost. Write "
                "`PresymplecticTao(coupling)` with a few times the highest frequency "
                "of the system, or `PresymplecticGauss(stages)`, which needs none."
            )
        moves = MoveSequence(moves, table)
        return Scheme(
            moves,
            start=lambda system, t, y: at_kink(system, t, y, (y, None)),
            at_kink=at_kink,
            not_composable=not_composable,
            most_friction=_MOST_FRICTION,
        )
