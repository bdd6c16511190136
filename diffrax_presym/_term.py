from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact, PyTree

from ._hamiltonian import AbstractHamiltonian
from ._hamiltonian._damping import add_friction, move_frame
from ._misc import cast_to, describe, tree_scale


State = tuple[PyTree[Inexact[Array, "..."]], PyTree[Inexact[Array, "..."]]]


# Also the closest there is to say of a state at which the energy is not defined. Older
# versions of Optimistix have no word for it.
NONFINITE: Any = getattr(dfx.RESULTS, "nonfinite", dfx.RESULTS.nonlinear_divergence)


class HamiltonianTerm(dfx.AbstractTerm):
    r"""The equations of motion of a Hamiltonian, for `diffrax.diffeqsolve`.

    The state is a pair `(q, p)` of pytrees of one structure, the positions and the
    *mechanical* momenta (see [`diffrax_presym.AbstractHamiltonian`][]).

    The solvers of this package ask the term for velocity, force and frame. Any other
    Diffrax solver for ordinary differential equations accepts it too, and is given the
    full vector field $(\partial E/\partial p, -\partial E/\partial q - \eta'(t) \, p)$.
    Comparing the two is changing one word.

    !!! example

        ```python
        hamiltonian = ConformalHamiltonian(
            QuadraticKinetic(),
            lambda t, q, args: jnp.sum(q**2) / 2,
            ConstantDamping(0.2),
        )
        sol = diffeqsolve(
            HamiltonianTerm(hamiltonian), PresymplecticLeapfrog(),
            t0=0.0, t1=10.0, dt0=0.1, y0=(jnp.array([1.0]), jnp.array([0.0])),
        )
        ```
    """

    hamiltonian: AbstractHamiltonian

    def __init__(self, hamiltonian: AbstractHamiltonian):
        """**Arguments:**

        - `hamiltonian`: any [`diffrax_presym.AbstractHamiltonian`][].

        **Raises:**

        `ValueError` if it is not one; and when the solve is traced, if the state is not
        a pair of real floating-point pytrees of one structure and shape.
        """
        if not isinstance(hamiltonian, AbstractHamiltonian):
            raise ValueError(
                f"`HamiltonianTerm` needs a Hamiltonian, but got {hamiltonian!r}. "
                "Write for example `HamiltonianTerm(SeparableHamiltonian(kinetic, "
                "potential))`, or `HamiltonianTerm(Hamiltonian(energy))` for a "
                "function `energy(t, q, p, args)`."
            )
        self.hamiltonian = hamiltonian

    def vf(self, t, y: State, args: PyTree) -> State:
        check_state(y)
        return View(self.hamiltonian, args, 1).slope(jnp.asarray(t), y)

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf: State, control) -> State:
        return tree_scale(control, vf)


class View(eqx.Module):
    """What a solver sees of a term: velocity, force and frame, in physical time."""

    hamiltonian: AbstractHamiltonian
    args: PyTree
    direction: int | Array

    @property
    def is_separable(self) -> bool:
        return self.hamiltonian.is_separable

    def time(self, t):
        """The physical time, which runs backwards where `direction` is -1."""
        return t * cast_to(self.direction, t)

    def velocity(self, t, y: State):
        return self.hamiltonian.velocity(t, *y, self.args)

    def check(self, t, y: State) -> dfx.RESULTS | None:
        """A failure where the energy is not defined."""
        valid = self.hamiltonian.is_valid(t, *y, self.args)
        if valid is None:
            return None
        return dfx.RESULTS.where(valid, dfx.RESULTS.successful, NONFINITE)

    def force(self, t, y: State):
        return self._stored(self.hamiltonian.force(t, *y, self.args), t, y)

    def velocity_and_force(self, t, y: State) -> State:
        velocity, force = self.hamiltonian.velocity_and_force(t, *y, self.args)
        return velocity, self._stored(force, t, y)

    def potential_force(self, t, y: State):
        """The force that a splitting kicks with."""
        return self._stored(self.hamiltonian.potential_force(t, *y, self.args), t, y)

    def _stored(self, force, t, y: State):
        # Selecting between two arrays, although always the first, makes XLA store the
        # force. It would rather recompute an elementwise force wherever it is used.
        return jtu.tree_map(lambda f, q: jnp.where(t == t, f, q), force, y[0])

    def values(self, x: PyTree) -> PyTree:
        """The numbers that stand for `x`, here itself."""
        return x

    def move_frame(self, t, h, p: PyTree, share: float = 1) -> PyTree:
        """`p` from the frame of `t` to the frame of `t + h`, or a share of the way."""
        return move_frame(self.hamiltonian.damping, t, h, p, share)

    def enter(self, t, y: State) -> State:
        """The variables that a splitting steps in, here the state itself."""
        return y

    def leave(self, t, z: State) -> State:
        return z

    def drift(self, t, h, y: State, order: int) -> State:
        """The flow of the kinetic part, frame included."""
        return self.hamiltonian.drift(t, h, *y, self.args, order)

    def slope(self, t, y: State, force=None) -> State:
        """The full vector field, of which the force may be known already."""
        damping = self.hamiltonian.damping
        if force is None:
            velocity, force = self.velocity_and_force(t, y)
        else:
            velocity = self.velocity(t, y)
        return velocity, add_friction(damping, t, force, y[1])

    def bend(self, t, y: State, slope: State) -> State:
        """The rate of change of the slope along the flow, the second derivative."""
        return jax.jvp(self.slope, (t, y), (jnp.ones_like(t), slope))[1]


def view(terms: PyTree, args: PyTree) -> View:
    """The view of the term that `diffeqsolve` hands to a solver."""
    term, direction = terms, 1
    # Diffrax wraps a term to solve backwards in time. Its wrapper is private, so it is
    # known here by its two attributes.
    if hasattr(term, "term") and hasattr(term, "direction"):
        term, direction = term.term, term.direction
    if isinstance(term, HamiltonianTerm):
        return View(term.hamiltonian, args, direction)
    if type(term).__name__ == "AdjointTerm":
        raise ValueError(
            "`BacksolveAdjoint()` solves the adjoint equations, which are not "
            "Hamiltonian, with the same solver. Write "
            "`BacksolveAdjoint(solver=diffrax.Tsit5())`, or use the default "
            "`RecursiveCheckpointAdjoint()`."
        )
    raise ValueError(
        "Presymplectic solvers step a `HamiltonianTerm`, but got "
        f"`{type(term).__name__}`. Write `HamiltonianTerm(hamiltonian)`, or "
        "`HamiltonianTerm(VectorField(velocity, force))` for a hand-written vector "
        "field."
    )


def check_state(y: PyTree) -> None:
    wanted = "The state must be a pair `(q, p)` of positions and momenta"
    if type(y) is not tuple or len(y) != 2:
        raise ValueError(f"{wanted}, but got {describe(y)}. Write `y0=(q0, p0)`.")
    q, p = y
    if describe(q) != describe(p):
        raise ValueError(
            f"{wanted} of one structure, shape and precision, but got q of "
            f"{describe(q)} and p of {describe(p)}."
        )
    for leaf in jtu.tree_leaves(y):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"{wanted} in real floating point, but got {describe(q)}. Convert "
                "them with `jnp.asarray(x, float)`, a complex number to its real and "
                "imaginary parts."
            )
