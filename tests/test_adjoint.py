"""Gradients by running the scheme backwards, against other methods. Those of every
scheme, friction and way to run are compared with differences by `test_pairs.py`."""

import re
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from catalogue import each, pick, Scheme
from helpers import assert_close

import diffrax_presym as dps
from diffrax_presym._loop._one_function import as_one_function


REVERSIBLE = dps.FixedStepAdjoint()
FIXED_STEP = dps.FixedStepAdjoint("checkpoints")
CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()
LEAPFROG = dps.PresymplecticLeapfrog()
Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.0, 0.3]))
GAMMA, STIFFNESS = jnp.asarray(np.float64(0.3)), jnp.asarray(np.float64(1.3))
INPUTS = (Y0, GAMMA, STIFFNESS)


def pendulum(t, q, args):
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.sin(t) * q[0]


def separable(gamma, potential=pendulum):
    damping = dps.ConstantDamping(gamma)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)


def add_up(tree):
    """A scalar that depends on every saved entry; unused entries are ignored."""

    def leaf(x):
        weights = jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)
        return jnp.sum(jnp.where(jnp.isfinite(x), x, 0) * weights)

    return sum(jtu.tree_leaves(jtu.tree_map(leaf, tree)), jnp.zeros(()))


def solve(inputs, adjoint, solver: Any = LEAPFROG, **options) -> Any:
    y0, gamma, stiffness = inputs
    times: dict[str, Any] = dict(t0=0.0, t1=1.0, dt0=0.1, max_steps=64)
    return dfx.diffeqsolve(
        separable(gamma),
        solver,
        y0=y0,
        args=stiffness,
        adjoint=adjoint,
        **(times | options),
    )


def value(inputs, adjoint, options):
    sol = solve(inputs, adjoint, **options)
    return add_up((sol.ys, sol.solver_state))


value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(value))


def differences(fn, x, h=1e-5):
    return (fn(x + h) - fn(x - h)) / (2 * h)


@each(pick("Euler", "leapfrog, position first", "Suzuki-Yoshida 4", "Tao"))
def test_gradients_are_those_of_the_computed_numbers(scheme: Scheme):
    options = dict(solver=scheme.solver)
    exact = value_and_gradient(INPUTS, CHECKPOINTED, options)
    assert all(np.all(x != 0) for x in jtu.tree_leaves(exact[1]))
    for adjoint in (REVERSIBLE, FIXED_STEP):
        assert_close(value_and_gradient(INPUTS, adjoint, options), exact, 1e-12)


TS = jnp.array([0.0, 0.05, 0.05, 0.3, 0.71, 1.0])


@pytest.mark.slow
def test_gradients_of_what_a_saved_function_closes_over():
    def gradient(adjoint):
        def loss(scale):
            fn = lambda t, y, args: scale * y[0] ** 2 * t
            return add_up(solve(INPUTS, adjoint, saveat=dfx.SaveAt(ts=TS, fn=fn)).ys)

        return jax.grad(loss)(jnp.asarray(np.float64(0.7)))

    assert_close(gradient(REVERSIBLE), gradient(FIXED_STEP), 1e-13)


def test_gradients_of_rows_that_are_not_reached():
    def loss(x):
        q0 = Y0[0] + x
        fn = lambda t, y, args: jnp.linalg.norm(y[0] - q0)
        inputs, saveat = ((q0, Y0[1]), GAMMA, STIFFNESS), dfx.SaveAt(steps=True, fn=fn)
        return jnp.sum(solve(inputs, REVERSIBLE, saveat=saveat).ys[:10])

    np.testing.assert_allclose(jax.grad(loss)(0.2), differences(loss, 0.2), 1e-7)


def test_gradients_of_a_force_that_ends_with_the_solve():
    def loss(k):
        force = dps.ForceField(lambda t, q, args: -k * q * jnp.sqrt(1 - t))
        system = dps.MechanicalSystem(dps.QuadraticKinetic(), force)
        saveat = dfx.SaveAt(ts=jnp.array([0.35, 1.0]))
        args = system, LEAPFROG, 0.0, 1.0, 0.1, Y0
        return add_up(dfx.diffeqsolve(*args, saveat=saveat, adjoint=REVERSIBLE).ys)

    np.testing.assert_allclose(jax.grad(loss)(1.3), differences(loss, 1.3), 1e-7)


def test_the_gradient_at_rest_at_the_origin():
    def loss(y0):
        potential = lambda t, q, args: jnp.sum(1 - jnp.cos(q))
        args = separable(GAMMA, potential), dps.TunedRKN6(), 0.0, 1.0, 0.1, y0
        return add_up(dfx.diffeqsolve(*args, adjoint=REVERSIBLE).ys)

    rest, near = (jax.tree.map(lambda x, s=s: s * x, Y0) for s in (0.0, 1e-9))
    assert_close(jax.grad(loss)(rest), jax.grad(loss)(near), 1e-12)


@pytest.mark.slow
def test_a_solve_continued_after_a_jump():
    """The solver state is recomputed. Without a jump the catalogue has it."""

    def gradient(adjoint):
        def loss(y0):
            saveat = dfx.SaveAt(t1=True, solver_state=True)
            first = solve((y0, GAMMA, STIFFNESS), adjoint, saveat=saveat)
            options = {"t0": 1.0, "t1": 2.0, "solver_state": first.solver_state}
            y = jtu.tree_map(lambda x: 1.5 * x[-1], first.ys)
            inputs, jump = (y, GAMMA, STIFFNESS), jnp.asarray(True)
            return add_up(solve(inputs, adjoint, made_jump=jump, **options).ys)

        return jax.jit(jax.grad(loss))(Y0)

    assert_close(gradient(REVERSIBLE), gradient(CHECKPOINTED), 1e-12)


def test_a_solver_state_of_another_solve():
    """The first step, by its force, is pulled back from its start."""

    def gradient(adjoint):
        loss = lambda force: add_up(solve(INPUTS, adjoint, solver_state=force).ys)
        return jax.grad(loss)(Y0[0])

    assert_close(gradient(REVERSIBLE), gradient(FIXED_STEP), 1e-13)


def test_without_max_steps():
    ours = value_and_gradient(INPUTS, REVERSIBLE, dict(max_steps=None))
    assert_close(ours, value_and_gradient(INPUTS, CHECKPOINTED, {}), 1e-12)


@pytest.mark.parametrize("checkpoints", [None, 20])
def test_strong_friction_by_place_keeps_as_many_states_as_there_are(checkpoints):
    def loss(strength, adjoint):
        rate = lambda t, q, args: 30 * strength * jnp.exp(-(q**2))
        pendulum = lambda t, q, args: -jnp.sum(jnp.cos(q))
        law = dps.PositionDamping(rate)
        system = dps.MechanicalSystem(dps.QuadraticKinetic(), pendulum, law)
        start = jnp.array([1.5, -0.3]), jnp.array([0.2, 0.4])
        sol: Any = dfx.diffeqsolve(
            *(system, dps.BlanesMoan6(), 0.0, 4.0, 0.2, start),
            **{"adjoint": adjoint, "max_steps": 100},
        )
        return jnp.sum(sol.ys[0] ** 2)

    by = dps.FixedStepAdjoint(checkpoints=checkpoints)
    got, h = jax.jit(jax.grad(lambda x: loss(x, by)))(1.0), 1e-5
    difference = (loss(1 + h, by) - loss(1 - h, by)) / (2 * h)
    assert got == pytest.approx(float(difference), rel=1e-7)


def test_second_derivatives_by_forward_over_reverse():
    def hessian_vector(adjoint):
        gradient = jax.grad(lambda x: add_up(solve(x, adjoint).ys) ** 2)
        return jax.jit(lambda x, v: jax.jvp(gradient, (x,), (v,))[1])(INPUTS, INPUTS)

    exact = hessian_vector(dfx.DirectAdjoint())
    assert_close(hessian_vector(REVERSIBLE), exact, 1e-11)
    # Also of states that are not kept.
    none_kept = dps.FixedStepAdjoint("reversal", checkpoints=0)
    assert_close(hessian_vector(none_kept), exact, 1e-11)


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


def test_loop_of_one_iteration_stays_in_the_compiled_program():
    def solve(x):
        outputs = lambda: (jnp.sin(x), 3 * x, dfx.RESULTS.successful, "static")
        return as_one_function(outputs)

    *values, result, static = solve(jnp.arange(3.0))
    assert_close(tuple(values), (jnp.sin(jnp.arange(3.0)), 3 * jnp.arange(3.0)), 1e-15)
    assert result == dfx.RESULTS.successful and static == "static"
    program = jax.jit(lambda x: solve(x)[:2]).lower(jnp.arange(3.0)).compile()
    assert "while(" in str(program.as_text())
    batch = jax.vmap(lambda x: solve(x)[:2])(jnp.arange(6.0).reshape(2, 3))
    assert_close(batch[1], 3 * jnp.arange(6.0).reshape(2, 3), 1e-15)


@pytest.mark.parametrize(
    "options",
    [
        dict(),
        dict(solver=dps.SymmetricMultistep(8)),
        dict(stepsize_controller=dps.StepsBetween(jnp.array([0.31, 0.72]))),
        dict(
            dt0=None,
            stepsize_controller=dps.StepDensityController(0.1, separable(GAMMA)),
        ),
    ],
    ids=["equal steps", "multistep", "steps between", "variable steps"],
)
def test_no_operation_keeps_a_loop_from_being_one_function(options):
    # Those that XLA calls by themselves on a CPU.
    apart = re.compile(r' (scatter|sort|custom-call)\(.*op_name="[^"]*while/body')
    options = dict(solver=dps.TunedRKN6(), saveat=dfx.SaveAt(ts=TS)) | options
    gradient = jax.grad(lambda inputs: value(inputs, dps.FixedStepAdjoint(), options))
    text = str(jax.jit(gradient).lower(INPUTS).compile().as_text())
    assert "while" in text and apart.search(text) is None


@pytest.mark.parametrize("gradient", ["reversal", "checkpoints"])
@pytest.mark.parametrize("varies", [False, True])
def test_a_member_that_fails_at_its_start_adds_nothing(varies, gradient):
    """Neither its force there has derivatives, nor the length of its first step."""
    well = lambda t, q, args: -args / jnp.sqrt(jnp.sum(q**2))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), well)
    controller = dps.StepDensityController(0.2, system)
    options = dict(dt0=None, stepsize_controller=controller) if varies else {}

    def total(starts, strength):
        def one(start):
            sol: Any = dfx.diffeqsolve(
                *(system, dps.TunedRKN6(), 0.0, 4.0),
                y0=(jnp.stack([start, 0.0 * start]), jnp.array([0.0, 1.0])),
                args=strength,
                adjoint=dps.FixedStepAdjoint(gradient),
                throw=False,
                **{"dt0": 0.05, "max_steps": 100, **options},
            )
            good = sol.result == dfx.RESULTS.successful
            return jnp.sum(jnp.where(good, sol.ys[0], 0.0) ** 2), good

        squares, good = jax.vmap(one)(starts)
        return jnp.sum(squares), good

    slope = jax.jit(jax.grad(total, 1, has_aux=True))
    got, good = slope(jnp.array([1.0, 0.0, jnp.nan]), 1.0)
    assert good.tolist() == [True, False, False]
    wanted, _ = slope(jnp.ones(1), 1.0)
    assert got == pytest.approx(float(wanted), rel=1e-12)


@pytest.mark.parametrize("gradient", ["reversal", "checkpoints"])
def test_one_motion_seen_from_several_places(gradient):
    """A batch of what is saved alone, of one motion."""

    def total(stiffness, place):
        seen = dfx.SubSaveAt(ts=TS, fn=lambda t, y, args: y[0] - place)
        sol: Any = solve(
            (Y0, GAMMA, stiffness),
            dps.FixedStepAdjoint(gradient),
            saveat=dfx.SaveAt(subs=[seen, dfx.SubSaveAt(t1=True)]),
        )
        return jnp.sum(sol.ys[0] ** 2) + jnp.sum(sol.ys[1][0] ** 2)

    places, slope = jnp.arange(3.0), jax.grad(total)
    together = lambda x: jnp.sum(jax.vmap(total, (None, 0))(x, places))
    wanted = sum(slope(STIFFNESS, place) for place in places)
    assert_close(jax.grad(together)(STIFFNESS), wanted, 1e-12)
