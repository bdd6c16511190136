"""`vmap` over all arguments agrees with a loop."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, each, pendulum, Scheme, WAYS

import diffrax_presym as dps


def driven(t, q, args):
    return pendulum(t, q, None) * (1 + args * jnp.sin(t))


def solve(solver, gamma, mass, t0, t1, dt0, q0, strength):
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(mass), driven, dps.ConstantDamping(gamma)
    )
    return solve_with(hamiltonian, solver, t0, t1, dt0, q0, strength)


@eqx.filter_jit
def solve_with(hamiltonian, solver, t0, t1, dt0, q0, strength):
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(hamiltonian),
        solver,
        t0=t0,
        t1=t1,
        dt0=dt0,
        y0=(q0, jnp.zeros_like(q0)),
        args=strength,
    )
    return jax.tree.map(lambda y: y[-1], sol.ys)


ARGUMENTS = {
    "gamma": jnp.array(0.1),
    "mass": jnp.array(2.0),
    "t0": jnp.array(0.1),
    "t1": jnp.array(2.0),
    "dt0": jnp.array(0.1),
    "q0": jnp.array([1.0, 0.5]),
    "strength": jnp.array(0.3),
}
SPLITTING = Scheme("splitting", dps.BlanesMoanRKN6(), 6, 14, kind="quadratic")


# Two schemes only, as each is compiled twice.
FEW = {"leapfrog_AB", "coupled_4"}


def element(batch, i):
    return jax.tree.map(lambda x: x[i], batch)


@each([s for s in WAYS if s.name in FEW] + [SPLITTING])
def test_everything_at_once(scheme: Scheme):
    scales = jnp.array([0.8, 1.0, 1.25])
    batch = {name: jnp.tensordot(scales, x, 0) for name, x in ARGUMENTS.items()}
    # Forwards, an empty interval, and backwards.
    batch["t1"] = batch["t0"] + jnp.array([1.0, 0.0, -1.5])
    batch["dt0"] = jnp.array([0.1, 0.1, -0.125])
    together = jax.vmap(lambda arguments: solve(scheme.solver, **arguments))(batch)
    for i in range(len(scales)):
        alone = solve(scheme.solver, **element(batch, i))
        assert_close(element(together, i), alone, 1e-13)


@pytest.mark.parametrize("name", ARGUMENTS)
def test_one_at_a_time(name):
    solver = dps.PresymplecticLeapfrog()
    x = ARGUMENTS[name]
    others = {k: v for k, v in ARGUMENTS.items() if k != name}
    batch = jnp.stack([x, 0.5 * x])
    together = jax.vmap(lambda x: solve(solver, **others, **{name: x}))(batch)
    for i in range(2):
        alone = solve(solver, **others, **{name: batch[i]})
        assert_close(element(together, i), alone, 1e-13)


def test_a_batch_of_hamiltonians():
    gammas = jnp.array([0.0, 0.1, -0.2])
    make = lambda gamma: dps.ConformalHamiltonian(
        dps.QuadraticKinetic(2.0), driven, dps.ConstantDamping(gamma)
    )
    batch = eqx.filter_vmap(make)(gammas)
    rest = {k: v for k, v in ARGUMENTS.items() if k not in ("gamma", "mass")}
    run = lambda hamiltonian: solve_with(
        hamiltonian, dps.PresymplecticLeapfrog(), **rest
    )
    together = eqx.filter_vmap(run)(batch)
    for i, gamma in enumerate(gammas):
        assert_close(element(together, i), run(make(gamma)), 1e-13)


def test_an_empty_solve_in_a_batch_is_its_start():
    solver = dps.PresymplecticLeapfrog()
    ends = jnp.stack([ARGUMENTS["t0"], ARGUMENTS["t1"]])
    others = {k: v for k, v in ARGUMENTS.items() if k != "t1"}
    together = jax.vmap(lambda t1: solve(solver, t1=t1, **others))(ends)
    q0 = ARGUMENTS["q0"]
    assert_close(element(together, 0), (q0, jnp.zeros_like(q0)), 0.0)
