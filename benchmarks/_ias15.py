"""IAS15 of REBOUND, if that is installed."""

import importlib.util
from typing import Any

import numpy as np
from problems_variable import MOON


def has_rebound():
    return importlib.util.find_spec("rebound") is not None


def simulation(masses, q, v, epsilon):
    """Bodies in the plane, for IAS15."""
    import rebound  # pyright: ignore[reportMissingImports]

    sim: Any = rebound.Simulation()
    for m, (x, y), (vx, vy) in zip(masses, q, v, strict=True):
        sim.add(m=m, x=float(x), y=float(y), vx=float(vx), vy=float(vy))
    sim.integrator = "ias15"
    # Of REBOUND 5, and of those before.
    settings: Any = getattr(sim, "ri_ias15", sim.integrator)
    settings.epsilon = epsilon
    return sim


def ias15(problem, ts):
    """A solve by REBOUND, by the tolerance; `None` where it does not apply."""
    if not has_rebound():
        return None
    q0, p0 = map(np.asarray, problem.y0)
    if problem.name == "Pleiades":
        masses = np.arange(1.0, 8)
        q0, v0, first = q0.T, (p0 / masses).T, 0
    elif problem.name == "Arenstorf orbit":
        masses, first = np.array([1 - MOON, MOON, 0.0]), 2
        q0 = np.stack([np.array([-MOON, 0]), np.array([1 - MOON, 0]), q0])
        v0 = np.stack([np.array([0, -MOON]), np.array([0, 1 - MOON]), p0])
    elif problem.name.startswith("Kepler"):
        masses, first = np.array([1.0, 0.0]), 1
        q0, v0 = np.stack([0 * q0, q0]), np.stack([0 * p0, p0])
    else:
        return None

    def run(epsilon):
        sim = simulation(masses, q0, v0, epsilon)
        out = np.empty((len(ts), 2, *np.shape(problem.q0)))
        for row, t in zip(out, ts, strict=True):
            sim.integrate(t)
            for i, body in enumerate(sim.particles[first:]):
                at = (..., i) if problem.name == "Pleiades" else ...
                row[0][at] = body.x, body.y
                row[1][at] = body.vx, body.vy
            if problem.name == "Pleiades":
                row[1] *= masses
        return (out[:, 0], out[:, 1]), sim.steps_done, False

    return run
