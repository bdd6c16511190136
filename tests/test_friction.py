"""Laws of friction as operators, at their singular times and in their limits."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close, flat, harmonic, solve

import diffrax_presym as dps
from diffrax_presym._system import System


H = 0.3
LAWS = {
    "constant": dps.ConstantDamping(0.7),
    "exciting": dps.ConstantDamping(-0.7),
    "logarithmic": dps.LogDamping(3.0, shift=0.5),
    "mixed": dps.MixedDamping(2.0, 0.75, 0.25),
    "function": dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), harmonic, lambda t: 0.3 * t**2
    ).damping,
}
laws = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


@laws
def test_operators_solve_the_equation_of_friction(law):
    # p' = F - Gamma p, and the integral of p, by an independent integration.
    t, p0, force = 1.3, np.array([0.9, -0.4]), np.array([0.5, 1.0])

    def rhs(s, x, force):
        p = x[:2]
        net = law.net_force(jnp.asarray(s), jnp.asarray(force), jnp.asarray(p))
        return np.concatenate([net, p])

    def after(p, force):
        x = np.concatenate([p, np.zeros(2)])
        end = scipy.integrate.solve_ivp(
            rhs, (t, t + H), x, "DOP853", args=(force,), rtol=1e-12, atol=1e-13
        )
        return np.split(end.y[:, -1], 2)

    times, zero = (jnp.asarray(t), jnp.asarray(H)), np.zeros(2)
    left, travelled = after(p0, zero)
    gained, _ = after(zero, force)
    np.testing.assert_allclose(p0 + law.decay(*times, jnp.asarray(p0)), left, 1e-10)
    np.testing.assert_allclose(
        law.carry(*times, jnp.asarray(p0), order=12), travelled, 1e-10
    )
    np.testing.assert_allclose(
        law.respond(*times, jnp.asarray(force), order=12), gained, 1e-10
    )
    grown = law.amplification(*times, jnp.asarray(p0))
    np.testing.assert_allclose(grown, p0 / left, 1e-10)


# Times that are integers.


@pytest.mark.parametrize("time", [10, np.int64(10), jnp.array(10)], ids=repr)
def test_integer_times_truncate_nothing(time):
    t = jnp.array(10.0)
    for law in LAWS.values():
        if law is not LAWS["function"]:
            assert_close(law(time), law(t), 1e-15)
        assert_close(law.rate(time), law.rate(t), 1e-15)
        assert_close(law.increment(time, time), law.increment(t, t), 1e-15)
    for scaling in (dps.PolynomialScaling(2.5, 0.3), dps.ExponentialScaling(0.3, 0.3)):
        for name in ("alpha", "beta", "rate", "strength"):
            fn = getattr(scaling, name)
            assert_close(fn(time), fn(t), 1e-15)
    system = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), harmonic, dps.ConstantDamping(0.1)
    )
    y, term = (jnp.array([0.3]), jnp.array([0.7])), dps.HamiltonianTerm(system)
    assert_close(term.vf(time, y, None), term.vf(t, y, None), 1e-15)
    for name in ("to_canonical", "from_canonical"):
        fn = getattr(system, name)
        assert_close(fn(time, y[1]), fn(t, y[1]), 1e-15)
    assert_close(system.canonical(time, *y), system.canonical(t, *y), 1e-15)
    assert_close(system.log_scale(time), system.log_scale(t), 1e-15)


def test_diagnostics_take_integer_times():
    system = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), harmonic, dps.ConstantDamping(0.1)
    )
    y, term = (jnp.array([0.3]), jnp.array([0.7])), dps.HamiltonianTerm(system)
    defect = dps.diagnostics.structure_defect(term, dps.Strang(), 0, 1, y)
    assert defect < 1e-14
    order = dps.diagnostics.convergence_order(term, dps.Strang(), 0, 2, y, 20)
    assert abs(order - 2) < 0.1


# From rest at the time when friction is infinite.

REST = (jnp.array([1.0, -0.5]), jnp.zeros(2))
SINGULAR = {
    "logarithmic": dps.LogDamping(3.0),
    "mixed": dps.MixedDamping(3.0, 0.5, 0.5),
    "none": dps.LogDamping(0.0),
    "power alone": dps.MixedDamping(0.0, 0.5, 0.5),
}
singular = pytest.mark.parametrize("law", SINGULAR.values(), ids=SINGULAR)
INSIDE = [dps.PresymplecticLeapfrog(), dps.BlanesMoanRKN4(), dps.TunedRKN6()]


def singular_system(law):
    return dps.ConformalHamiltonian(dps.QuadraticKinetic(), harmonic, law)


@singular
@pytest.mark.parametrize("solver", INSIDE[::2], ids=lambda x: type(x).__name__)
def test_dense_output_from_rest(law, solver):
    ts = jnp.linspace(0.0, 1.0, 21)
    saveat = dfx.SaveAt(ts=ts)
    sol = solve(singular_system(law), solver, 0.0, 1.0, 0.05, REST, saveat=saveat)
    coarse = solve(singular_system(law), solver, 0.0, 1.0, 0.1, REST, saveat=saveat)
    # An accurate solve from a little later on.
    start = jax.tree.map(lambda y: y[1], sol.ys)
    sol2 = solve(
        singular_system(law),
        dfx.Dopri8(scan_kind="bounded"),
        *(ts[1], 1.0, 0.001),
        start,
        saveat=dfx.SaveAt(ts=ts[1:]),
    )
    fine, exact, coarse = map(flat, (sol.ys, sol2.ys, coarse.ys))
    assert np.all(np.isfinite(fine)) and np.all(np.isfinite(coarse))
    np.testing.assert_allclose(coarse, fine, atol=2e-2)
    np.testing.assert_allclose(
        flat(jax.tree.map(lambda y: y[1:], sol.ys)), exact, atol=1e-2
    )


def test_any_solver_of_diffrax_starts_from_rest():
    # Nesterov's ODE with a quadratic: q = 2 J_1(t) / t.
    q0 = (jnp.array([1.0]), jnp.array([0.0]))
    controller = dfx.PIDController(rtol=1e-9, atol=1e-9)
    sol = solve(
        singular_system(dps.LogDamping(3.0)),
        dfx.Tsit5(scan_kind="bounded"),
        *(0.0, 2.0, 1e-3, q0),
        stepsize_controller=controller,
    )
    assert sol.ys is not None
    np.testing.assert_allclose(sol.ys[0][-1, 0], 0.5767248078, atol=1e-7)


def test_no_motion_but_from_rest():
    field = dps.HamiltonianTerm(singular_system(dps.LogDamping(3.0))).vf
    _, dp = field(0.0, (jnp.ones(1), jnp.ones(1)), None)
    assert np.all(np.isnan(dp))


def loss(law, solver, adjoint, saveat):
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(singular_system(law)),
        solver,
        *(0.0, 1.0, 0.1, REST),
        saveat=saveat,
        adjoint=adjoint,
        max_steps=32,
    )
    assert sol.ys is not None
    return jnp.sum(sol.ys[0] ** 2) + jnp.sum(jnp.sin(sol.ys[1]))


WITHIN = dfx.SaveAt(ts=jnp.array([0.03, 0.5, 1.0]))


@pytest.mark.parametrize(
    "solver, saveat",
    [
        (INSIDE[0], WITHIN),
        pytest.param(INSIDE[1], dfx.SaveAt(t1=True), marks=pytest.mark.slow),
        pytest.param(INSIDE[2], WITHIN, marks=pytest.mark.slow),
    ],
    ids=["leapfrog", "RKN4", "RKN6"],
)
def test_gradient_from_rest(solver, saveat):
    law = dps.LogDamping(3.0)
    gradient = eqx.filter_jit(eqx.filter_grad(loss))
    by_reversal = gradient(law, solver, dps.ReversibleAdjoint(), saveat)
    by_checkpoints = gradient(law, solver, dps.FixedStepAdjoint(), saveat)
    value = eqx.filter_jit(loss)
    up, down = (
        value(dps.LogDamping(3.0 + h), solver, dps.FixedStepAdjoint(), saveat)
        for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(by_reversal.gamma, (up - down) / 2e-5, rtol=1e-7)
    np.testing.assert_allclose(by_reversal.gamma, by_checkpoints.gamma, rtol=1e-12)


# Limits of single precision.


def test_gradient_of_the_integral_under_strong_friction():
    gamma, h = jnp.float32(1e6), jnp.float32(1.0)
    integral = lambda gamma: dps.ConstantDamping(gamma).integral(h, h, 8)
    np.testing.assert_allclose(integral(gamma), 1e-6, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(integral)(gamma), -1e-12, rtol=1e-5)


@pytest.mark.parametrize("p", [1e20, 1e-30, 0.0])
@pytest.mark.parametrize("mass", [1.0, 1e-25])
def test_relativistic_kinetic_energy_does_not_overflow(p, mass):
    kinetic = dps.RelativisticKinetic(jnp.float32(mass), jnp.float32(2.0))
    p = jnp.array([p, p], jnp.float32)
    t = jnp.float32(0)
    size, rest = np.linalg.norm(np.float64(p)), mass * 2.0
    exact = 2.0 * np.float64(p) / np.hypot(size, np.float64(np.float32(rest)))
    np.testing.assert_allclose(kinetic.velocity(t, p), exact, rtol=1e-6)
    energy = 2.0 * np.hypot(size, rest)
    np.testing.assert_allclose(kinetic(t, p), energy, rtol=1e-6)
    assert np.all(np.isfinite(jax.jacrev(kinetic.velocity, 1)(t, p)))
    for law in (dps.ConstantDamping(jnp.float32(0.5)), None):
        system = dps.ConformalHamiltonian(kinetic, harmonic, law)
        q, _ = System(system, None, 1).drift(t, jnp.float32(1.0), (0 * p, p), order=6)
        assert np.all(np.isfinite(q))


# Friction that is written in the wrong place.
