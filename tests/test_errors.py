"""Invalid input raises a clear error before any computation.

Each message says what was given, what is expected, and what to write instead.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from helpers import (
    assert_close,
    CARRIES,
    each,
    harmonic,
    mixed_energy,
    oscillator,
    Scheme,
    substeps,
    WAYS,
)

import diffrax_presym as dps


TERM = oscillator()
KINETIC = dps.QuadraticKinetic()
DAMPING = dps.ConstantDamping(0.2)
LEAPFROG = dps.PresymplecticLeapfrog()
BY_MATRIX = dps.MechanicalSystem(KINETIC, harmonic, dps.ViscousDamping(jnp.eye(2)))
PAIR = (jnp.ones(2), jnp.ones(2))
NONSEPARABLE = {
    "undamped": dps.Hamiltonian(mixed_energy),
    "damped": dps.Hamiltonian(mixed_energy, DAMPING),
}


def trace(term, solver, y0=PAIR, **kwargs):
    """Trace a solve, without computing it, so errors are raised at trace time."""
    dtype = kwargs.pop("dtype", jnp.float64)
    t0, t1, dt0 = (jnp.array(t, dtype) for t in (0.0, 1.0, 0.1))
    run = lambda y0: dfx.diffeqsolve(term, solver, t0, t1, dt0, y0, **kwargs).ys
    eqx.filter_eval_shape(run, y0)


def system(kinetic: Callable = KINETIC, potential=harmonic, **kwargs):
    """Trace a solve of a system with invalid parts."""
    solver = dps.PresymplecticGauss(2) if kwargs else LEAPFROG
    trace(dps.MechanicalSystem(kinetic, potential, **kwargs), solver)


class Mistake(NamedTuple):
    given: str
    needed: str
    instead: str

    def check(self, error: pytest.ExceptionInfo):
        message = str(error.value)
        for part in self:
            assert part in message


def splitting(*fractions, order=2, kick_first=True):
    return dps.Splitting(dps.SplittingTableau(order, kick_first, "any", fractions))


def mistakes(cases):
    return pytest.mark.parametrize(
        "act, mistake", list(cases.values()), ids=list(cases)
    )


# States

STATE = "The state must be a pair `(q, p)` of positions and momenta"
ALIKE = f"{STATE} of one structure, shape and precision"
REAL = f"{STATE} in real floating point"
x, x32 = jnp.ones(2), jnp.ones(2, jnp.float32)

STATES = {
    "an array": (x, Mistake("got float64[2]", STATE, "Write `y0=(q0, p0)`")),
    "a triple": ((x, x, x), Mistake("(float64[2], ", STATE, "Write `y0=(q0, p0)`")),
    "a dict": (
        {"q": x, "p": x},
        Mistake("{p: float64[2], q: float64[2]}", STATE, "Write `y0=(q0, p0)`"),
    ),
    "structures": (
        ({"a": x}, {"b": x}),
        Mistake("q of {a: float64[2]} and p of {b: float64[2]}", ALIKE, "one"),
    ),
    "shapes": (
        (x, jnp.ones(3)),
        Mistake("q of float64[2] and p of float64[3]", ALIKE, "shape"),
    ),
    "precisions": (
        (x, x32),
        Mistake("q of float64[2] and p of float32[2]", ALIKE, "precision"),
    ),
}


@pytest.mark.parametrize("y0, mistake", list(STATES.values()), ids=list(STATES))
@pytest.mark.parametrize("solver", [LEAPFROG, dfx.Tsit5()], ids=["ours", "Diffrax's"])
def test_states(y0, mistake, solver):
    # In single precision, as `diffeqsolve` promotes states to the precision of time.
    with pytest.raises(ValueError) as error:
        trace(TERM, solver, y0, dtype=jnp.float32)
    mistake.check(error)


@pytest.mark.filterwarnings("ignore:Complex dtype support")
def test_complex_states():
    y0 = (jnp.ones(2, complex), jnp.ones(2, complex))
    with pytest.raises(ValueError) as error:
        trace(TERM, LEAPFROG, y0)
    Mistake("complex128[2]", REAL, "its real and imaginary parts").check(error)


@each(WAYS)
def test_integer_states_are_for_diffeqsolve_to_convert(scheme: Scheme):
    y0 = (jnp.ones(2, int), jnp.ones(2, int))
    t0, t1 = jnp.array(0.0), jnp.array(0.1)
    with pytest.raises(ValueError) as error:
        eqx.filter_eval_shape(scheme.solver.init, TERM, t0, t1, y0, None)
    Mistake("int64[2]", REAL, "`jnp.asarray(x, float)`").check(error)


# Terms

ODE = dfx.ODETerm(lambda t, y, args: y)
STEPPED = (
    "Presymplectic solvers need a system such as `MechanicalSystem(kinetic, potential)`"
)
HAND_WRITTEN = "`MechanicalSystem(kinetic, ForceField(force))`"


@pytest.mark.parametrize("term", [ODE, dfx.MultiTerm(ODE, ODE)])
@each(CARRIES)
def test_terms_of_another_kind(scheme: Scheme, term):
    with pytest.raises(ValueError) as error:
        trace(term, scheme.solver)
    Mistake(f"got `{type(term).__name__}`", STEPPED, HAND_WRITTEN).check(error)


@eqx.filter_jit
def _gradient(adjoint):
    def loss(y0):
        t0, t1, dt0 = jnp.array(0.0), jnp.array(1.0), jnp.array(0.01)
        sol = dfx.diffeqsolve(TERM, LEAPFROG, t0, t1, dt0, y0, adjoint=adjoint)
        assert sol.ys is not None
        return jnp.sum(sol.ys[0] ** 2 + sol.ys[1])

    return jax.grad(loss)(PAIR)


@pytest.mark.slow
def test_backsolve_adjoint():
    backsolve = _gradient(dfx.BacksolveAdjoint(solver=dfx.Tsit5()))
    # Up to the error of the leapfrog, as the adjoint equations are continuous.
    assert_close(backsolve, _gradient(dfx.RecursiveCheckpointAdjoint()), 1e-4)


def test_backsolve_adjoint_with_the_same_solver():
    with pytest.raises(ValueError) as error:
        _gradient(dfx.BacksolveAdjoint())
    instead = "`BacksolveAdjoint(solver=diffrax.Tsit5())`"
    Mistake("`BacksolveAdjoint()`", "not Hamiltonian", instead).check(error)


# Energies that a scheme does not support

PARTS = "`MechanicalSystem(kinetic, potential)`"


@pytest.mark.parametrize("hamiltonian", list(NONSEPARABLE.values()), ids=NONSEPARABLE)
@each(kinds=("frozen",))
def test_nonseparable_energies_are_refused(scheme: Scheme, hamiltonian):
    with pytest.raises(ValueError) as error:
        trace(hamiltonian, scheme.solver)
    message = str(error.value)
    assert f"This `{type(hamiltonian).__name__}` is not separable" in message
    # Both alternatives.
    assert all(x in message for x in ("`PresymplecticGauss()`", PARTS))


SPLIT = "a system split into a kinetic part and a potential"


@pytest.mark.parametrize("hamiltonian", list(NONSEPARABLE.values()), ids=NONSEPARABLE)
@pytest.mark.parametrize("solver", [dps.BlanesMoan4(), dps.BlanesMoanRKN4()])
def test_splittings_need_a_split_energy(solver, hamiltonian):
    with pytest.raises(ValueError) as error:
        trace(hamiltonian, solver)
    given = f"this `{type(hamiltonian).__name__}` is not"
    Mistake(given, SPLIT, "`PresymplecticGauss()`").check(error)
    assert PARTS in str(error.value)


@pytest.mark.parametrize("solver", [dps.BlanesMoanRKN4(), dps.BlanesCasasRKN8()])
def test_nystroem_splittings_need_a_quadratic_kinetic_energy(solver):
    with pytest.raises(ValueError) as error:
        trace(dps.MechanicalSystem(dps.RelativisticKinetic(), harmonic), solver)
    needed = "only for a quadratic kinetic energy"
    Mistake(f"`{type(solver).__name__}`", needed, "`BlanesMoan4()`").check(error)
    assert "`QuadraticKinetic(mass)`" in str(error.value)


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
WITHOUT_TOLERANCES = dfx.with_stepsize_controller_tols(dfx.VeryChord)()

SOLVERS = {
    **{
        f"order {order!r}": (
            lambda order=order: dps.SuzukiYoshida(order),  # type: ignore
            Mistake(f"got {order!r}", EVEN, "`SuzukiYoshida(4)`"),
        )
        for order in (3, 0, -2, 4.0, None)
    },
    "order of a composition": (
        lambda: dps.Composition(LEAPFROG, [1.0], order=0),
        Mistake("got 0", "must be a positive integer", "omitted"),
    ),
    "weights that almost sum to one": (
        lambda: dps.Composition(LEAPFROG, [0.5, 0.5 + 1e-9]),
        Mistake("sum to 1.000000001", SUM, "divide by their sum"),
    ),
    **{
        f"tableau of {fractions}": (
            lambda fractions=fractions: splitting(*fractions),
            Mistake(given, TABLEAU, instead),
        )
        for *fractions, given, instead in (
            (0.5, 1.0, 0.25, "2 kicks that sum to 0.75", "divide each kind by its sum"),
            (0.5, float("nan"), 0.5, "1 drifts that sum to nan", "divide each kind"),
            (0.5, 0.5, 0.5, 0.5, "2 kicks that sum to 1.0 and 2", "an odd number of"),
        )
    },
    "drifts of a tableau": (
        lambda: splitting(0.5, 1.0, 0.25, kick_first=False),
        Mistake("2 drifts that sum to 0.75", TABLEAU, "divide each kind by its sum"),
    ),
    **{
        f"order {order!r} of a tableau": (
            lambda order=order: splitting(0.5, 1.0, 0.5, order=order),  # type: ignore
            Mistake(f"got {order!r}", "a positive integer", "`SplittingTableau(order="),
        )
        for order in (0, 2.0)
    },
    "tableau for an unknown kind of split": (
        lambda: dps.Splitting(dps.SplittingTableau(2, True, "shared", (0.5, 1.0, 0.5))),
        Mistake("got 'shared'", "`SplittingTableau(kind=...)` must be", '"nystrom"'),
    ),
    "tableau of another kind": (
        lambda: dps.Splitting((0.5, 1.0, 0.5)),  # type: ignore
        Mistake(
            "got (0.5, 1.0, 0.5)",
            "needs a tableau",
            "`Splitting(SplittingTableau(order, kick_first, kind, fractions))`",
        ),
    ),
    **{
        f"base of a composition {i}": (
            compose,
            Mistake("`PresymplecticEuler`", SYMMETRIC, "`PresymplecticLeapfrog()`"),
        )
        for i, compose in enumerate(
            [
                lambda: dps.SuzukiYoshida(4, base=dps.PresymplecticEuler()),
                lambda: dps.Suzuki4(dps.PresymplecticEuler()),
                lambda: dps.Composition(dps.PresymplecticEuler(), [0.25, 0.5, 0.25]),
            ]
        )
    },
    **{
        f"base of another kind {i}": (
            lambda base=base: substeps(base, 2),  # type: ignore
            Mistake(f"got {base!r}"[:11], BASE, "`PresymplecticLeapfrog()`"),
        )
        for i, base in enumerate([dfx.Tsit5(), dps.PresymplecticLeapfrog])
    },
    **{
        f"Tao in a composition {i}": (
            lambda solver=solver: trace(TERM, solver),
            Mistake("`PresymplecticTao` needs", FIXED, "`PresymplecticTao(coupling)`"),
        )
        for i, solver in enumerate(
            [
                dps.SuzukiYoshida(4, base=dps.PresymplecticTao()),
                dps.Suzuki4(substeps(dps.PresymplecticTao(), 2)),
            ]
        )
    },
    **{
        f"coupling {given}": (
            lambda given=given: dps.PresymplecticTao(given),
            Mistake(f"got {given}", "must be positive", "`PresymplecticTao(coupling)`"),
        )
        for given in (0.0, -1.0, float("nan"))
    },
    "coupling of another kind": (
        lambda: dps.PresymplecticTao("strong"),
        Mistake("'strong'", "a real number", "`PresymplecticTao(coupling)`"),
    ),
    "several couplings": (
        lambda: trace(TERM, dps.PresymplecticTao(jnp.ones(2))),
        Mistake("has shape (2,)", "must be a scalar", "`jax.vmap`"),
    ),
    **{
        f"first {given!r}": (
            lambda given=given: dps.PresymplecticLeapfrog(first=given),  # type: ignore
            Mistake(f"got {given!r}", "`first` must be", '"momentum" or "position"'),
        )
        for given in ("q", None)
    },
    **{
        f"root finder {given}": (
            lambda given=given: dps.PresymplecticGauss(2, given),  # type: ignore
            Mistake(f"got {given!r}"[:11], ROOT_FINDER, NEWTON),
        )
        for given in ("newton", optx.Newton, optx.BFGS(rtol=1e-3, atol=1e-3))
    },
    "root finder without tolerances": (
        lambda: dps.PresymplecticGauss(2, WITHOUT_TOLERANCES),
        Mistake("`root_finder` needs", "needs a tolerance `rtol`", NEWTON),
    ),
}


@mistakes(SOLVERS)
def test_solvers(act, mistake):
    with pytest.raises(ValueError) as error:
        act()
    mistake.check(error)


def test_equal_weights_ask_nothing_of_the_base():
    substeps(dps.PresymplecticEuler(), 3)
    substeps(dps.PresymplecticTao(), 3)
    dps.Composition(dps.PresymplecticEuler(), [0.5, 0.5])


@pytest.mark.parametrize(
    "solver, term",
    [(LEAPFROG, TERM), (dps.TunedRKN6(), BY_MATRIX)],
    ids=["the last force", "exponentials"],
)
def test_steps_without_a_solver_state_that_is_needed(solver, term):
    mistake = Mistake("got `solver_state=None`", "has a solver state", "solver.init(")
    with pytest.raises(ValueError) as error:
        solver.step(term, 0.0, 0.1, PAIR, None, None, made_jump=False)
    mistake.check(error)
    state = solver.init(term, 0.0, 0.1, PAIR, None)
    solver.step(term, 0.0, 0.1, PAIR, None, state, made_jump=False)
    without = dps.PresymplecticLeapfrog("position")
    without.step(TERM, 0.0, 0.1, PAIR, None, None, made_jump=False)


# Hamiltonians

POSITIVE = "must be positive"
ONE_NUMBER = "must return a real scalar for the whole system"
SUM_OVER = "`jnp.sum(...)`"
MASS = "`QuadraticKinetic(mass)`"
LAW = "must be a law of friction, a function eta(t) or a list of these"
RATE = "`ConstantDamping(rate)`"
ONE_RATE = "Only one rate of damping for all momenta has a log scale"
VECTOR, PLACES = jnp.array([0.1, 0.2]), jnp.ones((3, 2))
ASYMMETRIC = jnp.array([[1.0, 0.5], [0.0, 1.0]])
IS_SYMMETRIC, PART = "must be a symmetric matrix", "`(A + A.T) / 2`"

HAMILTONIANS = {
    **{
        f"mass {given}": (
            lambda given=given: dps.QuadraticKinetic(given),
            Mistake(f"got {given}", POSITIVE, MASS),
        )
        for given in (0.0, -1.0, np.array([1.0, -2.0]))
    },
    "negative effective mass": (
        lambda: dps.QuadraticKinetic(-2.0),
        Mistake("got -2.0", "negative effective mass", "a function `T(t, p, args)`"),
    ),
    "mass that is a function": (
        lambda: dps.QuadraticKinetic(lambda q: q),
        Mistake(f"{MASS} must be", "a real number", "`LagrangianSystem`"),
    ),
    "stiffness that is a function": (
        lambda: dps.QuadraticPotential(harmonic),
        Mistake(
            "a real number", "function is passed", "`MechanicalSystem(kinetic, V)`"
        ),
    ),
    **{
        f"{name} that is not symmetric": (
            lambda act=act: act(),
            Mistake(f"`{name}`", IS_SYMMETRIC, PART),
        )
        for name, act in {
            "QuadraticKinetic(mass)": lambda: system(dps.QuadraticKinetic(ASYMMETRIC)),
            "QuadraticPotential(stiffness)": lambda: system(
                potential=dps.QuadraticPotential(ASYMMETRIC)
            ),
        }.items()
    },
    **{
        f"{name} that are not symmetric": (
            lambda stiffness=stiffness, q=q: dps.QuadraticPotential(stiffness)(0.0, q),
            Mistake("`QuadraticPotential(stiffness)`", IS_SYMMETRIC, PART),
        )
        for name, stiffness, q in (
            ("matrices", jnp.stack([jnp.eye(2), ASYMMETRIC]), PLACES[:2]),
            ("pytrees", {"a": ASYMMETRIC}, {"a": VECTOR}),
            ("operators", lx.MatrixLinearOperator(ASYMMETRIC), VECTOR),
        )
    },
    "velocity by a mass that is not symmetric": (
        lambda: dps.EuclideanMirror(np.asarray(ASYMMETRIC)).gradient(VECTOR),
        Mistake(MASS, IS_SYMMETRIC, PART),
    ),
    "complex mass": (
        lambda: dps.QuadraticKinetic(1j),
        Mistake("got 1j", "must be real", MASS),
    ),
    "mass of a wrong shape": (
        lambda: system(dps.QuadraticKinetic(jnp.ones(3))),
        Mistake("of shape (3,)", "does not fit `p` of shape (2,)", "Pass a number, or"),
    ),
    "matrix that is not positive": (
        lambda: dps.QuadraticKinetic(jnp.array([[1.0, 2.0], [2.0, -1.0]])),
        Mistake("got [ 1. -1.]", POSITIVE, f"The diagonal of {MASS}"),
    ),
    "matrix of a wrong shape": (
        lambda: system(dps.QuadraticKinetic(jnp.eye(3))),
        Mistake("got shape (3, 3)", "for `p` of shape (2,)", "one row and column for"),
    ),
    "mass of a wrong structure": (
        lambda: system(dps.QuadraticKinetic({"a": 1.0})),
        Mistake("got PyTreeDef({'a': *})", "of the structure of `p`", "an array"),
    ),
    **{
        f"{name} of a relativistic particle": (
            lambda name=name: dps.RelativisticKinetic(**{name: -1.0}),
            Mistake("got -1.0", POSITIVE, f"`RelativisticKinetic({name}=...)`"),
        )
        for name in ("mass", "speed")
    },
    "rest masses": (
        lambda: system(dps.RelativisticKinetic(mass=VECTOR)),
        Mistake("shape (2,)", "one particle with one mass", "`T(t, p, args)`"),
    ),
    "potential of many numbers": (
        lambda: system(potential=lambda t, q, args: q**2),
        Mistake("The potential", f"{ONE_NUMBER}, but returned float64[2]", SUM_OVER),
    ),
    "potential of integers": (
        lambda: system(potential=lambda t, q, args: jnp.sum(q > 0)),
        Mistake("returned int64[]", f"The potential {ONE_NUMBER}", "floating point"),
    ),
    "complex potential": (
        lambda: system(potential=lambda t, q, args: jnp.sum(q) * jnp.array(1j)),
        Mistake("returned complex128[]", f"The potential {ONE_NUMBER}", "`jnp.real`"),
    ),
    "kinetic energy of many numbers": (
        lambda: system(lambda t, p, args: p**2),
        Mistake("The kinetic energy", f"{ONE_NUMBER}, but returned float64", SUM_OVER),
    ),
    "energy of many numbers": (
        lambda: trace(
            dps.Hamiltonian(lambda t, q, p, args: q * p), dps.PresymplecticTao()
        ),
        Mistake("The energy", f"{ONE_NUMBER}, but returned float64[2]", SUM_OVER),
    ),
    "potential is no function": (
        lambda: dps.MechanicalSystem(KINETIC, 3.0),
        Mistake("got 3.0", "`potential` must be a function", "`V(t, q, args)`"),
    ),
    "kinetic energy is no function": (
        lambda: dps.MechanicalSystem(2.0, harmonic),
        Mistake("got 2.0", "a kinetic energy or a function `T(t, p, args)`", MASS),
    ),
    "kinetic energy of one argument": (
        lambda: dps.MechanicalSystem(lambda p: p @ p, harmonic),
        Mistake("the arguments (p)", "`kinetic` must be a function", "`T(t, p, args)`"),
    ),
    "split that is no split": (
        lambda: dps.Hamiltonian(lambda t, q, p, args: p @ p, splits=(3,)),
        Mistake("got (3,)", "must be a tuple of", "`extend.AbstractSplit`"),
    ),
    "sum over pairs": (
        lambda: dps.pairwise_potential(lambda t, r, a: jnp.sum(r))(0.0, PLACES, None),
        Mistake("got float64[]", "needs the energy of each pair", "Do not sum"),
    ),
    "energy is no function": (
        lambda: dps.Hamiltonian(3.0),
        Mistake("got 3.0", "`energy` must be a function", "`E(t, q, p, args)`"),
    ),
    "force of a wrong shape": (
        lambda: system(force=lambda t, q, v, args: jnp.ones(3)),
        Mistake("returned shape (3,)", "arrays of the shapes of `q`", "of shape (2,)"),
    ),
    "force of a wrong structure": (
        lambda: system(force=lambda t, q, v, args: (q, q)),
        Mistake("returned PyTreeDef((*, *))", "the same structure as `q`", "`force`"),
    ),
    "complex force": (
        lambda: system(force=lambda t, q, v, args: q * jnp.array(1j)),
        Mistake("`force` must return real", "returned complex128[2]", "`jnp.real`"),
    ),
    "force of an energy that is not separable": (
        lambda: trace(
            dps.Hamiltonian(mixed_energy, force=lambda t, q, v, args: jnp.ones(3)),
            dps.PresymplecticTao(),
        ),
        Mistake("returned shape (3,)", "`force` must return", "of shape (2,)"),
    ),
    "force of a hand-written field": (
        lambda: system(potential=dps.ForceField(lambda t, q, args: jnp.ones(3))),
        Mistake("returned shape (3,)", "`force` must return", "of shape (2,)"),
    ),
    "damping by a number": (
        lambda: dps.MechanicalSystem(KINETIC, harmonic, 0.2),
        Mistake("got 0.2", LAW, RATE),
    ),
    **{
        f"damping of the paper's family, {name}": (
            lambda law=law: dps.DissipativeHamiltonian(KINETIC, harmonic, DAMPING, law),
            Mistake("has other friction", ONE_RATE, RATE),
        )
        for name, law in {
            "numbers": dps.ConstantDamping(VECTOR),
            "a function of several numbers": lambda t: VECTOR * t,
            "friction per velocity": dps.ViscousDamping(1.0),
            "drag": dps.Drag(1.0),
        }.items()
    },
    "damping of the general family by a number": (
        lambda: dps.DissipativeHamiltonian(KINETIC, harmonic, DAMPING, 0.2),
        Mistake("got 0.2", f"`eta2` {LAW}", RATE),
    ),
    "rate of another kind": (
        lambda: dps.ConstantDamping("weak"),
        Mistake("got 'weak'", "must be a real number", "`ConstantDamping(gamma)`"),
    ),
    "energy and damping by position": (
        lambda: dps.MechanicalSystem(mixed_energy, DAMPING),
        Mistake(
            "got Damping(",
            "`potential` must be a function `V(t, q, args)`",
            "write `Hamiltonian(energy)`",
        ),
    ),
    "potential before kinetic energy": (
        lambda: dps.MechanicalSystem(harmonic, KINETIC),
        Mistake(
            "got QuadraticKinetic(",
            "`potential` must be a function `V(t, q, args)`",
            "The order is `(kinetic, potential, friction)`",
        ),
    ),
}


OF_PLACE: Any = lambda q: q
WEAK: Any = "weak"
PLACE, PLACE_GIVEN = "`PositionDamping(rate)`", "one of the arguments (q)"
ETA = "`friction` must be a function `eta(t)`"
WRONG_FUNCTIONS = {
    "friction by place": (
        lambda: dps.MechanicalSystem(KINETIC, harmonic, lambda t, q, args: 0.1 * q),
        Mistake("the arguments (t, q, args)", ETA, PLACE),
    ),
    "a friction in a list": (
        lambda: dps.LagrangianSystem(harmonic, harmonic, [DAMPING, lambda: 0.1]),
        Mistake("the arguments ()", ETA, "`f(t, q, v, args)`"),
    ),
    "the class of a friction": (
        lambda: dps.Hamiltonian(mixed_energy, dps.Drag),
        Mistake("the class `Drag`", ETA, "Write `Drag(...)`"),
    ),
    "the class of a kinetic energy": (
        lambda: dps.MechanicalSystem(dps.QuadraticKinetic, harmonic),
        Mistake("the class", "`T(t, p, args)`", "Write `QuadraticKinetic(...)`"),
    ),
    **{
        f"{law.__name__} without its number": (
            lambda law=law: trace(
                dps.MechanicalSystem(KINETIC, harmonic, law), LEAPFROG
            ),
            Mistake("got ", "`eta(t)` must be a real number", RATE),
        )
        for law in (dps.ConstantDamping, dps.LogDamping, dps.ViscousDamping)
    },
    "a complex log scale": (
        lambda: trace(
            dps.MechanicalSystem(KINETIC, harmonic, lambda t: 1j * t), LEAPFROG
        ),
        Mistake("complex", "`eta(t)` must be real", "The value of"),
    ),
    **{
        f"PositionDamping of {given}": (
            lambda fn=fn: dps.PositionDamping(fn),
            Mistake(given, "a function `rate(t, q, args)`", "`ConstantDamping(rate)`"),
        )
        for given, fn in ((PLACE_GIVEN, OF_PLACE), ("got 'weak'", WEAK))
    },
    **{
        f"{name} of q": (
            lambda make=make: make(OF_PLACE),
            Mistake(PLACE_GIVEN, f"`{name}` must be a function", signature),
        )
        for name, make, signature in (
            ("ViscousDamping(coefficients)", dps.ViscousDamping, "`C(t, q, args)`"),
            ("Drag(coefficient)", dps.Drag, "`c(t, q, args)`"),
            ("Drag(..., medium=...)", lambda w: dps.Drag(1.0, w), "`w(t, q, args)`"),
            ("force", dps.ForceField, "`force(t, q, args)`"),
            ("pairwise_potential(fn)", dps.pairwise_potential, "`fn(t, r, args)`"),
        )
    },
    **{
        f"{name} of a function": (
            lambda make=make: make(OF_PLACE),
            Mistake("got <function", f"`{name}", f"function `eta(t)`, one that depends "
            f"on place by {PLACE}"),
        )
        for name, make in (
            ("ConstantDamping", dps.ConstantDamping),
            ("LogDamping", dps.LogDamping),
            ("PowerDamping", lambda gamma: dps.PowerDamping(gamma, 2.0)),
        )
    },
    "a scaling of two arguments": (
        lambda: dps.Scaling(dps.LogDamping(2.0), lambda t, c: c * t),
        Mistake("the arguments (t, c)", "`beta` must be a function", "`eta(t)`"),
    ),
    "a log scale of the paper's family": (
        lambda: dps.DissipativeHamiltonian(KINETIC, harmonic, lambda t, q: t, DAMPING),
        Mistake("the arguments (t, q)", "`eta1` must be a function", "`eta(t)`"),
    ),
}  # fmt: skip


@mistakes(WRONG_FUNCTIONS)
def test_functions_of_other_arguments(act, mistake):
    with pytest.raises(ValueError) as error:
        act()
    mistake.check(error)


@mistakes(HAMILTONIANS)
def test_hamiltonians(act, mistake):
    with pytest.raises(ValueError) as error:
        act()
    mistake.check(error)


@pytest.mark.parametrize(
    "make, mistake",
    [
        (lambda: dps.QuadraticKinetic(-1.0), POSITIVE),
        (lambda: dps.QuadraticKinetic(np.array([[1, 2], [2, -1]])), POSITIVE),
        (lambda: dps.RelativisticKinetic(0.0), POSITIVE),
        (lambda: dps.ConstantDamping(np.nan), "must be finite"),
        (
            lambda: dps.QuadraticPotential(np.array([[2, 1], [0, 2]]))(0.0, VECTOR),
            IS_SYMMETRIC,
        ),
    ],
)
def test_numbers_known_in_a_traced_function_are_checked(make, mistake):
    with pytest.raises(ValueError, match=mistake):
        jax.eval_shape(lambda t: (make(), t)[1], 0.0)


def test_masses_not_yet_known_are_not_judged():
    mass = eqx.filter_eval_shape(dps.QuadraticKinetic, jnp.array(-1.0)).mass
    assert mass.shape == ()


# A root that is not found gives an unsuccessful result.

NOT_FOUND = "root finder of `PresymplecticGauss` did not find the stages"


def hard_energy(t, q, p, args):
    """Not separable, and linear for a root finder except in a time interval."""
    start, end = args
    hard = jnp.where((t >= start) & (t <= end), 1.0, 0.0)
    return jnp.sum(q**2 + p**2) / 2 + hard * mixed_energy(t, q, p, None)


HARD = dps.Hamiltonian(hard_energy)
START = (jnp.array([0.7, -0.3]), jnp.array([0.4, 0.9]))


@eqx.filter_jit
def find(solver, window, throw=False):
    t0, t1, dt0 = jnp.array(0.0), jnp.array(1.0), jnp.array(0.25)
    return dfx.diffeqsolve(HARD, solver, t0, t1, dt0, START, window, throw=throw)


def window(start, end):
    return jnp.array(start), jnp.array(end)


# Two steps of Newton's method solve a linear equation and confirm convergence.
FINDER, STEPS = optx.Newton(rtol=1e-10, atol=1e-10), 2
MIDPOINT = dps.PresymplecticGauss(1, FINDER, STEPS)
# Schemes, and the times at which their root finds fail: in the first or the last step,
# the first or the last stage.
UNSOLVED = {
    "midpoint": (MIDPOINT, (0.125, 0.875)),
    "Suzuki4": (dps.Suzuki4(MIDPOINT), (0.0518, 0.9482)),
    "substeps": (substeps(MIDPOINT, 2), (0.0625, 0.9375)),
}


@pytest.mark.parametrize("name", UNSOLVED)
def test_roots_that_are_not_found_are_a_result(name):
    solver, times = UNSOLVED[name]
    assert find(solver, window(2.0, 2.0)).result == dfx.RESULTS.successful
    for t in times:
        sol = find(solver, window(t - 0.01, t + 0.01))
        assert sol.result != dfx.RESULTS.successful
        assert NOT_FOUND in dfx.RESULTS[sol.result]


def test_a_root_that_is_not_found_is_an_error():
    with pytest.raises(RuntimeError, match=NOT_FOUND):
        find(MIDPOINT, window(0.12, 0.13), throw=True)


def test_tolerances_that_cannot_be_met_are_a_result():
    solver = dps.PresymplecticGauss(1, optx.Newton(rtol=0.0, atol=0.0))
    sol = find(solver, window(0.0, 1.0))
    assert sol.result != dfx.RESULTS.successful
