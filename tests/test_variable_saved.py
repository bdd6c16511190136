"""Saved values of variable steps, within them or at their ends: beside Kepler's
equation and Diffrax's loop, and their gradients beside central differences."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers import check_members

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
OWN: Any
THEIRS: Any
OWN, THEIRS = dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()
E = 0.7  # the eccentricity
# The apocentre.
START = np.array([-1 - E, 0.0]), np.array([0.0, -(((1 - E) / (1 + E)) ** 0.5)])
TS = np.linspace(0.0, 12.0, 101)


def kepler(rate=None):
    potential = lambda t, q, args: -1 / jnp.linalg.norm(q)
    friction = None if rate is None else dps.ConstantDamping(rate)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)


def solve(system, epsilon, ts, adjoint=OWN, solver=None, y0=START, **options):
    t1 = options.pop("t1", ts[-1])
    return diffeqsolve(
        *(system, solver or dps.TunedRKN6(), 0.0, t1, None, y0),
        stepsize_controller=dps.StepDensityController(epsilon, system),
        adjoint=adjoint,
        **{"saveat": dfx.SaveAt(ts=jnp.asarray(ts)), "max_steps": 2000} | options,
    )


def positions(ts):
    """By Kepler's equation, the time from the apocentre."""
    mean = np.asarray(ts) + np.pi
    late = lambda x, m: x - E * np.sin(x) - m
    find: Any = partial(scipy.optimize.brentq, late, xtol=1e-15)
    x = np.array([find(m - 2, m + 2, args=(m,)) for m in mean])
    return np.stack([np.cos(x) - E, (1 - E**2) ** 0.5 * np.sin(x)], axis=1)


SOLVERS = {
    "RKN4": (dps.BlanesMoanRKN4(), 1.0),
    "RKN6": (dps.TunedRKN6(), 0.8),
    "RKN8": (dps.BlanesCasasRKN8(), 0.8),
    "composition": (dps.SofroniouSpaletta(6, dps.PresymplecticLeapfrog()), 0.8),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_the_error_between_steps_is_that_at_their_ends(name):
    (solver, epsilon), system = SOLVERS[name], kepler()
    sol = solve(system, epsilon, TS, solver=solver)
    steps = {"saveat": dfx.SaveAt(steps=True), "t1": TS[-1]}
    ends = solve(system, epsilon, TS, THEIRS, solver, **steps)
    n = int(ends.stats["num_steps"])
    assert sol.stats["num_steps"] == n
    error = lambda ts, q: np.max(np.abs(q - positions(ts)))
    at_ends = error(ends.ts[:n], ends.ys[0][:n])
    inside = np.sum(~np.isin(TS, ends.ts[:n])) - 1  # the first time is the start
    assert sol.stats["interpolated"] == inside
    most = 2 if name == "RKN8" else 1.5
    assert 1e-11 < error(TS, sol.ys[0]) < most * at_ends


def test_saved_values_do_not_depend_on_other_saved_times():
    system = kepler()
    all_of_them = solve(system, 0.2, TS).ys
    for some in (slice(None, None, 50), slice(31, 32), slice(98, None)):
        ys = solve(system, 0.2, TS[some], t1=TS[-1]).ys
        for x, y in zip(ys, all_of_them, strict=True):
            np.testing.assert_allclose(x, y[some], rtol=1e-13, atol=1e-13)


def test_gaps_and_the_end_of_a_solve():
    ts = np.array([np.nan, 0.0, np.nan, 3.0, 3.01, np.nan, 12.0])
    sol = solve(kepler(), 0.2, ts)
    gap = np.isnan(ts)
    assert np.all(np.isinf(sol.ys[0][gap]))
    np.testing.assert_allclose(sol.ys[0][~gap], positions(ts[~gap]), atol=1e-5)
    short = solve(kepler(), 0.2, TS, max_steps=40, throw=False)
    assert short.result == dfx.RESULTS.max_steps_reached
    reached = np.isfinite(short.ts)
    whole = solve(kepler(), 0.2, TS).ys[0]
    assert 10 < np.sum(reached) < 90
    np.testing.assert_allclose(short.ys[0][reached], whole[reached], atol=1e-14)


SAVED = {
    "every step": dfx.SaveAt(steps=True),
    "both ends": dfx.SaveAt(t0=True, steps=3, t1=True),
    "with times": dfx.SaveAt(
        subs=[
            dfx.SubSaveAt(ts=jnp.linspace(0.0, 12.0, 7)),
            dfx.SubSaveAt(steps=4, fn=lambda t, y, args: (t, y[0])),
        ]
    ),
}


@pytest.mark.parametrize("saved", SAVED)
@pytest.mark.parametrize("back", [False, True])
def test_ends_of_steps_are_those_of_the_other_loop(saved, back):
    options = {"saveat": SAVED[saved], "max_steps": 100}
    if back:
        flip = lambda x: -x if eqx.is_array(x) else x
        options["saveat"] = jax.tree.map(flip, SAVED[saved])
    t1 = -12.0 if back else 12.0
    own, theirs = (
        solve(kepler(), 0.3, TS, adjoint, t1=t1, **options) for adjoint in (OWN, THEIRS)
    )
    assert own.stats["num_steps"] == theirs.stats["num_steps"]
    both = [jax.tree.leaves((sol.ts, sol.ys)) for sol in (own, theirs)]
    for x, y in zip(*both, strict=True):
        # Within steps the one is a polynomial, the other a shorter step.
        atol = 1e-8 if x.shape == (7, 2) else 1e-10
        np.testing.assert_allclose(x, y, atol=atol)


# Gradients.

AT = np.array([0.02, 0.9, 1.1])  # friction, and factors of the state
# Between steps, in one step, near the ends, and at the ends.
TIMES = np.array([0.0, 0.02, 0.3, 1.0, 2.95, 2.96, 3.0, 5.0, 8.9, 8.99, 9.0])


def loss(adjoint):
    def of(x):
        q0, p0 = x[1] * START[0], x[2] * START[1]
        ys = solve(kepler(x[0]), 0.2, TIMES, adjoint, y0=(q0, p0)).ys
        return jnp.sum(ys[0] ** 3 + ys[0]) + jnp.sum(ys[1] ** 2)

    return jax.jit(of)


WAYS = {"reversal": OWN, "checkpoints": dps.FixedStepAdjoint("checkpoints")}


@pytest.mark.parametrize("way", WAYS)
def test_gradients_are_those_of_the_saved_values(way):
    fn = loss(WAYS[way])
    slope = lambda e, h: (fn(AT + h * e) - fn(AT - h * e)) / (2 * h)
    wanted = [(4 * slope(e, 1e-5) - slope(e, 2e-5)) / 3 for e in np.eye(3)]
    np.testing.assert_allclose(jax.grad(fn)(AT), wanted, rtol=1e-8)


@pytest.mark.variants(1)
@pytest.mark.parametrize("way", WAYS)
def test_gradients_of_the_ends_of_steps_and_of_their_times(way):
    """Times depend on the states before them."""
    saveat = dfx.SaveAt(steps=2, t1=True, fn=lambda t, y, args: (y, t * y[0]))
    reached = lambda x: jnp.where(jnp.isfinite(x), x, 0)

    @jax.jit
    def fn(x):
        y0 = x[1] * START[0], x[2] * START[1]
        options = {"y0": y0, "saveat": saveat, "max_steps": 300}
        sol = solve(kepler(x[0]), 0.3, TS, WAYS[way], **options)
        squares = [jnp.sum(reached(y) ** 2) for y in jax.tree.leaves(sol.ys)]
        return sum(squares) + jnp.sum(reached(sol.ts) ** 3)

    slope = lambda e, h: (fn(AT + h * e) - fn(AT - h * e)) / (2 * h)
    wanted = [(4 * slope(e, 1e-5) - slope(e, 2e-5)) / 3 for e in np.eye(3)]
    np.testing.assert_allclose(jax.grad(fn)(AT), wanted, rtol=1e-7)
    many = jnp.stack([AT, 1.1 * AT])
    each = [jax.grad(fn)(x) for x in many]
    np.testing.assert_allclose(jax.vmap(jax.grad(fn))(many), each, rtol=1e-10)


def test_the_time_at_which_the_most_steps_end_has_derivatives():
    """It depends on the states, unlike the end of a complete solve."""
    saveat = dfx.SaveAt(t1=True, fn=lambda t, y, args: t**2)

    def end(q, adjoint):
        options = {"saveat": saveat, "max_steps": 20, "throw": False}
        y0 = q, START[1]
        sol = solve(kepler(), 0.1, [9.0], adjoint, y0=y0, **options)
        return sol.ts[-1] + sol.ys[-1]

    own, other = (jax.grad(end)(START[0], adjoint) for adjoint in (OWN, THEIRS))
    assert jnp.max(jnp.abs(other)) > 0.1
    np.testing.assert_allclose(own, other, rtol=1e-9)


# Values within steps, by polynomials or by shorter steps.


def damped(law, ts, y0=START, adjoint=OWN, solver=None, **options):
    potential = lambda t, q, args: jnp.sum(q**2) / 2 + jnp.sum(q**4) / 8
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential, law, **options)
    # The steps differ by a factor of more than two.
    density = lambda t, y, args: 1 / (1 + jnp.sum(y[0] ** 2))
    return diffeqsolve(
        *(system, solver or dps.BlanesMoanRKN4(), 0.0, 12.0, None, y0),
        stepsize_controller=dps.StepDensityController(0.3, density),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=adjoint,
        max_steps=200,
    )


of_place = dps.PositionDamping(lambda t, q, args: 0.1 * jnp.sum(q**2))
# And of 81 values the least and the most that are interpolated; and the error.
LAWS = {
    "none": (None, 70, 80, 1e-6),
    "a constant": (dps.ConstantDamping(0.2), 70, 80, 1e-6),
    "of time": (lambda t: 0.3 / (1 + t), 70, 80, 2e-6),
    "strong at first": (dps.LogDamping(9.0, 1.0), 20, 70, 1e-6),
    "singular at first": (dps.LogDamping(3.0, 0.0), 30, 79, 1e-6),
    "of place": (of_place, 0, 0, 3e-6),
    "always strong": (dps.ConstantDamping(9.0), 0, 0, 3e-6),
}


@pytest.mark.variants(7)
@pytest.mark.parametrize("name", LAWS)
def test_values_within_steps_by_polynomials_where_these_follow(name):
    (law, least, most, atol), ts = LAWS[name], jnp.linspace(0.0, 12.0, 81)
    y0 = (START[0], 0 * START[1]) if name == "singular at first" else START
    solver = dps.BlanesMoan4() if name == "of place" else None
    own, other = (damped(law, ts, y0, adjoint, solver) for adjoint in (OWN, THEIRS))
    assert own.result == dfx.RESULTS.successful
    assert least <= int(own.stats["interpolated"]) <= most
    for x, y in zip(own.ys, other.ys, strict=True):
        np.testing.assert_allclose(x, y, 0, atol)


def test_schemes_up_to_order_two_and_constraints_take_shorter_steps():
    ts = jnp.linspace(0.0, 12.0, 41)
    sol = damped(None, ts, solver=dps.PresymplecticLeapfrog())
    assert sol.stats["interpolated"] == 0
    on_circle = dps.ConstrainedSystem(
        dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: q[1]),
        lambda t, q, args: q @ q - 1,
    )
    solved = diffeqsolve(
        *(on_circle, dps.Suzuki4(dps.Strang()), 0.0, 4.0, None),
        (jnp.array([1.0, 0.0]), jnp.zeros(2)),
        stepsize_controller=dps.StepDensityController(0.2, lambda t, y, args: 1.0),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.1, 3.9, 20)),
        adjoint=OWN,
    )
    assert solved.stats["interpolated"] == 0
    np.testing.assert_allclose(jnp.sum(solved.ys[0] ** 2, axis=1), 1, 1e-13)


@pytest.mark.variants(1)
@pytest.mark.parametrize("way", WAYS)
def test_gradients_where_some_values_are_shorter_steps(way):
    """Alone, and in a batch of which one member takes none, and one no other."""
    ts = jnp.linspace(0.1, 11.9, 47).at[jnp.array([3, 30])].set(jnp.nan)

    def total(x):
        rate, shift, size = x
        y0 = size * START[0], START[1]
        sol = damped(dps.LogDamping(rate, shift), ts, y0, WAYS[way])
        ys = jnp.concatenate(sol.ys, axis=1)
        weights = jnp.cos(jnp.arange(ys.size, dtype=float)).reshape(ys.shape)
        loss = jnp.sum(jnp.where(jnp.isfinite(ys), ys, 0.0) * weights)
        return loss, (ys, sol.stats["interpolated"])

    members = jnp.array([[9.0, 1.0, 1.0], [0.5, 1.0, 0.8], [900.0, 80.0, 1.2]])
    number = check_members(total, members, 1e-11)
    assert number[1] == 45 and 0 < number[0] < 45 and number[2] == 0


AT_ENDS = {
    "leapfrog": dps.PresymplecticLeapfrog(),
    "RKN4": dps.BlanesMoanRKN4(),
    "constrained": dps.Strang(),
}


@pytest.mark.variants(1)
@pytest.mark.parametrize("solver", AT_ENDS)
@pytest.mark.parametrize("way", WAYS)
def test_gradients_of_a_value_saved_where_a_step_ends(way, solver):
    """Such an end moves with the state, and the time does not: as near beside it."""
    density = lambda t, y, args: 1 / (1 + jnp.sum(y[1] ** 2))
    system = kepler(0.1)
    if solver == "constrained":
        circle = lambda t, q, args: q @ q - 1
        free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: q[1])
        system = dps.ConstrainedSystem(free, circle)

    def momentum(q, **options):
        return diffeqsolve(
            *(system, AT_ENDS[solver], 0.0, 1.0, None),
            y0=(jnp.array([1.0, 0.0]), q * jnp.array([0.0, 1.1])),
            stepsize_controller=dps.StepDensityController(0.1, density),
            **{"max_steps": 50, "adjoint": WAYS[way]} | options,
        )

    saved = lambda ts: {"saveat": dfx.SaveAt(ts=ts)}
    rows = lambda q, ts: momentum(q, **saved(ts)).ys[1][:, 0]
    every = momentum(1.0, saveat=dfx.SaveAt(steps=True))
    ts = jnp.asarray(every.ts)[jnp.array([0, 4, 9])]
    d = 1e-5
    wanted = (rows(1 + d, ts) - rows(1 - d, ts)) / (2 * d)
    # A shorter step has another slope before the end of a step than after it.
    tolerance = (1e-6, 0) if solver == "RKN4" else (0, 3e-4)
    np.testing.assert_allclose(jax.jacrev(rows)(1.0, ts), wanted, *tolerance)
    batch = jax.vmap(jax.jacrev(rows), (0, 0))(jnp.ones(2), jnp.stack([ts, ts + 1e-3]))
    np.testing.assert_allclose(batch[0], wanted, *tolerance)
    # A solve that ends at the last of them has it too.
    short = momentum(1.0, max_steps=10, throw=False, **saved(ts))
    np.testing.assert_allclose(short.ys[1][:, 0], rows(1.0, ts), 1e-13)
