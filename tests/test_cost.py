"""The cost of a step: evaluations of the force, counted at run time."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ANY, each, harmonic, oscillator, Scheme, SCHEMES, solve

import diffrax_presym as dps
from diffrax_presym._scan import equations


class Counter:
    """Velocity and force of an oscillator that count their evaluations.

    XLA removes a pure callback whose value is not used, as it removes any other unused
    force, for example in the derivatives for dense output of a solve that saves only
    its final state. A debugging callback has a side effect and would still be counted.
    """

    def __init__(self):
        self.velocities, self.forces = 0, 0

    def velocity(self, t, p, args):
        return self._count("velocities", p)

    def force(self, t, q, args):
        return -self._count("forces", q)

    def _count(self, name, x):
        def count(x):
            setattr(self, name, getattr(self, name) + 1)
            return np.asarray(x)

        @jax.custom_jvp
        def counted(x):
            return jax.pure_callback(count, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

        # Dense output for high order differentiates the vector field.
        counted.defjvp(lambda x, dx: (counted(*x), *dx))
        return counted(x)


STEPS = 8


def count(solver, **kwargs):
    counter = Counter()
    system = dps.VectorField(counter.velocity, counter.force, dps.ConstantDamping(0.1))
    y0 = (jnp.array([1.0]), jnp.array([0.0]))
    sol = solve(system, solver, 0.0, 1.0, 1 / STEPS, y0, **kwargs)
    jax.block_until_ready(sol.ys)
    return counter


@each(kinds=("frozen", "split", *ANY))
def test_force_evaluations_per_step(scheme: Scheme):
    forces = count(scheme.solver).forces
    # The force at the end of a step may be reused; the first has to be evaluated.
    assert forces in (STEPS * scheme.evaluations, STEPS * scheme.evaluations + 1)


@each(kinds=ANY)
def test_velocity_evaluations_per_step_of_augmented_schemes(scheme: Scheme):
    velocities = count(scheme.solver).velocities
    assert velocities == STEPS * scheme.evaluations + (scheme.kind == "augmented")


@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_triple_jumps_take_powers_of_three(order):
    assert len(dps.SuzukiYoshida(order).weights) == 3 ** (order // 2 - 1)


@pytest.mark.parametrize("first, extra", [("momentum", 0), ("position", 2)])
def test_dense_output_of_the_leapfrog(first, extra):
    solver = dps.PresymplecticLeapfrog(first)
    plain = count(solver).forces
    dense = count(solver, saveat=dfx.SaveAt(ts=jnp.array([0.3, 0.9]))).forces
    assert dense - plain == extra * STEPS


# Traced evaluations, an upper bound.


def trace(hamiltonian, solver, made_jump: Any = False):
    term = dps.HamiltonianTerm(hamiltonian)

    def step(t0, t1, y):
        carry = solver.init(term, t0, t1, y, None)
        y, _, dense_info, carry, _ = solver.step(
            term, t0, t1, y, None, carry, made_jump
        )
        # Points between the ends are shorter steps of the same scheme.
        inner = dense_info.pop("inner", None)
        return y, dense_info, carry, inner

    y = (jnp.array([1.0]), jnp.array([0.0]))
    jaxpr = jax.make_jaxpr(step)(jnp.array(0.0), jnp.array(0.1), y)
    return list(equations(jaxpr.eqns))


def primitives(equations):
    return {equation.primitive.name for equation in equations}


EXPONENTIALS = {"exp", "exp2", "expm1", "log", "log1p", "pow"}


@each()
def test_undamped_systems_trace_no_exponential(scheme: Scheme):
    undamped = dps.SeparableHamiltonian(dps.QuadraticKinetic(), harmonic)
    assert not EXPONENTIALS & primitives(trace(undamped, scheme.solver))
    # The counter does count evaluations.
    assert EXPONENTIALS & primitives(trace(oscillator(), scheme.solver))


@each()
def test_steps_without_jumps_trace_no_branch(scheme: Scheme):
    assert "cond" not in primitives(trace(oscillator(), scheme.solver))


def test_a_jump_recomputes_what_was_carried():
    traced = trace(oscillator(), dps.PresymplecticLeapfrog(), made_jump=jnp.array(True))
    assert "cond" in primitives(traced)


def test_the_size_of_a_composition_does_not_grow_with_its_stages():
    sizes = [len(trace(oscillator(), dps.SuzukiYoshida(order))) for order in (6, 8)]
    assert sizes[0] == sizes[1]


@each(
    [scheme for scheme in SCHEMES if scheme.evaluations > 5],
    kinds=("frozen", *ANY),  # exact drifts may contain small loops
)
def test_many_stages_run_in_one_loop(scheme: Scheme):
    traced = trace(oscillator(), scheme.solver)
    scans = [e for e in traced if e.primitive.name == "scan"]
    # That of the step; and for dense output one over points between its ends, with that
    # of a shorter step in it.
    assert len(scans) == 3
