"""The families of Hamiltonians of the paper, as systems."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._friction._base import Mechanics, Parts
from .._friction._damping import AbstractDamping, as_laws, ConstantDamping
from .._friction._fit import fit_friction, one_rate
from .._friction._linear import LinearFriction
from .._misc import check_callable, Scalar, scalar_fn, Time, tree_scale
from ._energy import Hamiltonian
from ._kinetic import (
    AbstractKinetic,
    as_kinetic,
    CallableKinetic,
    integrate,
    prepare_quadrature,
)
from ._mechanical import MechanicalSystem


def ConformalHamiltonian(
    kinetic=None, potential=None, damping=None, *, energy=None
) -> MechanicalSystem | Hamiltonian:
    r"""Any energy $E$ with friction: $q' = \partial E/\partial p$ and
    $p' = -\partial E/\partial q - \eta'(t) \, p$.

    The (generalised) conformal Hamiltonian systems, equations (gen_conf) and
    (new_ham_time) of França, Jordan and Vidal (2021), with
    $H(t, q, P) = e^{\eta(t)} E(t, q, e^{-\eta(t)} P)$. The energy may depend on time.

    **Arguments:**

    - `kinetic`, `potential`: a separable energy, as for
        [`diffrax_presym.MechanicalSystem`][].
    - `damping`: a law of one rate for all momenta such as
        [`diffrax_presym.ConstantDamping`][], or a function `eta(t)`, the integral of
        the rate. Defaults to no damping.
    - `energy`: in place of the first two an energy that is not separable, as for
        [`diffrax_presym.Hamiltonian`][].

    **Returns:**

    A [`diffrax_presym.MechanicalSystem`][] or a [`diffrax_presym.Hamiltonian`][].

    **Raises:**

    `ValueError` if both or neither of the two forms is given, if there is other
    friction than one rate for all momenta, and as for these classes.
    """
    if energy is None and kinetic is not None and potential is not None:
        system = MechanicalSystem(kinetic, potential, damping)
    elif energy is not None and kinetic is None and potential is None:
        system = Hamiltonian(energy, damping)
    else:
        raise ValueError(
            "`ConformalHamiltonian` needs either `kinetic` and `potential`, or "
            "`energy`. Write `ConformalHamiltonian(kinetic, potential, damping)` or "
            "`ConformalHamiltonian(energy=energy, damping=damping)`."
        )
    _ = system.damping  # An error if there is other friction.
    return system


def DissipativeHamiltonian(
    kinetic, potential, eta1, eta2, *, separable: bool = True
) -> MechanicalSystem | Hamiltonian:
    r"""The general family
    $H = e^{-\eta_1(t)} T(t, q, P) + e^{\eta_2(t)} f(t, q)$.

    Equation (gen_ham) of França, Jordan and Vidal (2021), where $P$ is the canonical
    momentum. The log scale is $\eta_2$, so the state holds
    $p = e^{-\eta_2(t)} P$ and the energy is
    $E = e^{-\eta_1 - \eta_2} T(t, q, e^{\eta_2} p) + f(t, q)$. For
    [`diffrax_presym.QuadraticKinetic`][] that is $e^{\eta_2 - \eta_1} T(p) + f$, and
    with $\eta_1 = \eta_2$ the same system as
    [`diffrax_presym.ConformalHamiltonian`][].

    The kinetic energies of this package do not evaluate the exponential of $\eta_2$
    itself. A plain function does, and overflows in `float32` once $2 \eta_2$ exceeds
    88.

    **Arguments:**

    - `kinetic`: the kinetic energy $T$ as a function of the *canonical* momentum: for
        example [`diffrax_presym.QuadraticKinetic`][], or a function `T(t, P, args)`;
        with `separable=False`, a function `T(t, q, P, args)`.
    - `potential`: the function $f$ to minimise, or potential energy, a function
        `f(t, q, args)` that returns a scalar.
    - `eta1`, `eta2`: damping laws or functions of time.
    - `separable`: whether `kinetic` does not depend on `q`. Defaults to `True`.

    **Returns:**

    A [`diffrax_presym.MechanicalSystem`][] or a [`diffrax_presym.Hamiltonian`][].

    **Raises:**

    `ValueError` if any of these has the wrong type, and when the solve is traced if a
    function returns values of the wrong shape.
    """
    eta1, eta2 = _as_damping(eta1, "`eta1`"), _as_damping(eta2, "`eta2`")
    if separable:
        kinetic = _ScaledKinetic(as_kinetic(kinetic), eta1, eta2)
        return MechanicalSystem(kinetic, potential, eta2)
    if isinstance(kinetic, AbstractKinetic) or not callable(kinetic):
        raise ValueError(
            "`DissipativeHamiltonian(..., separable=False)` needs `kinetic` to be a "
            f"function `T(t, q, P, args)`, but got {kinetic!r}."
        )
    check_callable(potential, "potential", "f(t, q, args)")
    return Hamiltonian(_ScaledEnergy(kinetic, potential, eta1, eta2), eta2)


def _as_damping(law, name: str) -> AbstractDamping:
    mechanics = Mechanics(None, has_mass=False)
    parts = sum((x.parts(mechanics) for x in as_laws(law, name)), Parts())
    damping = one_rate(parts)
    return ConstantDamping(0.0) if damping is None else damping


class _ScaledKinetic(AbstractKinetic):
    # exp(-eta1 - eta2) T(exp(eta2) p), as exp(eta2 - eta1) times the rescaled T.
    kinetic: AbstractKinetic
    eta1: AbstractDamping
    eta2: AbstractDamping
    is_autonomous: ClassVar[bool] = False

    @property
    def is_quadratic(self) -> bool:
        return self.kinetic.is_quadratic

    def _parts(self, t: Time):
        # Where it is minus infinity, as of 3 / t at zero, it has no derivatives.
        infinite = jnp.isneginf(self.eta2(t))
        eta2 = self.eta2(jnp.where(infinite, t + 1, t))
        eta2 = jnp.where(infinite, -jnp.inf, eta2)
        return jnp.exp(eta2 - self.eta1(t)), self.kinetic.rescale(eta2)

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        scale, kinetic = self._parts(t)
        return tree_scale(scale, scalar_fn(kinetic, "The kinetic energy")(t, p, args))

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        scale, kinetic = self._parts(t)
        return tree_scale(scale, kinetic.velocity(t, p, args))

    def _by_eta1(self, p: PyTree) -> LinearFriction:
        linear = self.eta1.parts(Mechanics(None, has_mass=False)).linear
        friction = fit_friction(linear, Mechanics(None), p)
        assert friction is not None
        return friction

    def prepare(self, friction, t, h, order):
        if not self.is_quadratic:
            return prepare_quadrature(friction, t, h, order)
        assert friction is not None
        # exp(eta2 - eta1) times the decay of p, exp(-eta2), decays like exp(-eta1).
        displacement = self._by_eta1(jnp.zeros_like(h)).prepare(t, h, order)
        return self._parts(t)[0], displacement, friction.prepare(t, h, order)

    def flow(self, friction: Any, t, h, data, p, args):
        if not self.is_quadratic:
            return integrate(self.velocity, friction, t, h, data, p, args)
        scale, displacement, decay = data
        ((_, carried, _),) = displacement.leaves
        dq = self.kinetic.velocity(t, tree_scale(scale * carried, p), args)
        return dq, friction.decay(decay, p)

    def rescale(self, s: Scalar) -> "AbstractKinetic":
        return _ScaledKinetic(self.kinetic.rescale(s), self.eta1, self.eta2)


class _ScaledEnergy(eqx.Module):
    kinetic: Callable
    potential: Callable
    eta1: AbstractDamping
    eta2: AbstractDamping

    def __call__(self, t: Time, q: PyTree, p: PyTree, args: PyTree) -> Any:
        at_q = CallableKinetic(lambda t, P, args: self.kinetic(t, q, P, args))
        kinetic = _ScaledKinetic(at_q, self.eta1, self.eta2)(t, p, args)
        potential = scalar_fn(self.potential, "The potential")(t, q, args)
        with jax.numpy_dtype_promotion("standard"):
            return kinetic + potential
