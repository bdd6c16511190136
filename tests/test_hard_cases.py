"""The hard cases, scaled down: bounds are measured values with a small margin."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, harmonic, solve, substeps, trajectory

import diffrax_presym as dps
from diffrax_presym._results import FRICTION_TOO_STRONG


LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
REST = (jnp.ones(1), jnp.zeros(1))
FIXED = dps.FixedStepAdjoint()
NONFINITE: Any = dfx.RESULTS.nonfinite  # pyright: ignore[reportAttributeAccessIssue]


def conservative(potential, mass=None):
    return dps.MechanicalSystem(dps.QuadraticKinetic(mass), potential)


def damped(potential, damping):
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)


def last(sol):
    return jax.tree.map(lambda x: np.asarray(x[-1]), sol.ys)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("solver", [LEAPFROG, RKN4], ids=["leapfrog", "RKN4"])
def test_no_overflow_of_the_frame(dtype, solver):
    # exp(1000) overflows in both precisions; only the slow mode remains.
    y0 = jax.tree.map(lambda x: x.astype(dtype), REST)
    t1, dt0, gamma = (jnp.asarray(x, dtype) for x in (50.0, 0.025, 20.0))
    system = damped(harmonic, dps.ConstantDamping(gamma))
    q, p = last(solve(system, solver, 0 * t1, t1, dt0, y0))
    slow = 10 - (100 - 1) ** 0.5
    exact = (1 + slow / (20 - 2 * slow)) * np.exp(-slow * 50)
    assert abs(q[0] / exact - 1) < 0.06
    assert q.dtype == dtype and np.isfinite(p[0])


def test_excitation_grows_until_overflow_is_physical():
    y0 = jax.tree.map(lambda x: x.astype(jnp.float32), REST)
    system = damped(harmonic, dps.ConstantDamping(-1.0))
    ends = []
    for t1 in (100.0, 250.0):
        t0, t1, dt0 = (jnp.float32(t) for t in (0.0, t1, 0.05))
        ends.append(solve(system, LEAPFROG, t0, t1, dt0, y0, throw=False))
    # exp(50) is finite in float32, and exp(125) is not.
    assert ends[0].result == dfx.RESULTS.successful
    assert ends[1].result == NONFINITE


@pytest.mark.parametrize("h, stable", [(1.999, True), (2.001, False)])
def test_leapfrog_is_stable_up_to_two(h, stable):
    q, _ = last(solve(conservative(harmonic), LEAPFROG, 0.0, 3000 * h, h, REST))
    assert (np.abs(q[0]) < 100) == stable


def test_no_drift_in_1e5_steps():
    # The step is a power of two, so times are exact. The error is bounded by that of
    # the scheme throughout; rounding errors are far smaller.
    system = conservative(harmonic)
    solver = substeps(LEAPFROG, 50)
    _, q, p = trajectory(system, solver, 0.0, 12500.0, 6.25, REST)
    error = np.abs((q**2 + p**2) / 2 - 0.5)
    assert error.max() < 0.125**2 / 4
    assert error[-200:].max() < 1.01 * error[:200].max()
    # The modified energy, which the leapfrog preserves to rounding.
    kept = p**2 + q**2 * (1 - 0.125**2 / 4)
    assert np.abs(kept - kept[0]).max() < 1e-13


@pytest.mark.parametrize("t0", [1e-6, 0.0])
@pytest.mark.parametrize(
    "solver",
    [LEAPFROG, dps.Suzuki4(), dps.BlanesMoan4(), RKN4, dps.BlanesMoanRKN6()],
    ids=lambda solver: type(solver).__name__,
)
def test_singular_damping_from_its_start(solver, t0):
    system = damped(harmonic, dps.LogDamping(3.0))
    q, p = last(solve(system, solver, t0, 1.0, (1 - t0) / 100, REST))
    assert abs(q[0] - 2 * 0.4400505857449335) < 2e-4  # 2 J_1(1)
    assert abs(p[0] + 2 * 0.11490348493190048) < 6e-4  # -2 J_2(1)


def test_stages_before_the_start_are_reported():
    system = damped(harmonic, dps.LogDamping(3.0))
    run = lambda solver: solve(system, solver, 1e-6, 1.0, 0.01, REST, throw=False)
    assert run(dps.SuzukiYoshida(4)).result != dfx.RESULTS.successful
    assert run(dps.Suzuki4()).result == dfx.RESULTS.successful


def slow_motion(solver, h_gamma, adjoint=FIXED, friction=dps.ConstantDamping, h=1.0):
    """The errors of q and p of an oscillator that friction slows down, of step times
    frequency 0.3, after a time in which the motion falls by 1 / e; and the result."""
    gamma, omega = h_gamma / h, 0.3 / h
    rate = -(omega**2) / (gamma / 2 + (gamma**2 / 4 - omega**2) ** 0.5)
    spring = dps.QuadraticPotential(jnp.asarray(omega**2))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), spring, friction(gamma))
    t1, y0 = h * np.ceil(1 / abs(rate * h)), (jnp.ones(1), jnp.ones(1) * rate)
    args = system, solver, 0.0, t1, h, y0
    sol: Any = solve(*args, adjoint=adjoint, throw=False, max_steps=4096)
    q, p = last(sol)
    exact = np.exp(rate * t1)
    return abs(q[0] / exact - 1), abs(p[0] / (rate * exact) - 1), sol.result


# Below and above the most friction that they resolve.
STRONG = [
    (dps.SuzukiYoshida(4), 1.0, 1.3),
    (dps.SuzukiYoshida(4, dps.Strang()), 2.0, 3.0),
    (dps.Suzuki4(), 3.0, 3.3),
    (dps.SofroniouSpaletta(6), 6.0, 6.5),
    (dps.SofroniouSpaletta(10), 12.0, 13.0),
    (dps.BlanesMoan4(), 17.5, 40.0),
    (dps.BlanesMoanRKN4(), 9.9, 20.0),
    (dps.BlanesMoan6(), 14.0, 16.0),
    (dps.TunedRKN6(), 29.0, 50.0),
    (dps.Compensated(dps.TunedRKN6()), 29.0, 50.0),
    (dps.Composition(dps.TunedRKN6(), (0.25,) * 4), 117.0, 200.0),
    (dps.BlanesCasasRKN8(), 25.0, 50.0),
    (dps.TunedLinear8(), 9.5, 30.0),
    (dps.SymmetricMultistep(8), 1.06, 2.0),
]


@pytest.mark.parametrize("adjoint", [FIXED, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("solver, below, above", STRONG)
def test_strong_friction(solver, below, above, adjoint):
    q, p, result = slow_motion(solver, below, adjoint)
    assert q < 0.12 and p < 0.12 and result == dfx.RESULTS.successful
    q, p, result = slow_motion(solver, above, adjoint)
    assert np.isnan(q) and np.isnan(p) and result == FRICTION_TOO_STRONG


def test_gradient_under_friction_that_is_too_strong():
    """It is not finite, as the solution is not, rather than zero."""

    def loss(gamma, adjoint):
        system = damped(harmonic, dps.ConstantDamping(gamma))
        options: dict = dict(adjoint=adjoint, throw=False)
        sol: Any = solve(system, RKN4, 0.0, 4.0, 1.0, REST, **options)
        return jnp.sum(sol.ys[0])

    for adjoint in (FIXED, dfx.RecursiveCheckpointAdjoint()):
        assert np.isnan(jax.grad(loss)(200.0, adjoint))
        each = jax.vmap(lambda gamma, a=adjoint: jax.grad(loss)(gamma, a))
        lost, kept = each(jnp.array([200.0, 1.0]))
        assert np.isnan(lost) and np.isfinite(kept)


def by_place(gamma):
    return dps.PositionDamping(lambda t, q, args: gamma + 0 * q)


def by_matrix(gamma):
    return dps.PositionDamping(lambda t, q, args: gamma * jnp.eye(1))


@pytest.mark.parametrize("adjoint", [FIXED, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("friction", [by_place, by_matrix])
@pytest.mark.parametrize(
    "solver, below, above",
    [
        (dps.Strang(), 300.0, None),
        (dps.BlanesMoan4(), 32.0, (33.0, 100.0)),
        (dps.BlanesMoan6(), 34.0, (35.0, 100.0)),
        (dps.SofroniouSpaletta(8, dps.Strang()), 24.0, (25.0, 100.0)),
    ],
)
def test_strong_friction_in_kicks(solver, below, above, friction, adjoint):
    q, p, result = slow_motion(solver, below, adjoint, friction)
    assert q < 0.12 and p < 0.12 and result == dfx.RESULTS.successful
    for h_gamma in above or ():
        q, p, result = slow_motion(solver, h_gamma, adjoint, friction)
        assert np.isnan(q) and np.isnan(p) and result != dfx.RESULTS.successful


@pytest.mark.parametrize("h_gamma", [0.5, 5.0, 100.0])
def test_momentum_of_coarse_schemes_under_strong_friction(h_gamma):
    """After the last half of a kick it is (x / 2) coth(x / 2) times what a constant
    force leaves."""
    x = h_gamma / 2
    force = dps.ForceField(lambda t, q, args: jnp.ones(1))
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), force, dps.ConstantDamping(h_gamma)
    )
    for solver, factor in ((dps.Strang(), 1.0), (LEAPFROG, x / np.tanh(x))):
        options: dict = dict(saveat=dfx.SaveAt(steps=True), adjoint=FIXED)
        sol: Any = solve(system, solver, 0.0, 100.0, 1.0, REST, **options)
        q, p = sol.ys
        assert_close(p[99] * h_gamma, jnp.ones(1) * x / np.tanh(x), 1e-12)
        assert_close((q[99] - q[98]) * h_gamma, jnp.ones(1) * factor, 1e-10)


def test_friction_that_becomes_too_strong():
    """Only the steps in which it is are beyond a scheme: in them the solve fails."""
    system = damped(harmonic, lambda t: jnp.maximum(t - 5.0, 0.0) ** 2 * 20)
    for adjoint in (FIXED, dfx.RecursiveCheckpointAdjoint()):
        run = lambda t1, adjoint=adjoint: solve(
            *(system, dps.BlanesMoan4(), 0.0, t1, 0.5, REST),
            adjoint=adjoint,
            throw=False,
        )
        assert run(5.5).result == dfx.RESULTS.successful
        assert run(8.0).result == FRICTION_TOO_STRONG


def test_half_solver_rejects_steps_of_too_much_friction():
    system = damped(harmonic, dps.ConstantDamping(100.0))
    control = dfx.PIDController(rtol=1e-6, atol=1e-6)
    solver = dfx.HalfSolver(dps.TunedRKN6())
    options: dict = dict(stepsize_controller=control)
    sol: Any = solve(system, solver, 0.0, 50.0, 5.0, REST, **options)
    rate = -2 / (100 + (100**2 - 4) ** 0.5)
    q, p = last(sol)
    assert abs(p[0] / (rate * q[0]) - 1) < 1e-3
    assert abs(q[0] / np.exp(rate * 50) - 1) < 1e-3


@pytest.mark.parametrize(
    "stiffness, mass",
    [
        (np.logspace(-8, 0, 9), None),
        (np.repeat([0.0, 1.0], 4), None),
        (np.logspace(-6, 6, 9), np.logspace(-6, 6, 9)),
    ],
)
def test_conditioning(stiffness, mass):
    # The modes are independent: the slow ones are as accurate as alone.
    stiffness, mass = jax.tree.map(jnp.asarray, (stiffness, mass))
    y0 = (jnp.ones(stiffness.size), jnp.zeros(stiffness.size))
    system = conservative(lambda t, q, args: jnp.sum(args * q**2) / 2, mass)
    q, _ = last(solve(system, RKN4, 0.0, 100.0, 0.5, y0, stiffness))
    omega = np.sqrt(stiffness / (1 if mass is None else mass))
    assert_close(q, np.cos(omega * 100), 1e-3)
