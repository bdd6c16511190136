import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from .._misc import as_positive, cast_to, tree_add, tree_scale, tree_sub
from .._term import State, View
from ._base import AbstractPresymplecticSolver


_Carry = tuple[State, State]


class PresymplecticTao(AbstractPresymplecticSolver[_Carry]):
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

    def order(self, terms):
        return 2

    def start(self, view: View, t, y: State) -> _Carry:
        return y, paired_field(view, t, y, y)

    def advance(self, view: View, t0, t1, h, y: State, carry: _Carry):
        half = h / 2
        middle = t0 + half
        copy, field = carry
        y, copy = exchange(half, field, y, copy)
        y, copy = (move_frame(view, t0, half, x) for x in (y, copy))
        copy, y = exchange(half, paired_field(view, middle, copy, y), copy, y)
        y, copy = _rotate(self._angle(h), y, copy)
        copy, y = exchange(half, paired_field(view, middle, copy, y), copy, y)
        y, copy = (move_frame(view, middle, half, x) for x in (y, copy))
        # The last map leaves its own arguments alone: its field starts the next step.
        field = paired_field(view, t1, y, copy)
        y, copy = exchange(half, field, y, copy)
        return y, (copy, field), None

    def slope(self, view: View, t, y: State, carry: _Carry) -> State:
        return view.slope(t, y)

    def distance(self, y: State, solver_state: _Carry) -> Array:
        """The largest difference between the copies, in any entry of `q` or `p`.

        **Arguments:**

        - `y`: the state at the end of a solve.
        - `solver_state`: the solver state there, by
            `SaveAt(t1=True, solver_state=True)`.
        """
        copy, _ = solver_state
        return largest(tree_sub(y, copy))

    def _angle(self, h):
        if self.coupling is None:
            return jnp.copysign(cast_to(3 * np.pi / 8, h), h)
        if jnp.shape(self.coupling) != ():
            raise ValueError(
                "`PresymplecticTao(coupling)` must be one number, but has shape "
                f"{jnp.shape(self.coupling)}. To compare several, solve side by side "
                "with `jax.vmap`."
            )
        return 2 * cast_to(self.coupling, h) * h


def paired_field(view: View, t, y: State, copy: State) -> State:
    """Velocity and force where `q` is of one copy and `p` of the other."""
    at = (y[0], copy[1])
    return view.velocity(t, at), view.force(t, at)


def exchange(h, field: State, y: State, copy: State) -> tuple[State, State]:
    """The flow of `H(t, q, p_copy)`: equation (tao_map1)."""
    velocity, force = field
    (q, p), (q_copy, p_copy) = y, copy
    return (q, tree_add(p, h, force)), (tree_add(q_copy, h, velocity), p_copy)


def move_frame(view: View, t, h, y: State) -> State:
    q, p = y
    return q, view.move_frame(t, h, p)


def _rotate(angle, y: State, copy: State) -> tuple[State, State]:
    """The flow of the coupling, which turns the difference: equation (tao_map2)."""
    mean = jtu.tree_map(lambda a, b: (a + b) / 2, y, copy)
    half = turn(angle, jtu.tree_map(lambda a, b: (a - b) / 2, y, copy))
    return tree_add(mean, 1, half), tree_sub(mean, half)


def turn(angle, y: State, scale: ArrayLike = 1.0) -> State:
    """`q` and `p` turned into each other, with `q` in units of `scale`.

    Both change at once. One after the other they would still look right in the energy,
    and not be symplectic.
    """
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    q, p = y
    q1 = tree_add(tree_scale(cos, q), sin * scale, p)
    return q1, tree_add(tree_scale(cos, p), -sin / scale, q)


def largest(x: State) -> Array:
    """The largest of all entries, without its sign."""
    sizes = jtu.tree_map(lambda x: jnp.max(jnp.abs(x), initial=0), x)
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_reduce(jnp.maximum, sizes)
