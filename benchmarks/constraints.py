"""Chains of links in the plane, in Cartesian coordinates with constraints.

`links`: the time of a step of `Strang`, which is RATTLE, against the number of links,
with the matrix of all multipliers and with its three diagonals, `lineax.Tridiagonal()`,
and of a gradient by reversal.

`angles`: the time to an error of the positions and velocities of a chain with friction,
beside the same chain in angles, with `PresymplecticGauss`, and Diffrax's `Dopri8` and
`Tsit5`, adaptive and with constant steps, and beside these two in Cartesian coordinates
with the multipliers eliminated. The reference is SciPy's DOP853, in angles. A dash is
an error that no run reached. `--links 10 40` measures other chains.

`mici`: without friction beside the constrained leapfrog of mici, which is the same
scheme, on a chain and on a torus. Its steps are a loop in Python that checks each by
its inverse, as ours do by `check_inverse=True`. It needs `pip install mici`.
"""

import importlib
import importlib.metadata
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from _report import command_line, Table
from _solve import integrated, relative_error, states
from _timing import diffrax_runs, error_curves, interleaved, print_least

import diffrax_presym as dps


GRAVITY = 9.81
TARGETS = 1e-3, 1e-6, 1e-9
STRANG = dps.Strang()


def lengths(t, q, args):
    """The squared lengths of the links, less one, from the point of support."""
    each = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0)
    return jnp.sum(each**2, axis=1) - 1


def weight(t, q, args):
    return GRAVITY * jnp.sum(q[:, 1])


def chain(linear_solver=None, friction=0.1, **options):
    law = dps.ConstantDamping(friction) if friction else None
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), weight, law)
    return dps.ConstrainedSystem(free, lengths, linear_solver=linear_solver, **options)


def positions(angles):
    each = jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=1)
    return jnp.cumsum(each, axis=0)


def at_rest(n):
    q = positions(jnp.linspace(1.0, 1.5, n))
    return q, jnp.zeros_like(q)


def in_angles(n):
    below = n - np.maximum.outer(np.arange(n), np.arange(n))

    def mass(t, q, args):
        return below * jnp.cos(q[:, None] - q[None, :])

    potential = lambda t, q, args: -GRAVITY * jnp.sum(np.diag(below) * jnp.cos(q))
    return dps.LagrangianSystem(mass, potential, dps.ConstantDamping(0.1))


def links(options):
    table = Table(
        "Chains of links: microseconds of a step of Strang",
        *("links:>6", "matrix:>9.0f", "diagonals:>10.0f", "gradient:>9.0f"),
    )
    steps, numbers = 200, (25, 50, 100, 200, 400, 800)
    for n in numbers[:1] if options.quick else numbers:
        run = lambda y0, solver: states(
            chain(solver), STRANG, (0.0, 1e-3 * steps), y0, float(steps)
        )
        loss = lambda y0, run=run: jnp.sum(run(y0, lx.Tridiagonal())[0])
        programs = {
            "matrix": jax.jit(lambda y0, run=run: run(y0, None)),
            "diagonals": jax.jit(lambda y0, run=run: run(y0, lx.Tridiagonal())),
            "gradient": jax.jit(jax.grad(loss)),
        }
        if n > 200:
            del programs["matrix"]
        calls = {name: partial(fn, at_rest(n)) for name, fn in programs.items()}
        found = interleaved(calls, 3 if options.quick else 9)
        cells = [
            1e6 * found[name].median / steps if name in found else None
            for name in ("matrix", "diagonals", "gradient")
        ]
        table.row(str(n), *cells)
        jax.clear_caches()


# Time to an error, in both coordinates.

CARTESIAN = {
    "Strang": STRANG,
    "Suzuki4(Strang)": dps.Suzuki4(STRANG),
    "BlanesMoan4": dps.BlanesMoan4(),
    "BlanesMoan6": dps.BlanesMoan6(),
    "SofroniouSpaletta(6, Strang)": dps.SofroniouSpaletta(6, STRANG),
    "SofroniouSpaletta(8, Strang)": dps.SofroniouSpaletta(8, STRANG),
}
GAUSS = {f"PresymplecticGauss({s})": dps.PresymplecticGauss(s) for s in (3, 4, 6)}
# The iteration ended at a hundredth of the error that is wanted.
GAUSS |= {
    f"PresymplecticGauss({s}, {tol:.0e})": dps.PresymplecticGauss(s, tolerance=tol)
    for s, tol in ((2, 1e-5), (4, 1e-8))
}
OURS, THEIRS, OTHERS = "constraints", "Diffrax, angles", "Diffrax, constraints"


def angles(options):
    for n in options.links or (10,):
        compare(n, options.quick)
        jax.clear_caches()


def compare(n, quick, t1=2.0):
    times, flat, turning = (0.0, t1), chain(lx.Tridiagonal()), in_angles(n)
    start = {"flat": at_rest(n), "turning": (jnp.linspace(1.0, 1.5, n), jnp.zeros(n))}

    def cartesian(y):
        """Positions and velocities from angles and their momenta."""
        q, v = turning.to_velocity(t1, y)
        return jax.jvp(positions, (q,), (v,))

    def run(system, solver, **more):
        name = "turning" if system is turning else "flat"
        end = lambda x: states(system, solver, times, start[name], x, **more)
        return jax.jit((lambda x: cartesian(end(x))) if system is turning else end)

    counts = list(map(float, np.ceil(10 * 2 ** (np.arange(30) / 2))))
    tolerances = list(10.0 ** -np.arange(3, 14))
    runs = {}
    for name in list(CARTESIAN)[1:2] if quick else CARTESIAN:
        runs[OURS, name] = run(flat, CARTESIAN[name]), counts
    for name in list(GAUSS)[1:2] if quick else GAUSS:
        runs["Gauss, angles", name] = run(turning, GAUSS[name]), counts
    for group, system in ((THEIRS, turning), (OTHERS, flat)):
        solves = partial(run, system)
        runs |= diffrax_runs(solves, group, counts, tolerances, quick)
    exact = cartesian(integrated(turning.vf, start["turning"], t1))
    error = lambda y: relative_error(y, exact)
    enough = (min(TARGETS), 0.1 if quick else 2.0)
    curves = error_curves(runs, error, 2 if quick else 5, enough)
    caption = f"A chain of {n} links with friction to t = {t1}"
    print_least(caption, curves, TARGETS, OURS)


# Beside mici, whose positions are flat arrays.


def chain_in_numpy():
    def each(q):
        return np.diff(q.reshape(-1, 2), axis=0, prepend=0.0)

    def jacobian(q):
        n, out = q.size // 2, np.zeros((q.size // 2, q.size // 2, 2))
        i, d = np.arange(n), 2 * each(q)
        out[i, i], out[i[1:], i[:-1]] = d, -d[1:]
        return out.reshape(n, -1)

    return (
        lambda q: GRAVITY * np.sum(q[1::2]),
        lambda q: np.tile([0.0, GRAVITY], q.size // 2),
        lambda q: np.sum(each(q) ** 2, axis=1) - 1,
        jacobian,
    )


WIDE, THIN = 1.0, 0.5


def torus(t, q, args):
    return jnp.stack([(jnp.hypot(q[0], q[1]) - WIDE) ** 2 + q[2] ** 2 - THIN**2])


def torus_in_numpy():
    def jacobian(q):
        r = np.hypot(q[0], q[1])
        return 2 * np.array([[*(q[:2] * (1 - WIDE / r)), q[2]]])

    return (
        lambda q: GRAVITY * q[2],
        lambda q: np.array([0.0, 0.0, GRAVITY]),
        lambda q: np.array([(np.hypot(q[0], q[1]) - WIDE) ** 2 + q[2] ** 2 - THIN**2]),
        jacobian,
    )


def on_torus(**options):
    height = lambda t, q, args: GRAVITY * q[2]
    free = dps.MechanicalSystem(dps.QuadraticKinetic(), height)
    return dps.ConstrainedSystem(free, torus, **options)


def leapfrog(system, h, **tolerances):
    """Some steps of mici's constrained leapfrog."""
    integrators: Any = importlib.import_module("mici.integrators")
    state: Any = importlib.import_module("mici.states").ChainState
    step = integrators.ConstrainedLeapfrogIntegrator(
        system, step_size=h, projection_solver_kwargs=tolerances
    ).step

    def run(y0, steps):
        q, p = (np.array(x).ravel() for x in y0)
        now = state(pos=q, mom=p, dir=1)
        for _ in range(steps):
            now = step(now)
        return now.pos, now.mom

    return run


def mici(options):
    try:
        systems: Any = importlib.import_module("mici.systems")
        version = importlib.metadata.version("mici")
    except ImportError:
        systems, version = None, "not installed"
    h, steps, quick = 0.01, 50 if options.quick else 200, options.quick
    table = Table(
        f"Without friction, {steps} steps of {h}, mici {version}",
        *("system:<12", "program:<34", "error:>9.2e", "from Strang:>11.1e"),
        *("off:>8.1e", "microseconds of a step:>22.1f", "ratio:>7.1f"),
    )
    make = partial(chain, friction=0.0)
    turned = jnp.array([0.9, 0.7, 0.4]), jnp.array([1.0, -2.0, 1.0])
    cases = {
        "chain of 10": (make, at_rest(10), chain_in_numpy()),
        "torus": (on_torus, on_torus().project(0.0, turned), torus_in_numpy()),
    }
    if quick:
        del cases["torus"]
    for name, (make, y0, (energy, slope, value, jacobian)) in cases.items():
        system, times = make(), (0.0, h * steps)
        run = lambda x, times=times, y0=y0: partial(
            jax.jit(partial(states, x, STRANG, times, y0)), float(steps)
        )
        calls: dict[str, Any] = {"Strang": run(system)}
        calls["Strang, check_inverse"] = run(make(check_inverse=True))
        if name == "chain of 10":
            calls["Strang, Tridiagonal"] = run(make(lx.Tridiagonal()))
        if systems:
            kind = systems.DenseConstrainedEuclideanMetricSystem
            written = kind(
                *(energy, value), grad_neg_log_dens=slope, jacob_constr=jacobian
            )
            back = lambda q, y0=y0: q.reshape(y0[0].shape)
            compiled = kind(
                lambda q, x=system, back=back: x.system.potential(0.0, back(q), None),
                lambda q, x=system, back=back: x.value(0.0, back(q), None),
                backend="jax",
            )
            tight = {"constraint_tol": 1e-13, "position_tol": 1e-12}
            for label, theirs, more in (
                ("mici, functions in NumPy", written, {}),
                ("mici, compiled functions in JAX", compiled, {}),
                ("mici, NumPy, tolerance 1e-13", written, tight),
            ):
                calls[label] = partial(leapfrog(theirs, h, **more), y0, steps)
        found = interleaved(calls, 2 if quick else 7)
        exact = integrated(system.vf, y0, times[1])
        ours = found["Strang"]
        for label, timing in found.items():
            y = tuple(x.reshape(y0[0].shape) for x in timing.result)
            errors = relative_error(y, exact), relative_error(y, ours.result)
            off = float(system.violation(times[1], *map(jnp.asarray, y)))
            each = 1e6 * timing.median / steps
            table.row(name, label, *errors, off, each, timing.over(ours))
        if not systems:
            table.row(name, "mici", *(None for _ in range(5)))
        jax.clear_caches()


def main():
    parser = command_line(__doc__)
    parts = {"links": links, "angles": angles, "mici": mici}
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(parts)}")
    parser.add_argument("--links", nargs="*", type=int, help="lengths of the chains")
    options = parser.parse_args()
    for name in options.parts or parts:
        parts[name](options)


if __name__ == "__main__":
    main()
