"""Friction by coefficients, the force per velocity."""

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Inexact, PyTree

from .._forms import as_form, divide, fit_form, is_matrix, is_operator, matvec, multiply
from .._misc import as_finite, cast_to, tree_scale, tree_sub, tree_sum
from ._base import AbstractFriction, Scalar, Time
from ._damping import (
    AbstractDamping,
    as_damping,
    check_scalar,
    ConstantDamping,
    ScaledDamping,
    SumDamping,
)
from ._exponential import exponential_products, exponentials
from ._functions import gauss_legendre


Form = PyTree[Inexact[Array, "..."]] | lx.AbstractLinearOperator | None

_COEFFICIENTS = "`ViscousDamping(coefficients)`"
_MASS = "`QuadraticKinetic(mass)`"
_FORMS = (
    "a number, an array, a matrix, a pytree of these or a `lineax` operator, or a "
    "function `C(t, q, args)`"
)


class ViscousDamping(eqx.Module):
    r"""Friction $-C v$, linear in the velocity $v$: dashpots, viscous drag, magnetic
    fields, Coriolis forces.

    For [`diffrax_presym.MechanicalSystem`][], with a kinetic energy of known mass. The
    flow of drift and friction is exact, by $e^{-h C M^{-1}}$ and its integral, so that
    every scheme keeps its order. A symmetric positive matrix $C$ damps; an
    antisymmetric one does no work, and the energy is kept. The force $e \, v \times B$
    on a charge $e$ in a uniform magnetic field $B$ is
    `ViscousDamping(e * jnp.array([[0, -B[2], B[1]], [B[2], 0, -B[0]],
    [-B[1], B[0], 0]]))`, and the Coriolis force in a frame that rotates with $\Omega$
    has $2 m \Omega$ in place of $e B$ with the opposite sign.

    With numbers or arrays the cost is that of
    [`diffrax_presym.ConstantDamping`][]. With matrices, exponentials for all stages of
    a step are computed once at the start of a solve, and again in steps of another
    length; a drift is two products with a matrix. Beside [`diffrax_presym.Drag`][] they
    are computed in every stage. Above some hundreds of degrees of
    freedom, if the matrix is sparse, pass a `lineax.FunctionLinearOperator`: each drift
    then takes about 20 products with $C$, and no matrix is stored.

    If $C$ is a function of time and place, the friction is part of the kicks, and
    exact there at fixed positions: as [`diffrax_presym.PositionDamping`][].
    """

    coefficients: Form | Callable
    law: AbstractDamping | None

    def __init__(self, coefficients, law=None):
        r"""**Arguments:**

        - `coefficients`: $C$, in units of force per velocity (torque per angular
            velocity for an angle), of any sign, in any of these forms.
            - A number: the same for every degree of freedom.
            - An array with as many dimensions as `p`, and broadcastable to it: a
                coefficient for each degree of freedom.
            - A square matrix, with `p` a vector; not necessarily symmetric.
            - An array with one dimension more than `p`: a matrix for each vector over
                the last axis of `p`. For the same matrix of `n` particles in three
                dimensions, with `p` of shape `(n, 3)`, pass shape `(1, 3, 3)`.
            - A pytree of the structure of `p`, whose leaves are any of the above.
            - A `lineax.AbstractLinearOperator` acting on `p`'s space. One that is
                given by a matrix is exponentiated as a matrix, any other by products.
            - A function `C(t, q, args)` that returns any of the above but operators.
        - `law`: a scalar damping law such as [`diffrax_presym.LogDamping`][], or a
            function `eta(t)`, whose rate multiplies constant coefficients. Matrices are
            then exponentiated in every step. Defaults to `None`, a rate of one.

        **Raises:**

        `ValueError` if a coefficient is not a finite real number or array, or a law is
        given with a function; and when the solve is traced, if a shape does not fit
        `p` or the mass is not known.
        """
        if coefficients is None:
            raise ValueError(
                f"{_COEFFICIENTS} must be {_FORMS}, but got None. For one force per "
                "velocity write `ViscousDamping(1.0)`."
            )
        local = callable(coefficients) and not is_operator(coefficients)
        if local and law is not None:
            raise ValueError(
                "`ViscousDamping(C, law)` with a function `C(t, q, args)` takes no "
                "`law`. Multiply the coefficients that the function returns by the "
                "rate."
            )
        if not local:
            coefficients = as_form(coefficients, _COEFFICIENTS, positive=False)
        self.coefficients = coefficients
        self.law = None if law is None else as_damping(law, "`ViscousDamping(law=...)`")

    @property
    def is_local(self) -> bool:
        """Whether the coefficients depend on place."""
        return callable(self.coefficients) and not is_operator(self.coefficients)


class RayleighDamping(eqx.Module):
    r"""Rayleigh damping, $C = \alpha M + \beta K$.

    For [`diffrax_presym.MechanicalSystem`][], with a kinetic energy of known mass $M$.
    The stiffness $K$ is that of a [`diffrax_presym.QuadraticPotential`][], or given. A
    mode of frequency $\omega$ is damped with the ratio
    $\alpha / 2 \omega + \beta \omega / 2$. Exact in the drift, as
    [`diffrax_presym.ViscousDamping`][], at the same cost.

    ??? cite "Reference"

        ```bibtex
        @book{rayleigh1877theory,
            author={Strutt, John William (Lord Rayleigh)},
            title={The Theory of Sound},
            volume={1},
            publisher={Macmillan},
            year={1877},
        }
        ```
    """

    alpha: Scalar
    beta: Scalar
    stiffness: Form

    def __init__(self, alpha: ArrayLike, beta: ArrayLike = 0.0, stiffness=None):
        r"""**Arguments:**

        - `alpha`: the coefficient of the mass, in units of one over time.
        - `beta`: the coefficient of the stiffness, in units of time. Defaults to 0.
        - `stiffness`: the stiffness $K$ in the forms of
            [`diffrax_presym.QuadraticPotential`][], for a potential of another kind.
            Defaults to `None`, that of the potential.

        **Raises:**

        `ValueError` if `alpha` or `beta` is not a finite real number, or if the
        stiffness is neither given nor known, when the system is made.
        """
        name = "`RayleighDamping({})`"
        self.alpha = as_finite(alpha, name.format("alpha"))
        self.beta = as_finite(beta, name.format("..., beta"))
        self.stiffness = as_form(
            stiffness, name.format("..., stiffness"), positive=False
        )

    @property
    def without_stiffness(self) -> bool:
        """Whether it is known to be friction in proportion to the mass alone."""
        return not isinstance(self.beta, Tracer) and bool(self.beta == 0)


def as_friction(
    laws: Sequence[AbstractDamping | ViscousDamping | RayleighDamping],
    mass: Form,
    stiffness: Form,
) -> AbstractFriction | None:
    """The friction of several laws at once, none of which depends on place."""
    if not laws:
        return None
    dampings = [law for law in laws if isinstance(law, AbstractDamping)]
    if len(dampings) == len(laws):
        return dampings[0] if len(laws) == 1 else SumDamping(tuple(dampings))
    rates, coefficients, timed = [], [], None
    for law in laws:
        if isinstance(law, ViscousDamping):
            coefficients.append(law.coefficients)
            timed = timed if law.law is None else law.law
        elif isinstance(law, RayleighDamping):
            rates.append(law.alpha)
            given = stiffness if law.stiffness is None else law.stiffness
            coefficients.append(_scaled(law.beta, given))
        elif isinstance(law, ConstantDamping):
            rates.append(law.gamma)
        else:
            timed = law
    if timed is not None:
        check_scalar(timed, "ViscousDamping")
        if len(laws) > 1:
            raise ValueError(
                "Friction by coefficients and friction that depends on time have no "
                f"exact flow together, but got {len(laws)} laws. Give one "
                "`ViscousDamping(C, law)`; or write all but one as "
                "`ViscousDamping(function)` with a function `C(t, q, args)`, which is "
                "part of the kicks."
            )
    return ViscousFriction(tuple(rates), tuple(coefficients), mass, timed)


def _scaled(beta: Scalar, form: Form) -> Form:
    if form is None:
        return beta
    return form * beta if is_operator(form) else tree_scale(beta, form)


class _Table(eqx.Module):
    """The exponentials over some times, for each leaf with a matrix."""

    times: Inexact[Array, " times"]
    # Half of the least distance between two of the times.
    radius: Scalar
    entries: list[tuple[Array, Array] | None]
    # Whether no other times occur.
    complete: bool = eqx.field(static=True, default=True)

    def assume(self, complete: bool) -> "_Table":
        """The same table, with or without the assumption that no other times occur."""
        return _Table(self.times, self.radius, self.entries, complete)

    def product(self, i: int, part: int, t: Time, time: Array, x: Array, compute):
        """The change (part 0) or integral (part 1) of a leaf over a time, times `x`;
        by `compute` if the time is not in the table."""
        entry = self.entries[i]
        assert entry is not None
        distances = jnp.abs(cast_to(self.times, time) - time)
        nearest = jnp.argmin(distances)
        distance, radius = distances[nearest], cast_to(self.radius, time)
        stored = lambda: matvec(cast_to(entry[part][nearest], x), x)
        if self.complete:
            return jnp.where(distance <= radius, stored(), jnp.nan)
        # Times of other steps, and times that differ by more than rounding.
        size = jnp.abs(cast_to(t, time)) + jnp.abs(time)
        rounding = 4 * jnp.finfo(time.dtype).eps * size
        found = distance <= jnp.minimum(rounding, radius)
        return jax.lax.cond(found, stored, compute)


class ViscousFriction(AbstractFriction):
    r"""Friction at the rate $\Gamma = r(t) \, (R + C M^{-1})$."""

    rates: tuple[Form, ...]  # R is the sum of these
    coefficients: tuple[Form, ...]  # C is the sum of these
    mass: Form
    law: AbstractDamping | None = None
    table: _Table | None = None
    # Whether it acts over whole stages, whose lengths are known beforehand.
    over_stages: bool = eqx.field(static=True, default=True)

    # What it is for a state.

    def _forms(self) -> tuple[Form, ...]:
        mass = (self.mass,) if self.coefficients else ()
        return *self.rates, *self.coefficients, *mass

    @property
    def _by_products(self) -> bool:
        """Whether the friction is given by products alone."""
        return any(map(_is_implicit, self._forms()))

    def _times(self, p: PyTree) -> PyTree:
        """R p + C M^-1 p."""
        parts = [multiply(x, p, "The damping", "p") for x in self.rates]
        if self.coefficients:
            v = divide(self.mass, p, _MASS, "p")
            parts += [multiply(x, v, _COEFFICIENTS, "p") for x in self.coefficients]
        return functools.reduce(tree_sum, parts)

    def _leaves(
        self, p: PyTree
    ) -> tuple[list[Array], Sequence[Array | None], Callable]:
        """Arrays that are independent of each other, and their rates: of each entry, as
        a matrix, or `None` if the rate is known by products. Also the inverse."""
        if any(map(is_operator, self._forms())):
            flat, unravel = ravel_pytree(p)
            back = lambda leaves: unravel(leaves[0])
            if self._by_products:
                return [flat], [None], back
            return [flat], [jax.jacfwd(self._ravelled(p))(jnp.zeros_like(flat))], back
        fit = lambda form, name: jtu.tree_leaves(fit_form(form, p, name, "p"))
        leaves, structure = jtu.tree_flatten(p)
        rates = [fit(x, "The damping") for x in self.rates]
        masses = fit(self.mass, _MASS) if self.coefficients else []
        for x in self.coefficients:
            parts = zip(fit(x, _COEFFICIENTS), masses, leaves, strict=True)
            rates.append([_per_momentum(*part) for part in parts])
        total = [
            functools.reduce(functools.partial(_sum, like=leaf), parts)
            for leaf, *parts in zip(leaves, *rates, strict=True)
        ]
        return leaves, total, structure.unflatten

    def _ravelled(self, p: PyTree) -> Callable[[Array], Array]:
        _, unravel = ravel_pytree(p)
        return lambda x: ravel_pytree(self._times(unravel(x)))[0]

    def _elapsed(self, t: Time, h: Time) -> Array:
        return jnp.asarray(h) if self.law is None else self.law.increment(t, h)

    def _each(self, p: PyTree, entry: Callable, matrix: Callable, product: Callable):
        """Apply one of three functions to each of the independent arrays."""
        leaves, rates, back = self._leaves(p)

        def one(i, x, rate):
            if rate is None:
                return product(x, self._ravelled(p))
            if is_matrix(rate, x):
                return matrix(x, rate, i)
            law = self.law
            law = ConstantDamping(rate) if law is None else ScaledDamping(law, rate)
            return entry(x, law)

        parts = zip(leaves, rates, strict=True)
        return back([one(i, x, rate) for i, (x, rate) in enumerate(parts)])

    def _product(self, part: int, matrix: Array, i: int, t: Time, time: Time, x: Array):
        """The change (part 0) or integral (part 1) over a time, times `x`."""
        time = cast_to(time, x)
        compute = lambda: matvec(exponentials(matrix, time[None])[part][0], x)
        if self.table is None:
            return compute()
        return self.table.product(i, part, t, time, x, compute)

    # What it does.

    def decay(self, t: Time, h: Time, p: PyTree) -> PyTree:
        time = self._elapsed(t, h)
        return self._each(
            p,
            lambda x, law: law.decay(t, h, x),
            lambda x, matrix, i: self._product(0, matrix, i, t, time, x),
            lambda x, apply: exponential_products(apply, cast_to(time, x), x)[0],
        )

    def carry(self, t: Time, h: Time, p: PyTree, order: int) -> PyTree:
        nodes, weights = gauss_legendre(h, order)
        return self._integral(
            p,
            lambda x, law: law.carry(t, h, x, order),
            *(
                t,
                h,
                weights,
                lambda law: jax.vmap(lambda s: law.increment(t, s))(nodes),
            ),
        )

    def respond(self, t: Time, h: Time, force: PyTree, order: int) -> PyTree:
        nodes, weights = gauss_legendre(h, order)
        after = lambda law: jax.vmap(lambda s: law.increment(t + s, h - s))(nodes)
        return self._integral(
            force, lambda x, law: law.respond(t, h, x, order), t, h, weights, after
        )

    def _integral(self, p, entry, t, h, weights, elapsed: Callable):
        """The integral of the exponential over a span, times `p`."""
        if self.law is None:
            return self._each(
                p,
                entry,
                lambda x, matrix, i: self._product(1, matrix, i, t, h, x),
                lambda x, apply: exponential_products(apply, cast_to(h, x), x)[1],
            )
        times = elapsed(self.law)

        def matrix(x, matrix, i):
            changes, _ = exponentials(matrix, cast_to(times, x))
            change = jnp.tensordot(cast_to(weights, x), changes, 1, precision="highest")
            return cast_to(h, x) * x + matvec(change, x)

        def product(x, apply):
            change = lambda time: exponential_products(apply, time, x)[0]
            changes = jax.vmap(change)(cast_to(times, x))
            return cast_to(h, x) * x + jnp.tensordot(cast_to(weights, x), changes, 1)

        return self._each(p, entry, matrix, product)

    def net_force(self, t: Time, force: PyTree, p: PyTree) -> PyTree:
        lost = self._times(p)
        if self.law is not None:
            lost = tree_scale(self.law.rate(t), lost)
        return tree_sub(force, lost)

    def amplification(self, t: Time, h: Time, p: PyTree) -> Scalar:
        leaves, rates, _ = self._leaves(p)
        largest = [jnp.zeros(())]
        for x, rate in zip(leaves, rates, strict=True):
            # Without a matrix the rate is not known. `ReversibleAdjoint` measures its
            # errors in any case.
            if rate is not None:
                if is_matrix(rate, x):
                    symmetric = (rate + jnp.swapaxes(rate, -1, -2)) / 2
                    rate = jnp.linalg.eigvalsh(symmetric)
                largest.append(cast_to(jnp.max(rate), largest[0]))
        elapsed = cast_to(self._elapsed(t, h), largest[0])
        return jnp.exp(jnp.max(jnp.stack(largest)) * elapsed)

    def contraction(self, t: Time, h: Time, p: PyTree) -> Scalar:
        leaves, rates, _ = self._leaves(p)
        total = jnp.asarray(self._elapsed(t, h))
        total, elapsed = jnp.zeros_like(total), total
        for x, rate in zip(leaves, rates, strict=True):
            if rate is None:
                rate = jax.jacfwd(self._ravelled(p))(jnp.zeros_like(x))
            if is_matrix(rate, x):
                rate = jnp.diagonal(rate, axis1=-2, axis2=-1)
            trace = jnp.sum(jnp.broadcast_to(rate, jnp.shape(x)))
            total = total + cast_to(trace, total)
        return total * elapsed

    def is_singular(self, t: Time) -> Bool[Array, ""] | None:
        return None if self.law is None else self.law.is_singular(t)

    # The table.

    def has_table(self, p: PyTree) -> bool:
        if self.law is not None or self.table is not None or not self.over_stages:
            return False
        leaves, rates, _ = self._leaves(p)
        pairs = zip(leaves, rates, strict=True)
        return any(rate is not None and is_matrix(rate, x) for x, rate in pairs)

    def tabulate(self, p: PyTree, times: Array) -> _Table:
        leaves, rates, _ = self._leaves(p)

        def entry(x: Array, rate: Array | None):
            if rate is None or not is_matrix(rate, x):
                return None
            return exponentials(rate, times)

        gaps = jnp.diff(jnp.sort(times))
        radius = jnp.min(gaps, initial=jnp.inf) / 2
        return _Table(times, radius, list(map(entry, leaves, rates)))

    def with_table(self, table: _Table) -> "ViscousFriction":
        is_none = lambda x: x is None
        return eqx.tree_at(lambda x: x.table, self, table, is_leaf=is_none)

    def over_parts(self) -> "ViscousFriction":
        """The same friction, which acts over parts of stages."""
        return ViscousFriction(
            self.rates, self.coefficients, self.mass, self.law, over_stages=False
        )


def _is_implicit(form: Form) -> bool:
    """Whether a form is an operator that is not given by its entries."""
    known = (
        lx.MatrixLinearOperator,
        lx.DiagonalLinearOperator,
        lx.TridiagonalLinearOperator,
        lx.IdentityLinearOperator,
    )
    if not is_operator(form) or isinstance(form, known):
        return False
    # Sums, products and tags of operators.
    parts = [x for x in vars(form).values() if is_operator(x)]
    return not parts or any(map(_is_implicit, parts))


def _per_momentum(coefficient: Array, mass: Array, p: Array) -> Array:
    """C M^-1 for one leaf."""
    if not is_matrix(mass, p):
        if is_matrix(coefficient, p):
            return coefficient / jnp.broadcast_to(mass, jnp.shape(p))[..., None, :]
        return coefficient / mass
    # M is symmetric: C M^-1 is the transpose of M^-1 C^T.
    transposed = jnp.swapaxes(_as_matrix(coefficient, p), -1, -2)
    factor = jnp.linalg.cholesky(mass)
    mass, transposed = jnp.broadcast_arrays(factor, transposed)
    solved = jax.scipy.linalg.cho_solve((mass, True), transposed)
    return jnp.swapaxes(solved, -1, -2)


def _sum(x: Array, y: Array, like: Array) -> Array:
    """The sum of two rates of a leaf, as a matrix if either is."""
    if is_matrix(x, like) or is_matrix(y, like):
        x, y = _as_matrix(x, like), _as_matrix(y, like)
    return x + y


def _as_matrix(rate: Array, like: Array) -> Array:
    if is_matrix(rate, like):
        return rate
    entries = jnp.broadcast_to(rate, jnp.shape(like))
    return entries[..., None] * jnp.eye(entries.shape[-1], dtype=entries.dtype)
