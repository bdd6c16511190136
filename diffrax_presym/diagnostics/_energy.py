"""The energy of a solution, and its balance."""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Inexact, PyTree

from .. import _tree as tree
from .._numbers import as_time, cast_to, State
from .._scheme._engine import cheap_iterations
from .._system._base import AbstractSystem


Times = Inexact[Array, " times"]
# Between two saved times, of the integral of a power.
_MAX_STEPS = 100_000


def energy(system: AbstractSystem, ts: Times, ys: State, args: PyTree = None) -> Times:
    """The mechanical energy `E(t, q, p)` at each saved time.

    **Arguments:**

    - `system`: the system of the solve.
    - `ts`, `ys`: times and states, the `ts` and `ys` of a `diffrax.Solution`.
    - `args`: as in `diffeqsolve`.

    **Returns:**

    An array with an entry for each time. Where nothing was saved (`ts` is infinite
    beyond the last step of `SaveAt(steps=True)`) it is not finite either.

    **Raises:**

    `ValueError` if the solution is a batch: use `jax.vmap` for that.
    """
    return _at_each(_energy, system, ts, ys, args)


def energy_error(
    system: AbstractSystem, ts: Times, ys: State, args: PyTree = None
) -> Times:
    """The error of the energy balance at each saved time.

    Along the exact motion the extended Hamiltonian is constant: energy changes only by
    friction, by other forces, and where it depends on time,

    `E(t) - E(t0) = ∫ (∂E/∂t + v · F) dt`,

    where `v` is the velocity and `F` the force that has no potential: `-η' p` for a
    damping law. The error is the left side minus the right. The integral is along the
    exact motion from each saved state to the next time, by `diffrax.Dopri8` to
    rounding, so that the error is that of the solution alone. It is NaN where that
    fails. Where a force has kinks, as of contacts, it may take far longer than the
    solve.

    **Arguments:**

    As `diagnostics.energy`.
    """
    error = energy(system, ts, ys, args) - _integral(_power, system, ts, ys, args)
    if not len(ts):
        return error
    return error - error[jnp.argmax(jnp.isfinite(as_time(ts)))]


def power_lost(
    system: AbstractSystem, ts: Times, ys: State, args: PyTree = None
) -> Times:
    """The power lost to friction at each saved time, `-v · F` with the velocity `v`
    and the force `F` of all laws of friction: `v · C v` for viscous friction. A
    `force=` of the system is none of these, and is in `diagnostics.energy_error`.

    It follows the saved momenta. Where friction over a step is of the order of one or
    more, those of `Strang`, `PresymplecticLeapfrog` and `PresymplecticEuler` are not
    resolved, and the power is wrong by the square of their factor, which is in their
    docstrings.

    **Arguments:**

    As `diagnostics.energy`.
    """
    return _at_each(_power_lost, system, ts, ys, args)


def energy_lost(
    system: AbstractSystem, ts: Times, ys: State, args: PyTree = None
) -> Times:
    """The energy lost to friction up to each saved time, the integral of
    `diagnostics.power_lost`.

    Along the exact motion from each saved state to the next time, so that a momentum
    that a coarse scheme does not resolve counts once for each saved time: see
    `diagnostics.power_lost`.

    **Arguments:**

    As `diagnostics.energy`.
    """
    return _integral(_power_lost, system, ts, ys, args)


# Functions of the module are compiled once for each system and shape.


def _energy(system: AbstractSystem, t, y: State, args: PyTree):
    return system.energy(t, *y, args=args)


def _power(system: AbstractSystem, t, y: State, args: PyTree):
    """The power of all that changes the energy."""
    energy = lambda t, q, p: system.energy(t, q, p, args)
    explicit, *slopes = jax.grad(energy, argnums=(0, 1, 2))(t, *y)
    done = tree.dot(slopes, list(system.vf(t, y, args)))
    return cast_to(explicit, done) + done


def _power_lost(system: AbstractSystem, t, y: State, args: PyTree):
    # Of bodies the angular velocity, where `system.velocity` is that of quaternions.
    velocity = jax.grad(lambda p: system.energy(t, y[0], p, args))(y[1])
    return -tree.dot(velocity, system.friction_force(t, *y, args))


@eqx.filter_jit
def _integral(
    power: Callable, system: AbstractSystem, ts: Times, ys: State, args: PyTree
) -> Times:
    """The integral up to each saved time of a function of time and state, from the
    first that is not a gap in measured times."""
    ts = checked(ts, ys)
    if not len(ts):
        return jnp.zeros_like(ts)
    eps = max(float(jnp.finfo(y.dtype).eps) for y in jtu.tree_leaves(ys))
    tolerance = 100 * eps

    def one(t0, t1, y0):
        field = lambda t, x, _: (
            system.vf(t, x[0], args),
            power(system, t, x[0], args),
        )
        zero = jnp.zeros_like(power(system, t0, y0, args))
        sol = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Dopri8(),
            *(t0, t1, None, (y0, zero)),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=_MAX_STEPS,
            throw=False,
        )
        assert sol.ys is not None
        good = sol.result == dfx.RESULTS.successful
        return jnp.where(good, sol.ys[1][0], jnp.nan)

    # Nothing was saved in gaps, and beyond the last step.
    saved = jnp.isfinite(ts)
    last = jax.lax.cummax(jnp.where(saved, jnp.arange(len(ts)), 0))[:-1]
    starts = jtu.tree_map(lambda y: y[last], ys)
    known = saved[1:] & saved[last]
    begin, end = (jnp.where(known, t, 0) for t in (ts[last], ts[1:]))
    spans = begin, end, starts
    # On a CPU one after the other: together each would take the steps of the longest.
    in_turn = lambda: jax.lax.map(lambda span: one(*span), spans)
    parts = in_turn() if cheap_iterations() else jax.vmap(one)(*spans)
    parts = jnp.where(known, parts, 0)
    return jnp.concatenate([jnp.zeros(1, parts.dtype), jnp.cumsum(parts)])


@eqx.filter_jit
def _at_each(fn: Callable, system: AbstractSystem, ts: Times, ys: State, args: PyTree):
    return jax.vmap(lambda t, y: fn(system, t, y, args))(checked(ts, ys), ys)


def checked(ts: Times, ys: State) -> Times:
    """The times of one solution; an error if it is a batch."""
    ts = as_time(ts)
    if jnp.ndim(ts) != 1:
        each = "jax.vmap(lambda ts, ys: diagnostics.energy(system, ts, ys))(ts, ys)"
        raise ValueError(
            f"`ts` must be the saved times of one solution, but has shape {ts.shape}. "
            f"Take one member of a batch, or write `{each}`, with the arguments of "
            "each member if they differ."
        )
    shapes = [jnp.shape(y) for y in jtu.tree_leaves(ys)]
    if any(shape[:1] != ts.shape for shape in shapes):
        raise ValueError(
            f"`ys` must have a state for each of the {len(ts)} times `ts`, but has "
            f"arrays of shapes {', '.join(map(str, shapes))}."
        )
    return ts
