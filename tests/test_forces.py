# pyright: reportMissingImports=false, reportOptionalMemberAccess=false
"""Any force of the velocity in explicit schemes: `MechanicalSystem(..., force=f)`."""

import functools
import pathlib
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import step

import diffrax_presym as dps


sys.path.append(str(pathlib.Path(__file__).parents[1] / "benchmarks"))
import problems_forces


SCHEMES = [
    dps.Strang(),
    dps.BlanesMoan4(),
    dps.BlanesMoan6(),
    dps.SuzukiYoshida(4, dps.Strang()),
]
UNIT = dps.QuadraticKinetic()
successful = dfx.RESULTS.successful


@pytest.fixture(autouse=True)
def _as_users_write():
    """The forces are written as those of users, who broadcast."""
    rank, promotion = jax.numpy_rank_promotion, jax.numpy_dtype_promotion
    with rank("allow"), promotion("standard"):
        yield


@functools.cache
def problem(name):
    """A problem of few bodies, and its solution by SciPy."""
    number = 16 if name == "charge" else 3
    found = getattr(problems_forces, name)(number)
    return found, found.exact(2.0)


def spring(t, q, args):
    return jnp.sum(q**2) / 2 + jnp.sum(q**4) / 4


def tanh_friction(t, q, v, args):
    return -args["strength"] * jnp.tanh((v - args["belt"]) / 0.3)


ARGS = {"strength": jnp.array(0.4), "belt": jnp.array([0.2, 0.0])}
Y0 = (jnp.array([1.0, -0.5]), jnp.array([0.2, 0.3]))
RUBBED = dps.MechanicalSystem(dps.QuadraticKinetic(1.5), spring, force=tanh_friction)


def ends(system, solver, t1, n, y0, args=None, **options):
    options = {"adjoint": dps.FixedStepAdjoint(), "throw": False} | options
    sol = dfx.diffeqsolve(
        system, solver, 0.0, t1, t1 / n, y0, args, max_steps=4096, **options
    )
    return jax.tree.map(lambda y: y[-1], sol.ys), sol.result


@pytest.mark.variants(10)
@pytest.mark.parametrize("solver", SCHEMES[:3], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("name", [make.__name__ for make in problems_forces.FORCES])
def test_order(name, solver):
    """Of positions and of momenta, against SciPy on the bare equations."""
    problem_, exact = problem(name)
    y0, order = tuple(map(jnp.asarray, problem_.y0)), solver.order(None)
    solve = jax.jit(lambda n: ends(problem_.system, solver, 2.0, n, y0))
    # Until rounding, or the error of SciPy.
    errors = {}
    for n in (16, 24, 32, 48, 64, 96, 128, 192, 256):
        y, result = solve(float(n))
        assert result == successful
        errors[n] = [np.max(np.abs(a - b)) for a, b in zip(y, exact, strict=True)]
        if max(errors[n]) < 1e-10:
            break
    last = sorted(errors)[-3:]
    for i in (0, 1):
        logs = np.log([errors[n][i] for n in last])
        slope = -np.polyfit(np.log(last), logs, 1)[0]
        assert abs(slope - order) < 0.35, (slope, errors)


@pytest.mark.variants(10)
@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("name", [make.__name__ for make in problems_forces.FORCES])
def test_a_step_is_undone(name, solver):
    problem_, _ = problem(name)
    y0 = tuple(map(jnp.asarray, problem_.y0))
    y = step(problem_.system, solver, 0.3, 0.4, y0)[0]
    assert max(np.max(np.abs(a - b)) for a, b in zip(y, y0, strict=True)) > 0.01
    back = step(problem_.system, solver, 0.4, 0.3, y)[0]
    size = max(np.max(np.abs(x)) for x in y0)
    assert all(
        np.max(np.abs(a - b)) < 2e-14 * size for a, b in zip(back, y0, strict=True)
    )


def higuera_cary(q, p, h, steps, c, electric, magnetic):
    """Higuera and Cary (2017), of charge and mass one: half drifts, and between them
    half kicks around a rotation, by the Lorentz factor of their middle."""
    velocity = lambda p: p / np.sqrt(1 + p @ p / c**2)
    for _ in range(steps):
        q = q + h / 2 * velocity(p)
        p = p + h / 2 * electric(q)
        tau = h / 2 * magnetic(q)
        sigma = 1 + p @ p / c**2 - tau @ tau
        square = tau @ tau + (p @ tau) ** 2 / c**2
        t = tau / np.sqrt((sigma + np.sqrt(sigma**2 + 4 * square)) / 2)
        p = (p + (p @ t) * t + np.cross(p, t)) / (1 + t @ t)
        p = p + np.cross(p, t) + h / 2 * electric(q)
        q = q + h / 2 * velocity(p)
    return q, p


def _bottle(xp, q):
    x, y, z = q[0], q[1], q[2]
    return xp.stack([-0.2 * x * z, -0.2 * y * z, 2 + 0.2 * z**2])


def _charge(strength):
    """A relativistic charge in a magnetic bottle and an electric trap."""
    return dps.MechanicalSystem(
        dps.RelativisticKinetic(1.0, 2.0),
        lambda t, q, args: strength * q @ q / 2,
        force=lambda t, q, v, args: jnp.cross(v, _bottle(jnp, q)),
    )


def test_against_higuera_and_cary():
    """The same limit, and no larger error at equal steps."""
    y0 = jnp.array([0.5, 0.0, 0.3]), jnp.array([0.0, 1.5, 0.5])
    system, n = _charge(0.3), 200
    exact, _ = ends(system, dps.BlanesMoan6(), 10.0, 2000, y0)
    electric, magnetic = (lambda q: -0.3 * q), lambda q: _bottle(np, q)

    def theirs(n):
        q0, p0 = map(np.asarray, y0)
        y = higuera_cary(q0, p0, 10.0 / n, n, 2.0, electric, magnetic)
        return max(np.max(np.abs(a - b)) for a, b in zip(y, exact, strict=True))

    def ours(n):
        y, _ = ends(system, dps.Strang(), 10.0, n, y0)
        return max(np.max(np.abs(a - b)) for a, b in zip(y, exact, strict=True))

    assert np.log2(theirs(n) / theirs(2 * n)) == pytest.approx(2, abs=0.1)
    assert np.log2(ours(n) / ours(2 * n)) == pytest.approx(2, abs=0.1)
    assert ours(n) < 1.2 * theirs(n)


@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
def test_a_magnetic_force_does_no_work(solver):
    y0 = jnp.array([0.5, 0.0, 0.3]), jnp.array([0.0, 1.5, 0.5])
    y, result = ends(_charge(0.0), solver, 20.0, 200, y0)
    assert result == successful
    sizes = [np.linalg.norm(x) for x in (y[1], y0[1])]
    assert abs(sizes[0] - sizes[1]) < 2e-13


_cross = lambda b: jnp.array([[0, -b[2], b[1]], [b[2], 0, -b[0]], [-b[1], b[0], 0]])
_UNIFORM = np.array([0.0, 0.1, 3.0])


@pytest.mark.parametrize(
    "law, field",
    [
        (lambda t, q, args: _cross(_bottle(jnp, q)), lambda q: _bottle(jnp, q)),
        (_cross(_UNIFORM), lambda q: _UNIFORM),
    ],
    ids=["bottle", "uniform"],
)
def test_magnetic_friction_with_a_relativistic_energy(law, field):
    """A law of friction per velocity is the same as its force."""
    law = dps.ViscousDamping(law)
    kinetic, potential = dps.RelativisticKinetic(1.0, 2.0), _charge(0.3).potential
    y0 = jnp.array([0.5, 0.0, 0.3]), jnp.array([0.0, 1.5, 0.5])
    found = [
        ends(system, dps.BlanesMoan4(), 5.0, 50, y0)[0]
        for system in (
            dps.MechanicalSystem(kinetic, potential, [law, dps.ConstantDamping(0.1)]),
            dps.MechanicalSystem(
                kinetic,
                potential,
                dps.ConstantDamping(0.1),
                force=lambda t, q, v, args: jnp.cross(v, field(q)),
            ),
        )
    ]
    for a, b in zip(*found, strict=True):
        assert np.max(np.abs(a - b)) < 1e-13


@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize(
    "adjoint",
    [
        dps.FixedStepAdjoint(),
        dps.FixedStepAdjoint("checkpoints"),
        dfx.RecursiveCheckpointAdjoint(),
    ],
    ids=["reversal", "checkpoints", "Diffrax"],
)
def test_gradient(solver, adjoint):
    """By arguments, by what the force closes over, and by the initial state."""

    def loss(inputs):
        y0, args, gain = inputs

        def force(t, q, v, args):
            return tanh_friction(t, q, v, args) - gain * v * jnp.sum(v**2)

        system = dps.MechanicalSystem(dps.QuadraticKinetic(1.5), spring, force=force)
        y, _ = ends(system, solver, 2.0, 20, y0, args, adjoint=adjoint)
        return jnp.sum(jnp.sin(y[0]) + y[1] ** 2)

    inputs = Y0, ARGS, jnp.array(0.1)
    found, loss = jax.jit(jax.grad(loss))(inputs), jax.jit(loss)
    along = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size)).reshape(x.shape), inputs)
    products = jax.tree.map(lambda a, b: jnp.sum(a * b), found, along)
    move = lambda s: jax.tree.map(lambda x, d: x + s * d, inputs, along)
    wanted = (loss(move(1e-5)) - loss(move(-1e-5))) / 2e-5
    assert abs(sum(jax.tree.leaves(products)) - wanted) < 1e-7 * abs(wanted)


def test_a_momentum_that_changes_its_sign():
    """A kick may end so close to zero that its own rounding errors are larger."""
    system = dps.MechanicalSystem(
        UNIT,
        lambda t, q, args: q**2 / 2,
        force=lambda t, q, v, args: -0.3 * jnp.tanh(v / 0.5),
    )

    def one(p):
        return ends(system, dps.BlanesMoan4(), 0.1, 1, (jnp.ones(()), p))[1]

    result = jax.jit(jax.vmap(one))(jnp.linspace(0.0, 0.1, 20_001))
    assert jnp.all(result == successful)


@pytest.mark.parametrize("adjoint", [dps.FixedStepAdjoint(), None], ids=repr)
@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
def test_too_stiff_for_the_step(solver, adjoint):
    """Dry friction that is smoothed too little fails, and says why."""
    rub = lambda t, q, v, args: -jnp.tanh(v / 1e-4)
    system = dps.MechanicalSystem(UNIT, spring, force=rub)
    options = {} if adjoint is None else {"adjoint": adjoint}
    solve = lambda n, **more: dfx.diffeqsolve(
        *(system, solver, 0.0, 2.0, 2.0 / n, Y0),
        **{"max_steps": 10**6, "throw": False} | options | more,
    )
    result = solve(20).result
    assert result != successful
    assert "too stiff for the step" in dfx.RESULTS[result]
    with pytest.raises(RuntimeError, match="too stiff for the step"):
        solve(20, throw=True)


@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("step", [0.03, 0.1, 0.3])
@pytest.mark.parametrize("width", [1e-5, 1e-7, 0.0])
def test_a_force_that_is_flat_where_a_kick_ends_is_too_stiff(solver, step, width):
    """Where its steep part throws the momentum, the equation of a kick converges."""
    rub = lambda t, q, v, args: -jnp.tanh(v / width) if width else -jnp.sign(v)
    system = dps.MechanicalSystem(UNIT, spring, force=rub)
    start = jnp.array([5.0, 3.0]), jnp.zeros(2)
    n = int(20 / step)
    y, result = ends(system, solver, 20.0, n, start)
    assert result != successful or np.max(np.abs(np.stack(y))) < 6


def test_a_member_of_a_batch_fails_alone():
    def one(width):
        rub = lambda t, q, v, args: -jnp.tanh(v / width)
        system = dps.MechanicalSystem(UNIT, spring, force=rub)
        return ends(system, dps.BlanesMoan4(), 2.0, 20, Y0)

    y, result = jax.vmap(one)(jnp.array([1e-5, 0.5, 0.0, 1.0]))
    assert (result == successful).tolist() == [False, True, False, True]
    alone, _ = one(0.5)
    assert np.max(np.abs(y[1][1] - alone[1])) < 1e-14


@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
def test_from_rest(solver):
    """The derivative of a speed is not finite at rest; the force is."""
    drag = lambda t, q, v, args: -0.3 * jnp.linalg.norm(v) * v
    y0, found = (Y0[0], jnp.zeros(2)), []
    for more in ({"force": drag}, {"friction": dps.Drag(0.3)}):
        system = dps.MechanicalSystem(UNIT, spring, **more)
        y, result = ends(system, solver, 2.0, 200, y0)
        assert result == successful
        found.append(y)
    for a, b in zip(*found, strict=True):
        # Of a force that is smooth once at rest, the order is no more than about four.
        assert np.max(np.abs(a - b)) < 1e-4 ** min(solver.order(None) / 2, 2)


def test_the_force_of_the_potential_is_evaluated_once_per_kick():
    count = []

    def field(t, q, args):
        jax.debug.callback(lambda: count.append(1))
        return -q

    rub = lambda t, q, v, args: -jnp.tanh(v)
    system = dps.MechanicalSystem(UNIT, dps.ForceField(field), force=rub)
    ends(system, dps.BlanesMoan6(), 1.0, 10, Y0)
    jax.effects_barrier()
    assert len(count) == 100


@pytest.mark.parametrize("size", [1e4, 1e7])
@pytest.mark.parametrize("solver", SCHEMES, ids=lambda x: type(x).__name__)
def test_forces_that_balance_each_other(solver, size):
    """The equation of a kick is solved to the rounding of the largest of them."""
    quadratic = lambda v: -v * jnp.sqrt(v**2 + 0.01)
    found = []
    for load in (0.0, size):
        system = dps.MechanicalSystem(
            *(UNIT, lambda t, q, args, x=load: spring(t, q, args) - x * jnp.sum(q)),
            force=lambda t, q, v, args, x=load: quadratic(v) - x,
        )
        y, result = ends(system, solver, 2.0, 200, Y0)
        assert result == successful
        found.append(np.stack(y))
    np.testing.assert_allclose(*found, atol=1e-15 * size * 200)
