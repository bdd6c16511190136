"""Values between steps where friction is too strong for a polynomial, or undefined."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import diffrax_presym as dps


GAUSS = dps.PresymplecticGauss


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
