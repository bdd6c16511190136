# pyright: reportCallIssue=false
"""A manifold, a drift and a constraint of one's own, as a user writes them.

A damped spherical pendulum whose drift is the geodesic flow of the sphere; a perturbed
Kepler orbit whose drift is the exact orbit; and a pendulum held on its circle by a
multiplier, with RATTLE composed to fourth order. Prints the measured orders, the error
of the constraint and that of the gradient by reversal, beside central differences.
`--quick` is the same.
"""

import argparse
from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import diffrax_presym as dps
from diffrax_presym.extend import (
    AbstractMove,
    AbstractPresymplecticSolver,
    AbstractSplit,
    AbstractSystem,
    Scheme,
)


jax.config.update("jax_enable_x64", True)


def tangential_gravity(q):
    gravity = jnp.array([0.0, 0.0, -1.0])
    return gravity - (gravity @ q) * q


class GeodesicDrift(AbstractSplit):
    """Great circles, with the friction, and kicks by the tangential force."""

    kinds: ClassVar = frozenset({"any"})

    def prepare(self, system, t, h, order):
        return system.friction.prepare(t, h, order)  # type: ignore

    def drift(self, system, t, h, data, y):
        q, p = y
        change, carried = system.friction.flow(data, p)  # type: ignore
        speed = jnp.linalg.norm(p)
        angle, left = carried @ p / speed, 1 + change @ p / speed**2
        c, s = jnp.cos(angle), jnp.sin(angle)
        return c * q + s * p / speed, left * (c * p - s * speed * q)

    def force(self, system, t, y):
        return tangential_gravity(y[0])


class Sphere(AbstractSystem):
    """A particle on the unit sphere with gravity and friction; the drift is exact."""

    gamma: jax.Array

    @property
    def splits(self):
        return (GeodesicDrift(),)

    @property
    def laws(self):
        return (dps.ConstantDamping(self.gamma),)

    def energy(self, t, q, p, args=None):
        return p @ p / 2 + q[2]

    def velocity(self, t, q, p, args=None):
        return p

    def force(self, t, q, p, args=None):
        return tangential_gravity(q) - (p @ p) * q


class KeplerDrift(AbstractSplit):
    """The exact Kepler orbit, and kicks by the perturbation."""

    kinds: ClassVar = frozenset({"any"})

    def drift(self, system, t, h, data, y):
        # By the difference x of the eccentric anomaly, from Kepler's equation.
        (q, p), r = y, jnp.linalg.norm(y[0])
        a = 1 / (2 / r - p @ p)
        n, e, d = a**-1.5, 1 - r / a, q @ p / jnp.sqrt(a)
        x = n * h
        for _ in range(8):
            excess = x - e * jnp.sin(x) + d * (1 - jnp.cos(x)) - n * h
            x = x - excess / (1 - e * jnp.cos(x) + d * jnp.sin(x))
        c, s = jnp.cos(x), jnp.sin(x)
        end = a * (1 - e * c + d * s)
        dq = -a / r * (1 - c) * q + (h + (s - x) / n) * p
        return q + dq, p - jnp.sqrt(a) * s / (end * r) * q - a / end * (1 - c) * p

    def force(self, system, t, y):
        return -jax.grad(system.term.potential)(y[0])


class Orbit(AbstractSystem):
    """A satellite of an oblate body; the drift is the exact Kepler orbit."""

    oblateness: jax.Array

    @property
    def splits(self):
        return (KeplerDrift(),)

    def potential(self, q):
        r = jnp.linalg.norm(q)
        return self.oblateness * (3 * (q[1] / r) ** 2 - 1) / (2 * r**3)

    def energy(self, t, q, p, args=None):
        return p @ p / 2 - 1 / jnp.linalg.norm(q) + self.potential(q)

    def velocity(self, t, q, p, args=None):
        return p

    def force(self, t, q, p, args=None):
        return -jax.grad(self.potential)(q) - q / jnp.linalg.norm(q) ** 3


class RattleMove(AbstractMove):
    """A step on g(q) = 0, with friction at both ends."""

    def prepare(self, system, span):
        return system.prepare_decay(span.t0, span.h / 2)

    def apply(self, system, span, data, stage):
        y, carry = stage
        (t0, t1, h), g = span, lambda q: q @ q - 1
        q, p = system.decay(data, y)
        p, normal = p + h / 2 * system.force(t0, (q, p)), jax.grad(g)(q)
        multiplier = jnp.zeros(())
        for _ in range(6):  # Newton's method
            ahead = q + h * (p - multiplier * normal)
            multiplier += g(ahead) / (h * (jax.grad(g)(ahead) @ normal))
        p = p - multiplier * normal
        q = q + h * p
        normal = jax.grad(g)(q)
        p = p + h / 2 * system.force(t1, (q, p))
        p = p - (p @ normal) / (normal @ normal) * normal
        return (system.decay(data, (q, p)), carry), None

    def undo(self, system, span, data, stage):
        return self.apply(system, span, data, stage)


class Rattle(AbstractPresymplecticSolver):
    """RATTLE on the unit circle. 2nd order and symmetric."""

    @property
    def is_symmetric(self):
        return True

    def order(self, terms):
        return 2

    def scheme(self, system):
        return Scheme(RattleMove())


def pendulum(gamma):
    return dps.MechanicalSystem(
        dps.QuadraticKinetic(), lambda t, q, args: q[1], dps.ConstantDamping(gamma)
    )


def reference(rhs, y0, t1):
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return scipy.integrate.solve_ivp(rhs, (0, t1), np.concatenate(y0), **options).y[
        :, -1
    ]


def sphere_rhs(t, y, gamma=0.2):
    q, p = np.split(y, 2)
    force = np.array([0.0, 0.0, -1.0]) + (q[2] - p @ p) * q
    return np.concatenate([p, force - gamma * p])


def orbit_rhs(t, y, oblateness=0.01):
    (x, z), p = np.split(y, 2)
    r = np.hypot(x, z)
    pull = oblateness * np.array(
        [3 * x - 15 * x * z**2 / r**2, 9 * z - 15 * z**3 / r**2]
    )
    return np.concatenate([p, -np.array([x, z]) / r**3 - pull / (2 * r**5)])


def circle_rhs(t, y, gamma=0.2):
    q, p = np.split(y, 2)
    force = np.array([0.0, -1.0]) + (q[1] - p @ p) * q
    return np.concatenate([p, force - gamma * p])


def vectors(*values):
    return tuple(jnp.array(x) for x in values)


CASES = {
    "sphere, geodesic drift, BlanesMoan6": (
        *(Sphere, 0.2, dps.BlanesMoan6(), sphere_rhs),
        vectors([1.0, 0.0, 0.0], [0.0, 0.6, 0.8]),
    ),
    "orbit, Kepler drift, BlanesMoan4": (
        *(Orbit, 0.01, dps.BlanesMoan4(), orbit_rhs),
        vectors([1.0, 0.0], [0.2, 1.1]),
    ),
    "circle, RATTLE": (
        *(pendulum, 0.2, Rattle(), circle_rhs),
        vectors([0.0, -1.0], [1.2, 0.0]),
    ),
    "circle, RATTLE by Suzuki4": (
        *(pendulum, 0.2, dps.Suzuki4(Rattle()), circle_rhs),
        vectors([0.0, -1.0], [1.2, 0.0]),
    ),
}


def measure(build, value, solver, rhs, y0, t1=8.0):
    """The order, the distance from the unit sphere, and the error of the gradient."""

    @jax.jit
    def end(value, dt0):
        system = build(value)
        return dfx.diffeqsolve(
            *(system, solver, 0.0, t1, dt0, y0),
            adjoint=dps.FixedStepAdjoint(),
            max_steps=None,
        ).ys

    exact = reference(rhs, y0, t1)
    errors, ys = [], None
    for n in (32, 64, 128):
        ys = end(value, t1 / n)
        errors.append(np.max(np.abs(np.concatenate([y[-1] for y in ys]) - exact)))
    order = np.log2(errors[0] / errors[2]) / 2
    off = abs(float(jnp.linalg.norm(ys[0][-1])) - 1)
    loss = lambda x: jnp.sum(end(x, t1 / 64)[0] ** 3)
    step = 1e-5
    difference = (loss(value + step) - loss(value - step)) / (2 * step)
    gradient = jax.grad(loss)(value)
    return errors, order, off, abs(float(gradient / difference) - 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="no difference here")
    parser.parse_args()
    print(f"{'':36} {'errors, 32, 64, 128 steps':>28} order  |q| - 1  gradient")
    for name, case in CASES.items():
        errors, order, off, gradient = measure(*case)
        cells = " ".join(f"{error:8.1e}" for error in errors)
        off = "" if name.startswith("orbit") else f"{off:.0e}"
        print(f"{name:36} {cells:>28} {order:5.2f} {off:>8} {gradient:9.0e}")
        claimed = case[2].order(None)
        assert abs(order - claimed) < 0.4 and gradient < 1e-6


if __name__ == "__main__":
    main()
