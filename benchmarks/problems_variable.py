"""Problems for variable steps: orbits, in units and from the sources as stated."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize
from jax.flatten_util import ravel_pytree
from problems import mechanics, Problem
from problems_test import pleiades


ATTRACTION = mechanics(lambda t, q, args: -1 / jnp.linalg.norm(q))


def eccentric(e, anomaly=0.0):
    """Position and momentum at an eccentric anomaly, of an orbit of period 2 pi."""
    b, rate = np.sqrt(1 - e**2), 1 / (1 - e * np.cos(anomaly))
    q = np.array([np.cos(anomaly) - e, b * np.sin(anomaly)])
    return q, rate * np.array([-np.sin(anomaly), b * np.cos(anomaly)])


MOON = 0.012277471


def restricted(q, t):
    """The places of earth and moon, in the frame at rest."""
    along = jnp.stack([jnp.cos(t), jnp.sin(t)])
    return jnp.linalg.norm(q + MOON * along), jnp.linalg.norm(q - (1 - MOON) * along)


def arenstorf():
    """Hairer, Norsett and Wanner (1993), section II.0, in the frame at rest."""

    def potential(t, q, args):
        earth, moon = restricted(q, t)
        return -(1 - MOON) / earth - MOON / moon

    speed, period = -2.00158510637908252240537862224, 17.0652165601579625588917206249
    p0 = [0.0, speed + 0.994]
    return Problem("Arenstorf orbit", mechanics(potential), [0.994, 0.0], p0, period)


def galaxy():
    """A cusp of the density 1 / r, Hernquist's (1990), flattened: about 50 orbits."""
    axes = np.array([1.0, 0.9, 0.7])
    system = mechanics(lambda t, q, args: -1 / (1 + jnp.linalg.norm(q / axes)))
    return Problem("cusped galaxy", system, [1.0, 0.0, 0.2], [0.0, 0.2, 0.1], 300.0)


def orbit():
    q0, p0 = eccentric(0.9)
    return Problem("Kepler, e = 0.9", ATTRACTION, q0, p0, 200 * np.pi)


def densities(name):
    """The time scale as a user writes it."""
    stars: Any = pleiades().distances
    moons = lambda t, q: (restricted(q, t)[0] ** 3, restricted(q, t)[1] ** 3 / MOON)
    return {
        "Pleiades": lambda t, y, args: jnp.sum(stars(y[0]) ** -3) ** -0.5,
        "Kepler, e = 0.9": lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5,
        "Arenstorf orbit": lambda t, y, args: (
            sum(1 / x for x in moons(t, y[0])) ** -0.5
        ),
        "cusped galaxy": lambda t, y, args: jnp.linalg.norm(y[0]) ** 0.5,
    }[name]


def exact(problem, ts):
    """The solution at the times, by methods that are not compared."""
    if problem.name.startswith("Kepler"):
        mean = np.mod(ts + np.pi, 2 * np.pi) - np.pi
        late = lambda x, m: x - 0.9 * np.sin(x) - m
        find: Any = partial(scipy.optimize.brentq, late, -4, 4, xtol=1e-15)
        anomalies = [find(args=(m,)) for m in mean]
        q, p = zip(*(eccentric(0.9, x) for x in anomalies), strict=True)
        return np.array(q), np.array(p)
    flat, unravel = ravel_pytree(problem.y0)
    slope = jax.jit(
        lambda t, y: ravel_pytree(problem.system.vf(t, unravel(y), None))[0]
    )
    solved = scipy.integrate.solve_ivp(
        *(lambda t, y: np.asarray(slope(t, y)), (0.0, problem.t1), flat, "DOP853", ts),
        rtol=3e-14,
        atol=1e-15,
    )
    return jax.vmap(unravel)(jnp.asarray(solved.y.T))
