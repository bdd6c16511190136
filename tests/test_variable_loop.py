"""Steps that vary in the loop of the package: those of Diffrax, and gradients."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close
from variable import control, DISTANCE, KEPLER, last, LEAPFROG, solve, succeeds, Y0

import diffrax_presym as dps


OWN = dps.FixedStepAdjoint()
DRAGGED = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -args / jnp.linalg.norm(q),
    dps.LogDamping(1.0, shift=20.0),
)


def test_the_clock_is_not_rounded_where_its_precision_is_low():
    # A circle in single precision, from a time of which a step has few digits.
    t0, t1 = jnp.float32(1e4), jnp.float32(1e4 + 100)
    y0 = jnp.array([1.0, 0.0], jnp.float32), jnp.array([0.0, 1.0], jnp.float32)
    saveat = dfx.SaveAt(ts=jnp.array([1e4 + 37, 1e4 + 100], jnp.float32))
    step, solver = control(0.3, DISTANCE), dps.Compensated(dps.TunedRKN6())
    sol = solve(step, solver, t0, t1, y0, adjoint=OWN, saveat=saveat, max_steps=None)
    assert succeeds(sol)
    angle = np.asarray(sol.ts, float) - 1e4
    exact = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert_close(np.asarray(sol.ys[0]), exact, 1e-4)


def saved(adjoint, solver=None, density=DISTANCE, sign=1, e=0.6, **kwargs):
    """An orbit with friction from its apocentre, at 30 times, as a function of what it
    depends on."""
    ts = sign * jnp.linspace(0.1, 9.0, 30)

    def states(epsilon, mass, p0):
        q0 = jnp.array([1 + e, 0.0])
        p0 = p0 * jnp.array([0.1, 1.0]) * ((1 - e) / (1 + e)) ** 0.5
        run = partial(solve, control(epsilon, density), solver or dps.BlanesMoanRKN6())
        y0, saveat = (q0, p0), dfx.SaveAt(ts=ts, t1=True)
        options = dict(args=mass, adjoint=adjoint, saveat=saveat) | kwargs
        return run(0.0, ts[-1], y0, DRAGGED, **options)

    return states


AT = jnp.array(0.2), jnp.array(1.0), jnp.array([1.0, 0.9])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "solver",
    [
        LEAPFROG,
        dps.TunedRKN6(),
        dps.BlanesMoan4(),
        dps.PresymplecticGauss(3),
        dps.Compensated(dps.BlanesMoanRKN4()),
    ],
)
def test_the_loop_of_the_package_takes_the_steps_of_diffrax(solver, sign):
    run = lambda adjoint: saved(adjoint, solver, sign=sign)(*AT)
    ours, theirs = map(run, (OWN, dfx.RecursiveCheckpointAdjoint()))
    assert succeeds(ours) and int(ours.stats["num_steps"]) > 30
    assert ours.stats["num_steps"] == theirs.stats["num_steps"]
    assert_close(last(ours.ys), last(theirs.ys), 1e-12)
    # Between steps each is of the order of the scheme, with errors of its own.
    order = solver.order(None)
    assert_close(ours.ys, theirs.ys, {2: 1e-2, 4: 1e-3, 6: 1e-5}[order])


@pytest.mark.variants(1)
@pytest.mark.parametrize(
    "adjoint",
    [
        OWN,
        dps.FixedStepAdjoint(checkpoints=0),
        dps.FixedStepAdjoint(checkpoints=5),
        dps.FixedStepAdjoint("checkpoints"),
    ],
)
@pytest.mark.parametrize("density", [DISTANCE, DRAGGED])
def test_gradients_in_the_loop_of_the_package(adjoint, density):
    """Of the discrete solution, with the dependence of the steps on the states: those
    of Diffrax through the same steps, and central differences."""

    def loss(*args, adjoint=adjoint):
        ys = saved(adjoint, density=density)(*args).ys
        return jnp.sum(jnp.sin(ys[0])) + jnp.sum(ys[1] ** 2)

    got = jax.grad(loss, argnums=(0, 1, 2))(*AT)
    at_ends = lambda *args, adjoint=adjoint: jnp.sum(
        last(saved(adjoint, density=density)(*args).ys)[0]
    )
    theirs = partial(at_ends, adjoint=dfx.RecursiveCheckpointAdjoint())
    gradient = lambda fn: jax.grad(fn, argnums=(0, 1, 2))(*AT)
    assert_close(gradient(at_ends), gradient(theirs), 1e-6)
    loss = jax.jit(loss)
    for i, x in enumerate(AT):
        for k in range(x.size):
            h = 1e-5 * jnp.zeros(x.size).at[k].set(1.0).reshape(x.shape)
            up, down = (
                loss(*[y + s * h if i == j else y for j, y in enumerate(AT)])
                for s in (1.0, -1.0)
            )
            assert_close(jnp.ravel(got[i])[k], (up - down) / 2e-5, 1e-5)


def test_gradients_of_orbits_of_different_eccentricity():
    def loss(e, adjoint=OWN):
        sol = saved(adjoint, e=e, throw=True)(*AT)
        return jnp.sum(sol.ys[0] ** 2), sol.stats["num_steps"]

    es = jnp.linspace(0.0, 0.95, 16)
    batch = jax.vmap(jax.value_and_grad(loss, has_aux=True))
    (values, steps), gradients = batch(es)
    assert len(set(np.asarray(steps).tolist())) > 8
    for i in (0, 7, 15):
        (value, _), gradient = jax.value_and_grad(loss, has_aux=True)(es[i])
        assert_close((values[i], gradients[i]), (value, gradient), 1e-8)


def test_gradients_of_many_steps_take_constant_memory():
    controller = control(0.01, DISTANCE)

    def end(p, max_steps):
        sol = solve(
            *(controller, LEAPFROG, 0.0, 500.0, (Y0[0], p * Y0[1])),
            **{"adjoint": OWN, "max_steps": max_steps, "throw": True},
        )
        return jnp.sum(sol.ys[0]), sol.stats["num_steps"]

    program = jax.jit(jax.value_and_grad(end, has_aux=True), static_argnums=1)
    compiled = program.lower(jnp.array(1.0), None).compile()
    memory: Any = compiled.memory_analysis()
    assert memory.temp_size_in_bytes < 1e5
    (_, steps), gradient = compiled(jnp.array(1.0))
    assert steps > 40_000
    h = 1e-7
    up, down = (end(jnp.array(1.0 + x), None)[0] for x in (h, -h))
    assert_close(gradient, (up - down) / (2 * h), 1e-4)


def test_a_step_for_a_tolerance():
    ts = jnp.linspace(0.0, 9.0, 31)

    @eqx.filter_jit
    def run(epsilon):
        return dfx.diffeqsolve(
            *(DRAGGED, dps.TunedRKN6(), 0.0, 9.0, None, Y0),
            args=1.0,
            stepsize_controller=control(epsilon, DRAGGED),
            saveat=dfx.SaveAt(ts=ts),
            adjoint=OWN,
            max_steps=None,
        )

    step = dps.choose_step(run, 0.0, 9.0, rtol=1e-7, atol=1e-7)
    sol: Any = run(step.dt0)
    assert step.steps == sol.stats["num_steps"] and not step.on_grid
    vf = jax.jit(lambda t, y: jnp.concatenate(DRAGGED.vf(t, (y[:2], y[2:]), 1.0)))
    exact = scipy.integrate.solve_ivp(
        *(vf, (0, 9), np.concatenate(Y0), "DOP853", np.asarray(ts)),
        rtol=1e-12,
        atol=1e-12,
    )
    error = np.abs(np.hstack(sol.ys) - exact.y.T) / (1e-7 + 1e-7 * np.abs(exact.y.T))
    assert 0.05 < np.max(error) < 1.5


@pytest.mark.parametrize("adjoint", [OWN, dfx.RecursiveCheckpointAdjoint()], ids=str)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_solve_goes_back_from_an_end_inside_of_a_step(adjoint, sign):
    step, saveat = control(0.2, KEPLER), dfx.SaveAt(steps=True, controller_state=True)
    run = partial(solve, step, dps.BlanesMoanRKN4(), adjoint=adjoint, saveat=saveat)
    t1, most = sign * 3.7, 100
    there = run(0.0, t1, Y0, max_steps=most)
    n = int(there.stats["num_steps"])
    h = np.diff(there.ts[:n])
    # Cut off by more than steps change.
    assert abs(h[-1]) < 0.95 * abs(step.step_size(there.controller_state))
    y1 = jax.tree.map(lambda y: y[n - 1], there.ys)
    state = step.reverse(jnp.asarray(t1), y1, None, there.controller_state)
    back = run(
        *(t1, 0.0, y1), dt0=-jnp.asarray(h[-1]), controller_state=state, max_steps=most
    )
    assert_close(back.ts[: n - 1], there.ts[: n - 1][::-1], 1e-9)
    rows = lambda ys, which: jax.tree.map(lambda y: y[which], ys)
    before, after = slice(n - 2, None, -1), slice(0, n - 1)
    assert_close(rows(back.ys, after), rows(there.ys, before), 1e-9)
    assert_close(rows(back.ys, n - 1), Y0, 1e-9)

    def end(p, adjoint):
        options: Any = dict(dt0=-jnp.asarray(h[-1]), controller_state=state)
        y = y1[0], p * y1[1]
        sol = solve(
            *(step, dps.BlanesMoanRKN4(), t1, 0.0, y),
            **(options | dict(adjoint=adjoint, max_steps=most)),
        )
        return jnp.sum(sol.ys[0])

    found, wanted = (jax.grad(end)(1.0, x) for x in (adjoint, OWN))
    d = 1e-6
    slope = (end(1 + d, adjoint) - end(1 - d, adjoint)) / (2 * d)
    assert found == pytest.approx(float(wanted), rel=1e-6)
    assert found == pytest.approx(float(slope), rel=1e-5)
