"""Problems on which coefficients and defaults may be tuned.

Those of the published tables are in `problems_test.py`.

The seven of `problems.py`, and seven more. Units and parameters are those of the
sources.
"""

import jax.numpy as jnp
import numpy as np
from problems import mechanics, pair_distances, Problem, PROBLEMS as SEVEN

import diffrax_presym as dps


def toda(n=16):
    """The periodic lattice of Toda (1967), with the friction 3 / t of Su, Boyd and
    Candes (2014)."""

    def potential(t, q, args):
        stretch = jnp.roll(q, -1) - q
        return jnp.sum(jnp.exp(stretch) - stretch - 1)

    q0 = np.sin(2 * np.pi * np.arange(n) / n)
    damping = dps.LogDamping(3.0, 1.0)
    return Problem("Toda lattice, 3 / t", mechanics(potential, damping), q0, 0 * q0, 60)


# Sun with the inner planets, Jupiter, Saturn, Uranus, Neptune and Pluto, from Hairer,
# Lubich and Wanner (2006), section I.2.4: days, astronomical units, solar masses.
PLANETS = (
    2.95912208286e-4,
    [
        *(1.00000597682, 0.000954786104043, 0.000285583733151),
        *(0.0000437273164546, 0.0000517759138449, 1 / 1.3e8),
    ],
    [
        *([0, 0, 0], [-3.5023653, -3.8169847, -1.5507963]),
        *([9.0755314, -3.0458353, -1.6483708], [8.3101420, -16.2901086, -7.2521278]),
        *(
            [11.4707666, -25.7294829, -10.8169456],
            [-15.5387357, -25.2225594, -3.1902382],
        ),
    ],
    [
        *([0, 0, 0], [0.00565429, -0.00412490, -0.00190589]),
        *([0.00168318, 0.00483525, 0.00192462], [0.00354178, 0.00137102, 0.00055029]),
        *([0.00288930, 0.00114527, 0.00039677], [0.00276725, -0.00170702, -0.00136504]),
    ],
)


def planets():
    """The outer solar system over 200 years, with drag."""
    gravity, mass, q0, v0 = map(np.array, PLANETS)
    i, j = np.triu_indices(len(mass), 1)
    weights = gravity * mass[i] * mass[j]
    distances = pair_distances(len(mass))
    potential = lambda t, q, args: -jnp.sum(weights / distances(q))
    kinetic = dps.QuadraticKinetic(mass[None])
    system = mechanics(potential, dps.ConstantDamping(1e-6), kinetic)
    p0, options = (mass[:, None] * v0).T, {"unit": 600.0, "distances": distances}
    return Problem("outer planets, drag", system, q0.T, p0, 73000.0, **options)


def molecules(n=16):
    """Colliding particles with the potential of Lennard-Jones (1924), with friction."""
    side = 4
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side))).reshape(2, -1)
    rng = np.random.default_rng(3)
    q0 = 1.15 * grid + 0.02 * rng.standard_normal((2, n))
    p0 = 0.4 * rng.standard_normal((2, n))
    i, j = np.triu_indices(n, 1)

    def potential(t, q, args):
        d = q[:, i] - q[:, j]
        inverse = 1 / jnp.sum(d**2, axis=0) ** 3
        return 4 * jnp.sum(inverse**2 - inverse)

    system = mechanics(potential, dps.ConstantDamping(0.1))
    p0 = p0 - p0.mean(axis=1, keepdims=True)
    return Problem("molecules, friction", system, q0, p0, 5.0)


def elastic_pendulum():
    """A pendulum on a spring (Vitt and Gorelik 1933): a stiff and a soft frequency."""

    def potential(t, q, args):
        length = jnp.sqrt(jnp.sum(q**2))
        return 50 * (length - 1) ** 2 / 2 + q[1]

    system = mechanics(potential, dps.ConstantDamping(0.02))
    return Problem("elastic pendulum", system, [1.0, 0.0], [0.0, 0.0], 50.0)


def duffing():
    """The driven hardening oscillator of Duffing (1918)."""

    def potential(t, q, args):
        return jnp.sum(q**2 / 2 + q**4 / 4 - 0.3 * jnp.cos(1.2 * t) * q)

    system = mechanics(potential, dps.ConstantDamping(0.1))
    return Problem("driven Duffing", system, [1.0], [0.0], 80.0)


def sine_gordon(n=64):
    """A breather of the damped sine-Gordon equation (Ablowitz, Kaup, Newell and Segur
    1973), in finite differences."""
    length = 20.0
    x = np.linspace(-length, length, n, endpoint=False)
    width, omega = x[1] - x[0], 0.6

    def potential(t, q, args):
        slope = (jnp.roll(q, -1) - q) / width
        return jnp.sum(slope**2 / 2 + 1 - jnp.cos(q))

    rho = np.sqrt(1 - omega**2)
    q0 = 4 * np.arctan(rho / omega / np.cosh(rho * x))
    law = lambda t: 0.2 * jnp.log1p(t) + 0.1 * jnp.sqrt(1 + t)
    system = mechanics(potential, law)
    return Problem("sine-Gordon, mixed law", system, q0, 0 * q0, 30.0)


def fermi_pasta_ulam(m=3, omega=20.0):
    """The chain of alternating soft and stiff springs of Galgani, Giorgilli, Martinoli
    and Vanzini (1992), see section I.5.1 of Hairer, Lubich and Wanner (2006)."""

    def potential(t, q, args):
        x, y = q[:m], q[m:]
        ends = jnp.concatenate([x - y, jnp.zeros(1)])
        others = jnp.concatenate([jnp.zeros(1), x + y])
        return omega**2 * jnp.sum(y**2) / 2 + jnp.sum((ends - others) ** 4) / 4

    q0, p0 = np.zeros(2 * m), np.zeros(2 * m)
    q0[0], p0[0], q0[m], p0[m] = 1.0, 1.0, 1 / omega, 1.0
    return Problem("stiff and soft springs", mechanics(potential), q0, p0, 20.0)


PROBLEMS = [
    *(*SEVEN, toda, planets, molecules, elastic_pendulum, duffing, sine_gordon),
    fermi_pasta_ulam,
]
