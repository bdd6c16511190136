"""The variables that a splitting steps in, where they are not those of the state.

Each has a way in and out, and the two moves of a splitting: a drift, which takes time
along, and the force of a kick, which moves the second of the pair by it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._hamiltonian import QuadraticKinetic
from .._hamiltonian._damping import add_friction
from .._misc import tree_add, tree_scale
from .._term import State, View


class Swapped(eqx.Module):
    """Positions and momenta in each other's roles.

    The drift is the flow of a quadratic potential, and the velocity kicks the position.
    """

    view: View

    def enter(self, t, y: State) -> State:
        q, p = y
        return p, q

    leave = enter

    def drift(self, t, h, z: State, order: int) -> State:
        p, q = z
        damping = self.view.hamiltonian.damping
        reach = h if damping is None else damping.response(t, h, order)
        force = self.view.potential_force(t, (q, p))
        return tree_add(self.view.move_frame(t, h, p), reach, force), q

    def potential_force(self, t, z: State) -> PyTree:
        p, q = z
        return self.view.velocity(t, (q, p))


class Shared(eqx.Module):
    r"""A frame that positions and momenta share, half of the friction each.

    With $q = e^{-\eta / 2} x$ friction turns into a force,
    $M x'' = e^{\eta / 2} F + (\eta'^2 / 4 + \eta'' / 2) M x$. The pair is $q$ and
    $p + \eta' M q / 2$, which are $e^{-\eta / 2}$ times $x$ and $M x'$.
    """

    view: View
    kinetic: QuadraticKinetic

    def _momentum(self, z: State) -> PyTree:
        """The momentum of a velocity that equals the position."""
        return self.kinetic.momentum(self.view.values(z[0]))

    def _tilt(self, t, y: State, share) -> State:
        damping, momentum = self.view.hamiltonian.damping, self._momentum(y)
        return y[0], add_friction(damping, t, y[1], tree_scale(share, momentum))

    def enter(self, t, y: State) -> State:
        return self._tilt(t, y, -1 / 2)

    def leave(self, t, z: State) -> State:
        return self._tilt(t, z, 1 / 2)

    def drift(self, t, h, z: State, order: int) -> State:
        q, p = z
        z = tree_add(q, h, self.view.velocity(t, z)), p
        return self.view.move_frame(t, h, z, share=1 / 2)

    def potential_force(self, t, z: State) -> PyTree:
        force, damping = self.view.potential_force(t, z), self.view.hamiltonian.damping
        if damping is None:
            return force
        rate, bend = jax.jvp(damping.rate, (t,), (jnp.ones_like(t),))
        return tree_add(force, rate**2 / 4 + bend / 2, self._momentum(z))
