"""What a step of moves needs of time alone, computed before it touches the state.

Moves of one kind are prepared together, wherever they are in the step: each more place
would be compiled again.
"""

import functools
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PyTree

from .. import _tree as tree
from .._friction._linear import Effects, LinearFriction
from .._friction._over_step import NODES
from .._numbers import cast_to
from .._system._bound import System
from ._engine import AbstractMove, Inverse, is_autonomous, Moves, MoveSequence, Span


def prepare(moves: Moves, system: System, span: Span, backward: bool = False) -> PyTree:
    """What all moves need of time alone, for a step: of the inverses if `backward`."""
    exact = lambda: _prepare(moves, system, span, backward)
    if system.friction is None or _number(moves) <= NODES:
        return exact()
    times = _flat([rows for _, rows in _places(moves)])[:, :2]
    first, last = float(np.min(times)), float(np.max(times))
    whole = span.part(first, last, last - first)
    found = system.friction.over_step(whole.t0, whole.h)
    if found is None:
        return exact()
    friction, converged = found
    fast = eqx.tree_at(lambda system: system.friction, system, friction)
    # Of a batch as one: otherwise each member would compute both.
    all_converged = ~tree.any_member(~converged)
    nearby = lambda: _prepare(moves, fast, span, backward)
    # A derivative computes either again: to keep what both consist of takes longer.
    again = functools.partial(jax.checkpoint, prevent_cse=False)
    return lax.cond(all_converged, again(nearby), again(exact))


def prepare_once(
    moves: Moves, system: System, span: Span, backward: bool = False
) -> PyTree:
    """The same for all steps of one length, in a form that is applied faster."""
    data, friction = prepare(moves, system, span, backward), system.friction
    if friction is None:
        return data
    is_effects = lambda x: isinstance(x, Effects) and not x.is_fixed
    leaves, structure = jtu.tree_flatten(data, is_leaf=is_effects)
    fixed = iter(friction.fix(list(filter(is_effects, leaves))))
    leaves = [next(fixed) if is_effects(x) else x for x in leaves]
    return structure.unflatten(leaves)


def _number(moves: Moves) -> int:
    """Of moves in a step."""
    if not isinstance(moves, MoveSequence):
        return 1
    return len(moves.table) * sum(map(_number, moves.moves))


_WHOLE = np.array([0.0, 1.0, 1.0])


def _places(
    moves: Moves, whole: np.ndarray = _WHOLE
) -> Iterator[tuple[Moves, np.ndarray]]:
    """All sequences and moves in it, in order, and the places of each: start, end and
    length in units of the whole, with an axis for the rows of each table."""
    yield moves, whole
    if not isinstance(moves, MoveSequence):
        return
    start, end, length = np.moveaxis(whole[..., None, None, :], -1, 0)
    # Rounding must not make the last of them miss the end of the whole.
    at = lambda x: np.where(x == 1, end, start + x * (end - start))
    first, last, part = np.moveaxis(moves.table, -1, 0)
    table = np.stack([at(first), at(last), length * part], axis=-1)
    for i, move in enumerate(moves.moves):
        yield from _places(move, table[..., i, :])


def _prepare(moves: Moves, system: System, span: Span, backward: bool) -> PyTree:
    places = list(_places(moves))
    each = [
        (move.move if isinstance(move, Inverse) else move, rows)
        for move, rows in places
        if not isinstance(move, MoveSequence)
    ]
    same: dict[Any, list[int]] = {}
    for i, (move, _) in enumerate(each):
        leaves, structure = jtu.tree_flatten(move)
        # What is prepared once for all steps is faster apart: XLA on a CPU distributes
        # operations on more than 512 bytes over threads.
        apart = i if is_autonomous(move, system) else None
        key = structure, tuple(map(id, leaves)), apart
        same.setdefault(key, []).append(i)

    bad, returning = None, [x for _, x in places if np.any(x[..., 1] < x[..., 0])]
    if system.friction is not None and returning and not backward:
        bad = _amplifies(system.friction, span, _flat(returning))
    found: dict[int, PyTree] = {}
    for which in same.values():
        rows = [each[i][1] for i in which]
        flat, ends = _flat(rows), np.cumsum([x.size // 3 for x in rows])
        data, indices = _prepare_rows(each[which[0]][0], system, span, backward, flat)
        data = data if bad is None else tree.invalid_if(bad, data)
        parts = zip(rows, np.split(indices, ends[:-1]), strict=True)
        take = [functools.partial(_rows, own.reshape(x.shape[:-1])) for x, own in parts]
        found |= {i: jtu.tree_map(f, data) for i, f in zip(which, take, strict=True)}
    numbered = iter(range(len(each)))
    return _nested(moves, lambda: found[next(numbered)])


def _flat(places: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([rows.reshape(-1, 3) for rows in places])


def _nested(moves: Moves, leaf) -> PyTree:
    """The data of a step: for each sequence a list."""
    if not isinstance(moves, MoveSequence):
        return leaf()
    return [_nested(move, leaf) for move in moves.moves]


def _prepare_rows(
    move: AbstractMove, system: System, span: Span, backward: bool, rows: np.ndarray
) -> tuple[PyTree, np.ndarray]:
    """What a move prepares for parts of the span, and which of it is for each."""
    which = np.arange(len(rows))
    if is_autonomous(move, system):
        lengths = np.round(rows[:, 2], 15)
        _, first, which = np.unique(lengths, return_index=True, return_inverse=True)
        order = np.argsort(first)  # as they come
        rows, which = rows[first[order]], np.argsort(order)[which]

    def one(*row) -> PyTree:
        part = span.part(*row)
        return move.prepare(system, part.reversed if backward else part)

    if len(rows) > 1:
        return jax.vmap(one)(*(cast_to(x, span.h) for x in rows.T)), which
    data = one(*rows[0].tolist())
    return jtu.tree_map(lambda x: jnp.expand_dims(x, 0), data), which


def _rows(indices: np.ndarray, x: Array) -> Array:
    """`x[indices]`, by slices: the transpose of an index is a scattered addition, with
    which XLA does not compile a loop to one function."""
    which, parts, i = indices.ravel().tolist(), [], 0
    while i < len(which):
        # As many as go up, or down, by one.
        first, down = which[i], which[i + 1 : i + 2] == [which[i] - 1]
        ahead = enumerate(first - k if down else k - first for k in which[i:])
        number = next((n for n, k in ahead if k != n), len(which) - i)
        low = first - number + 1 if down else first
        part = x[low : low + number]
        parts.append(jnp.flip(part, 0) if down else part)
        i += number
    return jnp.concatenate(parts).reshape(*indices.shape, *x.shape[1:])


def _amplifies(
    friction: LinearFriction, span: Span, rows: np.ndarray
) -> Bool[Array, ""]:
    """Whether friction amplifies rounding errors in a stage of a step, of which some go
    back in time, beyond half of the digits: what is prepared is then not finite."""
    # Of those within another stage, such as the moves of one, it is less.
    stages = {tuple(x) for x in rows.tolist()}
    within = lambda x, y: x != y and y[0] <= x[0] <= x[1] <= y[1]
    either = lambda x, y: within(x, y) or within(x[1::-1], y[1::-1])
    most = [x for x in stages if not any(either(x, y) for y in stages)]
    friction = tree.stop_gradient(friction)

    def growth(*row) -> Array:
        part = span.part(*row)
        return friction.growth(part.t1, -part.h)

    each = jax.vmap(growth)(*(cast_to(x, span.h) for x in np.array(sorted(most)).T))
    return jnp.any(each > -math.log(friction.precision) / 2)
