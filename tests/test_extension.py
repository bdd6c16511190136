"""The continuous extensions of schemes, which the loop of this package uses between
steps if forces take long."""

import math
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import diffrax_presym as dps
from diffrax_presym import _loop
from diffrax_presym._cost import nanoseconds
from diffrax_presym._solver import _extension, _splitting_extension


OURS = dps.ReversibleAdjoint(), dps.FixedStepAdjoint()
ONES = jnp.linspace(0.5, 1.0, 3)


@pytest.fixture(autouse=True)
def cheap_forces_too(monkeypatch):
    monkeypatch.setattr(_extension, "_OVERHEAD", 0)
    yield
    # Solves of equal arguments are traced once.
    jax.clear_caches()


def potential(t, q, args):
    return (
        -args * jnp.sum(jnp.cos(q)) + 0.1 * jnp.sum(q[1:] * q[:-1]) + jnp.sin(t) * q[0]
    )


def system(damping=None):
    return dps.ConformalHamiltonian(dps.QuadraticKinetic(1.3), potential, damping)


def solve(system, solver, dt0, saveat, adjoint=OURS[0], y0=None, t1=4.0, args=1.2):
    sol: Any = dfx.diffeqsolve(
        dps.HamiltonianTerm(system),
        solver,
        *(0.0, t1, dt0, (ONES, 0.3 * ONES) if y0 is None else y0),
        args=args,
        saveat=saveat,
        adjoint=adjoint,
        max_steps=200,
    )
    return sol.ys


LAWS = {
    "none": None,
    "constant": dps.ConstantDamping(0.3),
    "logarithmic": dps.LogDamping(2.0, shift=0.1),
    "any": lambda t: 0.2 * t + 0.1 * jnp.sin(t),
}
SCHEMES = {
    "BlanesMoan4": dps.BlanesMoan4(),
    "BlanesMoanRKN4": dps.BlanesMoanRKN4(),
    "BlanesMoan6": dps.BlanesMoan6(),
    "TunedRKN6": dps.TunedRKN6(),
    "BlanesCasasRKN8": dps.BlanesCasasRKN8(),
    "compensated": dps.Compensated(dps.Checked(dps.BlanesMoanRKN6())),
    "Gauss": dps.PresymplecticGauss(3),
    "compensated Gauss": dps.Compensated(dps.Checked(dps.PresymplecticGauss(4))),
}


@pytest.mark.parametrize(
    "name, law",
    [
        ("BlanesMoan4", "any"),
        ("TunedRKN6", "logarithmic"),
        *(
            pytest.param(name, law, marks=pytest.mark.slow)
            for name, law in {
                "BlanesMoanRKN4": "constant",
                "BlanesMoan6": "logarithmic",
                "BlanesCasasRKN8": "none",
                "compensated": "constant",
                "Gauss": "any",
                "compensated Gauss": "constant",
            }.items()
        ),
    ],
)
def test_the_order_is_that_of_the_scheme(name, law):
    solver = SCHEMES[name]
    order = solver.order(None)
    ts = jnp.linspace(0.0, 4.0, 24)
    mechanical = system(LAWS[law])
    run = jax.jit(lambda h: solve(mechanical, solver, h, dfx.SaveAt(ts=ts)))
    fine = dps.SofroniouSpaletta10()
    exact = jax.jit(lambda: solve(mechanical, fine, 0.05, dfx.SaveAt(ts=ts)))()
    errors = [
        np.max(np.abs(np.concatenate(run(h)) - np.concatenate(exact)))
        for h in (0.8, 0.4)
    ]
    assert errors[1] < 1e-3 and np.log2(errors[0] / errors[1]) > order - 1


def test_evaluations():
    """A step with times in it costs six evaluations more, however many they are, and
    one whose end alone is saved costs none."""
    forces = []

    def force(t, q, args):
        jax.debug.callback(lambda _: forces.append(1), q)
        return -jnp.sin(q)

    counted = dps.SeparableHamiltonian(
        dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(-jnp.cos(q)), force=force
    )

    def count(saveat):
        forces.clear()
        jax.block_until_ready(solve(counted, dps.TunedRKN6(), 0.5, saveat))
        jax.effects_barrier()
        return len(forces)

    steps = count(dfx.SaveAt(t1=True))
    assert steps >= 8 * 14
    assert count(dfx.SaveAt(ts=jnp.arange(9) / 2)) == steps
    for times in ([0.6], [0.5, 0.6, 0.7, 0.8, 0.9, 1.0], [0.6, 2.1, 2.2, 4.0]):
        inside = {int(2 * t) for t in times if 2 * t % 1}
        expected = steps + 6 * len(inside)
        assert count(dfx.SaveAt(ts=jnp.array(times))) == expected


def test_evaluations_of_collocation():
    """A step with times in it costs 24 evaluations for three stages."""
    calls = []

    def energy(t, q, p, args):
        jax.debug.callback(lambda _: calls.append(1), q)
        return (1 + q**2) * p**2 / 2 - jnp.cos(q)

    counted = dps.Hamiltonian(energy)
    y0 = jnp.asarray(1.0), jnp.asarray(0.3)
    solver = dps.PresymplecticGauss(3)

    def count(saveat):
        calls.clear()
        jax.block_until_ready(solve(counted, solver, 0.5, saveat, y0=y0))
        jax.effects_barrier()
        return len(calls)

    steps = count(dfx.SaveAt(t1=True))
    assert count(dfx.SaveAt(ts=jnp.arange(9) / 2)) == steps
    for times in ([0.6], [0.5, 0.6, 0.7, 0.8, 0.9, 1.0], [0.6, 2.1, 2.2, 4.0]):
        inside = {int(2 * t) for t in times if 2 * t % 1}
        expected = steps + 4 * 6 * len(inside)
        assert count(dfx.SaveAt(ts=jnp.array(times))) == expected


@pytest.mark.parametrize("kept", [True, False])
def test_what_forces_cost_decides(kept, monkeypatch):
    """Shorter steps for cheap forces, the same solution to the error of the scheme."""
    monkeypatch.setattr(_loop, "_LARGE_EXTENDED", 64 if kept else 0)
    ts = jnp.linspace(0.0, 4.0, 50)
    solve_all = lambda: solve(
        system(), dps.TunedRKN6(), 0.25, dfx.SaveAt(subs=subs), args=1.2
    )
    subs = [dfx.SubSaveAt(ts=ts, t0=True), dfx.SubSaveAt(ts=ts[7:9], steps=3)]
    finite = lambda ys: jax.tree.map(lambda x: x[np.isfinite(x)], ys)
    extended = finite(solve_all())
    monkeypatch.setattr(_extension, "_OVERHEAD", math.inf)
    jax.clear_caches()
    shorter = finite(solve_all())
    assert_close(extended, shorter, 1e-6)
    difference = jax.tree.map(lambda x, y: np.max(np.abs(x - y)), extended, shorter)
    assert max(jax.tree.leaves(difference[0])) > 1e-12


def test_costs_are_those_of_what_is_computed():
    x = jnp.ones((50, 50))
    product = nanoseconds(lambda x: x @ x, x)
    assert product > 20 * nanoseconds(lambda x: x + x, x)
    # The value of the sine is not needed for its gradient, nor what is dropped.
    sine = nanoseconds(jnp.sin, x)
    gradient = jax.grad(lambda x: jnp.sum(jnp.sin(x)))
    assert nanoseconds(gradient, x) == pytest.approx(sine, rel=0.3)
    assert nanoseconds(lambda x: (jnp.sin(x), x)[1], x) == 0
    loop = lambda x: jax.lax.fori_loop(0, 7, lambda _, x: jnp.sin(x), x)
    assert nanoseconds(loop, x) == pytest.approx(7 * sine, rel=0.3)


TIMES = {
    "many in a step": jnp.linspace(0.0, 4.0, 33),
    "some": jnp.array([0.0, 0.0, 0.3, 0.5, 0.5, 0.77, 3.0, 3.99, 4.0]),
}


@pytest.mark.parametrize(
    "name, adjoint, times",
    [
        ("TunedRKN6", OURS[0], "many in a step"),
        pytest.param("compensated", OURS[0], "some", marks=pytest.mark.slow),
        pytest.param("BlanesMoan6", OURS[1], "some", marks=pytest.mark.slow),
        pytest.param("Gauss", OURS[0], "many in a step", marks=pytest.mark.slow),
        pytest.param("compensated Gauss", OURS[1], "some", marks=pytest.mark.slow),
    ],
)
def test_gradients(name, adjoint, times):
    """Also of friction, mass and forces, on which the extension depends."""

    def loss(parameters):
        gamma, mass, args, q0 = parameters
        mechanical = dps.ConformalHamiltonian(
            dps.QuadraticKinetic(mass), potential, dps.LogDamping(gamma, shift=0.2)
        )
        fn = lambda t, y, args: (y[0] * t, y[1] ** 2 * args)
        sub = dfx.SubSaveAt(ts=TIMES[times], fn=fn, t1=True)
        saveat = dfx.SaveAt(subs=[sub, dfx.SubSaveAt(ts=TIMES["some"], steps=2)])
        y0 = q0, 0.3 * ONES
        ys = solve(mechanical, SCHEMES[name], 0.5, saveat, adjoint, y0, args=args)
        finite = lambda x: jnp.where(jnp.isfinite(x), x, 0)
        return sum(jnp.sum(jnp.sin(finite(y))) for y in jax.tree.leaves(ys))

    at = jnp.asarray(0.7), jnp.asarray(1.3), jnp.asarray(1.2), ONES
    value, gradient = jax.jit(jax.value_and_grad(loss))(at)
    assert np.isfinite(value)
    rng = np.random.default_rng(0)
    run = jax.jit(loss)
    for _ in range(2):
        direction = jax.tree.map(lambda x: rng.normal(size=x.shape), at)
        move = lambda e, d=direction: jax.tree.map(lambda x, d: x + e * d, at, d)
        slope = (run(move(1e-5)) - run(move(-1e-5))) / 2e-5
        pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
        product = sum(np.sum(g * d) for g, d in pairs)
        assert abs(product - slope) < 1e-7 * (1 + abs(slope))


@pytest.mark.parametrize(
    "adjoint", [OURS[0], pytest.param(OURS[1], marks=pytest.mark.slow)]
)
def test_friction_that_is_infinite_at_the_start(adjoint):
    linear = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(), lambda t, q, args: q**2 / 2, dps.LogDamping(3.0)
    )
    ts = jnp.array([0.0, 1e-3, 0.1, 0.2, 0.31, 1.0])
    # q = 2 J_1(t) / t, of which the first terms suffice.
    exact = 1 - ts**2 / 8 + ts**4 / 192 - ts**6 / 9216

    def run(q):
        y0 = q, jnp.zeros(())
        saveat = dfx.SaveAt(ts=ts)
        return solve(linear, dps.BlanesMoanRKN4(), 0.25, saveat, adjoint, y0, 1.0)[0]

    one = jnp.asarray(np.float64(1.0))
    assert_close(run(one), exact, 3e-5)
    assert_close(jax.jacrev(run)(one), exact, 3e-5)


def test_batches_and_single_precision():
    ts = jnp.linspace(0.0, 4.0, 30)
    solver, saveat = dps.TunedRKN6(), dfx.SaveAt(ts=ts)
    mechanical = system(dps.ConstantDamping(0.1))
    run = lambda y0: solve(mechanical, solver, 0.5, saveat, y0=y0)
    y0 = jnp.array([[0.1, 0.2, 0.3], [1.0, 2.0, 0.5]]), jnp.zeros((2, 3))
    batch = jax.jit(jax.vmap(run))(y0)
    each = [run(jax.tree.map(lambda x, i=i: x[i], y0)) for i in range(2)]
    assert_close(batch, jax.tree.map(lambda *x: jnp.stack(x), *each), 1e-14)

    pendulums = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        lambda t, q, args: -jnp.sum(jnp.cos(q)),
        dps.ConstantDamping(0.1),
    )
    high = jax.tree.map(lambda x: x[1], y0)
    low = jax.tree.map(lambda x: x.astype("float32"), high)
    saved = dfx.SaveAt(ts=ts.astype("float32"))
    low = solve(pendulums, solver, 0.5, saved, y0=low)
    assert all(x.dtype == jnp.float32 for x in low)
    assert_close(low, solve(pendulums, solver, 0.5, saveat, y0=high), 1e-5)


def test_the_order_conditions():
    """Exact positions of an oscillator, to the order of the conditions."""
    tableau = dps.TunedRKN6.tableau
    constants = _splitting_extension._constants(tableau)
    for x in (0.05, 0.1):
        forces, _ = _splitting_extension._oscillate(tableau, x)
        for s, weights in zip(constants.points[1:-1], constants.kicks, strict=True):
            q = np.array([1.0, s]) + (weights * (s - constants.times)) @ forces
            exact = np.cos(s * x), np.sin(s * x) / x
            np.testing.assert_allclose(q, exact, atol=1e-12)
    # The words that act on a force: 1, 1, 2, 3, 6, 10 and 20 of each degree.
    degrees = [len(word) for word in _splitting_extension._words(6)]
    assert [degrees.count(k) for k in range(7)] == [1, 1, 2, 3, 6, 10, 20]
