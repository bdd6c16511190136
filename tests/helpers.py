"""Shared by the tests: some systems, and functions to run solves."""

import json
import pathlib

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps
from diffrax_presym.extend import System


def substeps(base, n: int):
    """Several equal steps of a scheme as one."""
    return dps.Composition(base, (1 / n,) * n)


def reference(name: str):
    path = pathlib.Path(__file__).with_name("reference.json")
    return json.loads(path.read_text())[name]


# Functions are defined once, as a new closure would be compiled again.


def harmonic(t, q, args):
    return jnp.sum(q**2) / 2


def pendulum(t, q, args):
    return jnp.sum(1 - jnp.cos(q))


def henon_heiles(t, q, args):
    return jnp.sum(q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def mixed_energy(t, q, p, args):
    """A nonseparable energy."""
    return (1 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 2


def oscillator(gamma=0.2):
    return dps.MechanicalSystem(
        dps.QuadraticKinetic(), harmonic, dps.ConstantDamping(gamma)
    )


def drift(hamiltonian, t, h, q, p):
    """The flow of the kinetic part, as a splitting takes it."""
    system = System(hamiltonian, None, 1, (q, p))
    split = system.split("any")
    data = split.prepare(system, t, h, 8)
    return split.drift(system, t, h, data, (q, p))


# Python numbers would be compiled as constants: compile once for all times.


def step(hamiltonian, solver, t0, t1, y, args=None):
    """One step from a new solver state, as in `diffeqsolve`, with all its outputs."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    return _step(hamiltonian, solver, t0, t1, y, args)


@eqx.filter_jit
def _step(hamiltonian, solver, t0, t1, y, args):
    carry = solver.init(hamiltonian, t0, t1, y, args)
    return solver.step(hamiltonian, t0, t1, y, args, carry, made_jump=False)


def solve(hamiltonian, solver, t0, t1, dt0, y0, args=None, **kwargs):
    """A solve of at most 4096 steps that saves the final state."""
    t0, t1, dt0 = jnp.asarray(t0), jnp.asarray(t1), jnp.asarray(dt0)
    return _solve(hamiltonian, solver, t0, t1, dt0, y0, args, **kwargs)


_solve = eqx.filter_jit(dfx.diffeqsolve)


def trajectory(hamiltonian, solver, t0, t1, dt0, y0, args=None, **kwargs):
    """Times, positions and momenta of every step, including the initial ones."""
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = solve(hamiltonian, solver, t0, t1, dt0, y0, args, saveat=saveat, **kwargs)
    assert sol.ts is not None and sol.ys is not None
    sol = jtu.tree_map(np.asarray, (sol.ts, *sol.ys))
    taken = np.isfinite(sol[0])
    return jtu.tree_map(lambda x: x[taken], sol)


def flat(tree):
    """All leaves as one vector."""
    return ravel_pytree(tree)[0]


def assert_close(x, y, tolerance):
    """Largest difference, relative to the largest entry where that exceeds one."""
    assert jtu.tree_structure(x) == jtu.tree_structure(y)
    x, y = np.asarray(flat(x), np.float64), np.asarray(flat(y), np.float64)
    assert np.all(np.isfinite(x)) and np.all(np.isfinite(y))
    size = np.max(np.abs(y), initial=1)
    assert np.max(np.abs(x - y), initial=0) <= tolerance * size


def equations(jaxpr):
    """All of a program, also of its parts."""
    for equation in jaxpr.eqns:
        yield equation
        for part in jtu.tree_leaves(
            equation.params, is_leaf=lambda x: hasattr(x, "eqns")
        ):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield from equations(part)


def check_members(total, members, rtol):
    """That values and gradients of a batch are those of its members alone, and these
    central differences. `total(x)` returns a loss, and values and something else, which
    is returned."""
    run, value = jax.value_and_grad(total, has_aux=True), jax.jit(total)
    (_, (ys, other)), gradients = jax.jit(jax.vmap(run))(members)
    for x, y, gradient in zip(members, ys, gradients, strict=True):
        (_, (alone, _)), got = jax.jit(run)(x)
        np.testing.assert_allclose(y, alone, rtol, rtol / 10)
        np.testing.assert_allclose(gradient, got, 1e3 * rtol, 10 * rtol)
        for e in 1e-6 * jnp.eye(len(x)):
            two = (value(x + e)[0] - value(x - e)[0]) / 2e-6
            assert got @ e / 1e-6 == pytest.approx(float(two), rel=1e-5, abs=1e-7)
    return other
