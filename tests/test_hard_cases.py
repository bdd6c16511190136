"""The hard cases, scaled down: bounds are measured values with a small margin."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, harmonic, henon_heiles, mixed_energy, solve

import diffrax_presym as dps


LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
REST = (jnp.ones(1), jnp.zeros(1))
# Older versions of Optimistix have no such result.
NONFINITE = getattr(dfx.RESULTS, "nonfinite", dfx.RESULTS.nonlinear_divergence)


def conservative(potential, mass=None):
    return dps.MechanicalSystem(dps.QuadraticKinetic(mass), potential)


def damped(potential, damping):
    return dps.ConformalHamiltonian(dps.QuadraticKinetic(), potential, damping)


def last(sol):
    return jax.tree.map(lambda x: np.asarray(x[-1]), sol.ys)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("solver", [LEAPFROG, RKN4], ids=["leapfrog", "RKN4"])
def test_no_overflow_of_the_frame(dtype, solver):
    # exp(1000) overflows in both precisions; only the slow mode remains.
    y0 = jax.tree.map(lambda x: x.astype(dtype), REST)
    t1, dt0, gamma = (jnp.asarray(x, dtype) for x in (50.0, 0.025, 20.0))
    system = damped(harmonic, dps.ConstantDamping(gamma))
    q, p = last(solve(system, solver, 0 * t1, t1, dt0, y0))
    slow = 10 - (100 - 1) ** 0.5
    exact = (1 + slow / (20 - 2 * slow)) * np.exp(-slow * 50)
    assert abs(q[0] / exact - 1) < 0.06
    assert q.dtype == dtype and np.isfinite(p[0])


def test_excitation_grows_until_overflow_is_physical():
    y0 = jax.tree.map(lambda x: x.astype(jnp.float32), REST)
    system = damped(harmonic, dps.ConstantDamping(-1.0))
    ends = []
    for t1 in (100.0, 250.0):
        t0, t1, dt0 = (jnp.float32(t) for t in (0.0, t1, 0.05))
        ends.append(solve(system, LEAPFROG, t0, t1, dt0, y0, throw=False))
    # exp(50) is finite in float32, and exp(125) is not.
    assert ends[0].result == dfx.RESULTS.successful
    assert ends[1].result == NONFINITE


@pytest.mark.parametrize("h, stable", [(1.999, True), (2.001, False)])
def test_leapfrog_is_stable_up_to_two(h, stable):
    q, _ = last(solve(conservative(harmonic), LEAPFROG, 0.0, 3000 * h, h, REST))
    assert (np.abs(q[0]) < 100) == stable


def test_no_drift_in_1e5_steps():
    # The step is a power of two, so times are exact. The error is bounded by that of
    # the scheme throughout; rounding errors are far smaller.
    system = conservative(harmonic)
    term = system
    saveat = dfx.SaveAt(steps=True)
    solver = dps.Substeps(LEAPFROG, 50)
    sol = solve(system, solver, 0.0, 12500.0, 6.25, REST, saveat=saveat)
    assert sol.ts is not None and sol.ys is not None
    energy = dps.diagnostics.energy(
        term, sol.ts[:2000], jax.tree.map(lambda x: x[:2000], sol.ys)
    )
    error = np.abs(np.asarray(energy) - 0.5)
    assert error.max() < 0.125**2 / 4
    assert error[-200:].max() < 1.01 * error[:200].max()
    # The modified energy, which the leapfrog preserves to rounding.
    q, p = (np.asarray(x[:2000, 0]) for x in sol.ys)
    kept = p**2 + q**2 * (1 - 0.125**2 / 4)
    assert np.abs(kept - kept[0]).max() < 1e-13


def test_ensemble_of_chaos():
    # Henon-Heiles at energy 1/8: two schemes, different trajectories, equal means.
    key = jax.random.key(0)
    q0 = 0.1 * jax.random.normal(key, (100, 2))
    p0 = jax.random.normal(jax.random.fold_in(key, 1), (100, 2))
    left = 1 / 8 - jax.vmap(lambda q: henon_heiles(0.0, q, None))(q0)
    p0 *= jnp.sqrt(2 * left / jnp.sum(p0**2, axis=1))[:, None]
    term = conservative(henon_heiles)

    @eqx.filter_jit
    def means(solver, dt0):
        saveat = dfx.SaveAt(steps=True, fn=lambda t, y, args: jnp.sum(y[0] ** 2))
        one = lambda q, p: (
            dfx.diffeqsolve(
                term, solver, 0.0, 200.0, dt0, (q, p), saveat=saveat, max_steps=2000
            ).ys
        )
        return jax.vmap(one)(q0, p0)

    leapfrog = np.asarray(means(LEAPFROG, 0.1))[:, 500:]
    splitting = np.asarray(means(RKN4, 0.4))[:, 125:500]
    assert np.abs(leapfrog[:, -1] - splitting[:, -1]).max() > 0.01
    each = splitting.mean(axis=1)
    spread = each.std() / 10
    assert abs(leapfrog.mean() - each.mean()) < 4 * spread
    assert spread < 0.1 * each.mean()


@pytest.mark.parametrize("t0", [1e-6, 0.0])
@pytest.mark.parametrize(
    "solver, error",
    [
        (LEAPFROG, 2e-4),
        (dps.Suzuki4(), 2e-4),
        (dps.BlanesMoan4(), 2e-4),
        (RKN4, 2e-4),
        (dps.BlanesMoanRKN6(), 2e-4),
    ],
    ids=["leapfrog", "suzuki", "S6", "RKN4", "RKN6"],
)
def test_singular_damping_from_its_start(solver, error, t0):
    system = damped(harmonic, dps.LogDamping(3.0))
    q, p = last(solve(system, solver, t0, 1.0, (1 - t0) / 100, REST))
    assert abs(q[0] - 2 * 0.4400505857449335) < error  # 2 J_1(1)
    assert abs(p[0] + 2 * 0.11490348493190048) < 3 * error  # -2 J_2(1)


def test_stages_before_the_start_are_reported():
    system = damped(harmonic, dps.LogDamping(3.0))
    run = lambda solver: solve(system, solver, 1e-6, 1.0, 0.01, REST, throw=False)
    assert run(dps.PresymplecticYoshida4()).result == NONFINITE
    assert run(dps.Suzuki4()).result == dfx.RESULTS.successful


def test_kink():
    # Each crossing of the kink has an error of order h^2, of either sign.
    system = conservative(lambda t, q, args: jnp.sum(jnp.abs(q)))
    q, p = last(solve(system, LEAPFROG, 0.0, 20 * 4 * 2**0.5, 0.05, REST))
    assert abs(abs(q[0]) + p[0] ** 2 / 2 - 1) < 0.05


def test_bounces():
    system = conservative(lambda t, q, args: jnp.sum(q))
    above = lambda t, y, args, **kwargs: y[0][0]
    event = dfx.Event(above, optx.Newton(rtol=1e-10, atol=1e-10), direction=False)
    t, y = jnp.asarray(0.0), REST
    for _ in range(4):
        sol = solve(system, LEAPFROG, t, t + 10, 0.05, y, event=event)
        assert sol.ts is not None
        t, (q, p) = sol.ts[-1], last(sol)
        y = jnp.abs(q), -p
    assert abs(t - 2**0.5 * 7) < 1e-9


def test_damping_by_pieces():
    # Accurate if a step ends at the jump of the rate, and of order two otherwise.
    system = damped(harmonic, lambda t: jnp.maximum(t - 1.0, 0.0))
    y1 = np.array([np.cos(1.0), -np.sin(1.0)])
    matrix = jnp.array([[0.0, 1.0], [-1.0, -1.0]])
    exact = np.asarray(jax.scipy.linalg.expm(2 * matrix)) @ y1
    for steps, low, high in ((49, 0.0, 1e-7), (50, 1e-7, 1e-3)):
        times = jnp.linspace(0.0, 3.0, steps)
        sol = dfx.diffeqsolve(
            system,
            RKN4,
            0.0,
            3.0,
            None,
            REST,
            stepsize_controller=dfx.StepTo(times),
        )
        error = np.abs(np.concatenate(last(sol)) - exact).max()
        assert low < error < high


@pytest.mark.parametrize(
    "stiffness, mass",
    [
        (np.logspace(-8, 0, 9), None),
        (np.repeat([0.0, 1.0], 4), None),
        (np.logspace(-6, 6, 9), np.logspace(-6, 6, 9)),
    ],
    ids=["condition", "rank", "masses"],
)
def test_conditioning(stiffness, mass):
    # The modes are independent: the slow ones are as accurate as alone.
    stiffness = jnp.asarray(stiffness)
    mass = None if mass is None else jnp.asarray(mass)
    potential = lambda t, q, args: jnp.sum(args * q**2) / 2
    y0 = (jnp.ones(stiffness.size), jnp.zeros(stiffness.size))
    system = conservative(potential, mass)
    q, _ = last(solve(system, RKN4, 0.0, 100.0, 0.5, y0, stiffness))
    omega = np.sqrt(stiffness / (1 if mass is None else mass))
    assert_close(q, np.cos(omega * 100), 1e-3)


def broken(t, q, args):
    """Undefined for negative positions."""
    return -jnp.sum(jnp.sqrt(q))


def test_a_diverging_root_finder_is_reported():
    finder = optx.Newton(rtol=1e-12, atol=1e-12)
    solver = dps.PresymplecticLeapfrog("momentum", finder, 4)
    y0 = (jnp.array([0.3]), jnp.array([-1.0]))
    run = lambda **kwargs: solve(
        dps.Hamiltonian(mixed_energy), solver, 0.0, 20.0, 5.0, y0, **kwargs
    )
    assert run(throw=False).result != dfx.RESULTS.successful
    with pytest.raises(eqx.EquinoxRuntimeError):
        run()


def test_checked_with_its_wrappers():
    solver = dps.Substeps(dps.Compensated(LEAPFROG), 4)
    y0 = (jnp.array([0.3]), jnp.array([-2.0]))
    sol = solve(conservative(broken), solver, 0.0, 8.0, 0.5, y0, throw=False)
    assert sol.result == NONFINITE
    sol = solve(conservative(harmonic), solver, 0.0, 8.0, 0.5, y0)
    assert sol.result == dfx.RESULTS.successful
