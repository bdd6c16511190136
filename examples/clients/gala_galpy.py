"""Potentials of gala and galpy, converted by galax, or called from JAX.

Needs `pip install "galax[interop-gala,interop-galpy]"` (Python 3.12). Prints by how
much forces differ from those of gala and galpy, and orbits from each other.

    python examples/clients/gala_galpy.py
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# pyright: reportOptionalSubscript=false

import os


os.environ["JAX_ENABLE_X64"] = "true"  # before galax makes its constants

import diffrax as dfx
import gala.potential as gala
import galpy.potential
import jax
import jax.numpy as jnp
import numpy as np
from galax.potential.io import convert_potential, GalaxLibrary
from galpy.util.conversion import force_in_kmsMyr

import diffrax_presym as dps


galaxy = gala.MilkyWayPotential(version="v1")
parts = [convert_potential(GalaxLibrary, x) for x in galaxy.values()]
converted = lambda t, q, args: sum(x._potential(q, t) for x in parts)


def acceleration(t, q, args):  # no gradient, but for any potential of gala
    call = lambda q: galaxy.acceleration(np.asarray(q)).value[:, 0]
    return jax.pure_callback(call, q, q, vmap_method="sequential")


called = dps.ForceField(acceleration)


@jax.jit
def solve(y0):
    return [
        dfx.diffeqsolve(
            dps.MechanicalSystem(dps.QuadraticKinetic(), x),
            *(dps.TunedRKN6(), 0.0, 1000.0, 2.5, y0),
            adjoint=dps.FixedStepAdjoint(),
        ).ys[0][-1]
        for x in (converted, called)
    ]


first, second = solve((jnp.array([8.0, 0.0, 1.0]), jnp.array([0.0, 0.22, 0.05])))
print(f"orbits differ by {abs(first - second).max():.0e} kpc after 1 Gyr")
assert abs(first - second).max() < 1e-10

# The radial force of each part of galpy's MWPotential2014, without units there.
q, unit = jnp.array([12.0, 0.0, 3.0]), 1.0227121650537077e-3  # kpc / Myr in km / s
for part in galpy.potential.MWPotential2014:
    potential = convert_potential(GalaxLibrary, part)
    force = -jax.grad(potential._potential)(q, 0.0)[0]
    theirs = galpy.potential.evaluateRforces(part, 12 / 8, 3 / 8)
    theirs *= force_in_kmsMyr(220.0, 8.0) * unit
    print(f"{type(part).__name__:32}galax / galpy {force / theirs:.6f}")
