from .._friction import AbstractDamping, as_damping
from .._friction._base import Scalar
from ._energy import AbstractMechanicalHamiltonian, check_callable, SeparableEnergy


class VectorField(AbstractMechanicalHamiltonian):
    """A velocity and a force, without an energy.

    For forces without a potential, random forces, or potentials too expensive to
    compute: stochastic gradients, measured force fields. Every scheme for separable
    Hamiltonians accepts it, but is (pre)symplectic only if the two derive from an
    energy. Schemes of order above 4 differentiate both for dense output, so functions
    that JAX cannot differentiate, such as `jax.pure_callback`, need a `jax.custom_jvp`.
    """

    E: SeparableEnergy
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

        `ValueError` if any of these is not a function, when the solve is traced if a
        function returns values of the wrong shape, and if the energy is evaluated.
        """
        check_callable(velocity, "velocity", "velocity(t, p, args)")
        check_callable(force, "force", "force(t, q, args)")
        self.E = SeparableEnergy(_no_energy, _no_energy, velocity, force)
        self.damping = None if damping is None else as_damping(damping, "`damping`")


def _no_energy(*args) -> Scalar:
    raise ValueError(
        "A `VectorField` has no energy, only a velocity and a force. If they "
        "derive from an energy T(t, p) + V(t, q), write `ConformalHamiltonian(kinetic, "
        "potential, damping)` instead."
    )
