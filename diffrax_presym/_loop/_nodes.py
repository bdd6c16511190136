"""Values between steps from the ends of several steps, at no stage of the scheme.

Hermite interpolation of degree 15, from the states at the four ends of steps around a
time, the nodes, and their first three derivatives along the motion; of degree 11, from
two derivatives, for schemes of order four, to whose errors that adds nothing.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import _tree as tree
from .._numbers import cast_to, rounding_of, State
from .._scheme._base import Point, Scheme
from .._system._bound import System
from ._base import MOST_FRICTION, MOST_STEPS, MOST_TURN
from ._rows import Rows, stops_due
from ._steps import Steps


NODES = 4  # of a polynomial
DERIVATIVES = 3  # in each, of schemes of higher order than four
# The largest ratio of neighbouring steps.
_MOST_RATIO = 2.0

# Power iterations for the rate of friction that depends on the state.
_ITERATIONS = 8

# A state and its first derivatives, stacked: as few arrays as possible, because
# XLA runs many independent operations on a CPU by several threads, which takes longer.
Node = State


def derivatives(
    scheme: Scheme,
    system: System,
    t: Array,
    point: Point,
    moment: Array | None = None,
    number: int = DERIVATIVES,
) -> Node:
    """The state at a time of the solve, and its derivatives in that time, all but the
    first of a moment later."""
    y, force = system.values(point[0]), scheme.end_force(point[1])

    def slope(t: Array, y: State, force: PyTree = None) -> State:
        dy = system.slope(system.time(t), y, force)
        return tree.scale(jnp.asarray(system.direction), dy)

    known, rate = [y, slope(t, y, force)], slope
    if moment is not None:
        t, y = t + cast_to(moment, t), tree.add_scaled(y, moment, known[1])
    for _ in range(number - 1):
        rate = _rate_of(rate)
        known.append(rate(t, y, *known[1:]))
    return jtu.tree_map(lambda *x: jnp.stack(x), *known)


def _rate_of(fn: Callable) -> Callable:
    """The derivative of `fn(t, y, y', ...)`, a function of one more of these."""

    def rate(t: Array, *known: State) -> State:
        now, along = (t, *known[:-1]), (jnp.ones_like(t), *known[1:])
        return jax.jvp(fn, now, along)[1]

    return rate


def number_of_derivatives(order: int) -> int:
    """In each node, for a scheme of an order: the third takes longest to compile."""
    return DERIVATIVES if order > 4 else DERIVATIVES - 1


def node(
    scheme: Scheme,
    system: System,
    steps: Steps,
    number: int,
    first: Array,
    n: Array,
    side: Array,
    point: Point,
) -> Node:
    """The state at the start of a step, and a number of its derivatives: where they
    jump, those before it (-1) or after it (1). Not numbers if a body turns too far, but
    in a member of a batch that needs no nodes, as it has no `first` one."""
    t, h, moment = steps.time(n), steps.lengths(n), None
    # A function of time may itself round to the other side.
    t = t + cast_to(side, t) * rounding_of(steps.t0, t, h)
    point = steps.renewed(scheme, system, n, system.time(t), point)
    if system.external is not None:
        moment = _moment(jnp.where(side < 0, -h, h))
    known = derivatives(scheme, system, t, point, moment, number)
    little = turns_little(system, h, point[0], 2 * MOST_TURN)
    if little is True:
        return known
    return tree.invalid_if(~little & (first < MOST_STEPS), known)


def turns_little(system: System, h: Array, y: State, most: float = MOST_TURN) -> Any:
    """Whether polynomials can follow a drift of a length, which turns a state; `True`
    if it never does."""
    rate = system.term.turning(*system.values(y))
    return True if rate is None else jnp.abs(h) * rate <= most


def _moment(h: Array) -> Array:
    """A speed has no derivative at rest, but one a moment later."""
    return float(jnp.finfo(h.dtype).eps) ** (2 / 3) * h


def _rate(system: System, t: Array, y: State, h: Array) -> Float[Array, ""]:
    """At the start, the largest rate at which friction that depends on the state, and
    forces of the velocity, change momenta: of their derivative, by power iteration."""
    y, force = system.values(y), system.external
    q, p = tree.add_scaled(y, _moment(h), system.slope(t, y))

    def other(p: PyTree) -> PyTree:
        v = system.velocity(t, (q, p))
        return system.term.add_forces(tree.zeros(p), force, t, q, p, v, system.args)

    def iterate(_, x: tuple[PyTree, Array]) -> tuple[PyTree, Array]:
        u = x[0]
        change = jax.jvp(other, (p,), (u,))[1]
        size = jnp.sqrt(tree.dot(change, change) / tree.dot(u, u))
        u = tree.scale(1 / jnp.where(size == 0, 1, size), change)
        return tree.where(size == 0, x[0], u), size.astype(h.dtype)

    generic = lambda x: jnp.cos(jnp.arange(1.0, x.size + 1)).reshape(x.shape)
    first = jtu.tree_map(lambda x: cast_to(generic(x), x), p)
    start = first, jnp.zeros_like(h)
    return jnp.abs(lax.fori_loop(0, _ITERATIONS, iterate, start)[1])


def first_node(system: System, steps: Steps, last: Array, y: State) -> Int[Array, ""]:
    """The step from whose start on values between steps are interpolated; before it
    they are shorter steps."""
    yes = steps.ratio <= _MOST_RATIO
    first = jnp.zeros((), int)
    if system.friction is not None:
        first = steps.weak_from(system, last)
    if system.has_unknown_friction:
        h = steps.longest
        most = jnp.abs(h) * _rate(system, system.time(steps.t0), y, h) / 2
        yes &= most <= MOST_FRICTION
    yes &= turns_little(system, steps.longest, y)
    return lax.stop_gradient(jnp.where(yes, first, MOST_STEPS))


class Stencils(eqx.Module):
    """The nodes of each row, and where between them it is."""

    first: Int[Array, " rows+1"]  # node; the last is never reached
    unit: Float[Array, " rows"]  # of time
    place: Float[Array, " rows"]  # in that unit
    nodes: Float[Array, "rows nodes"] | None  # if they are not 0, 1, 2, 3
    weights: Float[Array, "rows nodes each"]
    number: Int[Array, ""]  # of values where a polynomial can follow the solution
    own: Bool[Array, " rows"]  # which are interpolated
    earliest: Int[Array, ""]  # the first of them in any member of a batch
    # Rows in order, of which those before the latest are not interpolated in a member.
    others: Int[Array, " rows+1"]
    latest: Int[Array, ""]

    def __init__(
        self, steps: Steps, rows: Rows, last: Array, first_node: Array, each: int
    ):
        stop = jnp.maximum(rows.stop, 0)
        begin = steps.time(stop)
        low, high = steps.smooth_part(stop)
        high = jnp.minimum(high, last)
        first = jnp.minimum(stop - NODES // 2, high - NODES) + 1
        first = jnp.maximum(first, low)
        self.unit, self.nodes = steps.lengths(stop), None
        self.place = jnp.where(rows.inside, (rows.time - begin) / self.unit, 0)
        if steps.ts is None:
            self.place += (stop - first).astype(begin.dtype)
        else:
            nodes = [steps.time(first + i) - begin for i in range(NODES)]
            self.nodes = jnp.stack(nodes, axis=-1) / self.unit[:, None]
        self.weights = _weights(self.place, self.nodes, self.unit, each)
        number, due = len(rows), rows.reached(last)
        few = high - low < NODES - 1  # steps in the span
        before = (rows.stop >= 0) & (first < first_node)
        if steps.kinks is None:
            before |= few
        begin = jnp.max(jnp.where(before, jnp.arange(number) + 1, 0), initial=0)
        follows = (jnp.arange(number) >= begin) & ~few
        self.number = jnp.sum(rows.taken(last) & follows)
        # Values at the ends of steps need no nodes, if they are the only ones.
        begin = jnp.where(jnp.any(rows.inside), begin, number)
        self.own = follows & jnp.any(rows.inside)
        self.latest = tree.largest_member(begin)
        self.earliest = tree.smallest_member(begin)
        self.others = jnp.arange(number + 1)
        if steps.kinks is not None:
            # Spans of few steps may be between others.
            self.latest = jnp.full_like(self.latest, number)
            some = tree.any_member(~self.own)
            (some,) = jnp.nonzero(some, size=number, fill_value=number)
            self.others = jnp.append(some, number)
        # A gap in measured times is saved at once, whatever it is.
        gap = (rows.stop < 0) | few
        first = jnp.where(gap, -NODES, jnp.where(due, first, last + 1))
        self.first = jnp.append(first, last + 1)

    @property
    def each(self) -> int:
        """The number of values in a node: the state and its derivatives."""
        return self.weights.shape[-1]

    def last(self, j: Any) -> Int[Array, "..."]:
        """The last node of a row, or of several."""
        return self.first[j] + NODES - 1

    def known(self, rows: Rows) -> Int[Array, " rows"]:
        """The number of steps after which each row is known."""
        here = self.own & (rows.stop >= 0)
        return jnp.where(here, self.last(slice(-1)), rows.known)

    def stops(self, rows: Rows, last: Array) -> Int[Array, " rows+1"]:
        """The steps from whose starts the others are shorter ones."""
        due = rows.reached(last) & (jnp.arange(len(rows)) < self.latest)
        return stops_due(rows.stop, due, last + 1)[self.others]

    def others_before(self, row: Array) -> Int[Array, ""]:
        """How many of the others are before a row."""
        return jnp.sum(self.others < jnp.minimum(row, self.latest))

    def _row(self, j: Array) -> Float[Array, "nodes each"]:
        return _row_weights(j, self.weights, self.place, self.nodes, self.unit)

    def combine(self, j: Array, n: Array, ring: Node) -> State:
        """The state in row `j`, from a ring of nodes of which the last is `n`."""

        # Each index once, as many of them take long to trace.
        at = lambda x, i: lax.dynamic_index_in_dim(x, i, keepdims=False)
        weights, first = self._row(j), _first(self.first[j], n)
        nodes = [((first + i) % NODES, weight) for i, weight in enumerate(weights)]

        def leaf(ring: Array) -> Array:
            total = jnp.zeros(ring.shape[2:], ring.dtype)
            for place, weight in nodes:
                for w, x in zip(weight, at(ring, place), strict=True):
                    total = total + cast_to(w, x) * x
            return total

        return jtu.tree_map(leaf, ring)

    def spread(self, j: Array, n: Array, bar: State, ring: Node) -> Node:
        """The transpose: the cotangents of the nodes, added to a ring of these."""
        place = (jnp.arange(NODES) - _first(self.first[j], n)) % NODES
        return spread(self._row(j)[place], bar, ring)


def _weights(place: Array, nodes: Array | None, unit: Array, number: int) -> Array:
    """Those of the nodes of one row, or of each, and of a number of derivatives."""
    each: Any = range(NODES) if nodes is None else jnp.moveaxis(nodes, -1, 0)
    return hermite(place, list(each), unit, number)


@jax.custom_batching.custom_vmap
def _first(first: Array, n: Array) -> Array:
    """The first node of which `n` is the last: the same for all members of a batch."""
    return first


@_first.def_vmap
def _(size, in_batched, first, n):
    return n - (NODES - 1), in_batched[1]


@jax.custom_batching.custom_vmap
def _row_weights(j: Array, weights: Array, *_: Array | None) -> Array:
    """A row of the weights. If they differ among the members of a batch, they take much
    memory and are computed for this row alone."""
    return lax.dynamic_index_in_dim(weights, j, keepdims=False)


@_row_weights.def_vmap
def _(size, in_batched, j, weights, *how):
    if not in_batched[1]:
        row = lambda j: lax.dynamic_index_in_dim(weights, j, keepdims=False)
        return jax.vmap(row)(j), True
    number = weights.shape[-1] - 1
    own = lambda j, *how: _weights(*jtu.tree_map(lambda x: x[j], how), number=number)
    axes = jtu.tree_map(lambda x: 0 if x else None, (in_batched[0], *in_batched[2:]))
    return jax.vmap(own, axes, axis_size=size)(j, *how), True


def spread(weights: Array, bar: State, nodes: Node) -> Node:
    """The transpose of the sum of weighted nodes, added to their cotangents."""

    def leaf(x: Array, bar: Array) -> Array:
        each = jnp.expand_dims(cast_to(weights, bar), range(2, x.ndim))
        return x + each * bar[None, None]

    return jtu.tree_map(leaf, nodes, bar)


def hermite(
    s: Array, nodes: list, unit: Array, derivatives: int = DERIVATIVES
) -> Array:
    """The weights of the value and each derivative at each node, of lengths in a
    `unit`."""
    weights, power = [], derivatives + 1
    for i, node in enumerate(nodes):
        others = nodes[:i] + nodes[i + 1 :]
        inverse, d = [1 / (node - other) for other in others], s - node
        # The series of its inverse power in d, by that of the logarithm.
        rates = [power * sum((-c) ** k for c in inverse) for k in range(1, power)]
        series: list[Any] = [1.0]
        for k in range(1, power):
            terms = [rates[m] * series[k - 1 - m] for m in range(k)]
            series.append(sum(terms) / k)
        lagrange = math.prod(s - other for other in others) * math.prod(inverse)
        each, factor = [], lagrange**power
        for k in range(power):
            rest = series[power - 1 - k]
            for c in reversed(series[: power - 1 - k]):
                rest = rest * d + c
            each.append(rest * factor)
            factor = factor * (d * unit) * (1 / (k + 1))
        weights.append(jnp.stack(each, axis=-1))
    return jnp.stack(weights, axis=-2)
