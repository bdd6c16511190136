"""Values between steps where a drift turns by far within one."""

from typing import Any, ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_presym as dps
from diffrax_presym._results import TURNS_TOO_FAR
from diffrax_presym.extend import AbstractSplit


diffeqsolve: Any = dfx.diffeqsolve
OMEGA = jnp.array([1.0, 1000.0])
TIMES = jnp.linspace(0.0, 10.0, 38)


class Oscillations(AbstractSplit):
    """Two oscillators, exactly."""

    kinds: ClassVar[frozenset[str]] = frozenset({"any", "nystrom"})

    def drift(self, system, t, h, data, y):
        (q, p), c, s = system.values(y), jnp.cos(OMEGA * h), jnp.sin(OMEGA * h)
        return system.add(y, (c * q + s * p - q, c * p - s * q - p))

    def force(self, system, t, y):
        return jnp.zeros(2)


def test_friction_that_a_split_omits_is_refused():
    energy = lambda t, q, p, args: jnp.sum(OMEGA * (q**2 + p**2)) / 2
    law = dps.ConstantDamping(0.1)
    system = dps.Hamiltonian(energy, law, splits=(Oscillations(),))
    y0 = jnp.ones(2), jnp.zeros(2)
    with pytest.raises(ValueError, match="`Oscillations` would omit the friction"):
        diffeqsolve(system, dps.BlanesMoan6(), 0.0, 1.0, 0.1, y0)


@pytest.mark.parametrize(
    "solver",
    [dps.BlanesMoan6(), dps.TunedRKN6(), dps.SofroniouSpaletta(6, dps.Strang())],
)
@pytest.mark.parametrize("vary", [False, True], ids=["equal", "variable"])
def test_of_a_split_of_the_user(solver, vary):
    energy = lambda t, q, p, args: jnp.sum(OMEGA * (q**2 + p**2)) / 2
    system = dps.Hamiltonian(energy, splits=(Oscillations(),))
    start, options = jnp.array([1.0, 1e-3]), {}
    if vary:
        density = lambda t, y, args: 1 + jnp.sin(t) / 2
        options["stepsize_controller"] = dps.StepDensityController(0.1, density)
    sol = diffeqsolve(
        *(system, solver, 0.0, 10.0, None if vary else 0.1, (start, jnp.zeros(2))),
        saveat=dfx.SaveAt(ts=TIMES),
        adjoint=dps.FixedStepAdjoint(),
        **options,
    )
    exact = start[None] * jnp.cos(jnp.outer(TIMES, OMEGA))
    np.testing.assert_allclose(sol.ys[0], exact, atol=1e-11)


def spinning(rate, steps, vary=False, law=None, sign=1, **options):
    """A top that starts at a rate of spin, and its values between steps of 0.2."""
    turn = dps.Attitude(jnp.array([1.0, 1.0, 0.5]))
    weight = lambda t, q, args: 0.1 * dps.rotation_matrix(q)[2, 2]
    system = dps.ManifoldSystem(turn, weight, law)
    y0 = jnp.array([0.8, 0.6, 0.0, 0.0]), jnp.array([0.1, 0.2, rate / 2])
    if vary:
        control = dps.StepDensityController(4.0 / steps, lambda t, y, args: 1.0)
        options["stepsize_controller"] = control
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None} | options
    end, dt0 = sign * 4.0, None if vary else sign * 4.0 / steps
    saveat = dfx.SaveAt(ts=TIMES * 0.4 * sign)
    args = system, dps.TunedRKN6(), 0.0, end, dt0, y0
    return diffeqsolve(*args, saveat=saveat, **options)


@pytest.mark.parametrize("vary", [False, True], ids=["equal", "variable"])
@pytest.mark.parametrize("rate, most", [(5.0, 1e-8), (30.0, 1e-8), (100.0, 1e-4)])
def test_of_a_body(rate, most, vary):
    sol, exact = spinning(rate, 20, vary), spinning(rate, 1480)
    assert (sol.stats["interpolated"] > 0) == (rate == 5.0)
    for x, y in zip(sol.ys, exact.ys, strict=True):
        np.testing.assert_allclose(x, y, atol=most)


@pytest.mark.parametrize("vary", [False, True], ids=["equal", "variable"])
def test_of_a_body_that_spins_up(vary):
    """Steps that are equal fail where it turns too far in one."""
    law = dps.ConstantDamping(-0.4)
    sol = spinning(6.0, 30, vary, law, throw=False)
    exact = spinning(6.0, 1480, law=law)
    assert jnp.linalg.norm(exact.ys[1][-1]) > 14
    assert (sol.result == TURNS_TOO_FAR) == (not vary)
    for x, y in zip(sol.ys, exact.ys, strict=True):
        known = jnp.isfinite(x)
        assert jnp.all(known) == vary
        assert jnp.mean(known) > 0.6
        np.testing.assert_allclose(x[known], y[known], atol=1e-7)


@pytest.mark.parametrize("gradient", ["reversal", "checkpoints"])
@pytest.mark.parametrize("sign", [1, -1], ids=["forwards", "backwards"])
def test_gradients_of_slow_and_fast_bodies_of_a_batch(gradient, sign):
    def loss(rate):
        options: dict = dict(adjoint=dps.FixedStepAdjoint(gradient), max_steps=64)
        q, p = spinning(rate, 20, sign=sign, **options).ys
        return jnp.sum(q**3) + jnp.sum(p[:, :2] ** 2)

    rates, h = jnp.array([5.0, 30.0]), 1e-5
    values = jax.jit(jax.vmap(jax.value_and_grad(loss)))(rates)
    each = jax.jit(lambda rates: jax.lax.map(loss, rates))
    np.testing.assert_allclose(values[0], each(rates), rtol=1e-12)
    central = (each(rates + h) - each(rates - h)) / (2 * h)
    np.testing.assert_allclose(values[1], central, rtol=1e-6)
