import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from .._misc import as_positive, cast_to
from .._split import State
from .._system import System
from ._base import AbstractMoveSolver
from ._copies import coupling, exchange, move_frames, paired_field
from ._engine import Moves, Stages


_Carry = tuple[State, State]


class PresymplecticTao(AbstractMoveSolver[_Carry]):
    r"""Tao's augmented integrator, explicit for every Hamiltonian.

    2nd order, symmetric, and conformally symplectic in the doubled phase space. Three
    evaluations of velocity and force per step. Uses 3rd order Hermite interpolation for
    dense/ts output, at the cost of two more.

    The phase space is doubled: the copy $(\bar q, \bar p)$ replaces the arguments that
    would make the scheme implicit, and a harmonic coupling of strength $\xi$ keeps it
    close. Both copies share one moving frame, in which the coupling acts unscaled, so
    that it stays of the size of the dynamics under damping. The solution is the
    original, and the `solver_state` holds the copy.

    The scheme of the paper for nonseparable Hamiltonians.
    [`diffrax_presym.PresymplecticCoupled`][] is much more accurate at equal cost,
    especially at higher orders, and has no coupling to choose.

    ??? cite "Reference"

        Equations (tao_ham) to (tao_flow) of França, Jordan and Vidal (2021), after

        ```bibtex
        @article{tao2016explicit,
            author={Tao, Molei},
            title={Explicit symplectic approximation of nonseparable {H}amiltonians:
                   Algorithm and long time performance},
            journal={Physical Review E},
            volume={94},
            number={4},
            pages={043303},
            year={2016},
        }
        ```
    """

    coupling: Inexact[Array, ""] | None

    def __init__(self, coupling=None):
        r"""**Arguments:**

        - `coupling`: the strength $\xi$ of the coupling, positive, in units of one over
            time. A few times the highest frequency of the system is a good value.
            Avoid $2 \xi h$ near a multiple of $\pi$, where the coupling resonates with
            the step. Defaults to `None`, which is $\xi = 3\pi / 16h$, half-way between
            resonance and copies that drift apart; not for use inside a
            [`diffrax_presym.Composition`][].

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

    def start(self, system: System, t: Array, y: State) -> _Carry:
        return y, paired_field(system, t, y, y)

    def moves(self, system: System) -> Moves:
        # The last map does not change its arguments: the next step reuses its field.
        moves = (
            *(exchange(known=True), move_frames, exchange(second=True)),
            coupling(self._angle),
            *(exchange(second=True), move_frames, exchange()),
        )
        table = [
            *((0, 0, 0.5), (0, 0.5, 0.5), (0.5, 0.5, 0.5)),
            (0.5, 0.5, 1),
            *((0.5, 0.5, 0.5), (0.5, 1, 0.5), (1, 1, 0.5)),
        ]
        return Stages(moves, table)

    def composition_error(self) -> str | None:
        if self.coupling is not None:
            return None
        return (
            "Inside a composition `PresymplecticTao` needs a coupling that does not "
            "change with the step size, or the order is lost. Write "
            "`PresymplecticTao(coupling)` with a few times the highest frequency of "
            "the system, or `PresymplecticCoupled(order)`, which needs none."
        )

    def _angle(self, h: Array) -> Array:
        if self.coupling is None:
            return jnp.copysign(cast_to(3 * np.pi / 8, h), h)
        if jnp.shape(self.coupling) != ():
            raise ValueError(
                "`PresymplecticTao(coupling)` must be a scalar, but has shape "
                f"{jnp.shape(self.coupling)}. To compare several, use `jax.vmap`."
            )
        return 2 * cast_to(self.coupling, h) * h
