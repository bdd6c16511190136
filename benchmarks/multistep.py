"""Symmetric multistep methods: their coefficients, and where they are unstable.

The table is the end of the interval of stability on an oscillator and, on Kepler
orbits, the number of steps to an orbit at which the energy drifts, of those tried, with
the energy error at some of them. `--search` chose the roots of `rho` among random ones,
by the number of steps at which it drifts, and then by the error, on other orbits and at
other numbers of steps; Kepler orbits are in the half of the problems to tune on.
"""

import math
from fractions import Fraction

import numpy as np
from _report import command_line, Table

from diffrax_presym._scheme._multistep import MultistepTable


# Twice the cosines of the roots; and of published methods, by Quinlan and Tremaine
# (1990) and by Quinlan (1999), the coefficients of rho up to the middle one.
COSINES = {
    8: ("0.8516", "-0.2157", "-1.6290"),
    10: ("1.4191", "0.6472", "-0.5899", "-1.6846"),
}
PUBLISHED = {
    "order 8, Quinlan and Tremaine": (1, -2, 2, -1, 0),
    "order 8, Quinlan 8A": (1, -2, 2, -2, 2),
    "order 10, Quinlan and Tremaine": (1, -1, 1, -1, 1, -2),
    "order 12, Quinlan and Tremaine": (1, -2, 2, -1, 0, 0, 0),
}
# Steps to an orbit, and eccentricities: of the search, and of the table.
SEARCH = np.round(1.0137 * np.geomspace(40, 170, 24), 1), (0.1, 0.3)
TABLE = np.round(np.geomspace(41, 173, 60), 1), (0.2, 0.4)
fractions = np.vectorize(Fraction, otypes=[object])
force = lambda q: -q / np.sum(q**2, axis=-1, keepdims=True) ** 1.5


def from_cosines(twice):
    """rho with a double root at one, and others given by twice their cosines."""
    rho = fractions([1, -2, 1])
    for c in twice:
        rho = np.convolve(rho, fractions([1, -Fraction(c), 1]))
    return rho


def method(rho) -> MultistepTable:
    """The method of all coefficients of rho, from rational arithmetic."""
    rho = fractions(rho)
    kicks = np.cumsum(np.cumsum(rho))[:-2]  # division by (z - 1)^2
    count, half = len(rho) - 2, len(rho) // 2
    # Even powers about the middle, up to the order: those of rho, from R.
    r = np.arange(1, half + 1)
    power = lambda x, r: fractions(x)[None, :] ** r[:, None]
    middle = np.arange(1 - half, half)
    second = sum(c * power(middle + i, 2 * r) for i, c in ((1, 1), (0, -2), (-1, 1)))
    moments = power(np.arange(half), 2 * r - 2)
    moments[:, 1:] *= 2
    one_sided = solve(moments, second @ kicks / fractions(2 * r * (2 * r - 1)))
    forces = np.concatenate([one_sided[:0:-1], one_sided])
    # For the force exp(w t / h), in powers of w: the kick is 2 (cosh(w) - 1) / w^2, an
    # entry of the state of the filter is what past forces and kicks add to a later
    # kick, and the momentum less its mean over the step is 1 / w - (1 - exp(-w)) / w^2.
    powers = range(count)
    factorial = fractions([math.factorial(j) for j in range(count + 2)])
    signs = fractions([(-1) ** j for j in powers])
    kick, newest = (1 + signs) / factorial[2:], fractions([j == 0 for j in powers])
    past = lambda m: fractions([(-m) ** j for j in powers]) / factorial[:count]
    series = lambda f, k, m: np.convolve(f * newest - k * kick, past(m))[:count]
    lags = lambda i: zip(forces[i + 1 :], kicks[i + 1 :], range(1, count), strict=False)
    state = [sum(series(*x) for x in lags(i)) for i in range(count - 1)]
    momentum = solve(np.stack([*state, newest], axis=1), signs / factorial[2:])
    return MultistepTable(*(tuple(map(float, x)) for x in (forces, kicks, momentum)))


def solve(matrix, right):
    """Solve a linear system by elimination, in rational arithmetic."""
    rows = np.column_stack([matrix, right])
    for i in range(len(rows)):
        pivot = i + int(np.argmax(rows[i:, i] != 0))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] = rows[i] / rows[i, i]
        others = np.arange(len(rows)) != i
        rows[others] = rows[others] - np.outer(rows[others, i], rows[i])
    return rows[:, -1]


def stability_limit(method):
    """The first step times frequency at which a root leaves the unit circle."""
    rho = np.convolve(method.kicks, [1, -2, 1])
    sigma = np.array([0, *method.forces, 0])
    outside = lambda h: np.max(np.abs(np.roots(rho + h**2 * sigma))) > 1 + 1e-6
    return next(h for h in np.arange(0.04, 4, 0.01) if outside(h))


def position(t, e):
    """Positions on Kepler orbits of eccentricity `e`."""
    anomaly = t
    for _ in range(60):
        step = anomaly - e * np.sin(anomaly) - t
        anomaly = anomaly - step / (1 - e * np.cos(anomaly))
    return np.stack([np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly)], -1)


def energy_errors(method, e, steps, orbits=60):
    """The largest energy error in each quarter of the time, for each number of steps to
    an orbit, from exact starting values."""
    h = (2 * np.pi / steps)[:, None]
    columns = (np.reshape(x, (-1, 1, 1)) for x in method)
    (newest, *forces), (_, *kicks), weights = map(np.array, columns)
    points = [position(j * h[:, 0], e) for j in range(len(kicks) + 2)]
    state = np.zeros((len(kicks), len(steps), 2))

    def remember(state, kick, g):
        later = np.concatenate([state[1:], np.zeros_like(state[:1])])
        return later + forces * g - kicks * kick

    for last, x, after in zip(points, points[1:], points[2:], strict=False):
        state = remember(state, (after - 2 * x + last) / h**2, force(x))
    q, p = points[-1], (points[-1] - points[-2]) / h
    g, count = force(q), int(np.max(steps) * orbits)
    errors = np.zeros((4, len(steps)))
    with np.errstate(all="ignore"):
        for i in range(count):
            kick = state[0] + newest * g
            p = p + h * kick
            q, state = q + h * p, remember(state, kick, g)
            g = force(q)
            v = p + h * (np.sum(weights[:-1] * state, axis=0) + weights[-1] * g)
            energy = np.sum(v**2, axis=-1) / 2 - np.sum(q**2, axis=-1) ** -0.5
            error = np.nan_to_num(np.abs(energy + 0.5), nan=1e3, posinf=1e3)
            quarter = min(4 * i // count, 3)
            errors[quarter] = np.maximum(errors[quarter], error)
    return errors


def tried(rho, steps, eccentricities):
    """Errors on two orbits, and for how many numbers of steps they drift."""
    errors = [energy_errors(method(rho), e, steps) for e in eccentricities]
    grows = lambda x: (x[3] > 3 * np.maximum(x[0], 1e-15)) & (x[3] > 1e-11)
    return errors, [int(np.sum((x[3] > 1e-3) | grows(x))) for x in errors]


def resonances(steps, eccentricities):
    shown = [f"{steps[i]:.0f} steps:>9.1e" for i in range(12, len(steps), 20)]
    columns = "stable to:>9.2f", *(f"drift, e = {e}:>14" for e in eccentricities)
    table = Table("Methods on Kepler orbits", "method:<30", *columns, *shown)
    methods = {f"order {n}": from_cosines(COSINES[n]) for n in COSINES}
    methods |= {name: (*rho, *rho[-2::-1]) for name, rho in PUBLISHED.items()}
    for name, rho in sorted(methods.items(), key=lambda x: len(x[1])):
        errors, drifts = tried(rho, steps, eccentricities)
        counts = [f"{n} of {len(steps)}" for n in drifts]
        last = [errors[0][3][i] for i in range(12, len(steps), 20)]
        table.row(name, stability_limit(method(rho)), *counts, *last)


def search(order, number):
    """Random roots, with the fewest drifts and then the least error first."""
    rng, found, pairs = np.random.default_rng(1), [], order // 2 - 1
    while len(found) < number:
        ends = rng.uniform(0.18, 0.42), rng.uniform(0.72, 0.95)
        angles = np.linspace(*ends, pairs) + rng.uniform(-0.04, 0.04, pairs)
        angles = np.sort(angles)
        if np.min(np.diff(angles)) >= 0.09 and angles[-1] <= 0.97:
            errors, drifts = tried(from_cosines(2 * np.cos(np.pi * angles)), *SEARCH)
            size = np.mean(np.log10(np.minimum([x[3] for x in errors], 1)))
            found.append((sum(drifts), size, angles))
    table = Table("", "roots / pi:<36", "drifts:>6", "log10 error:>11.2f")
    for bad, size, angles in sorted(found, key=lambda x: x[:2])[:8]:
        table.row(" ".join(f"{x:.4f}" for x in angles), str(bad), size)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--search", type=int, choices=COSINES)
    options = parser.parse_args()
    if options.search:
        return search(options.search, 4 if options.quick else 40)
    return resonances(TABLE[0][:: 6 if options.quick else 1], TABLE[1])


if __name__ == "__main__":
    main()
