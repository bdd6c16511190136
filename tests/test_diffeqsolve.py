"""Behaviour in `diffeqsolve`, as for a built-in solver."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from catalogue import each, PATHS, pick, Scheme, STATES
from helpers import assert_close, flat, harmonic

import diffrax_presym as dps


def swing(t, q, args):
    """A pendulum with an oscillating pivot."""
    return args * (1 + 0.3 * jnp.sin(2 * t)) * jnp.sum(1 - jnp.cos(q))


KINETIC = dps.QuadraticKinetic(np.array([1.0, 2.0]))
TERM = dps.MechanicalSystem(KINETIC, swing, dps.LogDamping(1.5))
Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.3, 0.6]))
ARGS = jnp.array(1.2)
COMPENSATED = Scheme("Compensated", lambda: dps.Compensated(dps.Suzuki4()), 4, None)


@eqx.filter_jit
def start(solver, t0, y0):
    return solver.init(TERM, t0, t0, y0, ARGS)


@eqx.filter_jit
def run(solver, t0, t1, dt0, y0, solver_state):
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    return dfx.diffeqsolve(
        *(TERM, solver, t0, t1, dt0, y0, ARGS),
        saveat=saveat,
        solver_state=solver_state,
        max_steps=128,
    )


def go(solver, t0, t1, y0, solver_state=None):
    """The final state and the solver state of a solve."""
    t0, t1, dt0 = jnp.array(t0), jnp.array(t1), jnp.array(1 / 32)
    if solver_state is None:
        solver_state = start(solver, t0, y0)
    sol = run(solver, t0, t1, dt0, y0, solver_state)
    return jtu.tree_map(lambda y: y[-1], sol.ys), sol.solver_state


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@each(STATES)
def test_precision_is_that_of_the_input(scheme: Scheme, dtype):
    saveat = dfx.SaveAt(
        t0=True, steps=True, ts=jnp.array([1.2], dtype), dense=True, solver_state=True
    )
    t0, t1, dt0 = (jnp.array(t, dtype) for t in (1.0, 2.0, 0.25))
    y0 = jtu.tree_map(lambda y: y.astype(dtype), Y0)

    def everything(y0):
        sol = dfx.diffeqsolve(
            *(TERM, scheme.solver, t0, t1, dt0, y0, ARGS.astype(dtype)),
            saveat=saveat,
            max_steps=4,
        )
        between = sol.evaluate(t0), sol.derivative(t0)
        return sol.ts, sol.ys, sol.solver_state, sol.interpolation, between

    shapes = eqx.filter_eval_shape(everything, y0)
    leaves = [x for x in jtu.tree_leaves(shapes) if hasattr(x, "dtype")]
    floats = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    assert len(floats) > 10 and set(floats) == {np.dtype(dtype)}


# Continuing a solve


@pytest.mark.variants(4)
@each([COMPENSATED, *PATHS])
def test_going_on_with_the_solver_state_is_one_solve_bit_for_bit(scheme: Scheme):
    y, state = go(scheme.solver, 1.0, 3.0, Y0)
    halfway, carried = go(scheme.solver, 1.0, 2.0, Y0)
    y_resumed, state_resumed = go(scheme.solver, 2.0, 3.0, halfway, carried)
    assert_close(y_resumed, y, 0)
    assert_close(state_resumed, state, 0)
    if "Tao" in scheme.name:
        # The copies are in the solver state.
        y_afresh, _ = go(scheme.solver, 2.0, 3.0, halfway)
        assert 1e-9 < np.max(np.abs(flat(y_afresh) - flat(y))) < 1e-2


def test_a_momentum_first_leapfrog_carries_the_force_at_the_end():
    (q, p), carried = go(dps.PresymplecticLeapfrog(), 1.0, 2.0, Y0)
    assert_close(carried, TERM.force(jnp.array(2.0), q, p, ARGS), 1e-14)


# Jumps


def two_forces(t, q, args):
    """A force of 1 before time 0.4, and of -2 afterwards."""
    return -jnp.where(t < 0.4, 1.0, -2.0) * jnp.sum(q)


@each(pick("leapfrog", "leapfrog, position first", "Suzuki4", "Strang", "TunedRKN6"))
def test_a_force_is_not_reused_across_a_jump(scheme: Scheme):
    # These schemes are exact for a constant force, and within the step.
    controller = dfx.ClipStepSizeController(
        dfx.PIDController(rtol=1e-3, atol=1e-3), jump_ts=jnp.array([0.4])
    )
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), two_forces)
    q0, p0 = jnp.array([1.0]), jnp.array([0.5])
    ys = eqx.filter_jit(dfx.diffeqsolve)(
        *(system, dfx.HalfSolver(scheme.solver), 0.0, 1.0, 0.25, (q0, p0)),
        stepsize_controller=controller,
    ).ys
    p_jump = p0 + 0.4
    q_jump = q0 + 0.4 * p0 + 0.4**2 / 2
    expected = q_jump + 0.6 * p_jump - 0.6**2, p_jump - 2 * 0.6
    assert_close(jtu.tree_map(lambda y: y[-1], ys), expected, 1e-12)


# Termination


@pytest.mark.variants(1)
@each(STATES)
def test_an_empty_span_is_its_start(scheme: Scheme):
    saveat = dfx.SaveAt(
        t0=True, t1=True, ts=jnp.array([1.0, 1.0]), dense=True, solver_state=True
    )

    @eqx.filter_jit
    def empty(t0, t1, y0):
        sol = dfx.diffeqsolve(
            *(TERM, scheme.solver, t0, t1, 0.25, y0, ARGS), saveat=saveat, max_steps=4
        )
        return sol.ys, sol.solver_state, sol.evaluate(t0)

    t0 = jnp.array(1.0)
    ys, state, dense = empty(t0, t0, Y0)
    assert_close(ys, jtu.tree_map(lambda y: jnp.stack([y] * 4), Y0), 0)
    assert_close(state, start(scheme.solver, t0, Y0), 1e-15)
    assert_close(dense, Y0, 0)


# Progress, and compilation


@pytest.mark.parametrize("meter", [dfx.TextProgressMeter(), dfx.TqdmProgressMeter()])
@each(pick("leapfrog", "Tao"))
def test_progress_meters(scheme: Scheme, meter, capfd):
    sol = dfx.diffeqsolve(
        *(TERM, scheme.solver, 1.0, 2.0, 0.125, Y0, ARGS), progress_meter=meter
    )
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    out, err = capfd.readouterr()
    assert "100.00%" in out + err


@each(STATES)
def test_a_second_call_is_not_traced_again(scheme: Scheme):
    traced = []

    def potential(t, q, args):
        traced.append(q)
        return harmonic(t, q, args)

    @eqx.filter_jit
    def end(system, solver, y0):
        return dfx.diffeqsolve(system, solver, 0.0, 1.0, 0.25, y0).ys

    def system(gamma, mass):
        kinetic = dps.QuadraticKinetic(jnp.array(mass))
        damping = dps.ConstantDamping(jnp.array(gamma))
        return dps.MechanicalSystem(kinetic, potential, damping)

    end(system(0.1, 1.0), scheme.solver, Y0)
    times = len(traced)
    assert times > 0
    # Another Hamiltonian of the same structure, and a copy of the solver.
    end(system(0.2, 2.0), jtu.tree_map(lambda x: x, scheme.solver), Y0)
    assert len(traced) == times
