"""Shared by the tests of steps that vary: an eccentric orbit, and how it is solved."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps


E = 0.9
Y0 = (jnp.array([1 - E, 0.0]), jnp.array([0.0, ((1 + E) / (1 - E)) ** 0.5]))
PERIOD = 2 * np.pi


def attraction(t, q, args):
    return -1 / jnp.linalg.norm(q)


KEPLER = dps.MechanicalSystem(dps.QuadraticKinetic(), attraction)
LEAPFROG = dps.PresymplecticLeapfrog()


def DISTANCE(t, y, args):
    return jnp.linalg.norm(y[0]) ** 1.5


control = dps.StepDensityController


@eqx.filter_jit
def solve(controller, solver, t0, t1, y0, system=KEPLER, **kwargs) -> Any:
    options: dict[str, Any] = dict(dt0=None, max_steps=2000, throw=False) | kwargs
    return dfx.diffeqsolve(
        *(system, solver, jnp.asarray(t0), jnp.asarray(t1)),
        y0=y0,
        stepsize_controller=controller,
        **options,
    )


def last(ys):
    return jax.tree.map(lambda y: y[-1], ys)


def succeeds(sol):
    return sol.result == dfx.RESULTS.successful
