# pyright: reportCallIssue=false, reportArgumentType=false
"""Everything that can be combined: one line an entry.

A system and a law of friction are written twice, once with the package and once in bare
NumPy, from which SciPy computes the reference. `test_pairs.py` tries all pairs of
entries. What an entry claims is in its line, and `claim` says what a combination
claims: an order, or that it is refused.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import own
import scipy.integrate
import scipy.spatial
from helpers import substeps
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


# Of all solves, but for those from a singularity. Steps are exact in binary.
START, LENGTH = 0.25, 1.5

# Systems. The numbers of NumPy are flat, in the order of `ravel_pytree`.

SPLIT = frozenset({"separable", "any"})
ALL = SPLIT | {"nystrom"}
RATE = ALL | {"shared"}
LINEAR = RATE | {"linear"}


@dataclasses.dataclass(frozen=True, eq=False)
class System:
    """A system, `build(laws)`, and its velocity and force without friction."""

    name: str
    build: Callable[..., Any]
    velocity: Callable  # of t, q, p, and the log scale eta(t)
    force: Callable
    q: Any
    p: Any
    offers: frozenset[str]  # the splits that it offers without friction
    # The friction that it takes: "all", "velocities", "rates", "joints", "tangential",
    # "one rate" or "none".
    takes: str
    mass: Any = None
    bodies: bool = False  # whether the last axis are the coordinates of bodies
    start: float = START
    constrained: bool = False  # whether its states are on a manifold
    slow: bool = False  # whether schemes of many stages take minutes to compile
    # Where there are multipliers: the force with theirs, of t, q, p and that without.
    react: Callable | None = None

    def __repr__(self):
        return self.name

    @property
    def size(self):
        """The number of momenta, of which quaternions have more positions."""
        return ravel_pytree(self.p)[0].size


def _flat(*entries):
    return tuple(np.array(x, float) for x in entries)


def _mechanical(kinetic, potential):
    def build(laws, force=None):
        return dps.MechanicalSystem(kinetic, potential, friction=laws, force=force)

    return build


def _energy(energy):
    def build(laws, force=None):
        return dps.Hamiltonian(energy, friction=laws, force=force)

    return build


def _split(laws, force=None):
    energy = lambda t, q, p, args: jnp.sum(p**2 / 2 + q**4 / 4)
    splits = (own.QuarticSplit(),)
    return dps.Hamiltonian(energy, friction=laws, force=force, splits=splits)


def _one_law(make):
    """A class that takes one scalar law, or none, as `damping`."""

    def build(laws, force=None):
        if force is not None:
            raise ValueError("write `MechanicalSystem`")
        return make(list(laws) or None)

    return build


def _inverse(mass):
    inverse = np.linalg.inv(mass)
    return lambda t, q, p, eta: inverse @ p


def _pendulum(t, q, args):
    return -1.2 * jnp.sum(jnp.cos(q))


def _pendulum_force(t, q, p):
    return -1.2 * np.sin(q)


def _coupled(t, q, args):
    return 1 - jnp.cos(q[0] - q[1]) + q @ q / 2 + q[0] ** 2 * q[1] / 3


def _coupled_force(t, q, p):
    s = np.sin(q[0] - q[1])
    return -np.array(
        [s + q[0] + 2 * q[0] * q[1] / 3, -s + q[1] + q[0] ** 2 / 3], dtype=float
    )


def _driven(t, q, args):
    return (1 + jnp.cos(t) / 2) * _coupled(t, q, args)


def _driven_force(t, q, p):
    return (1 + np.cos(t) / 2) * _coupled_force(t, q, p)


def _driven_kinetic(t, p, args):
    return (1 + jnp.sin(t) / 3) * jnp.sum(jnp.sqrt(1 + p**2))


def _driven_velocity(t, q, p, eta):
    return (1 + np.sin(t) / 3) * p / np.sqrt(1 + p**2)


def _smooth_kinetic(t, p, args):
    return jnp.sum(jnp.sqrt(1 + p**2))


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


def _mixed(t, q, p, args):
    return (1 + q @ q) * (1 + p @ p) * (1 + jnp.sin(t) / 4) / 2


def _mixed_velocity(t, q, p, eta):
    return (1 + np.sin(t) / 4) * (1 + q @ q) * p


def _mixed_force(t, q, p):
    return -(1 + np.sin(t) / 4) * (1 + p @ p) * q


def _links(t, q, args):
    c = jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2 + 0 * c, c]), jnp.stack([c, 1 + 0 * c])])


def _links_matrix(q):
    c = np.cos(q[0] - q[1])
    return np.array([[2, c], [c, 1]])


def _links_potential(t, q, args):
    return -2 * jnp.cos(q[0]) - jnp.cos(q[1])


def _links_velocity(t, q, p, eta):
    return np.linalg.solve(_links_matrix(q), p)


def _links_force(t, q, p):
    v = _links_velocity(t, q, p, 0)
    s = np.sin(q[0] - q[1]) * v[0] * v[1]
    return np.array([-s - 2 * np.sin(q[0]), s - np.sin(q[1])])


def _lagrangian(laws, force=None):
    return dps.LagrangianSystem(_links, _links_potential, laws, force=force)


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


def _entropy_velocity(t, q, p, eta):
    return 2 / t * q * np.expm1(p)


# The friction of a Bregman Hamiltonian is its own, and part of these.
def _entropy_force(t, q, p):
    return -t * _objective_slope(q) - 2 / t * np.expm1(p)


def _euclidean_force(t, q, p):
    return -t * _objective_slope(q) - 2 / t * p


_MASS = np.array([[2.0, 0.3], [0.3, 1.0]])
_MASSES = np.diag([1.0, 1.0, 1.5, 1.5])
_SPRINGS = np.array([[1.5, 0.2], [0.2, 1.0]])
_ONE, _TWO = _flat([1.1], [0.4]), _flat([1.0, -0.4], [0.3, 0.5])
_PLANE = _flat([[1.0, 0.2], [-0.5, 0.3]], [[0.1, 0.5], [0.2, -0.4]])
_TREE = (
    {"a": np.array([0.7, -0.2]), "b": np.array([[0.5, 0.9]])},
    {"a": np.array([0.2, 0.1]), "b": np.array([[-0.3, 0.4]])},
)
_LONG = _flat(np.sin(np.arange(20.0)), np.cos(2 * np.arange(20.0)) / 2)
_POSITIVE = _flat([0.8, 1.4], [0.3, -0.2])
_quadratic, _own = dps.QuadraticKinetic, lambda t, q, p, eta: p


def _spring_force(t, q, p):
    return -_SPRINGS @ q


def _smooth_velocity(t, q, p, eta):
    return p / np.sqrt(1 + p**2)


def _relativistic_velocity(t, q, p, eta):
    return 2 * p / np.sqrt(p @ p + 4)


def _dissipative(law):
    eta1 = dps.LogDamping(1.0, shift=2.0)
    law = [dps.ConstantDamping(0.0)] if law is None else law
    return dps.DissipativeHamiltonian(_quadratic(1.5), _driven, eta1, law)


def _dissipative_velocity(t, q, p, eta):
    return np.exp(eta) / (t + 2) * p / 1.5


def _whirl(t, q, args):
    """A force without a potential."""
    return jnp.stack([-q[0] - q[1] / 2, q[0] / 2 - q[1] ** 3])


def _whirl_force(t, q, p):
    return np.array([-q[0] - q[1] / 2, q[0] / 2 - q[1] ** 3])


# Manifolds. Initial states are projected by the systems.


def _manifold(manifold, potential):
    def build(laws, force=None):
        return dps.ManifoldSystem(manifold, potential, laws, force=force)

    return build


def _constrained(free, constraint):
    def build(laws, force=None):
        return dps.ConstrainedSystem(free(laws, force), constraint)

    return build


def _reaction(slopes, inverse, change, force):
    """The force and that of constraints with some slopes, by momenta, and the change of
    their rates without forces."""
    both = slopes @ inverse
    multipliers = np.linalg.solve(both @ slopes.T, both @ force + change)
    return force - slopes.T @ multipliers


def _rods(t, q, args):
    """Two rods, of which the first becomes longer."""
    square = lambda x: jnp.sum(x**2)
    return jnp.stack([square(q[0]) - t**3 / 10, square(q[1] - q[0])]) - 1


def _rods_potential(t, q, args):
    return (1 + jnp.cos(t) / 2) * (q[0, 1] + 3 * q[1, 1] / 2)


def _rods_force(t, q, p):
    return -(1 + np.cos(t) / 2) * np.array([0, 1, 0, 1.5])


def _rods_react(t, q, p, force):
    inverse = np.linalg.inv(_MASSES)
    (a, b), (u, v) = q.reshape(2, 2), (inverse @ p).reshape(2, 2)
    slopes = 2 * np.array([[*a, 0, 0], [*(a - b), *(b - a)]])
    change = np.array([2 * u @ u - 0.6 * t, 2 * (v - u) @ (v - u)])
    return _reaction(slopes, inverse, change, force)


def _upright(q):
    """The vertical, along the axes of a body."""
    w, x, y, z = q
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)])


def _top(t, q, args):
    x, y, z = dps.rotation_matrix(q)[2]
    return (1 + jnp.sin(t) / 5) * (z + 0.4 * x * y)


def _top_velocity(t, q, p, eta):
    (w, *u), v = q, p / _INERTIA / 2
    return np.concatenate([[-np.dot(u, v)], w * v + np.cross(u, v)])


def _top_force(t, q, p):
    u = _upright(q)
    slope = (1 + np.sin(t) / 5) * np.array([0.4 * u[1], 0.4 * u[0], 1])
    return np.cross(p, p / _INERTIA) + np.cross(u, slope)


def _joint(t, q, args):
    """Where a body hangs."""
    arm = jnp.asarray(_ARM, q[0].dtype)
    return q[0] + dps.rotation_matrix(q[1]) @ arm


def _hanging_potential(t, q, args):
    return (1 + jnp.cos(t) / 2) * (2 * q[0][2] + q[0][0] ** 2)


def _hanging_velocity(t, q, p, eta):
    return np.concatenate([p[:3] / 2, _top_velocity(t, q[3:], p[3:], eta)])


def _hanging_force(t, q, p):
    pull = -(1 + np.cos(t) / 2) * np.array([2 * q[0], 0, 2])
    return np.concatenate([pull, np.cross(p[3:], p[3:] / _INERTIA)])


def _hanging_react(t, q, p, force):
    last, omega = np.append(q[4:], q[3]), p[3:] / _INERTIA  # as SciPy has quaternions
    R = scipy.spatial.transform.Rotation.from_quat(last).as_matrix()
    turns = [R @ np.cross(e, _ARM) for e in np.eye(3)]
    slopes = np.concatenate([np.eye(3), np.stack(turns, axis=1)], axis=1)
    change = R @ np.cross(omega, np.cross(omega, _ARM))
    return _reaction(slopes, np.linalg.inv(_FLOATING), change, force)


def _form(t, q, args):
    return (1 + jnp.cos(t) / 2) * (q[0] ** 2 + q[1] * q[2] - q[2]) / 2


def _form_force(t, q, p):
    slope = np.array([2 * q[0], q[2], q[1] - 1])
    return -(1 + np.cos(t) / 2) * slope / 2


def _form_react(t, q, p, force):
    return force - (q @ force + p @ p) * q


_INERTIA, _ARM = np.array([1.0, 1.5, 2.5]), np.array([0.3, -0.2, 0.5])
_FLOATING = np.diag([2.0, 2.0, 2.0, *_INERTIA])
_VECTOR, _SPIN = np.array([0.6, 0.3, -0.8]), np.array([0.3, -0.8, 0.6])
_TURNED = np.array([0.9, 0.3, -0.2, 0.1])
_HANGING = (-_ARM, _TURNED), (_SPIN, _SPIN)
_FOLDED = _flat([[1.0, 0.3], [1.5, -0.6]], [[0.4, 0.5], [0.2, -0.4]])
_masses = _quadratic(np.array([[1.0], [1.5]]))

SYSTEMS = [
    System(
        *("pendulum", _mechanical(_quadratic(), _pendulum), _own, _pendulum_force),
        *(*_ONE, RATE, "all", np.eye(1)),
        bodies=True,
    ),
    System(
        *("mass matrix", _mechanical(_quadratic(_MASS), _coupled), _inverse(_MASS)),
        *(_coupled_force, *_TWO, RATE, "all", _MASS),
    ),
    System(
        *("bodies", _mechanical(_quadratic(np.array([[1.0], [1.5]])), _pair)),
        *(_inverse(_MASSES), _pair_force, *_PLANE, RATE, "all", _MASSES),
        bodies=True,
    ),
    System(
        *("driven", _mechanical(_quadratic(), _driven), _own, _driven_force),
        *(*_TWO, RATE, "all", np.eye(2)),
        bodies=True,
    ),
    System(
        *("chain of 20", _mechanical(_quadratic(), _chain), _own, _chain_force),
        *(*_LONG, RATE, "all", np.eye(20)),
        bodies=True,
    ),
    System(
        *("pytree", _mechanical(_quadratic(), _tree), _own, _tree_force),
        *(*_TREE, RATE, "all", np.eye(4)),
        bodies=True,
    ),
    System(
        *("linear", _mechanical(_quadratic(_MASS), dps.QuadraticPotential(_SPRINGS))),
        *(_inverse(_MASS), _spring_force, *_TWO, LINEAR, "all", _MASS),
    ),
    System(
        *("relativistic", _mechanical(dps.RelativisticKinetic(1.0, 2.0), _coupled)),
        *(_relativistic_velocity, _coupled_force, *_TWO, SPLIT, "velocities"),
    ),
    System(
        *("any T and V", _mechanical(_driven_kinetic, _driven), _driven_velocity),
        *(_driven_force, *_TWO, SPLIT, "velocities"),
    ),
    System(
        "any T, springs",
        _mechanical(_smooth_kinetic, dps.QuadraticPotential(_SPRINGS)),
        *(_smooth_velocity, _spring_force, *_TWO, ALL, "velocities"),
    ),
    System(
        *("any energy", _energy(_mixed), _mixed_velocity, _mixed_force),
        *(*_TWO, frozenset(), "rates"),
    ),
    System(
        *("M(q)", _lagrangian, _links_velocity, _links_force),
        *(*_TWO, frozenset(), "joints"),
    ),
    System(
        *("dissipative", _one_law(_dissipative), _dissipative_velocity, _driven_force),
        *(*_TWO, ALL, "one rate"),
    ),
    System(
        *("Bregman", _bregman(dps.EntropyMirror()), _entropy_velocity, _entropy_force),
        *(*_POSITIVE, frozenset({"any"}), "none"),
        start=1.0,
    ),
    System(
        *("Bregman, Euclidean", _bregman(dps.EuclideanMirror())),
        lambda t, q, p, eta: 2 / t * p,
        *(_euclidean_force, *_POSITIVE, ALL, "none"),
        start=1.0,
    ),
    System(
        *("force field", _mechanical(_quadratic(_MASS), dps.ForceField(_whirl))),
        *(_inverse(_MASS), _whirl_force, *_TWO, RATE, "all", _MASS),
    ),
    System(
        *("own split", _split, _own, lambda t, q, p: -(q**3)),
        *(*_TWO, frozenset({"any", "nystrom"}), "rates"),
    ),
    System(
        *("rods", _constrained(_mechanical(_masses, _rods_potential), _rods)),
        *(_inverse(_MASSES), _rods_force, *_FOLDED, frozenset({"any"}), "all"),
        *(_MASSES, True),
        constrained=True,
        react=_rods_react,
    ),
    System(
        *("rigid body", _manifold(dps.Attitude(_INERTIA), _top)),
        *(_top_velocity, _top_force, _TURNED, _SPIN, frozenset({"any"}), "all"),
        *(np.diag(_INERTIA), True),
        constrained=True,
    ),
    System(
        *("hanging body",),
        _constrained(
            _manifold((dps.Euclidean(2.0), dps.Attitude(_INERTIA)), _hanging_potential),
            _joint,
        ),
        *(_hanging_velocity, _hanging_force, *_HANGING, frozenset({"any"}), "all"),
        *(_FLOATING, True),
        constrained=True,
        slow=True,
        react=_hanging_react,
    ),
    System(
        *("sphere", _manifold(dps.Sphere(), _form), _own, _form_force),
        *(_VECTOR, _SPIN, frozenset({"any"}), "tangential"),
        bodies=True,
        constrained=True,
        react=_form_react,
    ),
]


# Friction.


@dataclasses.dataclass(frozen=True, eq=False)
class Friction:
    """Friction, `laws(system)`, and its force of time and state in NumPy."""

    name: str
    laws: Callable[[System], tuple]
    force: Callable  # of the system, t, q, p, v
    kind: str  # "none", "one rate", "entries", "matrix", "place", "drag" or "force"
    eta: Callable = lambda t: 0.0
    external: Callable | None = None
    needs: str = ""  # "mass" or "bodies"
    double: bool = False  # whether it is made for double precision
    constant: bool = True  # in time
    # From rest at a singularity: the order that is left, and the limit of the force and
    # its friction, of the system and the force.
    left: Callable[[System], float] = lambda s: np.inf
    limit: Callable | None = None
    kink: float | None = None

    def __repr__(self):
        return self.name


def _rates(system):
    return np.linspace(0.2, 0.7, system.size)


def _shaped(system, numbers):
    """Numbers for the entries of a state as the package takes them."""
    return jax.tree.map(jnp.asarray, ravel_pytree(system.p)[1](jnp.asarray(numbers)))


def _matrix(system, skew=False):
    """Coefficients that couple the entries within the last axis of each leaf."""
    n = system.size
    full = 0.5 * np.eye(n) if not skew else np.zeros((n, n))
    offset = 0
    for x in jax.tree.leaves(system.p):
        for _ in range(x.size // x.shape[-1]):
            for i in range(offset, offset + x.shape[-1] - 1):
                full[i, i + 1] += 0.6 if skew else 0.2
                full[i + 1, i] -= 0.6 if skew else -0.2
            offset += x.shape[-1]
    return full


def _as_forms(system, full):
    """A block-diagonal matrix as one matrix for each vector of each leaf."""
    forms, offset = [], 0
    leaves, structure = jax.tree.flatten(system.p)
    for x in leaves:
        d, blocks = x.shape[-1], []
        for _ in range(x.size // d):
            blocks.append(full[offset : offset + d, offset : offset + d])
            offset += d
        forms.append(jnp.asarray(np.stack(blocks).reshape(*x.shape, d)))
    return jax.tree.unflatten(structure, forms)


def _operator(system):
    full, like = jnp.asarray(_matrix(system)), jax.tree.map(jnp.asarray, system.p)
    unravel = ravel_pytree(like)[1]
    product = lambda v: unravel(
        full.astype(ravel_pytree(v)[0].dtype) @ ravel_pytree(v)[0]
    )
    return lx.FunctionLinearOperator(product, jax.eval_shape(lambda: like))


def _place_rate(t, q, args):
    return 0.4 + 0.3 * jnp.sin(sum(jnp.sum(x) for x in jax.tree.leaves(q)) + t)


def _place_rate_numpy(t, q):
    return 0.4 + 0.3 * np.sin(np.sum(q) + t)


def _place_matrix(system):
    forms = _as_forms(system, _matrix(system))

    def coefficients(t, q, args):
        rate = _place_rate(t, q, args)
        return jax.tree.map(lambda x: rate * x.astype(rate.dtype), forms)

    return coefficients


def _drag_numpy(system, v, c=0.4, k=2.0):
    out, offset = [], 0
    for x in jax.tree.leaves(system.p):
        for _ in range(x.size // x.shape[-1]):
            body = v[offset : offset + x.shape[-1]]
            out.append(-c * np.linalg.norm(body) ** (k - 1) * body)
            offset += x.shape[-1]
    return np.concatenate(out)


def _any_force(t, q, v, args):
    return jax.tree.map(lambda v: -0.3 * v - 0.1 * v**3, v)


def _rate(rate):
    """The force of one rate of time, or of one for each entry."""
    return lambda system, t, q, p, v: -rate(t) * p


def _wave(t):
    return 0.1 * t + 0.2 * jnp.sin(t)


_KINK = START + LENGTH / 2


def _jump(t):
    return 0.5 * jnp.maximum(t - _KINK, 0)


def _some(make):
    return lambda system: tuple(make(system))


def _same(*laws):
    return lambda system: laws


def _constant(system):
    return dps.ConstantDamping(0.4)


_constant_force = _rate(lambda t: 0.4)


def _by_matrix(system, t, q, p, v):
    return -_matrix(system) @ v


def _by_place(system, t, q, p, v):
    return -_place_rate_numpy(t, q) * p


def _sum(*forces):
    return lambda *x: sum(force(*x) for force in forces)


def _rayleigh(system):
    springs = _as_forms(system, 0.3 * _matrix(system))
    return [dps.ConstantDamping(0.2), dps.ViscousDamping(springs)]


def _viscous(system, skew=False):
    return dps.ViscousDamping(_as_forms(system, _matrix(system, skew)))


def _from_rest(name, law, gamma, extra=0.0):
    """The rate `gamma / t`, and some multiple of the root of that of a law."""

    def eta(t):
        return gamma * np.log(t) + 2 * extra * np.sqrt(t) if t > 0 else -np.inf

    return Friction(
        *(name, lambda system: law, _rate(lambda t: gamma / t + extra / np.sqrt(t))),
        *("one rate", eta),
        constant=False,
        left=lambda s: 2 if extra else gamma + 1,
        limit=lambda system, force: force / (1 + gamma),
    )


FRICTION = [
    Friction("none", _same(), _rate(lambda t: 0.0), "none"),
    Friction(
        *("constant", _same(dps.ConstantDamping(0.4)), _constant_force, "one rate"),
        eta=lambda t: 0.4 * t,
    ),
    Friction(
        *("exciting", _same(dps.ConstantDamping(-0.3)), _rate(lambda t: -0.3)),
        *("one rate", lambda t: -0.3 * t),
    ),
    Friction(
        *("2 / (t + 1)", _same(dps.LogDamping(2.0, 1.0)), _rate(lambda t: 2 / (t + 1))),
        *("one rate", lambda t: 2 * np.log(t + 1)),
        constant=False,
    ),
    Friction(
        *("eta(t)", _same(_wave), _rate(lambda t: 0.1 + 0.2 * np.cos(t)), "one rate"),
        eta=lambda t: 0.1 * t + 0.2 * np.sin(t),
        constant=False,
    ),
    Friction(
        *("rate that jumps", _same(_jump), _rate(lambda t: 0.5 * (t > _KINK))),
        *("one rate", lambda t: 0.5 * max(t - _KINK, 0)),
        constant=False,
        kink=_KINK,
    ),
    _from_rest("3 / t", [dps.LogDamping(3.0)], 3.0),
    _from_rest("1.5 / t", [dps.LogDamping(1.5)], 1.5),
    _from_rest(
        "3 / t + t^(-1/2) / 5",
        [dps.LogDamping(3.0), dps.PowerDamping(0.4, 0.5)],
        3.0,
        0.2,
    ),
    Friction(
        *("by entry", _some(lambda s: [dps.ConstantDamping(_shaped(s, _rates(s)))])),
        *(lambda s, t, q, p, v: -_rates(s) * p, "entries"),
    ),
    Friction(
        "by entry, in time",
        _some(lambda s: [dps.LogDamping(_shaped(s, 3 * _rates(s)), 1.0)]),
        *(lambda s, t, q, p, v: -3 * _rates(s) / (t + 1) * p, "entries"),
        constant=False,
    ),
    Friction(
        "dashpots",
        _some(lambda s: [dps.ViscousDamping(_shaped(s, _rates(s)))]),
        *(lambda s, t, q, p, v: -_rates(s) * v, "entries"),
        needs="mass",
    ),
    Friction(
        "matrix", _some(lambda s: [_viscous(s)]), _by_matrix, "matrix", needs="mass"
    ),
    Friction(
        *("magnetic field", _some(lambda s: [_viscous(s, skew=True)])),
        *(lambda s, t, q, p, v: -_matrix(s, True) @ v, "matrix"),
        needs="mass",
    ),
    Friction(
        *("Rayleigh", _some(_rayleigh)),
        *(lambda s, t, q, p, v: -0.2 * p - 0.3 * _matrix(s) @ v, "matrix"),
        needs="mass",
    ),
    Friction(
        "operator",
        _some(lambda s: [dps.ViscousDamping(_operator(s))]),
        *(_by_matrix, "matrix"),
        needs="mass",
        double=True,
    ),
    Friction("place", _same(dps.PositionDamping(_place_rate)), _by_place, "place"),
    Friction(
        "matrix by place",
        _some(lambda s: [dps.ViscousDamping(_place_matrix(s))]),
        *(lambda s, t, q, p, v: -_place_rate_numpy(t, q) * _matrix(s) @ v, "place"),
        needs="mass",
    ),
    Friction(
        *("drag", _same(dps.Drag(0.4)), lambda s, t, q, p, v: _drag_numpy(s, v)),
        *("drag",),
        needs="bodies",
    ),
    Friction(
        "force",
        _same(),
        *(lambda s, t, q, p, v: -0.3 * v - 0.1 * v**3, "force"),
        external=_any_force,
    ),
    Friction(
        "[constant, place, force]",
        _same(dps.ConstantDamping(0.4), dps.PositionDamping(_place_rate)),
        _sum(_constant_force, _by_place, lambda s, t, q, p, v: -0.3 * v - 0.1 * v**3),
        "force",
        external=_any_force,
    ),
    Friction(
        "[constant, 2 / (t + 1)]",
        _same(dps.ConstantDamping(0.4), dps.LogDamping(2.0, 1.0)),
        *(_rate(lambda t: 0.4 + 2 / (t + 1)), "one rate"),
        eta=lambda t: 0.4 * t + 2 * np.log(t + 1),
        constant=False,
    ),
    Friction(
        "[constant, matrix]",
        _some(lambda s: [_constant(s), _viscous(s)]),
        *(_sum(_constant_force, _by_matrix), "matrix"),
        needs="mass",
    ),
    Friction(
        "[matrix, place]",
        _some(lambda s: [_viscous(s), dps.PositionDamping(_place_rate)]),
        *(_sum(_by_matrix, _by_place), "place"),
        needs="mass",
    ),
    Friction(
        "[constant, drag]",
        _some(lambda s: [_constant(s), dps.Drag(0.4, medium=0.3)]),
        _sum(_constant_force, lambda s, t, q, p, v: _drag_numpy(s, v - 0.3)),
        "drag",
        needs="bodies",
    ),
    Friction(
        *("own drag", _same(own.CubicDrag())),
        lambda s, t, q, p, v: _drag_numpy(s, v, 0.3, 3.0),
        "drag",
        needs="bodies",
    ),
    Friction(
        "[matrix, drag]",
        _some(lambda s: [_viscous(s), dps.Drag(0.4)]),
        _sum(_by_matrix, lambda s, t, q, p, v: _drag_numpy(s, v)),
        "drag",
        needs="bodies",
    ),
]


# Schemes.


@dataclasses.dataclass(frozen=True)
class Scheme:
    """A scheme, the split that it needs, and its claimed order."""

    name: str
    make: Callable[[], Any]
    order: int
    needs: str | None
    symmetric: bool = True
    # A base of compositions: symmetric, and errors even in the step.
    composable: bool = True
    inside: bool = True  # whether it starts at a singularity of the friction
    implicit: bool = False  # whether `make` takes a root finder

    def __repr__(self):
        return self.name


def finder(precision: str) -> optx.AbstractRootFinder:
    tolerance = 1e-12 if precision == "float64" else 3e-6
    return optx.Newton(rtol=tolerance, atol=tolerance)


def _tao4():
    return dps.SuzukiYoshida(4, dps.PresymplecticTao(4.0))


SCHEMES = [
    Scheme(
        *("Euler", dps.PresymplecticEuler, 1, "separable"),
        symmetric=False,
        composable=False,
    ),
    Scheme(
        *("Euler, position first", lambda: dps.PresymplecticEuler("position"), 1),
        *("separable",),
        symmetric=False,
        composable=False,
    ),
    Scheme("leapfrog", dps.PresymplecticLeapfrog, 2, "separable"),
    Scheme(
        *("leapfrog, position first", lambda: dps.PresymplecticLeapfrog("position")),
        *(2, "separable"),
    ),
    Scheme(
        *("Suzuki-Yoshida 4", lambda: dps.SuzukiYoshida(4), 4, "separable"),
        inside=False,
    ),
    Scheme(
        *("Suzuki-Yoshida 6", lambda: dps.SuzukiYoshida(6), 6, "separable"),
        inside=False,
    ),
    Scheme("Suzuki4", dps.Suzuki4, 4, "separable"),
    Scheme(*("Sofroniou-Spaletta 6", lambda: dps.SofroniouSpaletta(6), 6, "separable")),
    Scheme(*("Sofroniou-Spaletta 8", lambda: dps.SofroniouSpaletta(8), 8, "separable")),
    Scheme(
        *("Sofroniou-Spaletta 10", lambda: dps.SofroniouSpaletta(10), 10, "separable")
    ),
    Scheme("Strang", dps.Strang, 2, "any"),
    Scheme("Blanes-Moan 4", dps.BlanesMoan4, 4, "any"),
    Scheme("Blanes-Moan 6", dps.BlanesMoan6, 6, "any"),
    Scheme("own moves", own.DrivenLeapfrog, 2, "any"),
    Scheme(*("Suzuki4 of Strang", lambda: dps.Suzuki4(dps.Strang()), 4, "any")),
    Scheme("RKN4", dps.BlanesMoanRKN4, 4, "nystrom"),
    Scheme("RKN6", dps.BlanesMoanRKN6, 6, "nystrom"),
    Scheme("TunedRKN6", dps.TunedRKN6, 6, "nystrom"),
    Scheme("RKN8", dps.BlanesCasasRKN8, 8, "nystrom"),
    Scheme("TunedLinear8", dps.TunedLinear8, 8, "linear"),
    Scheme(
        *("multistep 8", lambda: dps.SymmetricMultistep(8), 8, "shared"),
        composable=False,
    ),
    Scheme(
        *("multistep 10", lambda: dps.SymmetricMultistep(10), 10, "shared"),
        composable=False,
    ),
    Scheme(*("Tao", dps.PresymplecticTao, 2, None), composable=False),
    Scheme("Tao 4", _tao4, 4, None, inside=False),
    Scheme(
        "midpoint", lambda find: dps.PresymplecticGauss(1, find), 2, None, implicit=True
    ),
    Scheme("Gauss 2", lambda: dps.PresymplecticGauss(2), 4, None),
    Scheme("Gauss 4", lambda: dps.PresymplecticGauss(4), 8, None),
    Scheme(
        *("Gauss 3, root finder", lambda find: dps.PresymplecticGauss(3, find), 6),
        *(None,),
        implicit=True,
    ),
]


# Wrappers and nestings: the wrapped scheme, how many of its steps are one, and the
# order of a composition.


@dataclasses.dataclass(frozen=True)
class Wrapper:
    name: str
    wrap: Callable
    steps: int | None = 1  # of the bare scheme; `None` if it is another scheme
    order: Callable[[int], int] = lambda order: order
    composes: bool = False
    inside: bool = True

    def __repr__(self):
        return self.name


_triple = 1 / (2 - 2 ** (1 / 3))
_WEIGHTS = _triple, 1 - 2 * _triple, _triple


def _composition(base):
    return dps.Composition(base, _WEIGHTS, order=4)


WRAPPERS = [
    Wrapper("bare", lambda base: base),
    Wrapper("Compensated", dps.Compensated),
    Wrapper("substeps", lambda base: substeps(base, 2), 2),
    Wrapper(
        *("substeps(Compensated)", lambda base: substeps(dps.Compensated(base), 3)),
        steps=3,
    ),
    Wrapper(
        *("Compensated(substeps)", lambda base: dps.Compensated(substeps(base, 2))),
        steps=2,
    ),
    Wrapper("Suzuki4", dps.Suzuki4, None, lambda order: 4, composes=True),
    Wrapper(
        *("Sofroniou-Spaletta 6", lambda base: dps.SofroniouSpaletta(6, base), None),
        *(lambda order: 6, True),
    ),
    Wrapper(
        "Compensated(Composition)",
        lambda base: dps.Compensated(_composition(base)),
        *(None, lambda order: 4, True, False),
    ),
    Wrapper(
        "Suzuki4(Compensated)",
        lambda base: dps.Suzuki4(dps.Compensated(base)),
        *(None, lambda order: 4, True),
    ),
]


# What a combination claims.


@dataclasses.dataclass(frozen=True)
class Refused:
    """A combination that must raise an error that says what to write instead."""

    why: str


def offered(system: System, friction: Friction) -> frozenset[str] | Refused:
    """The splits of a system with friction."""
    kind = friction.kind
    if kind == "none":
        return system.offers
    if system.takes == "none":
        return Refused("its own friction")
    if system.takes == "one rate" and kind != "one rate":
        return Refused("one rate")
    if system.takes == "tangential":
        # In drifts one rate, in kicks any friction along the manifold.
        linear = kind in ("entries", "matrix") or friction.name.startswith("[matrix")
        return frozenset() if linear else system.offers
    if system.takes == "joints":
        return Refused("not of joints") if friction.needs == "bodies" else frozenset()
    if friction.needs == "mass" and system.takes == "velocities":
        kind = "force"
    elif friction.needs and system.mass is None:
        return Refused("no mass")
    if friction.name == "operator" and np.shape(system.p) != (system.size,):
        return Refused("not one vector")
    if friction.needs == "bodies" and not system.bodies:
        return frozenset()  # without a closed form, it is a force
    if kind == "force" and system.takes == "rates":
        return frozenset()
    if kind in ("force", "place", "drag"):
        return system.offers & {"any"}
    constant = friction.constant and kind == "one rate"
    return system.offers - (frozenset() if constant else {"shared", "linear"})


def claim(
    system: System, friction: Friction, scheme: Scheme, wrapper: Wrapper = WRAPPERS[0]
) -> float | Refused:
    """The order that a combination claims."""
    splits = offered(system, friction)
    if isinstance(splits, Refused):
        return splits
    if scheme.needs is not None and scheme.needs not in splits:
        return Refused(f"no split of kind {scheme.needs}")
    if scheme.needs is None and system.constrained:
        return Refused("leaves the manifold")
    if wrapper.composes and not scheme.composable:
        return Refused("not a base of compositions")
    order = scheme.order
    if wrapper.composes and order == 2:
        order = wrapper.order(order)
    if friction.kind == "drag" and system.size == 1:
        return min(order, 2)  # |v| v has a kink where the body turns
    if friction.kink is not None and not (scheme.inside and wrapper.inside):
        return min(order, 2)  # stages go beyond the ends of a step
    if friction.limit is None:
        return order
    # From a singularity on: an exact drift of a known mass leaves more than others.
    exact = scheme.needs in ("any", "nystrom") and system.mass is not None
    return min(order, friction.left(system) if exact else 2)


def fails(system: System, friction: Friction, scheme: Scheme, wrapper: Wrapper) -> bool:
    """Whether a solve must fail: stages leave the domain, or a force is infinite."""
    infinite = system.takes == "joints" and friction.needs == "mass"
    stays = scheme.inside and wrapper.inside and not infinite
    return friction.limit is not None and not stays


# The reference.


@functools.cache
def reference(system: System, friction: Friction):
    """The solution as a function of time, by SciPy on the bare equations."""
    t0, t1 = span(system, friction)
    n = ravel_pytree(system.q)[0].size

    def field(t, y):
        q, p = y[:n], y[n:]
        v, force = system.velocity(t, q, p, friction.eta(t)), system.force(t, q, p)
        if friction.limit is not None and t == 0:
            force = friction.limit(system, force)
        else:
            speed = v if n == p.size else np.linalg.solve(system.mass, p)
            force = force + friction.force(system, t, q, p, speed)
        if system.react is not None:
            force = system.react(t, q, p, force)
        return np.concatenate([v, force])

    ends = [t0, *([] if friction.kink is None else [friction.kink]), t1]
    pieces, y = [], ravel_pytree(start(system, friction))[0]
    for a, b in itertools.pairwise(ends):
        solution = scipy.integrate.solve_ivp(
            *(field, (a, b), y, "DOP853"),
            rtol=3e-14,
            atol=1e-14,
            dense_output=True,
            # The interpolation is of order 7.
            max_step=0.02,
        )
        y = solution.y[:, -1]
        pieces.append((a, b, solution.sol))

    def at(ts):
        out = []
        for t in np.ravel(ts):
            piece = next(sol for a, b, sol in pieces if t <= b + 1e-12)
            out.append(piece(t))
        return np.array(out)

    return at


def span(system: System, friction: Friction) -> tuple[float, float]:
    t0 = 0.0 if friction.limit is not None else system.start
    return t0, t0 + LENGTH


def start(system: System, friction: Friction):
    """The initial state: at rest where friction is singular."""
    rest = 0.0 if friction.limit is not None else 1.0
    return _start(system, span(system, friction)[0], rest)


@functools.cache
def _start(system: System, t0: float, scale: float):
    y0 = system.q, jax.tree.map(lambda p: scale * p, system.p)
    if not system.constrained:
        return y0
    y0 = system.build(()).project(t0, jax.tree.map(jnp.asarray, y0))
    return jax.tree.map(np.asarray, y0)


# Ways to run.

IRREGULAR = np.array([0.0, 0.04, 0.31, 0.3101, 0.77, 0.9, 1.0])  # of the span


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to run `n` steps: `run(problem, n, y0)` returns what was saved.

    That is a list of pairs of times and states. `n` is traced unless `prescribed`.
    """

    name: str
    run: Callable
    own: bool = True  # whether it uses the loop of the package
    prescribed: bool = False
    equal: bool = True  # whether all steps have one length
    end: bool = True  # whether the last of what it returns is the end of the solve
    order: bool = (
        True  # whether the error is that of the scheme, so that it has an order
    )
    backwards: bool = False

    def __repr__(self):
        return self.name


MAX_STEPS = 512


@dataclasses.dataclass(frozen=True)
class Problem:
    """A solve, but for the number of steps and the initial state."""

    system: Any
    solver: Any
    t0: Any
    t1: Any
    adjoint: Any

    def solve(self, dt0, y0, saveat, **options):
        options = {"t0": self.t0, "t1": self.t1, "args": None} | options
        return dfx.diffeqsolve(
            self.system,
            self.solver,
            **{"dt0": dt0, "y0": y0, "saveat": saveat, "adjoint": self.adjoint},
            **{"max_steps": MAX_STEPS, "throw": False} | options,
        )

    def length(self, n):
        return (self.t1 - self.t0) / n

    def times(self, fractions):
        dtype = jnp.result_type(self.t0)
        return self.t0 + (self.t1 - self.t0) * jnp.asarray(fractions, dtype)


def _saved(saveat):
    def run(problem, n, y0):
        sol = problem.solve(problem.length(n), y0, saveat(problem))
        return [(sol.ts, sol.ys)], sol.result

    return run


def _everything(problem, n, y0):
    ts = problem.times(IRREGULAR)
    subs = [
        dfx.SubSaveAt(t0=True, steps=2, ts=ts[1:-1]),
        dfx.SubSaveAt(ts=ts[2:4], fn=lambda t, y, args: jax.tree.map(jnp.asarray, y)),
        dfx.SubSaveAt(t1=True),
    ]
    sol = problem.solve(problem.length(n), y0, dfx.SaveAt(subs=subs))
    return list(zip(sol.ts, sol.ys, strict=True)), sol.result


def _unequal(problem, n, y0):
    u = np.linspace(0, 1, n + 1)
    ts = problem.times(u + 0.3 * np.sin(2 * np.pi * u) / (2 * np.pi))
    ts = ts.at[-1].set(problem.t1)
    controller, saveat = dfx.StepTo(ts=ts), dfx.SaveAt(ts=problem.times(IRREGULAR))
    sol = problem.solve(None, y0, saveat, stepsize_controller=controller)
    return [(sol.ts, sol.ys)], sol.result


def _adaptive(problem, n, y0):
    solver = dfx.HalfSolver(problem.solver)
    tolerance = 1 / n**3
    controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    problem = dataclasses.replace(problem, solver=solver)
    sol = problem.solve(
        problem.length(8.0), y0, dfx.SaveAt(t1=True), stepsize_controller=controller
    )
    return [(sol.ts, sol.ys)], sol.result


def _step_density(problem, n, y0):
    density = lambda t, y, args: (
        1 / (1 + 0.2 * sum(jnp.sum(x**2) for x in jax.tree.leaves(y[0])))
    )
    controller = dps.StepDensityController(problem.length(n), density)
    ts = dfx.SaveAt(t1=True)
    sol = problem.solve(None, y0, ts, stepsize_controller=controller)
    return [(sol.ts, sol.ys)], sol.result


def _chunks(problem, n, y0):
    """The second half from the solver state at the end of the first."""
    middle, h = problem.t0 + (problem.t1 - problem.t0) / 2, problem.length(n)
    save = dfx.SaveAt(t1=True, solver_state=True, made_jump=True)
    first = problem.solve(h, y0, save, t1=middle)
    y = jax.tree.map(lambda x: x[-1], first.ys)
    second = problem.solve(
        h,
        y,
        dfx.SaveAt(t1=True),
        t0=middle,
        solver_state=first.solver_state,
        made_jump=first.made_jump,
    )
    result = dfx.RESULTS.where(
        first.result == dfx.RESULTS.successful, second.result, first.result
    )
    return [(first.ts, first.ys), (second.ts, second.ys)], result


def _backwards(problem, n, y0):
    sol = problem.solve(
        *(-problem.length(n), y0, dfx.SaveAt(ts=problem.times(IRREGULAR)[::-1])),
        **{"t0": problem.t1, "t1": problem.t0},
    )
    return [(sol.ts, sol.ys)], sol.result


def _batch(problem, n, y0):
    saveat = dfx.SaveAt(ts=problem.times(IRREGULAR))

    def one(k, y0):
        sol = problem.solve(problem.length(n * k), y0, saveat)
        return sol.ts, sol.ys, sol.result

    k = jnp.array([1, 2], jnp.result_type(problem.t0))
    ts, ys, result = jax.vmap(one)(k, jax.tree.map(lambda x: jnp.stack([x, x]), y0))
    row = lambda i: jax.tree.map(lambda x: x[i], (ts, ys))
    failed = result != dfx.RESULTS.successful
    worst = jax.tree.map(lambda x: x[jnp.argmax(failed)], result)
    return [row(0), row(1)], worst


def _dense(problem, n, y0):
    saveat = dfx.SaveAt(dense=True, t1=True)
    sol = problem.solve(problem.length(n), y0, saveat)
    ts = problem.times(IRREGULAR)
    return [(ts, jax.vmap(sol.evaluate)(ts)), (sol.ts, sol.ys)], sol.result


_at_times = _saved(lambda problem: dfx.SaveAt(ts=problem.times(IRREGULAR)))
_at_end = _saved(lambda _: dfx.SaveAt(t1=True))

WAYS = [
    Way("Diffrax's loop, end", _at_end, own=False),
    Way("Diffrax's loop, times", _at_times, own=False),
    Way("Diffrax's loop, dense", _dense, own=False),
    Way("Diffrax's loop, chunks", _chunks, own=False),
    Way("HalfSolver", _adaptive, own=False, equal=False, order=False),
    Way("step density", _step_density, own=False, equal=False),
    Way("end", _at_end),
    Way("every second step", _saved(lambda _: dfx.SaveAt(steps=2)), end=False),
    Way("times", _at_times),
    Way("everything", _everything),
    Way("unequal steps", _unequal, prescribed=True, equal=False),
    Way("chunks", _chunks),
    Way("backwards", _backwards, end=False, backwards=True),
    Way("batch", _batch, end=False),
]


# Gradients: the adjoint, and whether it is for the loop of the package.


@dataclasses.dataclass(frozen=True)
class Gradient:
    name: str
    adjoint: Callable | None
    own: bool

    def __repr__(self):
        return self.name


GRADIENTS = [
    Gradient("reversal", dps.FixedStepAdjoint, True),
    Gradient("checkpoints", lambda: dps.FixedStepAdjoint("checkpoints"), True),
    Gradient("Diffrax's checkpoints", dfx.RecursiveCheckpointAdjoint, False),
    Gradient("forward mode", dfx.ForwardMode, False),
]

PRECISIONS = ["float64", "float32"]

# What is exported and not combined here, and the file of tests that has it.
ELSEWHERE = {
    "StepDensityController",  # step_density
    *("ChosenStep", "FixedStepAdjoint", "StepsBetween"),  # choose_step, adjoint
    "Stiefel",  # manifolds
    "MirrorMap",  # bregman
    *("Splitting", "SplittingTableau"),  # tableaus
}
