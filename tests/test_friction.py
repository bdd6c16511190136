# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
# pyright: reportGeneralTypeIssues=false
"""Laws of friction as operators, at their singular times and in their limits."""

import functools
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import drift, harmonic, solve
from scipy.special import gamma as gamma_function, jv

import diffrax_presym as dps


H = 0.3
LAWS = {
    "constant": (dps.ConstantDamping(0.3), lambda t: 0.3 * np.eye(2)),
    "entries": (
        dps.ConstantDamping(jnp.array([0.3, -0.2])),
        lambda t: np.diag([0.3, -0.2]),
    ),
    "log": (dps.LogDamping(3.0), lambda t: 3 / t * np.eye(2)),
    "log of entries": (
        dps.LogDamping(jnp.array([3.0, 1.0]), shift=0.5),
        lambda t: np.diag([3.0, 1.0]) / (t + 0.5),
    ),
    "power": (
        dps.PowerDamping(0.75, 0.25),
        lambda t: 0.75 * 0.25 * t**-0.75 * np.eye(2),
    ),
    "two laws": (
        [dps.LogDamping(jnp.array([2.0, 1.0])), dps.PowerDamping(0.75, 0.25)],
        lambda t: np.diag([2.0, 1.0]) / t + 0.75 * 0.25 * t**-0.75 * np.eye(2),
    ),
    "function": (lambda t: 0.3 * t**2, lambda t: 0.6 * t * np.eye(2)),
    "matrix": (
        dps.ViscousDamping(jnp.array([[0.5, 0.4], [-0.1, 0.8]])),
        lambda t: np.array([[0.5, 0.4], [-0.1, 0.8]]) / 2,
    ),
}


@pytest.mark.parametrize("law, rate", LAWS.values(), ids=LAWS)
def test_prepared_friction_solves_its_equation(law, rate):
    # p' = F - Gamma p, and the integral of p, by an independent integration.
    t, p0, force = 1.3, np.array([0.9, -0.4]), np.array([0.5, 1.0])
    system = dps.MechanicalSystem(dps.QuadraticKinetic(2.0), harmonic, friction=law)
    friction = system.fit_friction(jnp.asarray(p0))

    def rhs(s, x, force):
        return np.concatenate([force - rate(s) @ x[:2], x[:2]])

    def after(p, force):
        x = np.concatenate([p, np.zeros(2)])
        end = scipy.integrate.solve_ivp(
            rhs, (t, t + H), x, "DOP853", args=(force,), rtol=1e-12, atol=1e-13
        )
        return np.split(end.y[:, -1], 2)

    left, travelled = after(p0, np.zeros(2))
    gained, _ = after(np.zeros(2), force)
    net = friction.net_force(jnp.asarray(t), jnp.asarray(force), jnp.asarray(p0))
    np.testing.assert_allclose(net, force - rate(t) @ p0, 1e-12)
    prepared = friction.prepare(jnp.asarray(t), jnp.asarray(H), 12)
    for data in (prepared, *friction.fix([prepared])):
        change, carried = friction.flow(data, jnp.asarray(p0))
        np.testing.assert_allclose(p0 + change, left, 1e-10)
        np.testing.assert_allclose(carried, travelled, 1e-10)
        responded = friction.respond(data, jnp.asarray(force))
        np.testing.assert_allclose(responded, gained, 1e-10)


# Times that are integers.


VARYING = {
    "smooth": (lambda t: 2 * jnp.log1p(0.1 * t) + 0.1 * jnp.sin(t), True),
    "of each entry": (
        lambda t: jnp.array([0.3, -0.2], jnp.result_type(t)) * jnp.log1p(t),
        True,
    ),
    "strong": (lambda t: 8.0 * t, False),
    "with a kink": (lambda t: jnp.abs(t - 3.3), False),
    "singular": (lambda t: 3 * jnp.log(t - 3.0), False),
}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("name", VARYING)
def test_friction_over_one_step_is_interpolated(name, sign):
    """Where that is right to rounding: its decays and integrals by a quadrature."""
    eta, converges = VARYING[name]
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, eta)
    p = jnp.array([0.7, -1.2])
    friction = system.fit_friction(p)
    assert friction is not None
    t0, h = (3.0, 0.7) if sign > 0 else (3.7, -0.7)
    found = friction.over_step(t0, h)
    assert found is not None
    fast, converged = found
    assert converged == converges
    if not converges:
        return
    values = lambda t: np.asarray(eta(t)) * np.ones(2)
    # Also a span back in time.
    for start, end in ((0.0, 0.15), (0.4, 0.8), (0.9, 0.3), (0.0, 1.0)):
        t, length = t0 + start * h, (end - start) * h
        data = fast.prepare(t, length, 6)
        change, integral = friction.flow(data, p)
        gained = friction.respond(data, p)
        first, last = values(t), values(t + length)
        np.testing.assert_allclose(change, np.expm1(first - last) * p, 0, 4e-15)
        rows = np.polynomial.legendre.leggauss(30)
        nodes, weights = t + length * (1 + rows[0]) / 2, length * rows[1] / 2
        each = np.stack([values(x) for x in nodes])
        for got, exact in (
            (integral, weights @ np.exp(first - each)),
            (gained, weights @ np.exp(each - last)),
        ):
            np.testing.assert_allclose(got, exact * p, rtol=2e-14, atol=4e-15)


@pytest.mark.variants(1)
@pytest.mark.parametrize("name", VARYING)
def test_interpolated_friction_in_a_solve(name):
    """Also where it is not interpolated in all steps, or in no member of a batch."""
    eta, _ = VARYING[name]
    y0 = jnp.array([1.0, 0.5]), jnp.array([0.0, 0.3])

    @functools.partial(jax.jit, static_argnames="dtype")
    def end(scale, dtype=jnp.float64):
        law = lambda t: jnp.asarray(scale, t.dtype) * eta(t).astype(t.dtype)
        system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law)
        cast = lambda x: jax.tree.map(lambda x: jnp.asarray(x, dtype), x)
        return dfx.diffeqsolve(
            *(system, dps.TunedRKN6(), *cast((3.1, 5.1)), cast(2.0 / 40), cast(y0)),
            stepsize_controller=dps.StepsBetween(jnp.array([3.3], dtype)),
            **{"adjoint": dps.FixedStepAdjoint()},  # pyright: ignore
        ).ys

    rate = jax.jit(lambda t: jax.jvp(eta, (t,), (1.0,))[1])

    def vf(t, y, scale):
        return np.concatenate([y[2:], -y[:2] - scale * np.asarray(rate(t)) * y[2:]])

    for scale in (1.0, 0.5):
        exact = scipy.integrate.solve_ivp(
            *(vf, (3.1, 5.1), np.concatenate(y0), "DOP853"),
            **{"args": (scale,), "rtol": 1e-12, "atol": 1e-13, "max_step": 0.1},
        ).y[:, -1]
        error = lambda ys, exact=exact: np.max(np.abs(np.ravel(ys) - exact))
        assert error(end(scale)) < (1e-5 if name == "singular" else 3e-8)
        assert error(end(jnp.float32(scale), jnp.float32)) < 1e-4
        batch = jax.vmap(end)(jnp.array([scale, 1.0]))
        assert error([x[0] for x in batch]) < (1e-5 if name == "singular" else 3e-8)
    h = 1e-6
    loss = lambda scale: jnp.sum(end(scale)[1])
    central = (loss(1.0 + h) - loss(1.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(loss)(1.0), central, rtol=1e-6)


# From rest at the time when friction is infinite.


PRECISE: dict[str, Any] = dict(
    stepsize_controller=dfx.PIDController(rtol=1e-12, atol=1e-12), max_steps=20_000
)


def singular_system(law):
    return dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law)


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
    field = singular_system(dps.LogDamping(3.0)).vf
    _, dp = field(0.0, (jnp.ones(1), jnp.ones(1)), None)
    assert np.all(np.isnan(dp))


TIMES = np.array([0.03, 1.0, 2.0])


@functools.partial(jax.jit, static_argnums=2)
def positions(law, dt0, solver):
    y0 = jnp.ones(1), jnp.zeros(1)
    sol = dfx.diffeqsolve(
        *(singular_system(law), solver, 0.0, 2.0, dt0, y0),
        saveat=dfx.SaveAt(ts=jnp.asarray(TIMES)),
        adjoint=dps.FixedStepAdjoint(),
    )
    assert sol.ys is not None
    return sol.ys[0][:, 0]


def bessel(gamma):
    order = (gamma - 1) / 2
    return gamma_function(order + 1) * (2 / TIMES) ** order * jv(order, TIMES)


@pytest.mark.parametrize("gamma, tolerance", [(3.0, 1e-6), (0.0, 1e-5)])
def test_the_closed_form_from_rest(gamma, tolerance):
    found = positions(dps.LogDamping(gamma), 0.05, dps.TunedRKN6())
    np.testing.assert_allclose(found, bessel(gamma), rtol=0, atol=tolerance)


@pytest.mark.variants(1)
@pytest.mark.parametrize("solver", [dps.PresymplecticLeapfrog(), dps.TunedRKN6()])
def test_a_power_alone_from_rest(solver):
    law = [dps.LogDamping(0.0), dps.PowerDamping(0.5, 0.5)]
    rhs = lambda t, y: [y[1], -y[0] - 0.25 * t**-0.5 * y[1]]
    exact = scipy.integrate.solve_ivp(
        *(rhs, (1e-10, 2), [1, -1e-10], "Radau"), t_eval=TIMES, rtol=1e-10, atol=1e-12
    ).y[0]
    found = positions(law, 0.01, solver)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-4)


def test_an_entry_without_friction_beside_one_with_a_singularity():
    system = singular_system(dps.LogDamping(jnp.array([3.0, 0.0])))
    y0 = jnp.ones(2), jnp.array([0.0, 1.0])
    q, p = solve(system, dps.TunedRKN6(), 0.0, 2.0, 0.1, y0).ys
    exact = np.cos(2) + np.array([1, -1]) * np.sin(2)
    np.testing.assert_allclose([q[-1, 1], p[-1, 1]], exact, atol=1e-10)


NUMBERS, LOG = jnp.array([3.0, 2.0]), dps.LogDamping(3.0)
both = partial(dps.DissipativeHamiltonian, dps.QuadraticKinetic(), harmonic)
EQUAL = {
    "one law as two": (
        singular_system([dps.LogDamping(NUMBERS - 1), dps.LogDamping(1.0)]),
        singular_system(dps.LogDamping(NUMBERS)),
    ),
    "both energies": (both(LOG, LOG), singular_system(LOG)),
}


@pytest.mark.parametrize("one, other", EQUAL.values(), ids=EQUAL)
def test_equal_laws_from_a_singularity_are_equally_accurate(one, other):
    y0 = jnp.array([1.0, 2.0]), jnp.zeros(2)
    solves = [solve(x, dps.TunedRKN6(), 0.0, 2.0, 0.25, y0).ys for x in (one, other)]
    np.testing.assert_allclose(*map(np.ravel, solves), rtol=1e-12)


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_two_laws_of_a_relativistic_energy_from_a_singularity(shift):
    law, t0 = dps.LogDamping(3.0, shift), -shift
    system = dps.DissipativeHamiltonian(dps.RelativisticKinetic(), harmonic, law, law)
    args = t0, t0 + 1, 1e-2, (jnp.ones(2), jnp.zeros(2))
    ys, exact = (
        np.ravel(solve(system, solver, *args, **options).ys)
        for solver, options in ((dps.BlanesMoan4(), {}), (dfx.Dopri8(), PRECISE))
    )
    np.testing.assert_allclose(ys, exact, rtol=0, atol=1e-4)


@pytest.mark.parametrize("delta", [0.0, 1.0, 2.0])
def test_powers_without_a_singularity(delta):
    system = singular_system(dps.PowerDamping(0.3, delta))
    args = 0.0, 2.0, 0.1, (jnp.array([1.0, -0.5]), jnp.array([0.2, 0.3]))
    ys, exact = (
        np.ravel(solve(system, solver, *args, **options).ys)
        for solver, options in ((dps.TunedRKN6(), {}), (dfx.Dopri8(), PRECISE))
    )
    np.testing.assert_allclose(ys, exact, rtol=0, atol=1e-9)


def test_the_derivative_in_time_of_a_power_that_starts_at_zero():
    def end(law, t0):
        options = dict(max_steps=20, adjoint=dfx.ForwardMode())
        y0 = jnp.array([1.0]), jnp.array([0.2])
        args = singular_system(law), dps.Strang(), t0, t0 + 1, 0.1, y0
        return solve(*args, **options).ys[0][-1]

    laws = dps.PowerDamping(0.5, 2.0), lambda t: 0.5 * t * t
    slopes = [jax.jacfwd(lambda t0, law=law: end(law, t0))(0.0) for law in laws]
    np.testing.assert_allclose(*slopes, rtol=0, atol=1e-12)


# Limits of single precision.


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
        system = dps.MechanicalSystem(kinetic, harmonic, law)
        q, _ = drift(system, t, jnp.float32(1.0), 0 * p, p)
        assert np.all(np.isfinite(q))


KINDS = {
    dps.ConstantDamping: (0.1,),
    dps.LogDamping: (3.0,),
    dps.PowerDamping: (0.2, 0.5),
    dps.ViscousDamping: (np.eye(2),),
    dps.PositionDamping: (lambda t, q, args: 1.0,),
    dps.Drag: (0.1,),
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda x: x.__name__)
def test_a_law_is_of_the_class_that_was_written(kind):
    law = kind(*KINDS[kind])
    assert isinstance(law, dps.extend.AbstractFriction)
    assert [other for other in KINDS if isinstance(law, other)] == [kind]
    assert repr(law).startswith(f"{kind.__name__}(")
