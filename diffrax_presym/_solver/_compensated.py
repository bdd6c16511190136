import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact, PyTree

from .._misc import as_positive, cast_to, Sum, tree_add
from .._term import State, View
from ._base import AbstractPresymplecticSolver


class Compensated(AbstractPresymplecticSolver[tuple[PyTree, State]]):
    """Any explicit scheme, with the digits that its sums lose carried along.

    Order, structure and dense/ts output are those of the base; no more evaluations.
    Each kick and each drift adds a small number to a large one. What rounding drops is
    kept in the `solver_state` and added to the next, so that the errors left are
    smaller than rounding by about the length of the step.

    For very many steps without damping, in `float32` above all. Not for energies that
    are not separable; nor where friction is strong, which forgets rounding anyway.

    ??? cite "Reference"

        Section VIII.5 of Hairer, Lubich and Wanner, see the references; after

        ```bibtex
        @article{moller1965quasi,
            author={M{\\o}ller, Ole},
            title={Quasi double-precision in floating point addition},
            journal={BIT Numerical Mathematics},
            volume={5},
            pages={37--50},
            year={1965},
        }
        ```
    """

    base: AbstractPresymplecticSolver
    length: Inexact[Array, ""] | None

    def __init__(self, base: AbstractPresymplecticSolver, length=None):
        """**Arguments:**

        - `base`: a presymplectic solver made of kicks and drifts: Euler, leapfrog, or a
            composition or splitting.
        - `length`: the length of a step, if all are of one length: the `dt0` of the
            solve. The difference of two times is then replaced by it where the two
            agree to the rounding of the times. In `float32` that is worth as much as
            the rest: at a time of 1e4 steps of 0.01 vary by a tenth. Defaults to
            `None`, the difference.

        **Raises:**

        `ValueError` if `base` is no presymplectic solver or `length` is known not to be
        positive; and when the solve is traced, for Hamiltonians that are not separable.
        """
        if not isinstance(base, AbstractPresymplecticSolver):
            raise ValueError(
                "`base` must be a presymplectic solver, for example "
                f"`PresymplecticLeapfrog()`, but got {base!r}."
            )
        self.base = base
        self.length = (
            None if length is None else as_positive(length, "`Compensated(length=...)`")
        )

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric

    def order(self, terms):
        return self.base.order(terms)

    def start(self, view: View, t, y: State):
        if not view.is_separable:
            raise ValueError(
                "`Compensated` needs a separable Hamiltonian, the sum of kinetic and "
                f"potential energy, but this `{type(view.hamiltonian).__name__}` is "
                "not. Use the solver without it."
            )
        return self.base.start(view, t, y), jtu.tree_map(jnp.zeros_like, y)

    def advance(self, view: View, t0, t1, h, y: State, carry):
        carry, lost = carry
        if self.length is not None:
            h = _nominal(cast_to(self.length, h), h, t0, t1)
        sums = _Sums(view.hamiltonian, view.args, view.direction)
        y, carry, result = self.base.advance(
            sums, t0, t1, h, jtu.tree_map(Sum, y, lost), carry
        )
        return _part(y, "value"), (carry, _part(y, "lost")), result

    def slope(self, view: View, t, y: State, carry) -> State:
        return self.base.slope(view, t, y, carry[0])


def _nominal(length, h, t0, t1):
    """The nominal length, if it is that of the step as far as can be told."""
    length = jnp.copysign(length, h)
    ulp = jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    return jnp.where(jnp.abs(h - length) <= 2 * ulp, length, h)


def _part(y: PyTree, name: str) -> PyTree:
    is_sum = lambda x: isinstance(x, Sum)
    return jtu.tree_map(lambda x: getattr(x, name), y, is_leaf=is_sum)


class _Sums(View):
    """What a scheme sees whose positions and momenta are sums."""

    def values(self, x):
        return _part(x, "value")

    def velocity(self, t, y):
        return View.velocity(self, t, self.values(y))

    def force(self, t, y):
        return View.force(self, t, self.values(y))

    def potential_force(self, t, y):
        return View.potential_force(self, t, self.values(y))

    def move_frame(self, t, h, p, share=1):
        damping = self.hamiltonian.damping
        if damping is None:
            return p
        # As an increment, which rounds less than a product.
        lost = jnp.expm1(-share * damping.increment(t, h))
        return tree_add(p, lost, self.values(p))

    def drift(self, t, h, y, order):
        # How far `q` moves does not depend on `q`.
        q, p = y
        zero = jax.tree.map(jnp.zeros_like, self.values(q))
        moved, _ = View.drift(self, t, h, (zero, self.values(p)), order)
        return tree_add(q, 1, moved), self.move_frame(t, h, p)
