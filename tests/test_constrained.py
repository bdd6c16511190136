"""Constraints: orders and gradients with any friction, against SciPy on the equations
with multipliers, or in coordinates that need none."""

from functools import cache, partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps
from diffrax_presym._system import _multipliers


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


def by_scipy(field, y0, t1):
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(field, (0, t1), y0, **options).y[:, -1]


def end(system, solver, y0, t1, steps, **options):
    """The final state, as one vector."""
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None} | options
    args = (system, solver, 0.0, t1, t1 / steps, y0)
    ys = jax.jit(lambda: diffeqsolve(*args, **options).ys)()
    return np.concatenate([np.ravel(y[-1]) for y in ys])


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
    for steps in (16, 32, 64):
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


STEPS = [10_000, pytest.param(1_000_000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("steps", STEPS)
def test_constraints_hold_to_rounding(steps):
    free = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: G * jnp.sum(q[:, 1])
    )
    system = dps.ConstrainedSystem(free, two_rods)
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


# Systems in coordinates that need no constraint.


def test_spherical_pendulum_beside_its_angles():
    gamma = 0.3
    free = dps.MechanicalSystem(
        *(dps.QuadraticKinetic(2.0), lambda t, q, args: 2 * G * q[2]),
        dps.ConstantDamping(gamma),
    )
    system = dps.ConstrainedSystem(free, lambda t, q, args: q @ q - 1)

    def field(t, y):  # from the lowest point, and around
        theta, _, dtheta, dphi = y
        s, c = np.sin(theta), np.cos(theta)
        return np.array(
            [
                *(dtheta, dphi, s * c * dphi**2 - G * s - gamma * dtheta),
                -2 * c / s * dtheta * dphi - gamma * dphi,
            ]
        )

    def cartesian(y):
        (s, t), (c, d), (dtheta, dphi) = np.sin(y[:2]), np.cos(y[:2]), y[2:]
        q = np.array([s * d, s * t, -c])
        v = dtheta * np.array([c * d, c * t, s]) + dphi * np.array([-s * t, s * d, 0])
        return np.concatenate([q, 2 * v])

    first = np.array([1.2, 0.3, 0.4, 1.5])
    y0 = tuple(map(jnp.asarray, np.split(cartesian(first), 2)))
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, 3.0, 150)
    np.testing.assert_allclose(y, cartesian(by_scipy(field, first, 3.0)), atol=1e-11)


def test_bead_on_a_turning_wire():
    omega = 1.3
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0.0 * q[0])
    wire = lambda t, q, args: jnp.cos(omega * t) * q[1] - jnp.sin(omega * t) * q[0]
    system = dps.ConstrainedSystem(free, wire)
    y0 = jnp.array([0.5, 0.0]), jnp.array([0.0, 0.5 * omega])
    t = 2.0
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, t, 40)
    r, dr = 0.5 * np.cosh(omega * t), 0.5 * omega * np.sinh(omega * t)
    along = np.array([np.cos(omega * t), np.sin(omega * t)])
    across = omega * np.array([-along[1], along[0]])
    wanted = np.concatenate([r * along, dr * along + r * across])
    np.testing.assert_allclose(y, wanted, atol=1e-10)
    assert system.violation(t, *map(jnp.asarray, np.split(y, 2))) < 5e-15


def two_rods(t, q, args):
    return jnp.stack([q[0] @ q[0], (q[1] - q[0]) @ (q[1] - q[0])]) - 1


def bobs(angles):
    rods = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    return jnp.asarray(np.cumsum(rods, axis=0))


def test_double_pendulum_beside_its_angles():
    free = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: G * jnp.sum(q[:, 1])
    )
    system = dps.ConstrainedSystem(free, two_rods)

    def field(t, y):
        a, b, da, db = y
        s, c = np.sin(a - b), np.cos(a - b)
        force = [-s * db**2 - 2 * G * np.sin(a), s * da**2 - G * np.sin(b)]
        return np.array([da, db, *np.linalg.solve([[2, c], [c, 1]], force)])

    first = np.array([2.0, 2.5])
    y0 = bobs(first), jnp.zeros((2, 2))
    y = end(system, dps.SofroniouSpaletta(6, dps.Strang()), y0, 1.5, 200)
    angles = by_scipy(field, np.array([*first, 0, 0]), 1.5)[:2]
    np.testing.assert_allclose(y[:4], np.ravel(bobs(angles)), atol=1e-10)


def links(t, q, args):
    each = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0)
    return jnp.sum(each**2, axis=1) - 1


@pytest.mark.variants(1)
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
        kinetic = dps.QuadraticKinetic(None if mass is ONE else scale * mass)
        free = dps.MechanicalSystem(kinetic, lambda t, q, args: args * q[2], law)
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


def test_redundant_constraints():
    y0 = jnp.array([0.6, 0.0, -0.8]), jnp.ones(3)
    both = lambda t, q, args: jnp.stack([q @ q - 1, 3 * (q @ q) - 3])
    system = dps.ConstrainedSystem(sphere().system, both)
    with pytest.raises(Exception, match="The constraints are redundant"):
        system.project(0.0, y0)


def test_a_step_that_is_too_long():
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0])
    with pytest.raises(Exception, match=r"(?s)Newton's method.*Take shorter steps"):
        diffeqsolve(sphere(), dps.Strang(), 0.0, 1.0, 1.0, y0)
    far = jnp.zeros(3), jnp.zeros(3)
    with pytest.raises(Exception, match=r"redundant|did not find positions"):
        sphere().project(0.0, far)


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


@pytest.mark.parametrize(
    "solver",
    [
        *(dps.PresymplecticLeapfrog(), dps.PresymplecticEuler(), dps.TunedRKN6()),
        *(dps.PresymplecticGauss(2), dps.PresymplecticTao(), dps.TunedLinear8()),
        *(dps.SymmetricMultistep(8), dps.SuzukiYoshida(4)),
    ],
    ids=lambda x: type(x).__name__,
)
def test_schemes_that_leave_the_constraint_refuse(solver):
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3)
    with pytest.raises(ValueError, match=r"would leave the manifold.*Strang"):
        diffeqsolve(sphere(), solver, 0.0, 1.0, 0.1, y0)


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
