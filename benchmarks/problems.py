"""The problems of the benchmarks, each in JAX for solving and in NumPy for checking."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps


@dataclasses.dataclass(frozen=True)
class Problem:
    name: str
    hamiltonian: dps.AbstractHamiltonian
    # The right-hand side `rhs(t, q, p)` in NumPy, in the precision of its arguments,
    # and the increment of the log scale from `t` to `t + h`.
    rhs: Callable
    increment: Callable
    q0: Any
    p0: Any
    t1: float
    # Whether the force is linear in the positions.
    linear: bool = False
    # The solution at `t1`, where it is known.
    exact: Callable | None = None

    @property
    def y0(self):
        return jnp.asarray(self.q0), jnp.asarray(self.p0)


def conformal(potential, damping, kinetic=None):
    kinetic = dps.QuadraticKinetic() if kinetic is None else kinetic
    return dps.ConformalHamiltonian(kinetic, potential, damping)


def pendulum():
    gamma = 0.1
    return Problem(
        "damped pendulum",
        conformal(lambda t, q, args: -jnp.sum(jnp.cos(q)), dps.ConstantDamping(gamma)),
        lambda t, q, p: (p, -np.sin(q) - gamma * p),
        lambda t, h: gamma * h,
        np.array([2.0]),
        np.array([0.0]),
        100.0,
    )


def decaying():
    gamma = 3.0
    return Problem(
        "decaying oscillator",
        conformal(dps.QuadraticPotential(), dps.LogDamping(gamma, 1.0)),
        lambda t, q, p: (p, -q - gamma / (t + 1) * p),
        lambda t, h: gamma * math.log1p(h / (t + 1)),
        np.array([1.0]),
        np.array([0.0]),
        100.0,
        linear=True,
    )


def henon_heiles():
    gamma = 0.01

    def potential(t, q, args):
        x, y = q
        return (x**2 + y**2) / 2 + x**2 * y - y**3 / 3

    def rhs(t, q, p):
        x, y = q
        force = np.array([-x - 2 * x * y, -y - x**2 + y**2])
        return p, force - gamma * p

    return Problem(
        "damped Henon-Heiles",
        conformal(potential, dps.ConstantDamping(gamma)),
        rhs,
        lambda t, h: gamma * h,
        np.array([0.1, -0.3]),
        np.array([0.3, 0.1]),
        100.0,
    )


def kepler():
    gamma, e = 1e-3, 0.6

    def rhs(t, q, p):
        r2 = np.sum(q**2)
        return p, -q / (r2 * np.sqrt(r2)) - gamma * p

    return Problem(
        "Kepler with drag",
        conformal(
            lambda t, q, args: -1 / jnp.sqrt(jnp.sum(q**2)), dps.ConstantDamping(gamma)
        ),
        rhs,
        lambda t, h: gamma * h,
        np.array([1 - e, 0.0]),
        np.array([0.0, math.sqrt((1 + e) / (1 - e))]),
        20 * math.pi,
    )


def chain(n=100):
    gamma = 0.05

    def potential(t, q, args):
        stretch = jnp.diff(q)
        return jnp.sum(stretch**2 / 2 + stretch**4 / 4) + jnp.sum(q**2 / 2 + q**4 / 4)

    def rhs(t, q, p):
        stretch = np.diff(q)
        pull = stretch + stretch**3
        force = -q - q**3
        force[:-1] += pull
        force[1:] -= pull
        return p, force - gamma * p

    return Problem(
        f"chain of {n}",
        conformal(potential, dps.ConstantDamping(gamma)),
        rhs,
        lambda t, h: gamma * h,
        np.sin(2 * np.pi * np.arange(n) / n),
        np.zeros(n),
        50.0,
    )


def relativistic():
    gamma = 0.05
    return Problem(
        "relativistic oscillator",
        conformal(
            dps.QuadraticPotential(),
            dps.ConstantDamping(gamma),
            dps.RelativisticKinetic(),
        ),
        lambda t, q, p: (p / np.sqrt(np.sum(p**2) + 1), -q - gamma * p),
        lambda t, h: gamma * h,
        np.array([2.0]),
        np.array([0.0]),
        100.0,
    )


def random_quadratic(n=1000, m=1250):
    gamma = 0.7
    a = np.random.default_rng(0).standard_normal((m, n)) / math.sqrt(m)
    hessian = a.T @ a
    t1 = 20.0

    def exact():
        eigenvalues, modes = np.linalg.eigh(hessian)
        amplitude = modes.T @ np.ones(n)
        omega = np.sqrt(eigenvalues.astype(complex) - gamma**2 / 4)
        decay, phase = math.exp(-gamma * t1 / 2), omega * t1
        q = decay * (np.cos(phase) + gamma / 2 / omega * np.sin(phase)).real
        p = -decay * (eigenvalues / omega * np.sin(phase)).real
        return np.array([modes @ (q * amplitude), modes @ (p * amplitude)])

    def rhs(t, q, p):
        return p, -(hessian.astype(q.dtype) @ q) - gamma * p

    return Problem(
        f"random quadratic, {n}",
        conformal(
            dps.QuadraticPotential(jnp.asarray(hessian)), dps.ConstantDamping(gamma)
        ),
        rhs,
        lambda t, h: gamma * h,
        np.ones(n),
        np.zeros(n),
        t1,
        linear=True,
        exact=exact,
    )


PROBLEMS = [
    pendulum,
    decaying,
    henon_heiles,
    kepler,
    chain,
    relativistic,
    random_quadratic,
]


def reference(problem):
    """The solution at `t1` to better than 1e-14."""
    if problem.exact is not None:
        return problem.exact()
    steps = 4 * round(problem.t1)
    y, change = _extrapolated(problem, steps), np.inf
    while not change < 1e-14:
        if steps > 100 * problem.t1:
            raise RuntimeError(
                f"No reference for {problem.name}: still off by {change}"
            )
        steps = 2 * steps
        before, y = y, _extrapolated(problem, steps)
        change = np.max(np.abs(y - before))
    return y.astype(float)


def _extrapolated(problem, steps):
    """Gragg, Bulirsch and Stoer's extrapolation of order 16, in extended precision.

    It has nothing in common with any solver that is measured here.
    """
    real = np.longdouble
    t1 = real(problem.t1)
    q, p = (np.asarray(x, real) for x in (problem.q0, problem.p0))
    rhs = lambda t, y: np.array(problem.rhs(t, *y))
    h = t1 / steps
    y = np.array([q, p])
    counts = [2 * (k + 1) for k in range(8)]
    for i in range(steps):
        # In terms of the change from `y`, to round it and not `y` itself.
        table = []
        for n in counts:
            s = h / n
            before, now = 0, s * rhs(i * h, y)
            for k in range(1, n):
                before, now = now, before + 2 * s * rhs(i * h + k * s, y + now)
            last = rhs((i + 1) * h, y + now)
            table.append((before + now + s * last) / 2)
        for j in range(1, len(counts)):
            for k in range(len(counts) - 1, j - 1, -1):
                ratio = real(counts[k]) / counts[k - j]
                table[k] = table[k] + (table[k] - table[k - 1]) / (ratio**2 - 1)
        y = y + table[-1]
    return y
