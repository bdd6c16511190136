"""What the hard cases have in common."""

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np
from _solve import last, solve

import diffrax_presym as dps


LEAPFROG = dps.PresymplecticLeapfrog()
RKN6 = dps.BlanesMoanRKN6()

run = eqx.filter_jit(solve)
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
