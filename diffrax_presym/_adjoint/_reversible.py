"""Gradients by running the scheme backwards.

The inverse of a list of moves is the list of their inverses in reverse order. So the
states of a solve need not be stored for its gradient: each is recomputed from the next
one, and cotangents are pulled back through the step between them.
"""

from functools import partial

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax.lax as lax

from .._closures import closure_to_pytree
from .._misc import as_positive
from .._term import as_system
from ._rule import (
    forward,
    get_fns,
    get_hamiltonian,
    get_start,
    holds_tracers,
    is_none,
    refuse,
    solve,
)
from ._types import Inputs


class ReversibleAdjoint(dfx.AbstractAdjoint):
    r"""Exact gradients in constant memory, by running the scheme backwards.

    The gradient of the discrete solution ("discretise, then optimise"). It agrees with
    `diffrax.RecursiveCheckpointAdjoint` to rounding, and costs two to four solves for
    any number of steps. The forward pass is that of a solve without gradients.

    For every solver of this package with an adjoint method, with
    `diffrax.ConstantStepSize` or `diffrax.StepTo` and any `SaveAt`, and with respect to
    `y0`, `args`, the term, and everything that a function of these or of
    `SaveAt(fn=...)` closes over. Events, adaptive steps and derivatives with respect to
    times are errors; use `diffrax.RecursiveCheckpointAdjoint` for these. For second
    derivatives use forward mode over reverse mode, `jax.jvp` of `jax.grad`.

    Damping loses information: backwards in time rounding errors grow by $e^{\eta(t_1) -
    \eta(t_0)}$. If this is too much, or the recomputed initial state is inaccurate, the
    solve is repeated, and states are kept from which the backward pass restarts. The
    error of the recomputed states is measured at each known state, and one beyond `tol`
    raises an error.
    """

    checkpoints: int = 128
    tol: float | None = None

    def __check_init__(self):
        if not isinstance(self.checkpoints, int) or self.checkpoints < 0:
            raise ValueError(
                "`ReversibleAdjoint(checkpoints=...)` must be a Python integer, zero "
                f"or more, but got {self.checkpoints!r}."
            )
        if self.tol is not None:
            as_positive(self.tol, "`ReversibleAdjoint(tol=...)`")

    def loop(
        self,
        *,
        args,
        terms,
        solver,
        saveat,
        init_state,
        passed_solver_state,
        passed_controller_state,
        throw,
        **rest,
    ):
        del passed_solver_state, throw
        system = as_system(terms, args)
        _check(solver, rest["stepsize_controller"], rest["event"])
        if passed_controller_state:
            raise ValueError(refuse("a `controller_state`"))
        y, carry = init_state.y, init_state.solver_state
        if init_state.made_jump is not False:
            # The solver state is stale, and is recomputed before the first step.
            restart = lambda: solver.start(system, system.time(rest["t0"]), y)
            carry = lax.cond(init_state.made_jump, restart, lambda: carry)
        fns = get_fns(saveat)
        rest |= dict(
            solver=solver,
            terms=eqx.tree_at(get_hamiltonian, terms, None),
            saveat=eqx.tree_at(get_fns, saveat, [None] * len(fns)),
            init_state=eqx.tree_at(
                get_start, init_state, (None, None, False), is_leaf=is_none
            ),
        )
        # Closures of functions are differentiated too.
        parameters = closure_to_pytree((system, fns))
        inputs = Inputs((y, carry), parameters, rest, forward)
        if holds_tracers(parameters, system.time(rest["t0"]), y):
            # Convert them to inputs, which shows whether they are differentiated.
            # Equinox does not convert a function without a closure.
            run = eqx.filter_closure_convert(partial(forward), inputs)
            inputs = inputs._replace(run=run)
        out = solve(inputs, self)
        # To JAX all outputs of a custom rule have derivatives, even integers.
        out, counts = eqx.partition(out, eqx.is_inexact_array)
        return eqx.combine(out, eqxi.nondifferentiable_backward(counts))


ReversibleAdjoint.__init__.__doc__ = r"""**Arguments:**

- `checkpoints`: the maximum number of states to keep besides the two ends, which
    determines the memory. With 0 the solve is never repeated. Defaults to 128, enough
    for an increment of $\eta$ of 1000 in `float64`, and of a few hundred in `float32`.
- `tol`: the largest error of a recomputed state, relative to the size of the state.
    Defaults to the precision of the state to the power 2/3: 4e-11 in `float64`, 2e-5
    in `float32`.

**Raises:**

`ValueError` if either is out of range, and when the solve is traced if it is not
supported. `RuntimeError` when the gradient is computed, if the error at a known state
exceeds `tol`.
"""


def _check(solver, controller, event) -> None:
    # Diffrax's wrappers of solvers have no `reverse`.
    if getattr(solver, "reverse", None) is None:
        what = f"`{type(solver).__name__}`, which has no known adjoint method"
        raise ValueError(refuse(what))
    if type(controller) not in (dfx.ConstantStepSize, dfx.StepTo):
        raise ValueError(
            refuse(
                f"`{type(controller).__name__}`: only `diffrax.ConstantStepSize()` and "
                "`diffrax.StepTo(ts)` make steps that do not depend on the state"
            )
        )
    if event is not None:
        raise ValueError(refuse("events"))
