"""The schemes that are compared, what a step of each costs, and where it is stable."""

from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps


class Scheme(NamedTuple):
    solver: dfx.AbstractSolver
    order: int
    # Of the force per step; of velocity and force where the system is not separable.
    evaluations: int


SCHEMES = {
    "PresymplecticEuler": Scheme(dps.PresymplecticEuler(), 1, 1),
    "PresymplecticLeapfrog": Scheme(dps.PresymplecticLeapfrog(), 2, 1),
    "PresymplecticLeapfrog, position first": Scheme(
        dps.PresymplecticLeapfrog("position"), 2, 1
    ),
    "Strang": Scheme(dps.Strang(), 2, 1),
    "SuzukiYoshida(4)": Scheme(dps.SuzukiYoshida(4), 4, 3),
    "SuzukiYoshida(4), position first": Scheme(
        dps.SuzukiYoshida(4, dps.PresymplecticLeapfrog("position")), 4, 3
    ),
    "Suzuki4": Scheme(dps.Suzuki4(), 4, 5),
    "BlanesMoan4": Scheme(dps.BlanesMoan4(), 4, 6),
    "BlanesMoanRKN4": Scheme(dps.BlanesMoanRKN4(), 4, 6),
    "SuzukiYoshida(6)": Scheme(dps.SuzukiYoshida(6), 6, 9),
    "SofroniouSpaletta(6)": Scheme(dps.SofroniouSpaletta(6), 6, 13),
    "BlanesMoan6": Scheme(dps.BlanesMoan6(), 6, 10),
    "BlanesMoanRKN6": Scheme(dps.BlanesMoanRKN6(), 6, 14),
    "TunedRKN6": Scheme(dps.TunedRKN6(), 6, 14),
    "SuzukiYoshida(8)": Scheme(dps.SuzukiYoshida(8), 8, 27),
    "SofroniouSpaletta(8)": Scheme(dps.SofroniouSpaletta(8), 8, 21),
    "BlanesCasasRKN8": Scheme(dps.BlanesCasasRKN8(), 8, 19),
    "TunedLinear8": Scheme(dps.TunedLinear8(), 8, 14),
    "SymmetricMultistep(8)": Scheme(dps.SymmetricMultistep(8), 8, 1),
    "SymmetricMultistep(10)": Scheme(dps.SymmetricMultistep(10), 10, 1),
    "SofroniouSpaletta(10)": Scheme(dps.SofroniouSpaletta(10), 10, 35),
    "PresymplecticTao": Scheme(dps.PresymplecticTao(), 2, 3),
    # Six stages at once, in each of several iterations.
    "PresymplecticGauss(6)": Scheme(dps.PresymplecticGauss(6), 12, 40),
}
DIFFRAX = {
    "Tsit5": Scheme(dfx.Tsit5(), 5, 6),
    "Dopri5": Scheme(dfx.Dopri5(), 5, 6),
    "Dopri8": Scheme(dfx.Dopri8(), 8, 13),
}

# What the trace of a step may exceed its bound by and count as stable, a growth by 1e-6
# per step. Near multiples of pi the trace may touch the bound, where the excess of some
# schemes is less than rounding.
TRACE_TOLERANCE = 1e-12


@eqx.filter_jit
def step_matrices(solver, h, friction):
    """The matrix of a step of q'' + friction q' + q = 0, for each `h` and `friction`;
    not a number if the step fails."""

    def one(h, friction):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(),
            lambda t, q, args: q**2 / 2,
            dps.ConstantDamping(friction),
        )

        def step(y):
            t0 = jnp.zeros_like(h)
            carry = solver.init(system, t0, h, y, None)
            y, *_, result = solver.step(system, t0, h, y, None, carry, made_jump=False)
            return jnp.where(result == dfx.RESULTS.successful, jnp.stack(y), jnp.nan)

        unit = jnp.ones_like(h), jnp.zeros_like(h)
        return jnp.stack([step(unit), step(unit[::-1])], axis=1)

    return jax.vmap(one)(h, jnp.broadcast_to(friction, h.shape))


def stability_limit(scheme, friction=0.0):
    """The end of the first interval of stability of an oscillator.

    It is the largest step times frequency below which every step is stable: both
    eigenvalues of a step, whose determinant is the decay `exp(-friction h)`, have
    modulus at most one, which is |trace| <= 1 + det. Infinite if all steps that were
    tried are stable, up to 2.2 per evaluation.
    """

    def excess(h):
        matrices = np.asarray(step_matrices(scheme.solver, jnp.asarray(h), friction))
        trace = matrices[:, 0, 0] + matrices[:, 1, 1]
        return np.abs(trace) - (1 + np.exp(-friction * h))

    h = np.linspace(0, 2.2 * scheme.evaluations, 22001)
    values = excess(h)
    first = lambda values: np.argmax(values > TRACE_TOLERANCE)
    for i in range(1, h.size - 1):
        unstable, value = h[i], values[i]
        if value >= max(values[i - 1], values[i + 1]):
            # An instability may be narrower than the distance of the points.
            unstable, value = _zoom(excess, h[i - 1], h[i + 1], np.argmax)
        if value > TRACE_TOLERANCE:
            return _zoom(excess, h[i - 1], unstable, first)[0]
    return np.inf


def _zoom(function, low, high, choose):
    """The point between `low` and `high` that `choose` takes by the values, and its."""
    x, values, i = np.array([low, high]), np.zeros(2), 0
    for _ in range(10):
        x = np.linspace(low, high, 33)
        values = function(x)
        i = int(choose(values))
        low, high = x[max(i - 1, 0)], x[min(i + 1, 32)]
    return float(x[i]), float(values[i])
