"""The rule for the derivative of a solve: its forward pass, and its backward pass."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
from jax.core import Tracer

from .._loop import Inputs, run
from ._backward import Backward


class Call(NamedTuple):
    """A solve, without and with what its gradient needs."""

    inputs: Inputs
    run: Callable[[Inputs], Any]
    run_for_gradient: Callable[[Inputs], Any]


def call(inputs: Inputs, adjoint):
    """The solve with a rule for its derivative."""
    calls = Call(inputs, partial(run), partial(run, keep=adjoint.keep))
    system, _ = inputs.parameters
    if _holds_tracers(inputs.parameters, system.time(inputs.rest["t0"]), inputs.start):
        # Convert them to inputs, which shows whether they are differentiated. Equinox
        # does not convert a function without a closure.
        convert = lambda fn: eqx.filter_closure_convert(fn, inputs)
        calls = Call(inputs, convert(calls.run), convert(calls.run_for_gradient))
    return _solve(calls, adjoint)


def refuse(
    adjoint, what: str, instead: str = "`diffrax.RecursiveCheckpointAdjoint()`"
) -> str:
    return f"`{type(adjoint).__name__}` does not support {what}. Use {instead} instead."


def _holds_tracers(parameters, t, start) -> bool:
    """Whether a function uses arrays of an outer transformation that are no leaves."""
    arrays, static = eqx.partition((parameters, t, start), eqx.is_array)

    def use_all(arrays):
        (system, fns), t, (y, _) = eqx.combine(arrays, static)
        used = system.slope(t, y), [fn(t, y, system.args) for fn in fns]
        return eqx.filter(used, eqx.is_array)

    return any(isinstance(x, Tracer) for x in jax.make_jaxpr(use_all)(arrays).consts)


@eqx.filter_custom_vjp
def _solve(call: Call, adjoint):
    return call.run(call.inputs)[0]


@_solve.def_fwd
def _solve_fwd(perturbed: Call, call: Call, adjoint):
    if any(jtu.tree_leaves(perturbed.inputs.rest)):
        what = "derivatives with respect to times (`t0`, `t1`, `dt0`, `ts`) or to the "
        raise ValueError(refuse(adjoint, what + "solver"))
    if any(jtu.tree_leaves((perturbed.run, perturbed.run_for_gradient))):
        # Not covered by `closure_to_pytree`.
        raise ValueError(
            f"`{type(adjoint).__name__}` cannot differentiate with respect to an array "
            "that a function of the Hamiltonian, or of `SaveAt(fn=...)`, holds in a "
            "static field, a global variable or an object without `__dict__`. Pass the "
            "array through `args`, make it a field of an `equinox.Module` that is not "
            "static, or use `diffrax.RecursiveCheckpointAdjoint()` instead."
        )
    # Not `_solve`, so that this supports forward mode.
    final, trace = call.run_for_gradient(call.inputs)
    return final, (final, trace)


@_solve.def_bwd
def _solve_bwd(residuals, cotangents, perturbed: Call, call: Call, adjoint):
    final, trace = residuals
    backward = Backward(call.inputs, perturbed.inputs, final, trace, cotangents)
    at = adjoint.back(backward)
    none = lambda tree: jtu.tree_map(lambda _: None, tree)
    inputs = Inputs(at.bar, at.gradient, none(call.inputs.rest))
    return Call(inputs, none(call.run), none(call.run_for_gradient))
