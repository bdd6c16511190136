"""`Compensated` around and within every scheme."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ANY,
    assert_close,
    each,
    harmonic,
    henon_heiles,
    IMPLICIT,
    mixed_energy,
    oscillator,
    Scheme,
    SCHEMES,
    solve,
    step,
    substeps,
)

import diffrax_presym as dps


Y0 = (jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4]))
DAMPED = dps.MechanicalSystem(
    dps.QuadraticKinetic(), henon_heiles, dps.LogDamping(1.0, shift=1.0)
)
NONSEPARABLE = dps.Hamiltonian(mixed_energy, dps.ConstantDamping(0.3))
T0, T1 = 0.5, 0.6
WRAPPERS = {
    "compensated": dps.Compensated,
    "substeps": lambda solver: substeps(solver, 2),
}
wrappers = pytest.mark.parametrize("wrap", WRAPPERS.values(), ids=WRAPPERS)


def one_step(solver, hamiltonian: dps.extend.AbstractSystem = DAMPED):
    return step(hamiltonian, solver, T0, T1, Y0)[0]


@each()
def test_a_compensated_step_is_the_step(scheme: Scheme):
    expected = one_step(scheme.solver)
    assert_close(one_step(dps.Compensated(scheme.solver)), expected, 1e-15)


@each([s for s in SCHEMES if s.kind in ANY] + IMPLICIT)
def test_wrappers_of_schemes_for_any_energy(scheme: Scheme):
    expected = one_step(scheme.solver, NONSEPARABLE)
    wrapped = dps.Compensated(scheme.solver)
    tolerance = 1e-10 if scheme in IMPLICIT else 1e-15
    assert_close(one_step(wrapped, NONSEPARABLE), expected, tolerance)


@pytest.mark.parametrize(
    "compose",
    [dps.Suzuki4, lambda base: substeps(base, 3)],
    ids=["composition", "substeps"],
)
def test_compensation_inside_compositions_and_around_them(compose):
    for base in (dps.PresymplecticLeapfrog(), dps.PresymplecticTao(5.0)):
        expected, inner = one_step(compose(base)), dps.Compensated(base)
        for solver in (compose(inner), dps.Compensated(compose(base))):
            assert_close(one_step(solver), expected, 1e-15)


def test_gradients_where_the_solver_state_has_sums():
    solver = dps.Compensated(dps.PresymplecticTao())
    saveat = dfx.SaveAt(t0=True, ts=[0.7, 1.3])

    def loss(adjoint):
        def of(y0):
            args = oscillator(), solver, 0.5, 1.5, 0.05, y0
            sol = dfx.diffeqsolve(*args, saveat=saveat, adjoint=adjoint)
            return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(sol.ys))

        return jax.jit(jax.grad(of))(Y0)

    expected = loss(dfx.RecursiveCheckpointAdjoint())
    assert_close(loss(dps.FixedStepAdjoint("checkpoints")), expected, 1e-12)


@wrappers
def test_wrappers_keep_what_the_scheme_has(wrap):
    euler = wrap(dps.PresymplecticEuler())
    assert not euler.is_symmetric
    assert wrap(dps.PresymplecticLeapfrog()).is_symmetric
    assert wrap(dps.TunedRKN6()).order(None) == 6


@pytest.mark.parametrize(
    "solver",
    [
        dps.PresymplecticLeapfrog(),
        substeps(dps.Strang(), 2),
        pytest.param(dps.PresymplecticTao(5.0), marks=pytest.mark.slow),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_compensation_saves_digits(solver):
    # Numbers that are exact in single precision, so that the same steps in double
    # precision show the errors of rounding.
    undamped = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic)
    half = 4.0

    def end(solver, dtype):
        y0 = jax.tree.map(lambda x: jnp.round(32 * x).astype(dtype) / 32, Y0)
        t0, t1, h = (jnp.asarray(x, dtype) for x in (0.0, 64.0 * half, 2.0**-5))
        sol = solve(undamped, solver, t0, t1, h, y0, max_steps=2**14)
        assert sol.ys is not None
        return np.concatenate([np.asarray(y[-1], np.float64) for y in sol.ys])

    exact = end(solver, jnp.float64)
    plain = np.max(np.abs(end(solver, jnp.float32) - exact))
    compensated = end(dps.Compensated(solver), jnp.float32)
    assert np.max(np.abs(compensated - exact)) < plain / 3


@pytest.mark.parametrize(
    "wrap",
    [dps.Suzuki4, lambda base: substeps(base, 2), dfx.HalfSolver],
    ids=["composition", "substeps", "half steps"],
)
def test_steps_of_nominal_length_inside_others(wrap):
    # Times in single precision do not tell half of a step from a step at t = 1.5e4.
    t0, h, steps = 1.5e4, 2.0**-7, 64
    y0 = (jnp.array([1.0], jnp.float32), jnp.array([0.0], jnp.float32))
    base = dps.Compensated(dps.PresymplecticLeapfrog())
    t0, t1, dt0 = (jnp.asarray(t, jnp.float32) for t in (t0, t0 + steps * h, h))
    sol = solve(oscillator(0.0), wrap(base), t0, t1, dt0, y0)
    assert sol.ys is not None
    end = np.array([y[-1, 0] for y in sol.ys])
    np.testing.assert_allclose(end, [np.cos(steps * h), -np.sin(steps * h)], atol=2e-4)
