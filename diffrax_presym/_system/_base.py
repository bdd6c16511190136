import abc
from collections.abc import Callable
from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool, Inexact, PyTree

from .. import _tree as tree
from .._checks import describe, match
from .._friction._base import AbstractFriction, Mechanics, Parts
from .._friction._damping import AbstractDamping
from .._friction._fit import fit_friction, one_rate
from .._friction._linear import LinearFriction
from .._numbers import as_time, Scalar, State, Time
from ._split import AbstractSplit


Q = PyTree[Inexact[Array, "..."]]
P = PyTree[Inexact[Array, "..."]]


class AbstractSystem(dfx.AbstractTerm):
    """A mechanical system: the equations of motion, as a Diffrax term.

    The state is a pair `(q, p)` of pytrees of one structure, the positions and the
    *mechanical* momenta. With an energy `E` and a log scale `η` of the friction, the
    Hamiltonian is `H(t, q, P) = exp(η(t)) E(t, q, exp(-η(t)) P)`, and
    `p = exp(-η(t)) P`: it stays of the size of the velocity under damping, where the
    canonical momentum `P` overflows in `float32` once `η(t)` exceeds 88.

    Pass it to `diffrax.diffeqsolve`, with a solver of this package or any other of
    Diffrax for ordinary differential equations, which uses the full vector field
    `(∂E/∂p, -∂E/∂q - η'(t) p)`.

    To write a system of your own, subclass it with `energy`, `velocity`, `force` and
    `splits`.
    """

    @property
    @abc.abstractmethod
    def splits(self) -> tuple[AbstractSplit, ...]:
        """The pairs of exact flows into which the motion splits, the best first; `()`
        if no exact flow is known."""

    @abc.abstractmethod
    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """The mechanical energy `E(t, q, p)`."""

    @abc.abstractmethod
    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        """The velocity `∂E / ∂p`."""

    @abc.abstractmethod
    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        """The force `-∂E / ∂q`, and all other forces but linear friction that depends
        on time alone."""

    # What is different for some systems.

    def velocity_and_force(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> tuple[Q, P]:
        """Both at once, where they share computations."""
        v = self.velocity(t, q, p, args)
        return v, self.force_at(t, q, p, v, args)

    def force_at(self, t: Time, q: Q, p: P, v: Q, args: PyTree = None) -> P:
        """The force at a known velocity, which spares a system of which forces depend
        on it the way there. An iteration passes that of its last round."""
        return self.force(t, q, p, args)

    def add(self, y: State, dy: tuple[Q | None, P | None]) -> State:
        """The state `y` displaced by `dy`, of which either part may be `None`: a sum,
        or a step on a manifold. Solvers update states by it alone."""
        return tuple(  # pyright: ignore[reportReturnType]
            x if dx is None else tree.add(x, dx) for x, dx in zip(y, dy, strict=True)
        )

    def check_state(self, y: PyTree) -> None:
        """`ValueError` if `y` is not a state: by default, unless it is a pair `(q, p)`
        of pytrees of one structure, shape and precision."""
        check_state(y)

    # Systems whose states lie on a manifold.

    is_constrained: ClassVar[bool] = False

    def turning(self, q: Q, p: P) -> Scalar | None:
        """The largest rate at which a state turns without forces; `None`, the default,
        if it moves along straight lines."""
        return None

    def violation(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar | None:
        """By how much a state is off the manifold of the system, or its velocity off
        the tangent space; `None`, the default, if there is no such manifold."""
        return None

    def off_manifold(
        self, t: Time, h: Time, q: Q, p: P, args: PyTree = None
    ) -> Scalar | None:
        """As `violation`, without a unit of time: of velocities relative to their size,
        but for what moves a state by rounding in a step `h`."""
        return self.violation(t, q, p, args)

    def project(self, t: Time, y: State, args: PyTree = None) -> State:
        """The state moved to the manifold of the system, and its momentum to the
        tangent space. By default, where there is none, `y`."""
        return y

    def factorised(self, p: P) -> "AbstractSystem":
        """The same system, for many evaluations with momenta of this shape. By default
        nothing can be computed beforehand."""
        return self

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        """Whether the energy is defined at this state; if not, a solve fails. `None`,
        the default, means that it is not checked."""
        return None

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        """The laws of friction. None by default."""
        return ()

    @property
    def mechanics(self) -> Mechanics:
        """What friction needs to know of the system; by default nothing is known."""
        return Mechanics(has_mass=False)

    @property
    def drift_is_autonomous(self) -> bool:
        """Whether a drift depends on time by the length of its span alone, so that it
        is prepared once for steps of one length."""
        return False

    # The full vector field, for Diffrax.

    def vf(self, t, y: State, args: PyTree) -> State:
        self.check_state(y)
        t = as_time(t)
        velocity, force = self.velocity_and_force(t, *y, args)
        friction = self.fit_friction(y[1])
        return velocity, force if friction is None else friction.net_force(
            t, force, y[1]
        )

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf: State, control) -> State:
        return tree.scale(control, vf)

    # Friction, and other forces.

    @property
    def parts(self) -> Parts:
        """The friction, by where it acts; `ValueError` if a law does not fit."""
        each = [law.parts(self.mechanics) for law in self.laws]
        for law, parts in zip(self.laws, each, strict=True):
            if parts.linear and any(parts[1:]):
                raise ValueError(
                    f"`{type(law).__name__}.parts` must not join linear friction with "
                    "other friction. Write two laws: `friction=[first, second]`."
                )
        return sum(each, Parts())  # pyright: ignore

    def add_forces(
        self, force: P, external: Callable | None, t: Time, q: Q, p: P, v: Q, args
    ) -> P:
        """A force, and what else acts on a state of velocity `v`: the friction that is
        not part of drifts, and a user's force `external(t, q, v, args)`."""
        for law in self.laws:
            if not law.parts(self.mechanics).linear:
                force = tree.add(force, law.force(t, q, p, v, args))
        if external is None:
            return force
        value = external(t, q, v, args)
        return tree.add(force, match(value, v, "`force`", "the velocity"))

    def fit_friction(self, p: P) -> LinearFriction | None:
        """The linear friction that depends on time alone, for momenta like `p`."""
        return fit_friction(self.parts.linear, self.mechanics, p)

    def friction_force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        """The force of all friction."""
        v, friction = self.velocity(t, q, p, args), self.fit_friction(p)
        force = self.add_forces(tree.zeros(p), None, t, q, p, v, args)
        return force if friction is None else friction.net_force(t, force, p)

    @property
    def damping(self) -> AbstractDamping | None:
        """The law of friction, if that is one rate for all momenta; `ValueError` if
        there is other friction."""
        return one_rate(self.parts)

    # Canonical momenta, and velocities.

    def log_scale(self, t: Time) -> Scalar:
        """The log scale `η(t)`; 0 for a system without damping."""
        t = as_time(t)
        return jnp.zeros_like(t) if self.damping is None else self.damping(t)

    def canonical(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        """The value of the Hamiltonian, `exp(η(t)) E(t, q, p)`.

        `p` is the mechanical momentum, as in a solution.
        """
        energy = self.energy(t, q, p, args)
        return tree.scale(jnp.exp(self.log_scale(t)), energy)

    def to_canonical(self, t: Time, p: P) -> P:
        """From the mechanical momentum to the canonical, `P = exp(η(t)) p`."""
        return tree.scale(jnp.exp(self.log_scale(t)), p)

    def from_canonical(self, t: Time, P: P) -> P:
        """From the canonical momentum to the mechanical, `p = exp(-η(t)) P`."""
        return tree.scale(jnp.exp(-self.log_scale(t)), P)

    def from_velocity(self, t: Time, y: tuple[Q, Q], args: PyTree = None) -> State:
        """The state `(q, p)` of positions and velocities `(q, v)`: by Newton's method
        from the momentum that is equal to the velocity."""
        return y[0], _momentum(self, as_time(t), y, args)

    def to_velocity(self, t: Time, y: State, args: PyTree = None) -> tuple[Q, Q]:
        """Positions and velocities `(q, v)` of a state `(q, p)`: save them by
        `SaveAt(..., fn=system.to_velocity)`."""
        q, p = y
        return q, self.velocity(t, q, p, args)


AbstractSystem.__init__.__doc__ = "**Arguments:** its fields, if any."


@eqx.filter_jit  # Outside of a solve, it would be compiled again by each call.
def _momentum(system: AbstractSystem, t: Time, y: tuple[Q, Q], args: PyTree) -> P:
    q, v = y
    eps = max(float(jnp.finfo(x.dtype).eps) for x in jtu.tree_leaves(v))
    size = lax.stop_gradient(tree.largest(v))
    # Relative to the velocity, so that the tolerance is its rounding.
    unit = jnp.where(size > 0, 1 / size, 1)
    miss = lambda p: tree.sub(system.velocity(t, q, p, args), v)
    residual = lambda p, _: tree.scale(unit, miss(p))
    finder = optx.Newton(rtol=10 * eps, atol=10 * eps)
    p = optx.root_find(residual, finder, v, max_steps=64, throw=False).value
    # Rounding of the energy may be larger than that of the velocity.
    missed = ~(tree.largest(residual(p, None)) <= eps**0.5)
    message = "`from_velocity` found no momentum of this velocity."
    return eqx.error_if(p, missed, message)


def check_state(y: PyTree) -> None:
    wanted = "The state must be a pair `(q, p)` of positions and momenta"
    if type(y) is not tuple or len(y) != 2:
        raise ValueError(f"{wanted}, but got {describe(y)}. Write `y0=(q0, p0)`.")
    q, p = y
    if describe(q) != describe(p):
        raise ValueError(
            f"{wanted} of one structure, shape and precision, but got q of "
            f"{describe(q)} and p of {describe(p)}."
        )
    for leaf in jtu.tree_leaves(y):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"{wanted} in real floating point, but got {describe(q)}. Convert "
                "them with `jnp.asarray(x, float)`, a complex number to its real and "
                "imaginary parts."
            )
