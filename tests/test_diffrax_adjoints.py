"""The adjoints of Diffrax through every kind of system, by all solvers."""

import catalogue
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import diffrax_presym as dps


NONE, *LAWS = [x for x in catalogue.FRICTION if x.limit is None and not x.jumps]
(BODIES,) = catalogue.named(catalogue.SYSTEMS, "bodies")
# Without those that collocation would leave the manifold of.
PAIRS = [(s, NONE) for s in catalogue.SYSTEMS if not s.constrained]
PAIRS += [(BODIES, x) for x in LAWS if x.name != "operator"]
ADJOINTS = {
    "BacksolveAdjoint": dfx.BacksolveAdjoint(solver=dfx.Dopri8()),
    "DirectAdjoint": dfx.DirectAdjoint(),
    "RecursiveCheckpointAdjoint": dfx.RecursiveCheckpointAdjoint(),
}


def _gradient(system, y0, solver, adjoint):
    inputs, static = eqx.partition((system, y0), eqx.is_inexact_array)

    def loss(inputs):
        system, y0 = eqx.combine(inputs, static)
        sol = dfx.diffeqsolve(
            *(system, solver, 1.0, 1.5, 1 / 32, y0), adjoint=adjoint, max_steps=32
        )
        ends = [ravel_pytree(y)[0] for y in jax.tree.leaves(sol.ys)]
        return sum(jnp.sum(jnp.cos(jnp.arange(y.size)) * y) for y in ends)

    return ravel_pytree(eqx.filter_jit(jax.grad(loss))(inputs))[0]


@pytest.mark.variants(3)
@pytest.mark.parametrize("name", list(ADJOINTS))
@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: f"{pair[0]}-{pair[1]}")
def test_gradients_by_the_adjoints_of_diffrax(pair, name):
    system, friction = pair
    built = catalogue.build(system, friction)
    y0 = jax.tree.map(jnp.asarray, catalogue.start(system, friction))
    exact = _gradient(built, y0, dfx.Dopri8(), ADJOINTS["DirectAdjoint"])
    assert np.all(np.isfinite(exact)) and np.any(exact != 0)
    for solver in (dfx.Dopri8(), dps.PresymplecticGauss(3)):
        found = _gradient(built, y0, solver, ADJOINTS[name])
        np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-7)
