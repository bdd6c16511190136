# pyright: reportOptionalMemberAccess=false
"""Bregman dynamics: motion, structure and rates, for every mirror map and scaling."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.special as jsp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, drift, solve, step, trajectory

import diffrax_presym as dps
from diffrax_presym._friction._exponential import expm1


MASS = jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.7]])
SIMPLEX = dps.EntropyMirror(simplex=True)
FINDER = optx.Newton(rtol=1e-13, atol=1e-13)


def entropy(q):
    return jnp.sum(q * jnp.log(q) - q)


def found(w):
    """The inverse of the gradient of the entropy, by a root find."""
    residual = lambda q, _: jnp.log(q) - w
    return optx.root_find(residual, FINDER, jnp.full_like(w, 1e-3)).value


@dataclasses.dataclass(frozen=True)
class Mirror:
    """A mirror map, and its convex conjugate in closed form."""

    name: str
    map: Any
    dual: Callable

    def __repr__(self):
        return self.name


MIRRORS = [
    Mirror(
        "euclidean",
        dps.EuclideanMirror(MASS),
        lambda w: w @ jnp.linalg.solve(MASS, w) / 2,
    ),
    Mirror("entropy", dps.EntropyMirror(), lambda w: jnp.sum(jnp.exp(w))),
    Mirror("simplex", SIMPLEX, jsp.logsumexp),
    Mirror("own", dps.MirrorMap(entropy, found), lambda w: jnp.sum(jnp.exp(w))),
]
NAMED = {mirror.name: mirror for mirror in MIRRORS}


def over(*names):
    chosen = [NAMED[name] for name in names] or MIRRORS
    return pytest.mark.parametrize("mirror", chosen, ids=repr)


def rising(t):
    return 0.5 * t**2


# exp(alpha) = t, and beta slower than the ideal scaling
OWN_SCALING = dps.Scaling(rising, lambda t: 0.4 * t**2)
SCALINGS = {
    "polynomial": dps.PolynomialScaling(3.0, 0.4),
    "exponential": dps.ExponentialScaling(0.8, 0.5),
    "own": OWN_SCALING,
}


def logs(scaling, t):
    """The functions alpha and beta."""
    rate, strength = scaling.rate(t), scaling.strength(t)
    return jnp.log(rate), jnp.log(strength / rate)


Q = jnp.array([0.3, 0.5, 0.2])
P = jnp.array([0.1, -0.3, 0.2])
T0, T1 = jnp.array(1.5), jnp.array(1.75)


def objective(t, q, args):
    shift = q - jnp.array([0.1, 0.3, 0.6])
    return shift @ (MASS @ shift) / 2 + jnp.sum(q**4) / 4


def system(mirror, scaling="polynomial", f=objective):
    return dps.BregmanHamiltonian(mirror.map, f, SCALINGS[scaling])


# Equations of motion


@pytest.mark.variants(1)
@pytest.mark.parametrize(
    "mirror, scaling",
    [
        *((mirror, "polynomial") for mirror in MIRRORS),
        *((NAMED["entropy"], scaling) for scaling in ("exponential", "own")),
    ],
    ids=str,
)
def test_equations_of_motion_are_those_of_the_hamiltonian(mirror, scaling):
    law = SCALINGS[scaling]

    @jax.jit
    def hamiltonian(t, q, momentum):
        """Equation (bregman_ham), with canonical momentum and convex conjugate."""
        alpha, beta, gamma = *logs(law, t), law.gamma(t)
        image = mirror.map.gradient(q)
        there = image + jnp.exp(-gamma) * momentum
        at_image = jax.grad(mirror.dual)(image) @ (there - image)
        divergence = mirror.dual(there) - mirror.dual(image) - at_image
        total = divergence + jnp.exp(beta) * objective(t, q, None)
        return jnp.exp(alpha + gamma) * total

    H = system(mirror, scaling)
    momentum = H.to_canonical(T0, P)
    assert_close(H.canonical(T0, Q, P), hamiltonian(T0, Q, momentum), 1e-14)
    slope, velocity = jax.jit(jax.grad(hamiltonian, (1, 2)))(T0, Q, momentum)
    dq, dp = eqx.filter_jit(H.vf)(T0, (Q, P), None)
    assert_close(dq, velocity, 1e-13)
    change = H.from_canonical(T0, -slope) - law.gamma.rate(T0) * P
    # Momenta on the simplex are defined up to a constant.
    assert_close(dp, mirror.map.project(change), 1e-13)


@over()
def test_mirror_map_is_inverted(mirror):
    image = mirror.map.gradient(Q)
    if mirror.name != "own":
        assert_close(mirror.map.inverse(image), Q, 1e-14)
    there = Q + mirror.map.step(Q, P)
    moved = mirror.map.gradient(there) - image
    assert_close(mirror.map.project(moved), mirror.map.project(P), 1e-12)
    assert_close(mirror.map.change(Q, there - Q), moved, 1e-14)
    assert bool(mirror.map.contains(Q))
    assert not bool(mirror.map.contains(Q * jnp.nan))


def nothing(t, q, args):
    return 0 * jnp.sum(q)


@over()
def test_drift_is_the_flow_without_the_objective(mirror):
    H = system(mirror, "exponential", nothing)
    flow = eqx.filter_jit(drift)
    end = flow(H, T0, jnp.array(1.0), Q, P)
    # The composition of two drifts is one drift.
    middle = flow(H, T0, jnp.array(0.3), Q, P)
    assert_close(flow(H, T0 + 0.3, jnp.array(0.7), *middle), end, 2e-12)

    @jax.jit
    def rate(s):
        fn = lambda s: drift(H, T0, s, Q, P)
        return jax.jvp(fn, (s,), (jnp.ones_like(s),))

    # Its derivative is the vector field, so it is the flow.
    y, dy = rate(jnp.array(0.6))
    assert_close(dy, eqx.filter_jit(H.vf)(T0 + 0.6, y, None), 1e-12)


@over("euclidean", "entropy", "simplex")
def test_drift_keeps_its_digits_in_float32(mirror):
    # A step of 1e-3 at t = 1000 changes the state by a few millionths.
    H = system(mirror)
    single = [jnp.float32(x) for x in (1e3, 1e-3, Q, P)]
    double = [x.astype(jnp.float64) for x in single]
    t, h, q, p = single
    move = -expm1(-H.damping.increment(t, h)) * H.mirror_map.step(q, p)
    (q1, p1), (q64, p64) = drift(H, *single), drift(H, *double)
    assert q1.dtype == p1.dtype == jnp.float32
    assert_close(np.float64(move) / (q64 - double[2]), np.ones(3), 1e-6)
    assert_close(q1, q64, 1e-7)
    assert_close(np.float64(p1) / p64, np.ones(3), 1e-6)


# Schemes

# The tangent space of the simplex: vectors that sum to zero.
TANGENT = np.array([[1, -1, 0], [1, 1, -2]]).T / np.sqrt([2, 6])


@eqx.filter_jit
def jacobian(H, solver, basis):
    def one_step(x):
        n = basis.shape[1]
        y = (Q + basis @ x[:n], P + basis @ x[n:])
        q, p = step(H, solver, T0, T1, y)[0]
        return jnp.concatenate([basis.T @ q, basis.T @ p])

    return jax.jacfwd(one_step)(jnp.zeros(2 * basis.shape[1]))


@pytest.mark.variants(1)
@over("entropy", "simplex", "own")
def test_form_contracts_with_the_scaling(mirror):
    basis = TANGENT if mirror.name == "simplex" else np.eye(3)
    J = np.asarray(jacobian(system(mirror), dps.BlanesMoan4(), jnp.array(basis)))
    n = basis.shape[1]
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    contraction = float((T0 / T1) ** 3)
    tolerance = 1e-12 if mirror.name == "own" else 5e-14
    assert np.max(np.abs(J.T @ form @ J - contraction * form)) < tolerance


@over()
def test_a_step_backwards_undoes_a_step_of_a_splitting(mirror):
    H, solver = system(mirror), dps.Strang()
    there = step(H, solver, T0, T1, (Q, P))[0]
    back = step(H, solver, T1, T0, there)[0]
    assert_close(back, (Q, P), 1e-13)


def beyond_a_corner(t, q, args):
    return jnp.sum((q - jnp.array([[1.5, 0, -0.5]], q.dtype)) ** 2)


@pytest.mark.variants(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_positions_stay_on_the_simplex(dtype):
    H = dps.BregmanHamiltonian(SIMPLEX, beyond_a_corner, dps.PolynomialScaling(2.0))
    q0 = jnp.array([[0.3, 0.5, 0.2], [0.1, 0.1, 0.8]], dtype)
    t0, t1, dt0 = (dtype(x) for x in (0.25, 30.25, 1 / 32))
    y0, saveat = (q0, jnp.zeros_like(q0)), dfx.SaveAt(steps=True)
    sol = solve(H, dps.Strang(), t0, t1, dt0, y0, saveat=saveat, max_steps=960)
    assert sol.ys is not None
    q, p = sol.ys
    assert q.dtype == dtype and np.all(np.isfinite(q)) and np.all(q > 0)
    eps = np.finfo(dtype).eps
    assert np.max(np.abs(q.sum(-1) - 1)) < 32 * eps
    assert np.max(np.abs(p.sum(-1))) < 64 * eps * np.max(np.abs(p))
    assert np.all(q[-1, :, 0] > 0.99)


# Rates. For f(q) = exp(-q) the exact solution is q = beta(t), p = 1, so f = exp(-beta).


def falling(t, q, args):
    return jnp.sum(jnp.exp(-q))


RATES = {
    "c = 2": dps.PolynomialScaling(2.0),
    "c = 4": dps.PolynomialScaling(4.0, 0.3),
    "exponential": dps.ExponentialScaling(1.0),
    # Slower than the optimal rate.
    "own": dps.Scaling(rising, rising),
}


@pytest.mark.variants(1)
@pytest.mark.parametrize("rate", RATES)
def test_objective_falls_like_exp_of_beta(rate):
    H = dps.BregmanHamiltonian(dps.EuclideanMirror(), falling, RATES[rate])
    beta = jax.vmap(lambda t: logs(H.scaling, t)[1])
    y0 = (logs(H.scaling, jnp.array(1.0))[1][None], jnp.ones(1))
    t, q, p = trajectory(H, dps.BlanesMoan4(), 1.0, 3.0, 0.05, y0)
    assert_close(q[:, 0], beta(jnp.array(t)), 1e-6)
    assert_close(p, np.ones_like(p), 1e-6)
    gap = jax.vmap(lambda t, q: falling(t, q, None))(t, q)
    assert_close(np.log(gap), -beta(jnp.array(t)), 1e-6)


# Errors and failures


def test_violated_scaling_conditions_fail_a_solve():
    # They hold until t = 2.
    scaling = dps.Scaling(rising, lambda t: t**3 / 6)
    H = dps.BregmanHamiltonian(dps.EuclideanMirror(), objective, scaling)
    good = solve(H, dps.Strang(), 1.0, 1.9, 0.1, (Q, P), throw=False)
    assert good.result == dfx.RESULTS.successful
    bad = solve(H, dps.Strang(), 1.0, 2.5, 0.1, (Q, P), throw=False)
    assert bad.result != dfx.RESULTS.successful
    assert bad.stats["num_steps"] == 11


def failing(mirror_map, solver, q, p, h=0.5):
    H = dps.BregmanHamiltonian(mirror_map, objective, dps.PolynomialScaling(2.0))
    return solve(H, solver, 1.0, 1.0 + 4 * h, h, (q, p), throw=False)


@pytest.mark.variants(5)
@pytest.mark.parametrize(
    "mirror_map, solver, q, p",
    [
        # Outside the dual domain, outside the domain, not finite.
        (dps.EntropyMirror(), dps.Strang(), -Q, P),
        (dps.EntropyMirror(), dps.PresymplecticTao(), -Q, P),
        (dps.EntropyMirror(), dps.PresymplecticGauss(1, FINDER), -Q, P),
        (dps.EntropyMirror(), dps.Strang(), Q, 1e4 + P),
        (dps.EuclideanMirror(), dps.Strang(), jnp.nan * Q, P),
    ],
)
def test_leaving_the_domain_is_a_result(mirror_map, solver, q, p):
    sol = failing(mirror_map, solver, q, p)
    assert sol.result != dfx.RESULTS.successful
    assert sol.stats["num_steps"] == 1
    good = failing(mirror_map, solver, Q, P / 10, h=0.01)
    assert good.result == dfx.RESULTS.successful


def test_time_zero_is_a_result():
    H = system(NAMED["entropy"])
    sol = solve(H, dps.BlanesMoan4(), -0.1, 0.5, 0.05, (Q, P), throw=False)
    assert sol.result != dfx.RESULTS.successful


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: dps.BregmanHamiltonian(entropy, objective, SCALINGS["own"]), "Mirr"),
        (lambda: dps.BregmanHamiltonian(SIMPLEX, 1.0, SCALINGS["own"]), "objective"),
        (lambda: dps.BregmanHamiltonian(SIMPLEX, objective, rising), "Scaling"),
        (lambda: dps.PolynomialScaling(-1.0), "positive"),
        (lambda: dps.ExponentialScaling(1.0, 0.0), "positive"),
        (lambda: dps.MirrorMap(1.0, jnp.exp), "`h` must be a function"),
        (lambda: dps.MirrorMap(entropy, 1.0), "`inverse` must be"),
        (lambda: dps.Scaling(1.0), "`gamma`"),
        (lambda: dps.Scaling(rising, 1.0), "`beta`"),
    ],
)
def test_bad_parts_are_an_error(make, message):
    with pytest.raises(ValueError, match=message):
        make()
