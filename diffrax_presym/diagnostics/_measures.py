"""Measures of the energy, structure and order of a solution."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Inexact, PyTree

from .._friction import is_scalar
from .._hamiltonian import LagrangianSystem, MechanicalSystem
from .._misc import as_time, tree_dot, tree_sum
from .._split import State
from .._term import HamiltonianTerm


Times = Inexact[Array, " times"]


def energy(term: HamiltonianTerm, ts: Times, ys: State, args: PyTree = None) -> Times:
    r"""The mechanical energy $E(t, q, p)$ at each saved time.

    **Arguments:**

    - `term`: the term of the solve.
    - `ts`, `ys`: times and states, the `ts` and `ys` of a `diffrax.Solution`.
    - `args`: as in `diffeqsolve`.

    **Returns:**

    An array with an entry for each time. Where nothing was saved (`ts` is infinite
    beyond the last step of `SaveAt(steps=True)`) it is not finite either.
    """
    return _at_each(lambda t, y: term.hamiltonian.energy(t, *y, args=args), ts, ys)


def canonical_energy(
    term: HamiltonianTerm, ts: Times, ys: State, args: PyTree = None
) -> Times:
    r"""The canonical energy $H = e^{\eta(t)} E(t, q, p)$, that of the paper.

    It overflows where $e^{\eta}$ does.

    **Arguments:**

    As [`diffrax_presym.diagnostics.energy`][].
    """

    return _at_each(lambda t, y: term.hamiltonian.canonical(t, *y, args=args), ts, ys)


def energy_error(
    term: HamiltonianTerm, ts: Times, ys: State, args: PyTree = None
) -> Times:
    r"""The error of the energy balance at each saved time.

    Along the exact motion the extended Hamiltonian is constant: energy changes only by
    friction, by other forces, and where it depends on time,

    $$E(t) - E(t_0) = \int_{t_0}^t \Big( \frac{\partial E}{\partial t}
    + v \cdot F \Big) \, \mathrm d t,$$

    where $v$ is the velocity and $F$ the force that has no potential:
    $-\dot \eta \, p$ for a damping law. The error is the left side minus the
    right. The integral is computed from the saved states, to fourth order in their
    spacing: save every step, or often.

    **Arguments:**

    As [`diffrax_presym.diagnostics.energy`][].
    """
    hamiltonian = term.hamiltonian

    def power(t, y):
        energy = lambda t, q, p: hamiltonian.energy(t, q, p, args)
        explicit, slope, _ = jax.grad(energy, argnums=(0, 1, 2))(t, *y)
        velocity, force = term.vf(t, y, args)
        return explicit + tree_dot(velocity, tree_sum(force, slope))

    done = _integral(power, term, ts, ys, args)
    balance = energy(term, ts, ys, args)
    return balance - balance[0] - done


def power_lost(
    term: HamiltonianTerm, ts: Times, ys: State, args: PyTree = None
) -> Times:
    r"""The power lost to friction at each saved time, $-v \cdot F$ with the velocity
    $v$ and the force $F$ of all friction: $v \cdot C v$ for viscous friction.

    **Arguments:**

    As [`diffrax_presym.diagnostics.energy`][].
    """
    return _at_each(lambda t, y: _power_lost(term, t, y, args), ts, ys)


def energy_lost(
    term: HamiltonianTerm, ts: Times, ys: State, args: PyTree = None
) -> Times:
    """The energy lost to friction up to each saved time, the integral of
    [`diffrax_presym.diagnostics.power_lost`][].

    Computed from the saved states, to fourth order in their spacing.

    **Arguments:**

    As [`diffrax_presym.diagnostics.energy`][].
    """
    power = lambda t, y: _power_lost(term, t, y, args)
    return _integral(power, term, ts, ys, args)


def _power_lost(term, t, y, args):
    velocity = term.hamiltonian.velocity(t, *y, args)
    return -tree_dot(velocity, term.hamiltonian.friction_force(t, *y, args))


def _integral(power, term, ts, ys, args):
    """The integral up to each saved time of a function of time and state."""

    def with_slope(t, y):
        return jax.jvp(power, (t, y), (jnp.ones_like(t), term.vf(t, y, args)))

    ts = as_time(ts)
    values, slopes = _at_each(with_slope, ts, ys)
    # The trapezoidal rule and its first correction.
    h = jnp.diff(ts)
    trapezoid = h * (values[1:] + values[:-1]) / 2
    parts = trapezoid + h**2 / 12 * (slopes[:-1] - slopes[1:])
    return jnp.concatenate([jnp.zeros_like(values[:1]), jnp.cumsum(parts)])


def _at_each(fn, ts, ys):
    return eqx.filter_jit(jax.vmap(fn))(as_time(ts), ys)


def structure_defect(
    term: HamiltonianTerm,
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

    - `term`, `solver`: the term, and any solver that takes it.
    - `t0`, `t1`: the start and the end of the step.
    - `y`: the state `(q, p)` at the start.
    - `args`: as in `diffeqsolve`.

    **Raises:**

    `ValueError` if the system has other friction.
    """
    hamiltonian = term.hamiltonian
    if not is_scalar(hamiltonian.friction) or _has_other_friction(hamiltonian):
        raise ValueError(
            "`structure_defect` is the defect of conformal symplecticity, which only "
            "one rate of damping for all momenta preserves, but this "
            f"`{type(hamiltonian).__name__}` has other friction. Use `volume_defect`, "
            "for linear friction that does not depend on place."
        )
    return _structure_defect(term, solver, as_time(t0), as_time(t1), y, args)


def volume_defect(
    term: HamiltonianTerm,
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
    hamiltonian = term.hamiltonian
    if _has_other_friction(hamiltonian):
        raise ValueError(
            "`volume_defect` needs friction that is linear and does not depend on "
            f"place, but this `{type(hamiltonian).__name__}` has other friction or a "
            "`force`, which contracts phase volume by an amount that depends on the "
            "trajectory."
        )
    return _volume_defect(term, solver, as_time(t0), as_time(t1), y, args)


def _has_other_friction(hamiltonian) -> bool:
    """Whether there is friction that is not linear, or that depends on place."""
    if isinstance(hamiltonian, LagrangianSystem):
        return not hamiltonian.is_conservative
    return isinstance(hamiltonian, MechanicalSystem) and not hamiltonian.is_linear


@eqx.filter_jit
def _volume_defect(term, solver, t0, t1, y, args):
    _, jacobian = _jacobian(term, solver, t0, t1, y, args)
    _, contracted = jnp.linalg.slogdet(jacobian)
    friction = term.hamiltonian.friction
    if friction is None:
        return contracted
    return contracted + friction.contraction(t0, t1 - t0, y[1])


def _jacobian(term, solver, t0, t1, y, args):
    """The state at the start of a step as a vector, and the Jacobian of the step."""
    start, unravel = ravel_pytree(y)

    def end(x):
        y = unravel(x)
        carry = solver.init(term, t0, t1, y, args)
        y1, *_ = solver.step(term, t0, t1, y, args, carry, made_jump=False)
        return ravel_pytree(y1)[0]

    # Diffrax's own solvers support reverse mode.
    return start, jax.jacrev(end)(start)


@eqx.filter_jit
def _structure_defect(term, solver, t0, t1, y, args):
    start, jacobian = _jacobian(term, solver, t0, t1, y, args)
    n = start.size // 2
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    damping = term.hamiltonian.damping
    lost = jnp.zeros_like(t0) if damping is None else damping.increment(t0, t1 - t0)
    product = jnp.matmul(jacobian.T, form @ jacobian, precision="highest")
    return jnp.max(jnp.abs(product - jnp.exp(-lost) * form))


def convergence_order(
    term: HamiltonianTerm,
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

    - `term`, `solver`: the term, and any solver that takes it.
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
        _end(term, solver, t0, t1, (t1 - t0) / (k * steps), y0, args) for k in (1, 2, 4)
    )
    distance = lambda x, y: jnp.linalg.norm(x - y)
    return jnp.log2(distance(coarse, middle) / distance(middle, fine))


@eqx.filter_jit
def _end(term, solver, t0, t1, dt0, y0, args):
    sol = dfx.diffeqsolve(term, solver, t0, t1, dt0, y0, args, max_steps=None)
    return ravel_pytree(jtu.tree_map(lambda y: y[-1], sol.ys))[0]
