"""Invalid states, terms and solvers raise a clear error before any computation.

Each message says what was given, what is expected, and what to write instead.
"""

# pyright: reportArgumentType=false, reportOptionalSubscript=false

from functools import partial

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
import pytest
from catalogue import each, PATHS, Scheme
from errors import check, mechanics, PAIR, raising, trace
from helpers import mixed_energy, oscillator, substeps

import diffrax_presym as dps


TERM = oscillator()
LEAPFROG = dps.PresymplecticLeapfrog()


# States

STATE = "The state must be a pair `(q, p)` of positions and momenta"
ALIKE, REAL = (
    f"{STATE} of one structure, shape and precision",
    f"{STATE} in real floating point",
)
WRITE = "Write `y0=(q0, p0)`"
x, x32 = jnp.ones(2), jnp.ones(2, jnp.float32)
STATES = {
    "an array": (x, "got float64[2]", STATE, WRITE),
    "a triple": ((x, x, x), "(float64[2], ", STATE, WRITE),
    "a dict": ({"q": x, "p": x}, "{p: float64[2], q: float64[2]}", STATE, WRITE),
    "structures": (({"a": x}, {"b": x}),
        "q of {a: float64[2]} and p of {b: float64[2]}", ALIKE, "one"),
    "shapes": ((x, jnp.ones(3)), "q of float64[2] and p of float64[3]", ALIKE, "shape"),
    "precisions": ((x, x32), "q of float64[2] and p of float32[2]", ALIKE, "precision"),
}  # fmt: skip


@raising(STATES)
@pytest.mark.parametrize("solver", [LEAPFROG, dfx.Tsit5()], ids=["ours", "Diffrax's"])
def test_states(act, parts, solver):
    # In single precision, as `diffeqsolve` promotes states to the precision of time.
    check(lambda: trace(TERM, solver, act, dtype=jnp.float32), parts)


@pytest.mark.filterwarnings("ignore:Complex dtype support")
def test_complex_states():
    y0 = (jnp.ones(2, complex), jnp.ones(2, complex))
    parts = "complex128[2]", REAL, "its real and imaginary parts"
    check(lambda: trace(TERM, LEAPFROG, y0), parts)


@each(PATHS)
def test_integer_states_are_for_diffeqsolve_to_convert(scheme: Scheme):
    y0, t = (jnp.ones(2, int), jnp.ones(2, int)), jnp.array(0.0)
    act = lambda: eqx.filter_eval_shape(scheme.solver.init, TERM, t, t, y0, None)
    check(act, ("int64[2]", REAL, "`jnp.asarray(x, float)`"))


# Terms

ODE = dfx.ODETerm(lambda t, y, args: y)
STEPPED = (
    "Presymplectic solvers need a system such as `MechanicalSystem(kinetic, potential)`"
)
HAND_WRITTEN = "`MechanicalSystem(kinetic, ForceField(force))`"
PARTS, GAUSS = "`MechanicalSystem(kinetic, potential)`", "`PresymplecticGauss()`"
MIXED = dps.Hamiltonian(mixed_energy, dps.ConstantDamping(0.2))
SPLIT = "a system split into a kinetic part and a potential"
FAST = dps.MechanicalSystem(dps.RelativisticKinetic(), lambda t, q, args: jnp.sum(q))
FEW = "only for a quadratic kinetic energy"
VELOCITY = mechanics(force=lambda t, q, v, args: -v)
BY_PLACE = mechanics(friction=dps.PositionDamping(lambda t, q, args: q**2))
WITH_FORCE = dps.Hamiltonian(
    lambda t, q, p, args: p @ p / 2, force=lambda t, q, v, args: -v
)


def backsolve():
    loss = lambda y0: jnp.sum(
        dfx.diffeqsolve(
            *(TERM, LEAPFROG, 0.0, 1.0, 0.01, y0), adjoint=dfx.BacksolveAdjoint()
        ).ys[0]
    )
    return jax.grad(loss)(PAIR)


on = lambda *args: lambda: trace(*args)
TERMS = {
    "ODETerm": (on(ODE, LEAPFROG), "got `ODETerm`", STEPPED, HAND_WRITTEN),
    "MultiTerm": (on(dfx.MultiTerm(ODE, ODE), dps.BlanesMoan4()), "got `MultiTerm`",
        STEPPED, HAND_WRITTEN),
    "not separable": (on(MIXED, LEAPFROG), "This `Hamiltonian` is not separable", GAUSS,
        PARTS),
    "not split": (on(MIXED, dps.BlanesMoan4()), "this `Hamiltonian` is not", SPLIT,
        GAUSS, PARTS),
    "kinetic energy of a Nystroem splitting": (on(FAST, dps.BlanesMoanRKN4()),
        "`BlanesMoanRKN4`", FEW, "`BlanesMoan4()`", "`QuadraticKinetic(mass)`",
        "`QuadraticPotential(stiffness)`"),
    "friction by place, Nystroem": (on(BY_PLACE, dps.TunedRKN6()), "`BlanesMoan4()`",
        "`BlanesMoan6()`"),
    "friction by place, leapfrog": (on(BY_PLACE, LEAPFROG), "depend on time alone",
        "`BlanesMoan4()`"),
    "force, Nystroem": (on(VELOCITY, dps.TunedRKN6()),
        "without a `force=f` of the velocity. Otherwise use `Strang"),
    "force, leapfrog": (on(VELOCITY, LEAPFROG), "`BlanesMoan4()`, which are explicit"),
    "force, multistep": (on(VELOCITY, dps.SymmetricMultistep(8)),
        "use `TunedRKN6()`, `BlanesMoan6()`"),
    "force, linear": (on(VELOCITY, dps.TunedLinear8()),
        "`BlanesMoan6()` or `PresymplecticGauss"),
    "force of an energy": (on(WITH_FORCE, dps.Strang()),
        "give its parts: `MechanicalSystem"),
    "a solver of Diffrax in the loop of the package": (
        lambda: trace(ODE, dfx.Tsit5(), adjoint=dps.FixedStepAdjoint()),
        "does not support `Tsit5`", "`diffrax.RecursiveCheckpointAdjoint()`"),
    "the adjoint of Diffrax with the same solver": (backsolve, "`BacksolveAdjoint()`",
        "not Hamiltonian", "`BacksolveAdjoint(solver=diffrax.Tsit5())`"),
}  # fmt: skip


@raising(TERMS)
def test_terms(act, parts):
    check(act, parts)


def test_a_function_of_the_velocity_as_friction():
    with pytest.raises(IndexError) as error:
        trace(mechanics(friction=lambda v: v[0]), LEAPFROG)
    assert "is called as `eta(t)`" in error.value.__notes__[0]
    assert "`force=f`" in error.value.__notes__[0]


@pytest.mark.parametrize("solver", [LEAPFROG, dps.PresymplecticTao()])
@pytest.mark.parametrize("options", [{}, {"step_ts": jnp.array([0.5])}], ids=str)
def test_step_sizes_by_error_estimate(solver, options):
    controller = dfx.PIDController(rtol=1e-3, atol=1e-3, **options)
    with pytest.raises(RuntimeError, match="does not provide error estimates"):
        trace(TERM, solver, stepsize_controller=controller)
    trace(TERM, dfx.HalfSolver(solver), stepsize_controller=controller)


# Solvers

EVEN = "`SuzukiYoshida(order)` needs a positive even integer"
ROOT_FINDER = "`root_finder` must be an Optimistix root finder"
NEWTON = "`optimistix.Newton(rtol=1e-10, atol=1e-10)`"
SYMMETRIC = "Compositions need a symmetric base"
BASE = "`base` must be a presymplectic solver"
TABLEAU = "alternately drifts that sum to one and kicks that sum to one"
SUM = "`weights` must sum to one"
FIXED = "a coupling that does not change with the step"
OF_LEAPFROG, COUPLING = "`PresymplecticLeapfrog()`", "`PresymplecticTao(coupling)`"
EULER = dps.PresymplecticEuler()
TAO = dps.PresymplecticTao()
WITHOUT_TOLERANCES = dfx.with_stepsize_controller_tols(dfx.VeryChord)()


def splitting(*fractions, order=2, kick_first=True, kind="any"):
    tableau = dps.SplittingTableau(order, kick_first, kind, fractions)
    return lambda: dps.Splitting(tableau)


def call(fn, *args, **options):
    return lambda: fn(*args, **options)


SOLVERS = {
    **{
        f"order {x!r}": (
            call(dps.SuzukiYoshida, x),
            *(f"got {x!r}", EVEN, "`SuzukiYoshida(4)`"),
        )
        for x in (3, 0, -2, 4.0, None)
    },
    "base of Yoshida": (call(dps.PresymplecticYoshida4, EULER), "symmetric"),
    "order of a composition": (call(dps.Composition, LEAPFROG, [1.0], order=0), "got 0",
        "must be a positive integer", "omitted"),
    "base with error estimates": (call(dps.Compensated, dfx.HalfSolver(LEAPFROG)),
        "got a `HalfSolver`", BASE, "`HalfSolver(Compensated(Strang()))`"),
    "weights that almost sum to one": (
        call(dps.Composition, LEAPFROG, [0.5, 0.5 + 1e-9]), "sum to 1.000000001", SUM,
        "divide by their sum"),
    "kicks of a tableau": (splitting(0.5, 1.0, 0.25), "2 kicks that sum to 0.75",
        TABLEAU, "divide each kind by its sum"),
    "numbers of a tableau": (splitting(0.5, float("nan"), 0.5),
        "1 drifts that sum to nan", TABLEAU, "divide each kind"),
    "number of moves of a tableau": (splitting(0.5, 0.5, 0.5, 0.5),
        "2 kicks that sum to 1.0 and 2", TABLEAU, "an odd number of moves"),
    "drifts of a tableau": (splitting(0.5, 1.0, 0.25, kick_first=False),
        "2 drifts that sum to 0.75", TABLEAU, "divide each kind by its sum"),
    **{
        f"order {x!r} of a tableau": (
            lambda x=x: splitting(0.5, 1.0, 0.5, order=x)(),
            *(f"got {x!r}", "a positive integer", "`SplittingTableau(order="),
        )
        for x in (0, 2.0)
    },
    "tableau for an unknown kind of split": (
        lambda: splitting(0.5, 1.0, 0.5, kind="shared")(), "got 'shared'",
        "`SplittingTableau(kind=...)` must be", '"nystrom"'),
    "tableau of another kind": (call(dps.Splitting, (0.5, 1.0, 0.5)),
        "got (0.5, 1.0, 0.5)", "needs a tableau",
        "`Splitting(SplittingTableau(order, kick_first, kind, fractions))`"),
    "base of a composition": (call(dps.Suzuki4, EULER), "`PresymplecticEuler`",
        SYMMETRIC, OF_LEAPFROG),
    **{
        f"base of another kind {i}": (
            call(substeps, base, 2),
            *(f"got {base!r}"[:11], BASE, OF_LEAPFROG),
        )
        for i, base in enumerate([dfx.Tsit5(), dps.PresymplecticLeapfrog])
    },
    "Tao in a composition": (on(TERM, dps.Suzuki4(substeps(TAO, 2))),
        "`PresymplecticTao` needs", FIXED, COUPLING),
    **{
        f"coupling {x}": (
            call(dps.PresymplecticTao, x),
            *(f"got {x}", "must be positive", COUPLING),
        )
        for x in (0.0, -1.0, float("nan"))
    },
    "coupling of another kind": (call(dps.PresymplecticTao, "strong"), "'strong'",
        "a real number", COUPLING),
    "several couplings": (on(TERM, dps.PresymplecticTao(jnp.ones(2))), "has shape (2,)",
        "must be a scalar", "`jax.vmap`"),
    **{
        f"first {x!r}": (
            call(dps.PresymplecticLeapfrog, first=x),
            *(f"got {x!r}", "`first` must be", '"momentum" or "position"'),
        )
        for x in ("q", None)
    },
    **{
        f"root finder {x}": (
            call(dps.PresymplecticGauss, 2, x),
            *(f"got {x!r}"[:11], ROOT_FINDER, NEWTON),
        )
        for x in ("newton", optx.Newton, optx.BFGS(rtol=1e-3, atol=1e-3))
    },
    "root finder for one number": (
        call(dps.PresymplecticGauss, 2, optx.Bisection(1e-8, 1e-8)),
        "`root_finder` solves for many numbers", "`optimistix.Bisection` is for one",
        NEWTON),
    "root finder without tolerances": (
        call(dps.PresymplecticGauss, 2, WITHOUT_TOLERANCES), "`root_finder` needs",
        "needs a tolerance `rtol`", NEWTON),
    "compensated twice": (
        lambda: dps.Compensated(substeps(dps.Compensated(dps.TunedRKN6()), 2)),
        "Remove one"),
}  # fmt: skip


@raising(SOLVERS)
def test_solvers(act, parts):
    check(act, parts)


# Arguments of functions, by their names.

ORDERS = {
    "a potential": (lambda: mechanics(potential=lambda q, t, args: jnp.sum(q)),
        "`V(t, q, args)`", "got one of the arguments (q, t, args)"),
    "a force": (lambda: mechanics(force=lambda t, v, q, args: -v),
        "`f(t, q, v, args)`", "the arguments (t, v, q, args)"),
    "an energy": (lambda: dps.Hamiltonian(lambda q, p, t, args: q @ p),
        "`E(t, q, p, args)`", "the arguments (q, p, t, args)"),
    "friction": (lambda: dps.PositionDamping(lambda q, t, args: 0.1),
        "`rate(t, q, args)`", "the arguments (q, t, args)"),
}  # fmt: skip


@raising(ORDERS)
def test_arguments_in_another_order(act, parts):
    check(act, parts)


def test_arguments_of_any_other_names():
    square = lambda t, x, *args: jnp.sum(x**2)
    mechanics(potential=square, force=lambda time, x, u, args=None: -u)
    mechanics(potential=partial(lambda k, t, q, args: k * jnp.sum(q**2), 2.0))


def test_equal_weights_ask_nothing_of_the_base():
    substeps(EULER, 3)
    substeps(TAO, 3)
    dps.Composition(EULER, [0.5, 0.5])


@pytest.mark.parametrize(
    "solver, term",
    [
        (LEAPFROG, TERM),
        (dps.TunedRKN6(), mechanics(friction=dps.ViscousDamping(jnp.eye(2)))),
    ],
    ids=["the last force", "exponentials"],
)
def test_steps_without_a_solver_state_that_is_needed(solver, term):
    step = lambda solver, term, state: solver.step(
        term, 0.0, 0.1, PAIR, None, state, made_jump=False
    )
    parts = "got `solver_state=None`", "has a solver state", "solver.init("
    check(lambda: step(solver, term, None), parts)
    step(solver, term, solver.init(term, 0.0, 0.1, PAIR, None))
    step(dps.PresymplecticLeapfrog("position"), TERM, None)
