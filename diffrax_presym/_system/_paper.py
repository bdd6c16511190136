"""The general family of Hamiltonians of the paper, as a system."""

import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import PyTree

from .. import _tree as tree
from .._checks import scalar_fn
from .._friction._base import Mechanics, Parts
from .._friction._damping import AbstractDamping, as_laws, ConstantDamping
from .._friction._fit import fit_friction, one_rate
from .._friction._linear import LinearFriction
from .._numbers import as_time, Scalar, Time
from ._kinetic import AbstractKinetic, as_kinetic
from ._mechanical import MechanicalSystem


def DissipativeHamiltonian(kinetic, potential, eta1, eta2) -> MechanicalSystem:
    """The general family `H = exp(-η_1(t)) T(t, P) + exp(η_2(t)) f(t, q)`.

    Equation (gen_ham) of França, Jordan and Vidal (2021), where `P` is the canonical
    momentum. The log scale is `η_2`, so the state holds `p = exp(-η_2(t)) P` and the
    energy is `E = exp(-η_1 - η_2) T(t, exp(η_2) p) + f(t, q)`. For `QuadraticKinetic`
    that is `exp(η_2 - η_1) T(p) + f`, and with `η_1 = η_2` the same system as
    `MechanicalSystem(T, f, eta1)`.

    The kinetic energies of this package do not evaluate the exponential of `η_2`
    itself. A plain function does, and overflows in `float32` once `2 η_2` exceeds 88.

    **Arguments:**

    - `kinetic`: the kinetic energy `T` as a function of the *canonical* momentum: for
        example `QuadraticKinetic`, or a function `T(t, P, args)`. One that depends on
        `q` too is the energy `E` of a `Hamiltonian`.
    - `potential`: the function `f` to minimise, or potential energy, a function `f(t,
        q, args)` that returns a scalar.
    - `eta1`, `eta2`: damping laws or functions of time.

    **Returns:**

    A `MechanicalSystem`.

    **Raises:**

    `ValueError` if any of these has the wrong type, and when the solve is traced if a
    function returns values of the wrong shape.
    """
    eta1, eta2 = _as_damping(eta1, "`eta1`"), _as_damping(eta2, "`eta2`")
    kinetic = _ScaledKinetic(as_kinetic(kinetic), eta1, eta2)
    return MechanicalSystem(kinetic, potential, eta2)


def _as_damping(law, name: str) -> AbstractDamping:
    mechanics = Mechanics()
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
        # Where it is minus infinity, as of 3 / t at zero, it has no derivatives, and
        # what is just after it is the limit of the difference.
        infinite, t = jnp.isneginf(self.eta2(t)), as_time(t)
        info = jnp.finfo(t.dtype)
        just = jnp.maximum(math.sqrt(float(info.tiny)), float(info.eps) * jnp.abs(t))
        near = jnp.where(infinite, t + just, t)
        eta1, eta2 = self.eta1(near), self.eta2(near)
        rescaled = self.kinetic.rescale(jnp.where(infinite, -jnp.inf, eta2))
        return jnp.exp(eta2 - eta1), rescaled

    def __call__(self, t: Time, p: PyTree, args: PyTree = None) -> Scalar:
        scale, kinetic = self._parts(t)
        return tree.scale(scale, scalar_fn(kinetic, "The kinetic energy")(t, p, args))

    def velocity(self, t: Time, p: PyTree, args: PyTree = None) -> PyTree:
        scale, kinetic = self._parts(t)
        return tree.scale(scale, kinetic.velocity(t, p, args))

    def _by_eta1(self, p: PyTree) -> LinearFriction:
        mechanics = Mechanics()
        friction = fit_friction(self.eta1.parts(mechanics).linear, mechanics, p)
        assert friction is not None
        return friction

    def flow_is_known(self, friction) -> bool:
        if not self.is_quadratic:
            return False
        assert friction is not None
        return friction.is_known and self._by_eta1(jnp.zeros(())).is_known

    def prepare(self, friction, t, h, order):
        if not self.is_quadratic:
            return super().prepare(friction, t, h, order)
        assert friction is not None
        # exp(eta2 - eta1) times the decay of p, exp(-eta2), decays like exp(-eta1).
        displacement = self._by_eta1(jnp.zeros_like(h)).prepare(t, h, order)
        return self._parts(t)[0], displacement, friction.prepare(t, h, order)

    def flow(self, friction: Any, t, h, data, p, args):
        if not self.is_quadratic:
            return super().flow(friction, t, h, data, p, args)
        scale, displacement, decay = data
        carried = scale * displacement.leaves.carried
        dq = self.kinetic.velocity(t, tree.scale(carried, p), args)
        return dq, friction.decay(decay, p)

    def rescale(self, s: Scalar) -> "AbstractKinetic":
        return _ScaledKinetic(self.kinetic.rescale(s), self.eta1, self.eta2)
