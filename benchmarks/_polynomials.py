"""Splittings for oscillators as polynomials, and least squares with conditions."""

import itertools
import math

import jax
import jax.numpy as jnp
import mpmath  # pyright: ignore[reportMissingImports]
import numpy as np


STAGES = 14


class Problem:
    """Minimise the squares of `objective` where `conditions` are zero."""

    def __init__(self, conditions, objective):
        self.conditions, self.objective = jax.jit(conditions), jax.jit(objective)
        self.d_conditions = jax.jit(jax.jacfwd(conditions))
        self.d_objective = jax.jit(jax.jacfwd(objective))

    def restore(self, x, steps):
        """A point close by where the conditions hold, by Newton's method, or `None`."""
        for _ in range(steps):
            off = np.asarray(self.conditions(x))
            if np.max(np.abs(off)) < 1e-13:
                return x
            matrix = np.asarray(self.d_conditions(x))
            dx = np.linalg.lstsq(matrix, -off, rcond=1e-11)[0]
            x = x + dx * min(1, 0.1 / np.linalg.norm(dx))
        return x if np.max(np.abs(self.conditions(x))) < 1e-10 else None

    def minimise(self, x, steps):
        """Levenberg and Marquardt's method along the conditions."""
        x, damping = self.restore(x, 100), 1e-3
        if x is None:
            return None, math.inf
        residual = np.asarray(self.objective(x))
        for _ in range(steps):
            tangent = np.asarray(self.d_conditions(x))
            _, sizes, basis = np.linalg.svd(tangent)
            free = basis[np.sum(sizes > 1e-10 * sizes[0]) :].T
            u, s, v = np.linalg.svd(
                np.asarray(self.d_objective(x)) @ free, full_matrices=False
            )
            for _ in range(12):
                shrunk = s / (s**2 + damping * s[0] ** 2) * (u.T @ residual)
                dx = -free @ (v.T @ shrunk)
                dx *= min(1, 0.05 / max(np.linalg.norm(dx), 1e-30))
                there = self.restore(x + dx, 10)
                new = math.inf if there is None else np.asarray(self.objective(there))
                if np.sum(np.square(new)) < np.sum(residual**2):
                    break
                damping *= 6
            else:
                break
            settled = np.sum(np.square(new)) > np.sum(residual**2) * (1 - 1e-7)
            x, residual, damping = there, new, max(damping / 8, 1e-17)
            if settled:
                break
        return x, np.linalg.norm(residual)


def frequencies(longest):
    """Denser towards the highest; without the lowest, whose errors are rounding."""
    return longest * np.sin(np.linspace(0.12, 1, 60) * np.pi / 2)


def _taylor(one):
    """The series of cos(z) and sin(z) / z in z^2, and what brings the coefficients of
    P^2 + s A B to the size of one; in the arithmetic of `one`."""
    degrees = range(STAGES + 1)
    cos = [one / math.factorial(2 * j) * (-1) ** j for j in degrees]
    sin = [one / math.factorial(2 * j + 1) * (-1) ** j for j in degrees]
    return cos, sin, [one * math.factorial(2 * j) / 4**j for j in range(2 * STAGES + 1)]


class LinearProblem(Problem):
    """In terms of the polynomials P, A and B: what they are times those of cos and sin.

    The coefficients that order 8 fixes are one, and omitted.
    """

    fixed = 4

    def __init__(self, longest=5.4):
        n, k = STAGES, self.fixed
        cos, sin, scale = map(np.array, _taylor(1.0))
        ones = jnp.ones(k)

        def polynomials(x):
            p, a, b = jnp.split(x, [n - k, 2 * (n - k)])
            p = jnp.concatenate([jnp.ones(k + 1), p]) * cos
            a = jnp.concatenate([ones, a]) * sin[:-1]
            return p, a, jnp.concatenate([ones, b]) * sin

        def conditions(x):
            p, a, b = polynomials(x)
            ab = jnp.concatenate([jnp.zeros(1), jnp.convolve(a, b)])
            return ((jnp.convolve(p, p) + ab) * scale)[k + 1 :]

        z = frequencies(longest)
        powers = np.vander(z**2, n + 1, increasing=True)
        weight = (longest / z) ** (2 * k + 1)

        def objective(x):
            p, a, b = polynomials(x)
            errors = (
                powers @ p - np.cos(z),
                z * (powers[:, :-1] @ a) - np.sin(z),
                z * (powers @ b) - np.sin(z),
            )
            return jnp.concatenate([weight * error for error in errors])

        super().__init__(conditions, objective)

    def sharpen(self, x):
        """The polynomials, to the digits that Euclid's algorithm needs, or `None`."""
        n, k, number = STAGES, self.fixed, mpmath.mpf
        cos, sin, scale = _taylor(number(1))
        ends = n - k, 2 * (n - k)
        x = [number(float(value)) for value in x]
        for _ in range(8):
            known = [number(1)] * k
            p = _scaled(cos, [1, *known, *x[: ends[0]]])
            a = _scaled(sin, [*known, *x[ends[0] : ends[1]]])
            b = _scaled(sin, [*known, *x[ends[1] :]])
            off = [u + v for u, v in zip(_times(p, p), [0, *_times(a, b)], strict=True)]
            off = _scaled(scale, off)
            if max(map(abs, off[1:])) < 1e-40:
                return p, a, b
            # How the product changes with each coefficient that is free.
            columns = [
                [0] * j + [2 * cos[j] * c for c in p] for j in range(k + 1, n + 1)
            ]
            for j in range(k, n):
                columns.append([0] * (j + 1) + [sin[j] * c for c in b])
            for j in range(k, n + 1):
                columns.append([0] * (j + 1) + [sin[j] * c for c in a])
            rows = range(k + 1, 2 * n + 1)
            entry = lambda column, i: column[i] if i < len(column) else number(0)
            matrix = mpmath.matrix(
                [[entry(column, i) * scale[i] for column in columns] for i in rows]
            )
            wanted = mpmath.matrix([-off[i] for i in rows])
            step = matrix.T * mpmath.lu_solve(matrix * matrix.T, wanted)
            x = [u + v for u, v in zip(x, step, strict=True)]
        return None

    def start(self, random):
        """Highest coefficients that tend to zero, the lower the faster to one."""
        n, width = STAGES - self.fixed, random.uniform(1.5, 4)
        tail = lambda n, shift: np.tanh((np.arange(n)[::-1] + shift) / width) ** 2
        x = np.concatenate([tail(n, 1), tail(n, 1.3), tail(n + 1, 0.7)])
        return x * (1 + 0.1 * random.random() * random.standard_normal(x.size))


def _scaled(factors, x):
    return [factor * value for factor, value in zip(factors, x, strict=False)]


def _times(x, y):
    """The product of two polynomials."""
    product = [mpmath.mpf(0)] * (len(x) + len(y) - 1)
    for (i, u), (j, v) in itertools.product(enumerate(x), enumerate(y)):
        product[i + j] += u * v
    return product


def euclid(p, a, b):
    """The kicks and drifts whose step has these polynomials."""
    p2, moves = list(p), []
    minus = lambda x, c, y: [u - c * v for u, v in zip(x, y, strict=True)][:-1]
    for _ in range(STAGES):
        kick = b[-1] / p[-1]
        b, p2 = minus(b, kick, p), minus(p2, -kick, [0, *a])
        drift = -p[-1] / b[-1]
        p, a = minus(p, -drift, [0, *b]), minus(a, drift, p2)
        moves += [kick, drift]
    return np.array([*moves, b[-1] / p[-1]], float)
