"""Problems for the published tables, fixed before anything was measured on them.

Nothing in the package is tuned on these. They are from the literature, with the
parameters and initial states of the sources where these give them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from problems import mechanics, pair_distances, Problem

import diffrax_presym as dps


def pleiades():
    """Seven stars in the plane: Hairer, Norsett and Wanner (1993), section II.10."""
    x = [3.0, 3, -1, -3, 2, -2, 2]
    y = [3.0, -3, 2, 0, 0, -4, 4]
    u = [0.0, 0, 0, 0, 0, 1.75, -1.5]
    v = [0.0, 0, 0, -1.25, 1, 0, 0]
    mass = np.arange(1.0, 8)
    i, j = np.triu_indices(7, 1)
    weights, distances = mass[i] * mass[j], pair_distances(7)
    potential = lambda t, q, args: -jnp.sum(weights / distances(q))
    system = mechanics(potential, kinetic=dps.QuadraticKinetic(mass[None]))
    momenta = mass * np.array([u, v])
    return Problem("Pleiades", system, [x, y], momenta, 3.0, distances=distances)


def detest_orbit():
    """Orbit D3 of Hull, Enright, Fellen and Sedgwick (1972)."""
    e = 0.5
    distance = lambda q: jnp.sqrt(jnp.sum(q**2))
    system = mechanics(lambda t, q, args: -1 / distance(q))
    p0 = [0.0, np.sqrt((1 + e) / (1 - e))]
    return Problem("orbit D3", system, [1 - e, 0.0], p0, 20.0, distances=distance)


def figure_eight():
    """Three equal masses on an eight: Chenciner and Montgomery (2000), five periods."""
    q0 = np.array([[0.97000436, -0.97000436, 0], [-0.24308753, 0.24308753, 0]])
    v0 = np.array([-0.93240737, -0.86473146])
    p0 = np.stack([-v0 / 2, -v0 / 2, v0], axis=1)
    distances = pair_distances(3)
    system = mechanics(lambda t, q, args: -jnp.sum(1 / distances(q)))
    t1 = 5 * 6.32591398
    return Problem("figure eight", system, q0, p0, t1, distances=distances)


def logarithmic_galaxy():
    """A box orbit in the potential of Binney and Tremaine (1987), section 3.3.1."""

    def potential(t, q, args):
        x, y = q
        return jnp.log(0.14**2 + x**2 + (y / 0.9) ** 2) / 2

    system = mechanics(potential)
    return Problem("galactic orbit", system, [0.49, 0.0], [0.6, 0.95], 50.0)


def disc_with_drag():
    """A star in the disc of Miyamoto and Nagai (1975), with drag."""

    def potential(t, q, args):
        x, y, z = q
        height = 3.0 + jnp.sqrt(z**2 + 0.28**2)
        return -10 / jnp.sqrt(x**2 + y**2 + height**2)

    system = mechanics(potential, dps.ConstantDamping(0.01))
    return Problem("disc, drag", system, [8.0, 0.0, 0.5], [0.1, 0.9, 0.2], 150.0)


def argon():
    """The frozen argon crystal of Biesiadecki and Skeel (1993), with the initial state
    of Hairer, Lubich and Wanner (2006), section I.4.1: nanometres, nanoseconds."""
    boltzmann, depth, sigma, mass = 1.380658e-23, 119.8, 0.341, 66.34e-27
    q0 = [
        [0.00, 0.02, 0.34, 0.36, -0.02, -0.35, -0.31],
        [0.00, 0.39, 0.17, -0.21, -0.40, -0.16, 0.21],
    ]
    v0 = [[-30.0, 50, -70, 90, 80, -40, -80], [-20.0, -90, -60, 40, 90, 100, -60]]
    # Per unit mass; one metre per second is one nanometre per nanosecond.
    strength = 4 * boltzmann * depth / mass
    i, j = np.triu_indices(7, 1)

    def potential(t, q, args):
        d = q[:, i] - q[:, j]
        inverse = sigma**6 / jnp.sum(d**2, axis=0) ** 3
        return strength * jnp.sum(inverse**2 - inverse)

    system = mechanics(potential)
    return Problem("argon crystal", system, q0, v0, 0.02, unit=3e-4)


def fermi_pasta_ulam_alpha(n=32):
    """The nonlinear lattice of Fermi, Pasta and Ulam (1955), with decaying friction."""

    def potential(t, q, args):
        ends = jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)])
        stretch = jnp.diff(ends)
        return jnp.sum(stretch**2 / 2 + stretch**3 / 12)

    q0 = np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
    system = mechanics(potential, dps.LogDamping(0.5, 1.0))
    return Problem("FPU lattice, decaying", system, q0, 0 * q0, 200.0)


def klein_gordon(n=16):
    """A nonlinear wave in the plane (Strauss and Vazquez 1978), damped."""
    width = 10.0 / n

    def potential(t, q, args):
        slopes = [(jnp.roll(q, -1, axis) - q) / width for axis in (0, 1)]
        return jnp.sum((slopes[0] ** 2 + slopes[1] ** 2 + q**2) / 2 + q**4 / 4)

    x, y = np.meshgrid(*[width * np.arange(n) - 5] * 2, indexing="ij")
    q0 = 2 * np.exp(-(x**2 + y**2) / 2)
    system = mechanics(potential, dps.ConstantDamping(0.05))
    return Problem("wave in the plane", system, q0, 0 * q0, 20.0)


def two_wells():
    """The driven buckled beam of Moon and Holmes (1979)."""

    def potential(t, q, args):
        return jnp.sum(-(q**2) / 4 + q**4 / 8 - 0.2 * jnp.cos(t) * q)

    system = mechanics(potential, dps.ConstantDamping(0.25))
    return Problem("two wells, driven", system, [1.0], [0.5], 60.0)


def contraction():
    """Two coupled scalar fields in a contracting universe, where friction excites:
    Mukhanov (2005), section 5.4, with the scale factor (1 - t / 60)^(2/3)."""

    def potential(t, q, args):
        x, y = q
        return (x**2 + 1.5 * y**2) / 2 + x**2 * y**2 / 4

    system = mechanics(potential, lambda t: 2 * jnp.log1p(-t / 60))
    return Problem("contracting universe", system, [0.3, 0.2], [0.0, 0.1], 45.0)


def relativistic_quartic():
    """A relativistic particle in an anharmonic potential (Goldstein 1980, section 7.9),
    damped."""

    def potential(t, q, args):
        x, y = q
        return (x**2 + y**2) / 2 + (x**4 + x**2 * y**2 + 2 * y**4) / 4

    kinetic = dps.RelativisticKinetic(1.0, 2.0)
    system = mechanics(potential, dps.ConstantDamping(0.02), kinetic)
    return Problem("relativistic, quartic", system, [1.5, 0.5], [0.0, 1.0], 60.0)


def accelerated_logistic(n=20, m=60):
    """The equation of Su, Boyd and Candes (2014) for a logistic regression, from
    t = 1."""
    rng = np.random.default_rng(11)
    data = rng.standard_normal((m, n))
    labels = np.sign(data @ rng.standard_normal(n) + rng.standard_normal(m))
    rows = jnp.asarray(labels[:, None] * data)

    def potential(t, q, args):
        return jnp.sum(jax.nn.softplus(-rows @ q)) + jnp.sum(q**2) / 20

    system = mechanics(potential, dps.LogDamping(3.0, 1.0))
    return Problem("accelerated gradient", system, np.zeros(n), np.zeros(n), 20.0)


def morse_chain(n=20):
    """A chain of alternating light and heavy atoms (Born and von Karman 1912) with the
    bonds of Morse (1929), cooled ever more slowly."""
    mass = np.where(np.arange(n) % 2, 20.0, 1.0)

    def potential(t, q, args):
        return jnp.sum((1 - jnp.exp(-(jnp.roll(q, -1) - q))) ** 2)

    q0 = 0.3 * np.sin(2 * np.pi * np.arange(n) / n)
    p0 = np.sqrt(mass) * 0.3 * np.cos(6 * np.pi * np.arange(n) / n)
    law = lambda t: 0.5 * jnp.sqrt(1 + t)
    system = mechanics(potential, law, dps.QuadraticKinetic(mass))
    return Problem("Morse chain", system, q0, p0 - p0.mean(), 40.0)


def vortices():
    """Four point vortices (Aref 1983), an energy that is not separable."""
    strength = np.array([1.0, 1.0, 1.0, 1.0])
    i, j = np.triu_indices(4, 1)

    def energy(t, q, p, args):
        square = (q[i] - q[j]) ** 2 + (p[i] - p[j]) ** 2
        return -jnp.sum(strength[i] * strength[j] * jnp.log(square)) / (4 * np.pi)

    q0, p0 = [1.0, -1.0, 0.1, -0.2], [0.1, 0.0, 0.8, -0.9]
    return Problem("point vortices", dps.Hamiltonian(energy), q0, p0, 60.0)


PROBLEMS = [
    *(pleiades, detest_orbit, figure_eight, logarithmic_galaxy, disc_with_drag, argon),
    *(fermi_pasta_ulam_alpha, klein_gordon, two_wells, contraction),
    *(relativistic_quartic, accelerated_logistic, morse_chain, vortices),
]
