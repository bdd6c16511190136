# pyright: reportArgumentType=false, reportOptionalSubscript=false
# pyright: reportOptionalMemberAccess=false, reportOptionalIterable=false
# pyright: reportCallIssue=false
"""Steps of Gauss collocation that converge, fail, and are never wrong in silence."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.linalg
import scipy.special
from helpers import harmonic, mixed_energy, solve, substeps

import diffrax_presym as dps


NEWTON = optx.Newton(rtol=1e-13, atol=1e-13)


def is_successful(sol):
    return sol.result == dfx.RESULTS.successful


# The fixed-point iteration

# Stiffness matrices: oscillators, a chain without anchor, and free particles with one
# that is bound.
CHAIN = 100.0 * np.array([[1, -1, 0], [-1, 2, -1], [0, -1, 1]])
STIFFNESS = np.diag([1.0, 30.0, 900.0]), CHAIN, np.diag([0.0, 0.0, 50.0])


def starts(k, dtype):
    """From rest or not, near the origin and far, of any amplitude, and steps."""
    rng = np.random.default_rng(k)
    size = 10 ** rng.uniform(-4, 0.5, (100, 1))
    far = rng.choice([0.0, 1.0, 1e3, 1e6], (100, 1))
    if k == 0:
        far = np.zeros_like(far)
    q, p = size * rng.standard_normal((2, 100, 3))
    q, p = q * rng.choice([0, 1], (100, 1)), p * rng.choice([0, 1], (100, 1))
    far = far * (np.ones(3) if k == 1 else np.array([1.0, 0.0, 0.0]))
    frequency = np.sqrt(np.max(np.linalg.eigvalsh(STIFFNESS[k])))
    h = 10 ** rng.uniform(-1, 1, 100) / frequency
    return [x.astype(dtype) for x in (q + far, p, h)]


@pytest.mark.variants(4)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stages", [1, 2, 4, 8])
@pytest.mark.parametrize("k", range(3))
def test_what_is_successful_satisfies_the_equations(k, stages, dtype):
    stiffness = jnp.asarray(STIFFNESS[k], dtype)
    potential = lambda t, q, args: q @ stiffness @ q / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    solver, eps = dps.PresymplecticGauss(stages), np.finfo(dtype).eps

    @jax.jit
    @jax.vmap
    def step(q, p, h):
        start = jnp.zeros_like(h)
        options = {"saveat": dfx.SaveAt(t1=True, solver_state=True), "throw": False}
        sol = dfx.diffeqsolve(system, solver, start, h, h, (q, p), **options)
        return sol.solver_state.slopes, is_successful(sol)

    x, weights = np.polynomial.legendre.leggauss(stages)
    # Lagrange polynomials, and their integrals, in Legendre polynomials.
    to_legendre = np.polynomial.legendre.legvander(x, stages - 1).T * weights
    to_legendre *= np.arange(stages)[:, None] + 0.5
    integrals = np.polynomial.legendre.legint(np.eye(stages), lbnd=-1)
    A = np.polynomial.legendre.legval(x, integrals).T @ to_legendre / 2
    q, p, h = starts(k, dtype)
    slopes, successful = jax.tree.map(np.asarray, step(q, p, h))
    assert 20 < np.sum(successful)
    for i in np.flatnonzero(successful):
        v, f = (2 * x[i].astype(float) / weights[:, None] for x in slopes)
        Q, P = q[i] + A @ v, p[i] + A @ f
        step_length = float(h[i])
        # The rounding of the largest numbers, and its effect on slopes: wrong steps are
        # wrong by 1e6 times as much and more.
        largest = lambda x: eps * np.max(np.abs(x))
        rounding = step_length * largest(Q) * np.max(np.abs(STIFFNESS[k]))
        limits = largest(Q) + step_length * largest(P), largest(P) + rounding
        errors = step_length * P - v, -step_length * Q @ STIFFNESS[k] - f
        for error, limit in zip(errors, limits, strict=True):
            assert np.max(np.abs(error)) <= 1e2 * limit


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stages", [1, 4])
def test_motion_comes_to_rest_far_from_the_origin(stages, dtype):
    """Where momenta are rounding, and forces are differences of positions."""

    def potential(t, q, far):
        near, other = q["a"] - far, q["b"] - q["a"] + far
        return (jnp.sum(near**2) + jnp.sum(other**2) / 4) / 2

    law = dps.ConstantDamping(0.3)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, law)
    number = lambda x: jnp.asarray(x, dtype)

    @jax.jit
    @jax.vmap
    def end(far):
        q = {"a": far + number([0.3, -0.1]), "b": number([0.2, 0.0])}
        p = jax.tree.map(jnp.zeros_like, q)
        times, solver = map(number, (0.0, 200.0, 1.0)), dps.PresymplecticGauss(stages)
        options = {"adjoint": dps.FixedStepAdjoint(), "throw": False}
        return is_successful(
            dfx.diffeqsolve(system, solver, *times, (q, p), far, **options)
        )

    assert np.all(end(number([0.0, 0.3, 1.0, 1e3, 1e6])))


def links(n):
    """A chain of hanging links of unit length and weight, and angles of its start."""
    below = np.arange(n, 0, -1) / n
    mass = lambda t, q, args: (
        np.minimum.outer(below, below) * jnp.cos(q[:, None] - q[None])
    )
    potential = lambda t, q, args: -jnp.sum(below * jnp.cos(q))
    system = dps.LagrangianSystem(mass, potential, dps.ConstantDamping(0.05))
    return system, (jnp.linspace(0.8, 0.5, n), jnp.zeros(n))


# A mass of six positions is factorised once in a round, that of two for each velocity.
@pytest.mark.parametrize("n", [2, 6])
def test_momenta_first_takes_half_of_the_iterations(n):
    system, y0 = links(n)
    solver = dps.PresymplecticGauss(4, tolerance=1e-7, max_iterations=6)
    sol = solve(system, solver, 0.0, 40.0, 0.4, y0, throw=False)
    assert is_successful(sol)


@pytest.mark.parametrize("tolerance", [1e-10, 1e-6])
def test_a_gradient_by_reversal_allows_the_error_of_the_tolerance(tolerance):
    system, y0 = links(2)

    def end(y0, tolerance, adjoint):
        solver = dps.Suzuki4(dps.PresymplecticGauss(2, tolerance=tolerance))
        options = {"adjoint": adjoint, "max_steps": 200}
        sol = dfx.diffeqsolve(system, solver, 0.0, 10.0, 0.2, y0, **options)
        return sol.ys[0][-1, 0]

    exact = jax.grad(end)(y0, 0.0, dps.FixedStepAdjoint("checkpoints"))
    found = jax.grad(end)(y0, tolerance, dps.FixedStepAdjoint())
    for x, y in zip(found, exact, strict=True):
        np.testing.assert_allclose(x, y, atol=100 * tolerance)


def test_a_guess_that_diverges_is_dropped():
    system, y0 = links(6)
    solver = dps.PresymplecticGauss(8)
    solve_by = lambda dt0: solve(system, solver, 0.0, 40.0, dt0, y0, throw=False)
    # The extrapolated slopes of one of the long steps are out of all bounds.
    sol, exact = solve_by(0.625), solve_by(0.25)
    assert is_successful(sol) and is_successful(exact)
    for x, y in zip(sol.ys, exact.ys, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)


@pytest.mark.parametrize("frequency", [1.0, 3.0, 30.0])
def test_gradient_at_an_equilibrium(frequency):
    """The step converges at once, whatever its length; its derivatives may not."""
    potential = lambda t, q, args: frequency**2 * jnp.sum(q**2) / 2
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    solver = dps.PresymplecticGauss(4)
    end = lambda q: solve(system, solver, 0.0, 1.0, 1.0, (q, jnp.zeros(1))).ys[0][-1, 0]
    found = jax.grad(end)(jnp.zeros(1))[0]
    assert found == pytest.approx(np.cos(frequency), abs=1e-3) or (
        frequency == 30.0 and np.isnan(found)
    )


@pytest.mark.parametrize("finder", [None, NEWTON])
def test_the_message_of_a_step_that_is_too_long(finder):
    if finder is None:
        energy, name = lambda t, q, p, args: 50 * jnp.sum(q**2 + p**2), "fixed-point"
    else:
        # With p' = 1 + p^2 a long step has no real solution.
        energy, name = lambda t, q, p, args: -jnp.sum(q * (1 + p**2)), "root finder"
    solver = dps.PresymplecticGauss(1, finder)
    y0 = jnp.ones(1), jnp.ones(1)
    sol = solve(dps.Hamiltonian(energy), solver, 0.0, 4.0, 1.0, y0, throw=False)
    message = dfx.RESULTS[sol.result]
    assert f"The {name}" in message and "Take shorter steps" in message


# A root that is not found is a result


def hard_energy(t, q, p, args):
    """Not separable, and linear for a root finder except in a time interval."""
    start, end = args
    hard = jnp.where((t >= start) & (t <= end), 1.0, 0.0)
    return jnp.sum(q**2 + p**2) / 2 + hard * mixed_energy(t, q, p, None)


# Two steps of Newton's method solve a linear equation and confirm convergence.
MIDPOINT = dps.PresymplecticGauss(1, optx.Newton(rtol=1e-10, atol=1e-10), 2)
# Schemes, and the times at which their root finds fail: in the first or the last step,
# the first or the last stage.
UNSOLVED = {
    "midpoint": (MIDPOINT, (0.125, 0.875)),
    "Suzuki4": (dps.Suzuki4(MIDPOINT), (0.0518, 0.9482)),
    "substeps": (substeps(MIDPOINT, 2), (0.0625, 0.9375)),
}


@pytest.mark.parametrize("solver, times", UNSOLVED.values(), ids=UNSOLVED)
def test_roots_that_are_not_found_are_a_result(solver, times):
    y0 = jnp.array([0.7, -0.3]), jnp.array([0.4, 0.9])

    def find(solver, start, end):
        args = dps.Hamiltonian(hard_energy), solver, 0.0, 1.0, 0.25, y0
        window = jnp.array(start), jnp.array(end)
        return solve(*args, window, throw=False).result

    assert find(solver, 2.0, 2.0) == dfx.RESULTS.successful
    for t in times:
        message = dfx.RESULTS[find(solver, t - 0.01, t + 0.01)]
        assert "root finder of `PresymplecticGauss` did not find the stages" in message
    # Tolerances that cannot be met.
    never = dps.PresymplecticGauss(1, optx.Newton(rtol=0.0, atol=0.0))
    assert find(never, 0.0, 1.0) != dfx.RESULTS.successful


def test_the_derivative_in_time_of_a_stage_in_the_middle_of_its_step():
    law = dps.ViscousDamping(jnp.array([[0.5, 0.4], [0.1, 0.8]]))
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law)
    gauss, options = dps.PresymplecticGauss(1), {"adjoint": dfx.ForwardMode()}
    loss = lambda h: jnp.sum(solve(system, gauss, 0.0, h, h, Y0, **options).ys[0])
    wanted = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jacfwd(loss)(0.3), wanted, 1e-7)


# Friction that is strong over a step

RATES = np.array([[1.0, 0.3], [0.2, 0.7]])


def damped(strength, step, coupled):
    rate = strength / step
    law = dps.ViscousDamping(rate * RATES) if coupled else dps.ConstantDamping(rate)
    rates = rate * (RATES if coupled else np.eye(2))
    one = np.eye(2)
    flow = np.block([[0 * one, one], [-one, -rates]])
    return dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law), flow


Y0 = jnp.array([1.0, -0.5]), jnp.array([0.3, 0.2])


@pytest.mark.parametrize("finder", [None, NEWTON])
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(("stages", "tolerance"), [(1, 0.3), (2, 0.05), (4, 1e-3)])
def test_strong_friction(stages, tolerance, coupled, finder):
    for strength in (0.1, 1.0, 3.0, 10.0, 100.0):
        system, flow = damped(strength, 0.25, coupled)
        options = {"adjoint": dps.FixedStepAdjoint(), "throw": False}
        solver = dps.PresymplecticGauss(stages, finder)
        sol = solve(system, solver, 0.0, 10.0, 0.25, Y0, **options)
        exact = scipy.linalg.expm(10 * flow) @ np.concatenate(Y0)
        if finder is None and not is_successful(sol):
            assert strength > 1
            continue
        assert is_successful(sol)
        for found, part in zip(sol.ys, np.split(exact, 2), strict=True):
            error = np.max(np.abs(found[-1] - part))
            # Of weak friction the phase is the error.
            assert error < tolerance * (np.max(np.abs(part)) + 0.1 * (strength < 1))


@pytest.mark.parametrize("coupled", [False, True])
def test_gradients_and_reversal_of_strong_friction(coupled):
    # A half is in the frame.
    system, _ = damped(2.0, 0.25, coupled)
    solver = dps.PresymplecticGauss(2)

    def end(y, adjoint):
        ys = solve(system, solver, 0.0, 1.0, 0.25, y, adjoint=adjoint).ys
        return sum(jnp.sum(jnp.sin(x[-1])) for x in ys)

    adjoints = dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()
    both = [jax.grad(end)(Y0, adjoint) for adjoint in adjoints]
    for x, y in zip(*both, strict=True):
        assert x == pytest.approx(np.asarray(y), rel=1e-9)
    there = solve(system, solver, 0.0, 0.5, 0.25, Y0).ys
    y1 = jax.tree.map(lambda x: x[-1], there)
    back = solve(system, solver, 0.5, 0.0, -0.25, y1).ys
    for x, y in zip(back, Y0, strict=True):
        assert x[-1] == pytest.approx(np.asarray(y), rel=1e-11)


@pytest.mark.parametrize("strength", [0.1, 2.0])
@pytest.mark.parametrize(
    "wrap", [dps.Suzuki4, lambda x: dps.SofroniouSpaletta(6, dps.Compensated(x))]
)
def test_compositions_with_friction_by_a_function_of_time(wrap, strength):
    """The same as by the class for this friction, also where it is not in frames."""
    constant, _ = damped(strength, 0.25, coupled=False)
    eta = lambda t: strength / 0.25 * t
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, eta)
    solver = wrap(dps.PresymplecticGauss(1))
    both = [solve(x, solver, 0.0, 2.0, 0.25, Y0).ys for x in (system, constant)]
    for x, y in zip(*both, strict=True):
        assert x == pytest.approx(np.asarray(y), rel=1e-10)


@pytest.mark.parametrize("start", [0.0, 1e-3, 0.05])
@pytest.mark.parametrize("stages", [1, 2, 4])
def test_friction_after_a_singularity_is_in_the_frame(stages, start):
    # q'' + 3 / t q' + q = 0 from rest at t = 0 has the solution 2 J_1(t) / t.
    law = dps.LogDamping(3.0)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law)
    y0 = jnp.ones(1), -jnp.ones(1) * start / 4
    solver = dps.PresymplecticGauss(stages)
    q = solve(system, solver, start, 4 + start, 0.1, y0).ys[0][-1, 0]
    t = 4 + start
    assert q == pytest.approx(2 * scipy.special.j1(t) / t, abs=5e-3)
