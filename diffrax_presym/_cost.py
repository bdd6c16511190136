"""What an evaluation costs, estimated from its operations before anything is run."""

import math
from collections.abc import Callable

import jax
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


# Nanoseconds on a CPU for each number of a result, as measured in double precision
# within a factor of two or three. Other operations are simple, and mostly fused.
_SIMPLE = 0.1
_OTHERS = {
    **dict.fromkeys(["sin", "cos", "log", "tanh", "erf", "log1p", "expm1"], 9.0),
    **dict.fromkeys(["exp", "exp2", "logistic"], 6.0),
    **dict.fromkeys(["tan", "pow", "atan2", "cbrt"], 20.0),
    **dict.fromkeys(["sqrt", "rsqrt"], 1.0),
    "div": 0.3,
    "gather": 1.2,
    # Operations that are calls, of whatever they are given.
    **dict.fromkeys(["cholesky", "lu", "triangular_solve", "eigh"], 30.0),
    "pure_callback": 1e4,
}
_UPDATE = 2.5  # for each number that is scattered
# A product of matrices, and each product of two numbers in it.
_CALL, _PRODUCT = 50.0, 0.1
_FREE = {"broadcast_in_dim", "reshape", "squeeze", "iota", "copy", "stop_gradient"}


def nanoseconds(fn: Callable, *args) -> float:
    """About how long an evaluation takes on a CPU."""
    return _total(jax.make_jaxpr(fn)(*args).jaxpr)


def _total(jaxpr: Jaxpr) -> float:
    """The cost of what the results of a program need."""
    variables = lambda atoms: {x for x in atoms if not isinstance(x, Literal)}
    needed, total = variables(jaxpr.outvars), 0.0
    for eqn in reversed(jaxpr.eqns):
        if needed.isdisjoint(eqn.outvars) and not eqn.effects:
            continue
        needed |= variables(eqn.invars)
        total += _cost(eqn)
    return total


def _cost(eqn) -> float:
    inner = [
        _total(x.jaxpr if isinstance(x, ClosedJaxpr) else x)
        for x in jtu.tree_leaves(eqn.params)
        if isinstance(x, Jaxpr | ClosedJaxpr)
    ]
    if inner:
        return eqn.params.get("length", 1) * sum(inner)
    name, size = eqn.primitive.name, lambda x: math.prod(x.aval.shape)
    if name in _FREE:
        return 0.0
    if name == "dot_general":
        (contracted, _), _ = eqn.params["dimension_numbers"]
        lengths = [eqn.invars[0].aval.shape[i] for i in contracted]
        products = size(eqn.outvars[0]) * math.prod(lengths)
        return _PRODUCT * products + (_CALL if products > 1 else 0)
    if name.startswith("scatter"):
        return _UPDATE * size(eqn.invars[2])
    return _OTHERS.get(name, _SIMPLE) * max(map(size, eqn.outvars), default=0)
