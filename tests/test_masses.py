"""Masses, stiffnesses and friction of all forms; momenta of velocities and back."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close, equations, flat, harmonic, mixed_energy, solve

import diffrax_presym as dps


T, P = jnp.array(1.3), jnp.array([0.9, 0.4])
MASS = jnp.array([[2.0, 0.3], [0.3, 1.0]])
QUADRATIC, RELATIVISTIC = dps.QuadraticKinetic(MASS), dps.RelativisticKinetic(1.5, 2.0)


# Masses of all forms.

P2 = jnp.array([[0.3, -0.2, 1.0], [0.5, 0.1, -0.4]])
TREE = {"a": P, "b": (jnp.array(0.5), P2)}
MATRIX = jnp.array([[2.0, -0.5, 0.0], [-0.5, 1.0, 0.1], [0.0, 0.1, 3.0]])
MASSES = {
    "none": (None, P, P),
    "none, array of rank two": (None, P2, P2),
    "number": (2.0, P2, P2 / 2),
    "integer": (2, TREE, jtu.tree_map(lambda x: x / 2, TREE)),
    "each degree of freedom": (jnp.array([2.0, 5.0]), P, P / np.array([2.0, 5.0])),
    "each particle": (
        jnp.array([[2.0], [5.0]]),
        P2,
        P2 / np.array([[2.0, 2.0, 2.0], [5.0, 5.0, 5.0]]),
    ),
    "each direction": (
        jnp.array([[2.0, 3.0, 4.0]]),
        P2,
        P2 / np.array([[2.0, 3.0, 4.0], [2.0, 3.0, 4.0]]),
    ),
    "matrix": (MASS, P, np.linalg.solve(MASS, P)),
    "symmetric to rounding": (
        MASS.at[0, 1].multiply(1 + 1e-15),
        P,
        np.linalg.solve(MASS, P),
    ),
    "each vector a matrix": (
        jnp.stack([MATRIX, 2 * MATRIX]),
        P2,
        np.linalg.solve(MATRIX, P2.T).T / np.array([[1.0], [2.0]]),
    ),
    "square, each entry": (
        jnp.array([[2.0, 3.0], [5.0, 7.0]]),
        P2[:, :2],
        P2[:, :2] / np.array([[2.0, 3.0], [5.0, 7.0]]),
    ),
    "operator": (
        lx.MatrixLinearOperator(MASS, lx.positive_semidefinite_tag),
        P,
        np.linalg.solve(MASS, P),
    ),
    "pytree": (
        {"a": MASS, "b": (4.0, jnp.array([[2.0], [5.0]]))},
        TREE,
        {
            "a": jnp.linalg.solve(MASS, P),
            "b": (jnp.array(0.125), P2 / np.array([[2.0] * 3, [5.0] * 3])),
        },
    ),
}


@pytest.mark.parametrize("mass, p, expected", MASSES.values(), ids=MASSES)
def test_masses(mass, p, expected):
    kinetic = dps.QuadraticKinetic(mass)
    velocity = kinetic.velocity(T, p)
    assert jtu.tree_structure(velocity) == jtu.tree_structure(p)
    assert_close(velocity, jtu.tree_map(jnp.asarray, expected), 1e-15)
    assert_close(kinetic.factorised(p).velocity(T, p), velocity, 1e-15)
    assert_close(kinetic(T, p), flat(p) @ flat(expected) / 2, 1e-15)
    assert_close(velocity, jax.grad(kinetic, 1)(T, p), 1e-14)


@pytest.mark.variants(3)
@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("n", [3, 10, 20])
@pytest.mark.parametrize("by_place", [False, True])
def test_a_matrix_is_factorised_once(n, constrained, by_place):
    x = np.random.default_rng(0).normal(size=(n, n))
    M, q = jnp.asarray(np.eye(n) + 0.1 * x @ x.T / n), jnp.linspace(0.5, 1.0, n)

    law = dps.ViscousDamping((lambda t, q, args: q**2) if by_place else 0.1)

    def end(M, adjoint=None, law: Any = law):
        kinetic = dps.QuadraticKinetic(M)
        system: Any = dps.MechanicalSystem(kinetic, harmonic, law)
        if constrained:
            system = dps.ConstrainedSystem(system, lambda t, q, args: q[:2] - 0.5)
        y0 = system.project(0.0, (q.at[:2].set(0.5), 1 - q))
        solver = dps.Strang() if constrained or by_place else dps.TunedRKN6()
        adjoint = adjoint or dps.FixedStepAdjoint()
        sol = solve(system, solver, 0.0, 1.0, 0.1, y0, adjoint=adjoint)
        return jax.tree.map(lambda x: x[-1], sol.ys)

    if by_place:  # Not again for the friction at each place.
        with_law = lambda law: jax.make_jaxpr(lambda M: end(M, law=law))(M)
        count = lambda law: str(with_law(law)).count("cholesky")
        assert count(law) == count(None)
        # A matrix that is not symmetric, as a function.
        C = jnp.asarray(0.3 * x)
        in_kicks = end(M, law=dps.ViscousDamping(lambda t, q, args: C))
        in_drifts = end(M, law=dps.ViscousDamping(C))
        assert_close(in_kicks, in_drifts, 1e-2)
    assert_close(end(M), end(M, dfx.RecursiveCheckpointAdjoint()), 1e-13)
    slope = jax.grad(lambda M: jnp.sum(end(M)[0] ** 2))(M)
    change = jnp.asarray(x + x.T)
    near = [jnp.sum(end(M + s * change)[0] ** 2) for s in (1e-5, -1e-5)]
    assert_close(jnp.sum(slope * change), (near[0] - near[1]) / 2e-5, 1e-8)
    every = equations(jax.make_jaxpr(end)(M).jaxpr)
    loops = [x for x in every if x.primitive.name == "while"]
    assert loops
    if not constrained:  # Multipliers are found in every step.
        assert not any("custom_linear_solve" in str(loop) for loop in loops)


SPRINGS: dict[str, tuple[Any, Any]] = {
    "none": (None, lambda q: q),
    "number": (2.0, lambda q: 2 * q),
    "negative": (-1, lambda q: -q),
    "vector": (jnp.array([2.0, 3.0]), lambda q: jnp.array([2.0, 3.0]) * q),
    "matrix": (MASS, lambda q: MASS @ q),
    "operator": (lx.MatrixLinearOperator(MASS, lx.symmetric_tag), lambda q: MASS @ q),
}


@pytest.mark.parametrize("stiffness, product", SPRINGS.values(), ids=SPRINGS)
def test_stiffnesses(stiffness, product):
    q, potential = jnp.array([1.0, 0.5]), dps.QuadraticPotential(stiffness)
    system = dps.MechanicalSystem(RELATIVISTIC, potential)
    assert_close(potential(T, q), jnp.dot(q, product(q)) / 2, 1e-15)
    assert_close(system.force(T, q, P), -product(q), 1e-15)
    assert_close(jax.grad(potential, argnums=1)(T, q, None), product(q), 1e-15)


def test_negative_effective_masses_have_a_way():
    # A synchrotron above transition: phi'' = -omega^2 sin(phi) about phi = 0, of
    # T = -p^2 / 2 m and the potential of the opposite sign, with friction.
    m, gamma = 2.0, 0.3
    kinetic = lambda t, p, args: -jnp.sum(p**2) / (2 * m)
    top = lambda t, q, args: jnp.sum(jnp.cos(q))
    system = dps.MechanicalSystem(kinetic, top, dps.ConstantDamping(gamma))
    y0 = jnp.array([0.5]), jnp.array([-m * 0.2])
    ys: Any = solve(system, dps.BlanesMoan6(), 0.0, 10.0, 0.05, y0).ys
    rates = lambda t, y: [y[1], -np.sin(y[0]) / m - gamma * y[1]]
    options: Any = {"rtol": 1e-12, "atol": 1e-12}
    exact = scipy.integrate.solve_ivp(rates, (0, 10), [0.5, 0.2], **options).y[:, -1]
    end = jax.tree.map(lambda x: x[-1], ys)
    assert_close(end, (exact[:1], -m * exact[1:]), 1e-8)


ANY = dps.MechanicalSystem(
    lambda t, p, args: args * jnp.sum(p**4) / 4 + jnp.cos(t) * p[0] * p[1], harmonic
).kinetic


@pytest.mark.parametrize(
    "kinetic", [QUADRATIC, RELATIVISTIC, ANY], ids=["quadratic", "relativistic", "any"]
)
def test_rescaled_kinetic_energies(kinetic):
    s, args = jnp.array(0.8), jnp.array(1.7)
    rescaled, p = kinetic.rescale(s), jnp.exp(s) * P
    value, velocity = kinetic(T, p, args), kinetic.velocity(T, p, args)
    assert_close(rescaled(T, P, args), jnp.exp(-2 * s) * value, 1e-14)
    assert_close(rescaled.velocity(T, P, args), jnp.exp(-s) * velocity, 1e-14)


# Momenta of velocities.

VELOCITIES = {
    "quadratic": dps.MechanicalSystem(QUADRATIC, harmonic),
    "relativistic": dps.MechanicalSystem(RELATIVISTIC, harmonic),
    "any energy": dps.Hamiltonian(mixed_energy),
    "dissipative": dps.DissipativeHamiltonian(
        QUADRATIC, harmonic, dps.LogDamping(3.0, 0.5), dps.ConstantDamping(0.7)
    ),
}


@pytest.mark.parametrize("system", VELOCITIES.values(), ids=VELOCITIES)
def test_states_by_velocities(system):
    q0 = jnp.array([0.3, -0.7])
    q, v = system.to_velocity(T, (q0, P))
    assert_close((q, v), (q0, system.velocity(T, q0, P)), 0)
    state = eqx.filter_jit(system.from_velocity)(T, (q, v))
    assert_close(state, (q0, P), 1e-13)
    saveat = dfx.SaveAt(t0=True, fn=system.to_velocity)
    sol = solve(system, dfx.Tsit5(), T, T + 0.1, 0.1, state, saveat=saveat)
    assert_close(jax.tree.map(lambda x: x[0], sol.ys), (q, v), 1e-13)


def test_no_momentum_of_an_infinite_mass_at_rest():
    """As of a position that counts what nothing depends on."""
    mass, v = jnp.array([2.0, jnp.inf]), jnp.array([0.3, 0.0])
    system = dps.MechanicalSystem(dps.QuadraticKinetic(mass), harmonic)
    body = dps.Attitude(jnp.ones(3)), dps.Euclidean(mass)
    product = dps.ManifoldSystem(body, lambda t, q, args: 0.0)
    turned = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(2)
    momentum = lambda v: system.from_velocity(0.0, (jnp.zeros(2), v))[1]
    _, (_, p) = product.from_velocity(0.0, (turned, (jnp.zeros(3), v)))
    for found in (momentum(v), p):
        np.testing.assert_array_equal(found, [0.6, 0.0])
    assert np.isfinite(jax.grad(lambda v: momentum(v)[0])(v)).all()


def test_momenta_of_large_velocities():
    matrix = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.7, 0.2], [0.1, 0.2, 3.3]])
    general = dps.Hamiltonian(lambda t, q, p, args: p @ matrix @ p / 2)
    light = dps.MechanicalSystem(dps.RelativisticKinetic(2.0, 3e8), harmonic)
    for system, size in ((general, 1e3), (light, 1e8)):
        for seed in range(4):
            v = size * np.random.default_rng(seed).standard_normal(3) / 2
            y = system.from_velocity(0.0, (jnp.zeros(3), jnp.asarray(v)))
            np.testing.assert_allclose(system.to_velocity(0.0, y)[1], v, 1e-10)
    fast = dps.Hamiltonian(lambda t, q, p, args: jnp.sqrt(1 + p @ p))
    v = jnp.array([0.999])
    wanted = 0.999 / np.sqrt(1 - 0.999**2)
    np.testing.assert_allclose(fast.from_velocity(0.0, (v, v))[1], wanted, 1e-10)


# Derivatives through masses of Lineax.


def test_a_momentum_that_is_not_finite_is_one_member_of_a_batch():
    """Lineax itself raises an error for all."""
    mass = dps.QuadraticKinetic(lx.MatrixLinearOperator(MASS))
    energy = lambda p: jnp.sum(mass.velocity(0.0, p) ** 2)
    p = jnp.array([[1.0, 2.0], [jnp.nan, 1.0]])
    slopes = jax.vmap(jax.grad(energy))(p)
    inverse = np.linalg.inv(MASS)
    np.testing.assert_allclose(slopes[0], 2 * inverse @ inverse @ p[0], rtol=1e-14)
    assert np.all(np.isnan(slopes[1]))


def test_the_gradient_through_an_operator_that_is_not_symmetric():
    matrix = jnp.array([[2.0, 0.5], [-0.3, 1.0]])
    like = jax.ShapeDtypeStruct((2,), matrix.dtype)
    mass = dps.QuadraticKinetic(lx.FunctionLinearOperator(lambda v: matrix @ v, like))
    slope = jax.grad(lambda p: jnp.sum(mass.velocity(0.0, p) ** 2))(P)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(slope, 2 * inverse.T @ inverse @ P, rtol=1e-14)


# Friction of several particles.


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("by_place", [False, True])
@pytest.mark.parametrize("solver", [dps.BlanesMoan4(), dfx.Tsit5()])
def test_the_matrix_of_a_field_is_not_taken_for_its_entries(n, by_place, solver):
    lower = np.tri(n, k=-1)
    field = jnp.asarray(0.1 * np.eye(n) + lower - lower.T)
    q, p = np.random.default_rng(0).normal(size=(2, n, n))

    def solved(C, y0):
        law = dps.ViscousDamping((lambda t, q, args: C) if by_place else C)
        system = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, law)
        return flat(solve(system, solver, 0.0, 1.0, 0.01, y0, throw=False).ys)

    assert not np.any(np.isfinite(solved(field, (q, p))[n * n :]))
    each = [solved(field, y0) for y0 in zip(q, p, strict=True)]
    each = np.moveaxis(np.reshape(each, (n, 2, n)), 1, 0)
    together = np.reshape(solved(field[None], (q, p)), (2, n, n))
    np.testing.assert_allclose(together, each, rtol=0, atol=1e-13)
