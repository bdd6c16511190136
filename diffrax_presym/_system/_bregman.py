from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._checks import check_callable, scalar_fn
from .._friction._base import AbstractFriction
from .._numbers import Scalar, State, Time
from ._base import AbstractSystem, P, Q
from ._mirror import AbstractMirrorMap
from ._scaling import Scaling
from ._split import AbstractSplit


class BregmanSplit(AbstractSplit):
    """The drift is the flow of the Bregman divergence, the kick that of the
    objective."""

    kinds: frozenset[str] = eqx.field(static=True)
    is_resolved: ClassVar[bool] = True

    def prepare(self, system, t, h, order) -> PyTree:
        friction: Any = system.friction  # there always is some
        return friction.prepare(t, h, order)

    def drift(self, system, t, h, data, y) -> State:
        mirror, (q, p) = system.term.mirror_map, tree.values(y)
        friction: Any = system.friction
        dq = tree.scale(-1, friction.decay(data, mirror.step(q, p)))
        if mirror.is_quadratic:
            return system.add(y, (dq, friction.decay(data, p)))
        # A drift leaves grad h(q) + p constant.
        change = tree.scale(-1, mirror.change(q, dq))
        return system.add(y, (dq, mirror.project(change)))

    def force(self, system, t, y) -> PyTree:
        return system.term.potential_force(t, tree.values(y)[0], system.args)


class BregmanHamiltonian(AbstractSystem):
    """The Bregman Hamiltonian, whose motion minimises a function `f`, `H = exp(α + γ)
    [D(∇h(q) + exp(-γ) P, ∇h(q)) + exp(β) f(q)]`.

    Equation (bregman_ham) of França, Jordan and Vidal (2021), after Wibisono, Wilson
    and Jordan (2016), where `D` is the Bregman divergence of the convex dual of the
    mirror map `h`. The log scale is `γ`, so the state holds `p = exp(-γ) P`, and with
    `m = ∇h^*(∇h(q) + p)` the equations of motion are

    `q' = exp(α) (m - q)` and `d/dt (∇h(q) + p) = -exp(α + β) ∇f(q)`.

    During a drift `m` is constant and `q` decays towards it like `exp(-γ)`. So the
    drift is known in closed form for every mirror map, and splittings for any kinetic
    energy are explicit, such as `Strang` and `BlanesMoan4`. They need `∇h` and `∇h^*`
    but no second derivatives. With `EuclideanMirror` the Hamiltonian is separable.

    A solve fails if positions leave the domain of the mirror map, if its root find
    fails, or if a value is not finite.
    """

    mirror_map: AbstractMirrorMap
    objective: Callable
    scaling: Scaling

    def __init__(self, mirror_map, objective, scaling):
        """**Arguments:**

        - `mirror_map`: the mirror map `h`, for example `EntropyMirror`.
        - `objective`: the function to minimise, a function `f(t, q, args)` that returns
            a scalar.
        - `scaling`: the functions `α`, `β` and `γ` of time, for example
            `PolynomialScaling`.

        **Raises:**

        `ValueError` if any of these has the wrong type, and when the solve is traced if
        a function returns values of the wrong shape.
        """
        if not isinstance(mirror_map, AbstractMirrorMap):
            raise ValueError(
                "`mirror_map` must be a mirror map such as `EntropyMirror()`, but got "
                f"{mirror_map!r}. For a custom function `h(q)` write "
                "`MirrorMap(h, inverse)`."
            )
        if not isinstance(scaling, Scaling):
            raise ValueError(
                "`scaling` must be a scaling such as `PolynomialScaling(2.0)`, but got "
                f"{scaling!r}. For functions of your own write `Scaling(gamma, beta)`."
            )
        check_callable(objective, "objective", "f(t, q, args)")
        self.mirror_map = mirror_map
        self.objective = objective
        self.scaling = scaling

    @property
    def laws(self) -> tuple[AbstractFriction, ...]:
        return (self.scaling.gamma,)

    @property
    def splits(self) -> tuple[AbstractSplit, ...]:
        quadratic = {"separable", "nystrom"} if self.mirror_map.is_quadratic else set()
        return (BregmanSplit(frozenset({"any"} | quadratic)),)

    def energy(self, t: Time, q: Q, p: P, args: PyTree = None) -> Scalar:
        h, step = self.mirror_map, self.mirror_map.step(q, p)
        end = tree.add(q, step)
        # D_h*(grad h(q) + p, grad h(q)) is D_h(q, m).
        divergence = h(q) - h(end) + tree.dot(tree.add(h.gradient(q), p), step)
        objective = scalar_fn(self.objective, "The objective")(t, q, args)
        kinetic = tree.scale(self.scaling.rate(t), divergence)
        potential = tree.scale(self.scaling.strength(t), objective)
        with jax.numpy_dtype_promotion("standard"):
            return kinetic + potential

    def velocity(self, t: Time, q: Q, p: P, args: PyTree = None) -> Q:
        return tree.scale(self.scaling.rate(t), self.mirror_map.step(q, p))

    def force(self, t: Time, q: Q, p: P, args: PyTree = None) -> P:
        force = self.potential_force(t, q, args)
        if self.mirror_map.is_quadratic:
            return force
        step = self.mirror_map.step(q, p)
        # The kinetic part depends on q too: its force is p - hess h(q) (m - q).
        _, change = jax.jvp(self.mirror_map.gradient, (q,), (step,))
        kinetic = self.mirror_map.project(tree.sub(p, change))
        return tree.add_scaled(force, self.scaling.rate(t), kinetic)

    def potential_force(self, t: Time, q: Q, args: PyTree = None) -> P:
        """The force of the objective."""
        objective = scalar_fn(self.objective, "The objective")
        slope = jax.grad(objective, argnums=1)(t, q, args)
        return tree.scale(-self.scaling.strength(t), self.mirror_map.project(slope))

    def is_valid(
        self, t: Time, q: Q, p: P, args: PyTree = None
    ) -> Bool[Array, ""] | None:
        valid = self.mirror_map.contains(q) & tree.all_finite(p)
        return valid & self.scaling.is_valid(t)
