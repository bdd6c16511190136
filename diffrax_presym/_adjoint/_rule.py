"""The rule for the derivative of a solve: its forward pass, and its backward pass."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.tree_util as jtu
from jax.core import Tracer

from ._backward import Backward
from ._checkpoints import gradient
from ._types import Inputs


# Not covered by `closure_to_pytree`.
_HIDDEN = (
    "`ReversibleAdjoint` cannot differentiate with respect to an array that a function "
    "of the Hamiltonian, or of `SaveAt(fn=...)`, holds in a static field, a global "
    "variable or an object without `__dict__`. Pass the array through `args`, make it "
    "a field of an `equinox.Module` that is not static, or use "
    "`diffrax.RecursiveCheckpointAdjoint()` instead."
)


def refuse(what: str) -> str:
    return (
        f"`ReversibleAdjoint` does not support {what}. Use "
        "`diffrax.RecursiveCheckpointAdjoint()` instead."
    )


# Where these are in the inputs from Diffrax.
is_none = lambda x: x is None
_is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
get_fns = lambda saveat: [
    sub.fn for sub in jtu.tree_leaves(saveat.subs, is_leaf=_is_sub)
]
get_hamiltonian = lambda terms: terms.term.hamiltonian
get_start = lambda state: (state.y, state.solver_state, state.made_jump)


def holds_tracers(parameters, t, y) -> bool:
    """Whether a function uses arrays of an outer transformation that are no leaves."""
    arrays, static = eqx.partition((parameters, t, y), eqx.is_array)

    def use_all(arrays):
        (system, fns), t, y = eqx.combine(arrays, static)
        used = system.slope(t, y), [fn(t, y, system.args) for fn in fns]
        return eqx.filter(used, eqx.is_array)

    return any(isinstance(x, Tracer) for x in jax.make_jaxpr(use_all)(arrays).consts)


def forward(inputs: Inputs):
    """Diffrax's own loop, as for a solve without gradients."""
    system, fns = inputs.parameters
    init_state, saveat = inputs.rest["init_state"], inputs.rest["saveat"]
    start = (*inputs.start, False)
    changed = dict(
        terms=eqx.tree_at(
            get_hamiltonian, inputs.rest["terms"], system.hamiltonian, is_leaf=is_none
        ),
        saveat=eqx.tree_at(get_fns, saveat, fns, is_leaf=is_none),
        init_state=eqx.tree_at(get_start, init_state, start, is_leaf=is_none),
    )
    return dfx.ForwardMode().loop(
        **(inputs.rest | changed),
        args=system.args,
        throw=None,
        passed_solver_state=None,
        passed_controller_state=None,
    )


@eqx.filter_custom_vjp
def solve(inputs: Inputs, adjoint):
    return inputs.run(inputs._replace(run=forward))


@solve.def_fwd
def _solve_fwd(perturbed: Inputs, inputs: Inputs, adjoint):
    if any(jtu.tree_leaves(perturbed.rest)):
        raise ValueError(
            refuse(
                "derivatives with respect to times (`t0`, `t1`, `dt0`, `ts`) or to the "
                "solver"
            )
        )
    if any(jtu.tree_leaves(perturbed.run)):
        raise ValueError(_HIDDEN)
    # Not `solve`, so that this supports forward mode.
    out = inputs.run(inputs._replace(run=forward))
    return out, out[0]


@solve.def_bwd
def _solve_bwd(final, cotangents, perturbed: Inputs, inputs: Inputs, adjoint):
    backward = Backward(inputs, perturbed, final, cotangents[0])
    bar, more = gradient(backward, adjoint.checkpoints, adjoint.tol)
    none = jtu.tree_map(lambda _: None, (inputs.rest, inputs.run))
    return Inputs(bar, more, *none)
