"""Shared by the tests: the list of schemes, some systems, and functions to run them."""

import dataclasses
import json
import pathlib
from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps
from diffrax_presym.extend import System


# The form of the energy that a scheme requires, i.e. the systems it is tested on.
Kind = Literal[
    "frozen",  # T(t, p) + V(t, q)
    "split",  # a kinetic energy whose exact flow is known, and V(t, q)
    "quadratic",  # a quadratic kinetic energy, and V(t, q)
    "augmented",  # anything; the solver state holds a copy `(q, p)` in `carry[0]`
]


@dataclasses.dataclass(frozen=True)
class Scheme:
    """A solver and its claimed properties."""

    name: str
    solver: Any
    order: int
    evaluations: int  # of the force, per step
    symmetric: bool = True
    kind: Kind = "frozen"

    def __repr__(self):
        return self.name


def substeps(base, n: int):
    """Several equal steps of a scheme as one."""
    return dps.Composition(base, (1 / n,) * n)


# A new scheme is added as one line.
SCHEMES = [
    Scheme("euler_A", dps.PresymplecticEuler("momentum"), 1, 1, symmetric=False),
    Scheme("euler_B", dps.PresymplecticEuler("position"), 1, 1, symmetric=False),
    Scheme("leapfrog_AB", dps.PresymplecticLeapfrog("momentum"), 2, 1),
    Scheme("leapfrog_BA", dps.PresymplecticLeapfrog("position"), 2, 1),
    Scheme("suzuki_yoshida_4", dps.SuzukiYoshida(4), 4, 3),
    Scheme(
        "suzuki_yoshida_4_BA",
        dps.SuzukiYoshida(4, dps.PresymplecticLeapfrog("position")),
        4,
        3,
    ),
    Scheme("suzuki_yoshida_6", dps.SuzukiYoshida(6), 6, 9),
    Scheme("suzuki_yoshida_8", dps.SuzukiYoshida(8), 8, 27),
    Scheme("substeps", substeps(dps.PresymplecticLeapfrog(), 3), 2, 3),
    Scheme("strang", dps.Strang(), 2, 1, kind="split"),
    Scheme("tao", dps.PresymplecticTao(), 2, 3, kind="augmented"),
    Scheme("tao_fixed", dps.PresymplecticTao(5.0), 2, 3, kind="augmented"),
    Scheme(
        "tao_4", dps.SuzukiYoshida(4, dps.PresymplecticTao(5.0)), 4, 9, kind="augmented"
    ),
]
# One scheme for each code path; the others differ only in their coefficients.
WAYS = [
    scheme
    for scheme in SCHEMES
    if scheme.name
    in {
        "euler_B",
        "leapfrog_AB",
        "leapfrog_BA",
        "suzuki_yoshida_4",
        "substeps",
        "strang",
        "tao_4",
    }
]
# One scheme for each kind of solver state: none, a force, a copy. Diffrax does not
# depend on anything else.
CARRIES = [
    scheme
    for scheme in SCHEMES
    if scheme.name in {"leapfrog_BA", "suzuki_yoshida_4", "tao_4"}
]
# Schemes that are explicit for any energy.
ANY: tuple[Kind, ...] = ("augmented",)

# An implicit scheme, for any energy.
_midpoint = dps.PresymplecticGauss(1, optx.Newton(rtol=1e-12, atol=1e-12))
IMPLICIT = [Scheme("midpoint", _midpoint, 2, 1)]


def each(schemes=SCHEMES, *, kinds: tuple[Kind, ...] | None = None, symmetric=None):
    """Parametrise a test over schemes; by default over all of them."""
    chosen = [
        scheme
        for scheme in schemes
        if (kinds is None or scheme.kind in kinds)
        and (symmetric is None or scheme.symmetric == symmetric)
    ]
    return pytest.mark.parametrize("scheme", chosen, ids=repr)


def few(cases, schemes):
    """All cases for each kind of solver state; the first case for other schemes."""
    first, *_ = cases
    chosen = [(s, c) for s in schemes for c in cases if s in CARRIES or c == first]
    return pytest.mark.parametrize("scheme, case", chosen, ids=repr)


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
