from collections.abc import Callable

from jaxtyping import PyTree

from .._friction import AbstractDamping, as_damping
from .._friction._base import Scalar, Time
from .._misc import match
from .._split import AbstractSplit, KineticSplit
from ._base import AbstractHamiltonian, P, Q
from ._energy import check_callable
from ._kinetic import integrate_velocity


class VectorField(AbstractHamiltonian):
    """A velocity and a force written by hand, with no energy known.

    For forces that have no potential, that are random, or whose potential is not worth
    computing: stochastic gradients, measured force fields. Every scheme for separable
    Hamiltonians steps it, but only if the two do come from an energy is the result
    (pre)symplectic. Schemes of order above 4 differentiate both for their dense output,
    so that functions JAX cannot see through, such as a `jax.pure_callback`, need a
    `jax.custom_jvp` there.
    """

    velocity_fn: Callable
    force_fn: Callable
    damping: AbstractDamping | None

    def __init__(self, velocity, force, damping=None):
        """**Arguments:**

        - `velocity`: a function `velocity(t, p, args)`, of the structure and shape of
            `p`.
        - `force`: a function `force(t, q, args)`, of the structure and shape of `q`,
            without the friction.
        - `damping`: a damping law such as [`diffrax_presym.ConstantDamping`][], or a
            function `eta(t)`. Defaults to no damping.

        **Raises:**

        `ValueError` if any of these is not a function, and when the solve is traced if
        a function returns values of the wrong shape. Asking for the energy is an error.
        """
        check_callable(velocity, "velocity", "velocity(t, p, args)")
        check_callable(force, "force", "force(t, q, args)")
        self.velocity_fn = velocity
        self.force_fn = force
        self.damping = None if damping is None else as_damping(damping, "`damping`")

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        return (KineticSplit(separable=True, nystrom=False),)

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        raise ValueError(
            "A `VectorField` has no energy: it knows only its velocity and force. If "
            "they derive from an energy T(t, p) + V(t, q), write "
            "`ConformalHamiltonian(kinetic, potential, damping)` instead."
        )

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return match(self.velocity_fn(t, p, args), p, "`velocity`", "`p`")

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        return match(self.force_fn(t, q, args), q, "`force`", "`q`")

    def kinetic_flow(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None, order: int = 8
    ) -> tuple[Q, None]:
        velocity = lambda t, p, args: self.velocity(t, q, p, args)
        return integrate_velocity(velocity, t, h, p, args, self.damping, order), None
