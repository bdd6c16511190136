"""Shared by the tests of chosen steps: systems and solves as functions of the step."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_presym as dps


def cosine(t, q, args):
    return -jnp.sum(jnp.cos(q))


def system_of(potential, damping: Any = 0.1):
    friction = dps.ConstantDamping(damping)
    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential, friction)


PENDULUM = system_of(cosine)
RKN6 = dps.TunedRKN6()
Y0 = jnp.array([2.0, 0.5]), jnp.array([0.0, 0.3])
LONG = 0.0, 20.0, Y0


def solve_of(system, solver, t0, t1, y0, *, ts=None, args=None, **options):
    """A solve that is saved at given times, or at its end."""
    given: dict[str, Any] = {
        "saveat": dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=ts)
    }
    given |= {"adjoint": dps.FixedStepAdjoint(), "throw": False, "max_steps": None}

    @jax.jit
    def solve(dt0) -> Any:
        return dfx.diffeqsolve(
            *(system, solver, t0, t1, dt0, y0, args), **(given | options)
        )

    return solve


def choose(system, solver, t0, t1, y0, tolerance, max_steps=1_000_000, **options):
    solve = solve_of(system, solver, t0, t1, y0, **options)
    tolerances = {"rtol": tolerance, "atol": tolerance}
    return dps.choose_step(solve, t0, t1, max_steps=max_steps, **tolerances)
