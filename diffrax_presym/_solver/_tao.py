import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from .._misc import as_positive, cast_to, tree_sub
from .._split import State
from .._system import System
from ._base import AbstractMoveSolver
from ._copies import coupling, exchange, largest, move_frames, paired_field
from ._engine import Moves, Stages


_Carry = tuple[State, State]


class PresymplecticTao(AbstractMoveSolver[_Carry]):
    r"""Tao's augmented integrator, explicit for every Hamiltonian.

    2nd order, symmetric, and conformally symplectic in the doubled phase space. Three
    evaluations of velocity and force per step. Uses 3rd order Hermite interpolation for
    dense/ts output, at the cost of two more.

    The system is doubled: the copy $(\bar q, \bar p)$ provides the arguments that would
    make the scheme implicit, and a harmonic coupling of strength $\xi$ holds it close.
    Both copies live in one moving frame and the coupling acts there, unscaled, so that
    it stays of the size of the dynamics however much the system is damped. The
    `solver_state` holds the copy, and the solution is the original.

    The scheme of the paper. For Hamiltonians that are not separable; of those,
    [`diffrax_presym.PresymplecticCoupled`][] is many times as accurate at equal cost,
    above all at higher orders, and has no coupling to choose.

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
            the step. Defaults to `None`, which takes $\xi = 3\pi / 16h$, half-way
            between such trouble and copies that part; this is for use on its own and
            not inside a [`diffrax_presym.Composition`][].

        **Raises:**

        `ValueError` if `coupling` is known not to be positive, and when the solve is
        traced if it is not one number.
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
        # The last map leaves its own arguments alone: its field starts the next step.
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
            "change with the step, or the order is lost. Write "
            "`PresymplecticTao(coupling)` with a few times the highest frequency of "
            "the system, or `PresymplecticCoupled(order)`, which needs none."
        )

    def distance(self, y: State, solver_state: _Carry) -> Array:
        """The largest difference between the copies, in any entry of `q` or `p`.

        **Arguments:**

        - `y`: the state at the end of a solve.
        - `solver_state`: the solver state there, by
            `SaveAt(t1=True, solver_state=True)`.
        """
        copy, _ = solver_state
        return largest(tree_sub(y, copy))

    def _angle(self, h: Array) -> Array:
        if self.coupling is None:
            return jnp.copysign(cast_to(3 * np.pi / 8, h), h)
        if jnp.shape(self.coupling) != ():
            raise ValueError(
                "`PresymplecticTao(coupling)` must be one number, but has shape "
                f"{jnp.shape(self.coupling)}. To compare several, solve side by side "
                "with `jax.vmap`."
            )
        return 2 * cast_to(self.coupling, h) * h
