import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._friction import AbstractDamping, as_damping, check_scalar
from .._misc import scalar_fn, tree_scale
from ._energy import (
    AbstractMechanicalHamiltonian,
    check_potential,
    GeneralEnergy,
    SeparableEnergy,
)
from ._kinetic import (
    AbstractKinetic,
    as_kinetic,
    CallableKinetic,
    integrate_velocity,
)


class ConformalHamiltonian(AbstractMechanicalHamiltonian):
    r"""Any energy $E$ with friction: $q' = \partial E/\partial p$ and
    $p' = -\partial E/\partial q - \eta'(t) \, p$.

    The (generalised) conformal Hamiltonian systems, equations (gen_conf) and
    (new_ham_time) of França, Jordan and Vidal (2021), with
    $H(t, q, P) = e^{\eta(t)} E(t, q, e^{-\eta(t)} P)$. The energy may depend on time.

    One rate of damping acts on all momenta; for any other friction use
    [`diffrax_presym.MechanicalSystem`][].

    !!! warning

        Damping acts on the momentum $p$ of the energy, which is not always the mass
        times the velocity. With a vector potential, $E = |p - A(q)|^2 / 2$, or in
        general coordinates, it is not friction of the velocity, and the result depends
        on the choice of $A$. For a charge in a magnetic field with friction use
        [`diffrax_presym.ViscousDamping`][], for a mass matrix that depends on the
        positions [`diffrax_presym.LagrangianSystem`][].
    """

    E: SeparableEnergy | GeneralEnergy
    damping: AbstractDamping | None

    def __init__(
        self,
        kinetic=None,
        potential=None,
        damping=None,
        *,
        energy=None,
        velocity=None,
        force=None,
    ):
        """Write either `ConformalHamiltonian(kinetic, potential, damping)` or
        `ConformalHamiltonian(energy=energy, damping=damping)`.

        **Arguments:**

        - `kinetic`, `potential`: a separable energy, as for
            [`diffrax_presym.SeparableHamiltonian`][].
        - `damping`: a damping law such as [`diffrax_presym.ConstantDamping`][], or a
            function `eta(t)`, the integral of the rate of damping. Defaults to no
            damping.
        - `energy`: an energy that is not separable, as for
            [`diffrax_presym.Hamiltonian`][].
        - `velocity`, `force`: as for [`diffrax_presym.SeparableHamiltonian`][] or
            [`diffrax_presym.Hamiltonian`][].

        **Raises:**

        `ValueError` if both or neither of the two forms is given, and as for these
        classes.
        """
        if energy is None and kinetic is not None and potential is not None:
            self.E = SeparableEnergy(kinetic, potential, velocity, force)
        elif energy is not None and kinetic is None and potential is None:
            self.E = GeneralEnergy(energy, velocity, force)
        else:
            raise ValueError(
                "`ConformalHamiltonian` needs either `kinetic` and `potential`, or "
                "`energy`. Write `ConformalHamiltonian(kinetic, potential, damping)` "
                "or `ConformalHamiltonian(energy=energy, damping=damping)`."
            )
        self.damping = None if damping is None else as_damping(damping, "`damping`")


class DissipativeHamiltonian(AbstractMechanicalHamiltonian):
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
    """

    E: SeparableEnergy | GeneralEnergy
    damping: AbstractDamping | None

    def __init__(self, kinetic, potential, eta1, eta2, *, separable=True):
        r"""**Arguments:**

        - `kinetic`: the kinetic energy $T$ as a function of the *canonical* momentum:
            for example [`diffrax_presym.QuadraticKinetic`][], or a function
            `T(t, P, args)`; with `separable=False`, a function `T(t, q, P, args)`.
        - `potential`: the function $f$ to minimise, or potential energy, a function
            `f(t, q, args)` that returns a scalar.
        - `eta1`, `eta2`: damping laws or functions of time.
        - `separable`: whether `kinetic` does not depend on `q`. Defaults to `True`.

        **Raises:**

        `ValueError` if any of these has the wrong type, and when the solve is traced if
        a function returns values of the wrong shape.
        """
        eta1 = as_damping(eta1, "`eta1`")
        eta2 = as_damping(eta2, "`eta2`")
        check_potential(potential)
        if separable:
            kinetic = _ScaledKinetic(as_kinetic(kinetic), eta1, eta2)
            self.E = SeparableEnergy(kinetic, potential)
        elif isinstance(kinetic, AbstractKinetic) or not callable(kinetic):
            raise ValueError(
                "`DissipativeHamiltonian(..., separable=False)` needs `kinetic` to be "
                f"a function `T(t, q, P, args)`, but got {kinetic!r}."
            )
        else:
            self.E = GeneralEnergy(_ScaledEnergy(kinetic, potential, eta1, eta2))
        self.damping = eta2


class _ScaledKinetic(AbstractKinetic):
    # exp(-eta1 - eta2) T(exp(eta2) p), as exp(eta2 - eta1) times the rescaled T.
    kinetic: AbstractKinetic
    eta1: AbstractDamping
    eta2: AbstractDamping

    @property
    def is_quadratic(self) -> bool:
        return self.kinetic.is_quadratic

    def _parts(self, t):
        check_scalar(self.eta1, "DissipativeHamiltonian")
        eta2 = self.eta2(t)
        return jnp.exp(eta2 - self.eta1(t)), self.kinetic.rescale(eta2)

    def __call__(self, t, p, args=None):
        scale, kinetic = self._parts(t)
        return tree_scale(scale, scalar_fn(kinetic, "The kinetic energy")(t, p, args))

    def velocity(self, t, p, args=None):
        scale, kinetic = self._parts(t)
        return tree_scale(scale, kinetic.velocity(t, p, args))

    def displacement(self, t, h, p, args, friction, order):
        if not self.is_quadratic:
            return integrate_velocity(self.velocity, t, h, p, args, friction, order)
        # exp(eta2 - eta1) times the decay of p, exp(-eta2), decays like exp(-eta1).
        scale, kinetic = self._parts(t)
        dq = kinetic.displacement(t, h, p, args, self.eta1, order)
        return tree_scale(scale, dq)

    def rescale(self, s):
        return _ScaledKinetic(self.kinetic.rescale(s), self.eta1, self.eta2)


class _ScaledEnergy(eqx.Module):
    kinetic: PyTree
    potential: PyTree
    eta1: AbstractDamping
    eta2: AbstractDamping

    def __call__(self, t, q, p, args):
        at_q = CallableKinetic(lambda t, P, args: self.kinetic(t, q, P, args))
        kinetic = _ScaledKinetic(at_q, self.eta1, self.eta2)(t, p, args)
        potential = scalar_fn(self.potential, "The potential")(t, q, args)
        with jax.numpy_dtype_promotion("standard"):
            return kinetic + potential
