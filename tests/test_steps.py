"""Times at the edge: steps that are infinite or end elsewhere, gaps in saved times."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import diffrax_presym as dps
from diffrax_presym._loop._steps import Steps


OWN = dps.FixedStepAdjoint()
SPLIT = dps.StepsBetween(-jnp.ones(1))
PENDULUM = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    dps.ConstantDamping(0.1),
)

QUARTIC = dps.MechanicalSystem(
    dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q**4) / 4
)


def solve(dt0: Any = 0.1, *, size=1, solver=None, **options) -> Any:
    y0 = jnp.full(size, 1.0), jnp.full(size, 0.3)
    options = {"max_steps": 100, "throw": False, "adjoint": OWN} | options
    solver = dps.TunedRKN6() if solver is None else solver
    return dfx.diffeqsolve(PENDULUM, solver, 0.0, 1.0, dt0, y0, **options)


def exact(t):
    field = lambda t, y: [y[1], -np.sin(y[0]) - 0.1 * y[1]]
    sol = solve_ivp(field, (0, 1), [1.0, 0.3], rtol=1e-12, atol=1e-12, t_eval=t)
    return sol.y


@pytest.mark.parametrize("adjoint", [OWN, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize(
    "controller, steps",
    [(dfx.ConstantStepSize(), 1), (dps.StepsBetween(jnp.linspace(0.0, 1.0, 5)), 4)],
)
def test_an_infinite_step_is_as_long_as_it_can_be(adjoint, controller, steps):
    sol = solve(jnp.inf, stepsize_controller=controller, adjoint=adjoint)
    assert sol.result == dfx.RESULTS.successful and sol.stats["num_steps"] == steps
    np.testing.assert_allclose(np.ravel(sol.ys), exact([1.0])[:, 0], atol=1e-6)


@pytest.mark.parametrize("dt0, t1", [(0.0, 1.0), (0.1, jnp.inf), (0.1, jnp.nan)])
def test_a_solve_that_never_ends_fails_at_once(dt0, t1):
    y0 = jnp.ones(1), jnp.ones(1)

    def end(dt0, t1, throw=False) -> Any:
        args = PENDULUM, dps.TunedRKN6(), 0.0, t1, dt0, y0
        return dfx.diffeqsolve(*args, max_steps=None, adjoint=OWN, throw=throw)

    several = jnp.array([dt0, 0.1]), jnp.array([t1, 1.0])
    sol, one = jax.vmap(end)(*several), end(0.1, 1.0)
    np.testing.assert_array_equal(sol.stats["num_steps"], [0, 10])
    success = sol.result == dfx.RESULTS.successful
    np.testing.assert_array_equal(success, [False, True])
    np.testing.assert_allclose(sol.ys[0][1], one.ys[0], rtol=1e-14)
    with pytest.raises(eqx.EquinoxRuntimeError, match="max_steps"):
        end(dt0, t1, throw=True)


@pytest.mark.parametrize("adjoint", [OWN, dfx.RecursiveCheckpointAdjoint()])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("sign", [1, -1])
def test_between_regular_times_there_is_one_step(adjoint, dtype, sign):
    """Whose length is that between the times, but for their rounding."""
    times = sign * np.linspace(0.0, 100.0, 2001).astype(dtype)
    sol = dfx.diffeqsolve(
        *(PENDULUM, dps.PresymplecticLeapfrog(), times[0], times[-1]),
        *(jnp.asarray(sign * 0.05, dtype), 2 * (jnp.ones(1, dtype),)),
        stepsize_controller=dps.StepsBetween(times[::-1]),
        **{"adjoint": adjoint, "max_steps": 4000},  # pyright: ignore
    )
    assert sol.stats["num_steps"] == 2000


@pytest.mark.variants(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=lambda x: x.__name__)
@pytest.mark.parametrize(
    "t0, t1, dt0", [(0.0, 1.0, 0.1), (0.3, 7.8, 0.3), (-2.0, 5.0, 7.0)]
)
def test_steps_are_found_again_to_rounding(t0, t1, dt0, dtype):
    t0, t1, dt0 = (jnp.asarray(t, dtype) for t in (t0, t1, dt0))
    y0, saveat = (jnp.ones(1, dtype),) * 2, dfx.SaveAt(t0=True, steps=True)
    args = QUARTIC, dps.PresymplecticLeapfrog(), t0, t1, dt0, y0
    sol = dfx.diffeqsolve(*args, saveat=saveat, max_steps=32)
    n = int(sol.stats["num_steps"])
    with jax.numpy_dtype_promotion("standard"):  # as within `diffeqsolve`
        steps = Steps(t0, t1, dt0)
        times = steps.time(jnp.arange(n + 1))
        middle = (times[:-1] + times[1:]) / 2
        starts, inside = steps.locate(times)
        assert jnp.all(starts == jnp.arange(n + 1)) and not jnp.any(inside)
        between, inside = steps.locate(middle)
        assert jnp.all(between == jnp.arange(n)) and jnp.all(inside)
    ulp = jnp.finfo(dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    assert sol.ts is not None and n > 0
    assert jnp.all(jnp.abs(sol.ts[: n + 1] - times) <= 2 * ulp)
    assert sol.ts[0] == times[0] and sol.ts[n] == times[n] and steps.total == n


@pytest.mark.parametrize("dt0", [jnp.nan, -jnp.inf])
def test_a_step_that_is_no_step(dt0):
    try:
        assert solve(jnp.asarray(dt0)).result != dfx.RESULTS.successful
    except RuntimeError as error:
        assert "dt0" in str(error)


@pytest.mark.parametrize("saveat", [{"t1": True}, {"ts": jnp.linspace(-1.0, 0.0, 5)}])
@pytest.mark.parametrize("controller", [dfx.ConstantStepSize(), SPLIT])
def test_no_solve_from_a_time_that_is_not_finite(saveat, controller):
    sol: Any = dfx.diffeqsolve(
        dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: q @ q),
        *(dps.BlanesMoanRKN4(), -jnp.inf, 0.0, 0.1, (jnp.ones(2), jnp.zeros(2))),
        **{"max_steps": None, "throw": False, "adjoint": dps.FixedStepAdjoint()},
        **{"saveat": dfx.SaveAt(**saveat), "stepsize_controller": controller},
    )
    assert sol.result == dfx.RESULTS.nonfinite  # pyright: ignore
    assert sol.stats["num_steps"] == 0


def test_times_in_a_list_are_an_error():
    with pytest.raises(ValueError, match=r"an array, but got a list.*`jnp.array"):
        dps.StepsBetween([0.1, 0.2])


@pytest.mark.parametrize("ts", [[0.0, 0.25, 0.5], [0.5, 0.75, 1.0], [-0.5, 0.5, 1.0]])
def test_prescribed_steps_are_from_the_start_to_the_end(ts):
    with pytest.raises(Exception, match="must be `t0` and `t1`"):
        sol = solve(None, stepsize_controller=dfx.StepTo(ts=jnp.array(ts)))
        jax.block_until_ready(sol.ys)


TIMES = np.array([0.1, np.nan, 0.33, np.nan, np.nan, 0.5, 1.0])
GAPS = np.isnan(TIMES)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"size": 300},  # outputs one by one
        {"solver": dps.PresymplecticGauss(2)},
        {"adjoint": dps.FixedStepAdjoint("checkpoints")},
    ],
    ids=str,
)
def test_gaps_in_the_saved_times(options):
    def saved(k, ts):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(k), PENDULUM.potential, PENDULUM.friction
        )
        size, solver = options.get("size", 1), options.get("solver", dps.TunedRKN6())
        return dfx.diffeqsolve(
            *(system, solver, 0.0, 1.0, 0.05, (jnp.ones(size), jnp.full(size, 0.3))),
            saveat=dfx.SaveAt(ts=ts, t1=True),
            adjoint=options.get("adjoint", OWN),
            max_steps=64,
        )

    sol: Any = jax.jit(saved)(1.0, jnp.asarray(TIMES))
    q, p = (np.asarray(x[:-1, 0]) for x in sol.ys)
    assert np.all(np.isinf(q[GAPS]) & np.isinf(p[GAPS]) & np.isinf(sol.ts[:-1][GAPS]))
    at = exact(TIMES[~GAPS])
    np.testing.assert_allclose([q[~GAPS], p[~GAPS]], at, atol=2e-6)

    def loss(k, ts):
        ys: Any = saved(k, ts).ys
        return sum(jnp.sum(jnp.where(jnp.isfinite(y), y, 0) ** 2) for y in ys)

    slopes = jax.jit(jax.grad(loss))
    alone = slopes(1.0, jnp.asarray(TIMES[~GAPS]))
    np.testing.assert_allclose(slopes(1.0, jnp.asarray(TIMES)), alone, rtol=1e-10)
    assert np.isfinite(alone)


NONFINITE: Any = dfx.RESULTS.nonfinite  # pyright: ignore


def too_long(t1, dt0, **options) -> Any:
    args = QUARTIC, dps.TunedRKN6(), 0.0, t1, dt0, (jnp.array([1.0]), jnp.zeros(1))
    return dfx.diffeqsolve(*args, **({"throw": False, "adjoint": OWN} | options))


def test_a_solve_ends_at_the_next_saved_time_after_it_has_failed():
    """Of an explicit scheme, whose steps between are not checked."""
    ts = dfx.SaveAt(ts=jnp.arange(0.0, 1001.0, 50.0))
    sol = too_long(1000.0, 10.0, saveat=ts)
    assert sol.result == NONFINITE
    assert sol.stats["num_steps"] <= 10
    assert np.all(np.isinf(sol.ts[3:])) and np.all(np.isinf(sol.ys[0][3:]))


@pytest.mark.parametrize("solver", [dps.BlanesMoanRKN4(), dps.TunedRKN6()])
def test_derivatives_that_are_not_finite_at_the_end_of_a_step_are_a_failure(solver):
    """The states are finite, but what is interpolated from there is not."""
    potential = lambda t, q, args: jnp.sum(jnp.abs(q) ** 1.5)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    y0 = jnp.zeros(2), jnp.array([1.0, 0.0])

    def result(**options):
        args: Any = system, solver, 0.0, 10.0, 0.1, y0
        return dfx.diffeqsolve(*args, adjoint=OWN, throw=False, **options).result

    assert result() == dfx.RESULTS.successful
    at_steps = dfx.SaveAt(ts=jnp.arange(10.0))
    assert result(saveat=at_steps) == dfx.RESULTS.successful
    assert result(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 10.0, 33))) == NONFINITE


@pytest.mark.parametrize("adjoint", [OWN, dfx.RecursiveCheckpointAdjoint()])
def test_a_step_that_is_too_long_is_a_failure(adjoint):
    sol = too_long(1000.0, 25.0, adjoint=adjoint)
    assert sol.result == NONFINITE and not np.all(np.isfinite(sol.ys[0]))
    with pytest.raises(RuntimeError, match=r"[Nn]onfinite"):
        too_long(1000.0, 25.0, adjoint=adjoint, throw=True)


def test_an_infinite_span():
    sol = too_long(jnp.inf, 0.1, max_steps=30)
    assert sol.result == dfx.RESULTS.max_steps_reached
    assert sol.stats["num_steps"] == 30


@pytest.mark.parametrize("sign", [1, -1])
def test_times_of_steps_between_that_are_not_known_to_be_numbers(sign):
    @jax.jit
    def end(times):
        controller = dps.StepsBetween(sign * times)
        more: Any = dict(adjoint=OWN, stepsize_controller=controller, max_steps=None)
        span, y0 = (0.0, sign * 1.0, sign * 0.1), (jnp.ones(1), jnp.zeros(1))
        return dfx.diffeqsolve(PENDULUM, dps.TunedRKN6(), *span, y0, **more).ys

    gaps = end(jnp.array([jnp.nan, 0.37, jnp.nan]))
    np.testing.assert_array_equal(gaps, end(jnp.array([-1.0, 0.37, 2.0])))


@pytest.mark.parametrize("jit", [False, True])
def test_gradients_through_prescribed_steps_without_a_limit_of_their_number(jit):
    ts = jnp.array([0.0, 0.3, 0.5, 1.1, 1.5])

    def end(p, max_steps=None):
        options: Any = dict(stepsize_controller=dfx.StepTo(ts), max_steps=max_steps)
        y0, solver = (jnp.ones(1), jnp.full(1, p)), dps.TunedRKN6()
        sol: Any = dfx.diffeqsolve(
            *(PENDULUM, solver, 0.0, 1.5, None, y0),
            adjoint=OWN,
            **options,
        )
        return jnp.sum(sol.ys[0])

    wrap = jax.jit if jit else lambda fn: fn
    slope, d = wrap(jax.grad(end))(0.3), 1e-5
    np.testing.assert_allclose(slope, jax.grad(end)(0.3, max_steps=9), 1e-13)
    np.testing.assert_allclose(slope, (end(0.3 + d) - end(0.3 - d)) / (2 * d), 1e-9)
