"""The loop over the stages, and the quantities that are hoisted out of it."""

from typing import Any

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import solve

import diffrax_presym as dps
from diffrax_presym import _scan
from diffrax_presym._scan import equations, scan_stages


TIMES, LENGTHS = jnp.array([0.1, 0.2, 0.4]), jnp.array([1.0, -2.0, 3.0])


HAMILTONIAN = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(),
    lambda t, q, args: -jnp.sum(jnp.cos(q)),
    dps.ConstantDamping(0.1),
)


def by(scan, rate, y, reverse=False):
    def stage(y, moves):
        t, length = moves
        factor = jnp.exp(-rate * t)  # a scalar that does not depend on the state
        wide = jnp.log1p(t) * jnp.linspace(0, 1, y.size)  # not a scalar
        y = y + factor * length * jnp.sin(y) + wide
        return y, (factor, jnp.sum(y), None)

    return scan(stage, y, (TIMES, LENGTHS), reverse=reverse)


@pytest.mark.parametrize("cpu", [True, False], ids=["cpu", "gpu"])
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("n", [2, 40])
def test_as_a_scan(n, reverse, cpu, monkeypatch):
    monkeypatch.setattr(_scan, "cheap_iterations", lambda: cpu)
    y, rate = jnp.linspace(-1.0, 1.0, n), jnp.array(0.3)
    both = [by(scan, rate, y, reverse) for scan in (scan_stages, lax.scan)]
    assert jax.tree.structure(both[0]) == jax.tree.structure(both[1])
    for x, y in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14)


def test_stages_are_written_out_except_on_a_cpu(monkeypatch):
    scheme = dps.BlanesMoanRKN4()

    def run(y):
        sol = solve(HAMILTONIAN, scheme, 0.0, 1.0, 0.1, (y, y))
        return sol.ys

    y, loops = jnp.array([0.3]), []
    for cpu in (True, False):
        monkeypatch.setattr(_scan, "cheap_iterations", lambda cpu=cpu: cpu)
        jax.clear_caches()
        found = equations(jax.make_jaxpr(run)(y).eqns)
        scans = [e.params for e in found if e.primitive.name == "scan"]
        stages = [x for x in scans if x["length"] == len(scheme.tableau.fractions) // 2]
        loops.append((run(y), {x["unroll"] == x["length"] for x in stages}))
    (by_loop, rolled), (written_out, unrolled) = loops
    assert rolled == {False} and unrolled == {True}
    for a, b in zip(by_loop, written_out, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.parametrize("adjoint", [dps.ReversibleAdjoint(), dps.FixedStepAdjoint()])
def test_steps_are_taken_in_blocks_except_on_a_cpu(adjoint, monkeypatch):
    """The same solution and gradient, saved at times and every few steps."""
    monkeypatch.setattr(_scan, "_BLOCK", 8)
    subs = dfx.SubSaveAt(ts=jnp.array([0.03, 3.1])), dfx.SubSaveAt(steps=17, t1=True)

    def loss(y):
        sol: Any = solve(
            HAMILTONIAN,
            dps.PresymplecticLeapfrog(),
            *(0.0, 4.0, 0.1, (y, y / 2)),
            saveat=dfx.SaveAt(subs=subs),
            adjoint=adjoint,
            max_steps=40,
        )
        times, ends = sol.ys
        total = sum(jnp.sum(x**2) for x in (*times, *(x[:2] for x in ends)))
        return total, (sol.ys, sol.stats["num_steps"])

    y, found = jnp.array([0.3]), []
    for cpu in (True, False):
        monkeypatch.setattr(_scan, "cheap_iterations", lambda cpu=cpu: cpu)
        jax.clear_caches()
        traced = jax.jit(jax.value_and_grad(loss, has_aux=True)).trace(y)
        eqns = equations(traced.jaxpr.eqns)
        scans = [e.params for e in eqns if e.primitive.name == "scan"]
        blocks = [x for x in scans if x["length"] == _scan._BLOCK]
        # Forwards and backwards.
        assert not blocks if cpu else len(blocks) >= 2
        found.append(traced.lower().compile()(y))
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


@pytest.mark.parametrize(
    "through",
    [
        lambda f, *x: jax.grad(f, argnums=(0, 1))(*x),
        lambda f, *x: jax.jvp(f, x, x),
        lambda f, *x: jax.jvp(jax.grad(f), x, x),
        lambda f, r, y: jax.vmap(f)(jnp.array([0.1, 0.2]), jnp.stack([y, -y])),
    ],
    ids=["reverse", "forward", "second", "vmap"],
)
def test_transformed_as_a_scan(through):
    y, rate = jnp.linspace(-1.0, 1.0, 40), jnp.array(0.3)
    last = lambda scan: lambda rate, y: jnp.sum(by(scan, rate, y)[0] ** 2)
    both = [through(jax.jit(last(scan)), rate, y) for scan in (scan_stages, lax.scan)]
    for x, y in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12)


def test_effects_stay_in_the_loop(capsys):
    def stage(y, t):
        jax.debug.print("{}", t)
        return y + t, None

    jax.block_until_ready(scan_stages(stage, jnp.zeros(40), TIMES))
    jax.effects_barrier()
    assert capsys.readouterr().out.split() == ["0.1", "0.2", "0.4"]


def test_callbacks_are_called_with_numbers():
    def stage(y, t):
        result = jax.ShapeDtypeStruct((), t.dtype)
        return y + jax.pure_callback(lambda t: t.reshape(()), result, t), None

    y, _ = jax.jit(lambda: scan_stages(stage, jnp.zeros(40), TIMES))()
    np.testing.assert_allclose(y, 0.7)


def end(solver, damping, n, **kwargs):
    system = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(),
        # A driving force, so that the force depends on time as well.
        lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 4 - jnp.cos(t) * q),
        damping,
    )
    y0 = (jnp.full(n, 0.5), jnp.full(n, 0.1))
    ys = solve(system, solver, 1.0, 3.0, 0.25, y0, **kwargs).ys
    assert ys is not None
    return ys


@pytest.mark.slow
@pytest.mark.parametrize(
    "damping", [dps.LogDamping(3.0), lambda t: t**2 / 4], ids=["log", "function"]
)
@pytest.mark.parametrize(
    "solver",
    [
        dps.BlanesMoanRKN4(),
        dps.PresymplecticYoshida4(),
        dps.PresymplecticCoupled(4),
        dps.Substeps(dps.Strang(), 3),
        dps.Suzuki4(dps.PresymplecticMidpoint(optx.Newton(1e-13, 1e-13))),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_many_unknowns_move_as_one(solver, damping):
    one, many = end(solver, damping, 1), end(solver, damping, 10)
    for x, y in zip(one, many, strict=True):
        np.testing.assert_allclose(y, jnp.broadcast_to(x, y.shape), rtol=1e-13)


@pytest.mark.slow
def test_gradient_with_many_unknowns():
    def total(gamma, n):
        solver, adjoint = dps.BlanesMoanRKN4(), dps.ReversibleAdjoint()
        return jnp.sum(end(solver, dps.LogDamping(gamma), n, adjoint=adjoint)[0] ** 2)

    one, many = (jax.grad(total)(2.0, n) for n in (1, 40))
    np.testing.assert_allclose(many, 40 * one, rtol=1e-11)


def test_no_logarithm_in_the_loop():
    def stages(n):
        run = lambda: end(dps.BlanesMoanRKN6(), dps.LogDamping(3.0), n)
        traced = equations(jax.make_jaxpr(run)().eqns)
        return [eqn for eqn in traced if eqn.params.get("length") == 14]

    inside = lambda eqn: "log1p" in str(eqn.params["jaxpr"])
    assert any(map(inside, stages(2)))
    assert stages(40) and not any(map(inside, stages(40)))
