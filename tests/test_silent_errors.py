# pyright: reportOptionalSubscript=false, reportArgumentType=false
"""Wrong numbers with a successful result, each found once from outside."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.linalg
from helpers import harmonic, solve, substeps

import diffrax_presym as dps


successful = dfx.RESULTS.successful
UNIT_MASS = dps.QuadraticKinetic()
END = dict(max_steps=20_000, throw=False)
C = np.array([[0.5, 0.4], [0.1, 0.8]])
Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.2, 0.3]))


def last(sol):
    return jax.tree.map(lambda y: y[-1], sol.ys)


def by_matrix(t):
    """The oscillator with friction by the matrix `C`."""
    zero, one = np.zeros((2, 2)), np.eye(2)
    flow = scipy.linalg.expm(t * np.block([[zero, one], [-one, -C]]))
    return flow @ np.concatenate(Y0)


@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), None], ids=repr)
@pytest.mark.parametrize(
    "solver",
    [dps.PresymplecticGauss(4), substeps(dps.PresymplecticGauss(3), 2)],
    ids=lambda x: type(x).__name__,
)
def test_matrix_friction_with_collocation(solver, adjoint):
    system = mechanical(dps.ViscousDamping(jnp.asarray(C)))
    options = {} if adjoint is None else {"adjoint": adjoint}
    sol = solve(system, solver, 0.0, 5.0, 0.2, Y0, **END, **options)
    assert np.max(np.abs(np.concatenate(last(sol)) - by_matrix(5.0))) < 1e-7


@pytest.mark.parametrize(
    ("potential", "law"),
    [
        (dps.QuadraticPotential(), lambda t: 0.5 * jnp.maximum(t - 4.03, 0)),
        (dps.QuadraticPotential(), dps.LogDamping(2.0, 1.0)),
        (harmonic, dps.ConstantDamping(0.1)),
    ],
)
def test_a_scheme_for_linear_systems_refuses_others(potential, law):
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, law)
    with pytest.raises(ValueError, match="only for a linear force"):
        solve(system, dps.TunedLinear8(), 0.0, 10.0, 0.1, Y0)


@pytest.mark.parametrize("gamma", [40.0, 55.0])
def test_saved_times_with_strong_friction(gamma):
    # Of many unknowns.
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(gamma),
    )
    q0 = jnp.linspace(0.5, 2.5, 100)
    errors = []
    for ts in ([5.0, 5.5], [5.1, 5.25, 5.4]):
        ts = jnp.array(ts)
        options = dict(saveat=dfx.SaveAt(ts=ts), adjoint=dps.FixedStepAdjoint())
        both = [
            solve(system, dps.TunedRKN6(), 0.0, 10.0, h, (q0, 0 * q0), **options)
            for h in (0.5, 0.025)
        ]
        errors.append(np.max(np.abs(both[0].ys[1] - both[1].ys[1])))
    assert errors[1] < 3 * errors[0] + 1e-4


@pytest.mark.parametrize(
    "solver, gamma",
    [(dps.BlanesMoanRKN4(), 100.0), (dps.BlanesMoan6(), 100.0)],
    ids=lambda x: getattr(type(x), "__name__", ""),
)
@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), None], ids=repr)
def test_stages_backwards_in_time_under_strong_friction(solver, gamma, adjoint):
    # A strongly damped joint among ordinary ones.
    rates = jnp.array([0.1, gamma])
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), harmonic, friction=dps.ConstantDamping(rates)
    )
    options = {} if adjoint is None else {"adjoint": adjoint}
    y0 = jnp.ones(2), jnp.zeros(2)
    sol = solve(system, solver, 0.0, 10.0, 1.0, y0, **END, **options)
    exact = np.exp(-10 / gamma)
    assert sol.result != successful or abs(last(sol)[0][1] - exact) < 1e-2


def test_an_infinite_span():
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic)
    sol = dfx.diffeqsolve(
        system,
        dps.PresymplecticLeapfrog(),
        *(0.0, jnp.inf, 0.1, Y0),
        **{"max_steps": 30, "throw": False, "adjoint": dps.FixedStepAdjoint()},
    )
    assert sol.result == dfx.RESULTS.max_steps_reached
    assert sol.stats["num_steps"] == 30


def test_equal_laws_from_a_singularity_are_equally_accurate():
    pendulum = lambda t, q, args: -jnp.sum(jnp.cos(q))
    y0, numbers = (jnp.array([1.0, 2.0]), jnp.zeros(2)), jnp.array([3.0, 2.0])
    ends = []
    for law in (
        dps.LogDamping(numbers),
        [dps.LogDamping(numbers - 1), dps.LogDamping(1.0)],
    ):
        system = dps.MechanicalSystem(dps.QuadraticKinetic(), pendulum, friction=law)
        ends.append(last(solve(system, dps.TunedRKN6(), 0.0, 2.0, 0.25, y0)))
    for end in ends[1:]:
        np.testing.assert_allclose(end[0], ends[0][0], rtol=1e-12)


@pytest.mark.parametrize("size", [5.0, 11.0, 14.0])
def test_friction_by_an_operator_in_single_precision(size):
    matrix = np.diag(np.linspace(0.1, size, 8).astype(np.float32))
    p0 = jnp.ones(8, jnp.float32)
    like = jax.ShapeDtypeStruct((8,), jnp.float32)
    operator = lx.FunctionLinearOperator(lambda v: jnp.asarray(matrix) @ v, like)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: 0.0 * jnp.sum(q),
        friction=dps.ViscousDamping(operator),
    )
    t0, t1 = jnp.float32(0), jnp.float32(1)
    sol = solve(system, dps.Strang(), t0, t1, t1, (0 * p0, p0), **END)
    _, p = last(sol)
    exact = np.exp(-np.diag(matrix).astype(float))
    accurate = np.max(np.abs(np.asarray(p) - exact)) < 2e-5
    assert accurate or not np.all(np.isfinite(p))


def test_two_particles_at_one_place():
    potential = dps.pairwise_potential(lambda t, r, args: -1 / jnp.sqrt(1 + r**2))
    q = jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    force = jax.grad(lambda q: potential(0.0, q, None))(q)
    assert np.all(np.isfinite(force))


def test_an_energy_that_is_infinite_at_the_distance_one():
    energy = lambda t, r, c: c / (r**2 - 1) ** 2
    potential = dps.pairwise_potential(energy)
    q = jnp.array([[0.0, 0.0], [2.0, 0.0]])
    slope = jax.grad(lambda c: potential(0.0, q, c))(2.0)
    np.testing.assert_allclose(slope, 1 / 9)


@pytest.mark.parametrize(
    "saveat", [dfx.SaveAt(t1=True), dfx.SaveAt(ts=np.array([0.5, 40.0]))]
)
def test_a_step_that_is_too_large_is_a_failure(saveat):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q**4) / 4, None
    )
    sol = dfx.diffeqsolve(
        system,
        dps.TunedRKN6(),
        *(0.0, 50.0, 25.0, Y0),
        **{"saveat": saveat, "throw": False, "adjoint": dps.FixedStepAdjoint()},
    )
    assert not np.all(np.isfinite(last(sol)[0]))
    assert sol.result != successful


def pendulum(k):
    return mechanical(None, lambda t, q, args: k * jnp.sum(1 - jnp.cos(q)))


def slope(fn, x, h=1e-5):
    return (fn(x + h) - fn(x - h)) / (2 * h)


def solved(system, solver, t1=1.0, dt0=0.1, y0=Y0, **options):
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": 64} | options
    return dfx.diffeqsolve(system, solver, 0.0, t1, dt0, y0, **options)


def mechanical(friction, potential=harmonic, kinetic=UNIT_MASS):
    return dps.MechanicalSystem(kinetic, potential, friction)


def exact(system, t0, t1, y0):
    options = {"stepsize_controller": dfx.PIDController(rtol=1e-12, atol=1e-12)}
    return solve(system, dfx.Dopri8(), t0, t1, 0.01, y0, max_steps=20_000, **options)


def distance(a, b):
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in zip(a, b, strict=True))


def test_an_entry_without_friction_beside_one_with_a_singularity():
    system = mechanical(dps.LogDamping(jnp.array([3.0, 0.0])))
    y0 = jnp.ones(2), jnp.array([0.0, 1.0])
    q, p = last(solve(system, dps.TunedRKN6(), 0.0, 2.0, 0.1, y0))
    assert distance((q[1], p[1]), np.cos(2) + np.array([1, -1]) * np.sin(2)) < 1e-10


def test_equal_laws_of_both_energies_from_a_singularity():
    law, y0 = dps.LogDamping(3.0), (jnp.ones(2), jnp.zeros(2))
    general = dps.DissipativeHamiltonian(dps.QuadraticKinetic(), harmonic, law, law)
    end = lambda x: last(solve(x, dps.TunedRKN6(), 0.0, 2.0, 0.1, y0))
    assert distance(end(general), end(mechanical(law))) < 1e-12


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_two_laws_of_a_relativistic_energy_from_a_singularity(shift):
    law, t0 = dps.LogDamping(3.0, shift), -shift
    two = dps.RelativisticKinetic(), harmonic, law, law
    system, y0 = dps.DissipativeHamiltonian(*two), (jnp.ones(2), jnp.zeros(2))
    end = last(solve(system, dps.BlanesMoan4(), t0, t0 + 1, 1e-2, y0))
    assert distance(end, last(exact(system, t0, t0 + 1, y0))) < 1e-4


def test_powers_without_a_singularity():
    for delta in (0.0, 1.0, 2.0):
        system = mechanical(dps.PowerDamping(0.3, delta))
        end = last(solve(system, dps.TunedRKN6(), 0.0, 2.0, 0.1, Y0))
        assert distance(end, last(exact(system, 0.0, 2.0, Y0))) < 1e-9


def test_the_derivative_in_time_of_a_power_that_starts_at_zero():
    def end(law, t0):
        times = t0, t0 + 1, 0.1
        forward = dict(max_steps=20, adjoint=dfx.ForwardMode())
        return last(solve(mechanical(law), dps.Strang(), *times, Y0, **forward))[0]

    laws = dps.PowerDamping(0.5, 2.0), lambda t: 0.5 * t * t
    slopes = [jax.jacfwd(lambda t0, law=law: end(law, t0))(0.0) for law in laws]
    assert distance(*slopes) < 1e-12


def test_a_law_that_joins_linear_and_other_friction():
    class Joined(dps.extend.AbstractFriction):
        def parts(self, mechanics):
            drag = dps.Drag(0.5).parts(mechanics)
            return dps.ConstantDamping(0.1).parts(mechanics) + drag

        def force(self, t, q, p, v, args):
            return -0.1 * p - 0.5 * jnp.linalg.norm(v) * v

    with pytest.raises(ValueError, match="Write two laws"):
        mechanical(Joined())


def test_friction_by_place_as_a_matrix_and_as_a_number():
    matrix = lambda t, q, args: (1 + jnp.sum(q**2)) * jnp.asarray(C)
    system = mechanical(dps.PositionDamping(matrix))
    error = lambda n: distance(
        last(solve(system, dps.BlanesMoan6(), 0.0, 2.0, 2 / n, Y0)),
        last(exact(system, 0.0, 2.0, Y0)),
    )
    assert error(16) < 1e-6 and error(32) < error(16) / 30
    y0 = {"a": Y0[0]}, {"a": Y0[1]}
    potential = lambda t, q, args: jnp.sum(q["a"] ** 2) / 2
    by_number = dps.PositionDamping(lambda t, q, args: 0.3)
    q, p = last(
        solve(mechanical(by_number, potential), dps.Strang(), 0.0, 1.0, 0.1, y0)
    )
    assert np.all(np.isfinite(q["a"]) & np.isfinite(p["a"]))


@pytest.mark.parametrize("law", [dps.PositionDamping, dps.ViscousDamping, dps.Drag])
def test_a_function_of_friction_that_returns_nothing(law):
    y0 = jnp.ones((1, 2)), jnp.ones((1, 2))
    system = mechanical(law(lambda t, q, args: None))
    with pytest.raises(ValueError, match="returned None"):
        solve(system, dps.Strang(), 0.0, 1.0, 0.1, y0)


def test_friction_by_place_that_amplifies_too_much():
    system = mechanical(dps.PositionDamping(lambda t, q, args: 200.0))
    sol = solve(system, dps.BlanesMoan4(), 0.0, 10.0, 1.0, Y0, **END)
    assert sol.result != successful


@pytest.mark.parametrize("times", [[0.0, 3000.0], [0.0]])
def test_the_energy_balance_over_long_times(times):
    system, ts = mechanical(dps.ConstantDamping(1e-3)), jnp.array(times)
    saveat = dfx.SaveAt(ts=ts)
    sol = solved(system, dps.TunedRKN6(), 3e3, 0.25, saveat=saveat, max_steps=None)
    error = dps.diagnostics.energy_error(system, ts, sol.ys)
    assert error.shape == ts.shape
    assert np.max(np.abs(error)) < 1e-8


def test_momenta_of_velocities():
    matrix = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.7, 0.2], [0.1, 0.2, 3.3]])
    general = dps.Hamiltonian(lambda t, q, p, args: p @ matrix @ p / 2)
    relativistic = mechanical(None, kinetic=dps.RelativisticKinetic(2.0, 3e8))
    for system, size in ((general, 1e3), (relativistic, 1e8)):
        for seed in range(4):
            v = size * np.random.default_rng(seed).standard_normal(3) / 2
            y = system.from_velocity(0.0, (jnp.zeros(3), jnp.asarray(v)))
            np.testing.assert_allclose(system.to_velocity(0.0, y)[1], v, 1e-10)
    fast = dps.Hamiltonian(lambda t, q, p, args: jnp.sqrt(1 + p @ p))
    v = jnp.array([0.999])
    wanted = 0.999 / np.sqrt(1 - 0.999**2)
    np.testing.assert_allclose(fast.from_velocity(0.0, (v, v))[1], wanted, 1e-10)


def test_steps_for_a_fast_force_and_for_times_in_single_precision():
    fast = lambda t, q, args: jnp.sum(q**2) / 2 - 5 * jnp.sum(q) * jnp.cos(126 * t)
    system = mechanical(dps.ConstantDamping(0.1), fast)

    def solve_by(dt0, dtype=float, saveat=None):
        saveat = dfx.SaveAt(t1=True) if saveat is None else saveat
        y0 = jax.tree.map(lambda x: x.astype(dtype), Y0)
        options = {"saveat": saveat, "max_steps": None}
        return solved(system, dps.TunedRKN6(), 10.0, dt0, y0, **options)

    step = dps.choose_step(jax.jit(solve_by), 0.0, 10.0, rtol=1e-9, atol=1e-9)
    assert step.steps < 1000
    end = last(solve_by(step.dt0))
    assert distance(end, last(exact(system, 0.0, 10.0, Y0))) < 1e-8
    ts = np.linspace(0, 10, 101, dtype=np.float32)
    system = mechanical(dps.ConstantDamping(0.1))
    rough = lambda dt0: solve_by(dt0, jnp.float32, dfx.SaveAt(ts=jnp.asarray(ts)))
    assert dps.choose_step(jax.jit(rough), 0.0, 10.0, rtol=1e-3, atol=1e-3).steps < 20
    batch = jax.vmap(solve_by, axis_size=2, in_axes=None)
    with pytest.raises(ValueError, match="most difficult member"):
        dps.choose_step(batch, 0.0, 10.0, rtol=1e-3, atol=1e-3)


def test_gradients_of_a_force_that_ends_with_the_solve():
    def loss(k):
        force = dps.ForceField(lambda t, q, args: -k * q * jnp.sqrt(1 - t))
        saveat = dfx.SaveAt(ts=jnp.array([0.35, 1.0]))
        leapfrog = dps.PresymplecticLeapfrog()
        return jnp.sum(solved(mechanical(None, force), leapfrog, saveat=saveat).ys[0])

    np.testing.assert_allclose(jax.grad(loss)(1.3), slope(loss, 1.3), 1e-7)


def test_gradients_of_rows_that_are_not_reached():
    def loss(x):
        q0 = Y0[0] + x
        fn = lambda t, y, args: jnp.linalg.norm(y[0] - q0)
        saveat = dfx.SaveAt(steps=True, fn=fn)
        y0, leapfrog = (q0, Y0[1]), dps.PresymplecticLeapfrog()
        sol = solved(pendulum(1.3), leapfrog, y0=y0, saveat=saveat)
        return jnp.sum(sol.ys[:10])

    np.testing.assert_allclose(jax.grad(loss)(0.2), slope(loss, 0.2), 1e-7)


def test_the_derivative_in_time_of_a_stage_in_the_middle_of_its_step():
    def loss(h):
        step = mechanical(dps.ViscousDamping(C)), dps.PresymplecticGauss(1), 0.0, h, h
        return jnp.sum(last(solve(*step, Y0, adjoint=dfx.ForwardMode()))[0])

    derivative = jax.jit(jax.jacfwd(loss))
    np.testing.assert_allclose(derivative(0.3), slope(jax.jit(loss), 0.3), 1e-7)


def test_a_scheme_is_compensated_once():
    with pytest.raises(ValueError, match="Remove one"):
        dps.Compensated(substeps(dps.Compensated(dps.TunedRKN6()), 2))


def test_the_gradient_at_rest_at_the_origin():
    y0 = jnp.zeros(2), jnp.zeros(2)

    def loss(y0):
        return jnp.sum(last(solved(pendulum(1.3), dps.TunedRKN6(), y0=y0))[0])

    found, wanted = jax.grad(loss)(y0), jax.grad(loss)((Y0[0] * 1e-9, Y0[1] * 1e-9))
    assert distance(found, wanted) < 1e-12
