"""Forces along the normals of constraints, which leave the motion as it is, whatever
friction and forces of the velocity there are."""

import itertools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
successful = dfx.RESULTS.successful
G = 9.81
SOLVERS = [dps.Strang(), dps.SofroniouSpaletta(6, dps.Strang()), dps.BlanesMoan6()]
SMOOTH = 0.1
COUPLED = jnp.array([[1.0, 0.9], [0.9, 1.0]])
LAWS = {
    "none": {},
    "rate": {"friction": dps.ConstantDamping(0.3)},
    "matrix": {"friction": dps.ViscousDamping(COUPLED)},
    "magnetic": {"friction": dps.ViscousDamping(jnp.array([[0.0, 2.0], [-2.0, 0.0]]))},
    "place": {"friction": dps.ViscousDamping(lambda t, q, args: COUPLED * (q @ q))},
    "drag": {"friction": dps.Drag(0.5)},
    "drag and place": {
        "friction": [dps.Drag(0.4), dps.ViscousDamping(lambda t, q, args: 0.1)]
    },
    "force": {"force": lambda t, q, v, args: -0.5 * v * jnp.sqrt(v @ v + SMOOTH)},
    "force, pressed": {
        "force": lambda t, q, v, args: args * q - 0.5 * v * jnp.sqrt(v @ v + SMOOTH)
    },
}


def pendulum(name):
    """On a rod, pulled by a force `args` along it."""
    weight = lambda t, q, args: G * q[1] + args * (q @ q - 1) / 2
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), weight, **LAWS[name])
    return dps.ConstrainedSystem(free, lambda t, q, args: (q @ q - 1) / 2)


START = jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6])


def end(system, solver, h, args, **options):
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None} | options
    times = 0.0, 2.0, h
    return diffeqsolve(system, solver, *times, START, args, **options)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("name", LAWS)
def test_a_force_along_the_normals_does_nothing(name, solver):
    # However far it would move the mass in a step without the rod.
    system = pendulum(name)
    pulls = [0.0, 1e4] if "force" in name else [0.0, 1e4, 1e5]
    for h in (0.02, 0.1):
        alone, *ends = [end(system, solver, h, jnp.array(x)).ys for x in pulls]
        for pulled, values in itertools.product(ends, (0, 1)):
            np.testing.assert_allclose(pulled[values], alone[values], atol=1e-9)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("name", ["drag", "force, pressed"])
def test_against_the_angle(name, solver):
    smooth = 0.0 if name == "drag" else SMOOTH

    def slope(t, y):
        angle, rate = y
        return rate, -G * np.sin(angle) - 0.5 * rate * np.sqrt(rate**2 + smooth)

    start = [np.arctan2(0.6, 0.8), 1.0]
    exact = scipy.integrate.solve_ivp(
        slope, (0, 2), start, "DOP853", rtol=1e-12, atol=1e-12
    ).y[:, -1]
    # Drag is smooth to this order at rest.
    order = min(solver.order(None), 4 if name == "drag" else 6)
    errors = []
    for h in (0.04, 0.02):
        (q,), (p,) = end(pendulum(name), solver, h, jnp.array(3e3)).ys
        angle, rate = np.arctan2(q[0], -q[1]), p[0] * -q[1] + p[1] * q[0]
        errors.append(max(abs(angle - exact[0]), abs(rate - exact[1])))
    assert errors[1] < 10 * 0.02**order
    assert errors[1] < max(errors[0] / 2 ** (order - 1), 1e-8)


def test_gradient():
    solver = dps.BlanesMoan4()

    def loss(pull):
        (q,), (p,) = end(pendulum("force, pressed"), solver, 0.05, pull).ys
        return q[0] + p[1]

    pull = jnp.array(0.3)
    # Along the rod, but for the force that has the velocity in it.
    assert abs(jax.grad(loss)(pull)) < 1e-10

    def of_drag(c):
        law = lambda t, q, v, args: -args * v * jnp.sqrt(v @ v + 1e-9)
        free = dps.MechanicalSystem(
            dps.QuadraticKinetic(), lambda t, q, args: G * q[1] + 50 * q @ q, force=law
        )
        system = dps.ConstrainedSystem(free, lambda t, q, args: (q @ q - 1) / 2)
        (q,), (p,) = end(system, solver, 0.05, c).ys
        return q[0] + p[1]

    c, h = jnp.array(0.5), 1e-5
    central = (of_drag(c + h) - of_drag(c - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(of_drag)(c), central, rtol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_a_kick_that_is_not_solved_says_so(solver):
    rub = lambda t, q, v, args: -20 * jnp.tanh(v / 1e-7)  # It sticks.
    free = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: G * q[1], force=rub
    )
    system = dps.ConstrainedSystem(free, lambda t, q, args: (q @ q - 1) / 2)
    result = end(system, solver, 0.02, None, throw=False).result
    assert result != successful
    assert "too stiff for the step" in dfx.RESULTS[result]
