"""The public diagnostics, against known values."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    harmonic,
    mixed_energy,
    oscillator,
    pendulum,
    trajectory,
)

import diffrax_presym as dps
from diffrax_presym import diagnostics
from diffrax_presym.diagnostics import energy_lost


Y0 = (jnp.array([1.0]), jnp.array([0.3]))
TERM = oscillator(0.2)


GAUSS = dps.PresymplecticGauss(1)
TS, YS = jnp.array([0.0, 0.5]), (jnp.ones((2, 1)), jnp.ones((2, 1)))


def driven(t, q, args):
    return pendulum(t, q, args) + args * jnp.sin(t) * jnp.sum(q)


DRIVEN = dps.MechanicalSystem(dps.QuadraticKinetic(), driven, dps.LogDamping(2.0))


def test_energies():
    ts, (q, p) = jnp.array([0.0, 3.0]), jnp.array([[[1.0], [2.0]], [[0.0], [1.0]]])
    energies = diagnostics.energy(TERM, ts, (q, p))
    assert_close(energies, jnp.array([0.5, 2.5]), 1e-15)


@pytest.mark.variants(1)
@pytest.mark.parametrize("term", [TERM, DRIVEN], ids=["damped", "driven"])
def test_energy_error_is_that_of_the_solver(term):
    def error(solver):
        sol = trajectory(term, solver, 1.0, 11.0, 1 / 64, Y0, 0.7)
        ts, q, p = map(jnp.asarray, sol)
        return diagnostics.energy_error(term, ts, (q, p), 0.7)

    fine, coarse = error(dps.BlanesMoanRKN6()), error(dps.PresymplecticEuler())
    assert np.max(np.abs(fine)) < 1e-8
    assert 1e-4 < np.max(np.abs(coarse)) < 1e-1
    assert fine[0] == 0 and fine.shape == (641,)


@pytest.mark.parametrize("balance", [diagnostics.energy_error, energy_lost])
def test_a_balance_goes_on_after_a_gap_in_measured_times(balance):
    gaps = np.array([0, 3, 4, 8])
    sol: Any = dfx.diffeqsolve(
        *(DRIVEN, dps.PresymplecticLeapfrog(), 1.0, 5.0, 0.05, Y0, 0.7),
        saveat=dfx.SaveAt(ts=jnp.linspace(1.0, 5.0, 9).at[gaps].set(jnp.nan)),
        adjoint=dps.FixedStepAdjoint(),
    )
    q, p = sol.ys
    kept = np.delete(np.arange(9), gaps)
    alone = balance(DRIVEN, sol.ts[kept], (q[kept], p[kept]), 0.7)
    found = balance(DRIVEN, sol.ts, (q, p), 0.7)[kept]
    assert found[0] == 0 and np.ptp(alone) > 2e-4
    np.testing.assert_allclose(found, alone, 0, 1e-13)
    assert not len(balance(DRIVEN, TS[:0], (YS[0][:0], YS[1][:0]), 0.7))


def test_energy_error_of_a_conserved_energy_is_its_change():
    term = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic)
    ts, ys = jnp.array([0.0, 1.0]), (jnp.array([[1.0], [2.0]]), jnp.zeros((2, 1)))
    error = diagnostics.energy_error(term, ts, ys)
    assert_close(error, jnp.array([0.0, 1.5]), 1e-15)


def test_energies_of_a_rigid_body():
    inertia = np.array([1.0, 1.5, 2.5])
    height = lambda t, q, args: 2 * dps.rotation_matrix(q)[2, 2]
    slowed = dps.ManifoldSystem(dps.Attitude(inertia), height, dps.ViscousDamping(0.2))
    y0 = jnp.array([0.8, 0.6, 0.0, 0.0]), jnp.array([0.5, -1.0, 2.0])
    ts = jnp.linspace(0.0, 2.0, 5)
    ys = dfx.diffeqsolve(
        *(slowed, dps.BlanesMoan6(), 0.0, 2.0, 0.05, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
    ).ys
    assert ys is not None
    power = diagnostics.power_lost(slowed, ts, ys)
    assert_close(power, 0.2 * np.sum((np.asarray(ys[1]) / inertia) ** 2, axis=1), 1e-14)
    energy, lost = (f(slowed, ts, ys) for f in (diagnostics.energy, energy_lost))
    assert lost[-1] > 0.1
    assert_close(energy[0] - energy, lost, 1e-8)
    assert np.max(np.abs(diagnostics.energy_error(slowed, ts, ys))) < 1e-8
    with pytest.raises(ValueError, match="needs local coordinates"):
        args = slowed, dps.Strang(), 0.0, 0.1
        diagnostics.structure_defect(*args, (ys[0][0], ys[1][0]))


@pytest.mark.parametrize(
    "act",
    [
        lambda x, y: diagnostics.energy(x, TS, YS),
        lambda x, y: diagnostics.energy_error(x, TS, YS),
        lambda x, y: diagnostics.power_lost(x, TS, YS),
        lambda x, y: diagnostics.energy_lost(x, TS, YS),
        lambda x, y: diagnostics.structure_defect(x, GAUSS, 0.0, y, Y0),
        lambda x, y: x.from_velocity(y, Y0),
    ],
    ids=["energy", "error", "power", "lost", "structure", "momentum"],
)
def test_a_system_is_compiled_once(act):
    calls = []

    def counted(t, q, p, args):
        calls.append(t)
        return mixed_energy(t, q, p, args)

    system = dps.Hamiltonian(counted, dps.ConstantDamping(0.1))
    first = act(system, 0.1)
    number = len(calls)
    assert number > 0
    assert_close(act(system, 0.1), first, 0)
    act(system, 0.2)
    assert len(calls) == number


def test_structure_defect():
    def defect(solver):
        return diagnostics.structure_defect(DRIVEN, solver, 1.0, 1.3, Y0, 0.7)

    assert defect(dps.PresymplecticLeapfrog()) < 1e-14
    assert defect(dps.BlanesCasasRKN8()) < 1e-13
    assert 1e-9 < defect(dfx.Tsit5()) < 1e-3
    assert 1e-3 < defect(dfx.Euler())


def test_integer_times():
    assert diagnostics.structure_defect(TERM, dps.Strang(), 0, 1, Y0) < 1e-14


def test_other_friction_is_not_conformal():
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), harmonic, dps.ViscousDamping(jnp.eye(1))
    )
    with pytest.raises(ValueError, match="other friction"):
        diagnostics.structure_defect(system, dps.TunedRKN6(), 0.0, 0.1, Y0)


@pytest.mark.parametrize("times", [[0.0, 3000.0], [0.0]])
def test_the_energy_balance_over_long_times(times):
    system, ts = oscillator(1e-3), jnp.array(times)
    sol = dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 3e3, 0.25, Y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )
    assert sol.ys is not None
    error = diagnostics.energy_error(system, ts, sol.ys)
    assert error.shape == ts.shape
    assert np.max(np.abs(error)) < 1e-8


@pytest.mark.parametrize(
    "balance",
    [
        diagnostics.energy,
        diagnostics.energy_error,
        energy_lost,
        diagnostics.power_lost,
    ],
)
def test_a_batch_is_refused_but_by_vmap(balance):
    both = lambda x: jnp.stack([x, 2 * x])
    ts, ys = both(TS), (both(YS[0]), both(YS[1]))
    with pytest.raises(ValueError, match=r"one solution, but has shape \(2, 2\)"):
        balance(TERM, ts, ys)
    with pytest.raises(ValueError, match="a state for each of the 2 times"):
        balance(TERM, TS, (jnp.ones((3, 1)), jnp.ones((3, 1))))
    each = jax.vmap(lambda ts, ys: balance(TERM, ts, ys))(ts, ys)
    np.testing.assert_allclose(each[0], balance(TERM, TS, YS), atol=1e-12)
