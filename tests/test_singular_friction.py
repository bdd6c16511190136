"""Several laws of friction, of which one is infinite at the start or was before it."""

import itertools
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import diffrax_presym as dps
from diffrax_presym._friction._leaf import EntryFriction
from diffrax_presym._friction._log_scale import FunctionOfTime, LinearScale, Logarithm


OWN = dps.FixedStepAdjoint()
OTHERS = {
    "constant": (LinearScale(), 0.7, lambda t: t),
    "function": (FunctionOfTime(jnp.sin), -1.5, np.sin),
    "logarithm": (Logarithm(2.0), 3.0, lambda t: np.log(t + 2)),
}


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("order, tolerance", [(4, 5e-4), (6, 1e-6), (8, 1e-9)])
def test_the_effect_of_a_logarithm_and_another_law(kind, order, tolerance):
    """Beside integrals by SciPy in the logarithm of the time since the singularity."""
    law, factor, eta = OTHERS[kind]
    rates = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 6.0])
    terms = (Logarithm(None), jnp.asarray(rates)), (law, jnp.asarray(factor))
    prepare = jax.jit(lambda t, h: EntryFriction(terms).prepare(t, h, order))
    for t, h in (0.0, 0.3), (1e-6, 0.3), (0.05, 0.3), (0.6, 0.3), (9.0, 0.3), (1, -0.7):
        found, end = prepare(float(t), h), t + h
        for i, rate in enumerate(rates):
            total = partial(_total, rate, factor, eta)
            left = _integral(partial(_left, total, end), max(t, 1e-30), end)
            assert abs(found.responded[i] - left) < tolerance * abs(left)
            if t > 0:
                grown = partial(_left, lambda s, total=total: -total(s), t)
                kept = _integral(grown, t, end)
                unit = abs(kept) + 1e-3 * abs(h)
                assert abs(found.carried[i] - kept) < tolerance * unit
                change = np.expm1(total(t) - total(end))
                np.testing.assert_allclose(found.change[i], change, 1e-12)
            elif rate > 0:
                assert found.carried[i] == 0


@pytest.mark.parametrize("t", [0.0, 0.05, 0.6])
def test_derivatives_by_a_whole_strength(t):
    """By which powers of time have integrals that are logarithms."""

    def effect(rate):
        terms = (Logarithm(None), rate), (LinearScale(), jnp.asarray(0.7))
        return jnp.stack(EntryFriction(terms).prepare(t, 0.3, 6))

    rates, h = jnp.array([1.0, 2.0, 3.0, 4.0]), 1e-5
    slope = jax.jit(jax.vmap(jax.jacfwd(effect)))(rates)
    both = jax.vmap(effect)(rates + h), jax.vmap(effect)(rates - h)
    np.testing.assert_allclose(slope, (both[0] - both[1]) / (2 * h), 1e-7, 1e-10)


def _total(rate, factor, eta, t):
    return rate * np.log(t) + factor * eta(t)


def _left(total, end, t):
    return np.exp(total(t) - total(end))


def _integral(fn, a, b):
    a, b = np.log(a), np.log(b)
    in_log = lambda x: fn(np.exp(x)) * np.exp(x)
    points = np.linspace(a, b, 1 + int(np.ceil(abs(b - a))))
    pieces = itertools.pairwise(points)
    quad = lambda *ends: scipy.integrate.quad(in_log, *ends, epsabs=0, epsrel=1e-13)[0]
    return sum(quad(*ends) for ends in pieces)


# The largest error of 32 steps to t = 4, with which the order is at least three.
SOLVERS = {
    "BlanesMoan4": (dps.BlanesMoan4(), 3e-6),
    "TunedRKN6": (dps.TunedRKN6(), 3e-8),
    "PresymplecticGauss": (dps.PresymplecticGauss(3), 3e-4),
}
OTHER_LAWS = {"constant": dps.ConstantDamping(0.3), "function": lambda t: jnp.cos(t)}


@pytest.mark.parametrize("law", OTHER_LAWS)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("t0", [0.0, 1e-3])
def test_a_singular_law_beside_another_one_leaves_order_three(solver, law, t0):
    """Positions, momenta and values between steps, beside SciPy."""
    scheme, largest = SOLVERS[solver]
    friction = [dps.LogDamping(2.0), OTHER_LAWS[law]]
    rate = (lambda t: 0.3) if law == "constant" else (lambda t: -np.sin(t))
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(jnp.cosh(q)), friction
    )
    # From rest at a time before, with the first terms of the series at zero.
    begin = 1e-5
    accelerated = -np.sinh(1.0) / 3
    start = [1 + accelerated * begin**2 / 2, accelerated * begin]
    slope = lambda t, y: [y[1], -np.sinh(y[0]) - (2 / t + rate(t)) * y[1]]
    ts = np.array([t0 or begin, 0.04, 0.37, 1.1, 2.6, 4.0])
    exact = scipy.integrate.solve_ivp(
        *(slope, (begin, 4.0), start, "DOP853"), t_eval=ts, rtol=1e-13, atol=1e-13
    ).y
    y0 = (jnp.ones(1), jnp.zeros(1))
    if t0:
        y0 = tuple(jnp.asarray(x[:1]) for x in exact)

    def error(n):
        saveat = dfx.SaveAt(ts=jnp.asarray(ts[1:]))
        sol: Any = dfx.diffeqsolve(
            *(system, scheme, t0, 4.0, (4.0 - t0) / n, y0), saveat=saveat, adjoint=OWN
        )
        ys = np.stack([y[:, 0] for y in sol.ys])
        return np.max(np.abs(ys - exact[:, 1:]))

    coarse, fine = error(32), error(64)
    assert coarse < largest and fine < largest / 6


@pytest.mark.variants(1)
@pytest.mark.parametrize("friction", [[dps.LogDamping(3.0)], []], ids=["two", "one"])
def test_gradients_by_variable_steps_from_a_singular_start(friction):
    step = dps.StepDensityController(0.1, lambda t, y, args: 1 / (1 + y[0][0] ** 2))
    laws = [*friction, dps.PowerDamping(0.4, 0.5)]
    quartic = lambda t, q, args: jnp.sum(q**2) / 2 + jnp.sum(q**4) / 4
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), quartic, laws)

    @jax.jit
    def loss(q):
        sol: Any = dfx.diffeqsolve(
            *(system, dps.BlanesMoanRKN4(), 0.0, 1.5, None, (q, 0 * q)),
            saveat=dfx.SaveAt(ts=jnp.array([0.03, 0.4, 1.1])),
            stepsize_controller=step,
            adjoint=OWN,
            max_steps=300,
        )
        return jnp.sum(sol.ys[0])

    q, d = jnp.ones(1), 1e-5
    wanted = (loss(q + d) - loss(q - d)) / (2 * d)
    assert jax.grad(loss)(q)[0] == pytest.approx(float(wanted), rel=1e-7)


def test_the_effect_does_not_depend_on_the_order_of_laws():
    one = jnp.ones(())
    terms = [
        (Logarithm(None), 3 * one),
        (Logarithm(one), one),
        (FunctionOfTime(jnp.sin), -one / 2),
    ]
    for t, h in (0.0, 0.3), (0.2, 0.3):
        effects = [
            EntryFriction(order).prepare(t, h, 8)
            for order in itertools.permutations(terms)
        ]
        for effect in effects[1:]:
            np.testing.assert_allclose(effect, effects[0], rtol=1e-12)


RKN4 = dps.BlanesMoanRKN4()


def pendulum(
    law, t0, t1, n, ts, y0=(1.0, 0.0), adjoint: Any = OWN, solver: Any = RKN4
) -> Any:
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: -jnp.sum(jnp.cos(q)), law
    )
    y0 = tuple(jnp.asarray([y]) for y in y0)
    solve = (system, solver, t0, t1, (t1 - t0) / n, y0)
    options = {"throw": False, "max_steps": 200}
    saveat = dfx.SaveAt(ts=jnp.asarray(ts))
    return dfx.diffeqsolve(*solve, saveat=saveat, adjoint=adjoint, **options)


def by_scipy(delta, ts):
    def slope(t, y):
        return [y[1], -np.sin(y[0]) - 0.4 * delta * t ** (delta - 1) * y[1]]

    begin = 1e-9
    start = [1.0, -np.sin(1.0) * begin]
    return scipy.integrate.solve_ivp(
        *(slope, (begin, ts[-1]), start, "DOP853", ts), rtol=1e-12, atol=1e-13
    ).y


@pytest.mark.variants(1)
@pytest.mark.parametrize(
    "delta, error", [(0.5, 2e-3), (1.5, 1e-5), (2.0, 1e-6), (2.5, 1e-6)]
)
def test_values_in_the_first_steps_of_a_power_of_time(delta, error):
    """Whose rate has no two derivatives at zero, or seems to have none."""
    ts = [0.04, 0.17, 0.31, 2.0]
    value = jax.jit(lambda d: pendulum(dps.PowerDamping(0.4, d), 0.0, 2.0, 20, ts).ys)
    np.testing.assert_allclose(
        jnp.stack(value(delta))[..., 0], by_scipy(delta, ts), atol=error
    )
    if delta != 2:  # there the interpolation differs
        total = lambda d: sum(jnp.sum(y) for y in value(d))
        wanted = (total(delta + 1e-5) - total(delta - 1e-5)) / 2e-5
        assert jax.grad(total)(delta) == pytest.approx(float(wanted), rel=1e-6)


def test_gradients_by_the_exponent_of_values_between_steps():
    law = lambda d: dps.PowerDamping(0.3, d)
    ts = [1.33, 1.5, 1.77]
    total = jax.jit(lambda d: jnp.sum(pendulum(law(d), 1.0, 2.0, 10, ts).ys[0]))
    wanted = (total(0.6 + 1e-5) - total(0.6 - 1e-5)) / 2e-5
    assert jax.grad(total)(0.6) == pytest.approx(float(wanted), rel=1e-7)


@pytest.mark.variants(1)
@pytest.mark.parametrize("adjoint", [OWN, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("delta", [1.5, 2.0])
def test_backwards_to_the_start_of_a_power_of_time(delta, adjoint):
    at_end = by_scipy(delta, [2.0])[:, 0]
    solve = lambda d: pendulum(
        dps.PowerDamping(0.4, d), 2.0, 0.0, 20, [0.0], at_end, adjoint
    )
    sol = solve(delta)
    assert sol.result == dfx.RESULTS.successful
    np.testing.assert_allclose(sol.ys[0][0, 0], 1.0, atol=1e-5)
    end = jax.jit(lambda d: solve(d).ys[1][0, 0])
    wanted = (end(delta + 1e-5) - end(delta - 1e-5)) / 2e-5
    assert jax.grad(end)(delta) == pytest.approx(float(wanted), rel=1e-6)


GROWING = [dps.LogDamping(-0.5)], [dps.PowerDamping(0.3, -1.0)]
GROWING += ([dps.LogDamping(1.0), dps.LogDamping(-2.0)],)


@pytest.mark.parametrize("laws", GROWING)
def test_infinite_growth_at_the_start_fails(laws):
    solve = lambda laws: pendulum(laws, 0.0, 1.0, 20, [1.0], solver=dps.Strang())
    assert solve(laws).result != dfx.RESULTS.successful
    known = not isinstance(laws[0], dps.PowerDamping)
    sol = solve([*laws, dps.LogDamping(3.0)])
    assert (sol.result == dfx.RESULTS.successful) == known
