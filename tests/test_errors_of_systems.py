"""Systems and laws of friction with invalid parts raise a clear error.

Each message says what was given, what is expected, and what to write instead.
"""

# pyright: reportArgumentType=false

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from errors import check, mechanics, raising, trace, traced
from helpers import harmonic, mixed_energy

import diffrax_presym as dps


KINETIC = dps.QuadraticKinetic()
DAMPING = dps.ConstantDamping(0.2)
POSITIVE = "must be positive"
ONE_NUMBER = "must return a real scalar for the whole system"
SUM_OVER = "`jnp.sum(...)`"
MASS, STIFFNESS = "`QuadraticKinetic(mass)`", "`QuadraticPotential(stiffness)`"
LAW = "must be a law of friction, a function eta(t) or a list of these"
RATE = "`ConstantDamping(rate)`"
ONE_RATE = "Only one rate of damping for all momenta has a log scale"
VECTOR, PLACES = jnp.array([0.1, 0.2]), jnp.ones((3, 2))
ASYMMETRIC = jnp.array([[1.0, 0.5], [0.0, 1.0]])
IS_SYMMETRIC, PART = "must be a symmetric matrix", "`(A + A.T) / 2`"
V_OF_Q = "`potential` must be a function `V(t, q, args)`"
SHAPE = "returned shape (3,)", "of shape (2,)"
STRUCTURE = "the same structure as the velocity"
LONG = lambda t, q, v, args: jnp.ones(3)
TAO, GAUSS = dps.PresymplecticTao(), dps.PresymplecticGauss(2)

HAMILTONIANS = {
    **{
        f"mass {x}": (lambda x=x: dps.QuadraticKinetic(x), f"got {x}", POSITIVE, MASS)
        for x in (0.0, -1.0, np.array([1.0, -2.0]))
    },
    "negative effective mass": (lambda: dps.QuadraticKinetic(-2.0), "got -2.0",
        "negative effective mass", "a function `T(t, p, args)`"),
    "massless particles": (lambda: dps.QuadraticKinetic(jnp.array([1.0, 0.0])),
        "massless test particles", "ForceField"),
    "mass that is a function": (lambda: dps.QuadraticKinetic(lambda q: q),
        f"{MASS} must be", "a real number", "`LagrangianSystem`", "`T(t, p, args)`"),
    "stiffness that is a function": (lambda: dps.QuadraticPotential(harmonic),
        "a real number", "function is passed", "`MechanicalSystem(kinetic, V)`"),
    "mass that is not symmetric": (traced(kinetic=dps.QuadraticKinetic(ASYMMETRIC)),
        MASS, IS_SYMMETRIC, PART),
    "stiffness that is not symmetric": (
        traced(potential=dps.QuadraticPotential(ASYMMETRIC)), STIFFNESS, IS_SYMMETRIC,
        PART),
    **{
        f"{name} that are not symmetric": (
            lambda stiffness=stiffness, q=q: dps.QuadraticPotential(stiffness)(0.0, q),
            *(STIFFNESS, IS_SYMMETRIC, PART),
        )
        for name, stiffness, q in (
            ("matrices", jnp.stack([jnp.eye(2), ASYMMETRIC]), PLACES[:2]),
            ("pytrees", {"a": ASYMMETRIC}, {"a": VECTOR}),
            ("operators", lx.MatrixLinearOperator(ASYMMETRIC), VECTOR),
        )
    },
    "velocity by a mass that is not symmetric": (
        lambda: dps.EuclideanMirror(np.asarray(ASYMMETRIC)).gradient(VECTOR), MASS,
        IS_SYMMETRIC, PART),
    **{
        f"Euclidean mirror of a wrong shape {i}": (
            lambda fn=fn: fn(jnp.ones((2, 2))),
            "does not fit",
        )
        for i, fn in enumerate(
            [
                dps.EuclideanMirror(jnp.ones(3)),
                dps.EuclideanMirror(jnp.ones(3)).gradient,
            ]
        )
    },
    "complex mass": (lambda: dps.QuadraticKinetic(1j), "got 1j", "must be real", MASS),
    "mass of a wrong shape": (traced(kinetic=dps.QuadraticKinetic(jnp.ones(3))),
        "of shape (3,)", "does not fit `p` of shape (2,)", "Pass a number, or"),
    "matrix that is not positive": (
        lambda: dps.QuadraticKinetic(jnp.array([[1.0, 2.0], [2.0, -1.0]])),
        "got [ 1. -1.]", POSITIVE, f"The diagonal of {MASS}"),
    "matrix of a wrong shape": (traced(kinetic=dps.QuadraticKinetic(jnp.eye(3))),
        "got shape (3, 3)", "for `p` of shape (2,)", "one row and column for"),
    "mass of a wrong structure": (traced(kinetic=dps.QuadraticKinetic({"a": 1.0})),
        "got PyTreeDef({'a': *})", "of the structure of `p`", "an array"),
    **{
        f"{name} of a relativistic particle": (
            lambda name=name: dps.RelativisticKinetic(**{name: -1.0}),
            *("got -1.0", POSITIVE, f"`RelativisticKinetic({name}=...)`"),
        )
        for name in ("mass", "speed")
    },
    "rest masses": (traced(kinetic=dps.RelativisticKinetic(mass=VECTOR)), "shape (2,)",
        "one particle with one mass", "`T(t, p, args)`"),
    "potential of many numbers": (traced(potential=lambda t, q, args: q**2),
        "The potential", f"{ONE_NUMBER}, but returned float64[2]", SUM_OVER),
    "potential of integers": (traced(potential=lambda t, q, args: jnp.sum(q > 0)),
        "returned int64[]", f"The potential {ONE_NUMBER}", "floating point"),
    "complex potential": (
        traced(potential=lambda t, q, args: jnp.sum(q) * jnp.array(1j)),
        "returned complex128[]", f"The potential {ONE_NUMBER}", "`jnp.real`"),
    "kinetic energy of many numbers": (traced(kinetic=lambda t, p, args: p**2),
        "The kinetic energy", f"{ONE_NUMBER}, but returned float64", SUM_OVER),
    "energy of many numbers": (
        lambda: trace(dps.Hamiltonian(lambda t, q, p, args: q * p), TAO), "The energy",
        f"{ONE_NUMBER}, but returned float64[2]", SUM_OVER),
    "potential is no function": (lambda: mechanics(potential=3.0), "got 3.0",
        "`potential` must be a function", "`V(t, q, args)`"),
    "kinetic energy is no function": (lambda: mechanics(2.0), "got 2.0",
        "a kinetic energy or a function `T(t, p, args)`", MASS),
    "kinetic energy of one argument": (lambda: mechanics(lambda p: p @ p),
        "the arguments (p)", "`kinetic` must be a function", "`T(t, p, args)`"),
    "split that is no split": (
        lambda: dps.Hamiltonian(lambda t, q, p, args: p @ p, splits=(3,)), "got (3,)",
        "must be a tuple of", "`extend.AbstractSplit`"),
    "sum over pairs": (
        lambda: dps.pairwise_potential(lambda t, r, a: jnp.sum(r))(0.0, PLACES, None),
        "got float64[]", "needs the energy of each pair", "Do not sum"),
    "energy is no function": (lambda: dps.Hamiltonian(3.0), "got 3.0",
        "`energy` must be a function", "`E(t, q, p, args)`"),
    "force is no function": (lambda: mechanics(force=1.0), "f(t, q, v, args"),
    **{
        f"{name} of shape {shape}": (
            traced(GAUSS, **{name: kind(lambda *_, s=shape: jnp.ones(s))}),
            *(f"returned shape {shape}", SHAPE[1]), "`force` must", "`jnp.full_like`")
        for shape in ((), (1,), (1, 2), (3,))
        for name, kind in (("force", lambda f: f), ("potential", dps.ForceField))
    },
    "force of a wrong structure": (traced(GAUSS, force=lambda t, q, v, args: (q, q)),
        "returned PyTreeDef((*, *))", STRUCTURE, "`force`"),
    "complex force": (traced(GAUSS, force=lambda t, q, v, args: q * jnp.array(1j)),
        "`force` must return real", "returned complex128[2]", "`jnp.real`"),
    "force of an energy that is not separable": (
        lambda: trace(dps.Hamiltonian(mixed_energy, force=LONG), TAO),
        *SHAPE, "`force` must return"),
    "damping by a number": (lambda: mechanics(friction=0.2), "got 0.2", LAW, RATE),
    **{
        f"damping of the paper's family, {name}": (
            lambda law=law: dps.DissipativeHamiltonian(KINETIC, harmonic, DAMPING, law),
            *("has other friction", ONE_RATE, RATE),
        )
        for name, law in {
            "numbers": dps.ConstantDamping(VECTOR),
            "a function of several numbers": lambda t: VECTOR * t,
            "friction per velocity": dps.ViscousDamping(1.0),
            "drag": dps.Drag(1.0),
        }.items()
    },
    "damping of the general family by a number": (
        lambda: dps.DissipativeHamiltonian(KINETIC, harmonic, DAMPING, 0.2), "got 0.2",
        f"`eta2` {LAW}", RATE),
    "energy and damping by position": (
        lambda: dps.MechanicalSystem(mixed_energy, DAMPING), "got ConstantDamping(",
        V_OF_Q, "write `Hamiltonian(energy)`"),
    "potential before kinetic energy": (lambda: dps.MechanicalSystem(harmonic, KINETIC),
        "got QuadraticKinetic(", V_OF_Q,
        "The order is `(kinetic, potential, friction)`"),
}  # fmt: skip


@raising(HAMILTONIANS)
def test_hamiltonians(act, parts):
    check(act, parts)


# Functions.

OF_PLACE: Any = lambda q: q
PLACE, OF_Q = "`PositionDamping(rate)`", "one of the arguments (q)"
ETA = "`friction` must be a function `eta(t)`"
FUNCTIONS = {
    "friction by place": (lambda: mechanics(friction=lambda t, q, args: 0.1 * q),
        "the arguments (t, q, args)", ETA, PLACE),
    "a friction in a list": (
        lambda: dps.LagrangianSystem(harmonic, harmonic, [DAMPING, lambda: 0.1]),
        "the arguments ()", ETA, "`f(t, q, v, args)`"),
    "the class of a friction": (lambda: dps.Hamiltonian(mixed_energy, dps.Drag),
        "the class `Drag`", ETA, "Write `Drag(...)`"),
    "the class of a kinetic energy": (lambda: mechanics(dps.QuadraticKinetic),
        "the class", "`T(t, p, args)`", "Write `QuadraticKinetic(...)`"),
    **{
        f"{law.__name__} without its number": (
            lambda law=law: mechanics(friction=law),
            *(f"got the class `{law.__name__}`", f"Write `{law.__name__}(...)`"),
        )
        for law in (dps.ConstantDamping, dps.LogDamping, dps.ViscousDamping)
    },
    "a complex log scale": (traced(friction=lambda t: 1j * t), "complex",
        "`eta(t)` must be real", "The value of"),
    **{
        f"PositionDamping of {given}": (
            lambda fn=fn: dps.PositionDamping(fn),
            *(given, "a function `rate(t, q, args)`", RATE),
        )
        for given, fn in ((OF_Q, OF_PLACE), ("got 'weak'", "weak"), ("got 0.3", 0.3))
    },
    **{
        f"{name} of q": (
            lambda make=make: make(OF_PLACE),
            *(OF_Q, f"`{name}` must be a function", signature),
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
            *("got <function", f"`{name}"),
            f"function `eta(t)`, one that depends on place by {PLACE}",
        )
        for name, make in (
            ("ConstantDamping", dps.ConstantDamping),
            ("LogDamping", dps.LogDamping),
            ("PowerDamping", lambda gamma: dps.PowerDamping(gamma, 2.0)),
        )
    },
    "a scaling of two arguments": (
        lambda: dps.Scaling(dps.LogDamping(2.0), lambda t, c: c * t),
        "the arguments (t, c)", "`beta` must be a function", "`eta(t)`"),
    "a log scale of the paper's family": (
        lambda: dps.DissipativeHamiltonian(KINETIC, harmonic, lambda t, q: t, DAMPING),
        "the arguments (t, q)", "`eta1` must be a function", "`eta(t)`"),
}  # fmt: skip


@raising(FUNCTIONS)
def test_functions_of_other_arguments(act, parts):
    check(act, parts)


# Laws of friction, of states of shape (2,).


class Joined(dps.extend.AbstractFriction):
    """A law that joins linear and other friction."""

    def parts(self, mechanics):
        drag = dps.Drag(0.5).parts(mechanics)
        return dps.ConstantDamping(0.1).parts(mechanics) + drag

    def force(self, t, q, p, v, args):
        return -0.1 * p - 0.5 * jnp.linalg.norm(v) * v


C = jnp.array([[0.3, 0.5], [-0.3, 0.2]])
NAN, FINITE, EACH_BODY = jnp.nan * VECTOR, "must be finite", "one for each body"
WIND, ONE = jnp.ones(3), (jnp.array(1.0), jnp.array(0.0))
LEVEL = lambda t, q, args: jnp.sum(q["x"])
NAMED = ({"x": VECTOR}, {"x": VECTOR})
OPERATOR = lx.FunctionLinearOperator(
    lambda v: {"x": v["x"]}, {"x": jax.ShapeDtypeStruct((2,), float)}
)
BODIES = dps.QuadraticKinetic(jnp.array([1.0, 2.0]))
place = lambda law, value: law(lambda t, q, args: value)
LAWS = {
    "rate of another kind": (lambda: dps.ConstantDamping("weak"), "got 'weak'",
        "must be a real number", "`ConstantDamping(gamma)`"),
    "rate": (lambda: dps.ConstantDamping(jnp.nan), FINITE),
    "coefficients": (lambda: dps.ViscousDamping(C * jnp.inf), FINITE),
    "drag": (lambda: dps.Drag(jnp.nan), FINITE),
    "wind": (lambda: dps.Drag(0.1, medium=NAN), FINITE),
    "no coefficients": (lambda: dps.ViscousDamping(None), "ViscousDamping(1.0)"),
    "unknown mass": (
        lambda: mechanics(dps.RelativisticKinetic(), friction=dps.Drag(0.1)), MASS),
    "joined": (lambda: mechanics(friction=Joined()), "Write two laws"),
    "rates": (traced(friction=dps.ConstantDamping(jnp.ones(3))), "does not fit"),
    "rates of several axes": (traced(friction=dps.ConstantDamping(jnp.ones((1, 2)))),
        "one row and column"),
    "a matrix of rates": (traced(friction=dps.ConstantDamping(C)),
        "ViscousDamping(matrix)"),
    "a list": (traced(friction=dps.ConstantDamping([0.1, 0.2])), "jnp.array"),
    "numbers of dashpots": (traced(friction=dps.ViscousDamping(jnp.ones(3))),
        "does not fit"),
    "size of a matrix": (traced(friction=dps.ViscousDamping(jnp.ones((3, 3)))),
        "one row and column"),
    "place": (traced(friction=place(dps.PositionDamping, WIND)), "does not fit"),
    "drag by entry": (traced(friction=dps.Drag(VECTOR)), EACH_BODY),
    "drag by place": (traced(friction=place(dps.Drag, VECTOR)), EACH_BODY),
    "drag of a number": (traced(None, ONE, friction=dps.Drag(0.1)), "`(n, 1)`"),
    "drag of unequal masses": (traced(kinetic=BODIES, friction=dps.Drag(0.1)),
        EACH_BODY),
    "a wind": (traced(friction=dps.Drag(0.1, medium=WIND)), "does not fit"),
    "a wind by place": (traced(friction=dps.Drag(0.1, medium=lambda t, q, args: WIND)),
        "does not fit"),
    "laws of time": (traced(friction=[dps.ViscousDamping(C), dps.LogDamping(1.0)]),
        "no exact flow together"),
    "operator": (
        traced(None, NAMED, potential=LEVEL, friction=dps.ViscousDamping(OPERATOR)),
        "in one vector"),
    **{
        f"{law.__name__} of a function that returns nothing": (
            traced(friction=place(law, None)),
            "returned None",
        )
        for law in (dps.PositionDamping, dps.ViscousDamping, dps.Drag)
    },
}  # fmt: skip


@raising(LAWS)
def test_laws_of_friction(act, parts):
    check(act, parts)


# What is known when.

KNOWN = {
    "mass": (lambda: dps.QuadraticKinetic(-1.0), POSITIVE),
    "matrix": (lambda: dps.QuadraticKinetic(np.array([[1, 2], [2, -1]])), POSITIVE),
    "relativistic mass": (lambda: dps.RelativisticKinetic(0.0), POSITIVE),
    "rate": (lambda: dps.ConstantDamping(np.nan), FINITE),
    "stiffness": (
        lambda: dps.QuadraticPotential(np.array([[2, 1], [0, 2]]))(0.0, VECTOR),
        IS_SYMMETRIC),
}  # fmt: skip


@raising(KNOWN)
def test_numbers_known_in_a_traced_function_are_checked(act, parts):
    check(lambda: jax.eval_shape(lambda t: (act(), t)[1], 0.0), parts)


def test_masses_not_yet_known_are_not_judged():
    mass = eqx.filter_eval_shape(dps.QuadraticKinetic, jnp.array(-1.0)).mass
    assert mass.shape == ()


def test_states_of_pairs():
    potential = dps.pairwise_potential(lambda t, r, args: 1 / r**2)
    for wrong in (PLACES[0], {"a": PLACES}, [[0.0, 1.0]], 1.0):
        with pytest.raises(ValueError, match="one array"):
            potential(0.0, wrong, 1.0)
    with pytest.raises(ValueError, match="3 particles"):
        dps.pairwise_potential(lambda t, r, args: r, VECTOR)(0.0, PLACES, None)
    with pytest.raises(ValueError, match=r"fn\(t, r, args\)"):
        dps.pairwise_potential(3.0)
