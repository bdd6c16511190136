"""The problems of the benchmarks: in JAX, and in NumPy for solvers outside of it."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from _solve import reference

import diffrax_presym as dps


@dataclasses.dataclass(frozen=True)
class Problem:
    name: str
    system: Any
    q0: Any
    p0: Any
    t1: float
    # The solution at `t1`, where it has a closed form.
    exact: Callable | None = None
    # About the shortest period over six, in which sweeps of steps and the steps of the
    # reference solution are measured.
    unit: float = 1.0
    # The distances of bodies that attract each other by the inverse square law.
    distances: Callable | None = None

    @property
    def y0(self):
        return jnp.asarray(self.q0, float), jnp.asarray(self.p0, float)

    def reference(self):
        """The solution at `t1`."""
        if self.exact is not None:
            return self.exact()
        q, p = self.solution([0.0, self.t1])
        return np.array([q[0], p[0]])

    def solution(self, ts):
        """The solution at all times after the first."""
        return reference(self.system, self.y0, ts, longest=self.unit / 4)


def mechanics(potential, friction=None, kinetic=None):
    kinetic = dps.QuadraticKinetic() if kinetic is None else kinetic
    return dps.MechanicalSystem(kinetic, potential, friction)


def pair_distances(n):
    """The distances of `n` bodies, whose coordinates are the rows of `q`."""
    i, j = np.triu_indices(n, 1)
    return lambda q: jnp.sqrt(jnp.sum((q[:, i] - q[:, j]) ** 2, axis=0))


def pendulum():
    gamma = 0.1
    return Problem(
        "damped pendulum",
        mechanics(lambda t, q, args: -jnp.sum(jnp.cos(q)), dps.ConstantDamping(gamma)),
        *(np.array([2.0]), np.array([0.0]), 100.0),
    )


def decaying():
    gamma = 3.0
    return Problem(
        "decaying oscillator",
        mechanics(dps.QuadraticPotential(), dps.LogDamping(gamma, 1.0)),
        *(np.array([1.0]), np.array([0.0]), 100.0),
    )


def henon_heiles():
    gamma = 0.01

    def potential(t, q, args):
        x, y = q
        return (x**2 + y**2) / 2 + x**2 * y - y**3 / 3

    return Problem(
        "damped Henon-Heiles",
        mechanics(potential, dps.ConstantDamping(gamma)),
        *(np.array([0.1, -0.3]), np.array([0.3, 0.1]), 100.0),
    )


def kepler():
    gamma, e = 1e-3, 0.6

    distance = lambda q: jnp.sqrt(jnp.sum(q**2))
    return Problem(
        "Kepler with drag",
        mechanics(lambda t, q, args: -1 / distance(q), dps.ConstantDamping(gamma)),
        np.array([1 - e, 0.0]),
        np.array([0.0, math.sqrt((1 + e) / (1 - e))]),
        20 * math.pi,
        distances=distance,
    )


def chain(n=100):
    gamma = 0.05

    def potential(t, q, args):
        stretch = jnp.diff(q)
        return jnp.sum(stretch**2 / 2 + stretch**4 / 4) + jnp.sum(q**2 / 2 + q**4 / 4)

    return Problem(
        f"chain of {n}",
        mechanics(potential, dps.ConstantDamping(gamma)),
        *(np.sin(2 * np.pi * np.arange(n) / n), np.zeros(n), 50.0),
    )


def relativistic():
    gamma, potential = 0.05, dps.QuadraticPotential()
    return Problem(
        "relativistic oscillator",
        mechanics(potential, dps.ConstantDamping(gamma), dps.RelativisticKinetic()),
        *(np.array([2.0]), np.array([0.0]), 100.0),
    )


def random_quadratic(n=1000, m=1250):
    gamma, t1 = 0.7, 20.0
    a = np.random.default_rng(0).standard_normal((m, n)) / math.sqrt(m)
    hessian = a.T @ a

    def exact():
        eigenvalues, modes = np.linalg.eigh(hessian)
        amplitude = modes.T @ np.ones(n)
        omega = np.sqrt(eigenvalues.astype(complex) - gamma**2 / 4)
        decay, phase = math.exp(-gamma * t1 / 2), omega * t1
        q = decay * (np.cos(phase) + gamma / 2 / omega * np.sin(phase)).real
        p = -decay * (eigenvalues / omega * np.sin(phase)).real
        return np.array([modes @ (q * amplitude), modes @ (p * amplitude)])

    potential = dps.QuadraticPotential(jnp.asarray(hessian))
    return Problem(
        f"random quadratic, {n}",
        mechanics(potential, dps.ConstantDamping(gamma)),
        *(np.ones(n), np.zeros(n), t1),
        exact=exact,
    )


PROBLEMS = [
    *(pendulum, decaying, henon_heiles, kepler, chain, relativistic),
    random_quadratic,
]
