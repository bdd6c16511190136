"""What the hard cases have in common."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _solve import last, solve
from problems import henon_heiles as damped_henon_heiles

import diffrax_presym as dps


LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
RKN6 = dps.BlanesMoanRKN6()
QUADRATIC = dps.QuadraticKinetic()

harmonic = lambda t, q, args: jnp.sum(q**2) / 2
pendulum = lambda t, q, args: jnp.sum(1 - jnp.cos(q))
absolute = lambda t, q, args: jnp.sum(jnp.abs(q))
# Not defined for negative positions.
root = lambda t, q, args: -jnp.sum(jnp.sqrt(q))
# Without a lower bound: the motion reaches infinity in finite time.
quartic = lambda t, q, args: -jnp.sum(q**4)
mixed = lambda t, q, p, args: (1 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 2
duffing = lambda t, q, args: jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t))
henon_heiles = damped_henon_heiles().system.potential
softened = lambda q, args: jnp.sum(q**2) + (0.0 if args is None else args**2)
newton = lambda t, q, args: -1 / jnp.sqrt(softened(q, args))
# A step density, by Kepler's third law.
distance = lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5
height = lambda t, y, args, **kwargs: y[0][0]

run = eqx.filter_jit(solve)
ZERO = jnp.zeros(())
adaptive = lambda tolerance: dfx.PIDController(rtol=tolerance, atol=tolerance)
successful = lambda sol: sol.result == dfx.RESULTS.successful


def end(*arguments, **options):
    """The solve, and its final state in double precision."""
    sol = run(*arguments, **options)
    return sol, jax.tree.map(lambda x: np.asarray(x, np.float64), last(sol))


# Those that the groups of one scheme each compare.
FEW = (
    "PresymplecticEuler PresymplecticLeapfrog SuzukiYoshida(4) Suzuki4 "
    "BlanesMoan4 BlanesMoanRKN4 SofroniouSpaletta(6) BlanesMoan6 BlanesMoanRKN6 "
    "SofroniouSpaletta(8) BlanesCasasRKN8"
).split()
