"""Forces of the velocity: the time of explicit schemes, and of Gauss collocation.

The five motions of `problems_forces.py`, of many bodies and of few, with constant
steps to errors of 1e-3 and 1e-6: the least time over the schemes of each
kind, and their ratio, above one where the explicit scheme is faster. A second table is
the time of a step with a force linear in the velocity over that with the same friction
as a law.
"""

from functools import partial

import jax
import jax.numpy as jnp
from _report import command_line, means, Table
from _solve import reference_end, relative_error, states
from _timing import error_curves, fastest, interleaved
from problems import mechanics
from problems_forces import FORCES

import diffrax_presym as dps


EXPLICIT = {
    "BlanesMoan4": dps.BlanesMoan4(),
    "BlanesMoan6": dps.BlanesMoan6(),
    "SofroniouSpaletta(8), Strang": dps.SofroniouSpaletta(8, dps.Strang()),
}
GAUSS = {f"PresymplecticGauss({n})": dps.PresymplecticGauss(n) for n in (3, 4, 6)}
TARGETS = 1e-3, 1e-6
SWEEP = [10, 14, 20, 28, 40, 56, 80, 112, 160, 224, 320, 448, 640, 900, 1280, 1800]


def compare(quick):
    table = Table(
        "Gauss over explicit, least time to errors of 1e-3, 1e-6",
        *("force:<21", "size:<5", "1e-3:>6.2f", "1e-6:>6.2f", "ms:>8.2f"),
        *("explicit:<29", "Gauss:<22"),
    )
    for few in (False, True):
        rows = []
        for make in FORCES[:: 3 if quick else 1]:
            problem = make(*([16 if make.__name__ == "charge" else 1] if few else []))
            y0 = tuple(map(jnp.asarray, problem.y0))
            exact = reference_end(problem.system, y0, 0.0, problem.t1)
            runs = {}
            for kind, solvers in (("explicit", EXPLICIT), ("Gauss", GAUSS)):
                for name, solver in solvers.items():
                    times = 0.0, problem.t1
                    run = jax.jit(partial(states, problem.system, solver, times, y0))
                    runs[kind, name] = run, list(map(float, SWEEP))
            error = lambda y, exact=exact: relative_error(y, exact)
            curves = error_curves(runs, error, 2 if quick else 5, (1e-6, 0.5))
            found = [
                [fastest(curves, target, kind) for target in TARGETS]
                for kind in ("explicit", "Gauss")
            ]
            ours, theirs = found
            ratios = [b[0] / a[0] for a, b in zip(ours, theirs, strict=True)]
            rows.append(ratios)
            size = "few" if few else "many"
            milliseconds, names = 1e3 * ours[1][0], (ours[1][1], theirs[1][1])
            table.row(problem.name, size, *ratios, milliseconds, *names)
        table.row("geometric mean", "", *means(rows)[0], "", "", "")


def linear(quick):
    """A force linear in the velocity, and the same as a law of friction."""
    table = Table(
        "Microseconds of a step of BlanesMoan6, and force over law",
        *("friction:<26", "bodies:>6", "law:>8.2f", "force:>8.2f", "ratio:>6.2f"),
    )
    attraction = dps.pairwise_potential(lambda t, r, args: -0.1 / jnp.sqrt(r**2 + 0.1))
    potential = lambda t, q, args: jnp.sum(q**2) / 2 + attraction(t, q, args)
    turn = 0.5 * jnp.array([[0.2, -1.0, 0.0], [1.0, 0.2, 0.0], [0.0, 0.0, 0.2]])
    uneven = lambda q: 1 + q[:, :1] ** 2
    cases = {
        "number": (dps.ViscousDamping(0.3), lambda t, q, v, args: -0.3 * v),
        "matrix": (
            dps.ViscousDamping(turn[None]),
            lambda t, q, v, args: -v @ turn.T,
        ),
        "number by place": (
            dps.ViscousDamping(lambda t, q, args: 0.3 * uneven(q)),
            lambda t, q, v, args: -0.3 * uneven(q) * v,
        ),
        "matrix by place": (
            dps.ViscousDamping(lambda t, q, args: uneven(q)[..., None] * turn),
            lambda t, q, v, args: -uneven(q) * (v @ turn.T),
        ),
    }
    for (name, (law, force)), number in (
        (case, number) for case in cases.items() for number in (1, 16, 64)
    ):
        key, steps = jax.random.key(0), 200 if quick else 1000
        y0 = jax.random.normal(key, (number, 3)), jnp.zeros((number, 3))
        systems = {
            "law": mechanics(potential, law),
            "force": dps.MechanicalSystem(
                dps.QuadraticKinetic(), potential, force=force
            ),
        }
        calls = {}
        for key, system in systems.items():
            times = 0.0, 0.02 * steps
            run = jax.jit(partial(states, system, dps.BlanesMoan6(), times, y0))
            calls[key] = partial(run, float(steps))
        found = interleaved(calls, 3 if quick else 9)
        cells = [1e6 * found[key].median / steps for key in ("law", "force")]
        table.row(name, str(number), *cells, found["force"].over(found["law"]))


def main():
    options = command_line(__doc__).parse_args()
    compare(options.quick)
    linear(options.quick)


if __name__ == "__main__":
    main()
