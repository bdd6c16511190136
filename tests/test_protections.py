"""Wrappers: compensated summation, and detection of non-finite states."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, henon_heiles, oscillator, solve, step, substeps

import diffrax_presym as dps


# Older versions of Optimistix have no such result.
NONFINITE = getattr(dfx.RESULTS, "nonfinite", dfx.RESULTS.nonlinear_divergence)
BASES = [
    dps.PresymplecticLeapfrog("position"),
    dps.PresymplecticLeapfrog(),
    dps.Suzuki4(),
    dps.BlanesMoanRKN4(),
]
each_base = pytest.mark.parametrize("base", BASES, ids=lambda x: type(x).__name__)
HENON = dps.MechanicalSystem(
    dps.QuadraticKinetic(jnp.array([1.0, 2.0])), henon_heiles, dps.ConstantDamping(0.3)
)
Y0 = (jnp.array([0.3, -0.1]), jnp.array([0.1, 0.2]))


@each_base
def test_compensated_is_the_same_scheme(base):
    plain = step(HENON, base, 0.5, 0.6, Y0)
    kept = step(HENON, dps.Compensated(base), 0.5, 0.6, Y0)
    assert_close(kept[0], plain[0], 1e-15)
    for name in ("k0", "k1"):
        assert_close(kept[2][name], plain[2][name], 1e-14)
    term = HENON
    defect = dps.diagnostics.structure_defect(term, dps.Compensated(base), 0.5, 0.6, Y0)
    assert defect < 1e-14


@each_base
def test_compensated_keeps_the_digits_of_float32(base):
    # The compensation is the difference to a step in double precision.
    y0 = jax.tree.map(lambda x: x.astype(jnp.float32), Y0)
    t0, t1 = jnp.float32(0.0), jnp.float32(0.125)
    exact, *_ = step(HENON, base, 0.0, 0.125, jax.tree.map(np.float64, y0))
    y1, _, _, (_, lost), _ = step(HENON, dps.Compensated(base), t0, t1, y0)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves((y1, lost)))
    kept = jax.tree.map(lambda x, e: np.float64(x) + np.float64(e), y1, lost)
    error = lambda y: max(
        np.max(np.abs(np.asarray(a, np.float64) - b))
        for a, b in zip(y, exact, strict=True)
    )
    assert error(kept) < 3e-8
    assert error(kept) < error(step(HENON, base, t0, t1, y0)[0])


def test_compensated_error_grows_less():
    # 3e4 steps of 1/8, whose times are exact; root mean square over eight orbits.
    hamiltonian = oscillator(0.0)
    q0 = jnp.linspace(0.3, 1.0, 8)
    rms = {}
    exact = None
    for name, dtype, solver in (
        ("exact", jnp.float64, substeps(BASES[1], 64)),
        ("plain", jnp.float32, substeps(BASES[1], 64)),
        ("kept", jnp.float32, dps.Compensated(substeps(BASES[1], 64))),
    ):
        q = q0.astype(jnp.float32).astype(dtype)
        t0, t1, dt0 = (jnp.asarray(t, dtype) for t in (0.0, 3744.0, 8.0))
        sol = solve(hamiltonian, solver, t0, t1, dt0, (q, jnp.zeros_like(q)))
        assert sol.ys is not None
        end = np.asarray(jnp.stack(sol.ys), np.float64)
        if exact is None:
            exact = end
        rms[name] = np.sqrt(np.mean((end - exact) ** 2))
    assert rms["plain"] > 2e-6
    assert rms["kept"] < rms["plain"] / 5


def test_compensated_goes_on_from_its_state():
    solver = dps.Compensated(BASES[1])
    whole = solve(HENON, solver, 0.0, 2.0, 0.125, Y0)
    save = dfx.SaveAt(t1=True, solver_state=True)
    half = solve(HENON, solver, 0.0, 1.0, 0.125, Y0, saveat=save)
    y = jax.tree.map(lambda x: x[-1], half.ys)
    rest = solve(HENON, solver, 1.0, 2.0, 0.125, y, solver_state=half.solver_state)
    assert_close(rest.ys, whole.ys, 1e-16)


def test_substeps_divide_the_jitter_of_the_clock():
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0 * q)
    y0 = (jnp.float32(0.0), jnp.float32(1.0))
    t0, dt0 = jnp.float32(1e4), jnp.float32(0.01)
    for n, error in ((1, (0.02, 0.1)), (100, (0.0, 1e-3))):
        t1 = t0 + n * dt0
        q = step(free, substeps(BASES[1], n), t0, t1, y0)[0][0]
        assert error[0] <= abs(q / (n * dt0) - 1) <= error[1]


def test_compensated_gradients():
    @jax.jit
    def end(x):
        sol = dfx.diffeqsolve(
            HENON,
            dps.Compensated(dps.BlanesMoanRKN4()),
            0.0,
            1.0,
            0.25,
            (x * Y0[0], Y0[1]),
        )
        assert sol.ys is not None
        return jnp.sum(sol.ys[0] ** 2)

    at, h = jnp.asarray(1.0), 1e-6
    numeric = (end(at + h) - end(at - h)) / (2 * h)
    assert_close(jax.grad(end)(at), numeric, 1e-8)


def cubic(t, q, args):
    return -args * jnp.sum(q**4)


def test_a_step_that_is_not_finite_raises():
    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), cubic)
    y0 = (jnp.array([0.3]), jnp.array([1.0]))
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"Nonfinite|diverged"):
        solve(hamiltonian, BASES[1], 0.0, 9.0, 0.1, y0, jnp.asarray(1e3))
