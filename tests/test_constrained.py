"""Constraints: orders and gradients with any friction, against SciPy on the equations
with multipliers."""

import itertools
from functools import cache, partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import own
import pytest
from on_manifolds import bobs, by_scipy, end_as_vector as end, links

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
G = 9.81
MASS = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 1.5]])
C = np.array([[0.5, 0.2, 0.0], [-0.2, 0.6, 0.3], [0.0, -0.3, 0.4]])
ONE = np.eye(3)


def motor(np, q, v):
    """A motor about the axis, and smoothed dry friction."""
    about = np.stack([-q[1], q[0], 0 * q[0]])
    return (1 - about @ v) * about - np.tanh(2 * v)


# The law of friction or a force, its force of position and velocity, and the mass.
FRICTION = {
    "none": (None, lambda q, v: 0 * v, ONE),
    "rate": (dps.ConstantDamping(0.3), lambda q, v: -0.3 * MASS @ v, MASS),
    "matrix": (dps.ViscousDamping(C), lambda q, v: -C @ v, MASS),
    "place": (
        dps.ViscousDamping(lambda t, q, args: (1 + q[0] ** 2) * jnp.asarray(C)),
        lambda q, v: -(1 + q[0] ** 2) * C @ v,
        MASS,
    ),
    "drag": (dps.Drag(0.4), lambda q, v: -0.4 * np.linalg.norm(v) * v, ONE),
    "force": (lambda t, q, v, args: motor(jnp, q, v), partial(motor, np), MASS),
}
SCHEMES = {
    "Strang": (dps.Strang(), 2),
    "Suzuki4": (dps.Suzuki4(dps.Strang()), 4),
    "Suzuki-Yoshida 6": (dps.SuzukiYoshida(6, dps.Strang()), 6),
    "Sofroniou-Spaletta 6": (dps.SofroniouSpaletta(6, dps.Strang()), 6),
    "Blanes-Moan 4": (dps.BlanesMoan4(), 4),
    "Blanes-Moan 6": (dps.BlanesMoan6(), 6),
    "Compensated": (dps.Compensated(dps.Strang()), 2),
}
# Numbers of steps with errors that are neither of long steps nor of rounding.
STEPS_OF = {
    ("force", "Suzuki-Yoshida 6"): (32, 64, 128),
    ("drag", "Blanes-Moan 6"): (8, 16, 32),
}


def breathing_sphere(friction, **options):
    """A sphere whose radius depends on time, and a potential that does."""
    law, _, mass = FRICTION[friction]
    kinetic = dps.QuadraticKinetic(None if mass is ONE else mass)
    potential = lambda t, q, args: G * q[2] * (1 + 0.3 * jnp.sin(t))
    sphere = lambda t, q, args: q @ q - (1 + 0.1 * jnp.sin(t)) ** 2
    laws = {"force": law} if friction == "force" else {"friction": law}
    free = dps.MechanicalSystem(kinetic, potential, **laws)
    return dps.ConstrainedSystem(free, sphere, **options)


def start(system):
    y = jnp.array([0.6, 0.1, -0.8]), jnp.array([0.5, 1.0, 0.3])
    return system.project(0.0, y)


@cache
def exact(friction):
    _, force, mass = FRICTION[friction]
    inverse = np.linalg.inv(mass)

    def field(t, y):
        q, p = np.split(y, 2)
        v = inverse @ p
        total = np.array([0, 0, -G * (1 + 0.3 * np.sin(t))]) + force(q, v)
        r, dr, ddr = 1 + 0.1 * np.sin(t), 0.1 * np.cos(t), -0.1 * np.sin(t)
        tension = (q @ inverse @ total + v @ v - dr**2 - r * ddr) / (q @ inverse @ q)
        return np.concatenate([v, total - tension * q])

    y0 = np.concatenate(start(breathing_sphere(friction)))
    return by_scipy(field, y0, 2.0)


def order(errors):
    """The slope over the steps whose errors are above rounding."""
    errors = [e for e in errors if e > 2e-12]
    assert len(errors) > 1
    return np.log2(errors[0] / errors[-1]) / (len(errors) - 1)


@pytest.mark.variants(4)
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("friction", FRICTION)
def test_order(friction, scheme):
    system, (solver, claimed) = breathing_sphere(friction), SCHEMES[scheme]
    y0, errors = start(system), []
    for steps in STEPS_OF.get((friction, scheme), (16, 32, 64)):
        y = end(system, solver, y0, 2.0, steps)
        errors.append(np.max(np.abs(y - exact(friction))))
        q, p = map(jnp.asarray, np.split(y, 2))
        assert system.violation(2.0, q, p) < 2e-15
    # Of the triple jumps long steps show more.
    assert -0.3 < order(errors) - claimed < 0.6, errors


@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_step_is_undone(friction, scheme):
    system, (solver, _) = breathing_sphere(friction), SCHEMES[scheme]
    y0 = start(system)

    @eqx.filter_jit
    def step(*span, y, carry):
        return solver.step(system, *span, y, None, carry, False)

    carry = solver.init(system, 0.0, 0.1, y0, None)
    y1, _, _, carry, _ = step(0.0, 0.1, y=y0, carry=carry)
    assert np.max(np.abs(y1[0] - y0[0])) > 0.01
    y2, *_ = step(0.1, 0.0, y=y1, carry=carry)
    for x, y in zip(y0, y2, strict=True):
        np.testing.assert_allclose(y, x, atol=4e-15)


# Gradients.


GRADIENTS = {
    "reversal": dps.FixedStepAdjoint("reversal"),
    "checkpoints": dps.FixedStepAdjoint("checkpoints"),
    "Diffrax": dfx.RecursiveCheckpointAdjoint(),
    "forward": dfx.ForwardMode(),
}


@pytest.mark.variants(1)
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_gradient(friction, gradient):
    _, _, mass = FRICTION[friction]

    @jax.jit
    def loss(x):
        radius, speed, scale = x
        law, other = eqx.partition(FRICTION[friction][0], eqx.is_array)
        law = eqx.combine(jax.tree.map(lambda c: scale * c, law), other)
        laws = {"friction": law}
        if friction == "force":
            laws = {"force": lambda t, q, v, args: args / G * law(t, q, v, args)}
        kinetic = dps.QuadraticKinetic(None if mass is ONE else scale * mass)
        height = lambda t, q, args: args * q[2]
        free = dps.MechanicalSystem(kinetic, height, **laws)
        sphere = lambda t, q, args: q @ q - (radius + 0.1 * jnp.sin(t)) ** 2
        system = dps.ConstrainedSystem(free, sphere)
        y0 = jnp.array([0.6, 0.1, -0.8]), speed * jnp.array([0.5, 1.0, 0.3])
        ys = diffeqsolve(
            *(system, dps.Suzuki4(dps.Strang()), 0.0, 1.0, 0.1),
            *(system.project(0.0, y0), scale * G),
            saveat=dfx.SaveAt(ts=jnp.array([0.13, 0.5, 1.0])),
            adjoint=GRADIENTS[gradient],
            max_steps=16,
        ).ys
        return jnp.sum(ys[0] ** 3) + jnp.sum(ys[1])

    x, h = jnp.array([1.0, 1.2, 0.9]), 1e-5
    slope = jax.jacfwd(loss) if gradient == "forward" else jax.grad(loss)
    wanted = [(loss(x + h * e) - loss(x - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(slope(x), wanted, rtol=1e-8, atol=1e-9)


# What is saved.


STEPS = [10_000, pytest.param(1_000_000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("steps", STEPS)
def test_constraints_hold_to_rounding(steps):
    free = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: G * jnp.sum(q[:, 1])
    )
    system = dps.ConstrainedSystem(free, links)
    y0 = bobs(np.array([2.0, 2.5])), jnp.zeros((2, 2))
    worst = lambda t, y, args: (system.violation(t, *y), system.energy(t, *y))
    violation, energy = diffeqsolve(
        *(system, dps.Strang(), 0.0, steps * 1e-3, 1e-3, y0),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, steps * 1e-3, 1001), fn=worst),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    ).ys
    assert np.max(violation) < 1e-13
    assert np.max(np.abs(energy - energy[0])) < 1e-2


def test_saved_values_satisfy_the_constraints():
    system = breathing_sphere("matrix")
    y0, ts = start(system), jnp.linspace(0.0, 1.0, 12)
    solve = lambda **options: (
        diffeqsolve(system, dps.Suzuki4(dps.Strang()), 0.0, 1.0, 0.1, y0, **options).ys
    )
    ys = solve(saveat=dfx.SaveAt(ts=ts), adjoint=dps.FixedStepAdjoint())
    projected = solve(saveat=dfx.SaveAt(ts=ts, fn=system.project))
    for saved in (ys, projected):
        assert np.max(jax.vmap(system.violation)(ts, *saved)) < 4e-15
    np.testing.assert_allclose(projected[0], ys[0], atol=1e-5)


def test_backwards_in_batches_and_in_single_precision():
    system = breathing_sphere("rate")
    many = lambda scale: system.project(
        0.0, (jnp.array([0.6, 0.1, -0.8]), scale * jnp.array([0.5, 1.0, 0.3]))
    )
    solver, adjoint = dps.Suzuki4(dps.Strang()), dps.FixedStepAdjoint()
    options = {"adjoint": adjoint, "max_steps": None}

    def there_and_back(scale):
        y0 = many(scale)
        y1 = diffeqsolve(system, solver, 0.0, 1.0, 0.05, y0, **options).ys
        y1 = jax.tree.map(lambda x: x[-1], y1)
        y2 = diffeqsolve(system, solver, 1.0, 0.0, -0.05, y1, **options).ys
        return y0, jax.tree.map(lambda x: x[-1], y2)

    first, last = jax.vmap(there_and_back)(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(last[0], first[0], atol=1e-13)
    np.testing.assert_allclose(last[1], first[1], atol=1e-12)
    cast = lambda x: x.astype(jnp.float32) if eqx.is_array(x) else x
    single = jax.tree.map(cast, (system, start(system)))
    t0, t1, h = map(jnp.float32, (0.0, 2.0, 0.05))
    ys = diffeqsolve(single[0], solver, t0, t1, h, single[1], **options).ys
    assert all(y.dtype == jnp.float32 for y in ys)
    y = np.concatenate([y[-1] for y in ys])
    np.testing.assert_allclose(y, exact("rate"), atol=5e-5)


def test_other_solvers_solve_the_equations_with_multipliers():
    system = breathing_sphere("place")
    controller = dfx.PIDController(rtol=1e-10, atol=1e-10)
    options = {"stepsize_controller": controller, "max_steps": 4096}
    options["adjoint"] = dfx.RecursiveCheckpointAdjoint()
    y = end(system, dfx.Dopri8(), start(system), 2.0, 20, **options)
    np.testing.assert_allclose(y, exact("place"), atol=1e-8)


# Errors.


def sphere(potential=lambda t, q, args: G * q[2], **options):
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    return dps.ConstrainedSystem(free, lambda t, q, args: q @ q - 1, **options)


@pytest.mark.parametrize("adjoint", ["reversal", "Diffrax"])
@pytest.mark.parametrize(
    "q, p, most",
    [
        ([1.0, 0.0, 1e-3], [0.0, 1.0, 0.0], "1e-08"),
        ([1.0, 0.0, 0.0], [1e-3, 1.0, 0.0], "1e-05"),
        ([2.0, 0.0, 0.0], [0.0, 1.0, 0.0], "1e-02"),
    ],
)
def test_an_initial_state_off_the_constraint(q, p, most, adjoint):
    y0, options = (jnp.array(q), jnp.array(p)), {"adjoint": GRADIENTS[adjoint]}
    wanted = rf"(?s)off the manifold of the system by more than {most}.*system.project"
    with pytest.raises(Exception, match=wanted):
        diffeqsolve(sphere(), dps.Strang(), 0.0, 1.0, 0.1, y0, **options)
    y0 = sphere().project(0.0, y0)
    diffeqsolve(sphere(), dps.Strang(), 0.0, 1.0, 0.1, y0, **options)


@pytest.mark.parametrize("adjoint", ["reversal", "Diffrax"])
def test_an_initial_state_is_judged_without_a_unit_of_time(adjoint):
    """Fast ones of molecules are right, as are those at rest but for rounding, and
    slow ones that are not tangential are wrong."""

    def run(held, q, p, duration):
        y0, options = (jnp.array(q), p), {"adjoint": GRADIENTS[adjoint]}
        options |= {"dt0": 0.1 * duration, "throw": False}
        sol = diffeqsolve(held, dps.Strang(), 0.0, duration, y0=y0, args=p, **options)
        return sol.result == dfx.RESULTS.successful

    q, free = [0.6, 0.0, 0.8], lambda t, q, args: 0.0
    body = dps.MechanicalSystem(dps.QuadraticKinetic(), free)
    moving = dps.ConstrainedSystem(body, lambda t, q, p: q[:1] - 0.6 - p[1] * t)
    for speed, off in itertools.product((1e13, 1.0, 1e-7), (0.0, 1e-6)):
        p = speed * jnp.array([0.8 + off, 0.3, -0.6])
        assert run(sphere(free), q, p, 1 / speed) == (off == 0)
        p = speed * jnp.array([1.0 + off, 1.0])
        assert run(moving, q[:2], p, 1 / speed) == (off == 0)
    # By its weight, the last bits of a momentum are of no weight.
    assert run(sphere(), q, 1e-16 * jnp.array(q), 1.0)


@pytest.mark.parametrize(
    "solver",
    [
        *(dps.PresymplecticLeapfrog(), dps.PresymplecticEuler()),
        *(dps.PresymplecticGauss(2), dps.PresymplecticTao(), dps.TunedLinear8()),
        *(dps.SymmetricMultistep(8), dps.SuzukiYoshida(4)),
        *(own.SpringLeapfrog(), dps.Suzuki4(own.SpringLeapfrog())),
    ],
    ids=lambda x: type(x).__name__,
)
def test_schemes_that_leave_the_constraint_refuse(solver):
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3)
    with pytest.raises(ValueError, match=r"would leave the manifold.*Strang"):
        diffeqsolve(sphere(), solver, 0.0, 1.0, 0.1, y0)


def test_own_moves_say_that_they_start_from_other_variables():
    """Otherwise momenta at the ends of steps are not tangential."""
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.5])
    with pytest.raises(ValueError, match=r"BareLeapfrog.*ends=Enter\("):
        diffeqsolve(sphere(), own.BareLeapfrog(), 0.0, 1.0, 0.1, y0)
    right = end(sphere(), dps.BlanesMoan6(), y0, 1.0, 50)
    for loop in (dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()):
        found = [
            end(sphere(), own.DrivenLeapfrog(), y0, 1.0, n, adjoint=loop)
            for n in (10, 20)
        ]
        for y in found:
            assert sphere().violation(1.0, *jnp.split(y, 2)) < 1e-13
        errors = [np.max(np.abs(y - right)) for y in found]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


def test_arguments():
    system, g = sphere().system, lambda t, q, args: q @ q - 1
    wrong = {
        "needs a `MechanicalSystem`": (dps.Hamiltonian(lambda t, q, p, args: p @ p), g),
        "needs a constant mass": (dps.MechanicalSystem(lambda t, p, args: p @ p, g), g),
        "`constraint` must be a function": (system, 1.0),
    }
    for message, args in wrong.items():
        with pytest.raises(ValueError, match=message):
            dps.ConstrainedSystem(*args)
    with pytest.raises(ValueError, match="must be a Lineax solver"):
        dps.ConstrainedSystem(system, g, linear_solver="LU")  # pyright: ignore
    several = dps.ConstrainedSystem(system, lambda t, q, args: (q[0], q[1]))
    with pytest.raises(ValueError, match=r"must return a real array.*jnp.stack"):
        several.project(0.0, (jnp.ones(3), jnp.ones(3)))
