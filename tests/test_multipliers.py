"""The multipliers of constraints: their linear systems, and states and steps for which
there are none."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from on_manifolds import bobs, links

import diffrax_presym as dps
from diffrax_presym._system import _multipliers


diffeqsolve: Any = dfx.diffeqsolve
G = 9.81
FREE = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: G * q[2])
SPHERE = dps.ConstrainedSystem(FREE, lambda t, q, args: q @ q - 1)


@pytest.mark.variants(2)
@pytest.mark.parametrize("n", [12, 1, 2])
def test_the_diagonals_of_a_chain_are_its_matrix(n):
    free = dps.MechanicalSystem(
        *(dps.QuadraticKinetic(jnp.linspace(1.0, 2.0, n)[:, None]),),
        *(lambda t, q, args: G * jnp.sum(q[:, 1]), dps.ConstantDamping(0.2)),
    )
    y0 = bobs(np.linspace(1.0, 1.5, n)), jnp.zeros((n, 2))

    def loss(p, solver):
        system = dps.ConstrainedSystem(free, links, linear_solver=solver)
        q, p = system.project(0.0, (y0[0], p))
        adjoint = dps.FixedStepAdjoint()
        args = (system, dps.Strang(), 0.0, 0.5, 0.01, (q, p))
        q, p = diffeqsolve(*args, adjoint=adjoint).ys
        return jnp.sum(q**3) + jnp.sum(p)

    grad = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    value, slope = grad(y0[1] + 0.1, None)
    other, other_slope = grad(y0[1] + 0.1, lx.Tridiagonal())
    np.testing.assert_allclose(other, value, rtol=1e-12)
    np.testing.assert_allclose(other_slope, slope, atol=1e-11)
    # Without a matrix, by products.
    other, _ = grad(y0[1] + 0.1, lx.GMRES(1e-13, 1e-13))
    np.testing.assert_allclose(other, value, rtol=1e-11)


@pytest.mark.parametrize("n", [2, 5, 17])
def test_multipliers_by_pivots(n):
    """Of matrices with zeros on the diagonal, as of Newton's method for long steps."""
    matrix = np.random.default_rng(n).standard_normal((n, n)) * (1 - np.eye(n))
    solution = _multipliers.solve(
        lambda x: jnp.asarray(matrix) @ x, jnp.arange(1.0, n + 1), None
    )
    np.testing.assert_allclose(matrix @ solution, np.arange(1.0, n + 1), atol=1e-11)


@pytest.mark.parametrize("n", [2, 6, 24])
def test_diagonals_by_pivots(n):
    """The same of neighbours, and derivatives by the transposed system."""
    rng, near = np.random.default_rng(n), np.eye(n, k=1) + np.eye(n, k=-1)
    matrix, b = rng.standard_normal((n, n)) * near, jnp.arange(1.0, n + 1)
    product = lambda x: jnp.asarray(matrix) @ x
    solution = lambda b: _multipliers.solve(product, b, lx.Tridiagonal())
    np.testing.assert_allclose(matrix @ solution(b), b, atol=1e-10)
    slope = jax.grad(lambda b: solution(b) @ b**2)(jnp.ones(n))
    wanted = np.linalg.solve(matrix.T, np.ones(n)) + 2 * np.linalg.solve(matrix, b**0)
    np.testing.assert_allclose(slope, wanted, rtol=1e-9)


def test_links_that_friction_joins_are_no_chain():
    """Three diagonals are not their matrix, so steps fail, with an error that says it.
    The same with a mass."""
    n = 4
    joined = jnp.eye(2 * n) + 0.03 * (jnp.eye(2 * n, k=2) + jnp.eye(2 * n, k=-2))
    y0 = jnp.ravel(bobs(np.linspace(1.0, 1.5, n))), jnp.zeros(2 * n)
    weight = lambda t, q, args: G * jnp.sum(q[1::2])
    chain = lambda t, q, args: links(t, q.reshape(-1, 2), args)

    def result(solver, mass=None, friction=None):
        free = dps.MechanicalSystem(dps.QuadraticKinetic(mass), weight, friction)
        system = dps.ConstrainedSystem(free, chain, linear_solver=solver)
        args = system, dps.Strang(), 0.0, 0.5, 0.05, y0
        return diffeqsolve(*args, throw=False).result

    for parts in ({"mass": joined}, {"friction": dps.ViscousDamping(joined)}):
        assert result(None, **parts) == dfx.RESULTS.successful
        failure = result(lx.Tridiagonal(), **parts)
        assert "default `linear_solver=None`" in dfx.RESULTS[failure]


@pytest.mark.parametrize("n", [5, 6])
def test_a_ring_is_no_chain(n):
    """Its matrix has two corners, which look like diagonals every third time."""
    near = np.eye(n, k=1) + np.eye(n, k=-1)
    corners = np.eye(n, k=n - 1) + np.eye(n, k=1 - n)
    for entry in (0.0, 1.0):
        matrix = jnp.asarray(4 * np.eye(n) + near + entry * corners)
        product = lambda x, matrix=matrix: matrix @ x
        x = _multipliers.solve(product, jnp.arange(1.0, n + 1), lx.Tridiagonal())
        assert jnp.all(jnp.isnan(x)) == bool(entry)


FRICTIONS = {
    "none": lambda kind: None,
    "constant": lambda kind: dps.ConstantDamping(kind(0.5)),
    "by place": lambda kind: dps.ViscousDamping(lambda t, q, args: 0.5 + q[0] ** 2),
}


@pytest.mark.variants(4)
@pytest.mark.parametrize("kind", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("solver", [dps.Strang(), dps.BlanesMoan4()])
@pytest.mark.parametrize("friction", FRICTIONS)
def test_positions_near_the_origin(friction, solver, kind):
    """Nothing is small there but them: the support of the pendulum is above."""
    weight = lambda t, q, args: jnp.asarray(G, q.dtype) * q[1]
    law = FRICTIONS[friction](kind)
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), weight, law)
    held = dps.ConstrainedSystem(
        free, lambda t, q, args: q[0] ** 2 + q[1] ** 2 - 2 * q[1]
    )

    def end(x):
        q0 = jnp.stack([x, 1 - jnp.sqrt(1 - x**2)])
        y0 = held.project(kind(0), (q0, jnp.zeros(2, kind)))
        options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None}
        args = held, solver, kind(0), kind(20), kind(0.02), y0
        sol = diffeqsolve(*args, throw=False, **options)
        q, p = jax.tree.map(lambda y: y[-1], sol.ys)
        return sol.result == dfx.RESULTS.successful, held.violation(kind(20), q, p)

    good, violation = jax.jit(jax.vmap(end))(jnp.linspace(0.3, 0.7, 32).astype(kind))
    assert jnp.all(good) and jnp.max(violation) < 20 * float(jnp.finfo(kind).eps)


def test_the_slope_at_both_ends_of_a_correction_is_the_same():
    # It is 1 at zero, and also where the first correction ends but for 8e-6.
    bump = lambda x: 0.015 * (x / 2 - jnp.sin(2 * jnp.pi * x) / (4 * jnp.pi))
    miss = lambda x: x - 1 + bump(x) - bump(1.0)
    x, found = _multipliers.find_root(miss, jnp.zeros(1), None)
    assert found
    np.testing.assert_allclose(x, 1, 0, 1e-15)


def test_strong_friction_over_a_step():
    """The motion is slow, and follows the force: `x' = -g sin(x) / rate`."""
    for rate in (1e4, 1e6, 1e8):
        free = dps.MechanicalSystem(
            dps.QuadraticKinetic(),
            *(lambda t, q, args: G * q[1], dps.ConstantDamping(rate)),
        )
        held = dps.ConstrainedSystem(free, lambda t, q, args: q @ q - 1)
        y0 = jnp.array([0.6, -0.8]), jnp.zeros(2)
        adjoint = dps.FixedStepAdjoint()
        q, _ = diffeqsolve(held, dps.Strang(), 0.0, 1.0, 0.02, y0, adjoint=adjoint).ys
        # A step of `Strang` starts with its force for a half of it.
        np.testing.assert_allclose(q[-1, 0] - 0.6, -0.6 * 0.8 * G / rate, rtol=0.02)


def test_no_constraints():
    none = dps.ConstrainedSystem(FREE, lambda t, q, args: jnp.zeros(0))
    y0 = jnp.array([0.6, 0.0, -0.8]), jnp.array([0.4, 1.0, 0.3])
    np.testing.assert_array_equal(none.project(0.0, y0)[0], y0[0])
    ends = [
        diffeqsolve(system, dps.Strang(), 0.0, 1.0, 0.1, y0).ys
        for system in (none, FREE)
    ]
    for end, free in zip(*ends, strict=True):
        np.testing.assert_allclose(end, free, atol=1e-14)


def test_a_force_and_a_part_that_is_not_constrained():
    """Beside a rod that is held a spring, which does as without the rod."""
    potential = lambda t, q, args: G * q["rod"][1] + jnp.sum(q["spring"] ** 2)
    force = lambda t, q, v, args: jax.tree.map(lambda v: -0.4 * jnp.tanh(v), v)
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, force=force)
    held = dps.ConstrainedSystem(free, lambda t, q, args: q["rod"] @ q["rod"] - 1)
    q0 = {"rod": jnp.array([0.6, -0.8]), "spring": jnp.ones(1)}
    y0 = q0, jax.tree.map(jnp.zeros_like, q0)

    def end(system):
        q, p = diffeqsolve(system, dps.BlanesMoan4(), 0.0, 1.0, 0.05, y0).ys
        return q["spring"], p["spring"], jnp.sum(q["rod"] ** 2)

    (*found, length), (*expected, _) = end(held), end(free)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(length, 1.0, rtol=1e-14)


def test_a_linear_system_that_is_not_solved_is_one_member_of_a_batch():
    """NaN in derivatives too, where Lineax itself raises an error for all."""
    solver = lx.GMRES(1e-12, 1e-12, max_steps=4, restart=2)
    matrices = jnp.stack([jnp.eye(6), jnp.diag(jnp.arange(1.0, 7.0))])

    def total(b, A):
        return jnp.sum(_multipliers.solve(lambda x: A @ x, b, solver))

    slopes = jax.vmap(jax.grad(total), in_axes=(None, 0))(
        jnp.arange(1.0, 7.0), matrices
    )
    np.testing.assert_allclose(slopes[0], jnp.ones(6), rtol=1e-12)
    assert np.all(np.isnan(slopes[1]))


def test_redundant_constraints():
    y0 = jnp.array([0.6, 0.0, -0.8]), jnp.ones(3)
    both = lambda t, q, args: jnp.stack([q @ q - 1, 3 * (q @ q) - 3])
    system = dps.ConstrainedSystem(FREE, both)
    with pytest.raises(Exception, match="The constraints are redundant"):
        system.project(0.0, y0)


def test_a_step_that_is_too_long():
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0])
    with pytest.raises(Exception, match=r"(?s)Newton's method.*Take shorter steps"):
        diffeqsolve(SPHERE, dps.Strang(), 0.0, 1.0, 1.0, y0)
    far = jnp.zeros(3), jnp.zeros(3)
    with pytest.raises(Exception, match=r"redundant|did not find positions"):
        SPHERE.project(0.0, far)


def test_a_step_whose_inverse_ends_elsewhere():
    def egg(t, q, args):
        return q[0] ** 2 / 9 + q[1] ** 2 - 1 + q[0] ** 3 / 90

    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0.0 * q[0])
    q = jnp.array([3 * np.cos(5.683), np.sin(5.683)]) * 0.95
    results = []
    for check in (False, True):
        system = dps.ConstrainedSystem(free, egg, check_inverse=check)
        y0 = system.project(0.0, (q, jnp.array([1.0, 0.5])))
        args, options = (system, dps.Strang(), 0.0), {"throw": False}
        results.append(diffeqsolve(*args, 1.5, 1.5, y0, **options).result)
        short = diffeqsolve(*args, 1.0, 0.1, y0, **options)
        assert short.result == dfx.RESULTS.successful
    assert results[0] == dfx.RESULTS.successful
    assert "inverse of a step" in dfx.RESULTS[results[1]]


def test_a_step_of_no_length():
    solver, y0 = dps.Strang(), (jnp.array([0.6, 0.0, -0.8]), jnp.array([0.4, 1.0, 0.3]))

    def momentum(p):
        carry = solver.init(SPHERE, 0.0, 0.0, y0, None)
        (q, p), *_, result = solver.step(
            SPHERE, 0.0, 0.0, (y0[0], p), None, carry, False
        )
        return p, (q, result)

    p, (q, result) = momentum(y0[1])
    assert result == dfx.RESULTS.successful
    np.testing.assert_allclose(q, y0[0], atol=1e-15)
    np.testing.assert_allclose(p, y0[1], atol=1e-15)
    # The derivative is that of the projection to the tangent space.
    slope, _ = jax.jacrev(momentum, has_aux=True)(y0[1])
    np.testing.assert_allclose(slope, np.eye(3) - np.outer(q, q), atol=1e-15)


def test_gradients_in_the_loop_of_diffrax_are_finite():
    # One in twenty was not a number: that of the largest entry of a position.
    weight = lambda t, q, args: G * q[2]
    sphere = dps.ManifoldSystem(dps.Sphere(), weight, dps.ConstantDamping(0.2))
    held = dps.ConstrainedSystem(sphere, lambda t, q, args: q[1] - 0.3 * jnp.cos(t))
    q, p = jnp.array([0.6, 0.3, -0.7]), jnp.array([0.3, -0.8, 0.6])
    direction = jnp.array([0.3, -0.2, 0.5])

    def end(x):
        y0 = held.project(0.0, (q, p + x * direction))
        args = held, dps.Strang(), 0.0, 0.6, 0.05, y0
        return jnp.sum(diffeqsolve(*args, max_steps=50).ys[1])

    slopes = jax.jit(lambda xs: jax.lax.map(jax.grad(end), xs))
    assert jnp.all(jnp.isfinite(slopes(jnp.linspace(-0.5, 0.5, 401))))
