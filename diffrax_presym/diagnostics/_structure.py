"""Measures of what a solver preserves, and of its order."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact, PyTree

from .._friction._fit import has_one_rate
from .._misc import as_time, State
from .._system._base import AbstractSystem


def structure_defect(
    system: AbstractSystem,
    solver: dfx.AbstractSolver,
    t0,
    t1,
    y: State,
    args: PyTree = None,
) -> Inexact[Array, ""]:
    r"""The error of conformal symplecticity of one step.

    The largest entry of $J^T \Omega J - e^{\eta(t_0) - \eta(t_1)} \Omega$, where $J$ is
    the Jacobian of the step: zero to rounding for the schemes of this package. Those
    with two copies of the system are conformally symplectic in the doubled phase space;
    their defect in `y` alone is small but not zero. Only for systems whose friction is
    one rate of damping; for other linear friction see
    [`diffrax_presym.diagnostics.volume_defect`][].

    **Arguments:**

    - `system`, `solver`: the system, and any solver that takes it.
    - `t0`, `t1`: the start and the end of the step.
    - `y`: the state `(q, p)` at the start.
    - `args`: as in `diffeqsolve`.

    **Raises:**

    `ValueError` if the system has other friction.
    """
    if not has_one_rate(system.parts) or _has_force(system):
        raise ValueError(
            "`structure_defect` is the defect of conformal symplecticity, which only "
            "one rate of damping for all momenta preserves, but this "
            f"`{type(system).__name__}` has other friction. Use `volume_defect`, "
            "for linear friction that does not depend on place."
        )
    return _structure_defect(system, solver, as_time(t0), as_time(t1), y, args)


def volume_defect(
    system: AbstractSystem,
    solver: dfx.AbstractSolver,
    t0,
    t1,
    y: State,
    args: PyTree = None,
) -> Inexact[Array, ""]:
    r"""The error of the contraction of phase volume in one step.

    The exact motion with linear friction at the rate $\Gamma(t)$, a number, a rate for
    each degree of freedom or a matrix, contracts phase volume by
    $\exp(-\int \mathrm{tr} \, \Gamma \, \mathrm dt)$. The error is the logarithm
    of the determinant of the Jacobian of the step, minus this integral with its sign:
    zero to rounding for the splittings, compositions and leapfrogs of this package.

    **Arguments:**

    As [`diffrax_presym.diagnostics.structure_defect`][].

    **Raises:**

    `ValueError` if the system has friction that depends on place or on speed.
    """
    _, *other = system.parts
    if any(other) or _has_force(system):
        raise ValueError(
            "`volume_defect` needs friction that is linear and does not depend on "
            f"place, but this `{type(system).__name__}` has other friction or a "
            "`force`, which contracts phase volume by an amount that depends on the "
            "trajectory."
        )
    return _volume_defect(system, solver, as_time(t0), as_time(t1), y, args)


def _has_force(system: AbstractSystem) -> bool:
    return getattr(system, "external", None) is not None


@eqx.filter_jit
def _volume_defect(system, solver, t0, t1, y, args):
    _, jacobian = _jacobian(system, solver, t0, t1, y, args)
    _, contracted = jnp.linalg.slogdet(jacobian)
    friction = system.fit_friction(y[1])
    if friction is None:
        return contracted
    return contracted + friction.contraction(t0, t1 - t0, y[1])


def _jacobian(system, solver, t0, t1, y, args):
    """The state at the start of a step as a vector, and the Jacobian of the step."""
    start, unravel = ravel_pytree(y)

    def end(x):
        y = unravel(x)
        carry = solver.init(system, t0, t1, y, args)
        y1, *_ = solver.step(system, t0, t1, y, args, carry, made_jump=False)
        return ravel_pytree(y1)[0]

    # Diffrax's own solvers support reverse mode.
    return start, jax.jacrev(end)(start)


@eqx.filter_jit
def _structure_defect(system, solver, t0, t1, y, args):
    start, jacobian = _jacobian(system, solver, t0, t1, y, args)
    n = start.size // 2
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    damping = system.damping
    lost = jnp.zeros_like(t0) if damping is None else damping.increment(t0, t1 - t0)
    product = jnp.matmul(jacobian.T, form @ jacobian, precision="highest")
    return jnp.max(jnp.abs(product - jnp.exp(-lost) * form))


def convergence_order(
    system: AbstractSystem,
    solver: dfx.AbstractSolver,
    t0,
    t1,
    y0: State,
    steps: int,
    args: PyTree = None,
) -> Inexact[Array, ""]:
    r"""The measured order of a solver, $\log_2 (|y_h - y_{h/2}| / |y_{h/2} -
    y_{h/4}|)$, from solves with once, twice and four times as many steps.

    It is close to the order of the scheme if steps are small enough for the leading
    error to dominate, and large enough for it to exceed rounding.

    **Arguments:**

    - `system`, `solver`: the system, and any solver that takes it.
    - `t0`, `t1`: the start and the end of the solves.
    - `y0`: the state `(q, p)` at the start.
    - `steps`: the number of steps of the coarsest solve.
    - `args`: as in `diffeqsolve`.

    **Raises:**

    `ValueError` if `steps` is not a positive integer.
    """
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(
            f"`convergence_order(steps=...)` must be a positive integer, got {steps!r}."
        )
    t0, t1 = jnp.asarray(t0, float), jnp.asarray(t1, float)
    coarse, middle, fine = (
        _end(system, solver, t0, t1, (t1 - t0) / (k * steps), y0, args)
        for k in (1, 2, 4)
    )
    distance = lambda x, y: jnp.linalg.norm(x - y)
    return jnp.log2(distance(coarse, middle) / distance(middle, fine))


@eqx.filter_jit
def _end(system, solver, t0, t1, dt0, y0, args):
    sol = dfx.diffeqsolve(system, solver, t0, t1, dt0, y0, args, max_steps=None)
    return ravel_pytree(jtu.tree_map(lambda y: y[-1], sol.ys))[0]
