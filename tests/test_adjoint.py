"""Gradients by running the scheme backwards, against all other ways to get them."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from helpers import assert_close, each, IMPLICIT, mixed_energy, Scheme, SCHEMES

import diffrax_presym as dps


REVERSIBLE = dps.ReversibleAdjoint()
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
    return dps.ConformalHamiltonian(dps.QuadraticKinetic(), pendulum, damping)


def nonseparable(gamma):
    return dps.ConformalHamiltonian(energy=mixed, damping=dps.ConstantDamping(gamma))


def add_up(tree):
    """One number that every entry saved has a part of; what was not saved is left."""

    def leaf(x):
        weights = jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)
        return jnp.sum(jnp.where(jnp.isfinite(x), x, 0) * weights)

    return sum(jtu.tree_leaves(jtu.tree_map(leaf, tree)), jnp.zeros(()))


def solve(inputs, adjoint, solver: Any = LEAPFROG, system=separable, **kwargs):
    y0, gamma, stiffness = inputs
    times: dict[str, Any] = dict(t0=0.0, t1=1.0, dt0=0.1, max_steps=64)
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(system(gamma)),
        solver,
        y0=y0,
        args=stiffness,
        adjoint=adjoint,
        **(times | kwargs),
    )


@eqx.filter_jit
@eqx.filter_value_and_grad
def value_and_gradient(inputs, adjoint, kwargs):
    sol = solve(inputs, adjoint, **kwargs)
    # Of what is not asked for, a solution has `None`.
    dense = None if sol.interpolation is None else sol.evaluate(0.37 * sol.t1)
    return add_up((sol.ys, sol.solver_state, dense))


def check(inputs=INPUTS, adjoint=REVERSIBLE, tolerance=1e-12, **kwargs):
    ours = value_and_gradient(inputs, adjoint, kwargs)
    assert_close(ours, value_and_gradient(inputs, CHECKPOINTED, kwargs), tolerance)
    assert all(np.all(x != 0) for x in jtu.tree_leaves(ours[1]))


def named(schemes, *names):
    return [scheme for scheme in schemes if scheme.name in names]


# Compiling a gradient takes seconds, so one scheme stands for all that work alike.


@each(named(SCHEMES, "euler_A", "leapfrog_BA", "suzuki_yoshida_4", "tao"))
def test_gradients_are_those_of_the_computed_numbers(scheme: Scheme):
    check(solver=scheme.solver)


@each(named(IMPLICIT, "euler_B"))
def test_implicit_schemes_reverse_too(scheme: Scheme):
    check(solver=scheme.solver, system=nonseparable, t1=0.5, tolerance=1e-9)


@pytest.mark.parametrize(
    "solver",
    [
        dps.BlanesMoanRKN4(),
        dps.BlanesMoan4(),
        dps.Substeps(dps.PresymplecticEuler(), 3),
        dps.Splitting(dps.SplittingTableau(1, True, False, (0.3, 1.0, 0.7))),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_splittings_and_asymmetric_compositions(solver):
    check(solver=solver)


def energy(t, y, args):
    q, p = y
    return {"energy": jnp.sum(p**2) / 2 + pendulum(t, q, args), "count": q.size}


TS = jnp.array([0.0, 0.05, 0.05, 0.3, 0.71, 1.0])


@pytest.mark.parametrize(
    "saveat",
    [
        dict(t0=True, t1=True, steps=3),
        dict(ts=TS, steps=2, t1=True, t0=True),
        dict(dense=True, t1=True, solver_state=True),
        dict(
            subs=[
                dfx.SubSaveAt(
                    ts=TS, fn=lambda t, y, args: energy(t, y, args)["energy"]
                ),
                dict(steps=dfx.SubSaveAt(steps=4, t1=True)),
            ]
        ),
    ],
    ids=lambda saveat: "-".join(saveat),
)
def test_cotangents_of_all_that_is_saved(saveat):
    # Backwards in time, and `dt0` does not divide the span: the last steps are shorter.
    sign = -1

    def turn(x):
        return sign * x if eqx.is_array(x) else x

    saveat = jtu.tree_map(turn, dfx.SaveAt(**saveat))
    check(saveat=saveat, t1=sign * 1.0, dt0=sign * 0.3)


def test_step_to_and_splitting_dense_output():
    ts = jnp.array([0.0, 0.1, 0.3, 0.35, 1.0])
    kwargs: dict[str, Any] = dict(dt0=None, stepsize_controller=dfx.StepTo(ts))
    check(saveat=dfx.SaveAt(ts=TS), solver=dps.BlanesMoanRKN6(), **kwargs)


def test_without_max_steps():
    ours = value_and_gradient(INPUTS, REVERSIBLE, dict(max_steps=None))
    assert_close(ours, value_and_gradient(INPUTS, CHECKPOINTED, {}), 1e-12)


def undriven(t, q, args):
    return jnp.sum(1 - jnp.cos(q))


def strongly_damped(adjoint, eta, dtype: Any = jnp.float64):
    """The gradient of a solve that damps by `eta` e-folds, a trap for reversal."""

    @jax.jit
    @jax.grad
    def gradient(inputs):
        q0, gamma = inputs
        term = dps.HamiltonianTerm(
            dps.ConformalHamiltonian(
                dps.QuadraticKinetic(), undriven, dps.ConstantDamping(gamma)
            )
        )
        # Every step counts: what is left at the end has forgotten the start.
        saveat = dfx.SaveAt(ts=jnp.linspace(0.0, 4.0, 20, dtype=dtype))
        t0, t1, dt0 = (jnp.asarray(t, dtype) for t in (0.0, 100.0, 1 / 16))
        y0 = q0, jnp.zeros_like(q0)
        options: dict[str, Any] = dict(adjoint=adjoint, saveat=saveat, max_steps=1600)
        sol = dfx.diffeqsolve(term, LEAPFROG, t0, t1, dt0, y0, **options)
        return sum(jnp.sum(y**2) for y in jtu.tree_leaves(sol.ys))

    return gradient((jnp.array([1.0, 0.3], dtype), jnp.asarray(eta / 100, dtype)))


@pytest.mark.parametrize("eta", [10.0, 100.0, 1000.0])
def test_kept_states_make_up_for_what_damping_forgets(eta):
    exact = strongly_damped(CHECKPOINTED, eta)
    assert_close(strongly_damped(REVERSIBLE, eta), exact, 1e-10)


def test_kept_states_in_single_precision():
    exact = strongly_damped(CHECKPOINTED, 100.0)
    single = strongly_damped(REVERSIBLE, 100.0, jnp.float32)
    assert all(x.dtype == jnp.float32 for x in jtu.tree_leaves(single))
    assert_close(single, exact, 1e-4)


def test_a_gradient_that_is_off_is_an_error():
    for checkpoints, eta in ((0, 100.0), (2, 1000.0)):
        adjoint = dps.ReversibleAdjoint(checkpoints=checkpoints)
        with pytest.raises(Exception, match="Keep more states"):
            jax.block_until_ready(strongly_damped(adjoint, eta))
    assert_close(
        strongly_damped(dps.ReversibleAdjoint(checkpoints=0), 1.0),
        strongly_damped(CHECKPOINTED, 1.0),
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
        (
            lambda: solve(INPUTS, REVERSIBLE, dps.PresymplecticProjected()),
            "PresymplecticProjected",
        ),
        (
            lambda: solve(INPUTS, REVERSIBLE, dfx.HalfSolver(LEAPFROG)),
            "HalfSolver",
        ),
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
    ids=["solver", "projected", "adaptive", "event", "time"],
)
def test_what_is_not_supported_names_what_is(wrong, what):
    with pytest.raises(ValueError, match=f"{what}.*RecursiveCheckpointAdjoint"):
        wrong()


@pytest.mark.parametrize("kwargs", [dict(checkpoints=-1), dict(tol=0.0)])
def test_bad_options(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        dps.ReversibleAdjoint(**kwargs)
