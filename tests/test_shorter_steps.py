"""Values between steps where friction is too strong for a polynomial, or undefined."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from choosing import PENDULUM, RKN6, solve_of, Y0
from helpers import check_members

import diffrax_presym as dps
from diffrax_presym._step_size._convergence import find_steps
from diffrax_presym._step_size._solution import Solution


GAUSS = dps.PresymplecticGauss


@pytest.mark.parametrize(
    "rate, solver, tolerance",
    [(0.0, dps.BlanesMoanRKN4(), 3e-2), (1.5, dps.TunedRKN6(), 1e-2)],
)
def test_chosen_steps_end_at_saved_times_if_that_costs_less(rate, solver, tolerance):
    """Where long steps take shorter ones to saved times and short steps interpolate,
    and where all interpolate."""
    layer = jnp.where(jnp.arange(20) < 4, rate, 0.0)
    springs = lambda t, q, args: 2 * jnp.sum(jnp.diff(q, prepend=0.0, append=0.0) ** 2)
    chain = dps.MechanicalSystem(
        dps.QuadraticKinetic(), springs, dps.ConstantDamping(layer)
    )
    y0 = jnp.exp(-(jnp.linspace(-10.0, 9.0, 20) ** 2) / 8), jnp.zeros(20)

    @jax.jit
    def run(dt0):
        return dfx.diffeqsolve(
            *(chain, solver, 0.0, 90.0, dt0, y0), max_steps=None,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 90.0, 101)),
            adjoint=dps.FixedStepAdjoint(),
        )  # fmt: skip

    step = dps.choose_step(run, 0.0, 90.0, rtol=tolerance, atol=tolerance)
    assert step.steps == 100 and step.on_grid and step.error <= 1


@pytest.mark.parametrize("rate, interpolated", [(1.8, True), (8.0, False)])
def test_a_fast_rotation_takes_shorter_steps(rate, interpolated):
    """A magnetic field, of which drifts are exact however much they turn."""
    C = rate * np.array([[0.0, 1.0], [-1.0, 0.0]])
    law = dps.ViscousDamping(jnp.asarray(C))
    well = lambda t, q, args: jnp.sum(q**2) / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), well, law)
    ts, y0 = np.linspace(0.0, 10.0, 81), np.array([1.0, -0.5, 1.0, 1.0])
    sol: Any = dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 10.0, 0.5, tuple(jnp.split(jnp.array(y0), 2))),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        adjoint=dps.FixedStepAdjoint(),
    )
    assert bool(sol.stats["interpolated"]) == interpolated
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), -C]])
    right = np.stack([scipy.linalg.expm(t * A) @ y0 for t in ts])
    error = np.abs(np.concatenate(sol.ys, axis=1) - right)
    assert np.max(error) < 3 * np.max(error[::4])


MATRIX = np.array([[1.0, 0.3], [0.3, 0.7]])
HEAVY = lambda q: np.array([[2.0, 0.3 * q[0]], [0.3 * q[0], 1.5]])
BY_STATE = {
    "place": lambda k, q, v: -k * (1 + q[0] ** 2) * MATRIX @ v,
    "drag": lambda k, q, v: -k * np.sqrt(v @ v) * v,
    "force": lambda k, q, v: -k * np.array([1.0, 0.1]) * v,
    "joints": lambda k, q, v: -k * MATRIX @ v,
}


@pytest.mark.parametrize("kind", BY_STATE)
@pytest.mark.parametrize("k, interpolated", [(0.5, True), (10.0, False)])
def test_strong_friction_by_state_takes_shorter_steps(kind, k, interpolated):
    """How strong it is, is estimated at the start."""
    kinetic, solver = dps.QuadraticKinetic(), dps.BlanesMoan4()
    well = lambda t, q, args: jnp.sum(q**4) / 4 + jnp.sum(jnp.cos(q))
    mass = lambda q: np.eye(2)
    if kind == "joints":
        law, solver, mass = dps.ViscousDamping(jnp.asarray(k * MATRIX)), GAUSS(3), HEAVY
        matrix = lambda t, q, args: jnp.array([[2.0, 0.3 * q[0]], [0.3 * q[0], 1.5]])
        system = dps.LagrangianSystem(matrix, well, law)
    elif kind == "force":
        force = lambda t, q, v, args: -k * jnp.array([1.0, 0.1]) * v
        system = dps.MechanicalSystem(kinetic, well, force=force)
    else:
        rates = lambda t, q, args: k * (1 + q[0] ** 2) * jnp.asarray(MATRIX)
        law = dps.Drag(k) if kind == "drag" else dps.ViscousDamping(rates)
        system = dps.MechanicalSystem(kinetic, well, law)

    def slope(t, y):
        q, p = np.split(y, 2)
        v = np.linalg.solve(mass(q), p)
        force = np.sin(q) - q**3 + BY_STATE[kind](k, q, v)
        force[0] += 0.3 * v[0] * v[1] if kind == "joints" else 0.0
        return np.concatenate([v, force])

    q, v = np.array([0.6, -0.8]), np.array([0.5, 1.0])
    ts, y0 = np.linspace(0.0, 4.0, 81), np.concatenate([q, mass(q) @ v])
    right = scipy.integrate.solve_ivp(
        *(slope, (0.0, 4.0), y0, "Radau", ts), rtol=1e-10, atol=1e-11
    ).y.T
    sol: Any = dfx.diffeqsolve(
        *(system, solver, 0.0, 4.0, 0.2, tuple(map(jnp.asarray, np.split(y0, 2)))),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        adjoint=dps.FixedStepAdjoint(),
    )
    assert bool(sol.stats["interpolated"]) == interpolated
    error = np.abs(np.concatenate(sol.ys, axis=1) - right)
    assert np.max(error) < 1.5 * np.max(error[::4]) < 3e-3


@pytest.mark.parametrize("solver", [dps.BlanesMoan4(), GAUSS(3)])
def test_a_speed_has_no_derivative_at_rest(solver):
    drag = lambda t, q, v, args: args * jnp.linalg.norm(v) * v
    push = lambda t, q, args: q[1] * (1 + t)
    ball = dps.MechanicalSystem(dps.QuadraticKinetic(), push, force=drag)
    ts = np.linspace(0.0, 1.0, 23)

    def saved(c) -> Any:
        return dfx.diffeqsolve(
            *(ball, solver, 0.0, 1.0, 0.05, (jnp.zeros(2), jnp.zeros(2)), -c),
            saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
            adjoint=dps.FixedStepAdjoint(),
        ).ys

    def slope(t, y):
        return [y[1], -(1 + t) - 0.5 * abs(y[1]) * y[1]]

    options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}
    right = scipy.integrate.solve_ivp(slope, (0, 1), [0, 0], t_eval=ts, **options).y
    got = np.stack([x[:, 1] for x in saved(0.5)])
    np.testing.assert_allclose(got, right, 0, 2e-8)
    if solver != GAUSS(3):
        return  # JAX has no derivative of the norm in a kick at rest.
    total = lambda c: jnp.sum(saved(c)[1])
    difference = (total(0.5 + 1e-5) - total(0.5 - 1e-5)) / 2e-5
    assert jax.grad(total)(0.5) == pytest.approx(float(difference), rel=1e-7)


DECAYING = {
    "3 / (t + 1)": (dps.LogDamping(3.0, 1.0), lambda t: 3 / (t + 1)),
    "3 / t": (dps.LogDamping(3.0), lambda t: 3 / t if t > 0 else 0.0),
    # A function of time, strong at first and once more.
    "pulse": (
        lambda t: 2 * jnp.tanh(2 * (t - 3)) + 4 * jnp.tanh(t),
        lambda t: 4 / np.cosh(2 * (t - 3)) ** 2 + 4 / np.cosh(t) ** 2,
    ),
}


def anharmonic(law, solver, ts, n, y0=1.0) -> Any:
    """An oscillator whose friction is strong for some steps."""
    well = lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 8)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), well, law)
    return dfx.diffeqsolve(
        *(system, solver, 0.0, 24.0, 24.0 / n, (y0 * jnp.ones(1), jnp.zeros(1))),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts)),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


@pytest.mark.parametrize("name", DECAYING)
@pytest.mark.parametrize("solver", [dps.BlanesMoanRKN4(), dps.BlanesMoan6()])
def test_friction_that_ceases_takes_shorter_steps_until_then(name, solver):
    ts, (law, rate) = np.linspace(0.0, 24.0, 241), DECAYING[name]
    slope = lambda t, y: [y[1], -y[0] - y[0] ** 3 / 2 - rate(t) * y[1]]
    if name == "3 / t":  # which starts as q = 1 - q'' t^2 / 2, with 4 q'' = 1.5
        slope = lambda t, y: (
            [y[1], -y[0] - y[0] ** 3 / 2 - 3 * y[1] / t] if t else [0, -0.375]
        )
    options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-13, "max_step": 0.05}
    right = scipy.integrate.solve_ivp(
        *(slope, (0.0, 24.0), [1.0, 0.0], "DOP853", ts), **options
    ).y
    sol = anharmonic(law, solver, ts, 60)
    # Motion from a singular start is smooth from the second step on.
    least, most = (230, 241) if name == "3 / t" else (180, 230)
    assert least < int(sol.stats["interpolated"]) < most
    error = np.abs(np.stack([x[:, 0] for x in sol.ys]) - right)
    assert np.max(error) < 3 * np.max(error[:, ::4]) < 3e-3


@pytest.mark.variants(1)
@pytest.mark.parametrize("solver", [dps.BlanesMoanRKN4(), GAUSS(2)])
def test_gradients_where_some_values_are_shorter_steps(solver):
    """Alone, and in a batch of which one member takes none, and one no other."""
    ts = jnp.linspace(0.1, 23.9, 77).at[jnp.array([3, 40])].set(jnp.nan)

    def total(x):
        rate, shift, y0 = x
        sol = anharmonic(dps.LogDamping(rate, shift), solver, ts, 60, y0=y0)
        ys = jnp.concatenate(sol.ys, axis=1)
        weights = jnp.cos(jnp.arange(ys.size, dtype=float)).reshape(ys.shape)
        loss = jnp.sum(jnp.where(jnp.isfinite(ys), ys, 0.0) * weights)
        return loss, (ys, sol.stats["interpolated"])

    members = jnp.array([[3.0, 1.0, 1.0], [0.5, 1.0, 0.8], [600.0, 200.0, 1.2]])
    number = check_members(total, members, 1e-12)
    assert number[1] == 75 and 0 < number[0] < 75 and number[2] == 0


def test_a_batch_of_which_one_starts_where_friction_is_singular():
    def total(shift):
        law = dps.LogDamping(2.0, shift)
        sol = anharmonic(law, dps.BlanesMoanRKN4(), jnp.linspace(0, 24, 50), 60)
        return jnp.sum(sol.ys[0] ** 2)

    both = jax.vmap(jax.value_and_grad(total))(jnp.array([0.0, 30.0]))
    for i, shift in enumerate((0.0, 30.0)):
        value, slope = jax.value_and_grad(total)(shift)
        assert both[0][i] == pytest.approx(float(value), rel=1e-12)
        assert np.isfinite(value) and (i == 0 or np.isfinite(slope))
        np.testing.assert_allclose(both[1][i], slope, 1e-9)


def test_backwards_to_strong_friction_takes_shorter_steps():
    """Which are at the end of the solve, so that all before take them too."""
    ts, law = jnp.linspace(24.0, 0.0, 241), dps.LogDamping(3.0, 1.0)
    there = anharmonic(law, dps.BlanesMoanRKN6(), ts[::-1], 120)
    y0 = [x[-1] for x in there.ys]
    well = lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 8)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), well, law)
    back: Any = dfx.diffeqsolve(
        *(system, dps.BlanesMoanRKN6(), 24.0, 0.0, -0.2, tuple(y0)),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
    )
    assert int(back.stats["interpolated"]) == 0
    for x, y in zip(there.ys, back.ys, strict=True):
        np.testing.assert_allclose(x[::-1], y, 0, 1e-5)


def test_gradients_beside_a_member_of_few_steps():
    """Which takes shorter steps where the other interpolates."""

    def total(rate, dt0):
        well = lambda t, q, args: -jnp.sum(jnp.cos(q))
        law = lambda t: rate * (t + 0.5 * jnp.sin(t))
        sol: Any = dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), well, law),
            *(dps.BlanesMoanRKN4(), 0.0, 0.6, dt0, (jnp.ones(1), jnp.ones(1))),
            saveat=dfx.SaveAt(ts=jnp.array([0.25, 0.5])),
            adjoint=dps.FixedStepAdjoint(),
        )
        return jnp.sum(sol.ys[0])

    slope, steps = jax.grad(total), jnp.array([0.1, 0.3])
    got = jax.jit(jax.vmap(slope, (None, 0)))(0.2, steps)
    np.testing.assert_allclose(got, [slope(0.2, h) for h in steps], rtol=1e-10)


def test_second_derivatives_of_a_batch_by_its_friction():
    """Where the rows that are interpolated differ among the members."""

    def total(k):
        well = lambda t, q, args: -jnp.sum(jnp.cos(q))
        law = dps.ConstantDamping(0.1 * k)
        sol: Any = dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), well, law),
            *(dps.PresymplecticYoshida4(), 0.0, 1.0, 0.2, (jnp.ones(2), jnp.zeros(2))),
            saveat=dfx.SaveAt(ts=jnp.array([0.13, 0.5, 0.77])),
            adjoint=dps.FixedStepAdjoint(),
        )
        return jnp.sum(sol.ys[0] ** 2)

    ks, h, slope = jnp.array([1.0, 1.5]), 1e-5, jax.jit(jax.grad(total))
    second = lambda k: jax.jvp(jax.grad(total), (k,), (1.0,))[1]
    got = jax.jit(jax.vmap(second))(ks)
    wanted = [(slope(k + h) - slope(k - h)) / (2 * h) for k in ks]
    np.testing.assert_allclose(got, wanted, rtol=1e-5)


def test_a_chosen_step_has_no_shorter_one_that_failed():
    """As where a table has kinks at 41 saved times, at which steps end by chance."""
    ts, known = np.linspace(0.0, 1.0, 41), {4: 90.0, 9: 20.0, 19: 0.7, 30: 1.5}

    def solution(n):
        error = known.get(n, 1.2) if n % 40 else 1e-4 * (40 / n) ** 6
        values = [np.array([1 + error]), ts]
        return Solution(n, n, ts, values, True, 6, interpolates=True, values=1)

    trials: list = []
    choice = find_steps(solution, (0.0, 1.0), (0.0, 1.0), 10_000, trials.append)
    assert [x.error > 1 for x in trials if x.steps == 30] == [True]
    assert choice.best.steps == 40


@pytest.mark.parametrize("jit", [lambda fn: fn, jax.jit])
@pytest.mark.parametrize("ts, message", [([0.5, 1.1], "lie bet"), ([1.0, 0.5], "incr")])
def test_an_error_of_a_solve_is_not_a_step_that_is_too_long(jit, ts, message):
    solve = solve_of(PENDULUM, RKN6, 0.0, 1.0, Y0, ts=jnp.array(ts), throw=True)
    with pytest.raises(RuntimeError, match=message):
        dps.choose_step(jit(solve), 0.0, 1.0, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), dfx.DirectAdjoint()])
def test_values_just_before_a_solve_is_cut_off(adjoint):
    """Less than three steps after one of the given times."""
    well = lambda t, q, args: -jnp.sum(jnp.cos(q))
    sol: Any = dfx.diffeqsolve(
        dps.MechanicalSystem(dps.QuadraticKinetic(), well),
        *(dps.BlanesMoanRKN4(), 0.0, 2.0, 0.1, (jnp.ones(1), jnp.zeros(1))),
        saveat=dfx.SaveAt(ts=jnp.array([0.55, 1.02, 1.12, 1.3])),
        stepsize_controller=dps.StepsBetween(jnp.ones(1)),
        adjoint=adjoint,
        **{"throw": False, "max_steps": 12},
    )
    assert sol.result == dfx.RESULTS.max_steps_reached
    assert np.isfinite(sol.ys[0][:, 0]).tolist() == [True, True, True, False]
