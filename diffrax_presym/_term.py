import diffrax as dfx
from jaxtyping import PyTree

from ._hamiltonian import AbstractHamiltonian
from ._misc import as_time, tree_scale
from ._split import State
from ._system import check_state, System


class HamiltonianTerm(dfx.AbstractTerm):
    r"""The equations of motion of a Hamiltonian, for `diffrax.diffeqsolve`.

    The state is a pair `(q, p)` of pytrees of one structure, the positions and the
    *mechanical* momenta (see [`diffrax_presym.AbstractHamiltonian`][]).

    The solvers of this package use the velocity, force and frame of the term. Any other
    Diffrax solver for ordinary differential equations accepts it too, and uses the full
    vector field $(\partial E/\partial p, -\partial E/\partial q - \eta'(t) \, p)$.

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
        return System(self.hamiltonian, args, 1).slope(as_time(t), y)

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf: State, control) -> State:
        return tree_scale(control, vf)


def as_system(terms: PyTree, args: PyTree) -> System:
    """The system of the term that `diffeqsolve` passes to a solver."""
    term, direction = terms, 1
    # Diffrax wraps a term to solve backwards in time. The wrapper is private, so it is
    # recognised by its two attributes.
    if hasattr(term, "term") and hasattr(term, "direction"):
        term, direction = term.term, term.direction
    if isinstance(term, HamiltonianTerm):
        return System(term.hamiltonian, args, direction)
    if type(term).__name__ == "AdjointTerm":
        raise ValueError(
            "`BacksolveAdjoint()` solves the adjoint equations, which are not "
            "Hamiltonian, with the same solver. Write "
            "`BacksolveAdjoint(solver=diffrax.Tsit5())`, or use the default "
            "`RecursiveCheckpointAdjoint()`."
        )
    raise ValueError(
        "Presymplectic solvers need a `HamiltonianTerm`, but got "
        f"`{type(term).__name__}`. Write `HamiltonianTerm(hamiltonian)`, or "
        "`HamiltonianTerm(VectorField(velocity, force))` for a hand-written vector "
        "field."
    )
