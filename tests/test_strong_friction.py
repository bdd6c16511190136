"""Friction that is strong over a step: resolved up to a bound, and a failure beyond."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, harmonic, solve

import diffrax_presym as dps
from diffrax_presym._friction._leaf import MatrixFriction
from diffrax_presym._results import FRICTION_TOO_STRONG


RKN4, FIXED = dps.BlanesMoanRKN4(), dps.FixedStepAdjoint()
REST = (jnp.ones(1), jnp.zeros(1))
LOOPS = [FIXED, dfx.RecursiveCheckpointAdjoint()]
each_loop = pytest.mark.parametrize("adjoint", LOOPS, ids=["own", "Diffrax"])


def damped(damping, potential=harmonic):
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, damping)


def last(sol):
    return jax.tree.map(lambda x: np.asarray(x[-1]), sol.ys)


def slow_motion(solver, h_gamma, adjoint=FIXED, friction=dps.ConstantDamping):
    """The errors of q and p of an oscillator that friction slows down, of frequency 0.3
    for steps of one, after a time in which motion falls by 1 / e; and the result."""
    gamma, omega = h_gamma, 0.3
    rate = -(omega**2) / (gamma / 2 + (gamma**2 / 4 - omega**2) ** 0.5)
    spring = dps.QuadraticPotential(jnp.asarray(omega**2))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), spring, friction(gamma))
    t1, y0 = np.ceil(1 / abs(rate)), (jnp.ones(1), jnp.ones(1) * rate)
    args = system, solver, 0.0, t1, 1.0, y0
    sol: Any = solve(*args, adjoint=adjoint, throw=False, max_steps=4096)
    q, p = last(sol)
    exact = np.exp(rate * t1)
    return abs(q[0] / exact - 1), abs(p[0] / (rate * exact) - 1), sol.result


def check_bounds(below, above, run, failures):
    q, p, result = run(below)
    assert q < 0.12 and p < 0.12 and result == dfx.RESULTS.successful
    for h_gamma in above:
        q, p, result = run(h_gamma)
        assert np.isnan(q) and np.isnan(p) and failures(result)


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


@each_loop
@pytest.mark.parametrize("solver, below, above", STRONG)
def test_strong_friction(solver, below, above, adjoint):
    run = lambda h_gamma: slow_motion(solver, h_gamma, adjoint)
    check_bounds(below, [above], run, lambda result: result == FRICTION_TOO_STRONG)


def by_place(gamma):
    return dps.PositionDamping(lambda t, q, args: gamma + 0 * q)


def by_matrix(gamma):
    return dps.PositionDamping(lambda t, q, args: gamma * jnp.eye(1))


@each_loop
@pytest.mark.parametrize("friction", [by_place, by_matrix])
@pytest.mark.parametrize(
    "solver, below, above",
    [
        (dps.Strang(), 300.0, ()),
        (dps.BlanesMoan4(), 32.0, (33.0, 100.0)),
        (dps.BlanesMoan6(), 34.0, (35.0, 100.0)),
        (dps.SofroniouSpaletta(8, dps.Strang()), 24.0, (25.0, 100.0)),
    ],
)
def test_strong_friction_in_kicks(solver, below, above, friction, adjoint):
    run = lambda h_gamma: slow_motion(solver, h_gamma, adjoint, friction)
    check_bounds(below, above, run, lambda result: result != dfx.RESULTS.successful)


@each_loop
def test_one_strongly_damped_entry_among_ordinary_ones(adjoint):
    system, y0 = damped(dps.ConstantDamping(jnp.array([0.1, 100.0]))), jnp.ones(2)
    run = lambda h: solve(
        *(system, dps.BlanesMoan6(), 0.0, 10.0, h, (y0, 0 * y0)),
        adjoint=adjoint,
        throw=False,
    )
    assert run(1.0).result == FRICTION_TOO_STRONG
    sol: Any = run(0.1)
    assert_close(sol.ys[0][-1, 1], jnp.exp(-10 / 100), 1e-2)


@each_loop
@pytest.mark.parametrize("solver", [dps.BlanesMoan6(), dps.Suzuki4()])
def test_friction_that_changes_its_sign_within_a_step(solver, adjoint):
    """Of a step it is none, but stages that go back in time amplify rounding errors."""
    system = damped(lambda t: 20 * jnp.sin(2 * jnp.pi * t))
    run = lambda h: solve(
        *(system, solver, 0.0, 4.0, h, REST), adjoint=adjoint, throw=False
    )
    assert run(1.0).result != dfx.RESULTS.successful
    assert run(1 / 256).result == dfx.RESULTS.successful


def test_gradient_under_friction_that_is_too_strong():
    """It is not finite, as the solution is not, rather than zero."""

    def loss(gamma, adjoint):
        options: dict = dict(adjoint=adjoint, throw=False)
        args = damped(dps.ConstantDamping(gamma)), RKN4, 0.0, 4.0, 1.0, REST
        sol: Any = solve(*args, **options)
        return jnp.sum(sol.ys[0])

    for adjoint in LOOPS:
        assert np.isnan(jax.grad(loss)(200.0, adjoint))
        each = jax.vmap(lambda gamma, a=adjoint: jax.grad(loss)(gamma, a))
        lost, kept = each(jnp.array([200.0, 1.0]))
        assert np.isnan(lost) and np.isfinite(kept)


@pytest.mark.parametrize("h_gamma", [0.5, 5.0, 100.0])
def test_momentum_of_coarse_schemes_under_strong_friction(h_gamma):
    """After the last half of a kick it is (x / 2) coth(x / 2) times what a constant
    force leaves."""
    x, leapfrog = h_gamma / 2, dps.PresymplecticLeapfrog()
    force = dps.ForceField(lambda t, q, args: jnp.ones(1))
    system = damped(dps.ConstantDamping(h_gamma), force)
    for solver, factor in ((dps.Strang(), 1.0), (leapfrog, x / np.tanh(x))):
        options: dict = dict(saveat=dfx.SaveAt(steps=True), adjoint=FIXED)
        sol: Any = solve(system, solver, 0.0, 100.0, 1.0, REST, **options)
        q, p = sol.ys
        assert_close(p[99] * h_gamma, jnp.ones(1) * x / np.tanh(x), 1e-12)
        assert_close((q[99] - q[98]) * h_gamma, jnp.ones(1) * factor, 1e-10)


@each_loop
def test_friction_that_becomes_too_strong(adjoint):
    """Only the steps in which it is are beyond a scheme: in them the solve fails."""
    system = damped(lambda t: jnp.maximum(t - 5.0, 0.0) ** 2 * 20)
    run = lambda t1: solve(
        *(system, dps.BlanesMoan4(), 0.0, t1, 0.5, REST), adjoint=adjoint, throw=False
    )
    assert run(5.5).result == dfx.RESULTS.successful
    assert run(8.0).result == FRICTION_TOO_STRONG


def test_half_solver_rejects_steps_of_too_much_friction():
    control = dfx.PIDController(rtol=1e-6, atol=1e-6)
    args = damped(dps.ConstantDamping(100.0)), dfx.HalfSolver(dps.TunedRKN6())
    sol = solve(*args, 0.0, 50.0, 5.0, REST, stepsize_controller=control)
    rate = -2 / (100 + (100**2 - 4) ** 0.5)
    q, p = last(sol)
    assert abs(p[0] / (rate * q[0]) - 1) < 1e-3
    assert abs(q[0] / np.exp(rate * 50) - 1) < 1e-3


# Near the time at which friction is infinite.


@pytest.mark.parametrize(
    "solver",
    [dps.PresymplecticLeapfrog(), dps.Suzuki4(), dps.BlanesMoan4(), RKN4],
    ids=lambda solver: type(solver).__name__,
)
def test_damping_soon_after_its_singular_start(solver):
    run = lambda solver, **options: solve(
        *(damped(dps.LogDamping(3.0)), solver, 1e-6, 1.0, 0.01, REST), **options
    )
    q, p = last(run(solver))
    assert abs(q[0] - 2 * 0.4400505857449335) < 2e-4  # 2 J_1(1)
    assert abs(p[0] + 2 * 0.11490348493190048) < 6e-4  # -2 J_2(1)
    # The stages of a triple jump are before the start.
    outside = run(dps.SuzukiYoshida(4), throw=False)
    assert outside.result != dfx.RESULTS.successful


@pytest.mark.parametrize("n", [3, 8])
def test_the_fastest_decay_or_rotation_of_a_matrix(n):
    rng = np.random.default_rng(n)
    mass = np.eye(n) + rng.uniform(size=(n, n))
    shear = np.array([[3.0, 1.0], [0.0, 1.0]])
    coefficients = np.diag(rng.uniform(0.1, 1.0, n))
    for matrix in (coefficients @ np.linalg.inv(mass @ mass.T), 0.0 * mass, shear):
        largest = np.max(np.abs(np.linalg.eigvals(matrix)))
        friction = MatrixFriction(jnp.asarray(matrix)).by_rates(None)
        found = friction.growth(jnp.asarray(0.0), jnp.asarray(0.3))
        assert 0.3 * largest <= found <= 0.3 * 1.5 * largest


def chain_and_modes(n, strength):
    """Masses with dampers between them that are strong, and their modes."""
    stretch = np.eye(n) - np.eye(n, k=-1)
    stiffness = stretch.T @ stretch
    squares, modes = np.linalg.eigh(stiffness)
    q0 = 1 + np.arange(n) / n
    pairs = (stiffness, q0), (squares, modes.T @ q0)
    out = []
    for matrix, start in pairs:
        law = dps.ViscousDamping(jnp.asarray(strength * matrix))
        spring = dps.QuadraticPotential(jnp.asarray(matrix))
        out.append((damped(law, spring), (jnp.asarray(start), jnp.zeros(n))))
    return out, modes


@pytest.mark.parametrize("solver", [dps.Strang(), dps.PresymplecticLeapfrog()])
@pytest.mark.parametrize("n", [3, 30])
@pytest.mark.parametrize("strength", [1e2, 1e5, 1e8])
def test_matrices_of_any_strength_are_their_modes(strength, n, solver):
    """Also within steps, and with gradients, without as many products as there is
    friction over a step."""
    ((system, y0), (alone, z0)), modes = chain_and_modes(n, strength)
    ts = jnp.array([0.1, 0.5, 0.7, 1.0])

    @jax.jit
    def run(system, y0):
        args = system, solver, 0.0, 1.0, 0.5, y0
        sol: Any = solve(*args, saveat=dfx.SaveAt(ts=ts), adjoint=FIXED)
        return sol.ys

    (q, p), (x, v) = run(system, y0), run(alone, z0)
    # Entries of the matrix that are rounded are other modes.
    rounding = 1e-12 + 1e-15 * strength
    np.testing.assert_allclose(q, x @ modes.T, atol=rounding)
    np.testing.assert_allclose(p, v @ modes.T, atol=rounding)
    slope = jax.grad(lambda y, system: jnp.sum(run(system, y)[0] ** 2))
    np.testing.assert_allclose(
        slope(y0, system)[0], modes @ slope(z0, alone)[0], atol=10 * rounding
    )


@pytest.mark.parametrize("h_gamma", [20.0, 40.0])
def test_a_matrix_is_as_strong_as_its_modes(h_gamma):
    ((system, y0), (alone, z0)), _ = chain_and_modes(8, 1.0)
    fastest = float(np.max(alone.laws[0].coefficients))
    h = h_gamma / fastest
    results = [
        solve(x, dps.TunedRKN6(), 0.0, 40 * h, h, y, adjoint=FIXED, throw=False).result
        for x, y in ((system, y0), (alone, z0))
    ]
    good = [x == dfx.RESULTS.successful for x in results]
    assert good == ([True, True] if h_gamma < 29 else [False, False])
