# pyright: reportOptionalMemberAccess=false
"""The tabulated schemes: their coefficients, order, structure and cost."""

import json
import math
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, flat, solve

import diffrax_presym as dps


TABLES = json.loads(pathlib.Path(__file__).with_name("tableaus.json").read_text())
TABULATED = {name: getattr(dps, name)() for name in TABLES if name.startswith("Blanes")}
SPLITTINGS = TABULATED | {"TunedRKN6": dps.TunedRKN6()}
COMPOSITIONS = {
    "Suzuki4": dps.Suzuki4(),
    "SofroniouSpaletta6": dps.SofroniouSpaletta(6),
    "SofroniouSpaletta8": dps.SofroniouSpaletta(8),
    "SofroniouSpaletta10": dps.SofroniouSpaletta(10),
    "SuzukiYoshida4": dps.SuzukiYoshida(4),
    "SuzukiYoshida6": dps.SuzukiYoshida(6),
    "SuzukiYoshida8": dps.SuzukiYoshida(8),
}
SCHEMES = SPLITTINGS | COMPOSITIONS
# The triple jumps are tested with the other schemes of the paper.
NEW = [name for name in SCHEMES if not name.startswith("SuzukiYoshida")]


@pytest.mark.parametrize("name", TABULATED)
def test_splittings_agree_with_the_tables_to_the_last_digit(name):
    tableau, table = SPLITTINGS[name].tableau, TABLES[name]
    assert tableau.fractions == tuple(float(x) for x in table["coefficients"])
    assert tableau.order == table["order"]
    assert tableau.kick_first == (table["moves"][0] == "K")


@pytest.mark.parametrize("name", [*SPLITTINGS, "TunedLinear8"])
def test_splittings_sum_to_one(name):
    for turn in (0, 1):
        fractions = getattr(dps, name).tableau.fractions[turn::2]
        assert abs(math.fsum(fractions) - 1) < 1e-15


@pytest.mark.parametrize("name", COMPOSITIONS)
def test_compositions_agree_with_the_tables_to_the_last_digit(name):
    solver, table = COMPOSITIONS[name], TABLES[name]
    assert solver.weights == tuple(float(x) for x in table["coefficients"])
    assert solver.order(None) == table["order"]
    assert abs(math.fsum(solver.weights) - 1) < 1e-15


@pytest.mark.parametrize("name", NEW)
def test_schemes_are_symmetric(name):
    assert SCHEMES[name].is_symmetric


@pytest.mark.parametrize("name", [name for name in NEW if name in TABLES])
def test_coefficients_are_symmetric(name):
    table = TABLES[name]["coefficients"]
    assert table == table[::-1]


# Two nonlinear systems in which all parts depend on time.


def pendulum_on_a_moving_pivot(t, q, args):
    return -jnp.sum(jnp.cos(q)) * (1 + 0.3 * jnp.sin(t))


def driven_double_well(t, q, args):
    return jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t))


SYSTEMS = {
    "pendulum": dps.DissipativeHamiltonian(
        dps.QuadraticKinetic(2.0),
        pendulum_on_a_moving_pivot,
        eta1=dps.ConstantDamping(0.1),
        eta2=dps.LogDamping(1.0, shift=1.0),
    ),
    "double well": dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        driven_double_well,
        [dps.LogDamping(0.3), dps.PowerDamping(0.1, 0.5)],
    ),
}
Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.3, -0.7]))
T0, T1 = 1.0, 5.0


@eqx.filter_jit
def one_step(system, solver, y, t0, t1):
    term = system
    carry = solver.init(term, t0, t1, y, None)
    return solver.step(term, t0, t1, y, None, carry, made_jump=False)[0]


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("name", NEW)
def test_a_step_contracts_the_form_by_the_damping(name, system):
    t0, t1 = jnp.array(1.0), jnp.array(1.2)
    hamiltonian, solver = SYSTEMS[system], SCHEMES[name]

    def step(x):
        return flat(one_step(hamiltonian, solver, (x[:2], x[2:]), t0, t1))

    jacobian = jax.jacfwd(step)(flat(Y0))
    omega = np.kron([[0, -1], [1, 0]], np.eye(2))
    contraction = np.exp(-hamiltonian.damping.increment(t0, t1 - t0))
    assert np.max(np.abs(jacobian.T @ omega @ jacobian - contraction * omega)) < 1e-13


@pytest.mark.parametrize("name", NEW)
def test_a_step_backwards_undoes_a_step(name):
    system, solver = SYSTEMS["double well"], SCHEMES[name]
    t0, t1 = jnp.array(1.0), jnp.array(1.3)
    there = one_step(system, solver, Y0, t0, t1)
    assert_close(one_step(system, solver, there, t1, t0), Y0, 1e-14)


@pytest.mark.parametrize("name", SPLITTINGS)
def test_one_evaluation_of_the_force_for_each_kick(name):
    calls = 0

    def count(q):
        nonlocal calls
        calls += 1
        return np.asarray(-q)

    # For dense output the derivative is traced, but not evaluated.
    @jax.custom_jvp
    def force(q):
        return jax.pure_callback(count, jax.ShapeDtypeStruct(q.shape, q.dtype), q)

    force.defjvp(lambda q, dq: (force(*q), -dq[0]))
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), dps.ForceField(lambda t, q, args: force(q))
    )
    steps = 8
    sol = solve(system, SPLITTINGS[name], 0.0, 1.0, 1 / steps, Y0)
    jax.block_until_ready(sol.ys)
    tableau = SPLITTINGS[name].tableau
    kicks = len(tableau.fractions[0 if tableau.kick_first else 1 :: 2])
    # The force of a kick that ends one step and starts the next is evaluated once.
    per_step = kicks - tableau.kick_first
    assert calls == per_step * steps + tableau.kick_first


def test_a_splitting_of_your_own():
    # Strang splitting, drift first.
    strang = dps.SplittingTableau(
        order=2, kick_first=False, kind="any", fractions=(0.5, 1.0, 0.5)
    )
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: jnp.sum(q**2) / 2
    )
    h = 0.25
    sol = solve(system, dps.Splitting(strang), 0.0, h, h, Y0)
    ys = jax.tree.map(lambda y: y[0], sol.ys)
    middle = Y0[0] + h / 2 * Y0[1]
    kicked = Y0[1] - h * middle
    assert_close(ys, (middle + h / 2 * kicked, kicked), 1e-15)


def test_splittings_that_do_not_add_up_are_refused():
    make = lambda *fractions: dps.Splitting(
        dps.SplittingTableau(2, kick_first=True, kind="any", fractions=fractions)
    )
    with pytest.raises(ValueError, match="sum to one"):
        make(0.5, 0.9, 0.5)
    with pytest.raises(ValueError, match="odd number of moves"):
        make(1.0, 1.0)
