"""Gradients by running the scheme backwards, against other methods."""

import enum
import functools
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import assert_close, each, mixed_energy, Scheme, SCHEMES
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps
from diffrax_presym._loop._steps import Steps


REVERSIBLE = dps.FixedStepAdjoint()
FIXED_STEP = dps.FixedStepAdjoint("checkpoints")
CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()
LEAPFROG = dps.PresymplecticLeapfrog()
Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.0, 0.3]))
GAMMA, STIFFNESS = jnp.asarray(np.float64(0.3)), jnp.asarray(np.float64(1.3))
INPUTS = (Y0, GAMMA, STIFFNESS)


def pendulum(t, q, args):
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.sin(t) * q[0]


def mixed(t, q, p, args):
    return args * mixed_energy(t, q, p, args)


def separable(gamma):
    damping = dps.ConstantDamping(gamma)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), pendulum, damping)


def nonseparable(gamma):
    return dps.Hamiltonian(mixed, dps.ConstantDamping(gamma))


def add_up(tree):
    """A scalar that depends on every saved entry; unused entries are ignored."""

    def leaf(x):
        weights = jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)
        return jnp.sum(jnp.where(jnp.isfinite(x), x, 0) * weights)

    return sum(jtu.tree_leaves(jtu.tree_map(leaf, tree)), jnp.zeros(()))


def solve(inputs, adjoint, solver: Any = LEAPFROG, system=separable, **kwargs):
    y0, gamma, stiffness = inputs
    times: dict[str, Any] = dict(t0=0.0, t1=1.0, dt0=0.1, max_steps=64)
    return dfx.diffeqsolve(
        system(gamma),
        solver,
        y0=y0,
        args=stiffness,
        adjoint=adjoint,
        **(times | kwargs),
    )


def value(inputs, adjoint, kwargs):
    sol = solve(inputs, adjoint, **kwargs)
    # Outputs that are not saved are `None`.
    dense = None if sol.interpolation is None else sol.evaluate(0.37 * sol.t1)
    return add_up((sol.ys, sol.solver_state, dense))


value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(value))


@eqx.filter_jit
def by_forward_mode(inputs, kwargs):
    """The same in forward mode, which compiles in half the time of reverse mode."""
    numbers, unravel = ravel_pytree(inputs)

    def of_numbers(numbers):
        out = value(unravel(numbers), dfx.ForwardMode(), kwargs)
        return out, out

    gradient, out = jax.jacfwd(of_numbers, has_aux=True)(numbers)
    return out, unravel(gradient)


def check(tolerance=1e-12, adjoints=(REVERSIBLE,), **kwargs):
    exact = by_forward_mode(INPUTS, kwargs)
    assert all(np.all(x != 0) for x in jtu.tree_leaves(exact[1]))
    for adjoint in adjoints:
        ours = value_and_gradient(INPUTS, adjoint, kwargs)
        assert_close(ours, exact, tolerance)


def named(schemes, *names):
    return [scheme for scheme in schemes if scheme.name in names]


# Compiling a gradient takes seconds, so one scheme of each kind is tested.


@each(named(SCHEMES, "euler_A", "leapfrog_BA", "suzuki_yoshida_4", "tao"))
def test_gradients_are_those_of_the_computed_numbers(scheme: Scheme):
    check(solver=scheme.solver)


def energy(t, y, args):
    q, p = y
    return jnp.sum(p**2) / 2 + pendulum(t, q, args)


TS = jnp.array([0.0, 0.05, 0.05, 0.3, 0.71, 1.0])


@pytest.mark.variants(1)
@pytest.mark.parametrize(
    "saveat",
    [
        dict(t0=True, t1=True, steps=3),
        dict(ts=TS, steps=2, t1=True, t0=True),
        dict(t1=True, solver_state=True),
        dict(
            subs=[
                dfx.SubSaveAt(ts=TS, fn=energy),
                dict(steps=dfx.SubSaveAt(steps=4, t1=True)),
            ]
        ),
    ],
    ids=lambda saveat: "-".join(saveat),
)
def test_cotangents_of_all_that_is_saved(saveat):
    # Backwards in time.
    sign = -1

    def turn(x):
        return sign * x if eqx.is_array(x) else x

    # Between steps the loop of Diffrax interpolates: no test against that.
    options = dict(saveat=jtu.tree_map(turn, dfx.SaveAt(**saveat)))
    options |= dict(t1=sign * 1.0, dt0=sign * 0.25)
    ours = value_and_gradient(INPUTS, REVERSIBLE, options)
    assert_close(ours, value_and_gradient(INPUTS, FIXED_STEP, options), 1e-12)


@eqx.filter_jit
def _saving_steps(t0, t1, dt0, y0):
    dtype = y0[0].dtype
    term = separable(GAMMA.astype(dtype))
    saveat = dfx.SaveAt(t0=True, steps=True)
    stiffness = STIFFNESS.astype(dtype)
    return dfx.diffeqsolve(
        term, LEAPFROG, t0, t1, dt0, y0, stiffness, saveat=saveat, max_steps=32
    )


@pytest.mark.variants(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=lambda x: x.__name__)
@pytest.mark.parametrize(
    "t0, t1, dt0", [(0.0, 1.0, 0.1), (0.3, 7.8, 0.3), (-2.0, 5.0, 7.0)]
)
def test_steps_are_found_again_to_rounding(t0, t1, dt0, dtype):
    t0, t1, dt0 = (jnp.asarray(t, dtype) for t in (t0, t1, dt0))
    y0 = (jnp.ones(1, dtype), jnp.zeros(1, dtype))
    sol = _saving_steps(t0, t1, dt0, y0)
    n = int(sol.stats["num_steps"])
    with jax.numpy_dtype_promotion("standard"):  # as within `diffeqsolve`
        steps = Steps(dfx.ConstantStepSize(), t0, t1, dt0)
        times = steps.time(jnp.arange(n + 1))
        middle = (times[:-1] + times[1:]) / 2
    ulp = jnp.finfo(dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    assert sol.ts is not None and n > 0
    assert jnp.all(jnp.abs(sol.ts[: n + 1] - times) <= 2 * ulp)
    assert sol.ts[0] == times[0] and sol.ts[n] == times[n] and steps.total == n
    with jax.numpy_dtype_promotion("standard"):
        starts, inside = steps.locate(times)
        assert jnp.all(starts == jnp.arange(n + 1)) and not jnp.any(inside)
        between, inside = steps.locate(middle)
        assert jnp.all(between == jnp.arange(n)) and jnp.all(inside)


@pytest.mark.slow
def test_gradients_of_what_a_saved_function_closes_over():
    def gradient(adjoint):
        def loss(scale):
            fn = lambda t, y, args: scale * y[0] ** 2 * t
            return add_up(solve(INPUTS, adjoint, saveat=dfx.SaveAt(ts=TS, fn=fn)).ys)

        return jax.grad(loss)(jnp.asarray(np.float64(0.7)))

    assert_close(gradient(REVERSIBLE), gradient(FIXED_STEP), 1e-13)


class Bowl(eqx.Module):
    depth: jax.Array

    def __call__(self, q):
        return self.depth * q**2


def test_gradients_of_what_functions_of_the_term_close_over():
    """At any depth: in closures of closures, of defaults, of modules, of `args`."""

    def gradient(adjoint):
        def loss(x):
            a, b, c, d, e = x
            bowl = Bowl(a)
            inner = lambda q: jnp.sum(jax.vmap(bowl)(q))

            def potential(t, q, args, *, scale=b):
                return scale * inner(q) + args(q)

            hamiltonian = dps.MechanicalSystem(
                dps.QuadraticKinetic(), partial(potential, scale=d), lambda t: c * t
            )
            sol = dfx.diffeqsolve(
                hamiltonian,
                LEAPFROG,
                0.0,
                1.0,
                0.1,
                Y0,
                lambda q: e * jnp.sum(q**4),
                adjoint=adjoint,
            )
            return add_up(sol.ys)

        return jax.jit(jax.grad(loss))(jnp.array([1.0, 2.0, 0.3, 0.5, 0.1]))

    ours = gradient(REVERSIBLE)
    assert_close(ours, gradient(dfx.RecursiveCheckpointAdjoint()), 1e-13)
    assert jnp.all((ours != 0) == jnp.array([True, False, True, True, True]))


def test_saved_values_by_central_differences():
    """For one number of each kind of output, along one direction."""
    saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(ts=TS, steps=2), dfx.SubSaveAt(t1=True)])
    saveat = eqx.tree_at(lambda x: x.subs[1].fn, saveat, energy)

    @jax.jit
    def saved(e, i):
        inputs = jtu.tree_map(lambda x: x + e * jnp.cos(x), INPUTS)
        ys: Any = solve(inputs, REVERSIBLE, saveat=saveat).ys
        (q, p), energies = ys
        between, at_a_step, by_function = q[3, 0], p[5, 1], energies[0]
        return jnp.stack([between, at_a_step, by_function])[i]

    slope = jax.jit(jax.grad(saved))
    e, zero = jnp.asarray(np.float64(1e-5)), jnp.zeros(())
    for i in jnp.arange(3):
        difference = (saved(e, i) - saved(-e, i)) / (2 * e)
        assert_close(slope(zero, i), difference, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("made_jump", [None, True])
def test_a_solve_continued_from_another(made_jump):
    """The solver state is that of the first half, or recomputed after a jump."""

    def gradient(adjoint):
        def loss(y0):
            first = solve(
                (y0, GAMMA, STIFFNESS),
                adjoint,
                saveat=dfx.SaveAt(t1=True, solver_state=True),
            )
            y = jtu.tree_map(lambda x: (1.5 if made_jump else 1) * x[-1], first.ys)
            second = solve(
                (y, GAMMA, STIFFNESS),
                adjoint,
                t0=1.0,
                t1=2.0,
                solver_state=first.solver_state,
                made_jump=None if made_jump is None else jnp.asarray(made_jump),
            )
            return add_up(second.ys)

        return jax.jit(jax.grad(loss))(Y0)

    assert_close(gradient(REVERSIBLE), gradient(CHECKPOINTED), 1e-12)


def test_a_solver_state_of_another_solve():
    """The first step, by its force, is pulled back from its start."""

    def gradient(adjoint):
        loss = lambda force: add_up(solve(INPUTS, adjoint, solver_state=force).ys)
        return jax.grad(loss)(Y0[0])

    assert_close(gradient(REVERSIBLE), gradient(FIXED_STEP), 1e-13)


@pytest.mark.slow
def test_an_optimiser_of_optax():
    """Friction and stiffness are recovered by a typical training loop."""

    class Model(eqx.Module):
        gamma: jax.Array
        stiffness: jax.Array

        def __call__(self):
            inputs = (Y0, self.gamma, self.stiffness)
            return solve(inputs, REVERSIBLE, saveat=dfx.SaveAt(ts=TS)).ys

    data = Model(GAMMA, STIFFNESS)()
    optimiser = optax.adam(0.05)

    @eqx.filter_value_and_grad
    def loss(model):
        errors = jtu.tree_map(lambda x, y: jnp.sum((x - y) ** 2), model(), data)
        return sum(jtu.tree_leaves(errors))

    @eqx.filter_jit
    @jax.numpy_dtype_promotion("standard")  # Required by Optax.
    def update(model, state):
        value, gradient = loss(model)
        change, state = optimiser.update(gradient, state)
        return eqx.apply_updates(model, change), state, value

    model = Model(jnp.asarray(np.float64(0.1)), jnp.asarray(np.float64(1.0)))
    state = optimiser.init(eqx.filter(model, eqx.is_array))
    values = []
    for _ in range(200):
        model, state, value = update(model, state)
        values.append(float(value))
    assert values[-1] < 1e-6 * values[0]
    assert_close((model.gamma, model.stiffness), (GAMMA, STIFFNESS), 1e-2)


def test_without_max_steps():
    ours = value_and_gradient(INPUTS, REVERSIBLE, dict(max_steps=None))
    assert_close(ours, value_and_gradient(INPUTS, CHECKPOINTED, {}), 1e-12)


def undriven(t, q, args):
    return jnp.sum(1 - jnp.cos(q))


@eqx.filter_jit
def damping_gradient(adjoint, inputs):
    def loss(inputs):
        q0, gamma = inputs
        dtype = q0.dtype
        term = dps.MechanicalSystem(
            dps.QuadraticKinetic(), undriven, dps.ConstantDamping(gamma)
        )
        # Early states are saved, as the final state does not depend on the initial one.
        saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 20, dtype=dtype))
        t0, t1, dt0 = (jnp.asarray(t, dtype) for t in (0.0, 100.0, 1 / 16))
        y0 = q0, jnp.zeros_like(q0)
        options: dict[str, Any] = dict(adjoint=adjoint, saveat=saveat, max_steps=1600)
        sol = dfx.diffeqsolve(term, LEAPFROG, t0, t1, dt0, y0, **options)
        return sum(jnp.sum(y**2) for y in jtu.tree_leaves(sol.ys))

    return jax.grad(loss)(inputs)


def strongly_damped(adjoint, eta, dtype: Any = jnp.float64):
    """The gradient of a solve with `eta` e-folds of damping, hard to reverse."""
    inputs = jnp.array([1.0, 0.3], dtype), jnp.asarray(eta / 100, dtype)
    return damping_gradient(adjoint, inputs)


@pytest.mark.variants(1)
@pytest.mark.parametrize("eta", [10.0, 100.0, 1000.0])
def test_kept_states_make_up_for_what_damping_forgets(eta):
    exact = strongly_damped(FIXED_STEP, eta)
    assert_close(strongly_damped(REVERSIBLE, eta), exact, 1e-10)


def test_kept_states_in_single_precision():
    exact = strongly_damped(FIXED_STEP, 100.0)
    single = strongly_damped(REVERSIBLE, 100.0, jnp.float32)
    assert all(x.dtype == jnp.float32 for x in jtu.tree_leaves(single))
    assert_close(single, exact, 1e-4)


@pytest.mark.slow
def test_a_gradient_that_is_off_is_an_error():
    for checkpoints, eta in ((0, 100.0), (2, 1000.0)):
        adjoint = dps.FixedStepAdjoint(checkpoints=checkpoints)
        with pytest.raises(Exception, match="Keep more states"):
            jax.block_until_ready(strongly_damped(adjoint, eta))
    assert_close(
        strongly_damped(dps.FixedStepAdjoint(checkpoints=0), 1.0),
        strongly_damped(FIXED_STEP, 1.0),
        1e-11,
    )


def test_gradients_of_a_batch():
    batch = jtu.tree_map(lambda x: jnp.stack([x, 0.9 * x]), INPUTS)

    def gradient(inputs):
        return jax.grad(lambda x: add_up(solve(x, REVERSIBLE).ys))(inputs)

    together = jax.jit(jax.vmap(gradient))(batch)
    for i in range(2):
        alone = gradient(jtu.tree_map(lambda x, i=i: x[i], batch))
        assert_close(jtu.tree_map(lambda x, i=i: x[i], together), alone, 1e-13)


def test_second_derivatives_by_forward_over_reverse():
    def hessian_vector(adjoint):
        gradient = jax.grad(lambda x: add_up(solve(x, adjoint).ys) ** 2)
        return jax.jit(lambda x, v: jax.jvp(gradient, (x,), (v,))[1])(INPUTS, INPUTS)

    exact = hessian_vector(dfx.DirectAdjoint())
    assert_close(hessian_vector(REVERSIBLE), exact, 1e-11)


def controlled(controller: Any, event: Any = None):
    return solve(INPUTS, REVERSIBLE, stepsize_controller=controller, event=event)


@pytest.mark.parametrize(
    "wrong, what",
    [
        (lambda: solve(INPUTS, REVERSIBLE, dfx.Tsit5()), "Tsit5"),
        (lambda: solve(INPUTS, FIXED_STEP, dfx.Tsit5()), "FixedStepAdjoint.*Tsit5"),
        (lambda: solve(INPUTS, REVERSIBLE, dfx.HalfSolver(LEAPFROG)), "HalfSolver"),
        (
            lambda: controlled(
                dfx.ConstantStepSize(), dfx.Event(lambda t, y, args, **kwargs: t > 2)
            ),
            "events",
        ),
        (
            lambda: jax.grad(lambda t: add_up(solve(INPUTS, REVERSIBLE, t1=t).ys))(1.0),
            "times",
        ),
    ],
    ids=["solver", "other solver", "adaptive", "event", "time"],
)
def test_what_is_not_supported_names_what_is(wrong, what):
    with pytest.raises(ValueError, match=f"{what}.*RecursiveCheckpointAdjoint"):
        wrong()


def test_gradients_by_checkpoints_need_max_steps():
    with pytest.raises(ValueError, match="max_steps"):
        value_and_gradient(INPUTS, FIXED_STEP, dict(max_steps=None))
    value(INPUTS, FIXED_STEP, dict(max_steps=None))


@pytest.mark.parametrize("kwargs", [dict(checkpoints=-1), dict(tol=0.0)])
def test_bad_options(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        dps.FixedStepAdjoint(**kwargs)
    with pytest.raises(ValueError, match="checkpoints"):
        dps.FixedStepAdjoint(checkpoints=-1)


# Where functions may hold what is differentiated.


class _Callable:
    """Not a pytree."""

    def __init__(self, k):
        self.k = k

    def __call__(self, t, q, args):
        return self.k * jnp.sum(q**2) / 2


class _Key(enum.Enum):
    A = 1
    B = 2


def _cycle(k):
    ring: list = [k]
    ring.append(ring)
    return lambda t, q, args: ring[1][0] * jnp.sum(q**2) / 2


def _mutual_recursion(k):
    def even(n, x):
        return k * x if n == 0 else odd(n - 1, x)

    def odd(n, x):
        return even(n - 1, x)

    return lambda t, q, args: even(2, jnp.sum(q**2) / 2)


HOLDERS = {
    "closure": lambda k: lambda t, q, args: k * jnp.sum(q**2) / 2,
    "default": lambda k: lambda t, q, args, k=k: k * jnp.sum(q**2) / 2,
    "jit": lambda k: jax.jit(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "checkpoint": lambda k: jax.checkpoint(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "partial": lambda k: functools.partial(lambda k, t, q, a: k * jnp.sum(q**2) / 2, k),
    "nested": lambda k: jax.jit(
        jax.checkpoint(lambda t, q, args: k * jnp.sum(q**2) / 2)
    ),
    "object": _Callable,
    "method": lambda k: _Callable(k).__call__,
    "filter_jit": lambda k: eqx.filter_jit(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "enumeration": lambda k: (
        lambda t, q, args, k={_Key.A: k, _Key.B: "x"}: k[_Key.A] * jnp.sum(q**2) / 2
    ),
    "cycle": _cycle,
    "mutual recursion": _mutual_recursion,
}


def _held(k, holder, adjoint):
    hamiltonian = dps.MechanicalSystem(
        dps.QuadraticKinetic(), holder(k), dps.ConstantDamping(0.1)
    )
    y0 = (jnp.array([1.0]), jnp.array([0.0]))
    sol = dfx.diffeqsolve(
        hamiltonian, dps.PresymplecticLeapfrog(), *(0.0, 1.0, 0.1, y0), adjoint=adjoint
    )
    assert sol.ys is not None
    return jnp.sum(sol.ys[0])


_QUICK = "nested", "cycle", "mutual recursion"


@functools.cache
def _held_by_checkpoints():
    return jax.value_and_grad(_held)(1.3, HOLDERS["closure"], CHECKPOINTED)


@pytest.mark.parametrize(
    "holder",
    [
        pytest.param(holder, id=name, marks=() if name in _QUICK else pytest.mark.slow)
        for name, holder in HOLDERS.items()
    ],
)
def test_whatever_holds_an_array(holder):
    by_reversal = jax.value_and_grad(_held)(1.3, holder, REVERSIBLE)
    np.testing.assert_allclose(by_reversal, _held_by_checkpoints(), rtol=1e-13)


def test_a_checkpointed_potential_is_stepped():
    value = _held(1.3, HOLDERS["checkpoint"], REVERSIBLE)
    np.testing.assert_allclose(value, _held_by_checkpoints()[0], rtol=1e-14)


def test_the_last_saved_time_where_steps_are_short():
    # In a batch the last row computes a step too, which must not be one second long.
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: 1e18 * jnp.sum(q**4)
    )
    ts = jnp.linspace(0.0, 1e-8, 8)

    def saved(q):
        y0 = q[None], jnp.zeros(1)
        options = {"saveat": dfx.SaveAt(ts=ts), "adjoint": dps.FixedStepAdjoint()}
        solver = dps.BlanesMoanRKN4()
        sol = dfx.diffeqsolve(system, solver, 0.0, 1e-8, 1e-10, y0, **options)
        assert sol.ys is not None
        return jnp.sum(sol.ys[0])

    gradient = jax.vmap(jax.grad(saved))(jnp.array([0.5, 1.0]))
    assert jnp.all(jnp.isfinite(gradient))


# States of the last three rates cannot be recomputed between 8 of 1000 kept ones.
RATES = jnp.concatenate([jnp.linspace(0.0, 5.0, 61), jnp.array([1e3, 3e3, 1e4])])


def _damped(gamma, adjoint, throw=True):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: 1 - jnp.cos(q),
        dps.ConstantDamping(gamma),
    )
    sol = dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 2.0, 2e-3),
        (jnp.asarray(1.5), jnp.asarray(0.3)),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 2.0, 7)),
        adjoint=adjoint,
        max_steps=1000,
        throw=throw,
    )
    assert sol.ys is not None
    return jnp.sum(sol.ys[0] ** 2)


FEW = dps.FixedStepAdjoint(checkpoints=8)


def test_a_gradient_that_is_lost_is_that_of_one_member_of_a_batch():
    slopes = jax.jit(jax.vmap(jax.grad(lambda gamma: _damped(gamma, FEW))))(RATES)
    assert jnp.all(jnp.isnan(slopes[-3:]))
    alone = jax.jit(jax.grad(lambda gamma: _damped(gamma, FEW)))
    exact = jax.vmap(jax.grad(lambda gamma: _damped(gamma, FIXED_STEP)))(RATES)
    some = np.arange(0, 61, 12)
    np.testing.assert_allclose(slopes[some], [alone(x) for x in RATES[some]], rtol=1e-9)
    np.testing.assert_allclose(slopes[:-3], exact[:-3], rtol=1e-8)
    # Nothing is inverted between as many kept states as steps.
    every = dps.FixedStepAdjoint(checkpoints=999)
    kept = jax.grad(lambda gamma: _damped(gamma, every))(RATES[-1])
    np.testing.assert_allclose(kept, exact[-1], rtol=1e-12)


def test_a_gradient_that_is_lost_is_an_error_or_not_a_number():
    slope = lambda adjoint, **options: jax.grad(
        lambda gamma: _damped(gamma, adjoint, **options)
    )
    with pytest.raises(Exception, match="with an error beyond"):
        jax.block_until_ready(slope(FEW)(RATES[-1]))
    assert jnp.isnan(slope(FEW, throw=False)(RATES[-1]))
    never = dps.FixedStepAdjoint(checkpoints=8, throw=False)
    assert jnp.isnan(slope(never)(RATES[-1]))
    always = dps.FixedStepAdjoint(checkpoints=8, throw=True)
    with pytest.raises(Exception, match="with an error beyond"):
        jax.block_until_ready(jax.vmap(slope(always, throw=False))(RATES[-2:]))


def test_the_branch_of_a_batch_that_is_not_taken():
    """JAX differentiates it at zeros, of which no state can be recomputed."""

    def value(deep, k, adjoint):
        branch = lambda factor: lambda k: _held(factor * k, HOLDERS["closure"], adjoint)
        return jax.lax.cond(deep, branch(1.0), branch(2.0), k)

    slopes = jax.vmap(jax.grad(value, argnums=1), (0, None, None))
    both = slopes(jnp.array([True, False]), 1.3, REVERSIBLE)
    for deep, slope in zip((True, False), both, strict=True):
        exact = jax.grad(value, argnums=1)(deep, 1.3, CHECKPOINTED)
        np.testing.assert_allclose(slope, exact, rtol=1e-12)


def test_an_equation_of_one_member_that_has_no_solution():
    """The linear solve of the derivative of a root finder ends no other member."""
    newton = optx.Newton(rtol=1e-10, atol=1e-10)

    def loss(gamma):
        sol = dfx.diffeqsolve(
            dps.MechanicalSystem(
                dps.QuadraticKinetic(),
                lambda t, q, args: -jnp.cos(q),
                dps.ConstantDamping(gamma),
            ),
            *(dps.PresymplecticGauss(1, newton), 0.0, 1.0, 0.1),
            (jnp.asarray(1.5), jnp.asarray(0.0)),
            adjoint=REVERSIBLE,
            throw=False,
        )
        assert sol.ys is not None
        return jnp.sum(sol.ys[0])

    good, bad = jax.vmap(jax.grad(loss))(jnp.array([0.2, jnp.nan]))
    np.testing.assert_allclose(good, jax.grad(loss)(0.2), rtol=1e-9)
    assert jnp.isnan(bad)
