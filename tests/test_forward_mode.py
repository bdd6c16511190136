"""Forward mode in the loop of the package."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choosing import PENDULUM, RKN6, Y0

import diffrax_presym as dps


FORWARD = dps.FixedStepAdjoint("forward")
TS = jnp.linspace(0.0, 3.0, 11)


def saved(parameter=1.0, *, t1=3.0, dt0: Any = 0.25, ts=TS, adjoint=FORWARD, **options):
    y0 = Y0[0] * parameter, Y0[1] + parameter**2
    sol: Any = dfx.diffeqsolve(
        *(PENDULUM, RKN6, 0.0, t1, dt0, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=adjoint,
        **options,
    )
    return sol.ys[0]


CONTROLLERS = {
    "constant": {},
    "between": {"stepsize_controller": dps.StepsBetween(jnp.array([0.7, 1.9]))},
    "density": {
        "stepsize_controller": dps.StepDensityController(0.3, PENDULUM),
        "dt0": None,
    },
}


@pytest.mark.parametrize("options", CONTROLLERS.values(), ids=CONTROLLERS)
def test_jacobians_are_those_of_reverse_mode(options):
    """One by one, of a batch, and the second derivatives."""
    own = lambda x: saved(x, **options)
    other = lambda x: saved(x, adjoint=dps.FixedStepAdjoint(), **options)
    xs = jnp.array([1.0, 1.2])
    found = jax.jit(jax.vmap(jax.jacfwd(own)))(xs)
    wanted = [jax.jit(jax.jacrev(other))(x) for x in xs]
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(jax.jacfwd(own)(xs[1]), wanted[1], 1e-9, 1e-11)
    second = jax.jit(jax.jacfwd(jax.jacfwd(own)))(1.0)
    slopes = [jax.jit(jax.jacfwd(own))(x) for x in (1.0 + 1e-5, 1.0 - 1e-5)]
    np.testing.assert_allclose(second, (slopes[0] - slopes[1]) / 2e-5, 1e-6, 1e-6)


def test_derivatives_of_what_a_saved_function_holds():
    def velocities(mass, adjoint):
        system = dps.MechanicalSystem(dps.QuadraticKinetic(mass), PENDULUM.potential)
        sol: Any = dfx.diffeqsolve(
            *(system, RKN6, 0.0, 3.0, 0.25, Y0),
            saveat=dfx.SaveAt(ts=TS, fn=system.to_velocity),
            adjoint=adjoint,
        )
        return sol.ys[1]

    mass, other = jnp.array([1.0, 2.0]), dps.FixedStepAdjoint()
    found = jax.jacfwd(lambda mass: velocities(mass, FORWARD))(mass)
    wanted = jax.jacrev(lambda mass: velocities(mass, other))(mass)
    np.testing.assert_allclose(found, wanted, 1e-9, 1e-11)


def between(times):
    return saved(stepsize_controller=dps.StepsBetween(times))


BY_TIMES = {
    "t1": (lambda t1: saved(t1=t1), 3.0),
    "dt0": (lambda dt0: saved(dt0=dt0), 0.25),
    "ts": (lambda ts: saved(ts=ts), TS),
    "times of steps": (between, jnp.array([1.3])),
}


@pytest.mark.parametrize("name", BY_TIMES)
def test_no_derivatives_by_times(name):
    fn, x = BY_TIMES[name]
    with pytest.raises(RuntimeError, match=r"times.*`diffrax.ForwardMode"):
        jax.jacfwd(fn)(x)


def test_no_reverse_mode():
    with pytest.raises(RuntimeError, match=r"`jax.grad` write `FixedStepAdjoint"):
        jax.grad(lambda x: jnp.sum(saved(x)))(1.0)
