# pyright: reportCallIssue=false
"""Systems, each written twice: with the package, and in NumPy."""

import jax.numpy as jnp
import numpy as np
import own

import diffrax_presym as dps

from ._jumping import JUMPING
from ._manifolds import MANIFOLDS
from ._system import (
    ALL,
    ANY,
    energy,
    LINEAR,
    MASS,
    mechanical,
    one_law,
    PLANE,
    SPLIT,
    System,
    TWO,
    unit_mass,
)


def _pendulum(t, q, args):
    return -1.2 * jnp.sum(jnp.cos(q))


def _pendulum_force(t, q, p):
    return -1.2 * np.sin(q)


def _coupled(t, q, args):
    return 1 - jnp.cos(q[0] - q[1]) + q @ q / 2 + q[0] ** 2 * q[1] / 3


def _coupled_force(t, q, p):
    s = np.sin(q[0] - q[1])
    force = [s + q[0] + 2 * q[0] * q[1] / 3, -s + q[1] + q[0] ** 2 / 3]
    return -np.array(force, dtype=float)


def _driven(t, q, args):
    return (1 + jnp.cos(t) / 2) * _coupled(t, q, args)


def _driven_force(t, q, p):
    return (1 + np.cos(t) / 2) * _coupled_force(t, q, p)


_attraction = dps.pairwise_potential(lambda t, r, args: -1 / jnp.sqrt(1 + r**2))


def _pair(t, q, args):
    return jnp.sum(q**2) / 2 + _attraction(t, q, args)


def _pair_force(t, q, p):
    a, b = q.reshape(2, 2)
    pull = (a - b) / (1 + (a - b) @ (a - b)) ** 1.5
    return np.concatenate([-a - pull, -b + pull])


def _chain(t, q, args):
    d = jnp.diff(jnp.pad(q, 1))
    return jnp.sum(d**2 / 2 + d**4 / 4)


def _chain_force(t, q, p):
    d = np.diff(np.concatenate([[0], q, [0]]))
    return np.diff(d + d**3)


def _tree(t, q, args):
    a, b = q["a"], q["b"]
    return jnp.sum(a**2) / 2 + jnp.sum(1 - jnp.cos(b)) + a[0] * b[0, 1] / 2


def _tree_force(t, q, p):
    a, b = q[:2], q[2:]
    pull = np.array([b[1] / 2, 0, 0, a[0] / 2])
    return -np.concatenate([a, np.sin(b)]) - pull


def _spring_force(t, q, p):
    return -_SPRINGS @ q


def _whirl(t, q, args):
    """A force without a potential."""
    return jnp.stack([-q[0] - q[1] / 2, q[0] / 2 - q[1] ** 3])


def _whirl_force(t, q, p):
    return np.array([-q[0] - q[1] / 2, q[0] / 2 - q[1] ** 3])


# Kinetic energies without a mass.


def _relativistic_velocity(t, q, p, eta):
    return 2 * p / np.sqrt(p @ p + 4)


def _driven_kinetic(t, p, args):
    return (1 + jnp.sin(t) / 3) * jnp.sum(jnp.sqrt(1 + p**2))


def _driven_velocity(t, q, p, eta):
    return (1 + np.sin(t) / 3) * p / np.sqrt(1 + p**2)


def _smooth_kinetic(t, p, args):
    return jnp.sum(jnp.sqrt(1 + p**2))


def _smooth_velocity(t, q, p, eta):
    return p / np.sqrt(1 + p**2)


# Energies that are not separable, or scaled in time.


def _mixed(t, q, p, args):
    return (1 + q @ q) * (1 + p @ p) * (1 + jnp.sin(t) / 4) / 2


def _mixed_velocity(t, q, p, eta):
    return (1 + np.sin(t) / 4) * (1 + q @ q) * p


def _mixed_force(t, q, p):
    return -(1 + np.sin(t) / 4) * (1 + p @ p) * q


def _links(t, q, args):
    c = jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2 + 0 * c, c]), jnp.stack([c, 1 + 0 * c])])


def _links_potential(t, q, args):
    return -2 * jnp.cos(q[0]) - jnp.cos(q[1])


def _links_velocity(t, q, p, eta):
    c = np.cos(q[0] - q[1])
    return np.linalg.solve(np.array([[2, c], [c, 1]]), p)


def _links_force(t, q, p):
    v = _links_velocity(t, q, p, 0)
    s = np.sin(q[0] - q[1]) * v[0] * v[1]
    return np.array([-s - 2 * np.sin(q[0]), s - np.sin(q[1])])


def _lagrangian(laws, force=None):
    return dps.LagrangianSystem(_links, _links_potential, laws, force=force)


def _dissipative(law):
    eta1 = dps.LogDamping(1.0, shift=2.0)
    law = [dps.ConstantDamping(0.0)] if law is None else law
    return dps.DissipativeHamiltonian(_quadratic(1.5), _driven, eta1, law)


def _dissipative_velocity(t, q, p, eta):
    return np.exp(eta) / (t + 2) * p / 1.5


def _objective(t, q, args):
    return jnp.sum((q - 1) ** 2) / 2 + q[0] * q[1] / 4


def _objective_slope(q):
    return q - 1 + q[::-1] / 4


def _bregman(mirror_map):
    def build(laws, force=None):
        if laws or force is not None:
            raise ValueError("write `MechanicalSystem`")
        scaling = dps.PolynomialScaling(2.0, 0.5)
        return dps.BregmanHamiltonian(mirror_map, _objective, scaling)

    return build


# The friction of a Bregman Hamiltonian is its own, and part of these.
def _entropy_velocity(t, q, p, eta):
    return 2 / t * q * np.expm1(p)


def _entropy_force(t, q, p):
    return -t * _objective_slope(q) - 2 / t * np.expm1(p)


def _euclidean_force(t, q, p):
    return -t * _objective_slope(q) - 2 / t * p


def _quartic(t, q, p, args):
    return jnp.sum(p**2 / 2 + q**4 / 4)


_quadratic = dps.QuadraticKinetic
_SPRINGS = np.array([[1.5, 0.2], [0.2, 1.0]])
_ONE = np.array([1.1]), np.array([0.4])
_TREE = (
    {"a": np.array([0.7, -0.2]), "b": np.array([[0.5, 0.9]])},
    {"a": np.array([0.2, 0.1]), "b": np.array([[-0.3, 0.4]])},
)
_LONG = np.sin(np.arange(20.0)), np.cos(2 * np.arange(20.0)) / 2
_POSITIVE = np.array([0.8, 1.4]), np.array([0.3, -0.2])
_coupled_by = lambda kinetic: mechanical(kinetic, _coupled)
_bodies = mechanical(_quadratic(np.array([[1.0], [1.5]])), _pair)
_springs = dps.QuadraticPotential(_SPRINGS)
_field = mechanical(_quadratic(MASS), dps.ForceField(_whirl))
_own = energy(_quartic, splits=(own.QuarticSplit(),))

SYSTEMS = [
    System("pendulum", unit_mass(_pendulum), _pendulum_force, _ONE, bodies=True),
    System("mass matrix", _coupled_by(_quadratic(MASS)), _coupled_force, mass=MASS),
    System(
        *("bodies", _bodies, _pair_force, PLANE),
        mass=np.diag([1.0, 1.0, 1.5, 1.5]),
        bodies=True,
    ),
    System("driven", unit_mass(_driven), _driven_force, bodies=True),
    System("chain of 20", unit_mass(_chain), _chain_force, _LONG, bodies=True),
    System("pytree", unit_mass(_tree), _tree_force, _TREE, bodies=True),
    System(
        *("linear", mechanical(_quadratic(MASS), _springs), _spring_force),
        mass=MASS,
        offers=LINEAR,
    ),
    System(
        *("relativistic", _coupled_by(dps.RelativisticKinetic(1.0, 2.0))),
        *(_coupled_force, TWO, None, _relativistic_velocity),
        offers=SPLIT,
        takes="velocities",
    ),
    System(
        *("any T and V", mechanical(_driven_kinetic, _driven)),
        *(_driven_force, TWO, None, _driven_velocity),
        offers=SPLIT,
        takes="velocities",
    ),
    System(
        *("any T, springs", mechanical(_smooth_kinetic, _springs)),
        *(_spring_force, TWO, None, _smooth_velocity),
        offers=ALL,
        takes="velocities",
    ),
    System(
        *("any energy", energy(_mixed), _mixed_force, TWO, None, _mixed_velocity),
        offers=frozenset(),
        takes="rates",
    ),
    System(
        *("M(q)", _lagrangian, _links_force, TWO, None, _links_velocity),
        offers=frozenset(),
        takes="joints",
    ),
    System(
        *("dissipative", one_law(_dissipative)),
        *(_driven_force, TWO, None, _dissipative_velocity),
        offers=ALL,
        takes="one rate",
    ),
    System(
        *("Bregman", _bregman(dps.EntropyMirror())),
        *(_entropy_force, _POSITIVE, None, _entropy_velocity),
        offers=ANY,
        takes="none",
        start=1.0,
    ),
    System(
        *("Bregman, Euclidean", _bregman(dps.EuclideanMirror())),
        *(_euclidean_force, _POSITIVE, None, lambda t, q, p, eta: 2 / t * p),
        offers=ALL,
        takes="none",
        start=1.0,
    ),
    System("force field", _field, _whirl_force, mass=MASS),
    System(
        *("own split", _own, lambda t, q, p: -(q**3), TWO, None),
        velocity=lambda t, q, p, eta: p,
        offers=frozenset({"any", "nystrom"}),
        takes="rates",
    ),
    *JUMPING,
    *MANIFOLDS,
]
