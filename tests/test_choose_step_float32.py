"""The choice of a step where more steps only add errors of rounding."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
N, END, TIMES = 60, 200.0, np.linspace(0.0, 200.0, 401)[1:]
START = (2 * np.sin(0.1 * np.arange(N, dtype=np.float32))).astype(np.float32)


def potential(t, q, args):
    stretched = 12.5 * jnp.sum(jnp.diff(q) ** 2)
    return jnp.sum(1 - jnp.cos(q)) + stretched - 0.05 * jnp.cos(0.6 * t) * jnp.sum(q)


@pytest.fixture(scope="module")
def exact():
    def slope(t, y):
        q, p = np.split(y, 2)
        stretched = 25 * np.diff(q, 2, prepend=q[0], append=q[-1])
        force = -np.sin(q) + stretched + 0.05 * np.cos(0.6 * t)
        return np.concatenate([p, force - 0.02 * p])

    start = np.concatenate([START, np.zeros(N)]).astype(float)
    options = {"rtol": 1e-11, "atol": 1e-11, "t_eval": TIMES}
    y = scipy.integrate.solve_ivp(slope, (0, END), start, "DOP853", **options).y.T
    return np.split(y, 2, axis=1)


@pytest.mark.parametrize("tolerance", [1e-3, 3e-4, 1e-4])
def test_no_more_steps_than_the_tolerance_needs(tolerance, exact):
    friction = dps.ConstantDamping(jnp.float32(0.02))
    mass = dps.QuadraticKinetic(jnp.float32(1))
    system = dps.MechanicalSystem(mass, potential, friction)

    @jax.jit
    def solve(dt0):
        save = dfx.SaveAt(ts=jnp.asarray(TIMES, jnp.float32))
        return diffeqsolve(
            system,
            dps.TunedRKN6(),
            *(jnp.float32(0), jnp.float32(END), jnp.asarray(dt0, jnp.float32)),
            (jnp.asarray(START), jnp.zeros(N, jnp.float32)),
            saveat=save,
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        )

    step = dps.choose_step(solve, 0.0, END, rtol=tolerance, atol=tolerance)
    assert step.smooth and 320 < step.steps <= 800
    assert max(trial.steps for trial in step.trials) < 10_000
    for y, z in zip(solve(step.dt0).ys, exact, strict=True):
        assert y.dtype == jnp.float32
        y = np.asarray(y, float)
        assert np.max(np.abs(y - z) / (1 + np.abs(z))) < tolerance
