"""`Compensated` around and within schemes, substeps, and nested compositions."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import each
from helpers import (
    assert_close,
    harmonic,
    henon_heiles,
    mixed_energy,
    oscillator,
    solve,
    step,
    substeps,
)

import diffrax_presym as dps


Y0 = (jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4]))
LEAPFROG = dps.PresymplecticLeapfrog()
HENON = dps.MechanicalSystem(
    dps.QuadraticKinetic(jnp.array([1.0, 2.0])), henon_heiles, dps.ConstantDamping(0.3)
)
SPRINGS = dps.MechanicalSystem(
    dps.QuadraticKinetic(), dps.QuadraticPotential(), dps.ConstantDamping(0.3)
)
NONSEPARABLE = dps.Hamiltonian(mixed_energy, dps.ConstantDamping(0.3))


@pytest.mark.variants(5)
@each()
def test_a_compensated_step_is_the_step(scheme):
    system = {None: NONSEPARABLE, "linear": SPRINGS}.get(scheme.needs, HENON)
    solvers = scheme.solver, dps.Compensated(scheme.solver)
    plain, kept = (step(system, solver, 0.5, 0.6, Y0) for solver in solvers)
    assert_close(kept[0], plain[0], 1e-10 if scheme.implicit else 1e-15)
    for name in {"k0", "k1"} & set(plain[2]):  # of dense output
        assert_close(kept[2][name], plain[2][name], 1e-10 if scheme.implicit else 1e-14)


@pytest.mark.parametrize("wrap", [dps.Compensated, lambda solver: substeps(solver, 2)])
def test_wrappers_keep_what_the_scheme_has(wrap):
    assert not wrap(dps.PresymplecticEuler()).is_symmetric
    assert wrap(LEAPFROG).is_symmetric
    assert wrap(dps.TunedRKN6()).order(None) == 6


def test_compositions_nest():
    inner, outer = (0.7, -0.4, 0.7), (0.3, 0.4, 0.3)
    product = [a * b for b in outer for a in inner]
    doubled = [w / 2 for w in outer for _ in range(2)]
    one = lambda solver: step(HENON, solver, 1.0, 1.25, Y0)[0]
    for nested, weights in (
        (dps.Composition(dps.Composition(LEAPFROG, inner), outer), product),
        (dps.Composition(substeps(LEAPFROG, 2), outer), doubled),
    ):
        flat = dps.Composition(LEAPFROG, weights)
        assert_close(one(nested), one(flat), 1e-14)


# Digits that are saved.

BASES = [
    dps.PresymplecticLeapfrog("position"),
    LEAPFROG,
    dps.Suzuki4(),
    dps.BlanesMoanRKN4(),
]


@pytest.mark.parametrize("base", BASES, ids=lambda x: type(x).__name__)
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


@pytest.mark.parametrize(
    "solver",
    [
        LEAPFROG,
        substeps(dps.Strang(), 2),
        pytest.param(dps.PresymplecticTao(5.0), marks=pytest.mark.slow),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_compensation_saves_digits(solver):
    # Numbers that are exact in single precision, so that the same steps in double
    # precision show the errors of rounding.
    undamped = dps.MechanicalSystem(dps.QuadraticKinetic(), harmonic)

    def end(solver, dtype):
        y0 = jax.tree.map(lambda x: jnp.round(32 * x).astype(dtype) / 32, Y0)
        t0, t1, h = (jnp.asarray(x, dtype) for x in (0.0, 256.0, 2.0**-5))
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
    t0, t1, dt0 = (jnp.asarray(t, jnp.float32) for t in (t0, t0 + steps * h, h))
    sol = solve(oscillator(0.0), wrap(dps.Compensated(LEAPFROG)), t0, t1, dt0, y0)
    assert sol.ys is not None
    end = np.array([y[-1, 0] for y in sol.ys])
    np.testing.assert_allclose(end, [np.cos(steps * h), -np.sin(steps * h)], atol=2e-4)


def test_substeps_divide_the_jitter_of_the_clock():
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), lambda t, q, args: 0 * q)
    y0 = (jnp.float32(0.0), jnp.float32(1.0))
    t0, dt0 = jnp.float32(1e4), jnp.float32(0.01)
    for n, error in ((1, (0.02, 0.1)), (100, (0.0, 1e-3))):
        t1 = t0 + n * dt0
        q = step(free, substeps(LEAPFROG, n), t0, t1, y0)[0][0]
        assert error[0] <= abs(q / (n * dt0) - 1) <= error[1]
