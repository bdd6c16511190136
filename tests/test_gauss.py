"""Gauss collocation, and mechanics with a mass matrix."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import optimistix as optx
import pytest
from helpers import assert_close, flat, solve, step
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps
from diffrax_presym._scan import equations
from diffrax_presym._solver._collocation import gauss_table
from diffrax_presym._solver._gauss_extension import GaussExtension
from diffrax_presym.diagnostics._count import counted, Counter


FINDER = optx.Newton(rtol=1e-12, atol=1e-12)


def forced_energy(t, q, p, args):
    """Neither separable nor autonomous."""
    return (2 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 4 + jnp.sin(t) * q[0]


FORCED = dps.ConformalHamiltonian(
    energy=forced_energy, damping=dps.ConstantDamping(0.3)
)
# A rate that depends on time.
WAVY = dps.ConformalHamiltonian(energy=forced_energy, damping=dps.LogDamping(2.0))
Y0 = (jnp.array([0.5, -0.3]), jnp.array([0.2, 0.4]))

ZERO = jnp.array(0.0)


def chain_mass(t, q, args):
    """A chain of links of unit length and mass, angles measured from the vertical."""
    n = len(q)
    below = n - np.maximum.outer(np.arange(n), np.arange(n)).astype(q.dtype)
    return below * jnp.cos(q[:, None] - q[None, :])


def chain_potential(t, q, args):
    n = len(q)
    return -9.81 * jnp.sum((n - np.arange(n)).astype(q.dtype) * jnp.cos(q))


def chain_energy(t, q, p, args):
    v = jnp.linalg.solve(chain_mass(t, q, args), p)
    return p @ v / 2 + chain_potential(t, q, args)


CHAIN = dps.LagrangianSystem(chain_mass, chain_potential)
PENDULUM = (jnp.array([1.0, 1.5]), jnp.array([0.3, -0.2]))


# Coefficients


@pytest.mark.parametrize("stages", range(1, 9))
def test_coefficients_are_right_to_the_last_digit(stages):
    table = gauss_table(stages)
    with mpmath.workdps(50):
        legendre = lambda x: mpmath.legendre(stages, x)
        guesses, _ = np.polynomial.legendre.leggauss(stages)
        c = sorted((1 + mpmath.findroot(legendre, float(x))) / 2 for x in guesses)
        powers = mpmath.matrix(stages, stages)
        for k in range(stages):
            for j in range(stages):
                powers[k, j] = c[j] ** k
        # The conditions B(s) and C(s) of quadrature and collocation.
        moments = lambda x: [x ** (k + 1) / (k + 1) for k in range(stages)]
        b = mpmath.lu_solve(powers, mpmath.matrix(moments(mpmath.mpf(1))))
        for i in range(stages):
            assert abs(table.nodes[i] - c[i]) <= 0.5 * np.spacing(table.nodes[i])
            assert abs(table.weights[i] - b[i]) <= 0.5 * np.spacing(table.weights[i])
            a = mpmath.lu_solve(powers, mpmath.matrix(moments(c[i])))
            for j in range(stages):
                assert abs(table.mu[i, j] - a[j] / b[j]) <= 2.0**-53 * 1.1
    # What makes it symplectic and symmetric, without any rounding.
    assert np.all(table.mu + table.mu.T == 1)
    assert np.all(table.mu == table.mu[::-1, ::-1].T)
    assert np.all(table.weights == table.weights[::-1])


# Order

RANDOM = np.random.default_rng(0)
STARTS = jnp.array(RANDOM.normal(size=(2, 16, 2)) / 2)


@eqx.filter_jit
def many_ends(solver, n):
    """From many starts, as the error of one may change its sign."""

    def one(q, p, n):
        dt0 = 6.0 / n
        sol: Any = solve(FORCED, solver, 0.0, 6.0, dt0, (q, p), max_steps=None)
        return flat(sol.ys)

    each_start = jax.vmap(one, (0, 0, None))
    return jax.vmap(each_start, (None, None, 0))(STARTS[0], STARTS[1], n)


_slow = lambda s: pytest.param(s, marks=pytest.mark.slow)


@pytest.mark.parametrize("stages", [2, 4, 6, 8, *map(_slow, (1, 3, 5, 7))])
def test_order(stages):
    solver = dps.PresymplecticGauss(stages)
    n = np.array([6.0, 9.0, 12.0, 18.0]) * (4 if stages < 4 else 1)
    ends = many_ends(solver, jnp.array(n))
    exact = many_ends(dps.PresymplecticGauss(8), jnp.array([40.0, 40.0, 40.0, 40.0]))
    errors = np.max(np.abs(ends - exact), axis=-1)
    errors = np.exp(np.mean(np.log(errors), axis=-1))
    # Without the plateau of rounding errors.
    kept = errors > 5e-14
    assert np.sum(kept) >= 3
    slope, _ = np.polyfit(np.log(n[kept]), np.log(errors[kept]), 1)
    assert solver.order(None) == 2 * stages
    assert abs(-slope - 2 * stages) < 0.2 * stages


def test_one_stage_is_the_midpoint_rule():
    midpoint = dps.PresymplecticMidpoint(FINDER)
    expected = step(FORCED, midpoint, 0.0, 0.2, Y0)[0]
    assert_close(
        step(FORCED, dps.PresymplecticGauss(1), 0.0, 0.2, Y0)[0], expected, 1e-15
    )


@pytest.mark.slow
@pytest.mark.parametrize("stages", [4])
def test_newton_finds_the_same(stages):
    newton = dps.PresymplecticGauss(stages, FINDER)
    expected = solve(WAVY, dps.PresymplecticGauss(stages), 1.0, 2.0, 0.25, Y0).ys
    assert_close(solve(WAVY, newton, 1.0, 2.0, 0.25, Y0).ys, expected, 1e-12)


# Structure

T0, H = jnp.array(0.5), 0.3


@pytest.mark.parametrize("stages", [1, 8])
def test_conformally_symplectic_to_rounding(stages):
    solver = dps.PresymplecticGauss(stages)
    start, unravel = ravel_pytree(Y0)
    fn = lambda x: flat(step(WAVY, solver, T0, T0 + H, unravel(x))[0])
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(fn)(x), jax.jacrev(fn)(x)))(start)
    assert_close(forward, reverse, 1e-14)
    form = np.kron([[0, 1], [-1, 0]], np.eye(2))
    decay = float(T0 / (T0 + H)) ** 2
    J = np.asarray(forward)
    assert np.max(np.abs(J.T @ form @ J - decay * form)) < 1e-14


@pytest.mark.parametrize("stages", [4])
def test_symmetric_to_rounding(stages):
    solver = dps.PresymplecticGauss(stages)
    assert solver.is_symmetric and solver.reverse is solver
    end, _, _, carry, _ = step(WAVY, solver, T0, T0 + H, Y0)
    # Afresh, and with what the step leaves to the next.
    assert_close(step(WAVY, solver, T0 + H, T0, end)[0], Y0, 2e-15)
    term = dps.HamiltonianTerm(WAVY)
    go_on = lambda y, carry: solver.step(term, T0 + H, T0, y, None, carry, False)[0]
    assert_close(jax.jit(go_on)(end, carry), Y0, 2e-15)


def spin(t, q, p, args):
    """Rotational symmetry, and not separable."""
    return (1 + jnp.sum(q**2)) * jnp.sum(p**2) / 2 + jnp.sum(q**2) ** 2


@pytest.mark.slow
def test_quadratic_invariants_are_kept():
    solver = dps.PresymplecticGauss(3)
    saveat = dfx.SaveAt(steps=True)
    sol: Any = solve(dps.Hamiltonian(spin), solver, 0.0, 20.0, 1 / 8, Y0, saveat=saveat)
    q, p = (np.asarray(x)[:160] for x in sol.ys)
    momentum = q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]
    assert np.ptp(momentum) < 1e-15 and np.ptp(q) > 0.5


def test_rounding_does_not_drift():
    y0 = (jnp.array([0.6, 0.9]), jnp.zeros(2))
    energy = lambda t, y, args: CHAIN.energy(t, *y)
    saveat = dfx.SaveAt(steps=True, fn=energy)
    solver = dps.PresymplecticGauss(8)
    sol: Any = solve(CHAIN, solver, 0.0, 409.6, 0.1, y0, saveat=saveat)
    errors = np.asarray(sol.ys) / float(CHAIN.energy(ZERO, *y0)) - 1
    assert np.max(np.abs(errors)) < 2e-15


@pytest.mark.slow
def test_long_steps_keep_the_energy():
    y0 = (jnp.array([0.6, 0.9]), jnp.zeros(2))
    energy = lambda t, y, args: CHAIN.energy(t, *y)
    saveat = dfx.SaveAt(steps=True, fn=energy)
    solver = dps.PresymplecticGauss(3)
    sol: Any = solve(CHAIN, solver, 0.0, 409.6, 0.1, y0, saveat=saveat)
    errors = np.abs(sol.ys - CHAIN.energy(ZERO, *y0))
    first, last = np.max(errors[:1024]), np.max(errors[-1024:])
    assert 1e-7 < last < 1.5 * first


# Dense output


def test_dense_output_is_exact_at_the_ends_and_of_the_order_of_the_scheme():
    for hamiltonian in (FORCED, CHAIN):
        y0 = Y0 if hamiltonian is FORCED else PENDULUM
        for stages in (1, 2, 3):
            solver, errors = dps.PresymplecticGauss(stages), []
            for h in (0.1, 0.05):
                end, _, info, *_ = step(hamiltonian, solver, 0.0, h, y0)
                of_step = dps.HermiteInterpolation(t0=0.0, t1=h, **info)
                assert_close(of_step.evaluate(0.0), y0, 0)
                assert_close(of_step.evaluate(h), end, 0)
                part = step(hamiltonian, dps.PresymplecticGauss(8), 0.0, 0.3 * h, y0)[0]
                y = flat(of_step.evaluate(jnp.asarray(0.3 * h)))
                errors.append(np.max(np.abs(y - flat(part))))
            assert np.log2(errors[0] / errors[1]) > 2 * stages + 0.6


# As any solver of Diffrax


@pytest.mark.slow
def test_backwards_in_time():
    solver = dps.PresymplecticGauss(4)
    end = solve(FORCED, solver, 0.0, 1.0, 0.1, Y0).ys
    end = jax.tree.map(lambda x: x[-1], end)
    ts = jnp.array([0.97, 0.42, 0.0])
    saveat = dfx.SaveAt(ts=ts)
    back: Any = solve(FORCED, solver, 1.0, 0.0, -0.1, end, saveat=saveat)
    assert_close(jax.tree.map(lambda x: x[-1], back.ys), Y0, 1e-14)
    there = solve(FORCED, solver, 0.0, 1.0, 0.1, Y0, saveat=dfx.SaveAt(ts=ts[::-1]))
    assert_close(jax.tree.map(lambda x: x[::-1], back.ys), there.ys, 1e-7)


@pytest.mark.slow
def test_steps_of_any_length_and_vmap():
    # Each a first guess for the next, and far from it.
    ts = jnp.array([0.0, 0.3, 0.31, 0.5, 0.50001, 1.0])
    solver = dps.PresymplecticGauss(8)

    def end(q):
        controller = dfx.StepTo(ts)
        sol: Any = dfx.diffeqsolve(
            *(dps.HamiltonianTerm(FORCED), solver, 0.0, 1.0, None, (q, Y0[1])),
            stepsize_controller=controller,
        )
        return sol.ys

    both = jax.jit(jax.vmap(end))(jnp.stack([Y0[0], 2 * Y0[0]]))
    for i in range(2):
        exact = solve(FORCED, solver, 0.0, 1.0, 0.05, ((i + 1) * Y0[0], Y0[1])).ys
        assert_close(jax.tree.map(lambda x, i=i: x[i], both), exact, 1e-12)


@pytest.mark.slow
def test_half_solver_adapts_steps():
    sol: Any = solve(
        *(FORCED, dfx.HalfSolver(dps.PresymplecticGauss(3)), 0.0, 3.0, 0.1, Y0),
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
    )
    exact = solve(FORCED, dps.PresymplecticGauss(8), 0.0, 3.0, 0.05, Y0).ys
    assert_close(sol.ys, exact, 1e-6)
    assert sol.stats["num_rejected_steps"] < sol.stats["num_accepted_steps"]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_precision_of_the_state_is_kept(dtype):
    y0 = jax.tree.map(lambda x: {"x": x.astype(dtype)}, Y0)

    def energy(t, q, p, args):
        assert q["x"].dtype == p["x"].dtype == dtype
        return forced_energy(t.astype(dtype), q["x"], p["x"], args)

    damped = dps.ConformalHamiltonian(energy=energy, damping=dps.ConstantDamping(0.3))
    solver = dps.PresymplecticGauss(4)
    t = lambda x: jnp.asarray(x, dtype)
    sol: Any = solve(damped, solver, t(0), t(2), t(0.25), y0, saveat=SAVEAT[dtype])
    assert all(x.dtype == dtype for x in jax.tree.leaves((sol.ys, sol.solver_state)))
    exact: Any = solve(FORCED, solver, 0.0, 2.0, 0.25, Y0).ys
    assert_close(jax.tree.map(lambda x: x[-1], flat(sol.ys[0])), exact[0][-1, -1], 2e-6)


SAVEAT: Any = {
    dtype: dfx.SaveAt(ts=jnp.array([0.3, 2.0], dtype), solver_state=True)
    for dtype in (jnp.float32, jnp.float64)
}


@pytest.mark.slow
def test_friction_that_is_infinite_at_the_start():
    y0 = (Y0[0], jnp.zeros(2))
    ends = [
        solve(WAVY, dps.PresymplecticGauss(s), 0.0, 1.0, h, y0).ys
        for s, h in ((4, 1 / 32), (6, 1 / 64))
    ]
    assert_close(ends[0], ends[1], 1e-3)


def rooted_energy(t, q, p, args):
    return (1 + jnp.sum(q**2)) * jnp.sum(p**2) / 2 - jnp.sum(jnp.sqrt(q - 1e-3))


@pytest.mark.slow
def test_a_guess_outside_of_the_domain_is_dropped():
    # It falls towards the edge, and turns.
    y0 = (jnp.array([0.05]), jnp.array([-0.01]))
    solver = dps.PresymplecticGauss(8)
    rooted = dps.Hamiltonian(rooted_energy)
    sol = solve(rooted, solver, 0.0, 0.2, 0.02, y0, throw=False)
    assert sol.result == dfx.RESULTS.successful
    exact = solve(rooted, solver, 0.0, 0.2, 0.002, y0).ys
    assert_close(sol.ys, exact, 1e-6)


# Failure


def test_iterations_that_do_not_converge_are_a_result():
    stiff = dps.Hamiltonian(lambda t, q, p, args: 50 * spin(t, q, p, args))
    for solver, result in [
        (dps.PresymplecticGauss(4), dfx.RESULTS.nonlinear_divergence),
        (
            dps.PresymplecticGauss(4, max_iterations=2),
            dfx.RESULTS.nonlinear_max_steps_reached,
        ),
        (
            dps.PresymplecticGauss(4, FINDER, max_iterations=1),
            dfx.RESULTS.nonlinear_max_steps_reached,
        ),
    ]:
        sol = solve(stiff, solver, 0.0, 1.0, 0.25, Y0, throw=False)
        assert sol.result == result
        assert sol.stats["num_steps"] == 1


def test_a_tolerance_ends_the_iteration_earlier():
    def run(tolerance):
        counter = Counter()
        system = counted(FORCED, counter)
        solver = dps.PresymplecticGauss(4, tolerance=tolerance)
        y = solve(system, solver, 0.0, 2.0, 0.2, Y0).ys
        return flat(y), counter.count

    (exact, most), (loose, fewer) = run(0.0), run(1e-8)
    assert 1e-14 < np.max(np.abs(loose - exact)) < 1e-7
    assert fewer < 0.8 * most


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrap, h, dtype",
    [
        (lambda x: x, 0.2, jnp.float32),
        (dps.Checked, -0.2, jnp.float64),
        (dps.Compensated, 0.2, jnp.float64),
    ],
)
def test_a_tolerance_in_wrappers_batches_and_gradients(wrap, h, dtype):
    def energy(t, q, p, args):
        return (2 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 4

    system = dps.ConformalHamiltonian(energy=energy, damping=dps.ConstantDamping(0.3))
    many = jax.tree.map(lambda x: jnp.stack([x, -x / 2]).astype(dtype), Y0)
    tolerance, within = (1e-8, 1e-6) if dtype == jnp.float64 else (1e-4, 1e-2)
    # A state is promoted to the precision of the times.
    t0, t1, dt = (jnp.asarray(t, dtype) for t in (0.0, 10 * h, h))
    options = dict(
        saveat=dfx.SaveAt(ts=jnp.array([0.3, 1.0, 1.7], dtype) * (1 if h > 0 else -1)),
        adjoint=dps.FixedStepAdjoint(),
    )

    def loss(y, tolerance):
        solver = wrap(dps.PresymplecticGauss(4, tolerance=tolerance))
        one = lambda y: solve(system, solver, t0, t1, dt, y, **options).ys
        ys: Any = jax.vmap(one)(y)
        q, p = ys
        assert q.dtype == p.dtype == dtype
        return jnp.sum(q**2) + jnp.sum(p**2)

    loose, exact = (jax.value_and_grad(loss)(many, x) for x in (tolerance, 0.0))
    assert_close(loose, exact, within)


def stiff_energy(t, q, p, args):
    return (1 + jnp.sum(q**2)) * jnp.sum(p**2) / 2 + 1e4 * jnp.sum(q**2)


@pytest.mark.slow
def test_newton_solves_what_is_stiff():
    y0 = (jnp.array([0.001, -0.002]), jnp.array([0.2, 0.4]))
    H = dps.Hamiltonian(stiff_energy)
    solver = dps.PresymplecticGauss(2)
    assert solve(H, solver, 0.0, 2.0, 0.2, y0, throw=False).result != (
        dfx.RESULTS.successful
    )
    sol: Any = solve(H, dps.PresymplecticGauss(2, FINDER), 0.0, 2.0, 0.2, y0)
    q, p = (x[-1] for x in sol.ys)
    assert abs(H.energy(ZERO, q, p) / H.energy(ZERO, *y0) - 1) < 0.1


@pytest.mark.slow
def test_a_system_at_rest_stays_there():
    damped = dps.LagrangianSystem(chain_mass, chain_potential, friction=5.0)
    sol = solve(damped, dps.PresymplecticGauss(6), 0.0, 80.0, 0.02, PENDULUM)
    assert sol.result == dfx.RESULTS.successful
    assert np.max(np.abs(flat(sol.ys))) < 1e-10


NOTHING: Any = None
WORD: Any = "newton"
TWO: Any = 2.0
# Its tolerances are those of an adaptive controller.
UNFINISHED = dfx.with_stepsize_controller_tols(optx.Newton)()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: dps.PresymplecticGauss(0), "from 1 to 8"),
        (lambda: dps.PresymplecticGauss(9), "from 1 to 8"),
        (lambda: dps.PresymplecticGauss(TWO), "Python integer"),
        (lambda: dps.PresymplecticGauss(True), "Python integer"),
        (lambda: dps.PresymplecticGauss(2, max_iterations=0), "at least 1"),
        (lambda: dps.PresymplecticGauss(2, UNFINISHED), "tolerance"),
        (lambda: dps.PresymplecticGauss(2, tolerance=-1e-8), "at least 0"),
        (lambda: dps.PresymplecticGauss(2, FINDER, tolerance=1e-8), "root finder"),
        (lambda: dps.PresymplecticGauss(2, WORD), "root finder"),
        (lambda: dps.LagrangianSystem(3.0, chain_potential), "M(t, q, args)"),
        (lambda: dps.LagrangianSystem(chain_mass, NOTHING), "V(t, q, args)"),
        (
            lambda: dps.LagrangianSystem(chain_mass, chain_potential, force=1.0),
            "f(t, q, v, args)",
        ),
        (
            lambda: dps.LagrangianSystem(chain_mass, chain_potential, chain_mass),
            "`force=f`",
        ),
        (
            lambda: dps.LagrangianSystem(chain_mass, chain_potential, "much"),
            "real number",
        ),
    ],
)
def test_bad_arguments_are_an_error(make, message):
    with pytest.raises(ValueError) as error:
        make()
    assert message in str(error.value)


# Gradients

TS = jnp.array([0.0, 0.13, 0.7, 0.9, 1.93])


def loss(theta, solver, adjoint, saveat, n=16):
    a, gamma, x = theta

    def energy(t, q, p, args):
        # A closure, and arguments of any type.
        k, _ = args
        return (1 + a * jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 2 + jnp.sin(k * t) * q[0]

    damped = dps.ConformalHamiltonian(energy=energy, damping=dps.ConstantDamping(gamma))
    sol: Any = dfx.diffeqsolve(
        *(dps.HamiltonianTerm(damped), solver, 0.0, 2.0, 2.0 / n),
        (jnp.stack([x, -0.3 * x]), Y0[1]),
        args=(2 * a, jnp.arange(3)),
        saveat=saveat,
        adjoint=adjoint,
        max_steps=n,
    )
    q, p = sol.ys
    return jnp.sum(jnp.sin(q)) + jnp.sum(p**2)


THETA = jnp.array([0.7, 0.1, 0.5])


def test_gradients_are_those_of_the_implicit_function():
    saveat, solver = dfx.SaveAt(t1=True), dps.PresymplecticGauss(3)
    fn = lambda adjoint: lambda theta: loss(theta, solver, adjoint, saveat)
    value = fn(dfx.RecursiveCheckpointAdjoint())
    checkpoints = jax.jit(jax.grad(value))(THETA)
    assert_close(checkpoints, differences_of(jax.jit(value)), 1e-8)
    reverse = jax.jit(jax.grad(fn(dps.ReversibleAdjoint())))(THETA)
    assert_close(reverse, checkpoints, 1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("finder", [None, FINDER], ids=["fixed point", "newton"])
def test_gradients_of_dense_output(finder):
    saveat, solver = dfx.SaveAt(ts=TS), dps.PresymplecticGauss(3, finder)
    fn = lambda adjoint: lambda theta: loss(theta, solver, adjoint, saveat)
    value = fn(dfx.RecursiveCheckpointAdjoint())
    checkpoints = jax.jit(jax.grad(value))(THETA)
    assert_close(checkpoints, differences_of(jax.jit(value)), 1e-8)
    forward = jax.jit(jax.jacfwd(fn(dfx.ForwardMode())))(THETA)
    assert_close(forward, checkpoints, 1e-13)
    fixed_step = jax.jit(jax.grad(fn(dps.FixedStepAdjoint())))(THETA)
    assert_close(fixed_step, checkpoints, 1e-5)
    reverse = jax.jit(jax.grad(fn(dps.ReversibleAdjoint())))(THETA)
    assert_close(reverse, fixed_step, 1e-12)


REVERSE: Any = dps.ReversibleAdjoint()


@pytest.mark.slow
def test_gradients_of_dense_output_by_reversal():
    # Backwards, the solver state has slopes of other steps.
    term = dps.HamiltonianTerm(FORCED)

    def value(theta, adjoint=REVERSE):
        saveat = dfx.SaveAt(dense=True)
        sol: Any = dfx.diffeqsolve(
            *(term, dps.PresymplecticGauss(3), 0.0, 2.0, 0.25, (theta[:2], Y0[1])),
            saveat=saveat,
            adjoint=adjoint,
            max_steps=8,
        )
        return jnp.sum(jnp.sin(sol.evaluate(1.1)[0])) + theta[2]

    reverse = jax.jit(jax.grad(value))(THETA)
    assert_close(reverse, differences_of(jax.jit(value)), 1e-8)
    fixed = jax.jit(jax.grad(lambda theta: value(theta, dps.FixedStepAdjoint())))
    assert_close(reverse, fixed(THETA), 1e-12)


def differences_of(fn):
    unit = 1e-5 * np.eye(3)
    return jnp.stack([(fn(THETA + e) - fn(THETA - e)) / 2e-5 for e in unit])


@pytest.mark.slow
def test_second_derivatives():
    solver, saveat = dps.PresymplecticGauss(2), dfx.SaveAt(t1=True)
    fn = lambda adjoint: lambda theta: loss(theta, solver, adjoint, saveat, 8)
    reverse = jax.jit(jax.jacfwd(jax.grad(fn(dps.ReversibleAdjoint()))))(THETA)
    gradient = jax.jit(jax.grad(fn(dps.ReversibleAdjoint())))
    assert_close(reverse, differences_of(gradient), 1e-7)


def test_gradients_do_not_depend_on_the_number_of_iterations():
    # With one iteration from the solution itself there is nothing to differentiate.
    solver = dps.PresymplecticGauss(4)
    jaxpr = jax.make_jaxpr(
        jax.grad(lambda q: jnp.sum(step(FORCED, solver, 0.0, 0.2, (q, Y0[1]))[0][0]))
    )(Y0[0])
    loops = [e.primitive.name for e in equations(jaxpr.eqns)]
    lengths = [
        e.params["length"] for e in equations(jaxpr.eqns) if "length" in e.params
    ]
    # The only loop of known length is that of dense output, which starts from the
    # solution without its derivatives.
    assert "while" in loops and set(lengths) <= {GaussExtension(4).iterations}


@pytest.mark.slow
@pytest.mark.parametrize("dense", [False, True])
def test_gradients_of_joint_friction(dense):
    saveat = dfx.SaveAt(ts=TS) if dense else dfx.SaveAt(t1=True)

    def loss(C, adjoint):
        damped = dps.LagrangianSystem(chain_mass, chain_potential, friction=C)
        sol: Any = dfx.diffeqsolve(
            *(dps.HamiltonianTerm(damped), dps.PresymplecticGauss(6), 0.0, 2.0, 0.1),
            PENDULUM,
            adjoint=adjoint,
            saveat=saveat,
        )
        return jnp.sum(flat(sol.ys) ** 2)

    C = jnp.array([0.3, 0.2])
    checkpoints, reverse = (
        jax.jit(jax.grad(lambda C, adjoint=adjoint: loss(C, adjoint)))(C)
        for adjoint in (dps.FixedStepAdjoint(), dps.ReversibleAdjoint())
    )
    assert_close(reverse, checkpoints, 1e-11)
    value = jax.jit(lambda C: loss(C, dfx.RecursiveCheckpointAdjoint()))
    for i, e in enumerate(1e-5 * np.eye(2)):
        difference = (value(C + e) - value(C - e)) / 2e-5
        assert abs(checkpoints[i] - difference) < 1e-6


# Mechanics with a mass matrix


@pytest.mark.parametrize("n", [1, 2, 6, 7])
def test_velocity_and_force_are_those_of_the_energy(n):
    q, p = jnp.array(RANDOM.normal(size=(2, n)))
    expected = dps.Hamiltonian(chain_energy)
    both = CHAIN.velocity_and_force(ZERO, q, p)
    velocity, force = expected.velocity_and_force(ZERO, q, p)
    assert_close(both, (velocity, force), 1e-12)
    assert_close(CHAIN.velocity(ZERO, q, p), velocity, 1e-13)
    assert_close(CHAIN.force(ZERO, q, p), force, 1e-12)
    assert_close(CHAIN.energy(ZERO, q, p), expected.energy(ZERO, q, p), 1e-13)
    assert_close(CHAIN.to_velocity(ZERO, q, p), velocity, 1e-13)
    assert_close(CHAIN.from_velocity(ZERO, q, velocity), p, 1e-12)
    assert CHAIN.splits == ()


def moving_mass(t, q, args):
    return (2 + jnp.sin(t)) * chain_mass(t, q, args)


def motor(t, q, v, args):
    return args * jnp.sin(t) - 0.1 * v**3


@pytest.mark.parametrize(
    "friction",
    [
        pytest.param(0.3, marks=pytest.mark.slow),
        pytest.param(np.array([0.3, 0.1]), marks=pytest.mark.slow),
        np.array([[0.3, -0.2], [0.2, 0.4]]),
    ],
)
def test_motion_in_joint_coordinates(friction):
    system = dps.LagrangianSystem(moving_mass, chain_potential, friction, motor)
    args = jnp.array([1.0, -0.5])
    end: Any = solve(
        *(system, dps.PresymplecticGauss(6), 0.0, 2.0, 0.05, PENDULUM, args)
    ).ys

    # Lagrange's equations for (q, v), without momenta.
    def acceleration(t, y, args):
        q, v = y
        mass = lambda q, t: moving_mass(t, q, None)
        L = lambda q: v @ mass(q, t) @ v / 2 - chain_potential(t, q, None)
        C = jnp.asarray(friction)
        f = jax.grad(L)(q) + motor(t, q, v, args)
        f = f - (C @ v if C.ndim == 2 else C * v)
        moved = jax.jvp(mass, (q, t), (v, jnp.ones_like(t)))[1]
        return v, jnp.linalg.solve(mass(q, t), f - moved @ v)

    v0 = system.to_velocity(ZERO, *PENDULUM)
    sol: Any = dfx.diffeqsolve(
        *(dfx.ODETerm(acceleration), dfx.Dopri8(), 0.0, 2.0, 0.01),
        (PENDULUM[0], v0),
        args=args,
        stepsize_controller=dfx.PIDController(rtol=1e-12, atol=1e-12),
    )
    q, v = (x[-1] for x in sol.ys)
    p = system.from_velocity(jnp.array(2.0), q, v)
    assert_close(jax.tree.map(lambda x: x[-1], end), (q, p), 1e-9)


SKEW = jnp.array([[0.0, 0.1], [0.0, 0.0]])
BAD_MASSES: Any = {
    "indefinite": lambda t, q, args: chain_mass(t, q, args) - 1.5 * jnp.eye(2),
    "asymmetric": lambda t, q, args: chain_mass(t, q, args) + SKEW,
}


@pytest.mark.parametrize("name", BAD_MASSES)
def test_a_bad_mass_matrix_is_a_result(name):
    solver = dps.PresymplecticGauss(4)
    system = dps.LagrangianSystem(BAD_MASSES[name], chain_potential)
    sol = solve(system, solver, 0.0, 1.0, 0.05, PENDULUM, throw=False)
    assert sol.result != dfx.RESULTS.successful
    assert sol.stats["num_steps"] == 1
    if name == "indefinite":
        assert np.all(np.isnan(system.velocity(ZERO, *PENDULUM)))


@pytest.mark.parametrize(
    "make, y0, message",
    [
        (lambda: CHAIN, jax.tree.map(lambda x: x[None], PENDULUM), "vectors"),
        (lambda: CHAIN, tuple({"a": x} for x in PENDULUM), "vectors"),
        (
            lambda: dps.LagrangianSystem(lambda t, q, args: q, chain_potential),
            PENDULUM,
            r"shape \(2, 2\)",
        ),
        (
            lambda: dps.LagrangianSystem(lambda t, q, args: 1.0, chain_potential),
            PENDULUM,
            r"shape \(2, 2\)",
        ),
        (
            lambda: dps.LagrangianSystem(chain_mass, chain_potential, np.ones(3)),
            PENDULUM,
            "does not fit `q`",
        ),
        (
            lambda: dps.LagrangianSystem(
                chain_mass, chain_potential, force=lambda t, q, v, args: np.ones(3)
            ),
            PENDULUM,
            "`force` must return",
        ),
        (
            lambda: dps.LagrangianSystem(chain_mass, lambda t, q, args: q),
            PENDULUM,
            "a real scalar",
        ),
    ],
)
def test_wrong_shapes_are_an_error(make, y0, message):
    with pytest.raises(ValueError, match=message):
        solve(make(), dps.PresymplecticGauss(2), 0.0, 1.0, 0.1, y0)


def test_there_is_no_exact_drift():
    with pytest.raises(ValueError, match="PresymplecticGauss"):
        CHAIN.kinetic_flow(ZERO, jnp.array(0.1), *PENDULUM)


@pytest.mark.slow
def test_any_solver_takes_the_term():
    exact = solve(CHAIN, dps.PresymplecticGauss(8), 0.0, 1.0, 0.05, PENDULUM).ys
    coupled = solve(CHAIN, dps.PresymplecticCoupled(4), 0.0, 1.0, 0.01, PENDULUM).ys
    assert_close(coupled, exact, 1e-6)
    sol: Any = solve(
        *(CHAIN, dfx.Dopri8(), 0.0, 1.0, 0.01, PENDULUM),
        stepsize_controller=dfx.PIDController(rtol=1e-12, atol=1e-12),
    )
    assert_close(sol.ys, exact, 1e-10)
