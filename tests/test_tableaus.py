# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
"""The tabulated schemes: their coefficients and cost, and long steps of linear forces.
Their order is tested by `test_pairs.py`, their structure by `test_structure.py`."""

import json
import math
import pathlib
import sys
from fractions import Fraction
from itertools import zip_longest

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, solve

import diffrax_presym as dps
from diffrax_presym._scheme._multistep import _MOST_FRICTION, _TABLES


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


Y0 = (jnp.array([1.0, 0.5]), jnp.array([0.3, -0.7]))


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


# Linear forces.


def _series(fractions, kick_first, degree):
    """A step of an oscillator as exact polynomials in step size times frequency."""
    one, zero = [Fraction(1)], [Fraction(0)]
    rows = [[one, zero], [zero, one]]
    for i, fraction in enumerate(fractions):
        kick = (i % 2 == 0) == kick_first
        to, source, sign = (1, 0, -1) if kick else (0, 1, 1)
        length = sign * Fraction(fraction)
        for column in (0, 1):
            moved = [Fraction(0), *(length * x for x in rows[source][column])]
            pairs = zip_longest(rows[to][column], moved, fillvalue=Fraction(0))
            rows[to][column] = [x + y for x, y in pairs]
    return [[float(x) for x in entry[:degree]] for row in rows for entry in row]


def test_a_step_of_an_oscillator_is_its_rotation_to_eighth_order():
    tableau, degree = dps.TunedLinear8().tableau, 9
    cos, sin = np.zeros((2, degree))
    for k in range(degree):
        (cos, sin)[k % 2][k] = (-1) ** (k // 2) / math.factorial(k)
    series = _series(tableau.fractions, tableau.kick_first, degree)
    for computed, exact in zip(series, (cos, sin, -sin, cos), strict=True):
        padded = [*computed, *[0.0] * (degree - len(computed))]
        assert np.max(np.abs(padded - exact)) < 1e-15


@pytest.mark.parametrize("gamma", [0.0, 0.5, 5.0, -0.1])
def test_long_steps_of_a_linear_system(gamma):
    # Frequencies up to the claimed limit for an error of 1e-9 per step.
    omega, steps = jnp.linspace(0.1, 3.6, 50), 4
    springs, friction = dps.QuadraticPotential(omega**2), dps.ConstantDamping(gamma)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), springs, friction)
    y0 = jnp.ones(50), jnp.zeros(50)
    ys = solve(system, dps.TunedLinear8(), 0.0, float(steps), 1.0, y0).ys
    shifted = np.sqrt(np.asarray(omega, complex) ** 2 - gamma**2 / 4)
    decay, phase = np.exp(-gamma * steps / 2), shifted * steps
    q = decay * (np.cos(phase) + gamma / 2 / shifted * np.sin(phase)).real
    p = -decay * (np.asarray(omega) ** 2 / shifted * np.sin(phase)).real
    size = np.maximum(1, np.abs(q)) if gamma < 0 else np.max(np.abs(q))
    assert np.max(np.abs(ys[0][-1] - q) / size) < steps * 4e-9
    assert np.max(np.abs(ys[1][-1] - p) / size) < steps * 4e-9 * 3.6


# Symmetric multistep methods.


@pytest.mark.parametrize("order", _TABLES)
def test_coefficients(order, monkeypatch):
    # For x = t^k: sum alpha_j j^k = k (k - 1) sum beta_j j^(k - 2).
    table = _TABLES[order]
    alpha = np.convolve(table.kicks, [1, -2, 1])
    beta = np.array([0, *table.forces, 0])
    j = np.arange(order + 1) - order / 2
    defects = [
        abs(alpha @ j**k - k * (k - 1) * (beta @ j ** max(k - 2, 0))) / (order / 2) ** k
        for k in range(order + 3)
    ]
    assert max(defects[:-1]) < 1e-11 < 1e-4 < defects[-1]
    # All roots but the double one at 1 are simple and on the unit circle.
    roots = np.roots(table.kicks)
    assert np.allclose(np.abs(roots), 1, atol=1e-10)
    assert np.min(np.abs(roots - 1)) > 0.1
    assert np.min(np.abs(roots[:, None] - roots) + 2 * np.eye(order - 2)) > 0.02
    # The script of the coefficients still finds them.
    folder = pathlib.Path(__file__).parents[1] / "benchmarks"
    monkeypatch.syspath_prepend(str(folder))
    import multistep  # pyright: ignore[reportMissingImports]

    assert table == multistep.method(multistep.from_cosines(multistep.COSINES[order]))
    for name in ("multistep", "_report"):
        sys.modules.pop(name)


def test_most_friction():
    """The rate of the slow motion, from the largest root of the method."""
    for order, most in _MOST_FRICTION.items():
        table = _TABLES[order]
        alpha = np.convolve(table.kicks, [1, -2, 1])
        beta = np.array([0, *table.forces, 0])

        def error(x, alpha=alpha, beta=beta):
            root = np.max(np.abs(np.roots(alpha - (x**2 / 4 - 1e-4) * beta)))
            rate = (x**2 / 4 - 1e-4) ** 0.5 - x / 2
            return abs((np.log(root) - x / 2) / rate - 1)

        assert error(most) < 0.1 < error(1.02 * most)
