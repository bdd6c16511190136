"""Loops over the stages of a step and over steps, as the platform needs them."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Array, PyTree


_S = TypeVar("_S")

# Size of the loop's state from which precomputing pays off, as measured.
_MANY = 16
# The steps of a loop whose length is known, for which the host does not wait on a GPU.
_BLOCK = 32


def scan_stages(stage: Callable, init: PyTree, moves: PyTree, reverse: bool = False):
    """`jax.lax.scan`, with numbers that depend only on `moves` precomputed for all
    stages at once.

    These are the numbers that depend on damping and time. In the loop each would be a
    separate kernel on a CPU, and there are many more of them than kernels that update
    the state.
    """
    unroll = 1 if cheap_iterations() else True
    if sum(jnp.size(x) for x in jtu.tree_leaves(init)) < _MANY:
        return lax.scan(stage, init, moves, reverse=reverse, unroll=unroll)
    first = jtu.tree_map(lambda x: x[0], moves)
    closed, out = jax.make_jaxpr(stage, return_shape=True)(init, first)
    jaxpr, constants, structure = closed.jaxpr, closed.consts, jtu.tree_structure(out)
    of_moves = jaxpr.invars[len(jtu.tree_leaves(init)) :]

    known, before, within = {*jaxpr.constvars, *of_moves}, [], []
    for eqn in jaxpr.eqns:
        early = known.issuperset(_variables(eqn.invars)) and not eqn.effects
        # A callback may not support all stages at once.
        alone = any(e.primitive.name == "pure_callback" for e in equations([eqn]))
        if early and not alone and all(x.aval.size < _MANY for x in eqn.outvars):
            before.append(eqn)
            known.update(eqn.outvars)
        else:
            within.append(eqn)
    needed = {x for eqn in within for x in _variables(eqn.invars)}
    needed.update(_variables(jaxpr.outvars))
    numbers = [x for eqn in before for x in eqn.outvars if x in needed]

    part = functools.partial(jaxpr.replace, constvars=())
    ahead = part(invars=[*jaxpr.constvars, *of_moves], outvars=numbers, eqns=before)
    inputs = [*jaxpr.constvars, *numbers, *jaxpr.invars]
    rest = part(invars=inputs, outvars=jaxpr.outvars, eqns=within)

    def prepare(moves):
        return eval_jaxpr(ahead, (), *constants, *jtu.tree_leaves(moves))

    def body(state, prepared):
        numbers, moves = prepared
        inputs = *constants, *numbers, *jtu.tree_leaves((state, moves))
        return jtu.tree_unflatten(structure, eval_jaxpr(rest, (), *inputs))

    rows = jax.vmap(prepare)(moves), moves
    return lax.scan(body, init, rows, reverse=reverse, unroll=unroll)


def repeat(
    left: Callable[[_S], Array],
    step: Callable[[_S], _S],
    state: _S,
    going: Callable[[_S], Array] | None = None,
) -> _S:
    """Steps as long as any are `left`, and if given, as long as it is `going`."""
    if not cheap_iterations() and going is None:
        block = lambda state: lax.fori_loop(0, _BLOCK, lambda _, x: step(x), state)
        state = lax.while_loop(lambda state: left(state) >= _BLOCK, block, state)
    more = lambda state: left(state) > 0
    both = more if going is None else lambda state: more(state) & going(state)
    return lax.while_loop(both, step, state)


def cheap_iterations() -> bool:
    """Whether iterations are cheap, and code is not.

    On a GPU an iteration takes ten microseconds or more, whatever is in it, and twice
    as long if the host has to ask whether it is the last. So stages are written out,
    and steps are taken in blocks. On a CPU stages were measured to take four to five
    times as long so.
    """
    return jax.default_backend() == "cpu"


def _variables(atoms) -> list:
    return [x for x in atoms if not isinstance(x, Literal)]


def equations(eqns):
    """All of these equations, including those in loops, branches and calls."""
    for eqn in eqns:
        yield eqn
        for inner in jtu.tree_leaves(eqn.params):
            if isinstance(inner, Jaxpr | ClosedJaxpr):
                yield from equations(inner.eqns)
