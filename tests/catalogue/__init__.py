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

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from jax.flatten_util import ravel_pytree

from ._system import ANY, JUMP, LENGTH, System
from .friction import FRICTION, Friction
from .schemes import each, PATHS, pick, Scheme, SCHEMES, STATES, Wrapper, WRAPPERS
from .systems import SYSTEMS
from .ways import GRADIENTS, Problem, WAYS


__all__ = [
    "ELSEWHERE", "FRICTION", "GRADIENTS", "PATHS", "PRECISIONS", "SCHEMES", "STATES",
    "SYSTEMS", "WAYS", "WRAPPERS", "Problem", "Refused", "Scheme", "build", "claim",
    "each", "fails", "named", "offered", "pick", "reference", "span", "start",
]  # fmt: skip

PRECISIONS = ["float64", "float32"]

# What is exported and not combined here, and the file of tests that has it.
ELSEWHERE = {
    *("StepDensityController", "StepsBetween", "FixedStepAdjoint"),  # ways
    "ChosenStep",  # choose_step
    "Stiefel",  # manifolds
    "MirrorMap",  # bregman
    *("Splitting", "SplittingTableau"),  # tableaus
}


def named(entries: list, *names: str) -> list:
    """The entries of these names."""
    by_name = {entry.name: entry for entry in entries}
    return [by_name[name] for name in names]


def build(system: System, friction: Friction):
    external = {} if friction.external is None else {"force": friction.external}
    return system.build(friction.laws(system), **external)


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
        offers = system.offers if kind == "one rate" else ANY
        return frozenset() if linear else offers
    if system.takes == "joints":
        return Refused("not of joints") if friction.needs == "bodies" else frozenset()
    if friction.needs == "mass" and system.takes == "velocities":
        kind = "force"
    elif friction.needs and system.mass is None:
        return Refused("no mass")
    if friction.name == "operator" and np.shape(system.y0[1]) != (system.size,):
        return Refused("not one vector")
    if friction.needs == "bodies" and not system.bodies:
        return frozenset()  # without a closed form, it is a force
    in_kicks = kind in ("force", "place", "drag")
    if in_kicks and system.takes == "rates":
        return frozenset()  # a split of a user has no such kicks
    if in_kicks or (system.constrained and kind != "one rate"):
        return system.offers & ANY
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
    if wrapper.order is not None and order == 2:
        order = wrapper.order
    if friction.kind == "drag" and system.size == 1:
        return min(order, 2)  # |v| v has a kink where the body turns
    if friction.jumps and not (scheme.inside and wrapper.inside):
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


@functools.cache
def reference(system: System, friction: Friction):
    """The solution as a function of time, by SciPy on the bare equations."""
    t0, t1 = span(system, friction)
    n = ravel_pytree(system.y0[0])[0].size

    def field(t, y):
        q, p = y[:n], y[n:]
        v, force = system.moves(t, q, p, friction.eta(t)), system.force(t, q, p)
        if friction.limit is not None and t == 0:
            force = friction.limit(force)
        else:
            speed = v if n == p.size else system.by_mass(p)
            force = force + friction.force(system, t, q, p, speed)
        if system.react is not None:
            force = system.react(t, q, p, force)
        return np.concatenate([v, force])

    jumps = system.jumps or friction.jumps
    ends = [t0, *([JUMP] if jumps else []), t1]
    pieces, y = [], ravel_pytree(start(system, friction))[0]
    for a, b in itertools.pairwise(ends):
        solution = scipy.integrate.solve_ivp(
            *(field, (a, b), y, "DOP853"),
            rtol=3e-14,
            atol=1e-14,
            dense_output=True,
            max_step=0.02,  # The interpolation is of order 7.
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
    q, p = system.y0
    y0 = q, jax.tree.map(lambda p: scale * p, p)
    if not system.constrained:
        return y0
    y0 = system.build(()).project(t0, jax.tree.map(jnp.asarray, y0))
    return jax.tree.map(np.asarray, y0)
