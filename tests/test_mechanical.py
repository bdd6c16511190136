# pyright: reportAssignmentType=false, reportArgumentType=false, reportReturnType=false
"""Friction of every kind: by degree of freedom, matrix, place and speed."""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from helpers import assert_close, flat, harmonic, solve, step

import diffrax_presym as dps
from diffrax_presym._friction._exponential import exponential_products, exponentials
from diffrax_presym.diagnostics import (
    energy,
    energy_error,
    energy_lost,
    power_lost,
    structure_defect,
)
from diffrax_presym.extend import System


MASS = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 1.5]])
# Neither symmetric nor normal.
C = jnp.array([[0.3, 0.5, -0.2], [-0.3, 0.2, 0.1], [0.1, -0.4, 0.25]])
STIFFNESS = jnp.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
Y0 = (jnp.array([0.8, -0.5, 0.3]), jnp.array([0.2, 0.6, -0.4]))
DENSE, KINETIC = dps.QuadraticKinetic(MASS), dps.QuadraticKinetic()


def saved(sol) -> Any:
    """Times and states of a solution."""
    assert sol.ts is not None and sol.ys is not None
    return sol.ts, sol.ys


def driven(t, q, args):
    coupling = q[0] * q[1] * q[2] / 2 + q[0] ** 2 * q[1] / 2 * jnp.cos(t)
    return jnp.sum(jnp.cosh(q)) + coupling


def layer(t, q, args):
    return 0.5 * jnp.exp(-(q**2))


def by_place(t, q, args):
    return 0.3 * jnp.exp(-(q[:1] ** 2))


def gust(t, q, args):
    return jnp.stack([jnp.sin(t), q[0], 1 + 0 * t])


LINEAR = {
    "by degree of freedom and time": dps.LogDamping(jnp.array([3.0, 1, 0.5]), 1.0),
    "two laws": [dps.ConstantDamping(0.1), lambda t: jnp.sin(t) / 5],
    "viscous number": dps.ViscousDamping(0.3),
    "matrix": dps.ViscousDamping(C),
    "operator": dps.ViscousDamping(
        lx.FunctionLinearOperator(lambda v: C @ v, jax.eval_shape(lambda: Y0[1]))
    ),
    "sum": [
        dps.ViscousDamping(C),
        dps.ViscousDamping(0.1 * STIFFNESS),
        dps.ConstantDamping(0.2),
    ],
}
WIND = jnp.array([1.0, -0.5, 0.2])
LOCAL = {
    "place": dps.PositionDamping(layer),
    "place, matrix": dps.ViscousDamping(lambda t, q, args: C * (1 + q[0] ** 2)),
    "two drags": [dps.Drag(0.3), dps.Drag(0.2, WIND)],
    "wind": dps.Drag(0.3, medium=WIND),
    "gust": dps.Drag(0.3, medium=gust),
    "all by place": [
        dps.Drag(by_place, medium=WIND),
        dps.PositionDamping(layer),
        dps.ViscousDamping(C),
    ],
}
# Bodies of the mass 2: for each `(c, w)` a drag `c |v - w| (v - w)`.
DRAGS: dict[str, tuple] = {
    "two drags": [
        (lambda q: 0.3, lambda t, q: 0.0),
        (lambda q: 0.2, lambda t, q: np.array(WIND)),
    ],
    "wind": [(lambda q: 0.3, lambda t, q: np.array(WIND))],
    "gust": [(lambda q: 0.3, lambda t, q: np.array([np.sin(t), q[0], 1]))],
    "all by place": [(lambda q: 0.3 * np.exp(-(q[0] ** 2)), lambda t, q: WIND)],
}


@functools.cache
def system(name):
    kinetic = dps.QuadraticKinetic(2.0) if name in DRAGS else DENSE
    return dps.MechanicalSystem(kinetic, driven, (LINEAR | LOCAL)[name])


def force_by_hand(name, t, q, v):
    """The friction of bodies, in NumPy."""
    force = np.zeros(3)
    for c, w in DRAGS[name]:
        relative = v - np.asarray(w(t, q))
        force -= c(q) * np.linalg.norm(relative) * relative
    if name == "all by place":
        force -= 0.5 * np.exp(-(q**2)) * 2 * v + np.array(C) @ v
    return force


@pytest.mark.parametrize("name", DRAGS)
def test_friction_of_bodies(name):
    q, p = Y0
    found = system(name).friction_force(jnp.array(0.3), q, p)
    assert_close(found, jnp.asarray(force_by_hand(name, 0.3, q, p / 2)), 1e-15)


@pytest.mark.parametrize("name", ["place", "two drags", "gust"])
def test_schemes_that_would_lose_their_order_name_those_that_do_not(name):
    for solver in (dps.TunedRKN6(), dps.BlanesMoanRKN4(), dps.BlanesCasasRKN8()):
        with pytest.raises(ValueError, match=r"BlanesMoan4.*BlanesMoan6"):
            step(system(name), solver, 0.0, 0.1, Y0)
    with pytest.raises(ValueError, match="BlanesMoan4"):
        step(system(name), dps.PresymplecticLeapfrog(), 0.0, 0.1, Y0)


# Structure.


# Rates of `LINEAR`, by hand.
TRACES = {
    "matrix": np.array(C) @ np.linalg.inv(np.array(MASS)),
    "operator": np.array(C) @ np.linalg.inv(np.array(MASS)),
    "viscous number": 0.3 * np.linalg.inv(np.array(MASS)),
    "sum": np.array(C + 0.1 * STIFFNESS) @ np.linalg.inv(np.array(MASS))
    + 0.2 * np.eye(3),
}


@pytest.mark.parametrize("name", TRACES)
@pytest.mark.parametrize("solver", [dps.TunedRKN6(), dps.PresymplecticLeapfrog()])
def test_phase_volume_contracts_by_the_trace(name, solver):
    end = lambda q, p: step(system(name), solver, 0.3, 0.5, (q, p))[0]
    jacobian = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(*Y0)
    matrix = np.block([[np.array(x) for x in row] for row in jacobian])
    lost = 0.2 * np.trace(TRACES[name])
    np.testing.assert_allclose(np.linalg.det(matrix), np.exp(-lost), 1e-13)


def test_other_friction_is_not_conformal():
    with pytest.raises(ValueError, match="other friction"):
        structure_defect(system("matrix"), dps.TunedRKN6(), 0.0, 0.1, Y0)


@pytest.mark.slow
def test_a_kick_with_friction_by_place_contracts_by_the_friction_there():
    (q, p), t, h = Y0, jnp.array(0.0), jnp.array(0.3)
    bound = System(system("place, matrix"), None, 1, Y0)
    split = bound.split("any")
    _, forms, numbers = split.force(bound, t, Y0)
    force = jnp.ones(3)
    change = lambda p: split.kick(bound, t, h, (q, p), (force, forms, numbers), 6)[1]
    gamma = (1 + q[0] ** 2) * C @ jnp.linalg.inv(MASS)
    found = np.linalg.slogdet(jax.jacfwd(change)(p))[1]
    np.testing.assert_allclose(found, -0.3 * jnp.trace(gamma), 1e-13)
    # p' = force - Gamma p.
    left = scipy.linalg.expm(-0.3 * gamma)
    gained = np.linalg.solve(gamma, (np.eye(3) - left) @ force)
    np.testing.assert_allclose(change(p), left @ p + gained, 1e-12)


@pytest.mark.parametrize("name", ["matrix", "wind"])
def test_a_step_backwards_undoes_a_step(name):
    solver = dps.BlanesMoan6() if name in DRAGS else dps.TunedRKN6()
    there = step(system(name), solver, 0.0, 0.2, Y0)[0]
    assert_close(step(system(name), solver, 0.2, 0.0, there)[0], Y0, 1e-13)


FIELD = jnp.array([[0.0, -0.7, 0.2], [0.7, 0.0, 1.1], [-0.2, -1.1, 0.0]])


@pytest.mark.parametrize("steps", [2000, pytest.param(10**6, marks=pytest.mark.slow)])
def test_energy_in_a_magnetic_field_does_not_drift(steps):
    friction, h = dps.ViscousDamping(FIELD), 0.3
    field = dps.MechanicalSystem(dps.QuadraticKinetic(2.0), harmonic, friction)

    @jax.jit
    def end(y):
        sol = dfx.diffeqsolve(
            *(field, dps.TunedRKN6(), 0.0, steps * h, h, y),
            max_steps=None,
            saveat=dfx.SaveAt(ts=jnp.linspace(0, steps * h, 6)[1:]),
            adjoint=dps.FixedStepAdjoint(),
        )
        return energy(field, *saved(sol))

    # The scheme makes an error that oscillates; rounding would accumulate.
    errors = np.asarray(end(Y0) / field.energy(0.0, *Y0) - 1)
    assert np.max(np.abs(errors)) < 1e-9


def test_a_batch_of_particles_in_one_field():
    q = jnp.stack([Y0[0], -Y0[1]])
    kinetic = dps.QuadraticKinetic(jnp.array([[2.0], [1.0]]))
    both = dps.MechanicalSystem(kinetic, harmonic, dps.ViscousDamping(FIELD[None]))
    ends = step(both, dps.TunedRKN6(), 0.0, 0.3, (q, q))[0]
    for i, mass in enumerate([2.0, 1.0]):
        kinetic = dps.QuadraticKinetic(mass)
        one = dps.MechanicalSystem(kinetic, harmonic, dps.ViscousDamping(FIELD))
        end = step(one, dps.TunedRKN6(), 0.0, 0.3, (q[i], q[i]))[0]
        assert_close((ends[0][i], ends[1][i]), end, 1e-14)


def test_friction_of_the_canonical_momentum_is_not_that_of_the_velocity():
    # |p - A(q)|^2 / 2 with a damping law damps p, not the velocity p - A.
    A = lambda q: FIELD @ q / 2
    canonical = lambda t, q, p, args: jnp.sum((p - A(q)) ** 2) / 2
    trap = dps.Hamiltonian(canonical, dps.ConstantDamping(0.3))
    laws = [dps.ViscousDamping(FIELD), dps.ViscousDamping(0.3)]
    right = dps.MechanicalSystem(KINETIC, lambda t, q, args: 0.0 * jnp.sum(q), laws)
    q, v = Y0
    rates = trap.vf(0.0, (q, v + A(q)), None)
    _, slope = jax.jvp(A, (q,), (v,))
    # With the magnetic field alone both agree.
    undamped = rates[1] + 0.3 * (v + A(q)) - slope
    assert_close(undamped, -FIELD @ v, 1e-14)
    rate = right.vf(0.0, (q, v), None)[1]
    assert_close(rate, undamped - 0.3 * v, 1e-14)
    assert np.max(np.abs(rates[1] - slope - rate)) > 0.05


# The parts.


@pytest.mark.parametrize("scale", [0.0, 1e-9, 0.3, 40.0])
def test_exponentials(scale):
    matrix, times = scale * C, jnp.array([0.1, -0.3, 1.0, 0.0])
    changes, integrals = exponentials(matrix, times)
    for time, change, integral in zip(times, changes, integrals, strict=True):
        zero = np.zeros((3, 3))
        block = np.block([[-matrix * time, np.eye(3) * time], [zero, zero]])
        exact = scipy.linalg.expm(block)
        size = np.max(np.abs(exact))
        np.testing.assert_allclose(change, exact[:3, :3] - np.eye(3), atol=1e-13 * size)
        np.testing.assert_allclose(integral, exact[:3, 3:], atol=1e-13 * size)
        if scale < 1:
            products = exponential_products(matrix, time, Y0[0])
            assert_close(products, (change @ Y0[0], integral @ Y0[0]), 1e-15)


@pytest.mark.parametrize("scale", [0.3, 20.0])
def test_exponential_products_and_their_derivatives(scale):
    x, time = Y0[0], jnp.asarray(0.4)
    products = exponential_products(scale * C, time, x)
    change, integral = (y[0] for y in exponentials(scale * C, time[None]))
    assert_close(products, (change @ x, integral @ x), 1e-12)
    total = lambda *args: jnp.sum(jnp.sin(jnp.stack(exponential_products(*args))))
    at, d = (scale * C, time, x), 1e-6
    along = jnp.cos(jnp.arange(9.0)).reshape(3, 3), jnp.asarray(0.3), jnp.sin(x)
    moved = lambda d: [y + d * dy for y, dy in zip(at, along, strict=True)]
    wanted = (total(*moved(d)) - total(*moved(-d))) / (2 * d)
    slopes = jax.grad(total, argnums=(0, 1, 2))(*at)
    found = sum(jnp.sum(g * dy) for g, dy in zip(slopes, along, strict=True))
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(jax.jvp(total, at, along)[1], found, rtol=1e-12)


@pytest.mark.parametrize("h, medium", [(0.7, None), (-0.2, [0.5, -1.0])])
def test_the_decay_by_drag(h, medium):
    drag = dps.Drag(0.4, None if medium is None else jnp.array(medium))
    p, wind = jnp.array([[1.0, -2.0], [0.3, 0.1]]), np.asarray(medium or 0.0)
    mass = 1.5

    def rhs(t, p):
        v = p.reshape(2, 2) / mass - wind
        return np.ravel(-0.4 * np.linalg.norm(v, axis=1, keepdims=True) * v)

    options: Any = dict(rtol=1e-12, atol=1e-13)
    end = scipy.integrate.solve_ivp(rhs, (0, h), np.ravel(p), "DOP853", **options)
    change = drag.decay(jnp.asarray(h), p, jnp.asarray(mass))
    np.testing.assert_allclose(np.ravel(p + change), end.y[:, -1], 1e-9)


def test_bodies_at_rest_have_gradients():
    drag, h, mass = dps.Drag(0.4), jnp.asarray(0.3), jnp.asarray(1.5)
    rest = jnp.zeros(2)
    decay = jax.jacrev(lambda p: drag.decay(h, p, mass))(rest)
    force = jax.jacrev(lambda p: drag.force(0.0, rest, p, p / mass, None))(rest)
    assert_close((decay, force), (jnp.zeros((2, 2)),) * 2, 0)


def test_drag_backwards_beyond_its_start_fails():
    # Backwards in time the speed becomes infinite.
    fast = dps.MechanicalSystem(KINETIC, harmonic, dps.Drag(5.0))
    y0 = jnp.zeros(2), jnp.array([30.0, 0.0])
    sol = solve(fast, dps.Strang(), 0.0, -0.5, -0.1, y0, throw=False)
    assert sol.result != dfx.RESULTS.successful


# The numbers of the friction.


def test_the_leaves_of_a_system_are_its_parameters_each_once():
    assert len(jax.tree.leaves(eqx.filter(system("matrix"), eqx.is_array))) == 2


@eqx.filter_jit
def end_of(c, solver, adjoint):
    model = dps.MechanicalSystem(DENSE, driven, dps.ViscousDamping(c))
    return flat(dfx.diffeqsolve(model, solver, 0.0, 0.5, 0.1, Y0, adjoint=adjoint).ys)


@pytest.mark.slow
def test_gradients_at_equal_eigenvalues():
    # And by reversal as by Diffrax.
    at, direction = 0.3 * jnp.eye(3), jnp.sin(1 + jnp.arange(9.0)).reshape(3, 3)
    value = lambda c, adjoint: jnp.sum(jnp.sin(end_of(c, dps.TunedRKN6(), adjoint)))
    adjoints = dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()
    first, second = (jax.grad(value)(at, adjoint) for adjoint in adjoints)
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-12)
    d = 1e-5 * direction
    central = (value(at + d, adjoints[0]) - value(at - d, adjoints[0])) / 2e-5
    np.testing.assert_allclose(central, np.sum(first * direction), rtol=1e-6)


@pytest.mark.slow
def test_vmap_over_coefficients():
    one = lambda c: end_of(c, dps.BlanesMoanRKN4(), dfx.RecursiveCheckpointAdjoint())
    many = jnp.stack([C, 2 * C, C.T])
    wanted = jnp.stack([one(c) for c in many])
    np.testing.assert_allclose(jax.vmap(one)(many), wanted, atol=1e-14)


# Energy.


@pytest.mark.parametrize("name", ["sum", "wind", "all by place"])
@pytest.mark.variants(1)
def test_energy_balance(name):
    solver = dps.BlanesMoan6() if name in LOCAL else dps.TunedRKN6()
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = solve(system(name), solver, 0.0, 2.0, 0.01, Y0, saveat=saveat, max_steps=201)
    taken = np.isfinite(saved(sol)[0])
    ts, ys = jax.tree.map(lambda x: x[taken], saved(sol))
    assert np.max(np.abs(energy_error(system(name), ts, ys))) < 1e-7


@pytest.mark.slow
def test_power_lost():
    term = dps.MechanicalSystem(DENSE, harmonic, dps.ViscousDamping(C))
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 2, 201))
    ts, ys = saved(solve(term, dps.TunedRKN6(), 0.0, 2.0, 0.1, Y0, saveat=saveat))
    v = jnp.linalg.solve(MASS, ys[1].T).T
    wanted = jnp.einsum("ni,ij,nj->n", v, C, v)
    np.testing.assert_allclose(power_lost(term, ts, ys), wanted, atol=1e-14)
    energies = energy(term, ts, ys)
    total = energies + energy_lost(term, ts, ys)
    np.testing.assert_allclose(total, energies[0], atol=1e-8)
    joints = dps.LagrangianSystem(lambda t, q, a: MASS, harmonic, dps.ViscousDamping(C))
    np.testing.assert_allclose(power_lost(joints, ts, ys), wanted, atol=1e-14)


# Errors.

NUMBER: Any = 0.3
UNKNOWN = dps.RelativisticKinetic()
MISTAKES = {
    "not finite": (lambda: dps.ConstantDamping(jnp.nan), "must be finite"),
    "not finite matrix": (lambda: dps.ViscousDamping(C * jnp.inf), "must be finite"),
    "not finite drag": (lambda: dps.Drag(jnp.nan), "must be finite"),
    "not finite wind": (lambda: dps.Drag(0.1, medium=WIND * jnp.nan), "be finite"),
    "no coefficients": (lambda: dps.ViscousDamping(None), r"ViscousDamping\(1.0\)"),
    "rate by place": (lambda: dps.PositionDamping(NUMBER), r"ConstantDamping\(rate\)"),
    "unknown mass": (
        lambda: dps.MechanicalSystem(UNKNOWN, harmonic, dps.Drag(0.1)),
        r"QuadraticKinetic\(mass\)",
    ),
    "force": (
        lambda: dps.MechanicalSystem(KINETIC, harmonic, force=1.0),
        "f.t, q, v, args",
    ),
}


@pytest.mark.parametrize("make, message", MISTAKES.values(), ids=MISTAKES)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


SHAPES = {
    "rates": (dps.ConstantDamping(jnp.ones(2)), "does not fit"),
    "rates of several axes": (
        dps.ConstantDamping(jnp.ones((1, 3))),
        "one row and column",
    ),
    "a matrix of rates": (dps.ConstantDamping(C), r"ViscousDamping\(matrix\)"),
    "a list": (dps.ConstantDamping([0.1, 0.2, 0.3]), "jnp.array"),
    "coefficients": (dps.ViscousDamping(jnp.ones(2)), "does not fit"),
    "matrix": (dps.ViscousDamping(jnp.ones((2, 2))), "one row and column"),
    "place": (dps.PositionDamping(lambda t, q, args: jnp.ones(2)), "does not fit"),
    "drag by entry": (dps.Drag(jnp.ones(3)), "one for each body"),
    "drag by place": (dps.Drag(lambda t, q, args: jnp.ones(3)), "one for each body"),
    "laws of time": (
        [dps.ViscousDamping(C), dps.LogDamping(1.0)],
        "no exact flow together",
    ),
    "operator": (
        dps.ViscousDamping(
            lx.FunctionLinearOperator(
                lambda v: {"x": v["x"]}, {"x": jax.ShapeDtypeStruct((3,), float)}
            )
        ),
        "in one vector",
    ),
}


@pytest.mark.parametrize("friction, message", SHAPES.values(), ids=SHAPES)
def test_shapes_that_do_not_fit(friction, message):
    wrong = dps.MechanicalSystem(KINETIC, harmonic, friction)
    y0 = ({"x": Y0[0]}, {"x": Y0[1]}) if message == "in one vector" else Y0
    with pytest.raises(ValueError, match=message):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, y0)


@pytest.mark.parametrize("medium", [jnp.ones(2), lambda t, q, args: jnp.ones(2)])
def test_a_wind_that_does_not_fit(medium):
    wrong = dps.MechanicalSystem(KINETIC, harmonic, dps.Drag(0.1, medium=medium))
    with pytest.raises(ValueError, match="does not fit"):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, Y0)


def test_drag_needs_bodies():
    wrong = dps.MechanicalSystem(KINETIC, harmonic, dps.Drag(0.1))
    with pytest.raises(ValueError, match=r"`\(n, 1\)`"):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, (jnp.array(1.0), jnp.array(0.0)))
    unequal = dps.QuadraticKinetic(jnp.array([1.0, 2.0, 3.0]))
    wrong = dps.MechanicalSystem(unequal, harmonic, dps.Drag(0.1))
    with pytest.raises(ValueError, match="one for each body"):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, Y0)


def test_a_momentum_that_is_not_finite_is_one_member_of_a_batch():
    """With a mass of Lineax too, which itself raises an error for all."""
    mass = lx.MatrixLinearOperator(jnp.array([[2.0, 0.5], [0.5, 1.0]]))
    energy = lambda p: jnp.sum(dps.QuadraticKinetic(mass).velocity(0.0, p) ** 2)
    p = jnp.array([[1.0, 2.0], [jnp.nan, 1.0]])
    slopes = jax.vmap(jax.grad(energy))(p)
    inverse = np.linalg.inv(mass.matrix)
    np.testing.assert_allclose(slopes[0], 2 * inverse @ inverse @ p[0], rtol=1e-14)
    assert np.all(np.isnan(slopes[1]))


def test_the_gradient_through_an_operator_that_is_not_symmetric():
    matrix = jnp.array([[2.0, 0.5], [-0.3, 1.0]])
    like = jax.ShapeDtypeStruct((2,), matrix.dtype)
    mass = dps.QuadraticKinetic(lx.FunctionLinearOperator(lambda v: matrix @ v, like))
    p = jnp.array([1.0, 2.0])
    slope = jax.grad(lambda p: jnp.sum(mass.velocity(0.0, p) ** 2))(p)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(slope, 2 * inverse.T @ inverse @ p, rtol=1e-14)
