import abc

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax.lax as lax
from jaxtyping import Array

from .._closures import closure_to_pytree
from .._loop import flatten_subs, Inputs, Plan, Steps
from .._solver._base import AbstractPresymplecticSolver, Tabulated
from .._term import as_system
from ._backward import Backward, Position
from ._rule import call, refuse


class AbstractFixedStepAdjoint(dfx.AbstractAdjoint):
    """The loop for steps known beforehand, with a rule for gradients."""

    @abc.abstractmethod
    def keep(self, plan: Plan) -> Array:
        """The steps whose starting states a gradient needs, in order; those after the
        last step are not kept."""

    @abc.abstractmethod
    def back(self, backward: Backward) -> Position:
        """The backward pass."""

    def check(self, solver) -> None:
        """An error if a solve is not supported."""

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
        self._check(solver, rest["stepsize_controller"], rest["event"])
        self.check(solver)
        if passed_controller_state:
            raise ValueError(refuse(self, "a `controller_state`"))
        y, carry = init_state.y, init_state.solver_state
        first = carry.table if isinstance(carry, Tabulated) else None
        if isinstance(carry, Tabulated):
            # Most steps are of one length, but not all.
            steps = Steps(**rest)
            n = steps.total // 2
            t0, t1 = (system.time(steps.time(n + i)) for i in (0, 1))
            h = solver.step_length(t0, t1)
            table = solver.tabulated(system, h, y, both=True).table
            system, carry = system.with_table(table.assume(False)), carry.carry
        if init_state.made_jump is not False:
            # The solver state is stale, and is recomputed before the first step.
            restart = lambda: solver.start(system, system.time(rest["t0"]), y)
            carry = lax.cond(init_state.made_jump, restart, lambda: carry)
        fns = _get_fns(saveat)
        start = lambda state: (state.y, state.solver_state, state.made_jump)
        none = None, None, False
        rest |= dict(
            solver=solver,
            saveat=eqx.tree_at(_get_fns, saveat, [None] * len(fns)),
            init_state=eqx.tree_at(start, init_state, none, is_leaf=_is_none),
        )
        # Closures of functions are differentiated too.
        parameters = closure_to_pytree((system, fns))
        out = self.solve(Inputs((y, carry), parameters, rest))
        # To JAX all outputs of a custom rule have derivatives, even integers.
        out, counts = eqx.partition(out, eqx.is_inexact_array)
        out = eqx.combine(out, eqxi.nondifferentiable_backward(counts))
        if first is not None:
            # As it was, so that it has the form that a solve expects.
            at_end = Tabulated(out.solver_state, first)
            where = lambda x: x.solver_state
            out = eqx.tree_at(where, out, at_end, is_leaf=_is_none)
        return out, {}

    def solve(self, inputs: Inputs):
        """Diffrax's final state, with a rule for its gradient."""
        return call(inputs, self)

    def _check(self, solver, controller, event) -> None:
        # Not `isinstance`, which Diffrax's wrappers of solvers pass.
        if not issubclass(type(solver), AbstractPresymplecticSolver):
            raise ValueError(refuse(self, f"`{type(solver).__name__}`"))
        if type(controller) not in (dfx.ConstantStepSize, dfx.StepTo):
            what = (
                f"`{type(controller).__name__}`: only `diffrax.ConstantStepSize()` and "
                "`diffrax.StepTo(ts)` make steps that do not depend on the state"
            )
            raise ValueError(refuse(self, what))
        if event is not None:
            raise ValueError(refuse(self, "events"))


_is_none = lambda x: x is None
_get_fns = lambda saveat: [sub.fn for sub in flatten_subs(saveat)[0]]
