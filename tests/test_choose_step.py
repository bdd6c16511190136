# pyright: reportOptionalOperand=false, reportOptionalMemberAccess=false
"""`choose_step`: the tolerance is reached, by a step not much shorter than needed.

Errors are measured against `Dopri8`, which ends a step at each saved time, or SciPy.
"""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from choosing import choose, cosine, LONG, PENDULUM, RKN6, solve_of, system_of, Y0
from helpers import flat

import diffrax_presym as dps
from diffrax_presym._step_size._grid import intervals


REGULAR = jnp.linspace(0.0, 20.0, 41)
KNOTS, PUSH = np.array([0.0, 1.3, 4.0, 7.7, 10.0]), np.array([0.0, 2.0, -1.0, 1.5, 0.0])
IRREGULAR = jnp.sort(jax.random.uniform(jax.random.key(0), (30,), maxval=20.0))


# The problem, how it is solved, both tolerances, and how many times the error may be
# smaller: up to a factor of two in the step where that is a multiple of the spacing.
BACK, S6, DIRECT = (20.0, 0.0, Y0), dps.BlanesMoan6(), {"adjoint": dfx.DirectAdjoint()}
CASES = {
    "leapfrog": ((PENDULUM, dps.PresymplecticLeapfrog(), *LONG), {}, 1e-4, 1e-4, 3),
    "grid": ((PENDULUM, dps.Strang(), *LONG), {"ts": REGULAR}, 1e-4, 1e-4, 64),
    "between": ((PENDULUM, RKN6, *LONG), {"ts": REGULAR}, 1e-9, 1e-9, 3),
    "irregular": ((PENDULUM, RKN6, *LONG), {"ts": IRREGULAR}, 1e-7, 1e-9, 3),
    "backwards": ((PENDULUM, S6, *BACK), {"ts": REGULAR[::-1]}, 1e-6, 1e-8, 3),
    "Diffrax": ((PENDULUM, dfx.Tsit5(), *LONG), DIRECT, 1e-6, 1e-6, 3),
}


@pytest.mark.parametrize("name", CASES)
def test_the_tolerance_is_reached(name):
    (system, solver, t0, t1, y0), options, rtol, atol, within = CASES[name]
    solve = solve_of(system, solver, t0, t1, y0, **options)
    step = dps.choose_step(solve, t0, t1, rtol=rtol, atol=atol)
    assert step.dt0 == pytest.approx((t1 - t0) / step.steps, rel=1e-15)
    sol = solve(step.dt0)
    assert sol.stats["num_steps"] == step.steps
    precise = dfx.PIDController(rtol=1e-13, atol=1e-13)
    exact = dfx.diffeqsolve(
        *(system, dfx.Dopri8(), t0, t1, None, y0, options.get("args")),
        saveat=dfx.SaveAt(ts=sol.ts),
        stepsize_controller=dfx.ClipStepSizeController(precise, step_ts=sol.ts),
        max_steps=None,
    )
    x = flat(exact.ys)
    got = np.max(np.abs(flat(sol.ys) - x) / (atol + rtol * np.abs(x)))
    assert got == pytest.approx(step.error, rel=0.1)
    assert 1 / within <= got <= 1.05
    assert step.claimed_order == (None if name == "Diffrax" else solver.order(system))
    assert step.order > solver.order(system) - 0.7
    assert step.on_grid or name != "grid"
    if name == "grid":
        spacing = float((sol.ts[1] - sol.ts[0]) / step.dt0)
        ratio = max(spacing, 1 / spacing)
        assert ratio == pytest.approx(round(ratio), rel=1e-12)
    assert f"{step.steps} steps" in str(step)


@pytest.mark.variants(11)
@pytest.mark.parametrize(
    "ts, number",
    [
        (np.linspace(0, 10, 11), 10),
        (np.linspace(0, 10, 1002)[1:], 1001),
        (np.arange(0.5, 10.0), 20),
        (np.array([1.0, 2.0, 7.0]), 10),
        (np.array([10.0]), 1),
        (np.array([0.0]), 1),
        (np.array([2.0, 2.0, 5.0]), 10),
        (np.array([0.3, 7.7]), None),
        (np.array([1.0, np.pi]), None),
        (np.sort(np.random.default_rng(0).uniform(0, 10, 30)), None),
        (np.linspace(0, 10, 2001, dtype=np.float32), 2000),
    ],
)
def test_grids(ts, number):
    ends = np.array([0, 10], ts.dtype)
    assert intervals(ts, ends[0], ends[1]) == number
    assert intervals(ts[::-1], ends[0], ends[1]) == number
    shifted, start, end = ts + ts.dtype.type(3), *(ends + ts.dtype.type(3))
    assert intervals(shifted, start, end) == number


@pytest.mark.variants(6)
@pytest.mark.parametrize(
    "solver, tolerance", [(RKN6, 1e-3), (RKN6, 1e-8), (dps.Strang(), 1e-3)]
)
@pytest.mark.parametrize(
    "ts",
    [np.linspace(0, 20, 501), np.array([2.0, 4.0, 14.0]), np.arange(0.25, 20, 0.5)],
)
def test_no_other_step_tried_is_cheaper(ts, solver, tolerance):
    # A saved time inside of a step takes a step more, or a third if it is interpolated.
    def cost(n):
        ends = ts * n / 20.0
        inside = np.sum(np.abs(ends - np.round(ends)) > 1e-9)
        return n + inside * (1 if solver.order(None) == 2 else 1 / 3)

    solve = solve_of(PENDULUM, solver, *LONG, ts=jnp.asarray(ts))
    step = dps.choose_step(solve, 0.0, 20.0, rtol=tolerance, atol=tolerance)
    good = [trial for trial in step.trials if trial.error <= 1]
    assert step.smooth and cost(step.steps) == min(cost(x.steps) for x in good)
    if solver is not RKN6 and len(ts) > 500:
        # Of those that cost as much the one with the most steps is the most accurate.
        assert step.steps % 500 == 0
    exact = flat(solve(step.dt0 / 2).ys)
    got = np.max(np.abs(flat(solve(step.dt0).ys) - exact) / (1 + np.abs(exact)))
    assert got <= 1.05 * tolerance * max(step.error, 1e-3)


def test_steps_do_not_follow_the_phase_of_a_force():
    # With any divisor of 160 as the number of steps, the force is constant.
    phase = lambda t, q, args: -jnp.sum(q) * jnp.cos(2 * jnp.pi * 160 * t)
    problem = system_of(phase, 0.0), dps.PresymplecticLeapfrog("position"), 0.0, 1.0
    y0 = jnp.array([0.0]), jnp.array([1.0])
    step = choose(*problem, y0, 1e-6, ts=jnp.linspace(0.0, 1.0, 161))
    assert step.steps > 160


def test_steps_for_a_fast_force():
    fast = lambda t, q, args: jnp.sum(q**2) / 2 - 5 * jnp.sum(q) * jnp.cos(126 * t)
    problem = system_of(fast), RKN6, 0.0, 10.0, Y0
    step = choose(*problem, 1e-9)
    assert step.steps < 1000
    fine, found = (flat(solve_of(*problem)(h).ys) for h in (1e-3, step.dt0))
    assert np.max(np.abs(found - fine)) < 1e-8


def test_what_is_exact_takes_one_step():
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0.0 * q[0])
    step = choose(free, dps.Strang(), *LONG, 1e-6)
    assert step.steps == 1 and np.isnan(step.order)


def test_a_short_push_from_rest():
    # Solves with few steps miss it, and find no motion at all.
    def push(t):
        x = (t - 0.1935) / 0.03
        return jnp.where(jnp.abs(x) < 1, (1 - x**2) ** 4, 0.0)

    pushed = lambda t, q, args: jnp.sum(q**2) / 2 - push(t) * jnp.sum(q)
    problem = system_of(pushed, 0.0), dps.Strang(), 0.0, 2.0, (jnp.zeros(1),) * 2
    step = choose(*problem, 1e-4)
    sol = solve_of(*problem)(step.dt0)
    rhs = lambda t, y: np.array([y[1], float(push(t)) - y[0]])
    options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-14, "max_step": 0.01}
    exact = scipy.integrate.solve_ivp(rhs, (0, 2), np.zeros(2), "DOP853", **options)
    assert np.max(np.abs(flat(sol.ys) - exact.y[:, -1])) <= 1.05e-4


@pytest.mark.filterwarnings("ignore:invalid value")  # Diffrax fills integers with inf.
@pytest.mark.parametrize(
    "saved", [lambda q: jnp.round(50 * q).astype(int), lambda q: lax.complex(0 * q, q)]
)
def test_errors_of_integers_and_complex_values(saved):
    fn = lambda t, y, args: saved(y[0])
    problem = PENDULUM, RKN4, *LONG
    solve = solve_of(*problem, saveat=dfx.SaveAt(t1=True, fn=fn))
    step = dps.choose_step(solve, 0.0, 20.0, rtol=0.0, atol=1e-3)
    fine = solve_of(*problem)(step.dt0 / 3).ys[0]
    assert np.max(np.abs(solve(step.dt0).ys - saved(fine))) <= 1.05e-3


RKN4, GAUSS = dps.BlanesMoanRKN4(), dps.PresymplecticGauss(2)


@pytest.mark.parametrize(
    "solver, options", [(RKN4, {}), (RKN4, {"throw": True}), (GAUSS, {})]
)
def test_a_step_that_is_too_large_is_no_error(solver, options, caplog):
    stiff = system_of(lambda t, q, args: 1e3 * jnp.sum(q**4), 0.0)
    step = choose(stiff, solver, 0.0, 1.0, Y0, 1e-4, ts=REGULAR / 20, **options)
    assert any(np.isinf(trial.error) for trial in step.trials)
    assert step.error <= 1
    assert not caplog.records  # no traceback of a trial


def test_a_failure_after_a_success_is_no_error():
    # JAX then raises another exception.
    stiff = system_of(lambda t, q, args: 1e3 * jnp.sum(q**4), 0.0)

    @jax.jit
    def solve(dt0):
        options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None}
        return dfx.diffeqsolve(stiff, RKN4, 0.0, 1.0, dt0, Y0, **options)

    for _ in range(3):
        solve(0.001)
    step = dps.choose_step(solve, 0.0, 1.0, rtol=1e-4, atol=1e-4)
    assert any(np.isinf(trial.error) for trial in step.trials)


def test_an_error_of_the_users_own_is_raised():
    def solve(dt0):
        raise RuntimeError("no table")

    with pytest.raises(RuntimeError, match="no table"):
        dps.choose_step(solve, 0.0, 1.0, rtol=1e-3, atol=1e-3)


def test_single_precision():
    t0, t1, y0 = jax.tree.map(jnp.float32, (jnp.array(0.0), jnp.array(20.0), Y0))
    system = system_of(cosine, jnp.float32(0.1))
    assert choose(system, dps.Strang(), t0, t1, y0, 1e-3).error <= 1
    ts = jnp.linspace(t0, t1, 101)
    assert choose(system, RKN6, t0, t1, y0, 1e-3, ts=ts).steps < 60
    with pytest.raises(RuntimeError, match="in float32") as error:
        choose(system, RKN6, t0, t1, y0, 1e-8, ts=jnp.linspace(t0, t1, 81))
    instead = "`Compensated(solver)`", "'jax_enable_x64'"
    assert all(x in str(error.value) for x in instead)


@pytest.mark.variants(5)
@pytest.mark.parametrize(
    "potential, solver, tolerance, max_steps, message",
    [
        (cosine, dps.Strang(), 1e-9, 10**5, "needs about .*e[+]05, more than 1"),
        (cosine, dps.Strang(), 1e-6, 5000, "needs more than 5000 steps"),
        (cosine, dps.Strang(), 1e-3, 3, "too few steps"),
        # Infinite after a finite time.
        (lambda t, q, args: -jnp.sum(q**4), RKN6, 1e-3, 1000, "no finite solution"),
        # A force with jumps.
        (lambda t, q, args: jnp.sum(abs(q)), RKN6, 1e-12, 20000, "no regular conv"),
    ],
)
def test_tolerances_that_cannot_be_reached(
    potential, solver, tolerance, max_steps, message
):
    with pytest.raises(RuntimeError, match=message):
        choose(system_of(potential), solver, *LONG, tolerance, max_steps)


def test_a_solve_that_takes_too_few_steps():
    solve = solve_of(PENDULUM, RKN6, *LONG, max_steps=100)
    with pytest.raises(RuntimeError, match=r"than the solve takes.*Let the"):
        dps.choose_step(solve, 0.0, 20.0, rtol=1e-9, atol=1e-9)


def test_what_does_not_converge_ends_soon():
    # Chaotic: no two solves agree.
    chaotic = system_of(lambda t, q, args: cosine(t, q, args) * (1 + jnp.cos(t)), 0.0)
    trials = []
    solve = solve_of(chaotic, RKN6, 0.0, 1000.0, Y0)
    with pytest.raises(RuntimeError, match="no regular convergence with up to 32"):
        dps.choose_step(
            *(solve, 0.0, 1000.0), rtol=1e-3, atol=1e-3, on_trial=trials.append
        )
    assert 8 < len(trials) < 15 and trials[-1].steps < 20000


def test_a_step_near_the_limit_of_stability_has_a_note():
    fast = system_of(lambda t, q, args: q @ (jnp.array([1.0, 1e4]) * q) / 2, 0.0)
    solve = solve_of(fast, RKN6, 0.0, 20.0, (jnp.array([1.0, 1e-12]), jnp.zeros(2)))
    step = dps.choose_step(solve, 0.0, 20.0, rtol=1e-6, atol=1e-6)
    assert (
        "unstable, or miss an event: for other parameters" in str(step)
        and step.error < 0.1
    )


def test_trials_are_shown():
    trials, solve = [], solve_of(PENDULUM, RKN6, *LONG)
    options: Any = dict(rtol=1e-6, atol=1e-6, on_trial=trials.append)
    step = dps.choose_step(solve, 0.0, 20.0, **options)
    assert step.trials == tuple(trials)


def saves_steps(dt0):
    saveat = dfx.SaveAt(steps=True)
    return dfx.diffeqsolve(PENDULUM, RKN6, 0.0, 20.0, dt0, Y0, saveat=saveat)


def between(times):
    controller = lambda: dps.StepsBetween(times)
    return lambda h: solve_of(PENDULUM, RKN6, *LONG, stepsize_controller=controller())(
        h
    )


TWICE = jax.vmap(lambda h: solve_of(PENDULUM, RKN6, *LONG)(h), None, axis_size=2)


@pytest.mark.variants(18)
@pytest.mark.parametrize(
    "changes, message",
    [
        ({"rtol": 0.0, "atol": 0.0}, "needs a positive tolerance"),
        ({"rtol": -1.0}, "rtol=.* must be a number that is not negative, but got -1.0"),
        ({"atol": float("nan")}, "atol=.* but got nan"),
        ({"atol": "small"}, "atol=.* but got 'small'"),
        ({"max_steps": 0}, "max_steps=.* must be a positive integer, but got 0"),
        ({"first": -1.0}, "first=.* must be a positive number, but got -1.0"),
        ({"t0": 20.0, "t1": 0.0}, "`t0` and `t1` must be those"),
        ({"solve": lambda h: solve_of(PENDULUM, RKN6, *LONG)(0.1)}, "not use `dt0`"),
        ({"t1": 0.0}, "two different finite times"),
        ({"t1": 5.0}, "needs the times of the solve"),
        ({"t1": float("inf")}, "two different finite times"),
        ({"solve": lambda dt0: Y0}, "must return a `diffrax.Solution`"),
        ({"solve": 0.1}, "a function from a step to a solution, but got 0.1"),
        ({"solve": saves_steps}, "times that do not depend on the step"),
        ({"solve": between(np.zeros((2, 2)))}, r"a vector, but got the shape \(2, 2\)"),
        ({"solve": between([0.0, np.inf])}, r"StepsBetween\(times\)"),
        ({"solve": lambda dt0: between(KNOTS)(None)}, "needs the longest step"),
        ({"solve": TWICE}, "most difficult member"),
    ],
)
def test_bad_input(changes, message):
    given: Any = {"solve": solve_of(PENDULUM, RKN6, *LONG), "t0": 0.0, "t1": 20.0}
    given |= {"rtol": 1e-3, "atol": 1e-3} | changes
    with pytest.raises(ValueError, match=message):
        dps.choose_step(**given)


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_the_solve_is_traced_once_for_the_choice_and_its_use(jit):
    traced = []

    @jit
    def solve(dt0):
        traced.append(dt0)
        return solve_of(PENDULUM, RKN6, *LONG)(dt0)

    solve(dps.choose_step(solve, 0.0, 20.0, rtol=1e-4, atol=1e-4).dt0)
    assert len(traced) == 1


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, lambda f: jax.vmap(f)])
def test_traced_input(transform):
    def of_start(x):
        y0 = Y0[0] * x, Y0[1]
        return choose(PENDULUM, RKN6, 0.0, 20.0, y0, 1e-3).dt0

    of_time = lambda t1: choose(PENDULUM, RKN6, 0.0, t1, Y0, 1e-3).dt0
    of_tolerance = lambda x: choose(PENDULUM, RKN6, *LONG, x).dt0
    x = jnp.ones(2) if transform not in (jax.jit, jax.grad) else 1.0
    for f in (of_start, of_time, of_tolerance):
        with pytest.raises(ValueError, match=r"outside of `jax.jit`, `jax.grad`"):
            transform(f)(x)
