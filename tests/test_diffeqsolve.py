"""Behaviour in `diffeqsolve`, as for a built-in solver."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import pytest
from helpers import (
    ANY,
    assert_close,
    CARRIES,
    each,
    flat,
    harmonic,
    mixed_energy,
    oscillator,
    pendulum,
    Scheme,
    SCHEMES,
    step,
    substeps,
    WAYS,
)

import diffrax_presym as dps


def swing(t, q, args):
    """A pendulum with an oscillating pivot."""
    return args * (1 + 0.3 * jnp.sin(2 * t)) * jnp.sum(1 - jnp.cos(q))


KINETIC = dps.QuadraticKinetic(np.array([1.0, 2.0]))
SYSTEM = dps.MechanicalSystem(KINETIC, swing, dps.LogDamping(1.5))
TERM = SYSTEM
OSCILLATOR = oscillator()
Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.3, 0.6]))
ARGS = jnp.array(1.2)
STEP = 1 / 32


def of(*names):
    """Parametrise over single schemes that represent their families."""
    return each([scheme for scheme in SCHEMES if scheme.name in names])


@eqx.filter_jit
def start(term, solver, t0, y0, args=ARGS):
    return solver.init(term, t0, t0, y0, args)


@eqx.filter_jit
def run(term, solver, t0, t1, dt0, y0, solver_state, args=ARGS):
    saveat = dfx.SaveAt(t1=True, solver_state=True)
    return dfx.diffeqsolve(
        *(term, solver, t0, t1, dt0, y0, args),
        saveat=saveat,
        solver_state=solver_state,
        max_steps=128,
    )


def go(scheme, t0, t1, y0, solver_state=None):
    """The final state and the solver state of a solve."""
    t0, t1, dt0 = jnp.array(t0), jnp.array(t1), jnp.array(np.copysign(STEP, t1 - t0))
    if solver_state is None:
        solver_state = start(TERM, scheme.solver, t0, y0)
    sol = run(TERM, scheme.solver, t0, t1, dt0, y0, solver_state)
    return jtu.tree_map(lambda y: y[-1], sol.ys), sol.solver_state


@eqx.filter_jit
def march(term, solver, times, y0, args=ARGS):
    """The same steps in a hand-written loop."""

    def one(carry, span):
        y, state = carry
        y, _, _, state, _ = solver.step(term, *span, y, args, state, made_jump=False)
        return (y, state), y

    carry = y0, solver.init(term, times[0], times[1], y0, args)
    _, ys = jax.lax.scan(one, carry, (times[:-1], times[1:]))
    return jtu.tree_map(lambda y, ys: jnp.concatenate([y[None], ys]), y0, ys)


@pytest.fixture(scope="module")
def exact():
    """The solution at times 2 and 3, by another method."""
    controller = dfx.PIDController(rtol=1e-12, atol=1e-12)
    ts = jnp.array([2.0, 3.0])
    sol = dfx.diffeqsolve(
        *(TERM, dfx.Dopri8(), 1.0, 3.0, 0.1, Y0, ARGS),
        stepsize_controller=controller,
        saveat=dfx.SaveAt(ts=ts),
    )
    return lambda t: jtu.tree_map(lambda y: y[jnp.argmin(jnp.abs(ts - t))], sol.ys)


def accuracy(scheme):
    return {1: 5e-2, 2: 2e-3, 4: 1e-4}.get(scheme.order, 1e-6)


# Saving

TIMES = jnp.array([1.0, 1.0625, 1.125, 1.25, 1.28125, 1.5, 1.625])


def position(t, y, args):
    return t + y[0][0]


@each(CARRIES)
def test_saving_steps_ends_and_times(scheme: Scheme):
    saveat = dfx.SaveAt(
        subs={
            "t0": dfx.SubSaveAt(t0=True),
            "t1": dfx.SubSaveAt(t1=True),
            "steps": dfx.SubSaveAt(t0=True, steps=True),
            "every other": dfx.SubSaveAt(steps=2),
            "function": dfx.SubSaveAt(t0=True, steps=True, fn=position),
            "ts": dfx.SubSaveAt(ts=jnp.array([1.0, 1.125, 1.3, 1.625])),
        }
    )

    @eqx.filter_jit
    def saved(y0):
        return dfx.diffeqsolve(
            *(TERM, scheme.solver, 1.0, 1.625, None, y0, ARGS),
            saveat=saveat,
            stepsize_controller=dfx.StepTo(TIMES),
            max_steps=len(TIMES) - 1,
        )

    sol = saved(Y0)
    ts, ys = sol.ts, sol.ys
    assert ts is not None and ys is not None
    by_hand = march(TERM, scheme.solver, TIMES, Y0)
    at = lambda *i: jtu.tree_map(lambda y: y[jnp.array(i)], by_hand)

    np.testing.assert_array_equal(ts["steps"], TIMES)
    assert_close(ys["steps"], by_hand, 1e-14)
    np.testing.assert_array_equal(ts["every other"], TIMES[2::2])
    assert_close(ys["every other"], at(2, 4, 6), 1e-14)
    assert_close(ys["t0"], at(0), 0)
    assert_close(ys["t1"], at(-1), 1e-14)
    assert_close(ys["function"], TIMES + by_hand[0][:, 0], 1e-14)
    # Exact at the steps, and as accurate as the interpolation in between.
    at_steps = jtu.tree_map(lambda y: y[jnp.array([0, 1, 3])], ys["ts"])
    assert_close(at_steps, at(0, 2, 6), 1e-14)


@each(CARRIES)
def test_steps_by_a_constant_and_to_given_times_agree(scheme: Scheme, exact):
    y, _ = go(scheme, 1.0, 2.0, Y0)
    ts = jnp.linspace(1.0, 2.0, 33)
    sol = eqx.filter_jit(dfx.diffeqsolve)(
        *(TERM, scheme.solver, 1.0, 2.0, None, Y0, ARGS),
        stepsize_controller=dfx.StepTo(ts),
        max_steps=32,
    )
    assert_close(jtu.tree_map(lambda y: y[-1], sol.ys), y, 1e-14)
    assert_close(y, exact(2.0), accuracy(scheme))


@of("leapfrog_AB", "suzuki_yoshida_4", "tao")
def test_a_step_that_does_not_divide_the_span(scheme: Scheme, exact):
    sol = eqx.filter_jit(dfx.diffeqsolve)(
        *(TERM, scheme.solver, 1.0, 2.0, 0.03, Y0, ARGS),
        saveat=dfx.SaveAt(steps=True, t1=True),
        max_steps=64,
    )
    assert sol.ts is not None
    taken = np.isfinite(sol.ts)
    assert sol.ts[taken][-1] == 2.0
    last = jtu.tree_map(lambda y: y[taken][-1], sol.ys)
    assert_close(last, exact(2.0), accuracy(scheme))


# Continuing a solve


@each(WAYS)
def test_going_on_with_the_solver_state_is_one_solve_bit_for_bit(scheme: Scheme):
    y, state = go(scheme, 1.0, 3.0, Y0)
    halfway, carried = go(scheme, 1.0, 2.0, Y0)
    y_resumed, state_resumed = go(scheme, 2.0, 3.0, halfway, carried)
    assert_close(y_resumed, y, 0)
    assert_close(state_resumed, state, 0)


@each(kinds=("augmented",))
def test_the_copies_of_augmented_schemes_are_in_the_solver_state(scheme: Scheme):
    y, _ = go(scheme, 1.0, 3.0, Y0)
    halfway, _ = go(scheme, 1.0, 2.0, Y0)
    y_afresh, _ = go(scheme, 2.0, 3.0, halfway)
    difference = np.max(np.abs(flat(y_afresh) - flat(y)))
    assert 1e-9 < difference < 1e-2


def test_a_momentum_first_leapfrog_carries_the_force_at_the_end():
    solver = dps.PresymplecticLeapfrog()
    (q, p), carried = go(Scheme("", solver, 2, 1), 1.0, 2.0, Y0)
    assert_close(carried, SYSTEM.force(jnp.array(2.0), q, p, ARGS), 1e-14)


# Backwards in time


@each(symmetric=True)
def test_there_and_back(scheme: Scheme):
    y, state = go(scheme, 1.0, 2.0, Y0)
    if scheme.kind in ANY:
        # The copies are part of the state, and are reversed as well.
        y_back, _ = go(scheme, 2.0, 1.0, y, state)
    else:
        y_back, _ = go(scheme, 2.0, 1.0, y)
    assert_close(y_back, Y0, 1e-12)


def test_negative_times():
    # The same system with the time shifted by four.
    y, _ = go(SCHEMES[2], 1.0, 2.0, Y0)
    early = dps.MechanicalSystem(
        KINETIC, lambda t, q, args: swing(t + 4, q, args), dps.LogDamping(1.5, shift=4)
    )
    term = early
    sol = dfx.diffeqsolve(term, SCHEMES[2].solver, -3.0, -2.0, STEP, Y0, ARGS)
    assert_close(jtu.tree_map(lambda y: y[-1], sol.ys), y, 1e-13)


# Adaptive step sizes


def two_forces(t, q, args):
    """A force of 1 before time 0.4, and of -2 afterwards."""
    return -jnp.where(t < 0.4, 1.0, -2.0) * jnp.sum(q)


FALL = dps.MechanicalSystem(dps.QuadraticKinetic(), two_forces)
# The stages of a triple jump lie outside the step, on the other side of the jump.
WITHIN = [
    scheme
    for scheme in SCHEMES
    if not (scheme.name.startswith("suzuki_yoshida") or scheme.name == "tao_4")
]


@each(
    [scheme for scheme in WITHIN if scheme.order > 1],
    kinds=("frozen", "split", "quadratic"),
)
def test_jumps_of_the_force(scheme: Scheme):
    # These schemes are exact for a constant force, so the only possible error is that
    # of a force that is reused across the jump.
    controller = dfx.ClipStepSizeController(
        dfx.PIDController(rtol=1e-3, atol=1e-3), jump_ts=jnp.array([0.4])
    )
    q0, p0 = jnp.array([1.0]), jnp.array([0.5])

    @eqx.filter_jit
    def fall(y0):
        return dfx.diffeqsolve(
            *(FALL, dfx.HalfSolver(scheme.solver), 0.0, 1.0, 0.25, y0),
            stepsize_controller=controller,
        )

    ys = fall((q0, p0)).ys
    assert ys is not None
    p_jump = p0 + 0.4
    q_jump = q0 + 0.4 * p0 + 0.4**2 / 2
    expected = q_jump + 0.6 * p_jump - 0.6**2, p_jump - 2 * 0.6
    assert_close(jtu.tree_map(lambda y: y[-1], ys), expected, 1e-12)


# States of several structures


@pytest.mark.slow
@pytest.mark.parametrize(
    "q0, p0",
    [(1.0, 0.5), (1, 2), (np.float64(1.0), 2), (jnp.array(1), jnp.array(0.5))],
    ids=["floats", "integers", "mixed", "arrays"],
)
@of("suzuki_yoshida_4", "tao")
def test_numbers_are_states_too(scheme: Scheme, q0, p0):
    solve = lambda y0: dfx.diffeqsolve(OSCILLATOR, scheme.solver, 0, 1, 0.25, y0).ys
    ys = solve((q0, p0))
    assert ys is not None
    q, p = ys
    assert q.shape == p.shape == (1,)
    assert q.dtype == p.dtype == jnp.float64
    as_arrays = jnp.array(q0, float), jnp.array(p0, float)
    assert_close(ys, solve(as_arrays), 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@each(CARRIES)
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


# Termination


@pytest.mark.variants(1)
@each(CARRIES)
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
    assert_close(state, start(TERM, scheme.solver, t0, Y0), 1e-15)
    assert_close(dense, Y0, 0)


@pytest.mark.variants(1)
@of("leapfrog_AB", "tao_4")
def test_too_few_steps(scheme: Scheme):
    def short(throw):
        return dfx.diffeqsolve(
            *(TERM, scheme.solver, 1.0, 2.0, 0.125, Y0, ARGS),
            max_steps=4,
            throw=throw,
            saveat=dfx.SaveAt(steps=True),
        )

    sol = short(throw=False)
    assert sol.result == dfx.RESULTS.max_steps_reached
    times = jnp.array([1.0, 1.125, 1.25, 1.375, 1.5])
    by_hand = march(TERM, scheme.solver, times, Y0)
    assert_close(sol.ys, jtu.tree_map(lambda y: y[1:], by_hand), 1e-14)
    with pytest.raises(RuntimeError, match="maximum number of solver steps"):
        short(throw=True)


# The same term in other solvers


OTHERS = {
    "Tsit5": (dfx.Tsit5(), True, 1e-6),
    "Dopri8": (dfx.Dopri8(), True, 1e-6),
    "Kvaerno5": (dfx.Kvaerno5(), True, 1e-6),
    "ImplicitEuler": (dfx.ImplicitEuler(optx.Newton(1e-8, 1e-8)), False, 5e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize("solver, adapts, tolerance", OTHERS.values(), ids=OTHERS)
def test_the_term_in_other_solvers(solver, adapts, tolerance):
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8)
    sol = dfx.diffeqsolve(
        *(TERM, solver, 1.0, 2.0, 1 / 512, Y0, ARGS),
        stepsize_controller=controller if adapts else dfx.ConstantStepSize(),
    )
    y, _ = go(Scheme("", dps.SofroniouSpaletta(8), 8, 21), 1.0, 2.0, Y0)
    assert_close(jtu.tree_map(lambda y: y[-1], sol.ys), y, tolerance)


def test_semi_implicit_euler_is_presymplectic_euler_without_damping():
    hamiltonian = dps.MechanicalSystem(KINETIC, pendulum)
    velocity = dfx.ODETerm(lambda t, p, args: KINETIC.velocity(jnp.asarray(t), p))
    force = dfx.ODETerm(lambda t, q, args: -jnp.sin(q))
    span = (0.0, 1.0, 0.125, Y0)
    theirs = dfx.diffeqsolve((velocity, force), dfx.SemiImplicitEuler(), *span)
    # Diffrax's solver first updates the first of its pair: position first.
    solver = dps.PresymplecticEuler("position")
    ours = dfx.diffeqsolve(hamiltonian, solver, *span)
    assert_close(ours.ys, theirs.ys, 1e-14)


# Nested schemes


def test_compositions_nest():
    leapfrog = dps.PresymplecticLeapfrog()
    inner, outer = (0.7, -0.4, 0.7), (0.3, 0.4, 0.3)
    times = jnp.array([1.0, 1.25, 1.5])
    product = [a * b for b in outer for a in inner]
    flat = march(TERM, dps.Composition(leapfrog, product), times, Y0)
    nested = dps.Composition(dps.Composition(leapfrog, inner), outer)
    assert_close(march(TERM, nested, times, Y0), flat, 1e-14)
    within = dps.Composition(substeps(leapfrog, 2), outer)
    doubled = [w / 2 for w in outer for _ in range(2)]
    flat = march(TERM, dps.Composition(leapfrog, doubled), times, Y0)
    assert_close(march(TERM, within, times, Y0), flat, 1e-14)


# Implicit schemes

MIXED = dps.Hamiltonian(mixed_energy, dps.ConstantDamping(0.2))


# With p' = 1 + p^2 the midpoint rule has no real solution for the step below.
HOPELESS = dps.Hamiltonian(lambda t, q, p, args: -jnp.sum(q * (1 + p**2)))


def test_an_implicit_step_without_a_solution_is_a_result():
    finder = optx.Newton(rtol=1e-12, atol=1e-12)
    solver = dps.PresymplecticGauss(1, finder)
    y0 = (jnp.array([1.0]), jnp.array([1.0]))
    sol = dfx.diffeqsolve(*(HOPELESS, solver, 0.0, 4.0, 1.0, y0), throw=False)
    assert sol.result != dfx.RESULTS.successful
    assert sol.stats["num_steps"] == 1


# Progress, and compilation


@pytest.mark.parametrize("meter", [dfx.TextProgressMeter(), dfx.TqdmProgressMeter()])
@of("leapfrog_AB", "tao")
def test_progress_meters(scheme: Scheme, meter, capfd):
    sol = dfx.diffeqsolve(
        *(TERM, scheme.solver, 1.0, 2.0, 0.125, Y0, ARGS), progress_meter=meter
    )
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    out, err = capfd.readouterr()
    assert "100.00%" in out + err


@each(CARRIES)
def test_a_second_call_is_not_traced_again(scheme: Scheme):
    traced = []

    def potential(t, q, args):
        traced.append(q)
        return harmonic(t, q, args)

    @eqx.filter_jit
    def end(hamiltonian, solver, y0):
        term = hamiltonian
        return dfx.diffeqsolve(term, solver, 0.0, 1.0, 0.25, y0).ys

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


@each(WAYS)
def test_a_step_is_the_same_in_a_solve_and_alone(scheme: Scheme):
    t1 = 1.0 + STEP
    y, *_ = step(SYSTEM, scheme.solver, 1.0, t1, Y0, ARGS)
    solved, _ = go(scheme, 1.0, t1, Y0)
    assert_close(solved, y, 1e-15)


# Splittings, which are not covered by the tests above

SPLITTINGS = [
    Scheme("rkn_4", dps.BlanesMoanRKN4(), 4, 6, kind="quadratic"),  # state: a force
    Scheme("rkn_6", dps.BlanesMoanRKN6(), 6, 14, kind="quadratic"),  # state: none
]


# Adjoints


# A jump of a force that is not constant


def jolt(t, q, args):
    """A pendulum with a constant force that changes sign at time 1.4."""
    return args * jnp.sum(1 - jnp.cos(q)) + jnp.where(t < 1.4, -1.0, 2.0) * jnp.sum(q)


# Convergence only. `test_jumps_of_the_force` tests that the force is recomputed.
@pytest.mark.slow
@of("leapfrog_AB", "tao")
def test_a_clipped_solve_is_two_solves(scheme: Scheme):
    system = dps.MechanicalSystem(KINETIC, jolt, dps.LogDamping(1.5))

    @eqx.filter_jit
    def end(solver, t0, t1, y0, jump_ts, rtol):
        controller = dfx.PIDController(rtol=rtol, atol=rtol)
        sol = dfx.diffeqsolve(
            *(system, solver, t0, t1, 0.05, y0, ARGS),
            stepsize_controller=dfx.ClipStepSizeController(controller, jump_ts=jump_ts),
        )
        return jtu.tree_map(lambda y: y[-1], sol.ys), sol.stats["num_steps"]

    # The force is smooth on either side of the jump. The last step of the first part
    # ends just before the jump.
    before = jnp.nextafter(jnp.array(1.4), jnp.array(0.0))
    jump_ts, none = jnp.array([1.4]), jnp.array([9.0])
    reference, tight = dfx.Tsit5(), jnp.array(1e-10)
    y, _ = end(reference, jnp.array(1.0), before, Y0, none, tight)
    y, _ = end(reference, jnp.array(1.4), jnp.array(2.0), y, none, tight)
    solver = dfx.HalfSolver(scheme.solver)
    span = jnp.array(1.0), jnp.array(2.0), Y0
    errors = []
    for rtol in (1e-4, 1e-6):
        found, _ = end(solver, *span, jump_ts, jnp.array(rtol))
        errors.append(np.max(np.abs(flat(found) - flat(y))))
        assert errors[-1] < 20 * rtol
    assert errors[1] < errors[0] / 10
