"""Symmetric multistep methods: where they are unstable or resonate, and long runs.

The first table is the end of the interval of stability of each method on an oscillator,
and on Kepler orbits the number of steps to an orbit at which the energy drifts, of
those tried, with the energy error at some of them. The roots of orders 8 and 10 were
chosen among random ones, `--search`, by the number of steps at which an orbit of
eccentricity 0.3 drifts, and then by the error; Kepler orbits are in the half of the
problems to tune on. The second table, `--long`, is the largest energy error in the
first and in the last tenth of 1e5 periods.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table

import diffrax_presym as dps
from diffrax_presym._solver._multistep_tables import (
    multistep_table,
    QUINLAN_TREMAINE_8,
    QUINLAN_TREMAINE_10,
    RHO,
)


jax.config.update("jax_enable_x64", True)

METHODS = {
    "order 8": RHO[8],
    "order 8, Quinlan and Tremaine": QUINLAN_TREMAINE_8,
    "order 10": RHO[10],
    "order 10, Quinlan and Tremaine": QUINLAN_TREMAINE_10,
    "order 12": RHO[12],
}
# Steps to an orbit, without simple ratios to angles of roots.
STEPS = np.round(1.0137 * np.geomspace(40, 170, 24), 1)
SHOWN = (4, 12, 20)


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


def force(q):
    return -q / np.sum(q**2, axis=-1, keepdims=True) ** 1.5


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


def planet(e=0.2):
    potential = lambda t, q, args: -1 / jnp.sqrt(jnp.sum(q**2))
    y0 = jnp.array([1 - e, 0.0]), jnp.array([0.0, np.sqrt((1 + e) / (1 - e))])
    return potential, y0, 2 * np.pi


def pendulum():
    potential = lambda t, q, args: -jnp.sum(jnp.cos(q))
    # Its period with this amplitude, from the arithmetic-geometric mean.
    a, b = 1.0, np.cos(0.5)
    for _ in range(8):
        a, b = (a + b) / 2, np.sqrt(a * b)
    return potential, (jnp.array([1.0]), jnp.array([0.0])), 2 * np.pi / a


def largest_in_tenths(make, order, steps, periods):
    """The largest energy error at the steps, in each tenth of the time."""
    potential, y0, period = make()
    hamiltonian = dps.MechanicalSystem(dps.QuadraticKinetic(), potential)
    solver, term = dps.SymmetricMultistep(order), hamiltonian
    first, h, zero = hamiltonian.energy(0.0, *y0), period / steps, jnp.asarray(0.0)

    def step(i, state):
        y, carry, n, worst = state
        t0, t1 = n * h, (n + 1) * h
        y, _, _, carry, _ = solver.step(term, t0, t1, y, None, carry, made_jump=False)
        error = jnp.abs(hamiltonian.energy(0.0, *y) - first)
        return y, carry, n + 1, jnp.maximum(worst, error)

    def tenth(state, _):
        count = int(periods * steps / 10)
        *state, worst = jax.lax.fori_loop(0, count, step, (*state, zero))
        return tuple(state), worst

    carry = solver.init(term, zero, h, y0, None)
    return jax.jit(lambda x: jax.lax.scan(tenth, x, None, 10))((y0, carry, zero))[1]


def long_runs(periods, steps=113):
    columns = "system:<10", "first tenth:>11.1e", "last tenth:>10.1e"
    caption = f"Largest energy error in {periods:.0e} periods of {steps} steps"
    table = Table(caption, "order:<6", *columns)
    for make in (planet, pendulum):
        for order in RHO:
            errors = largest_in_tenths(make, order, steps, periods)
            table.row(str(order), make.__name__, errors[0], errors[-1])


def main():
    parser = command_line(__doc__)
    parser.add_argument("--search", type=int, choices=(8, 10, 12))
    parser.add_argument("--long", action="store_true", help="1e5 periods")
    options = parser.parse_args()
    if options.search:
        search(options.search, 4 if options.quick else 40)
        return
    resonances(STEPS[::6] if options.quick else STEPS)
    long_runs(1e5 if options.long else 1e2 if options.quick else 1e3)


if __name__ == "__main__":
    main()
