import abc
from collections.abc import Callable

import equinox as eqx
import jax
import lineax as lx
from jaxtyping import Array, Inexact, PyTree

from .. import _tree as tree
from .._checks import check_callable, match, scalar_fn
from .._forms import as_form, is_symmetric, multiply
from .._friction._base import AbstractFriction
from .._numbers import Scalar, Time
from ._kinetic import AbstractKinetic


_STIFFNESS = "`QuadraticPotential(stiffness)`"
_NO_FUNCTION = (
    " A potential energy that is a function is passed as it is: "
    "`MechanicalSystem(kinetic, V)`."
)


class AbstractPotential(eqx.Module):
    """A potential energy `V(t, q, args)` and its force."""

    @abc.abstractmethod
    def __call__(self, t: Time, q: PyTree, args: PyTree = None) -> Scalar:
        """The potential energy of the whole system, a scalar."""

    @abc.abstractmethod
    def force(self, t: Time, q: PyTree, args: PyTree = None) -> PyTree:
        """The force `-∂V / ∂q`."""


AbstractPotential.__init__.__doc__ = "**Arguments:** its fields, if any."


class QuadraticPotential(AbstractPotential):
    """The potential energy `V(q) = q · K q / 2` of linear springs.

    It tells solvers that the force is linear. Runge--Kutta--Nyström splittings then
    accept any kinetic energy, by swapping the roles of positions and momenta, and the
    force is one product with `K`.
    """

    stiffness: PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None
    symmetric: bool = eqx.field(static=True)

    def __init__(self, stiffness=None):
        """**Arguments:**

        - `stiffness`: the stiffness `K`, of any sign, in any of these forms. Defaults
            to `None`.
            - `None`: unit stiffness.
            - A number: the same stiffness for every degree of freedom.
            - An array with as many dimensions as `q`, and broadcastable to it: a
                stiffness for each degree of freedom.
            - A symmetric matrix, with `q` a vector.
            - An array with one dimension more than `q`: a symmetric matrix for each
                vector over the last axis of `q`.
            - A pytree of the structure of `q`, whose leaves are any of the above.
            - A symmetric `lineax.AbstractLinearOperator` acting on `q`'s space, such as
                the stencil of a grid as a `lineax.FunctionLinearOperator`, whose
                function may close over parameters to be differentiated.

        **Raises:**

        `ValueError` if a stiffness is not a finite real number or array; and when the
        solve is traced, if its shape does not fit `q`, or if it is a matrix that was
        not symmetric when this was made. That is not checked of traced arrays, nor of
        operators other than `lineax.MatrixLinearOperator`.
        """
        self.stiffness = as_form(stiffness, _STIFFNESS, _NO_FUNCTION)
        self.symmetric = is_symmetric(stiffness)

    def __call__(self, t: Time, q: PyTree, args: PyTree = None) -> Scalar:
        return -tree.dot(q, self.force(t, q)) / 2

    def force(self, t: Time, q: PyTree, args: PyTree = None) -> PyTree:
        product = multiply(self.stiffness, q, _STIFFNESS, "q", self.symmetric)
        return tree.scale(-1, product)


class ForceField(AbstractPotential):
    """A force that depends on time and place, without a potential energy.

    As the potential of a `MechanicalSystem`: for measured force fields, stochastic
    gradients, forces that are not conservative, or potentials too expensive to compute.
    Every scheme accepts it, but is (pre)symplectic only if the force derives from an
    energy.
    """

    fn: Callable

    def __init__(self, force: Callable):
        """**Arguments:**

        - `force`: a function `force(t, q, args)`, of the structure and shape of `q`.

        **Raises:**

        `ValueError` if it is not a function, when the solve is traced if it returns
        values of the wrong shape, and if the energy is evaluated.
        """
        check_callable(force, "force", "force(t, q, args)")
        self.fn = force

    def __call__(self, t: Time, q: PyTree, args: PyTree = None) -> Scalar:
        raise ValueError(
            "A `ForceField` has no energy, only a force. If it derives from an energy "
            "V(t, q), write `MechanicalSystem(kinetic, potential)` with a function "
            "`V(t, q, args)` instead."
        )

    def force(self, t: Time, q: PyTree, args: PyTree = None) -> PyTree:
        return match(self.fn(t, q, args), q, "`force`", "`q`")


class CallablePotential(AbstractPotential):
    """Any function `V(t, q, args)` as a potential energy, differentiated by JAX."""

    fn: Callable

    def __call__(self, t: Time, q: PyTree, args: PyTree = None) -> Scalar:
        return scalar_fn(self.fn, "The potential")(t, q, args)

    def force(self, t: Time, q: PyTree, args: PyTree = None) -> PyTree:
        return tree.scale(-1, jax.grad(self.__call__, argnums=1)(t, q, args))


def as_potential(potential) -> AbstractPotential:
    if isinstance(potential, AbstractPotential):
        return potential
    # Kinetic energies and laws of friction are callable too, but mean that the
    # arguments are in the wrong order.
    if isinstance(potential, AbstractKinetic | AbstractFriction):
        raise ValueError(
            "`potential` must be a function `V(t, q, args)`, but got "
            f"{potential!r}. The order is `(kinetic, potential, friction)`; for an "
            "energy that is not a sum of the two write `Hamiltonian(energy)`."
        )
    check_callable(potential, "potential", "V(t, q, args)")
    return CallablePotential(potential)
