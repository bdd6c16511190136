"""Dense output: its order between steps, and its values at the steps."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, CARRIES, each, flat, pendulum, Scheme, solve

import diffrax_presym as dps
from diffrax_presym._interpolation import inner_points


SYSTEM = dps.DissipativeHamiltonian(
    dps.QuadraticKinetic(2.0),
    pendulum,
    eta1=dps.ConstantDamping(0.1),
    eta2=dps.LogDamping(1.0, shift=1.0),
)
Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.3, -0.7]))
T1 = 3.0
TS = jnp.linspace(0, T1, 58)

# Each with the order of its dense output.
SOLVERS = {
    "leapfrog": (dps.PresymplecticLeapfrog(), 2),
    "leapfrog, position first": (dps.PresymplecticLeapfrog("position"), 2),
    "Yoshida 4": (dps.PresymplecticYoshida4(), 4),
    "BlanesMoan4": (dps.BlanesMoan4(), 4),
    "BlanesMoanRKN4": (dps.BlanesMoanRKN4(), 4),
    "BlanesMoanRKN6": (dps.BlanesMoanRKN6(), 6),
    "BlanesMoan6": (dps.BlanesMoan6(), 6),
    "SofroniouSpaletta8": (dps.SofroniouSpaletta8(), 8),
    "Tao": (dps.PresymplecticTao(5.0), 2),
}


@functools.cache
def exact():
    saveat = dfx.SaveAt(ts=TS)
    controller = dfx.StepTo(jnp.linspace(0, T1, 57 * 40 + 1))
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(SYSTEM),
        dfx.Dopri8(),
        t0=0.0,
        t1=T1,
        dt0=None,
        y0=Y0,
        saveat=saveat,
        stepsize_controller=controller,
    )
    return jax.tree.map(np.asarray, sol.ys)


@pytest.mark.slow
@pytest.mark.parametrize("half", ["q", "p"])
@pytest.mark.parametrize("name", SOLVERS)
def test_order_between_the_steps(name, half):
    solver, order = SOLVERS[name]
    which = "qp".index(half)
    errors = []
    # At order 8 with steps above rounding.
    for h in (0.3, 0.15) if order == 8 else (0.15, 0.075):
        ys = solve(SYSTEM, solver, 0.0, T1, h, Y0, saveat=dfx.SaveAt(ts=TS)).ys
        error = jax.tree.map(lambda y, e: np.max(np.abs(y - e)), ys, exact())
        errors.append(error[which])
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.3


def dense(solver, dt0=0.3, **kwargs):
    saveat = dfx.SaveAt(t0=True, steps=True, dense=True)
    return solve(
        SYSTEM, solver, 0.0, T1, dt0, Y0, saveat=saveat, max_steps=10, **kwargs
    )


@pytest.mark.parametrize("name", ["leapfrog", "BlanesMoanRKN6"])
def test_dense_output_is_exact_at_the_steps(name):
    sol = dense(SOLVERS[name][0])
    steps = np.asarray(sol.ts)
    for i, t in enumerate(steps[steps < np.inf]):
        at = sol.evaluate(jnp.asarray(t))
        assert_close(at, jax.tree.map(lambda y, i=i: y[i], sol.ys), 1e-15)


@pytest.mark.parametrize("name", ["Yoshida 4", "BlanesMoanRKN6"])
def test_derivative_is_the_vector_field(name):
    sol, t = dense(SOLVERS[name][0]), jnp.array(1.1)
    slope = dps.HamiltonianTerm(SYSTEM).vf(t, sol.evaluate(t), None)
    assert_close(sol.derivative(t), slope, 2e-3 if name == "Yoshida 4" else 2e-6)


def test_differences_within_a_step():
    # For a whole solution, Diffrax supports them only if the state is one array.
    term, solver = dps.HamiltonianTerm(SYSTEM), dps.BlanesMoanRKN6()
    t0, t1 = jnp.array(0.0), jnp.array(0.3)
    carry = solver.init(term, t0, t1, Y0, None)
    _, _, info, _, _ = solver.step(term, t0, t1, Y0, None, carry, made_jump=False)
    step = dps.HermiteInterpolation(t0=t0, t1=t1, **info)
    difference = jax.tree.map(jnp.subtract, step.evaluate(0.2), step.evaluate(0.1))
    assert_close(step.evaluate(0.1, 0.2), difference, 1e-15)


def test_dense_output_backwards_in_time():
    solver = dps.BlanesMoanRKN6()
    saveat = dfx.SaveAt(dense=True)
    end = jax.tree.map(lambda y: y[-1], exact())
    sol = solve(SYSTEM, solver, T1, 0.0, -0.1, end, saveat=saveat, max_steps=30)
    for i in (10, 31, 50):
        expected = jax.tree.map(lambda y, i=i: y[i], exact())
        assert_close(sol.evaluate(TS[i]), expected, 1e-7)


@pytest.mark.parametrize("name", ["leapfrog", "BlanesMoanRKN6", "Tao"])
def test_an_empty_solve_is_its_start(name):
    t = jnp.array(0.5)
    saveat = dfx.SaveAt(t0=True, t1=True, ts=jnp.array([0.5, 0.5]), dense=True)
    sol = solve(SYSTEM, SOLVERS[name][0], t, t, 0.1, Y0, saveat=saveat, max_steps=4)
    expected = flat(Y0)
    assert_close(sol.evaluate(t), Y0, 0.0)
    for i in range(4):
        saved = jax.tree.map(lambda y, i=i: y[i], sol.ys)
        assert np.array_equal(flat(saved), expected)


def test_dense_output_under_vmap():
    solver = dps.BlanesMoanRKN4()
    scales = jnp.array([0.5, 1.0, 1.5])

    def at(scale, t):
        y0 = jax.tree.map(lambda y: scale * y, Y0)
        sol = dfx.diffeqsolve(
            dps.HamiltonianTerm(SYSTEM),
            solver,
            t0=0.0,
            t1=T1,
            dt0=0.3,
            y0=y0,
            saveat=dfx.SaveAt(dense=True),
            max_steps=10,
        )
        return sol.evaluate(t)

    t = jnp.array(1.23)
    batch = jax.vmap(at, in_axes=(0, None))(scales, t)
    for i, scale in enumerate(scales):
        assert_close(jax.tree.map(lambda y, i=i: y[i], batch), at(scale, t), 1e-14)


# Properties of every scheme, in both directions of time.


@eqx.filter_jit
def at_the_steps(sol):
    """Value and derivative at the steps, and the expected derivative."""
    term = dps.HamiltonianTerm(SYSTEM)
    expected = jax.vmap(lambda t, y: term.vf(t, y, None))(sol.ts, sol.ys)
    return jax.vmap(lambda t: (sol.evaluate(t), sol.derivative(t)))(sol.ts), expected


@pytest.mark.parametrize("t0, t1", [(0.0, T1), (T1, 0.0)], ids=["there", "back"])
@each(CARRIES)
def test_value_and_slope_at_the_steps_of_every_scheme(scheme: Scheme, t0, t1):
    dt0 = (t1 - t0) / 8
    saveat = dfx.SaveAt(t0=True, steps=True, dense=True)
    kwargs = dict(saveat=saveat, max_steps=8)
    sol = solve(SYSTEM, scheme.solver, t0, t1, dt0, Y0, **kwargs)
    assert sol.ts is not None and np.all(np.isfinite(sol.ts))
    (values, slopes), expected = at_the_steps(sol)
    assert_close(values, sol.ys, 0)  # bit for bit
    assert_close(slopes, expected, 1e-12)


# A single step, without a solver

CUBIC = np.array([0.3, -1.0, 0.5, 2.0])
QUINTIC = np.array([0.2, 0.1, -0.7, 0.4, -1.0, 1.5])
NONIC = np.array([0.05, -0.1, 0.03, 0.2, *QUINTIC])


def value(polynomial, t, m=0):
    """A derivative of a polynomial, as a pytree."""
    x = jnp.asarray(np.polyval(np.polyder(polynomial, m), t))
    return {"a": jnp.array([x, 2 * x]), "b": (x,)}


def hermite(polynomial, t0, t1, number):
    scaled = lambda t, m: jax.tree.map(
        lambda x: (t1 - t0) ** m * x, value(polynomial, t, m)
    )
    ends = dict(y0=scaled(t0, 0), y1=scaled(t1, 0), k0=scaled(t0, 1), k1=scaled(t1, 1))
    if number:
        times = [t0 + (t1 - t0) * x for x in inner_points(number)]
        stack = lambda m: jax.tree.map(
            lambda *x: jnp.stack(x), *(scaled(t, m) for t in times)
        )
        ends |= dict(inner=(stack(0), stack(1)))
    return dps.HermiteInterpolation(t0=jnp.array(t0), t1=jnp.array(t1), **ends)


@pytest.mark.parametrize("t0, t1", [(0.5, 2.0), (2.0, 0.5)])
@pytest.mark.parametrize(
    "polynomial, number",
    [(CUBIC, 0), (QUINTIC, 1), (NONIC, 3)],
    ids=["cubic", "quintic", "nonic"],
)
def test_polynomials_are_met_exactly(polynomial, number, t0, t1):
    step = hermite(polynomial, t0, t1, number)
    for t in (0.5, 0.8, 1.4, 2.0):
        assert_close(step.evaluate(jnp.array(t)), value(polynomial, t), 1e-14)
        assert_close(step.derivative(jnp.array(t)), value(polynomial, t, 1), 1e-13)


def test_a_quintic_is_no_cubic():
    y = hermite(QUINTIC, 0.5, 2.0, 0).evaluate(jnp.array(1.4))
    assert np.max(np.abs(flat(y) - flat(value(QUINTIC, 1.4)))) > 1e-3


@pytest.mark.parametrize("number", [0, 3], ids=["cubic", "nonic"])
def test_a_step_of_no_length_has_a_derivative(number):
    # As under `vmap`, when one solve terminates before the others.
    step = hermite(QUINTIC, 1.0, 1.0, number)

    def first(y0):
        ends = dict(k0=step.k0, k1=step.k1, inner=step.inner)
        at = dps.HermiteInterpolation(t0=step.t0, t1=step.t1, y0=y0, y1=y0, **ends)
        return at.evaluate(jnp.array(1.0))["b"][0]

    gradient = jax.grad(first)(step.y0)
    assert_close(gradient, {"a": jnp.zeros(2), "b": (jnp.array(1.0),)}, 0)
