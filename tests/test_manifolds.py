"""Rigid bodies, spheres and orthonormal matrices: beside SciPy on the equations in
rotation matrices or with multipliers, and beside closed forms."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import on_manifolds
import pytest
import scipy.special
from on_manifolds import CASES, end, exact, flat, INERTIA, L, matrix, Q, rng, start

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
SCHEMES = {
    "Strang": (dps.Strang(), 2),
    "Suzuki4": (dps.Suzuki4(dps.Strang()), 4),
    "Blanes-Moan 4": (dps.BlanesMoan4(), 4),
    "Blanes-Moan 6": (dps.BlanesMoan6(), 6),
    "Compensated": (dps.Compensated(dps.Strang()), 2),
    "RKN 4": (dps.BlanesMoanRKN4(), 4),
    "Tuned RKN": (dps.TunedRKN6(), 6),
}
DRIFTS = on_manifolds.DRIFTS
PAIRS = [(c, s) for c in CASES for s in SCHEMES if c in DRIFTS or "RKN" not in s]


@pytest.mark.variants(6)
@pytest.mark.parametrize("case, scheme", PAIRS)
def test_order(case, scheme):
    system, (solver, claimed) = CASES[case][0], SCHEMES[scheme]
    y0, errors, first = start(case), [], 4 if scheme == "Tuned RKN" else 8
    for steps in (first, 2 * first, 4 * first):
        y = end(system, solver, y0, 2.0, steps)
        errors.append(np.max(np.abs(flat(case, y) - exact(case))))
        assert system.violation(2.0, *y) < 2e-15
    errors = [e for e in errors if e > 2e-12]
    order = np.log2(errors[0] / errors[-1]) / (len(errors) - 1)
    assert -0.4 < order - claimed < 0.6, errors


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_undone(case):
    system, solver, y0 = CASES[case][0], dps.BlanesMoan4(), start(case)
    step = jax.jit(lambda s, t, y: solver.step(system, s, t, y, None, None, False)[0])
    y2 = step(0.1, 0.0, step(0.0, 0.1, y0))
    for x, y in zip(jax.tree.leaves(y0), jax.tree.leaves(y2), strict=True):
        np.testing.assert_allclose(y, x, atol=4e-15)


STEPS = [10_000, pytest.param(1_000_000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("case", ["top, one rate", "sphere", "Stiefel"])
def test_states_stay_on_the_manifold(case, steps):
    system = CASES[case][0]
    system = dps.ManifoldSystem(system.manifold, system.potential)  # no friction
    worst = lambda t, y, args: system.violation(t, *y)
    t1 = steps * 0.01
    violation = diffeqsolve(
        *(system, dps.Strang(), 0.0, t1, 0.01, start(case)),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, t1, 101), fn=worst),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    ).ys
    assert np.max(violation) < 3e-15


# Closed forms.


# Rounding of each drift adds up, so that over long times there are few of them.
@pytest.mark.parametrize(
    "periods, solver, h",
    [(100, dps.BlanesMoan6(), 0.1), (100_000, dps.Strang(), 1.0)],
)
def test_free_body_beside_elliptic_functions(periods, solver, h):
    a, b, c = INERTIA
    system = dps.ManifoldSystem(dps.Attitude(INERTIA), lambda t, q, args: 0.0 * q[0])
    p0 = np.array([0.4, 0.0, 2.0])  # where the second entry is zero
    energy, square = np.sum(p0**2 / INERTIA), np.sum(p0**2)
    # About the third axis, Landau and Lifshitz, paragraph 37, for a < b < c.
    omega = np.sqrt((c - b) * (square - energy * a) / (a * b * c))
    m = (b - a) * (energy * c - square) / ((c - b) * (square - energy * a))
    t1 = periods * 4 * scipy.special.ellipk(m) / omega + 0.7
    sn, cn, dn, _ = scipy.special.ellipj(omega * 0.7, m)
    sizes = np.sqrt(
        [
            a * (energy * c - square) / (c - a),
            b * (energy * c - square) / (c - b),
            c * (square - energy * a) / (c - a),
        ]
    )
    wanted = sizes * [cn, sn, dn]
    steps = int(np.ceil(t1 / h))
    y0 = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.asarray(p0)
    q, p = end(system, solver, y0, t1, steps)
    np.testing.assert_allclose(p, wanted, rtol=0, atol=1e-13 * periods)
    # The angular momentum in space does not change.
    np.testing.assert_allclose(matrix(np.asarray(q)) @ p, p0, atol=1e-14 * (10 + steps))


def test_third_derivatives_at_rest_on_a_circle():
    system = dps.ManifoldSystem(dps.Sphere(), lambda t, q, args: 0.0 * q[0])

    def height(v):
        y0 = jnp.array([0.0, 1.0]), v * jnp.array([1.0, 0.0])
        sol = diffeqsolve(
            *(system, dps.Strang(), 0.0, 1.0, 0.25, y0), adjoint=dfx.ForwardMode()
        )
        return sol.ys[0][-1, 0]  # the sine of v

    third = height
    for _ in range(3):
        third = jax.jacfwd(third)
    for v in (0.0, 0.01, 0.3):
        assert third(v) == pytest.approx(-np.cos(v), abs=1e-10)


def test_smallest_eigenvectors():
    n, k = 20, 3
    frame = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = frame @ np.diag(np.linspace(1, 4, n)) @ frame.T
    values, vectors = np.linalg.eigh(A)
    objective = lambda t, q, args: jnp.sum(q * (A @ q)) / 2
    friction = dps.ConstantDamping(0.5)
    start = jnp.asarray(rng.standard_normal((n, k)))
    sphere = dps.ManifoldSystem(dps.Sphere(), objective, friction)
    y0 = sphere.project(0.0, (start[:, 0], jnp.zeros(n)))
    q, _ = end(sphere, dps.Strang(), y0, 200.0, 500)
    assert abs(objective(0.0, q, None) - values[0] / 2) < 1e-12
    assert abs(abs(q @ vectors[:, 0]) - 1) < 1e-10
    frames = dps.ManifoldSystem(dps.Stiefel(), objective, friction)
    y0 = frames.project(0.0, (start, jnp.zeros((n, k))))
    q, _ = end(frames, dps.Strang(), y0, 200.0, 500)
    assert abs(objective(0.0, q, None) - np.sum(values[:k]) / 2) < 1e-10


def test_torques_of_many_bodies_by_a_force_field():
    inertia = np.stack([INERTIA, INERTIA[::-1]])
    attitude = jnp.stack([jnp.asarray(Q), jnp.asarray(Q[::-1])])
    slope = lambda t, q, args: -0.5 * jnp.tile(jnp.asarray(L), (2, 1))
    many = dps.ManifoldSystem(dps.Attitude(inertia), dps.ForceField(slope))
    y0 = many.project(0.0, (attitude, jnp.stack([jnp.asarray(L), -jnp.asarray(L)])))
    q, p = end(many, dps.BlanesMoan4(), y0, 1.0, 10)
    for i in range(2):
        torque = dps.ForceField(lambda t, q, args: -0.5 * jnp.asarray(L))
        one = dps.ManifoldSystem(dps.Attitude(inertia[i]), torque)
        y = end(one, dps.BlanesMoan4(), jax.tree.map(lambda x, i=i: x[i], y0), 1.0, 10)
        np.testing.assert_allclose(y[0], q[i], atol=1e-14)
        np.testing.assert_allclose(y[1], p[i], atol=1e-14)


# Gradients and what is saved.


GRADIENTS = {
    "reversal": dps.FixedStepAdjoint("reversal"),
    "checkpoints": dps.FixedStepAdjoint("checkpoints"),
    "Diffrax": dfx.RecursiveCheckpointAdjoint(),
}


@pytest.mark.variants(1)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_gradient(case, gradient):
    system, y0 = CASES[case][0], start(case)
    solver, ts = dps.Suzuki4(dps.Strang()), jnp.array([0.13, 0.5, 1.0])

    @jax.jit
    def loss(x):
        moved = jax.tree.map(lambda y: y * jnp.where(y > 0, x[0], 1.0), y0)
        scale = lambda tree: jax.tree.map(lambda y: x[1] * y, tree)
        numbers, rest = eqx.partition(system.friction, eqx.is_inexact_array_like)
        changed = eqx.combine(scale(numbers), rest)
        force = system.external and (lambda *at: scale(system.external(*at)))
        fields = system.manifold, system.potential, changed
        new = dps.ManifoldSystem(*fields, force=force)
        ys = diffeqsolve(
            *(new, solver, 0.0, 1.0, 0.1, new.project(0.0, moved)),
            saveat=dfx.SaveAt(ts=ts),
            adjoint=GRADIENTS[gradient],
            max_steps=16,
        ).ys
        return sum(jnp.sum(y**3 + y) for y in jax.tree.leaves(ys))

    x, h = jnp.array([1.1, 0.9]), 1e-5
    wanted = [(loss(x + h * e) - loss(x - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.grad(loss)(x), wanted, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_saved_values_are_on_the_manifold(case):
    system, y0 = CASES[case][0], start(case)
    ts = jnp.linspace(0.0, 1.0, 12)
    solve = lambda **options: (
        diffeqsolve(
            *(system, dps.Suzuki4(dps.Strang()), 0.0, 1.0, 0.1, y0), **options
        ).ys
    )
    ys = solve(saveat=dfx.SaveAt(ts=ts), adjoint=dps.FixedStepAdjoint())
    projected = solve(saveat=dfx.SaveAt(ts=ts, fn=system.project))
    for saved in (ys, projected):
        assert np.max(jax.vmap(system.violation)(ts, *saved)) < 4e-15
    both = zip(jax.tree.leaves(ys), jax.tree.leaves(projected), strict=True)
    for x, y in both:
        np.testing.assert_allclose(y, x, atol=1e-4)


def test_single_precision():
    system = CASES["floating body"][0]
    cast = lambda x: jnp.asarray(x, jnp.float32)
    arrays = jax.tree.map(cast, start("floating body"))
    t0, t1 = jnp.float32(0.0), jnp.float32(2.0)
    y = diffeqsolve(
        *(system, dps.BlanesMoan4(), t0, t1, jnp.float32(0.1), arrays),
        adjoint=dps.FixedStepAdjoint(),
    ).ys
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(y))
    y = flat("floating body", jax.tree.map(lambda x: x[-1], y))
    np.testing.assert_allclose(y, exact("floating body"), atol=3e-5)


# Errors.


@pytest.mark.parametrize("case", CASES)
def test_an_initial_state_off_the_manifold(case):
    system = CASES[case][0]
    q, p = start(case)
    y0 = jax.tree.map(lambda x: 1.01 * x, q), p
    with pytest.raises(Exception, match=r"(?s)off the manifold.*system.project"):
        diffeqsolve(system, dps.Strang(), 0.0, 1.0, 0.1, y0)


@pytest.mark.parametrize("speed", [1e13, 1e-7])
def test_an_initial_momentum_is_judged_by_its_size(speed):
    system = dps.ManifoldSystem(dps.Sphere(), lambda t, q, args: 0.0 * q[0])
    q, right = jnp.array([0.6, 0.0, 0.8]), speed * jnp.array([0.8, 0.3, -0.6])
    for p in (right, right + 1e-6 * speed * q):
        sol = diffeqsolve(
            *(system, dps.Strang(), 0.0, 1 / speed, 0.1 / speed, (q, p)), throw=False
        )
        assert (sol.result == dfx.RESULTS.successful) == (p is right)


def test_a_batch_of_failed_states_is_off_the_manifold():
    """XLA on a CPU drops NaN from the maxima of a thousand rows."""
    ball = dps.ManifoldSystem(dps.Sphere(), lambda t, q, args: q[0])
    rod = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: q[0])
    held = dps.ConstrainedSystem(rod, lambda t, q, args: q @ q - 1)
    lost = jnp.full((2048, 3), jnp.nan)
    for system in ball, held:
        off = jax.jit(jax.vmap(partial(system.violation, 0.0)))(lost, lost)
        assert jnp.isnan(off).all()


def test_project_of_what_has_no_nearest_point():
    """Columns of zero become some that are orthonormal to the others."""
    frames = dps.ManifoldSystem(dps.Stiefel(), lambda t, q, args: q[0, 0])
    y0 = jnp.diag(jnp.array([2.0, 0.0, 0.0]))[:, :2], jnp.ones((3, 2))
    q, p = frames.project(0.0, y0)
    np.testing.assert_allclose(q.T @ q, np.eye(2), atol=1e-15)
    assert frames.violation(0.0, q, p) < 1e-15
    ball = dps.ManifoldSystem(dps.Sphere(), lambda t, q, args: q[0])
    assert jnp.isnan(ball.project(0.0, (jnp.zeros(3), jnp.ones(3)))[0]).all()


@pytest.mark.parametrize(
    "solver",
    [dps.PresymplecticLeapfrog(), dps.SymmetricMultistep(8), dps.PresymplecticGauss(2)],
    ids=lambda x: type(x).__name__,
)
def test_schemes_that_leave_the_manifold_refuse(solver):
    with pytest.raises(ValueError, match=r"would leave the manifold.*Strang"):
        diffeqsolve(CASES["top"][0], solver, 0.0, 1.0, 0.1, start("top"))


def test_arguments():
    flat = lambda t, q, args: 0.0 * jnp.sum(q)
    with pytest.raises(ValueError, match=r"needs a manifold such as `Sphere\(\)`"):
        dps.ManifoldSystem(dps.Sphere, flat)
    with pytest.raises(ValueError, match=r"`force` must be a function `f\(t, q, v"):
        dps.ManifoldSystem(dps.Sphere(), flat, force=lambda t, q: q)
    with pytest.raises(ValueError, match="three principal moments"):
        dps.Attitude(jnp.ones(2))
    with pytest.raises(ValueError, match="must be positive"):
        dps.Attitude(jnp.array([1.0, 0.0, 1.0]))
    body = dps.ManifoldSystem(dps.Attitude(INERTIA), flat)
    with pytest.raises(ValueError, match=r"The state must be a pair.*Write"):
        body.project(0.0, (jnp.ones(4), jnp.ones(4)))
    shapes = [
        (dps.Attitude(INERTIA), (5,), (3,)),
        (dps.Attitude(jnp.ones((2, 3))), (4,), (3,)),
        (dps.Attitude(jnp.ones((2, 3))), (5, 4), (5, 3)),
        (dps.Stiefel(), (2, 4, 3), (2, 4, 3)),
        (dps.Stiefel(), (2, 4), (2, 4)),
        (dps.Stiefel(), (4,), (4,)),
        (dps.Sphere(), (), ()),
    ]
    for manifold, q, p in shapes:
        with pytest.raises(ValueError, match=r"The state must be a pair.*Write"):
            dps.ManifoldSystem(manifold, flat).project(0.0, (jnp.ones(q), jnp.ones(p)))
    entries = dps.ConstantDamping(jnp.array([0.1, 0.2, 0.3]))
    rough = dps.ManifoldSystem(dps.Sphere(), flat, entries)
    y0 = jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3)
    held = dps.ConstrainedSystem(rough, lambda t, q, args: q[:1])
    for system, solver in (
        (rough, dps.Strang()),
        (rough, dfx.Tsit5()),
        (held, dps.Strang()),
    ):
        with pytest.raises(ValueError, match="must be at one rate"):
            diffeqsolve(system, solver, 0.0, 1.0, 0.1, y0)


def test_velocities_of_bodies():
    from scipy.spatial.transform import Rotation

    omega, v = np.array([0.3, -0.8, 0.6]), np.array([1.0, 2.0, -1.0])
    parts = {"turn": dps.Attitude(jnp.asarray(INERTIA)), "place": dps.Euclidean(2.0)}
    free = dps.ManifoldSystem(parts, lambda t, q, args: 0.0)
    held = dps.ConstrainedSystem(free, lambda t, q, args: q["place"][2:])
    q0 = {"turn": jnp.array([0.6, 0.0, 0.8, 0.0]), "place": jnp.zeros(3)}
    velocities = {"turn": jnp.asarray(omega), "place": jnp.asarray(v)}
    for system in (free, held):
        y = system.from_velocity(0.0, (q0, velocities))
        back = system.to_velocity(0.0, y)[1]
        for part, velocity in velocities.items():
            np.testing.assert_allclose(back[part], velocity, atol=1e-14)
    # By the rotation over a short time, along the axes of the body.
    y, h = free.from_velocity(0.0, (q0, velocities)), 1e-4
    q, _ = diffeqsolve(free, dps.Strang(), 0.0, h, h, y).ys
    turned = Rotation.from_matrix(matrix(q0["turn"]).T @ matrix(q["turn"][-1]))
    np.testing.assert_allclose(turned.as_rotvec() / h, omega, atol=1e-3)
    np.testing.assert_allclose(q["place"][-1] / h, v, rtol=1e-10)
