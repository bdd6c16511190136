"""Energies that do not separate: time of a solve against its error.

Linkages with friction in each joint, a charged particle, geodesics on an ellipsoid and
around a black hole, a relativistic particle in a field, and Tao's benchmark, with
`PresymplecticGauss`, and Diffrax's `Tsit5`, `Dopri5`, `Dopri8` and `Kvaerno5`, adaptive
and with constant steps. A dash is an error that no run reached. `--only chain` measures
the problems whose names begin so.

`--mujoco` compares chains of 3 and of 10 hinges, with a damper in each, with MuJoCo,
and their mass matrices. `--long` follows the energy of an undamped double pendulum over
a million steps, of several lengths.
"""

import importlib
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, means, Table
from _schemes import DIFFRAX
from _solve import reference_end, relative_error, solve, states
from _timing import error_curves, fastest, interleaved, least_to

import diffrax_presym as dps


TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
TOLERANCES = 10.0 ** -np.arange(2, 14)
GRAVITY = 9.81


def chain_mass(t, q, args):
    """Links of unit length and mass, angles measured from the vertical."""
    n = len(q)
    below = n - np.maximum.outer(np.arange(n), np.arange(n))
    return below * jnp.cos(q[:, None] - q[None, :])


def chain_potential(t, q, args):
    return -GRAVITY * jnp.sum((len(q) - np.arange(len(q))) * jnp.cos(q))


def chain(n, friction=0.1):
    law = dps.ViscousDamping(friction)
    system = dps.LagrangianSystem(chain_mass, chain_potential, law)
    return system, (jnp.linspace(1.0, 1.5, n), jnp.zeros(n)), 10.0


def charged_particle():
    """In the plane, in a field that decays at the rate of the drag, and a trap."""

    def energy(t, q, p, args):
        a = 2 * jnp.exp(-0.05 * t) * jnp.stack([-q[1], q[0]])
        return jnp.sum((p - a) ** 2) / 2 + q[0] ** 2 / 2 + q[1] ** 2

    system = dps.Hamiltonian(energy, dps.ConstantDamping(0.05))
    return system, (jnp.array([1.0, 0.0]), jnp.array([0.0, 2.5])), 40.0


def ellipsoid():
    """Free motion on an ellipsoid of half axes 1, 1.3 and 0.7."""

    def place(q):
        (ca, cb), (sa, sb) = jnp.cos(q), jnp.sin(q)
        return jnp.stack([ca * cb, 1.3 * ca * sb, 0.7 * sa])

    def metric(t, q, args):
        jacobian = jax.jacfwd(place)(q)
        return jacobian.T @ jacobian

    system = dps.LagrangianSystem(metric, lambda t, q, args: jnp.zeros(()))
    start = jnp.array([0.3, 0.0]), jnp.array([0.7, 1.0])
    return system, system.from_velocity(0.0, start), 60.0


def relativistic():
    """A charge at high speed, in a magnetic field that grows outwards, and a trap."""

    def energy(t, q, p, args):
        a = (1 + jnp.sum(q**2) / 4) * jnp.stack([-q[1], q[0]]) / 2
        return jnp.sqrt(1 + jnp.sum((p - a) ** 2)) + jnp.sum(q**2) / 4

    system = dps.Hamiltonian(energy)
    return system, (jnp.array([1.0, 0.5]), jnp.array([0.0, 2.0])), 60.0


def black_hole():
    """A bound orbit in the Schwarzschild metric, in units of the mass."""

    def energy(t, q, p, args):
        r = jnp.sqrt(q @ q)
        radial = q @ p / r
        return jnp.sqrt((1 - 2 / r) * (1 + p @ p - 2 / r * radial**2))

    system = dps.Hamiltonian(energy)
    return system, (jnp.array([16.0, 0.0]), jnp.array([0.0, 0.27])), 3000.0


# The problem, and the longest step to begin with.
PROBLEMS = {
    "double pendulum": (partial(chain, 2), 0.5),
    "chain of 3": (partial(chain, 3), 0.3),
    "chain of 10": (partial(chain, 10), 0.1),
    "charged particle": (charged_particle, 3.0),
    "geodesic on an ellipsoid": (ellipsoid, 2.0),
    "relativistic charge": (relativistic, 2.0),
    "orbit around a black hole": (black_hole, 200.0),
}
QUICK = ("double pendulum", "charged particle")
FIXED = {f"Gauss({s})": dps.PresymplecticGauss(s) for s in (3, 4, 6, 8)}
# The iteration ended at a hundredth of the error that is wanted.
FIXED |= {
    f"Gauss({s}), {tol:.0e}": dps.PresymplecticGauss(s, tolerance=tol)
    for s, tol in ((2, 1e-5), (4, 1e-5), (4, 1e-8), (6, 1e-8), (6, 1e-11), (8, 1e-11))
}
THEIRS = {name: scheme.solver for name, scheme in DIFFRAX.items()} | {
    "Kvaerno5": dfx.Kvaerno5()
}


def curves(system, times, y0, exact, longest, quick):
    """The errors and times of every solver, by its group and name."""
    span = float(times[1] - times[0])
    run = eqx.filter_jit(states)
    factors = 2 ** (np.arange(0, 20 if quick else 40) / 2)
    counts = [
        jnp.asarray(float(n)) for n in np.unique(np.ceil(span / longest * factors))
    ]
    tolerances = [jnp.asarray(tol) for tol in TOLERANCES[:: 3 if quick else 1]]
    runs = {}
    for name, solver in FIXED.items():
        group = name.split("(")[0]
        runs[group, name] = partial(run, system, solver, times, y0), counts
    for name, solver in THEIRS.items():
        call = partial(run, system, solver, times, y0)
        runs["Diffrax", name + ", adaptive"] = partial(call, adaptive=True), tolerances
        if name != "Kvaerno5":
            runs["Diffrax", name + ", constant"] = call, counts
    error = lambda y: relative_error(y, exact)
    longest_run = 0.5 if quick else 4.0
    return error_curves(runs, error, 2 if quick else 5, (min(TARGETS), longest_run))


def compare(options):
    ratios = []
    for problem, (make, longest) in PROBLEMS.items():
        if options.only and not problem.startswith(tuple(options.only)):
            continue
        if options.quick and problem not in QUICK:
            continue
        system, y0, t1 = make()
        # Rounding accumulates over a long time.
        tolerance = 1e-11 if t1 > 1e3 else 1e-12
        limits = {"tolerance": tolerance, "longest": longest / 2}
        exact = reference_end(system, y0, 0.0, t1, **limits)
        times = jnp.array([0.0, t1])
        found = curves(system, times, y0, exact, longest, options.quick)
        titles = (f"{target:.0e}:>9.2f" for target in TARGETS)
        table = Table(f"{problem}: milliseconds to an error", "solver:<18", *titles)
        for (_, name), curve in found.items():
            table.row(name, *(1e3 * least_to(curve, target) for target in TARGETS))
        theirs, ours = (
            np.array([fastest(found, target, group)[0] for target in TARGETS])
            for group in ("Diffrax", "Gauss")
        )
        ratios.append(np.where(np.isfinite(ours), theirs / ours, np.inf))
        table.row("Diffrax / Gauss", *ratios[-1])
        jax.clear_caches()
    table = Table(
        "Ratios of the best times, in geometric mean over the problems, and the least",
        *("ratio:<22", *(f"{target:.0e}:>9.2f" for target in TARGETS)),
    )
    mean, least = means(ratios)
    table.row("Diffrax / Gauss", *mean)
    table.row("  the least", *least)


# Long times.


def long(quick):
    """The energy error over a million steps: its size, and the slope of a fit."""
    system = dps.LagrangianSystem(chain_mass, chain_potential)
    y0 = jnp.array([1.0, 1.5]), jnp.zeros(2)
    steps, saved = 10**4 if quick else 10**6, 1000
    table = Table(
        f"Double pendulum without friction, {steps} steps of PresymplecticGauss(8)",
        *("h:>6.3f", "largest energy error:>21.1e", "slope per step:>15.1e"),
        *("its standard error:>19.1e", "ratio:>6.1f"),
    )

    @jax.jit
    def errors(h):
        ts = h * (steps // saved) * jnp.arange(1, saved + 1)
        problem = system, dps.PresymplecticGauss(8), 0.0, ts[-1], h, y0
        options = {"saveat": dfx.SaveAt(ts=ts), "adjoint": dps.FixedStepAdjoint()}
        sol: Any = solve(*problem, **options)
        return jax.vmap(system.energy)(sol.ts, *sol.ys) / system.energy(0.0, *y0) - 1

    for h in (0.01, 0.015, 0.02):
        error = np.asarray(errors(jnp.asarray(h)))
        n = np.arange(1, saved + 1) * (steps // saved)
        slope = np.sum(n * error) / np.sum(n * n)
        # Of a random walk, whose increments are independent, fitted through zero.
        step = np.std(np.diff(error, prepend=0.0))
        weights = np.cumsum(n[::-1])[::-1] / np.sum(n * n)
        spread = step * np.sqrt(np.sum(weights**2))
        table.row(h, np.max(np.abs(error)), slope, spread, slope / spread)


# The same chains in MuJoCo, whose angles are those between neighbours.


def hinges(n):
    """The XML of a chain of rods of unit length and mass, with a damper in each joint.

    The angles are relative to the link before.
    """
    text = '<mujoco><option gravity="0 0 -9.81"/><worldbody>'
    for i in range(n):
        text += (
            f'<body pos="0 0 {0 if i == 0 else -1}"><joint type="hinge" axis="0 -1 0" '
            f'damping="{damping(n)[i]}"/><inertial pos="0 0 -0.5" mass="1" '
            f'diaginertia="{1 / 12!r} {1 / 12!r} 0.001"/>'
        )
    return text + "</body>" * n + "</worldbody></mujoco>"


def damping(n):
    return np.linspace(0.1, 0.3, n)


def rods(n):
    """The same as a `LagrangianSystem`: the mass matrix is J^T M J, for absolute angles
    J q, about which M is known."""
    total = np.tril(np.ones((n, n)))
    # The centre of link k moves with all links before it, and half with its own.
    reach = total - np.eye(n) / 2
    products = reach.T @ reach

    def mass(t, q, args):
        angles = total @ q
        cos = jnp.cos(angles[:, None] - angles[None, :])
        return total.T @ (products * cos + np.eye(n) / 12) @ total

    def potential(t, q, args):
        return -GRAVITY * jnp.sum(reach @ jnp.cos(total @ q))

    return dps.LagrangianSystem(mass, potential, dps.ViscousDamping(damping(n)))


def mujoco(quick):
    """Errors and times of MuJoCo's integrators, and of ours on the same equations.

    MuJoCo loads a model once; a time is that of its steps.
    """
    try:
        mj: Any = importlib.import_module("mujoco")
    except ImportError:
        print("MuJoCo is not installed: pip install mujoco")
        return
    solvers = {f"Gauss({s})": dps.PresymplecticGauss(s) for s in (3, 6)}
    solvers["Gauss(4), 1e-8"] = dps.PresymplecticGauss(4, tolerance=1e-8)
    for n, t1 in ((3, 10.0), (10, 5.0)):
        model, system = mj.MjModel.from_xml_string(hinges(n)), rods(n)
        q0 = jnp.linspace(1.0 if n == 3 else 0.3, 0.1, n)

        def simulate(integrator, steps, model=model, q0=q0, t1=t1):
            model.opt.integrator = getattr(mj.mjtIntegrator, f"mjINT_{integrator}")
            model.opt.timestep, data = t1 / steps, mj.MjData(model)
            data.qpos[:] = q0
            mj.mj_step(model, data, nstep=steps)
            return data.qpos.copy(), data.qvel.copy()

        data, mass = mj.MjData(model), np.zeros((n, n))
        data.qpos[:] = q0
        mj.mj_forward(model, data)
        for column, unit in zip(mass, np.eye(n), strict=True):
            mj.mj_mulM(model, data, column, unit)
        difference = relative_error(system.mass_matrix(0.0, q0), mass)
        print(f"\nMass matrix of {n} hinges, relative difference: {difference:.1e}")
        exact = simulate("RK4", 40_000 if quick else 200_000)
        calls = {
            (f"MuJoCo {name}", steps): partial(simulate, name.upper(), steps)
            for name in ("Euler", "implicitfast", "RK4")
            for steps in (1000, 4000, 16000)
        }
        for name, solver in solvers.items():
            one = eqx.filter_jit(partial(states, system, solver, (0.0, t1)))
            for steps in (50, 200, 800):
                y0 = q0, jnp.zeros(n)
                calls[name, steps] = partial(one, y0, jnp.asarray(float(steps)))
        table = Table(
            f"A chain of {n} hinges, to t = {t1}",
            *("integrator:<24", "steps:>7d", "error:>9.1e", "milliseconds:>13.3f"),
        )
        for (name, steps), timing in interleaved(calls, 3 if quick else 9).items():
            y = timing.result
            if not name.startswith("MuJoCo"):
                y = system.to_velocity(0.0, y)
            table.row(name, steps, relative_error(y, exact), 1e3 * timing.median)


def main():
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="*", help="beginnings of names of problems")
    parser.add_argument("--mujoco", action="store_true")
    parser.add_argument("--long", action="store_true")
    options = parser.parse_args()
    if options.mujoco:
        mujoco(options.quick)
    elif options.long:
        long(options.quick)
    else:
        compare(options)


if __name__ == "__main__":
    main()
