# pyright: reportAssignmentType=false, reportArgumentType=false, reportReturnType=false
# pyright: reportCallIssue=false, reportOptionalSubscript=false
"""Friction by matrices, place and speed: forces, structure, exponentials and energy."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_close, flat, harmonic, solve, step

import diffrax_presym as dps
from diffrax_presym._forms import vecmat
from diffrax_presym._friction._exponential import (
    exponential,
    exponential_products,
    exponentials,
)
from diffrax_presym.diagnostics import energy, energy_error, energy_lost, power_lost


MASS = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 1.5]])
# Neither symmetric nor normal.
C = jnp.array([[0.3, 0.5, -0.2], [-0.3, 0.2, 0.1], [0.1, -0.4, 0.25]])
STIFFNESS = jnp.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
FIELD = jnp.array([[0.0, -0.7, 0.2], [0.7, 0.0, 1.1], [-0.2, -1.1, 0.0]])
WIND = jnp.array([1.0, -0.5, 0.2])
Y0 = (jnp.array([0.8, -0.5, 0.3]), jnp.array([0.2, 0.6, -0.4]))
DENSE, UNIT = dps.QuadraticKinetic(MASS), dps.QuadraticKinetic()
FIXED = dps.FixedStepAdjoint()


def driven(t, q, args):
    coupling = q[0] * q[1] * q[2] / 2 + q[0] ** 2 * q[1] / 2 * jnp.cos(t)
    return jnp.sum(jnp.cosh(q)) + coupling


def gust(t, q, args):
    return jnp.stack([jnp.sin(t), q[0], 1 + 0 * t])


def layer(t, q, args):
    return 0.5 * jnp.exp(-(q**2))


def dense(laws):
    return dps.MechanicalSystem(DENSE, driven, laws)


OPERATOR = lx.FunctionLinearOperator(lambda v: C @ v, jax.eval_shape(lambda: Y0[1]))
SUM = [
    dps.ViscousDamping(C),
    dps.ViscousDamping(0.1 * STIFFNESS),
    dps.ConstantDamping(0.2),
]
LAYERS = [
    dps.Drag(lambda t, q, args: 0.3 * jnp.exp(-(q[:1] ** 2)), medium=WIND),
    *(dps.PositionDamping(layer), dps.ViscousDamping(C)),
]
# Of bodies of the mass 2, and for each the force by hand.
BODIES = {
    "gust": (
        dps.Drag(0.3, medium=gust),
        lambda q, v, w: -0.3 * np.linalg.norm(v - w) * (v - w),
    ),
    "all by place": (
        LAYERS,
        lambda q, v, w: (
            -0.3 * np.exp(-(q[0] ** 2)) * np.linalg.norm(v - WIND) * (v - WIND)
            - 0.5 * np.exp(-(q**2)) * 2 * v
            - np.array(C) @ v
        ),
    ),
}


def bodies(name):
    return dps.MechanicalSystem(dps.QuadraticKinetic(2.0), driven, BODIES[name][0])


@pytest.mark.parametrize("name", BODIES)
def test_friction_of_bodies(name):
    q, p = map(np.asarray, Y0)
    found = bodies(name).friction_force(jnp.array(0.3), *Y0)
    wind = np.array([np.sin(0.3), q[0], 1])
    assert_close(found, jnp.asarray(BODIES[name][1](q, p / 2, wind)), 1e-15)


def test_friction_by_place_as_a_matrix_and_as_a_number():
    matrix = lambda t, q, args: (1 + jnp.sum(q**2)) * C
    number, array = lambda t, q, args: 0.3, lambda t, q, args: 0.3 * jnp.ones(3)
    run = lambda law: step(
        dps.MechanicalSystem(UNIT, harmonic, law), dps.BlanesMoan6(), 0.0, 0.3, Y0
    )[0]
    by_place = dps.PositionDamping
    assert_close(run(by_place(matrix)), run(dps.ViscousDamping(matrix)), 1e-14)
    assert_close(run(by_place(number)), run(by_place(array)), 1e-14)


# Structure.

LINEAR = {
    "viscous number": (dps.ViscousDamping(0.3), 0.3 * np.linalg.inv(MASS)),
    "operator": (dps.ViscousDamping(OPERATOR), C @ np.linalg.inv(MASS)),
    "sum": (SUM, (C + 0.1 * STIFFNESS) @ np.linalg.inv(MASS) + 0.2 * np.eye(3)),
}


@pytest.mark.parametrize("laws, rates", LINEAR.values(), ids=LINEAR)
@pytest.mark.parametrize("solver", [dps.TunedRKN6(), dps.PresymplecticLeapfrog()])
def test_phase_volume_contracts_by_the_trace(laws, rates, solver):
    end = lambda q, p: step(dense(laws), solver, 0.3, 0.5, (q, p))[0]
    jacobian = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(*Y0)
    matrix = np.block([[np.array(x) for x in row] for row in jacobian])
    lost = 0.2 * np.trace(rates)
    np.testing.assert_allclose(np.linalg.det(matrix), np.exp(-lost), 1e-13)


@pytest.mark.parametrize(
    "system, solver",
    [
        (dense(dps.ViscousDamping(C)), dps.TunedRKN6()),
        (bodies("gust"), dps.BlanesMoan6()),
    ],
    ids=["matrix", "gust"],
)
def test_a_step_backwards_undoes_a_step(system, solver):
    there = step(system, solver, 0.0, 0.2, Y0)[0]
    assert_close(step(system, solver, 0.2, 0.0, there)[0], Y0, 1e-13)


@pytest.mark.parametrize("steps", [2000, pytest.param(10**6, marks=pytest.mark.slow)])
def test_energy_in_a_magnetic_field_does_not_drift(steps):
    friction, h = dps.ViscousDamping(FIELD), 0.3
    field = dps.MechanicalSystem(dps.QuadraticKinetic(2.0), harmonic, friction)
    ts = jnp.linspace(0, steps * h, 6)[1:]
    sol: Any = solve(
        *(field, dps.TunedRKN6(), 0.0, steps * h, h, Y0),
        max_steps=None,
        saveat=dfx.SaveAt(ts=ts),
        adjoint=FIXED,
    )
    # The scheme makes an error that oscillates; rounding would accumulate.
    errors = energy(field, ts, sol.ys) / field.energy(0.0, *Y0) - 1
    assert np.max(np.abs(errors)) < 1e-9


def test_a_batch_of_particles_in_one_field():
    q = jnp.stack([Y0[0], -Y0[1]])

    def end(mass, field, q):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(mass), harmonic, dps.ViscousDamping(field)
        )
        return step(system, dps.TunedRKN6(), 0.0, 0.3, (q, q))[0]

    ends = end(jnp.array([[2.0], [1.0]]), FIELD[None], q)
    for i, mass in enumerate([2.0, 1.0]):
        assert_close((ends[0][i], ends[1][i]), end(mass, FIELD, q[i]), 1e-14)


# Exponentials.


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


@pytest.mark.parametrize("n", [1, 2, 12, 13])
@pytest.mark.parametrize("scale", [0.0, 1e-9, 2.0, 30.0])
def test_exponential_of_a_small_or_large_matrix_and_its_derivative(n, scale):
    # Sizes on both sides of that from which on it is computed by SciPy's algorithm.
    rng = np.random.default_rng(n)
    x, dx = rng.standard_normal((2, n, n)) / n
    x = scale * (x - x.T)
    found, slope = jax.jvp(exponential, (jnp.asarray(x),), (jnp.asarray(dx),))
    exact, wanted = scipy.linalg.expm_frechet(x, dx)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)
    np.testing.assert_allclose(slope, wanted, rtol=0, atol=1e-13)
    if n > 1:
        np.testing.assert_allclose(found @ found.T, np.eye(n), rtol=0, atol=1e-13)


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


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_as_many_terms_as_the_size_of_a_matrix_needs(dtype):
    x, unit = Y0[0].astype(dtype), (C / np.linalg.norm(C, 1)).astype(dtype)
    find = jax.jit(lambda h: exponential_products(unit, h, x))
    for size in np.logspace(-18, 0.3, 60):
        h = jnp.asarray(size, dtype)
        series, term, generator = np.zeros(3), np.asarray(x, float), -np.asarray(unit)
        for k in range(30):
            series += term / (k + 1)
            term = float(h) * generator.astype(float) @ term / (k + 1)
        change, integral = (np.asarray(y, float) for y in find(h))
        wanted = generator.astype(float) @ series
        atol = 8 * float(jnp.finfo(dtype).eps) * np.max(np.abs(x))
        np.testing.assert_allclose(change / float(h), wanted, rtol=0, atol=atol)
        np.testing.assert_allclose(integral / float(h), series, rtol=0, atol=atol)


@pytest.mark.variants(4)
@pytest.mark.parametrize("axes", [(None, None), (0, None), (None, 0), (0, 0)])
@pytest.mark.parametrize("n", [1, 10, 11, 32, 33])
def test_a_vector_times_one_of_many_matrices(n, axes):
    """Alone and in a batch, with derivatives by both, against NumPy."""
    rng = np.random.default_rng(n)
    x, matrix = rng.normal(size=(2, n)), rng.normal(size=(2, n, n))
    dx, d_matrix = rng.normal(size=x.shape), rng.normal(size=matrix.shape)
    at = lambda *xs: [
        jnp.asarray(x if i == 0 else x[0]) for x, i in zip(xs, axes, strict=True)
    ]
    product = jax.vmap(vecmat, axes) if axes != (None, None) else vecmat
    primals, tangents = at(x, matrix), at(dx, d_matrix)
    found, slope = jax.jvp(product, primals, tangents)
    rows = lambda *xs: np.einsum("...j,...jk->...k", *xs)
    wanted = rows(tangents[0], primals[1]) + rows(primals[0], tangents[1])
    np.testing.assert_allclose(found, rows(*primals), rtol=0, atol=1e-13)
    np.testing.assert_allclose(slope, wanted, rtol=0, atol=1e-13)
    pulled = jax.vjp(product, *primals)[1](found)
    both = zip(pulled, tangents, strict=True)
    total = sum(jnp.sum(g * d) for g, d in both)
    np.testing.assert_allclose(total, np.sum(found * slope), rtol=1e-11)


@pytest.mark.parametrize("size", [5.0, 11.0, 14.0])
def test_friction_by_an_operator_in_single_precision(size):
    rates = np.linspace(0.1, size, 8).astype(np.float32)
    p0, like = jnp.ones(8, jnp.float32), jax.ShapeDtypeStruct((8,), jnp.float32)
    operator = lx.FunctionLinearOperator(
        lambda v: jnp.asarray(np.diag(rates)) @ v, like
    )
    free, law = lambda t, q, args: 0.0 * jnp.sum(q), dps.ViscousDamping(operator)
    times = map(jnp.float32, (0.0, 1.0, 1.0))
    args = dps.MechanicalSystem(UNIT, free, law), dps.Strang(), *times, (0 * p0, p0)
    p = np.asarray(solve(*args, throw=False).ys[1][-1])
    np.testing.assert_allclose(p, np.exp(-rates.astype(float)), rtol=0, atol=1e-6)


# Drag.


def test_bodies_at_rest_have_gradients():
    drag, h, mass = dps.Drag(0.4), jnp.asarray(0.3), jnp.asarray(1.5)
    rest = jnp.zeros(2)
    decay = jax.jacrev(lambda p: drag.decay(h, p, mass))(rest)
    force = jax.jacrev(lambda p: drag.force(0.0, rest, p, p / mass, None))(rest)
    assert_close((decay, force), (jnp.zeros((2, 2)),) * 2, 0)


def test_drag_backwards_beyond_its_start_fails():
    # Backwards in time the speed becomes infinite.
    fast = dps.MechanicalSystem(UNIT, harmonic, dps.Drag(5.0))
    y0 = jnp.zeros(2), jnp.array([30.0, 0.0])
    sol = solve(fast, dps.Strang(), 0.0, -0.5, -0.1, y0, throw=False)
    assert sol.result != dfx.RESULTS.successful


# The numbers of the friction.


def test_the_leaves_of_a_system_are_its_parameters_each_once():
    leaves = jax.tree.leaves(eqx.filter(dense(dps.ViscousDamping(C)), eqx.is_array))
    assert len(leaves) == 2


@pytest.mark.slow
def test_vmap_over_coefficients():
    @jax.jit
    def one(c):
        args = dense(dps.ViscousDamping(c)), dps.BlanesMoanRKN4(), 0.0, 0.5, 0.1, Y0
        return flat(dfx.diffeqsolve(*args).ys)

    many = jnp.stack([C, 2 * C, C.T])
    wanted = jnp.stack([one(c) for c in many])
    np.testing.assert_allclose(jax.vmap(one)(many), wanted, atol=1e-14)


# Energy.

JOINTS = dps.LagrangianSystem(lambda t, q, args: MASS, driven, dps.ViscousDamping(C))


@pytest.mark.variants(3)
@pytest.mark.parametrize(
    "system, solver",
    [
        (dense(SUM), dps.TunedRKN6()),
        (bodies("all by place"), dps.BlanesMoan6()),
        (JOINTS, dps.PresymplecticGauss(3)),
    ],
    ids=["sum", "all by place", "joints"],
)
def test_energy_balance(system, solver):
    ts = jnp.linspace(0.0, 2.0, 201)
    sol: Any = solve(system, solver, 0.0, 2.0, 0.01, Y0, saveat=dfx.SaveAt(ts=ts))
    assert np.max(np.abs(energy_error(system, ts, sol.ys))) < 1e-7


def test_power_lost():
    term = dps.MechanicalSystem(DENSE, harmonic, dps.ViscousDamping(C))
    ts = jnp.linspace(0, 2, 201)
    sol: Any = solve(term, dps.TunedRKN6(), 0.0, 2.0, 0.1, Y0, saveat=dfx.SaveAt(ts=ts))
    v = jnp.linalg.solve(MASS, sol.ys[1].T).T
    wanted = jnp.einsum("ni,ij,nj->n", v, C, v)
    joints = dps.LagrangianSystem(lambda t, q, a: MASS, harmonic, dps.ViscousDamping(C))
    for system in (term, joints):
        found = power_lost(system, ts, sol.ys)
        np.testing.assert_allclose(found, wanted, atol=1e-14)
    total = energy(term, ts, sol.ys) + energy_lost(term, ts, sol.ys)
    np.testing.assert_allclose(total, total[0], atol=1e-8)
