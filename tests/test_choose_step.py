"""`choose_step`: the tolerance is reached, by a step not much shorter than needed.

Errors are measured here against `Dopri8` with a small tolerance, which ends a step at
each saved time.
"""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_presym as dps
from diffrax_presym._step_size._grid import intervals


def cosine(t, q, args):
    return -jnp.sum(jnp.cos(q))


def attraction(t, q, args):
    return -1 / jnp.linalg.norm(q)


def driven(t, q, args):
    x = q["x"]
    return jnp.sum(x**4) / 4 + args["strength"] * jnp.cos(1.3 * t) * jnp.sum(x)


def term_of(potential, damping=0.1):
    return dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(damping)
    )


PENDULUM = term_of(cosine)
SPRING = dps.MechanicalSystem(
    dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q**2) / 2
)
Y0 = jnp.array([2.0, 0.5]), jnp.array([0.0, 0.3])
ORBIT = jnp.array([0.7, 0.0]), jnp.array([0.0, 1.36])
FORCED = {"x": jnp.array([[1.0, 0.2]])}, {"x": jnp.array([[0.0, -0.5]])}
STRENGTH = {"strength": jnp.array(0.5)}
REGULAR = jnp.linspace(0.0, 20.0, 41)
IRREGULAR = jnp.sort(jax.random.uniform(jax.random.key(0), (30,), maxval=20.0))


def choose_step(
    system, solver, t0, t1, y0, *, ts=None, args=None, max_steps=1_000_000, **tolerances
) -> dps.ChosenStep:
    """The step for a problem that is saved at given times, or at its end."""
    saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts)

    @jax.jit
    def solve(dt0):
        return dfx.diffeqsolve(
            *(system, solver, t0, t1, dt0, y0, args),
            **{"saveat": saveat, "max_steps": None, "throw": False},
            adjoint=dps.FixedStepAdjoint(),
        )

    return dps.choose_step(solve, t0, t1, max_steps=max_steps, **tolerances)


def choose(*problem: Any, tolerance: float, **options: Any) -> dps.ChosenStep:
    return choose_step(*problem, rtol=tolerance, atol=tolerance, **options)


def exact(term, t0, t1, y0, ts, args=None):
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)
    return dfx.diffeqsolve(
        *(term, dfx.Dopri8(), t0, t1, None, y0, args),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.ClipStepSizeController(controller, step_ts=ts),
        max_steps=None,
    ).ys


def error_of(step, term, solver, t0, t1, y0, ts, args, rtol, atol):
    """The error over the tolerance of a solve with the step."""
    times = jnp.array([t1]) if ts is None else ts
    sol = dfx.diffeqsolve(
        *(term, solver, t0, t1, step.dt0, y0, args),
        saveat=dfx.SaveAt(ts=times),
        max_steps=step.steps,
    )
    assert sol.stats["num_steps"] == step.steps
    scaled = jax.tree.map(
        lambda y, x: (y - x) / (atol + rtol * abs(x)),
        sol.ys,
        exact(term, t0, t1, y0, times, args),
    )
    return float(jnp.max(jax.vmap(optx.rms_norm)(scaled)))


@pytest.mark.parametrize(
    "term, solver, t0, t1, y0, ts, args, rtol, atol, within",
    [
        (
            PENDULUM,
            dps.PresymplecticLeapfrog(),
            0.0,
            20.0,
            Y0,
            None,
            None,
            1e-4,
            1e-4,
            3,
        ),
        # Multiples of the spacing are up to a factor of two apart.
        (PENDULUM, dps.TunedRKN6(), 0.0, 20.0, Y0, REGULAR, None, 1e-9, 1e-9, 64),
        (PENDULUM, dps.TunedRKN6(), 0.0, 20.0, Y0, IRREGULAR, None, 1e-7, 1e-9, 3),
        (
            PENDULUM,
            dps.BlanesMoan6(),
            20.0,
            0.0,
            Y0,
            REGULAR[::-1],
            None,
            1e-4,
            1e-6,
            64,
        ),
        (
            term_of(attraction, 1e-3),
            dps.BlanesMoanRKN4(),
            1.0,
            16.0,
            ORBIT,
            None,
            None,
            1e-5,
            1e-7,
            3,
        ),
        (
            term_of(driven),
            dps.PresymplecticCoupled(4),
            2.0,
            7.0,
            FORCED,
            None,
            STRENGTH,
            0.0,
            1e-6,
            3,
        ),
    ],
    ids=["leapfrog", "grid", "irregular", "backwards", "orbit", "args"],
)
def test_the_tolerance_is_reached(
    term, solver, t0, t1, y0, ts, args, rtol, atol, within
):
    tolerances = {"rtol": rtol, "atol": atol}
    step = choose_step(term, solver, t0, t1, y0, ts=ts, args=args, **tolerances)
    assert step.dt0 == pytest.approx((t1 - t0) / step.steps, rel=1e-15)
    got = error_of(step, term, solver, t0, t1, y0, ts, args, **tolerances)
    assert got == pytest.approx(step.error, rel=0.1)
    assert 1 / within <= got <= 1.05
    assert step.claimed_order == solver.order(term)
    assert step.order > step.claimed_order - 0.7
    assert step.on_grid == (ts is not IRREGULAR)
    if step.on_grid:
        spacing = 1.0 if ts is None else float(ts[1] - ts[0]) / step.dt0
        assert max(spacing, 1 / spacing) == pytest.approx(
            round(max(spacing, 1 / spacing)), rel=1e-12
        )
    assert f"{step.steps} steps" in str(step)


def test_the_measured_order_is_that_of_the_scheme():
    for solver in (dps.PresymplecticEuler(), dps.PresymplecticLeapfrog("position")):
        step = choose(PENDULUM, solver, 0.0, 2.0, Y0, tolerance=1e-5)
        assert step.order == pytest.approx(step.claimed_order, abs=0.1)


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


def test_no_more_than_twice_as_many_steps_for_the_grid():
    # 1009 is a prime: it has no divisors, so that steps would be ten times too short.
    problem, options = (PENDULUM, dps.TunedRKN6(), 0.0, 20.0, Y0), {"tolerance": 1e-4}
    prime = jnp.linspace(0.0, 20.0, 1010)
    step = choose(*problem, ts=prime, **options)
    assert not step.on_grid and step.steps < 200
    divisible = jnp.linspace(0.0, 20.0, 1009)
    other = choose(*problem, ts=divisible, **options)
    assert other.on_grid and 1008 % other.steps == 0
    assert other.steps <= 2 * step.steps


def test_steps_do_not_follow_the_phase_of_a_force():
    # With any divisor of 160 as the number of steps, the force is constant.
    phase = lambda t, q, args: -jnp.sum(q) * jnp.cos(2 * jnp.pi * 160 * t)
    term = dps.MechanicalSystem(dps.QuadraticKinetic(), phase)
    y0 = jnp.array([0.0]), jnp.array([1.0])
    step = choose_step(
        *(term, dps.PresymplecticLeapfrog("position"), 0.0, 1.0, y0),
        ts=jnp.linspace(0.0, 1.0, 161),
        rtol=0.0,
        atol=1e-6,
    )
    assert step.steps > 160


def test_what_is_exact_takes_one_step():
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0.0 * q[0])
    y0 = jnp.array([0.0, 1.0]), jnp.array([0.0, 2.0])
    step = choose_step(free, dps.Strang(), 0.0, 10.0, y0, rtol=1e-6, atol=0.0)
    assert step.steps == 1 and np.isnan(step.order)


def test_a_step_that_is_too_large_is_no_error():
    stiff = term_of(lambda t, q, args: 1e3 * jnp.sum(q**4), 0.0)
    step = choose(stiff, dps.BlanesMoanRKN4(), 0.0, 1.0, Y0, tolerance=1e-4)
    assert any(np.isinf(trial.error) for trial in step.trials)
    assert step.error <= 1


def test_single_precision():
    to32 = lambda x: jax.tree.map(jnp.float32, x)
    term, solver = term_of(cosine, jnp.float32(0.1)), dps.PresymplecticLeapfrog()
    t0, t1, y0 = to32((jnp.array(0.0), jnp.array(20.0), Y0))
    chosen = lambda solver, tolerance: choose(
        term, solver, t0, t1, y0, tolerance=tolerance
    )
    step = chosen(solver, 1e-3)
    assert step.error <= 1
    with pytest.raises(RuntimeError, match="in float32: rounding") as error:
        chosen(dps.TunedRKN6(), 1e-8)
    assert "`Compensated(TunedRKN6(...))`" in str(error.value)
    assert "'jax_enable_x64'" in str(error.value)
    # Below rounding from the start.
    with pytest.raises(RuntimeError, match="in float32: rounding"):
        choose(
            *(SPRING, dps.TunedRKN6(), t0, t1, y0),
            tolerance=1e-8,
            ts=jnp.linspace(t0, t1, 81),
        )
    with pytest.raises(RuntimeError, match="Use double precision"):
        chosen(dps.Compensated(dps.TunedRKN6()), 1e-9)


@pytest.mark.parametrize(
    "term, solver, y0, tolerance, max_steps, message",
    [
        (
            PENDULUM,
            dps.PresymplecticLeapfrog(),
            Y0,
            1e-9,
            10**5,
            "needs about .*e+05 steps, but",
        ),
        (
            PENDULUM,
            dps.PresymplecticLeapfrog(),
            Y0,
            1e-6,
            5000,
            "needs more than 5000 steps",
        ),
        (PENDULUM, dps.PresymplecticLeapfrog(), Y0, 1e-3, 3, "too few steps"),
        # Infinite after a finite time.
        (
            term_of(lambda t, q, args: -jnp.sum(q**4)),
            dps.TunedRKN6(),
            Y0,
            1e-3,
            1000,
            "no finite solution",
        ),
        # A force with jumps.
        (
            term_of(lambda t, q, args: jnp.sum(abs(q))),
            dps.TunedRKN6(),
            Y0,
            1e-12,
            20000,
            "no regular convergence",
        ),
    ],
    ids=["order", "steps", "few steps", "singular", "jumps"],
)
def test_tolerances_that_cannot_be_reached(
    term, solver, y0, tolerance, max_steps, message
):
    with pytest.raises(RuntimeError, match=message.replace("+", r"\+")):
        problem = term, solver, 0.0, 20.0, y0
        choose(*problem, tolerance=tolerance, max_steps=max_steps)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"rtol": 0.0, "atol": 0.0}, "needs a positive tolerance"),
        ({"rtol": -1.0}, "rtol=.* must be a number that is not negative, but got -1.0"),
        ({"atol": float("nan")}, "atol=.* but got nan"),
        ({"atol": "small"}, "atol=.* but got 'small'"),
        ({"max_steps": 0}, "max_steps=.* must be a positive integer, but got 0"),
        ({"t1": 0.0}, "two different finite times"),
        ({"t1": float("inf")}, "two different finite times"),
    ],
)
def test_bad_input(changes, message):
    given = {"t0": 0.0, "t1": 20.0, "y0": Y0, "rtol": 1e-3, "atol": 1e-3} | changes
    with pytest.raises(ValueError, match=message):
        choose_step(PENDULUM, dps.TunedRKN6(), **given)


def test_schemes_that_refuse_the_system():
    coupled = dps.Hamiltonian(lambda t, q, p, args: jnp.sum((q**2 + 1) * (p**2 + 1)))
    with pytest.raises(ValueError, match="PresymplecticGauss"):
        choose(coupled, dps.TunedRKN6(), 0.0, 1.0, Y0, tolerance=1e-3)


def test_traced_input():
    @jax.jit
    def chosen(t1):
        return choose(PENDULUM, dps.TunedRKN6(), 0.0, t1, Y0, tolerance=1e-3).dt0

    with pytest.raises(ValueError, match=r"outside of `jax.jit`"):
        chosen(1.0)
