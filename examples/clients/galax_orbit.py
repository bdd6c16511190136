"""An orbit in a galactic potential, with galax.

Needs `pip install galax` (Python 3.12). Prints the largest error of the positions over
3 Gyr, compared with galax's default solver at a small tolerance, and the time of a
solve with `jax.jit` and without.

    python examples/clients/galax_orbit.py
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# pyright: reportOptionalSubscript=false

import os
import statistics
import time


os.environ["JAX_ENABLE_X64"] = "true"  # before galax makes its constants

import diffrax as dfx
import galax.coordinates as gc
import galax.dynamics as gd
import galax.potential as gp
import jax
import jax.numpy as jnp
import unxt as u
from galax.dynamics.fields import AbstractOrbitField, HamiltonianField

import diffrax_presym as dps


@AbstractOrbitField.terms.dispatch
def terms(self: HamiltonianField, solver: dps.extend.AbstractPresymplecticSolver, /):
    def potential(t, q, args):
        return jnp.sum(self.potential._potential(q, t))  # of all orbits of a batch

    return dps.MechanicalSystem(dps.QuadraticKinetic(), potential)


solver = gd.OrbitSolver(
    dps.TunedRKN6(),
    stepsize_controller=dfx.ConstantStepSize(),
    adjoint=dps.FixedStepAdjoint(),
)
field = HamiltonianField(gp.MilkyWayPotential())
w0 = gc.PhaseSpaceCoordinate(
    q=u.Q([8.0, 0.0, 1.0], "kpc"), p=u.Q([0.0, 220.0, 50.0], "km/s"), t=u.Q(0, "Gyr")
)
ts = u.Q(jnp.linspace(0, 3000, 301), "Myr")


@jax.jit
def solve(w0):
    return solver.solve(field, w0, ts[-1], saveat=ts, dt0=2.5)  # dt0 in Myr


orbit = solve(w0)

precise = dfx.PIDController(rtol=1e-12, atol=1e-12)
reference = gd.OrbitSolver(dfx.Dopri8(), stepsize_controller=precise)
exact = reference.solve(field, w0, ts[-1], saveat=ts)
error = jnp.abs(orbit.ys[0] - exact.ys[0]).max()
print(f"largest error {error:.1e} kpc")
assert error < 1e-6


def milliseconds(fn):
    times = []
    for _ in range(10):
        start = time.perf_counter()
        jax.block_until_ready(fn(w0).ys)
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


plain = milliseconds(solve.__wrapped__)
print(f"{milliseconds(solve):.1f} ms, and {plain:.0f} without jax.jit")
