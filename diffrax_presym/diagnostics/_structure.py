"""Measures of what a solver preserves."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact, PyTree

from .._friction._fit import has_one_rate
from .._numbers import as_time, State
from .._scheme._base import AbstractPresymplecticSolver
from .._system._base import AbstractSystem
from .._system._bound import bind


def structure_defect(
    system: AbstractSystem,
    solver: dfx.AbstractSolver,
    t0,
    t1,
    y: State,
    args: PyTree = None,
) -> Inexact[Array, ""]:
    """The error of conformal symplecticity of one step.

    The largest entry of `J^T Ω J - exp(η(t0) - η(t1)) Ω`, where `J` is the Jacobian of
    the step: zero to rounding for the one-step schemes of this package
    (`PresymplecticGauss` while friction over a step is at most one). Those with two
    copies of the system are conformally symplectic in the doubled phase space; their
    defect in `y` alone is small but not zero. Only for systems whose friction is one
    rate of damping, without constraints.

    **Arguments:**

    - `system`, `solver`: the system, and any solver that takes it.
    - `t0`, `t1`: the start and the end of the step.
    - `y`: the state `(q, p)` at the start.
    - `args`: as in `diffeqsolve`.

    **Raises:**

    `ValueError` if the system has other friction or a manifold, or for a multistep
    method.
    """
    if system.is_constrained:
        raise ValueError(
            "`structure_defect` needs local coordinates, but the state of a "
            f"`{type(system).__name__}` is on a manifold or constraints. Write it in "
            "such coordinates, as a `LagrangianSystem`."
        )
    force = getattr(system, "external", None)
    if not has_one_rate(system.parts) or force is not None:
        raise ValueError(
            "`structure_defect` is the defect of conformal symplecticity, which only "
            "one rate of damping for all momenta preserves, but this "
            f"`{type(system).__name__}` has other friction or a `force`."
        )
    own = isinstance(solver, AbstractPresymplecticSolver)
    if own and solver.scheme(bind(system, args, y)).has_history:
        raise ValueError(
            f"A step of `{type(solver).__name__}` depends on those before it, so that "
            "one does not show what is preserved. It is symmetric, not symplectic."
        )
    return _structure_defect(system, solver, as_time(t0), as_time(t1), y, args)


@eqx.filter_jit
def _structure_defect(system, solver, t0, t1, y, args):
    start, unravel = ravel_pytree(y)

    def end(x):
        y = unravel(x)
        carry = solver.init(system, t0, t1, y, args)
        y1, *_ = solver.step(system, t0, t1, y, args, carry, made_jump=False)
        return ravel_pytree(y1)[0]

    # Diffrax's own solvers support reverse mode.
    jacobian = jax.jacrev(end)(start)
    n = start.size // 2
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    damping = system.damping
    lost = jnp.zeros_like(t0) if damping is None else damping.increment(t0, t1 - t0)
    product = jnp.matmul(jacobian.T, form @ jacobian, precision="highest")
    return jnp.max(jnp.abs(product - jnp.exp(-lost) * form))
