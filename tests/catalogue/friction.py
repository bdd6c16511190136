# pyright: reportArgumentType=false
"""Laws of friction, each written twice: with the package, and in NumPy."""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import own
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps

from ._system import JUMP, System


@dataclasses.dataclass(frozen=True, eq=False)
class Friction:
    """Friction, `laws(system)`, and its force of time and state in NumPy."""

    name: str
    laws: Callable[[System], tuple | list]
    force: Callable  # of the system, t, q, p, v
    kind: str  # "none", "one rate", "entries", "matrix", "place", "drag" or "force"
    eta: Callable = lambda t: 0.0
    external: Callable | None = None
    needs: str = ""  # "mass" or "bodies"
    double: bool = False  # whether it is made for double precision
    constant: bool = True  # in time
    # From rest at a singularity: the order that is left, and the limit of the force and
    # its friction.
    left: Callable[[System], float] = lambda s: np.inf
    limit: Callable | None = None
    jumps: bool = False  # whether its rate does, at `JUMP`

    def __repr__(self):
        return self.name


def _rates(system):
    return np.linspace(0.2, 0.7, system.size)


def _shaped(system, numbers):
    """Numbers for the entries of a state as the package takes them."""
    unravel = ravel_pytree(system.y0[1])[1]
    return jax.tree.map(jnp.asarray, unravel(jnp.asarray(numbers)))


def _vectors(system):
    """The slices of a flat state that are the last axes of its leaves."""
    offset = 0
    for x in jax.tree.leaves(system.y0[1]):
        for _ in range(x.size // x.shape[-1]):
            yield slice(offset, offset + x.shape[-1])
            offset += x.shape[-1]


def _matrix(system, skew=False):
    """Coefficients that couple the entries within the last axis of each leaf."""
    full = 0.5 * np.eye(system.size) * (not skew)
    for part in _vectors(system):
        for i in range(part.start, part.stop - 1):
            full[i, i + 1] += 0.6 if skew else 0.2
            full[i + 1, i] -= 0.6 if skew else -0.2
    return full


def _forms(system, full):
    """A block-diagonal matrix as one matrix for each vector of each leaf."""
    parts = _vectors(system)

    def leaf(x):
        number = range(x.size // x.shape[-1])
        blocks = [full[k, k] for _, k in zip(number, parts, strict=False)]
        return jnp.asarray(np.stack(blocks).reshape(*x.shape, x.shape[-1]))

    return jax.tree.map(leaf, system.y0[1])


def _operator(system):
    full = jnp.asarray(_matrix(system))
    like = jax.tree.map(jnp.asarray, system.y0[1])
    unravel = ravel_pytree(like)[1]

    def product(v):
        v = ravel_pytree(v)[0]
        return unravel(full.astype(v.dtype) @ v)

    return lx.FunctionLinearOperator(product, jax.eval_shape(lambda: like))


def _place(t, q, args):
    return 0.4 + 0.3 * jnp.sin(sum(jnp.sum(x) for x in jax.tree.leaves(q)) + t)


def _place_numpy(t, q):
    return 0.4 + 0.3 * np.sin(np.sum(q) + t)


def _place_matrix(system):
    forms = _forms(system, _matrix(system))

    def coefficients(t, q, args):
        rate = _place(t, q, args)
        return jax.tree.map(lambda x: rate * x.astype(rate.dtype), forms)

    return coefficients


def _drag_force(system, v, c=0.4, k=2.0):
    bodies = [v[part] for part in _vectors(system)]
    return np.concatenate([-c * np.linalg.norm(x) ** (k - 1) * x for x in bodies])


def _external(t, q, v, args):
    return jax.tree.map(lambda v: -0.3 * v - 0.1 * v**3, v)


def _wave(t):
    return 0.1 * t + 0.2 * jnp.sin(t)


def _jump(t):
    return 0.5 * jnp.maximum(t - JUMP, 0)


def _viscous(system, skew=False):
    return dps.ViscousDamping(_forms(system, _matrix(system, skew)))


def _rayleigh(system):
    springs = _forms(system, 0.3 * _matrix(system))
    return [dps.ConstantDamping(0.2), dps.ViscousDamping(springs)]


# Forces in NumPy.


def _by_rate(rate):
    """The force of one rate of time, or of one for each entry."""
    return lambda system, t, q, p, v: -rate(t) * p


def _by_matrix(system, t, q, p, v):
    return -_matrix(system) @ v


def _by_place(system, t, q, p, v):
    return -_place_numpy(t, q) * p


def _by_force(system, t, q, p, v):
    return -0.3 * v - 0.1 * v**3


def _by_drag(system, t, q, p, v):
    return _drag_force(system, v)


def _sum(*forces):
    return lambda *x: sum(force(*x) for force in forces)


# Kinds of friction. Laws are given as they are, or as a function of the system.


def _one(kind, name, laws, force, **options):
    return Friction(
        name, laws if callable(laws) else lambda s: laws, force, kind, **options
    )


_entries, _matrices, _places = (
    partial(_one, kind) for kind in ("entries", "matrix", "place")
)
_drags = partial(_one, "drag", needs="bodies")
_forces = partial(_one, "force", external=_external)


def _rate(name, laws, rate, eta, **options):
    return _one("one rate", name, laws, _by_rate(rate), eta=eta, **options)


def _from_rest(name, laws, gamma, extra=0.0):
    """The rate `gamma / t`, and some multiple of the root of that of a law."""

    def eta(t):
        return gamma * np.log(t) + 2 * extra * np.sqrt(t) if t > 0 else -np.inf

    return _rate(
        *(name, laws, lambda t: gamma / t + extra / np.sqrt(t), eta),
        constant=False,
        left=lambda s: 2 if extra else gamma + 1,
        limit=lambda force: force / (1 + gamma),
    )


_constant, _log = dps.ConstantDamping(0.4), dps.LogDamping(2.0, 1.0)
_by_constant = _by_rate(lambda t: 0.4)
_three, _place_law = dps.LogDamping(3.0), dps.PositionDamping(_place)

FRICTION = [
    _one("none", "none", (), _by_rate(lambda t: 0.0)),
    _rate("constant", (_constant,), lambda t: 0.4, lambda t: 0.4 * t),
    _rate("exciting", (dps.ConstantDamping(-0.3),), lambda t: -0.3, lambda t: -0.3 * t),
    _rate(
        *("2 / (t + 1)", (_log,), lambda t: 2 / (t + 1), lambda t: 2 * np.log(t + 1)),
        constant=False,
    ),
    _rate(
        *("eta(t)", (_wave,), lambda t: 0.1 + 0.2 * np.cos(t)),
        lambda t: 0.1 * t + 0.2 * np.sin(t),
        constant=False,
    ),
    _rate(
        *("rate that jumps", (_jump,), lambda t: 0.5 * (t > JUMP)),
        lambda t: 0.5 * max(t - JUMP, 0),
        constant=False,
        jumps=True,
    ),
    _from_rest("3 / t", [_three], 3.0),
    _from_rest("1.5 / t", [dps.LogDamping(1.5)], 1.5),
    _from_rest("3 / t + t^(-1/2) / 5", [_three, dps.PowerDamping(0.4, 0.5)], 3.0, 0.2),
    _entries(
        "by entry",
        lambda s: [dps.ConstantDamping(_shaped(s, _rates(s)))],
        lambda s, t, q, p, v: -_rates(s) * p,
    ),
    _entries(
        "by entry, in time",
        lambda s: [dps.LogDamping(_shaped(s, 3 * _rates(s)), 1.0)],
        lambda s, t, q, p, v: -3 * _rates(s) / (t + 1) * p,
        constant=False,
    ),
    _entries(
        "dashpots",
        lambda s: [dps.ViscousDamping(_shaped(s, _rates(s)))],
        lambda s, t, q, p, v: -_rates(s) * v,
        needs="mass",
    ),
    _matrices("matrix", lambda s: [_viscous(s)], _by_matrix, needs="mass"),
    _matrices(
        "magnetic field",
        lambda s: [_viscous(s, skew=True)],
        lambda s, t, q, p, v: -_matrix(s, True) @ v,
        needs="mass",
    ),
    _matrices(
        *("Rayleigh", _rayleigh, lambda s, t, q, p, v: -0.2 * p - 0.3 * _matrix(s) @ v),
        needs="mass",
    ),
    _matrices(
        *("operator", lambda s: [dps.ViscousDamping(_operator(s))], _by_matrix),
        needs="mass",
        double=True,
    ),
    _places("place", (_place_law,), _by_place),
    _places(
        "matrix by place",
        lambda s: [dps.ViscousDamping(_place_matrix(s))],
        lambda s, t, q, p, v: -_place_numpy(t, q) * _matrix(s) @ v,
        needs="mass",
    ),
    _drags("drag", (dps.Drag(0.4),), _by_drag),
    _forces("force", (), _by_force),
    _forces(
        *("[constant, place, force]", (_constant, _place_law)),
        _sum(_by_constant, _by_place, _by_force),
    ),
    _rate(
        *("[constant, 2 / (t + 1)]", (_constant, _log), lambda t: 0.4 + 2 / (t + 1)),
        lambda t: 0.4 * t + 2 * np.log(t + 1),
        constant=False,
    ),
    _matrices(
        *("[constant, matrix]", lambda s: [_constant, _viscous(s)]),
        _sum(_by_constant, _by_matrix),
        needs="mass",
    ),
    _places(
        *("[matrix, place]", lambda s: [_viscous(s), _place_law]),
        _sum(_by_matrix, _by_place),
        needs="mass",
    ),
    _drags(
        *("[constant, drag]", (_constant, dps.Drag(0.4, medium=0.3))),
        _sum(_by_constant, lambda s, t, q, p, v: _drag_force(s, v - 0.3)),
    ),
    _drags(
        *("own drag", (own.CubicDrag(),)),
        lambda s, t, q, p, v: _drag_force(s, v, 0.3, 3.0),
    ),
    _drags(
        *("[matrix, drag]", lambda s: [_viscous(s), dps.Drag(0.4)]),
        _sum(_by_matrix, _by_drag),
    ),
]
