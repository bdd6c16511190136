"""Values between steps where a drift turns by far within one."""

from typing import Any, ClassVar

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_presym as dps
from diffrax_presym.extend import AbstractSplit


diffeqsolve: Any = dfx.diffeqsolve
OMEGA = jnp.array([1.0, 1000.0])
TIMES = jnp.linspace(0.0, 10.0, 38)


class Oscillations(AbstractSplit):
    """Two oscillators, exactly."""

    kinds: ClassVar = frozenset({"any", "nystrom"})

    def drift(self, system, t, h, data, y):
        (q, p), c, s = system.values(y), jnp.cos(OMEGA * h), jnp.sin(OMEGA * h)
        return system.add(y, (c * q + s * p - q, c * p - s * q - p))

    def force(self, system, t, y):
        return jnp.zeros(2)


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
