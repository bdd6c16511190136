"""Symmetric multistep methods: where they are unstable or resonate.

The table is the end of the interval of stability of each method on an oscillator,
and on Kepler orbits the number of steps to an orbit at which the energy drifts, of
those tried, with the energy error at some of them. The roots of orders 8 and 10 were
chosen among random ones, `--search`, by the number of steps at which an orbit of
eccentricity 0.3 drifts, and then by the error; Kepler orbits are in the half of the
problems to tune on.
"""

import numpy as np
from _report import command_line, Table

from diffrax_presym._scheme._multistep_tables import multistep_table, RHO


# Those of Quinlan and Tremaine (1990), and 8A of Quinlan (1999), are published.
METHODS = {
    "order 8": RHO[8],
    "order 8, Quinlan and Tremaine": (1, -2, 2, -1, 0),
    "order 8, Quinlan 8A": (1, -2, 2, -2, 2),
    "order 10": RHO[10],
    "order 10, Quinlan and Tremaine": (1, -1, 1, -1, 1, -2),
    "order 12": RHO[12],
}
# Steps to an orbit, without simple ratios to angles of roots.
STEPS = np.round(1.0137 * np.geomspace(40, 170, 24), 1)
SHOWN = (4, 12, 20)
force = lambda q: -q / np.sum(q**2, axis=-1, keepdims=True) ** 1.5


def stability_limit(table):
    """The first step times frequency at which a root leaves the unit circle."""
    rho = np.convolve(table.kicks, [1, -2, 1])
    sigma = np.concatenate([[0], table.forces, [0]])
    for h in np.arange(0.04, 1.6, 0.01):
        if np.max(np.abs(np.roots(rho + h**2 * sigma))) > 1 + 1e-6:
            return h
    return np.inf


def position(t, e):
    """Positions on Kepler orbits of eccentricities `e` at one time."""
    anomaly = np.full_like(e, t) if np.ndim(t) == 0 else t.copy()
    for _ in range(60):
        step = anomaly - e * np.sin(anomaly) - t
        anomaly = anomaly - step / (1 - e * np.cos(anomaly))
    x, y = np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly)
    return np.stack([x, y], axis=-1)


def energy_errors(table, eccentricity, steps, orbits=60):
    """The largest energy error in each quarter of the time, for each number of steps to
    an orbit, from exact starting values."""
    h, e = (2 * np.pi / steps)[:, None], np.full(len(steps), eccentricity)
    newest, *forces = table.forces[:, None, None]
    kicks = table.kicks[1:, None, None]
    points = [position(j * h[:, 0], e) for j in range(table.order)]
    state = np.zeros((table.order - 2, len(steps), 2))

    def remember(state, kick, g):
        later = np.concatenate([state[1:], np.zeros_like(state[:1])])
        return later + forces * g - kicks * kick

    for last, x, after in zip(points, points[1:], points[2:], strict=False):
        state = remember(state, (after - 2 * x + last) / h**2, force(x))
    q, p = points[-1], (points[-1] - points[-2]) / h
    g, weights = force(q), table.momentum[:, None, None]
    count = int(np.max(steps) * orbits)
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


def drifts(errors):
    grows = errors[3] > 3 * np.maximum(errors[0], 1e-15)
    return (errors[3] > 1e-3) | (grows & (errors[3] > 1e-11))


def resonances(steps):
    shown = [f"{steps[i]:.0f} steps:>9.1e" for i in SHOWN if i < len(steps)]
    columns = "stable to:>9.2f", "drift, e = 0.1:>15", "e = 0.3:>8"
    table = Table("Methods on Kepler orbits", "method:<31", *columns, *shown)
    for name, rho in METHODS.items():
        method = multistep_table(rho)
        both = [energy_errors(method, e, steps) for e in (0.1, 0.3)]
        counts = [f"{np.sum(drifts(errors))} of {len(steps)}" for errors in both]
        errors = [both[1][3][i] for i in SHOWN if i < len(steps)]
        table.row(name, stability_limit(method), *counts, *errors)


def search(order, number=40):
    """Random roots, with the fewest drifts and then the least error first."""
    rng, found = np.random.default_rng(1), []
    pairs = order // 2 - 1
    while len(found) < number:
        ends = rng.uniform(0.18, 0.42), rng.uniform(0.72, 0.95)
        angles = np.linspace(*ends, pairs) + rng.uniform(-0.04, 0.04, pairs)
        angles = np.sort(angles)
        if np.min(np.diff(angles)) < 0.09 or angles[-1] > 0.97:
            continue
        rho = np.array([1.0, -2.0, 1.0])
        for angle in angles:
            rho = np.convolve(rho, [1, -2 * np.cos(np.pi * angle), 1])
        method = multistep_table(tuple(map(float, rho[: order // 2 + 1])))
        errors = [energy_errors(method, e, STEPS) for e in (0.1, 0.3)]
        bad = sum(int(np.sum(drifts(x))) for x in errors)
        size = np.mean([np.mean(np.log10(np.minimum(x[3], 1))) for x in errors])
        found.append((bad, size, angles))
    columns = "roots / pi:<36", "drifts:>6", "log10 error:>11.2f"
    table = Table(f"Roots of order {order}", *columns)
    for bad, size, angles in sorted(found, key=lambda x: x[:2])[:8]:
        text = " ".join(f"{x:.4f}" for x in angles)
        table.row(text, str(bad), size)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--search", type=int, choices=(8, 10, 12))
    options = parser.parse_args()
    if options.search:
        search(options.search, 4 if options.quick else 40)
        return
    resonances(STEPS[::6] if options.quick else STEPS)


if __name__ == "__main__":
    main()
