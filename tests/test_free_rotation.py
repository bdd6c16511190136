"""The free rotation of a rigid body, beside Euler's equations in NumPy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps
from diffrax_presym._system._free_rotation import multiply


UNIT = np.array([1.0, -0.2, 0.5, 0.3]) / np.linalg.norm([1.0, -0.2, 0.5, 0.3])
# Principal moments, and the angular momentum.
BODIES = {
    "asymmetric": ([1.0, 1.6, 2.3], [0.7, -0.4, 1.1]),
    "middle moment first": ([1.6, 2.3, 1.0], [0.7, -0.4, 1.1]),
    "middle moment last": ([2.3, 1.0, 1.6], [0.7, -0.4, 1.1]),
    "reversed order": ([2.3, 1.6, 1.0], [0.7, -0.4, 1.1]),
    "about the least moment": ([1.0, 1.6, 2.3], [1.3, 0.2, 0.1]),
    "about the middle moment": ([1.0, 1.6, 2.3], [0.0, 1.5, 0.0]),
    "about the largest moment": ([1.0, 1.6, 2.3], [0.0, 0.0, -1.5]),
    "on the separatrix": ([1.0, 1.5, 3.0], [1.0, 0.1, 1.0]),
    "near the separatrix": ([1.0, 1.5, 3.0], [1.0, 0.1, 1.0 + 1e-9]),
    "symmetric, flat": ([1.0, 1.0, 1.9], [0.7, -0.4, 1.1]),
    "symmetric, long": ([1.0, 0.1, 1.0], [0.7, -0.04, 0.2]),
    "nearly symmetric": ([1.0, 1.0 + 1e-12, 1.9], [0.7, -0.4, 1.1]),
    "a rod": ([0.01, 1.0, 1.0], [0.01, 0.3, 0.0]),
    "spherical": ([0.8, 0.8, 0.8], [0.7, -0.4, 1.1]),
    "nearly at rest": ([1.0, 1.6, 2.3], [1e-7, -2e-7, 1e-7]),
    "at rest": ([1.0, 1.6, 2.3], [0.0, 0.0, 0.0]),
}
TIMES = 1e-6, 1e-3, 0.1, 1.0, -0.8


def euler(inertia, p, s):
    def field(t, y):
        q, p = y[:4], y[4:]
        w = p / inertia
        real = -np.dot(q[1:], w)
        imaginary = q[0] * w + np.cross(q[1:], w)
        return np.concatenate([[real / 2], imaginary / 2, np.cross(p, w)])

    return scipy.integrate.solve_ivp(
        *(field, (0.0, s), np.concatenate([UNIT, p]), "DOP853"), rtol=1e-13, atol=1e-15
    ).y[:, -1]


@jax.jit
def flow(inertia, y, s):
    q, p = dps.Attitude(inertia).flow(y[:4], y[4:], s)
    return jnp.concatenate([q, p])


def state(p):
    return jnp.concatenate([jnp.asarray(UNIT), jnp.asarray(p)])


DERIVATIVES = [
    jax.jit(jacobian(lambda p, inertia, s: flow(inertia, state(p), s), (0, 1, 2)))
    for jacobian in (jax.jacfwd, jax.jacrev)
]


@pytest.mark.parametrize("s", TIMES)
@pytest.mark.parametrize("body", BODIES)
def test_beside_eulers_equations(body, s):
    inertia, p = map(np.array, BODIES[body])
    found = flow(inertia, state(p), s)
    np.testing.assert_allclose(found, euler(inertia, p, s), atol=3e-14)
    # The way back is exact, and so is a way in two parts.
    np.testing.assert_allclose(flow(inertia, found, -s), state(p), atol=1e-14)
    parts = flow(inertia, flow(inertia, state(p), 0.3 * s), 0.7 * s)
    np.testing.assert_allclose(parts, found, atol=1e-14)


@pytest.mark.parametrize("s", [1e-3, 0.1, 1.0])
@pytest.mark.parametrize("body", BODIES)
def test_derivatives(body, s):
    inertia, p = map(np.array, BODIES[body])

    def difference(fn, x, i):
        step = 1e-5 * np.eye(len(x))[i]
        near = (fn(x + step) - fn(x - step)) / 2e-5
        far = (fn(x + 2 * step) - fn(x - 2 * step)) / 4e-5
        return (4 * near - far) / 3

    by_p = lambda p: flow(inertia, state(p), s)
    by_inertia = lambda inertia: flow(inertia, state(p), s)
    for fn, x, which in ((by_p, p, 0), (by_inertia, inertia, 1)):
        exact = np.stack([difference(fn, jnp.asarray(x), i) for i in range(3)], axis=1)
        for derivatives in DERIVATIVES:
            found = derivatives(jnp.asarray(p), jnp.asarray(inertia), s)[which]
            np.testing.assert_allclose(found, exact, atol=1e-8)
    by_time = DERIVATIVES[0](jnp.asarray(p), jnp.asarray(inertia), s)[2]
    q, p = (flow(inertia, state(p), s)[i:j] for i, j in ((0, 4), (4, 7)))
    body = dps.Attitude(inertia)
    np.testing.assert_allclose(by_time[:4], body.velocity(q, p), atol=1e-11)
    np.testing.assert_allclose(by_time[4:], jnp.cross(p, p / inertia), atol=1e-11)


SECOND = jax.jit(jax.jacfwd(jax.jacrev(lambda p, *of: flow(of[0], state(p), of[1]))))


@pytest.mark.parametrize("body", ["asymmetric", "symmetric, long", "a rod"])
def test_second_derivatives(body):
    """At both sides of where a rotation is taken as small. That by a momentum `a p`
    over a time is that by `p` over `a` times it, so they are differences of first
    derivatives of rotations that are not small."""
    inertia, p = map(np.array, BODIES[body])
    unit = np.min(inertia)
    slope = lambda x: DERIVATIVES[0](jnp.asarray(x), jnp.asarray(inertia), 1.0)[0][:4]
    for s in 1e-9, 5e-6, 5e-5, 2e-4, 1e-3, 1e-2:
        found = SECOND(jnp.asarray(p), jnp.asarray(inertia), s * unit)[:4]
        steps = 0.01 * unit * np.eye(3)
        around = lambda k, s=s, steps=steps: np.stack(
            [slope(s * unit * p + k * x) for x in steps], axis=-1
        )
        near, far = (around(k) - around(-k) for k in (1, 2))
        exact = (8 * near - far) / 0.12
        np.testing.assert_allclose(found / (s**2 * unit), exact, atol=1e-7 / unit)


@pytest.mark.parametrize("body", ["asymmetric", "a rod", "symmetric, long"])
def test_long_steps_are_right_or_fail(body):
    inertia, p = map(np.array, BODIES[body])
    failed = []
    for s in (1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0):
        found = flow(inertia, state(p), s)
        failed.append(bool(np.isnan(found[0])))
        if not failed[-1]:
            np.testing.assert_allclose(found, euler(inertia, p, s), atol=1e-8)
    assert failed == sorted(failed) and not failed[0]
    assert failed[-1] or body == "asymmetric"


@pytest.mark.parametrize("inertia", [[1.0, 1.2, 0.4], [5.0, 1.0, 0.01]])
def test_a_spin_about_the_middle_axis(inertia):
    """Where the functions grow or vanish exponentially, and the momentum is at rest."""
    inertia, failed = np.array(inertia), []
    unit = np.eye(3)[np.argsort(inertia)[1]]
    for angle in 0.5, 1.0, 3.0, 10.0, 20.0, 50.0:
        found = flow(inertia, state(inertia * unit), angle)
        failed.append(bool(np.isnan(found[0])))
        if not failed[-1]:
            half = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * unit])
            turned = multiply(jnp.asarray(UNIT), jnp.asarray(half))
            wanted = np.concatenate([turned, inertia * unit])
            np.testing.assert_allclose(found, wanted, atol=1e-13)
    assert failed == sorted(failed) and not failed[1]


def test_steps_in_which_a_body_turns_many_times():
    """Of bodies that may be, half of them near the middle axis: right, or failed in
    both directions."""
    rng, passed, errors = np.random.default_rng(0), 0, []
    for k in range(60):
        sizes = rng.uniform(0.02, 1.0, 3)
        inertia = np.sum(sizes) - sizes
        p = rng.standard_normal(3)
        if k % 2:
            p *= np.where(np.arange(3) == np.argsort(inertia)[1], 1.0, 1e-2)
        s = rng.uniform(0.2, 20.0) / np.linalg.norm(p / inertia)
        found = flow(inertia, state(p), s)
        if not np.isnan(found).any():
            exact = euler(inertia, p, s)
            errors.append(np.max(np.abs(found[:4] - exact[:4])))
            np.testing.assert_allclose(found[4:], exact[4:], atol=1e-9)
            np.testing.assert_allclose(flow(inertia, found, -s), state(p), atol=1e-6)
            passed += 1
    assert passed > 30 and np.max(errors) < 1e-6 and np.median(errors) < 1e-11


def test_derivatives_of_long_steps():
    """By the moments as by the momentum, beside those of eight steps."""
    rng = np.random.default_rng(0)
    sizes, omega = rng.uniform(0.1, 1.0, (300, 3)), rng.standard_normal((300, 3))
    inertia = np.sum(sizes, axis=1, keepdims=True) - sizes
    omega *= 2.5 / np.linalg.norm(omega, axis=1, keepdims=True)

    def after(steps, inertia, p):
        step = lambda y, _: (flow(inertia, y, 1.0 / steps), None)
        return jax.lax.scan(step, state(p), length=steps)[0]

    both = partial(jax.jacfwd, argnums=(1, 2))
    one, eight = (
        jax.jit(jax.vmap(partial(both(after), steps)))(inertia, inertia * omega)
        for steps in (1, 8)
    )
    for found, exact in zip(one, eight, strict=True):
        assert jnp.max(jnp.abs(found - exact)) < 3e-12 * jnp.max(jnp.abs(exact))


@pytest.mark.parametrize("s", [10.0, 40.0])
def test_momentum_after_periods(s):
    inertia, p = map(np.array, BODIES["asymmetric"])
    found = flow(inertia, state(p), s)[4:]
    np.testing.assert_allclose(found, euler(inertia, p, s)[4:], atol=1e-13 * (10 + s))


def test_many_bodies_in_single_precision():
    rng = np.random.default_rng(0)
    single = lambda x: np.asarray(x, np.float32)
    inertia = single(rng.uniform(0.5, 2.0, (50, 3)))
    p, q = single(rng.standard_normal((50, 3))), jnp.asarray(single([UNIT] * 50))
    found = dps.Attitude(inertia).flow(q, jnp.asarray(p), jnp.float32(0.2))
    exact = np.stack([euler(*x, 0.2) for x in zip(inertia, p, strict=True)])
    assert found[0].dtype == found[1].dtype == jnp.float32
    for scale in (1e12, 1e-12):  # The units are of no importance.
        y = q, jnp.asarray(single(scale * p))
        other = dps.Attitude(single(scale * inertia)).flow(*y, jnp.float32(0.2))
        np.testing.assert_allclose(other[0], found[0], atol=1e-6)
    np.testing.assert_allclose(np.concatenate(found, axis=1), exact, atol=2e-6)
