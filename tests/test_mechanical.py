"""Friction of every kind: by degree of freedom, matrix, place and speed."""

import functools
import math
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from helpers import assert_close, flat, harmonic, solve, step

import diffrax_presym as dps
from diffrax_presym._friction._exponential import exponential_products, exponentials
from diffrax_presym.diagnostics import (
    energy,
    energy_error,
    energy_lost,
    power_lost,
    structure_defect,
    volume_defect,
)


MASS = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 1.5]])
# Neither symmetric nor normal.
C = jnp.array([[0.3, 0.5, -0.2], [-0.3, 0.2, 0.1], [0.1, -0.4, 0.25]])
STIFFNESS = jnp.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
Y0 = (jnp.array([0.8, -0.5, 0.3]), jnp.array([0.2, 0.6, -0.4]))
DENSE = dps.QuadraticKinetic(MASS)


def saved(sol) -> Any:
    """Times and states of a solution."""
    assert sol.ts is not None and sol.ys is not None
    return sol.ts, sol.ys


def driven(t, q, args):
    coupling = q[0] * q[1] * q[2] / 2 + q[0] ** 2 * q[1] / 2 * jnp.cos(t)
    return jnp.sum(jnp.cosh(q)) + coupling


def layer(t, q, args):
    return 0.5 * jnp.exp(-(q**2))


LINEAR = {
    "by degree of freedom": dps.ConstantDamping(jnp.array([0.1, 0.5, -0.2])),
    "and time": dps.LogDamping(jnp.array([3.0, 1.0, 0.5]), shift=1.0),
    "two laws": [dps.ConstantDamping(0.1), lambda t: jnp.sin(t) / 5],
    "viscous number": dps.ViscousDamping(0.3),
    "matrix": dps.ViscousDamping(C),
    "matrix and time": dps.ViscousDamping(C, dps.LogDamping(1.0, shift=1.0)),
    "rayleigh": dps.RayleighDamping(0.1, 0.1, STIFFNESS),
    "operator": dps.ViscousDamping(lx.MatrixLinearOperator(C) * 2.0),
    "products": dps.ViscousDamping(
        lx.FunctionLinearOperator(lambda v: C @ v, jax.eval_shape(lambda: Y0[1]))
    ),
    "sum": [
        dps.ViscousDamping(C),
        dps.RayleighDamping(0.1, 0.1, STIFFNESS),
        dps.ConstantDamping(0.1),
    ],
}
LOCAL = {
    "place": dps.PositionDamping(layer),
    "place, matrix": dps.ViscousDamping(lambda t, q, args: C * (1 + q[0] ** 2)),
    "place and matrix": [dps.ViscousDamping(C), dps.PositionDamping(layer)],
}
DRAG = {
    "drag": dps.Drag(0.3),
    "drag 1.5": dps.Drag(0.3, 1.5),
    "drag and matrix": [dps.Drag(0.3), dps.ViscousDamping(C)],
    "two drags": [dps.Drag(0.3, 1.0), dps.Drag(0.2, 3.0)],
    "drag by place": dps.Drag(lambda t, q, args: jnp.exp(-(q[:1] ** 2))),
    "all by place": [
        dps.Drag(lambda t, q, args: 0.3 * jnp.exp(-(q[:1] ** 2))),
        dps.PositionDamping(layer),
        dps.ViscousDamping(C),
    ],
}
ALL = LINEAR | LOCAL | DRAG


@functools.cache
def system(name):
    kinetic = dps.QuadraticKinetic(2.0) if name in DRAG else DENSE
    return dps.MechanicalSystem(kinetic, driven, ALL[name])


def reference_system(name):
    """The same equations by hand."""
    mass = 2 * np.eye(3) if name in DRAG else np.array(MASS)
    c, gradient = np.array(C), jax.jit(jax.grad(driven, argnums=1))
    drag = lambda c, k: lambda t, q, v: c(q) * np.linalg.norm(v) ** (k - 1) * v
    by_place = lambda q: np.exp(-(q**2))
    constant = lambda matrix: lambda t, q, v: matrix @ v
    rate = lambda rate: lambda t, q, v: rate(t, q) * (mass @ v)
    friction = {
        "by degree of freedom": [rate(lambda t, q: np.array([0.1, 0.5, -0.2]))],
        "and time": [rate(lambda t, q: np.array([3.0, 1.0, 0.5]) / (t + 1))],
        "two laws": [rate(lambda t, q: 0.1 + np.cos(t) / 5)],
        "viscous number": [constant(0.3 * np.eye(3))],
        "matrix": [constant(c)],
        "matrix and time": [lambda t, q, v: c @ v / (t + 1)],
        "rayleigh": [constant(0.1 * mass + 0.1 * np.array(STIFFNESS))],
        "operator": [constant(2 * c)],
        "products": [constant(c)],
        "sum": [constant(c + 0.2 * mass + 0.1 * np.array(STIFFNESS))],
        "place": [rate(lambda t, q: 0.5 * by_place(q))],
        "place, matrix": [lambda t, q, v: (1 + q[0] ** 2) * c @ v],
        "place and matrix": [constant(c), rate(lambda t, q: 0.5 * by_place(q))],
        "drag": [drag(lambda q: 0.3, 2)],
        "drag 1.5": [drag(lambda q: 0.3, 1.5)],
        "drag and matrix": [drag(lambda q: 0.3, 2), constant(c)],
        "two drags": [drag(lambda q: 0.3, 1), drag(lambda q: 0.2, 3)],
        "drag by place": [drag(lambda q: by_place(q[0]), 2)],
        "all by place": [
            drag(lambda q: 0.3 * by_place(q[0]), 2),
            rate(lambda t, q: 0.5 * by_place(q)),
            constant(c),
        ],
    }[name]

    def rhs(t, y):
        q, v = y[:3], np.linalg.solve(mass, y[3:])
        force = -np.asarray(gradient(t, q, None))
        return np.concatenate([v, force - sum(f(t, q, v) for f in friction)])

    return rhs


@functools.cache
def truth(name):
    times, start = (0, 2), np.concatenate(Y0)
    rhs = reference_system(name)
    sol = scipy.integrate.solve_ivp(rhs, times, start, "DOP853", rtol=3e-14, atol=1e-15)
    return sol.y[:, -1]


def schemes(name):
    nystrom = dps.PresymplecticLeapfrog(), dps.BlanesMoanRKN4(), dps.TunedRKN6()
    general = dps.Strang(), dps.BlanesMoan4(), dps.BlanesMoan6()
    return nystrom if name in LINEAR else general


# The most general of each kind with the scheme that has the most to lose.
HARD = "matrix", "and time", "place and matrix", "drag", "all by place"
ORDERS = [
    pytest.param(
        *(name, solver),
        marks=[] if name in HARD and solver.order(None) == 6 else pytest.mark.slow,
        id=f"{name}, {type(solver).__name__}",
    )
    for name in ALL
    for solver in schemes(name)
]


@pytest.mark.parametrize("name, solver", ORDERS)
def test_order(name, solver):
    order = solver.order(None)
    steps = np.array([10, 14, 20] if order == 6 else [32, 48, 64])

    def error(n):
        sol = solve(system(name), solver, 0.0, 2.0, 2 / n, Y0)
        return np.max(np.abs(flat(sol.ys) - truth(name)))

    errors = np.array([error(n) for n in steps])
    assert errors[-1] < (2e-3 if order == 2 else 1e-6)
    measured = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(measured - order) < 0.25


@pytest.mark.parametrize("name", [*LOCAL, *DRAG])
def test_schemes_that_would_lose_their_order_refuse(name):
    for solver in (dps.TunedRKN6(), dps.BlanesMoanRKN4(), dps.BlanesCasasRKN8()):
        with pytest.raises(ValueError, match=r"BlanesMoan4.*BlanesMoan6"):
            step(system(name), solver, 0.0, 0.1, Y0)
    with pytest.raises(ValueError, match="BlanesMoan4"):
        step(system(name), dps.PresymplecticLeapfrog(), 0.0, 0.1, Y0)


def test_long_steps_refuse_friction_other_than_one_rate():
    with pytest.raises(ValueError, match="TunedRKN6"):
        step(system("matrix"), dps.TunedLinear8(), 0.0, 0.1, Y0)
    one = dps.MechanicalSystem(DENSE, driven, dps.ConstantDamping(0.2))
    same = dps.ConformalHamiltonian(DENSE, driven, dps.ConstantDamping(0.2))
    for solver in (dps.TunedLinear8(), dps.TunedRKN6()):
        found, wanted = (step(x, solver, 0.0, 0.1, Y0)[0] for x in (one, same))
        assert_close(found, wanted, 1e-15)


# Structure.


@pytest.mark.parametrize("name", LINEAR)
def test_phase_volume_contracts_by_the_trace(name):
    solvers = dps.PresymplecticLeapfrog(), dps.TunedRKN6()
    for solver in solvers if name in HARD else solvers[:1]:
        term = system(name)
        assert abs(volume_defect(term, solver, 0.3, 0.5, Y0)) < 1e-13


def test_the_trace_by_hand():
    term = system("matrix")
    end = lambda q, p: step(system("matrix"), dps.TunedRKN6(), 0.3, 0.5, (q, p))[0]
    jacobian = jax.jacfwd(end, argnums=(0, 1))(*Y0)
    matrix = np.block([[np.array(x) for x in row] for row in jacobian])
    trace = np.trace(np.array(C) @ np.linalg.inv(np.array(MASS)))
    np.testing.assert_allclose(np.linalg.det(matrix), np.exp(-0.2 * trace), 1e-13)
    with pytest.raises(ValueError, match="volume_defect"):
        structure_defect(term, dps.TunedRKN6(), 0.0, 0.1, Y0)
    with pytest.raises(ValueError, match="depends on the trajectory"):
        place = system("place")
        volume_defect(place, dps.BlanesMoan4(), 0.0, 0.1, Y0)


def test_a_kick_with_friction_by_place_contracts_by_the_friction_there():
    q, p = Y0
    local: Any = system("place, matrix")
    values, force = local.local_values(0.0, q, None), jnp.ones(3)
    change = lambda p: p + local.kick(0.0, 0.3, p, force, values, 6)
    gamma = (1 + q[0] ** 2) * C @ jnp.linalg.inv(MASS)
    found = np.linalg.slogdet(jax.jacfwd(change)(p))[1]
    np.testing.assert_allclose(found, -0.3 * jnp.trace(gamma), 1e-13)
    # p' = force - Gamma p.
    left = scipy.linalg.expm(-0.3 * gamma)
    gained = np.linalg.solve(gamma, (np.eye(3) - left) @ force)
    np.testing.assert_allclose(change(p), left @ p + gained, 1e-12)


FIELD = jnp.array([[0.0, -0.7, 0.2], [0.7, 0.0, 1.1], [-0.2, -1.1, 0.0]])


@pytest.mark.parametrize("steps", [2000, pytest.param(10**6, marks=pytest.mark.slow)])
def test_energy_in_a_magnetic_field_does_not_drift(steps):
    field = dps.MechanicalSystem(
        dps.QuadraticKinetic(2.0), harmonic, dps.ViscousDamping(FIELD)
    )
    term, h = field, 0.3

    @jax.jit
    def end(y):
        sol = dfx.diffeqsolve(
            *(term, dps.TunedRKN6(), 0.0, steps * h, h, y),
            max_steps=None,
            saveat=dfx.SaveAt(ts=jnp.linspace(0, steps * h, 6)[1:]),
            adjoint=dps.FixedStepAdjoint(),
        )
        return energy(term, *saved(sol))

    start = field.energy(0.0, *Y0)
    # The scheme makes an error that oscillates; rounding would accumulate.
    errors = np.asarray(end(Y0) / start - 1)
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
    trap = dps.ConformalHamiltonian(energy=canonical, damping=dps.ConstantDamping(0.3))
    right = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: 0.0 * jnp.sum(q),
        [dps.ViscousDamping(FIELD), dps.ViscousDamping(0.3)],
    )
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
            products = exponential_products(lambda x: matrix @ x, time, Y0[0])
            assert_close(products, (change @ Y0[0], integral @ Y0[0]), 1e-15)


TREES = {
    "constant": (dps.ConstantDamping, (0.7,)),
    "logarithmic": (dps.LogDamping, (3.0, 0.5)),
}


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("h", [0.7, -0.2])
def test_the_flow_of_drag(exponent, h):
    drag, p, mass = dps.Drag(0.4, exponent), jnp.array([[1.0, -2.0], [0.3, 0.1]]), 1.5

    def rhs(t, x):
        v = x[4:].reshape(2, 2) / mass
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        return np.concatenate([v.ravel(), (-0.4 * speed ** (exponent - 1) * v).ravel()])

    start = np.concatenate([np.zeros(4), np.ravel(p)])
    end = scipy.integrate.solve_ivp(
        rhs, (0, h), start, "DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    moved, change = drag.flow(jnp.asarray(h), p, jnp.asarray(mass))
    np.testing.assert_allclose(np.ravel(moved), end[:4], 1e-9)
    np.testing.assert_allclose(np.ravel(p + change), end[4:], 1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1.2, 2.0, 2.5])
@pytest.mark.parametrize("coefficient, speed", [(0.4, 1.0), (0.0, 1.0), (0.4, 1e-9)])
def test_gradients_of_the_flow_of_drag(exponent, coefficient, speed):
    @jax.jit
    def flow(x):
        c, k, p = x
        drag = eqx.tree_at(lambda drag: drag.exponent, dps.Drag(c), k)
        return flat(drag.flow(jnp.asarray(0.3), speed * p, jnp.asarray(1.5))) / speed

    x = jnp.asarray(coefficient), jnp.asarray(exponent), jnp.array([[0.6, -0.8]])
    jacobians, d = jax.jacfwd(flow)(x), 1e-6
    for i in range(3):
        move = lambda d, i=i: tuple(y + d * (i == j) for j, y in enumerate(x))
        wanted = (flow(move(d)) - flow(move(-d))) / (2 * d)
        found = jnp.sum(jacobians[i].reshape(len(wanted), -1), axis=1)
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1.3, 2.0])
def test_bodies_at_rest_have_gradients(exponent):
    drag, h, mass = dps.Drag(0.4, exponent), jnp.asarray(0.3), jnp.asarray(1.5)
    rest, rate = jnp.zeros(2), 0.4 / 1.5
    jacobian = jax.jacrev(lambda p: drag.flow(h, p, mass)[0])(rest)
    time = (1 - np.exp(-rate * 0.3)) / rate if exponent == 1 else 0.3
    np.testing.assert_allclose(jacobian, time / 1.5 * np.eye(2), 1e-12)
    force = jax.jacrev(lambda p: drag.force(0.0, rest, p, p / mass, None))(rest)
    wanted = -rate if exponent == 1 else 0.0
    np.testing.assert_allclose(force, wanted * np.eye(2), atol=1e-14)


def test_drag_backwards_beyond_its_start_fails():
    # Backwards in time the speed becomes infinite.
    fast = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic, dps.Drag(5.0))
    y0 = jnp.zeros(2), jnp.array([30.0, 0.0])
    sol = solve(fast, dps.Strang(), 0.0, -0.5, -0.1, y0, throw=False)
    assert sol.result != dfx.RESULTS.successful


# Gradients.

GRADIENTS = {
    "matrix": lambda c: dps.ViscousDamping(c),
    "equal eigenvalues": lambda c: dps.ViscousDamping(0.3 * jnp.eye(3) + 0 * C + c - C),
    "by degree of freedom": lambda c: dps.ConstantDamping(c[0]),
    "matrix and time": lambda c: dps.ViscousDamping(c, dps.LogDamping(1.0, shift=1.0)),
    "rayleigh": lambda c: dps.RayleighDamping(c[0, 0], c[0, 1], STIFFNESS),
    "place": lambda c: dps.PositionDamping(lambda t, q, args: c[0] * q**2),
    "drag": lambda c: dps.Drag(c[0, 0], 1.7 + c[0, 1]),
}
FEW = ("by degree of freedom",)


def make_loss(name):
    solver = dps.BlanesMoan6() if name in ("place", "drag") else dps.TunedRKN6()
    mass = 2.0 if name == "drag" else MASS

    def loss(c, adjoint):
        friction = GRADIENTS[name](c)
        law = dps.MechanicalSystem(dps.QuadraticKinetic(mass), driven, friction)
        # The step does not divide the span.
        sol = dfx.diffeqsolve(
            *(law, solver, 0.0, 0.95, 0.1, Y0), adjoint=adjoint
        )
        return jnp.sum(jnp.sin(flat(sol.ys)))

    return loss


@pytest.mark.parametrize(
    "name",
    [x if x in FEW else pytest.param(x, marks=pytest.mark.slow) for x in GRADIENTS],
)
def test_gradients_with_respect_to_coefficients(name):
    loss = make_loss(name)
    reverse = jax.jit(jax.grad(lambda c: loss(c, dps.FixedStepAdjoint())))(C)
    stored = jax.jit(jax.grad(lambda c: loss(c, dfx.RecursiveCheckpointAdjoint())))(C)
    np.testing.assert_allclose(reverse, stored, rtol=0, atol=1e-12)
    direction = jnp.sin(1.0 + jnp.arange(9.0)).reshape(3, 3)
    value = jax.jit(lambda c: loss(c, dfx.ForwardMode()))
    _, forward = jax.jvp(value, (C,), (direction,))
    along = np.sum(stored * direction)
    np.testing.assert_allclose(forward, along, rtol=1e-11, atol=1e-13)
    d = 1e-5
    central = (value(C + d * direction) - value(C - d * direction)) / (2 * d)
    np.testing.assert_allclose(central, along, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_gradients_with_respect_to_the_system():
    # The leaves of a system are its parameters, each once.
    model = dps.MechanicalSystem(DENSE, driven, dps.ViscousDamping(C))
    assert len(jax.tree.leaves(eqx.filter(model, eqx.is_array))) == 2

    def loss(model):
        sol = dfx.diffeqsolve(
            *(
                model,
                dps.PresymplecticLeapfrog(),
                0.0,
                0.5,
                0.1,
                Y0,
            )
        )
        return jnp.sum(jnp.sin(flat(sol.ys)))

    gradient = eqx.filter_jit(eqx.filter_grad(loss))(model)
    found = jnp.sum(gradient.laws[0].coefficients)
    where = lambda x: x.laws[0].coefficients
    move = lambda d: loss(eqx.tree_at(where, model, C + d))
    np.testing.assert_allclose(found, (move(1e-5) - move(-1e-5)) / 2e-5, 1e-6)


# With all else.


def test_saved_times_and_steps_of_other_lengths():
    ts = jnp.array([0.03, 0.31, 0.5, 0.95])
    term, solver = system("matrix"), dps.TunedRKN6()
    fine = scipy.integrate.solve_ivp(
        *(reference_system("matrix"), (0, 0.95), np.concatenate(Y0), "DOP853"),
        t_eval=np.array(ts),
        rtol=3e-14,
        atol=1e-15,
    ).y.T
    ways = [
        dict(dt0=0.07, adjoint=dps.FixedStepAdjoint()),
        dict(dt0=0.07),
        dict(
            dt0=None,
            stepsize_controller=dfx.StepTo(
                jnp.array([0.0, 0.03, 0.2, 0.31, 0.5, 0.6, 0.75, 0.95])
            ),
        ),
    ]
    for way in ways:
        sol = dfx.diffeqsolve(
            *(term, solver, 0.0, 0.95), y0=Y0, saveat=dfx.SaveAt(ts=ts), **way
        )
        found = np.concatenate(saved(sol)[1], axis=1)
        np.testing.assert_allclose(found, fine, rtol=0, atol=2e-9)


@pytest.mark.slow
def test_a_solve_can_be_continued():
    solver, term = dps.TunedRKN6(), system("matrix")
    whole = solve(system("matrix"), solver, 0.0, 1.0, 0.1, Y0)
    for adjoint in (dfx.RecursiveCheckpointAdjoint(), dps.FixedStepAdjoint()):
        saveat = dfx.SaveAt(t1=True, solver_state=True)
        half = dfx.diffeqsolve(
            *(term, solver, 0.0, 0.5, 0.1, Y0), saveat=saveat, adjoint=adjoint
        )
        y = jax.tree.map(lambda x: x[-1], half.ys)
        rest = dfx.diffeqsolve(
            *(term, solver, 0.5, 1.0, 0.1, y),
            solver_state=half.solver_state,
            made_jump=False,
            adjoint=adjoint,
        )
        assert_close(rest.ys, whole.ys, 1e-14)


@pytest.mark.parametrize("name", ["matrix", "drag"])
def test_backwards_in_time(name):
    solver = schemes(name)[2]
    there = step(system(name), solver, 0.0, 0.2, Y0)[0]
    back = step(system(name), solver, 0.2, 0.0, there)[0]
    assert_close(back, Y0, 1e-13)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("matrix", marks=pytest.mark.slow),
        pytest.param("place and matrix", marks=pytest.mark.slow),
        "drag",
    ],
)
def test_wrappers(name):
    solver = schemes(name)[1]
    plain = solve(system(name), solver, 0.0, 1.0, 0.1, Y0).ys
    for wrapper in (dps.Compensated(solver), dps.Substeps(solver, 1)):
        assert_close(solve(system(name), wrapper, 0.0, 1.0, 0.1, Y0).ys, plain, 1e-13)
    halves = solve(system(name), dps.Substeps(solver, 2), 0.0, 1.0, 0.2, Y0).ys
    assert_close(halves, plain, 1e-13)


@pytest.mark.slow
def test_step_densities():
    term = system("matrix")
    density = lambda t, y, args: 1 / (1 + y[0][0] ** 2)
    controller = dps.StepDensityController(term, 0.05, density)
    sol = dfx.diffeqsolve(
        *(term, dps.TunedRKN6(), 0.0, 2.0, None, Y0), stepsize_controller=controller
    )
    np.testing.assert_allclose(flat(sol.ys), truth("matrix"), atol=1e-8)


def test_vmap_over_coefficients():
    def end(c):
        model = dps.MechanicalSystem(DENSE, driven, dps.ViscousDamping(c))
        sol = dfx.diffeqsolve(
            *(model, dps.BlanesMoanRKN4(), 0.0, 0.5, 0.1, Y0)
        )
        return flat(sol.ys)

    many = jnp.stack([C, 2 * C, C.T])
    batch = jax.jit(jax.vmap(end))(many)
    one = jax.jit(end)
    np.testing.assert_allclose(batch, jnp.stack([one(c) for c in many]), atol=1e-14)


@pytest.mark.slow
def test_float32_stays_float32():
    cast = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    for name in ("matrix", "all by place"):
        solver = schemes(name)[2]
        y, *_ = step(system(name), solver, jnp.float32(0), jnp.float32(0.1), cast(Y0))
        assert {x.dtype for x in y} == {jnp.dtype("float32")}
        assert_close(y, step(system(name), solver, 0.0, 0.1, Y0)[0], 3e-6)


# Any other force.


def motor(t, q, v, args):
    return jnp.sin(t) - 0.2 * v - 0.1 * jnp.tanh(v) * q**2


def test_any_force():
    forced = dps.MechanicalSystem(DENSE, driven, dps.ConstantDamping(0.1), force=motor)
    mass = np.array(MASS)
    gradient = jax.jit(jax.grad(driven, argnums=1))

    def rhs(t, y):
        q, p = y[:3], y[3:]
        v = np.linalg.solve(mass, p)
        extra = np.sin(t) - 0.2 * v - 0.1 * np.tanh(v) * q**2
        return np.concatenate([v, -np.asarray(gradient(t, q, None)) - 0.1 * p + extra])

    exact = scipy.integrate.solve_ivp(
        rhs, (0, 1), np.concatenate(Y0), "DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    finder = optx.Newton(rtol=1e-12, atol=1e-12)
    solvers = [
        (dps.PresymplecticGauss(4), 1e-10),
        (dps.PresymplecticCoupled(4), 1e-5),
        (dps.PresymplecticGauss(1, finder), 5e-3),
    ]
    for solver, tolerance in solvers:
        found = flat(solve(forced, solver, 0.0, 1.0, 0.05, Y0).ys)
        np.testing.assert_allclose(found, exact, atol=tolerance)
    with pytest.raises(ValueError, match="PresymplecticGauss"):
        step(forced, dps.TunedRKN6(), 0.0, 0.1, Y0)


def test_copies_that_part_are_not_a_success():
    number = 3
    weights = number - jnp.maximum(*jnp.meshgrid(jnp.arange(3), jnp.arange(3)))

    def mass(t, q, args):
        angles = q[:, None] - q[None, :]
        return weights.astype(q.dtype) * jnp.cos(angles) + 0.1 * jnp.eye(number)

    def potential(t, q, args):
        return -9.81 * jnp.sum((number - jnp.arange(3.0)) * jnp.cos(q))

    chain = dps.LagrangianSystem(mass, potential, friction=STIFFNESS)
    y0 = jnp.array([1.0, 1.5, 2.0]), jnp.zeros(3)
    exact = flat(solve(chain, dps.PresymplecticGauss(6), 0.0, 2.0, 0.02, y0).ys)
    coupled = dps.PresymplecticCoupled(2)
    for solver, parts in [
        (coupled, True),
        (dps.Compensated(coupled), True),
    ]:
        sol = solve(chain, solver, 0.0, 2.0, 0.05, y0, throw=False)
        failed = sol.result != dfx.RESULTS.successful
        assert failed or np.max(np.abs(flat(sol.ys) - exact)) < 1
        assert failed or not parts


# Energy.


@pytest.mark.parametrize("name", ["sum", "and time", "all by place"])
def test_energy_balance(name):
    term, solver = system(name), schemes(name)[2]
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = dfx.diffeqsolve(*(term, solver, 0.0, 2.0, 0.01, Y0), saveat=saveat)
    taken = np.isfinite(saved(sol)[0])
    ts, ys = jax.tree.map(lambda x: x[taken], saved(sol))
    assert np.max(np.abs(energy_error(term, ts, ys))) < 1e-7


def test_power_lost():
    free = dps.MechanicalSystem(DENSE, harmonic, dps.ViscousDamping(C))
    term = free
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 2, 201))
    sol = dfx.diffeqsolve(*(term, dps.TunedRKN6(), 0.0, 2.0, 0.1, Y0), saveat=saveat)
    ts, ys = saved(sol)
    v = jnp.linalg.solve(MASS, ys[1].T).T
    wanted = jnp.einsum("ni,ij,nj->n", v, C, v)
    np.testing.assert_allclose(power_lost(term, ts, ys), wanted, atol=1e-14)
    lost = energy_lost(term, ts, ys)
    energies = energy(term, ts, ys)
    np.testing.assert_allclose(energies + lost, energies[0], atol=1e-8)
    joints = dps.LagrangianSystem(lambda t, q, a: MASS, harmonic, friction=C)
    same = power_lost(joints, ts, ys)
    np.testing.assert_allclose(same, wanted, atol=1e-14)


# Errors.

KINETIC = dps.QuadraticKinetic()
NUMBER: Any = 0.3
UNKNOWN = dps.RelativisticKinetic()
MISTAKES = {
    "a number": (
        lambda: dps.MechanicalSystem(KINETIC, harmonic, 0.3),
        r"ConstantDamping\(rate\)",
    ),
    "not finite": (lambda: dps.ConstantDamping(jnp.nan), "must be finite"),
    "not finite matrix": (lambda: dps.ViscousDamping(C * jnp.inf), "must be finite"),
    "not finite drag": (lambda: dps.Drag(jnp.nan), "must be finite"),
    "exponent": (lambda: dps.Drag(0.1, 0.5), "at least 1"),
    "no coefficients": (lambda: dps.ViscousDamping(None), r"ViscousDamping\(1.0\)"),
    "function and law": (
        lambda: dps.ViscousDamping(layer, dps.ConstantDamping(1.0)),
        "takes no `law`",
    ),
    "rate by place": (lambda: dps.PositionDamping(NUMBER), r"ConstantDamping\(rate\)"),
    "unknown mass": (
        lambda: dps.MechanicalSystem(UNKNOWN, harmonic, dps.ViscousDamping(C)),
        r"QuadraticKinetic\(mass\)",
    ),
    "no stiffness": (
        lambda: dps.MechanicalSystem(KINETIC, harmonic, dps.RayleighDamping(1.0, 1.0)),
        "RayleighDamping.alpha, beta, stiffness",
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
}


@pytest.mark.parametrize("friction, message", SHAPES.values(), ids=SHAPES)
def test_shapes_that_do_not_fit(friction, message):
    wrong = dps.MechanicalSystem(KINETIC, harmonic, friction)
    with pytest.raises(ValueError, match=message):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, Y0)


def test_drag_needs_bodies():
    wrong = dps.MechanicalSystem(KINETIC, harmonic, dps.Drag(0.1))
    with pytest.raises(ValueError, match=r"`\(n, 1\)`"):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, (jnp.array(1.0), jnp.array(0.0)))
    unequal = dps.QuadraticKinetic(jnp.array([1.0, 2.0, 3.0]))
    wrong = dps.MechanicalSystem(unequal, harmonic, dps.Drag(0.1))
    with pytest.raises(ValueError, match="one for each body"):
        step(wrong, dps.BlanesMoan4(), 0.0, 0.1, Y0)


@pytest.mark.parametrize("law", ["matrix", "drag"])
def test_events(law):
    """A body that falls to the ground, whose height is known in closed form."""
    c = 0.4
    friction = dps.ViscousDamping(c * jnp.eye(2)) if law == "matrix" else dps.Drag(c)
    ball = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: q[1], friction
    )
    solver = dps.TunedRKN6() if law == "matrix" else dps.BlanesMoan6()
    if law == "matrix":
        height = lambda t: 2.0 - t / c - math.expm1(-c * t) / c**2
    else:
        height = lambda t: 2.0 - math.log(math.cosh(t * c**0.5)) / c
    landing = scipy.optimize.brentq(height, 0, 10, xtol=1e-15)

    @jax.jit
    def fly(start):
        return dfx.diffeqsolve(
            *(ball, solver, 0.0, 10.0, 0.1),
            (jnp.stack([jnp.zeros(()), start]), jnp.zeros(2)),
            event=dfx.Event(
                lambda t, y, args, **kwargs: y[0][1], optx.Newton(1e-13, 1e-13)
            ),
        )

    sol = fly(jnp.asarray(2.0))
    assert sol.result == dfx.RESULTS.event_occurred
    assert abs(sol.ts[0] - landing) < 1e-9
