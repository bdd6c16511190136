"""The hard cases, scaled down: bounds are measured values with a small margin."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, harmonic, solve, substeps, trajectory

import diffrax_presym as dps


LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
REST = (jnp.ones(1), jnp.zeros(1))
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
    assert run(dps.SuzukiYoshida(4)).result == NONFINITE
    assert run(dps.Suzuki4()).result == dfx.RESULTS.successful


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
