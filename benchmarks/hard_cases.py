"""The hard cases: what happens, and how schemes of every kind fare. One table a group.

Errors are the same on any machine; prices are ratios of times, both sides compiled,
warmed up and run by turns, the median of several.
"""

import argparse
import pathlib
import statistics
import time
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

LEAPFROG = dps.PresymplecticLeapfrog()
RKN4 = dps.BlanesMoanRKN4()
RKN6 = dps.BlanesMoanRKN6()
QUADRATIC = dps.QuadraticKinetic()


def harmonic(t, q, args):
    return jnp.sum(q**2) / 2


def pendulum(t, q, args):
    return jnp.sum(1 - jnp.cos(q))


def newton(t, q, args):
    return -1 / jnp.sqrt(jnp.sum(q**2) + (0.0 if args is None else args**2))


def absolute(t, q, args):
    return jnp.sum(jnp.abs(q))


def root(t, q, args):
    """Not defined for negative positions."""
    return -jnp.sum(jnp.sqrt(q))


def quartic(t, q, args):
    """No lower bound: the motion reaches infinity in finite time."""
    return -jnp.sum(q**4)


def mixed(t, q, p, args):
    return (1 + jnp.sum(q**2)) * (1 + jnp.sum(p**2)) / 2


def conservative(potential, mass=None):
    return dps.SeparableHamiltonian(dps.QuadraticKinetic(mass), potential)


def damped(potential, damping):
    return dps.ConformalHamiltonian(QUADRATIC, potential, damping)


@eqx.filter_jit
def solve(hamiltonian, solver, t0, t1, dt0, y0, args, controller, saveat):
    """The one solve of this file; a failure is a result."""
    return dfx.diffeqsolve(
        dps.HamiltonianTerm(hamiltonian),
        solver,
        t0,
        t1,
        dt0,
        y0,
        args,
        stepsize_controller=controller,
        saveat=saveat,
        max_steps=None,
        throw=False,
    )


Controller = dfx.AbstractStepSizeController
ZERO = jnp.zeros(())
CONSTANT: Controller = dfx.ConstantStepSize()
TIGHT = dfx.PIDController(rtol=1e-8, atol=1e-8)
LAST = dfx.SaveAt(t1=True)


def end(
    hamiltonian, solver, t0, t1, dt0, y0, args=None, controller: Controller = CONSTANT
):
    sol = solve(hamiltonian, solver, t0, t1, dt0, y0, args, controller, LAST)
    return sol, jax.tree.map(lambda x: np.asarray(x[-1], np.float64), sol.ys)


def table(title, header, rows):
    print(f"\n{title}\n")
    rows = [header, *([str(x) for x in row] for row in rows)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    for i, row in enumerate(rows):
        print("  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip())
        if i == 0:
            print("  ".join("-" * w for w in widths))


def number(x):
    x = float(x)
    return f"{x:.1e}" if np.isfinite(x) else "nan" if np.isnan(x) else "inf"


def overflow(quick):
    """Relative error of an oscillator whose momentum decays by exp(-eta) at the end."""
    rows = []
    for dtype in (jnp.float32, jnp.float64):
        for eta in (1.0, 1e2, 1e3, 1e5):
            cells = []
            # Critically slow: the momentum follows the force, whatever the damping.
            t1 = jnp.asarray(50.0, dtype)
            gamma = jnp.asarray(eta / 50, dtype)
            y0 = (jnp.ones(1, dtype), jnp.zeros(1, dtype))
            for name in ("frame", "canonical", "unequal"):
                if name == "frame":
                    system = damped(harmonic, dps.ConstantDamping(gamma))
                elif name == "canonical":
                    system = canonical_form(harmonic, gamma)
                else:
                    system = dps.DissipativeHamiltonian(
                        QUADRATIC,
                        harmonic,
                        eta1=dps.ConstantDamping(gamma),
                        eta2=dps.ConstantDamping(gamma * 0.999),
                    )
                dt0 = jnp.asarray(50.0 / 2000, dtype)
                _, (q, p) = end(system, LEAPFROG, 0 * t1, t1, dt0, y0)
                good = np.isfinite(q).all() and np.isfinite(p).all()
                cells.append(f"{q[0]:+.3f}" if good else "nan")
            rows.append((jnp.dtype(dtype).name, f"{eta:g}", *cells))
    table(
        "1. overflow: q(50) of a damped oscillator, exp(eta) at the end",
        ("precision", "eta", "in the frame", "canonical", "eta1 > eta2"),
        rows,
    )


def canonical_form(potential, gamma):
    """The same system in canonical momenta, the naive way: P grows like exp(eta)."""
    gradient = jax.grad(potential, argnums=1)
    return dps.VectorField(
        lambda t, p, args: jnp.exp(-gamma * t) * p,
        lambda t, q, args: -jnp.exp(gamma * t) * gradient(t, q, args),
    )


SCHEMES = {
    "PresymplecticEuler": dps.PresymplecticEuler(),
    "PresymplecticLeapfrog": LEAPFROG,
    "PresymplecticYoshida4": dps.PresymplecticYoshida4(),
    "Suzuki4": dps.Suzuki4(),
    "BlanesMoan4": dps.BlanesMoan4(),
    "BlanesMoanRKN4": RKN4,
    "SofroniouSpaletta6": dps.SofroniouSpaletta6(),
    "BlanesMoan6": dps.BlanesMoan6(),
    "BlanesMoanRKN6": RKN6,
    "SofroniouSpaletta8": dps.SofroniouSpaletta8(),
    "BlanesCasasRKN8": dps.BlanesCasasRKN8(),
    "PresymplecticTao": dps.PresymplecticTao(5.0),
}


@eqx.filter_jit
def trace(solver, h, gamma):
    """The trace of one step of the undamped or damped oscillator."""
    term = dps.HamiltonianTerm(damped(harmonic, dps.ConstantDamping(gamma)))

    def one(x):
        y = (x[:1], x[1:])
        carry = solver.init(term, 0 * h, h, y, None)
        (q, p), *_ = solver.step(term, 0 * h, h, y, None, carry, False)
        return jnp.concatenate([q, p])

    return jax.jacfwd(one)(jnp.zeros(2))


def stability(quick):
    """The largest h * omega before the first unstable step, by the eigenvalues."""
    rows = []
    hs = jnp.arange(1, 1200 if not quick else 300) * (
        6.0 / (1200 if not quick else 300)
    )
    for name, solver in SCHEMES.items():
        if name == "PresymplecticTao":
            continue  # Its step is a map of two copies.
        cells = []
        for gamma in (0.0, 0.5):
            steps = jax.vmap(lambda h, g=gamma, s=solver: trace(s, h, g))(hs)
            radius = np.abs(np.linalg.eigvals(np.asarray(steps))).max(axis=1)
            unstable = np.flatnonzero(radius > 1 + 1e-7)
            cells.append(f"{hs[unstable[0] - 1]:.2f}" if unstable.size else "> 6")
        rows.append((name, *cells))
    table(
        "2. stability: the largest stable h * omega",
        ("scheme", "undamped", "gamma = omega / 2"),
        rows,
    )
    # Frequencies 1 to 1e4 in one system, at and beyond the limit of the fastest.
    omega = jnp.logspace(0, 4, 5)
    stiff = conservative(lambda t, q, args: jnp.sum((omega * q) ** 2) / 2)
    y0 = (jnp.ones(5) / omega, jnp.zeros(5))
    rows = []
    for factor in (1.0, 1.9, 2.1):
        sol, (q, p) = end(stiff, dps.Checked(LEAPFROG), 0.0, 0.2, factor * 1e-4, y0)
        energy = np.sum(p**2 + (np.asarray(omega) * q) ** 2) / 5
        failed = "" if sol.result == dfx.RESULTS.successful else "reported"
        rows.append((factor, number(energy - 1), failed))
    table(
        "   frequencies 1 to 1e4, the leapfrog to t = 0.2: energy error",
        ("h * omega_max", "error", "Checked"),
        rows,
    )


def long_times(quick):
    """Rounding errors of the energy, root mean square of 16 orbits, against the same
    steps in compensated doubles."""
    rows, growth = [], {}
    q0 = jnp.linspace(0.3, 1.0, 16, dtype=jnp.float32)
    system = conservative(pendulum)
    sub = dps.Substeps(LEAPFROG, 1000)
    numbers = (10**4, 10**5) if quick else (10**4, 10**5, 10**6, 10**7)
    for n in numbers:
        ends = {}
        for name, dtype, solver in (
            ("exact", jnp.float64, dps.Compensated(sub, 125.0)),
            ("float32", jnp.float32, sub),
            ("float32 compensated", jnp.float32, dps.Compensated(sub, 125.0)),
            ("float64", jnp.float64, sub),
        ):
            q = q0.astype(dtype)
            t1, dt0 = jnp.asarray(n / 8, dtype), jnp.asarray(125.0, dtype)
            _, y = end(system, solver, 0 * t1, t1, dt0, (q, jnp.zeros_like(q)))
            ends[name] = y[1] ** 2 / 2 + 1 - np.cos(y[0])
        exact = ends.pop("exact")
        start = 1 - np.cos(np.asarray(q0, np.float64))
        error = {k: np.sqrt(np.mean((v - exact) ** 2)) for k, v in ends.items()}
        growth[n] = error
        scheme = np.abs(exact - start).max()
        rows.append((f"{n:.0e}", number(scheme), *(number(x) for x in error.values())))
    table(
        "3. long times: error of the energy of a pendulum, leapfrog, h = 1/8",
        ("steps", "of the scheme", *(f"rounding, {x}" for x in growth[numbers[0]])),
        rows,
    )
    # The clock of float32: a free particle shows the lengths of the steps themselves.
    rows = []
    h, t0 = jnp.float32(0.01), jnp.float32(1e4)
    for name, solver, n in (
        ("PresymplecticLeapfrog", LEAPFROG, 1),
        ("Substeps(..., 100)", dps.Substeps(LEAPFROG, 100), 100),
        ("Compensated(..., length)", dps.Compensated(LEAPFROG, h), 1),
    ):
        term = dps.HamiltonianTerm(conservative(lambda t, q, args: 0 * jnp.sum(q)))
        y = (jnp.zeros(1, jnp.float32), jnp.ones(1, jnp.float32))
        t1 = t0 + n * h
        carry = solver.init(term, t0, t1, y, None)
        (q, _), *_ = solver.step(term, t0, t1, y, None, carry, False)
        rows.append((name, f"{abs(float(q[0]) / (n * 0.01) - 1):.1%}"))
    table("   float32 at t = 1e4, h = 0.01", ("solver", "error of the step"), rows)
    return growth


def kepler(quick):
    """Orbits of e = 0.9, with drag and without: controller, constant steps, Dopri8."""
    e, orbits = 0.9, 100 if quick else 2000
    y0 = (jnp.array([1 - e, 0.0]), jnp.array([0.0, ((1 + e) / (1 - e)) ** 0.5]))
    t1 = 2 * np.pi * orbits
    # Each at the same phase of every orbit would be blind: times of no common period.
    ts = jnp.linspace(0.0, t1, 20 * orbits + 1)
    series = {}
    for drag in (None, 1e-5):
        system = (
            conservative(newton)
            if drag is None
            else damped(newton, dps.ConstantDamping(drag))
        )
        term = dps.HamiltonianTerm(system)

        def record(t, y, args, system=system):
            q, p = y
            return system.energy(t, q, p, args)

        density = dps.DistanceDensity()
        controller = lambda eps, d=density, t=term: dps.StepDensityController(t, eps, d)
        runs = {
            "RKN6, density": (RKN6, controller(0.25), None, 14),
            "leapfrog, density": (LEAPFROG, controller(0.04), None, 1),
            "leapfrog, constant": (LEAPFROG, CONSTANT, 2 * np.pi / 4000, 1),
            "Dopri8, 1e-8": (dfx.Dopri8(), TIGHT, None, 14),
            "Tsit5, 1e-8": (dfx.Tsit5(), TIGHT, None, 6),
        }
        saveat = dfx.SaveAt(ts=ts, fn=record)
        tight = dfx.PIDController(rtol=1e-13, atol=1e-13)
        reference = (
            -0.5
            if drag is None
            else np.asarray(
                solve(system, dfx.Dopri8(), 0.0, t1, None, y0, None, tight, saveat).ys
            )
        )
        rows = []
        for name, (solver, control, dt0, cost) in runs.items():
            sol = solve(system, solver, 0.0, t1, dt0, y0, None, control, saveat)
            error = np.abs(np.asarray(sol.ys) - reference)
            series[name, drag] = error
            tenth = len(error) // 10
            rows.append(
                (
                    name,
                    f"{int(sol.stats['num_steps']) * cost / orbits:.0f}",
                    number(error[1:tenth].max()),
                    number(error[-tenth:].max()),
                )
            )
        table(
            f"4. Kepler, e = {e}, {orbits} orbits, drag {drag or 0:g}: energy error",
            ("solver", "forces per orbit", "first tenth", "last tenth"),
            rows,
        )
    return series


def encounters(quick):
    """Energy errors where bodies come close."""
    rows = []
    for e, soft in ((0.9, None), (0.99, None), (0.99, 1e-2)):
        # From the far end, where softening does not matter.
        q0 = jnp.array([1 + e, 0.0])
        y0 = (q0, jnp.array([0.0, ((1 - e) / (1 + e)) ** 0.5]))
        system = conservative(newton)
        term = dps.HamiltonianTerm(system)
        start = float(system.energy(ZERO, *y0, soft))
        cells = []
        for control, dt0 in (
            (dps.StepDensityController(term, 0.04, dps.DistanceDensity()), None),
            (CONSTANT, 2 * np.pi / 4000),
        ):
            sol, (q, p) = end(
                system, LEAPFROG, 0.0, 20 * np.pi + 3, dt0, y0, soft, control
            )
            error = float(system.energy(ZERO, q, p, soft)) - start
            cells += [f"{int(sol.stats['num_steps'])}", number(abs(error))]
        rows.append((e, soft or 0, *cells))
    table(
        "   ten orbits: energy error of the leapfrog",
        ("e", "softening", "steps", "density", "steps", "constant"),
        rows,
    )


def weighted(t, q, args):
    return jnp.sum(args * q**2) / 2


def eight_energy(t, q, args):
    return -jnp.sum(1 / dps.pair_distances(q))


PERIOD = 6.32591398


def eight_start():
    q1 = np.array([0.97000436, -0.24308753])
    v3 = np.array([-0.93240737, -0.86473146])
    q0 = jnp.array([q1, -q1, [0.0, 0.0]])
    return q0, jnp.array([-v3 / 2, -v3 / 2, v3])


def figure_eight(quick):
    """Three bodies on one curve, and what friction makes of it."""
    y0, period, rows = eight_start(), PERIOD, []
    for gamma in (0.0, 1e-3):
        system = damped(eight_energy, dps.ConstantDamping(gamma))
        t1 = (10 if quick else 50) * period
        tight = dfx.PIDController(rtol=1e-12, atol=1e-12)
        _, exact = end(system, dfx.Dopri8(), 0.0, t1, None, y0, None, tight)
        energy = lambda y, s=system: float(s.energy(ZERO, *y))
        for name, solver, dt0, control in (
            ("RKN4", RKN4, period / 50, CONSTANT),
            ("leapfrog", LEAPFROG, period / 300, CONSTANT),
            ("Tsit5", dfx.Tsit5(), None, dfx.PIDController(rtol=1e-5, atol=1e-5)),
        ):
            sol, y = end(system, solver, 0.0, t1, dt0, y0, None, control)
            steps = int(sol.stats["num_steps"])
            rows.append((gamma, name, steps, number(abs(energy(y) - energy(exact)))))
    table(
        f"   figure eight, {t1 / period:.0f} periods: error of the energy",
        ("friction", "solver", "steps", "error"),
        rows,
    )


def duffing(t, q, args):
    return jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t))


def henon_heiles(t, q, args):
    return jnp.sum(q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def chaos(quick):
    """Mean values over an ensemble, of two schemes and of two steps."""
    n = 200 if quick else 1000
    key = jax.random.key(0)
    rows = []
    for name, system, size in (
        ("Duffing", damped(duffing, dps.ConstantDamping(0.25)), 1),
        ("Henon-Heiles", conservative(henon_heiles), 2),
    ):
        q0 = 0.1 * jax.random.normal(key, (n, size))
        p0 = jax.random.normal(jax.random.fold_in(key, 1), (n, size))
        if size == 2:  # All of one energy, 1/8, where most orbits are chaotic.
            left = 1 / 8 - jax.vmap(lambda q: henon_heiles(0.0, q, None))(q0)
            p0 *= jnp.sqrt(2 * left / jnp.sum(p0**2, axis=1))[:, None]
        for label, solver, dt0, control in (
            ("RKN4, 1/20", RKN4, 0.05 * 6, CONSTANT),
            ("leapfrog, 1/20", LEAPFROG, 0.05, CONSTANT),
            ("Dopri8, 1e-10", dfx.Dopri8(), None, dfx.PIDController(1e-10, 1e-10)),
        ):

            @eqx.filter_jit
            @eqx.filter_vmap(in_axes=(None, None, 0, None, None))
            def one(system, solver, y0, dt0, control):
                times = jnp.linspace(100.0, 300.0, 201)
                return dfx.diffeqsolve(
                    dps.HamiltonianTerm(system),
                    solver,
                    0.0,
                    300.0,
                    dt0,
                    y0,
                    stepsize_controller=control,
                    saveat=dfx.SaveAt(ts=times),
                    max_steps=None,
                ).ys

            q, p = one(system, solver, (q0, p0), dt0, control)
            mean = lambda x: np.mean(np.sum(np.asarray(x) ** 2, axis=-1), axis=1)
            cells = []
            for x in (q, p):
                each = mean(x)
                error = each.std() / n**0.5
                cells.append(f"{each.mean():.4f} +- {error:.4f}")
            rows.append((name, label, *cells))
    table(
        f"5. chaos: means over time and {n} orbits",
        ("system", "solver", "<q^2>", "<p^2>"),
        rows,
    )


def singular_damping(quick):
    """Nesterov's equation q'' + 3/t q' + q = 0, whose solution is 2 J_1(t) / t."""
    exact = 2 * 0.4400505857449335  # J_1(1), at t = 1.
    y0 = (jnp.ones(1), jnp.zeros(1))
    rows = []
    system = damped(harmonic, dps.LogDamping(3.0))
    for name, solver in SCHEMES.items():
        cells = []
        for t0 in (1e-6, 0.0):
            checked = dps.Checked(solver)
            try:
                sol, (q, _) = end(system, checked, t0, 1.0, (1.0 - t0) / 100, y0)
                good = sol.result == dfx.RESULTS.successful
                cells.append(number(abs(q[0] - exact)) if good else "reported")
            except Exception as error:
                cells.append(type(error).__name__)
        rows.append((name, *cells))
    table(
        "6. q'' + 3 q'/t + q = 0 to t = 1 in 100 steps: error, or a failure reported",
        ("scheme (Checked)", "from t0 = 1e-6", "from t0 = 0"),
        rows,
    )


def height(t, y, args, **kwargs):
    return y[0][0]


def non_smooth(quick):
    """Kinks, contacts and damping by pieces, against their exact solutions."""
    rows = []
    # |q|: parabolas, of period 4 sqrt(2) from q = 1, and of energy 1.
    for name, solver, dt0, control in (
        ("leapfrog", LEAPFROG, 0.01, CONSTANT),
        ("RKN6", RKN6, 0.1, CONSTANT),
        ("Tsit5", dfx.Tsit5(), None, dfx.PIDController(rtol=1e-6, atol=1e-6)),
    ):
        system, y0 = conservative(absolute), (jnp.ones(1), jnp.zeros(1))
        t1 = 100 * 4 * 2**0.5
        sol, (q, p) = end(system, solver, 0.0, t1, dt0, y0, None, control)
        error = abs(q[0]) + p[0] ** 2 / 2 - 1
        rows.append(
            ("|q|, 100 periods", name, int(sol.stats["num_steps"]), number(abs(error)))
        )
    # A ball, thrown back at each contact, in ten bounces.
    falling = conservative(lambda t, q, args: jnp.sum(q))
    event = dfx.Event(height, optx.Newton(rtol=1e-10, atol=1e-10), direction=False)
    for name, solver in (("leapfrog", LEAPFROG), ("RKN4", RKN4)):
        t, y = 0.0, (jnp.ones(1), jnp.zeros(1))
        for _ in range(10):
            sol = dfx.diffeqsolve(
                dps.HamiltonianTerm(falling), solver, t, t + 10, 0.05, y, event=event
            )
            assert sol.ts is not None and sol.ys is not None
            t = sol.ts[-1]
            y = (jnp.abs(sol.ys[0][-1]), -sol.ys[1][-1])
        exact = 2**0.5 * 19
        rows.append(("ten bounces", name, "", number(abs(float(t) - exact))))
    # Damping switched on at t = 1, between two steps and at the end of one.
    law = lambda t: jnp.maximum(t - 1.0, 0.0)
    system = damped(harmonic, law)
    y0 = (jnp.ones(1), jnp.zeros(1))
    tight = dfx.PIDController(rtol=1e-12, atol=1e-12)
    plain = conservative(harmonic)
    always = damped(harmonic, dps.ConstantDamping(1.0))
    _, y = end(plain, dfx.Dopri8(), 0.0, 1.0, None, y0, None, tight)
    _, exact = end(always, dfx.Dopri8(), 1.0, 3.0, None, y, None, tight)
    for name, times in (
        ("within a step", np.linspace(0.0, 3.0, 50)),
        ("at the end of a step", np.linspace(0.0, 3.0, 49)),
    ):
        control = dfx.StepTo(times)
        _, (q, _) = end(system, RKN4, 0.0, 3.0, None, y0, None, control)
        rows.append(
            (
                f"damping jumps {name}",
                "RKN4",
                len(times) - 1,
                number(abs(q - exact[0])[0]),
            )
        )
    table("7. non-smooth", ("case", "solver", "steps", "error"), rows)


def conditioning(quick):
    """Energies over 1000 steps at 0.9 of the stability limit, relative."""
    rows = []
    size = 10**4 if quick else 10**6
    for name, stiffness, mass in (
        ("condition 1e8", np.logspace(-8, 0, 50), None),
        ("rank-deficient", np.repeat([0.0, 1.0], 25), None),
        ("masses 1e-6 to 1e6", np.logspace(-6, 6, 50), np.logspace(-6, 6, 50)),
        (f"dimension {size:.0e}", np.linspace(0.0, 1.0, size), None),
    ):
        stiffness = jnp.asarray(stiffness)
        system = conservative(weighted, None if mass is None else jnp.asarray(mass))
        y0 = (jnp.ones(stiffness.size), jnp.zeros(stiffness.size))
        before = float(system.energy(ZERO, *y0, stiffness))
        cells = []
        for solver, dt0 in ((LEAPFROG, 1.0), (RKN4, 1.0)):
            _, y = end(system, solver, 0.0, 1000 * dt0, dt0, y0, stiffness)
            q, p = map(jnp.asarray, y)
            after = float(system.energy(ZERO, q, p, stiffness))
            cells.append(number(abs(after / before - 1)))
        rows.append((name, *cells))
    table(
        "8. conditioning: relative energy error after 1000 steps, h * omega_max = 1",
        ("system", "leapfrog", "RKN4"),
        rows,
    )


def broken(quick):
    """What a solve says whose input breaks at run time."""
    rows = []
    newton_root = optx.Newton(rtol=1e-12, atol=1e-12)
    implicit = dps.PresymplecticLeapfrog("momentum", newton_root, 4)
    word = lambda sol: (
        "successful" if sol.result == dfx.RESULTS.successful else "failure"
    )
    y0 = (jnp.array([0.3]), jnp.array([-1.0]))
    for name, system, solvers in (
        ("nan: sqrt of q < 0", conservative(root), (LEAPFROG, dps.Checked(LEAPFROG))),
        ("overflow: -q^4", conservative(quartic), (LEAPFROG, dps.Checked(LEAPFROG))),
        (
            "root finder diverges",
            dps.Hamiltonian(mixed),
            (implicit, dps.Checked(implicit)),
        ),
    ):
        cells = []
        for solver in (*solvers, dfx.Tsit5()):
            adaptive = isinstance(solver, dfx.Tsit5)
            control = (
                dfx.PIDController(1e-6, 1e-6, dtmin=1e-9, force_dtmin=False)
                if adaptive
                else CONSTANT
            )
            sol, (q, _) = end(system, solver, 0.0, 20.0, 0.5, y0, None, control)
            finite = "" if np.isfinite(q).all() else ", nan"
            cells.append(f"{word(sol)} at {int(sol.stats['num_steps'])}{finite}")
        rows.append((name, *cells))
    table(
        "9. broken input: result, number of steps",
        ("case", "as it is", "Checked", "Tsit5"),
        rows,
    )


# Each with its force evaluations per step.
EVERYONE = {
    "PresymplecticEuler": (dps.PresymplecticEuler(), 1),
    "PresymplecticLeapfrog": (LEAPFROG, 1),
    "Strang": (dps.Strang(), 1),
    "PresymplecticYoshida4": (dps.PresymplecticYoshida4(), 3),
    "Suzuki4": (dps.Suzuki4(), 5),
    "BlanesMoan4": (dps.BlanesMoan4(), 6),
    "BlanesMoanRKN4": (RKN4, 6),
    "SofroniouSpaletta6": (dps.SofroniouSpaletta6(), 13),
    "BlanesMoan6": (dps.BlanesMoan6(), 10),
    "BlanesMoanRKN6": (RKN6, 14),
    "SofroniouSpaletta8": (dps.SofroniouSpaletta8(), 21),
    "BlanesCasasRKN8": (dps.BlanesCasasRKN8(), 19),
    "SofroniouSpaletta10": (dps.SofroniouSpaletta10(), 35),
    "PresymplecticTao": (dps.PresymplecticTao(), 3),
    "PresymplecticCoupled(4)": (dps.PresymplecticCoupled(4), 11),
    "PresymplecticCoupled(6)": (dps.PresymplecticCoupled(6), 27),
    "leapfrog, canonical": (LEAPFROG, 1),
    "Tsit5, equal steps": (dfx.Tsit5(), 6),
    "Dopri8, equal steps": (dfx.Dopri8(), 13),
}


def every_scheme(quick):
    """All schemes in all cases where one number tells, by as many evaluations."""
    e, gamma = 0.9, 20.0
    slow, fast = np.roots([1.0, gamma, 1.0])[::-1]
    settled = (slow * np.exp(fast * 50) - fast * np.exp(slow * 50)) / (slow - fast)
    stiffness = jnp.logspace(-8, 0, 50)
    one = jnp.ones(1)
    # Potential, friction, start, `args`, end, and evaluations until then.
    cases = {
        "overflow": (harmonic, gamma, (one, 0 * one), None, 50.0, 20_000),
        "long": (pendulum, None, (2 * one, 0 * one), None, 1e4, 200_000),
        "e = 0.9": (
            newton,
            None,
            (jnp.array([1 + e, 0.0]), jnp.array([0.0, ((1 - e) / (1 + e)) ** 0.5])),
            None,
            20 * np.pi + 3,
            40_000,
        ),
        "eight": (eight_energy, None, eight_start(), None, 10.3 * PERIOD, 6_000),
        "|q|": (absolute, None, (one, 0 * one), None, 100.0, 10_000),
        "1e8": (
            weighted,
            None,
            (jnp.ones(50), jnp.zeros(50)),
            stiffness,
            1000.0,
            10_000,
        ),
    }
    rows = []
    system: Any
    for name, (solver, cost) in EVERYONE.items():
        cells = []
        for potential, friction, y0, args, t1, most in cases.values():
            if friction is None:
                system = conservative(potential)
            elif "canonical" in name:
                system = canonical_form(potential, friction)
            else:
                system = damped(potential, dps.ConstantDamping(friction))
            steps = max(1, round(most / cost) // (10 if quick else 1))
            _, y = end(system, solver, 0.0, t1, t1 / steps, y0, args)
            q, p = map(jnp.asarray, y)
            if friction is None:
                energy = lambda y, s=system, a=args: float(s.energy(ZERO, *y, a))
                cells.append(number(abs(energy((q, p)) / energy(y0) - 1)))
            else:
                cells.append(number(abs(q[0] / settled - 1)))
        rows.append((name, *cells))
    table(
        "Every scheme by as many force evaluations: relative error of q in the first "
        "case, of the energy in the others",
        ("scheme", *cases),
        rows,
    )


def prices(quick):
    """Times of a solve with a protection, over those of the same solve without."""
    rows = []
    free = conservative(pendulum)
    constant = damped(pendulum, dps.ConstantDamping(0.1))
    decaying = damped(pendulum, dps.LogDamping(3.0, 1.0))
    for size in (1, 100, 1000):
        y0 = (jnp.full(size, 0.5), jnp.zeros(size))
        # Powers of two, so that every side takes as many steps.
        steps = 2 ** {1: 19, 100: 15, 1000: 13}[size] // (32 if quick else 1)
        for scheme, base in (("leapfrog", LEAPFROG), ("RKN6", RKN6)):
            sub = dps.Substeps(base, 16)
            sides = {
                "frame": ((free, base, 1), (constant, base, 1)),
                "frame, 1/t": ((free, base, 1), (decaying, base, 1)),
                "Compensated": ((free, base, 1), (free, dps.Compensated(base), 1)),
                "Checked": ((free, base, 1), (free, dps.Checked(base), 1)),
                "Checked, every 16th": ((free, sub, 16), (free, dps.Checked(sub), 16)),
            }
            cells = []
            for pair in sides.values():
                ratios = []
                for attempt in range(4 if quick else 10):
                    taken = []
                    for system, solver, n in pair:
                        t1, dt0 = steps / 16, n / 16
                        start = time.perf_counter()
                        sol = solve(
                            system, solver, 0.0, t1, dt0, y0, None, CONSTANT, LAST
                        )
                        jax.block_until_ready(sol.ys)
                        taken.append(time.perf_counter() - start)
                    if attempt > 0:  # The first compiles.
                        ratios.append(taken[1] / taken[0])
                cells.append(f"{statistics.median(ratios):.2f}")
            rows.append((size, scheme, *cells))
    table(
        "What a protection costs, times the bare solve",
        ("unknowns", "scheme", *sides),
        rows,
    )


def pictures(series, growth, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    names = [name for name, drag in series if drag is None]
    for name in names:
        error = series[name, None]
        # The largest error so far in each of 200 stretches: drift, not oscillation.
        pieces = [x.max() for x in np.array_split(error[1:], 200)]
        orbits = np.linspace(0, (len(error) - 1) / 20, 200)
        ax.semilogy(orbits, pieces, label=name)
    ax.set(
        xlabel="orbits",
        ylabel="largest energy error per stretch",
        title="Kepler orbit, e = 0.9",
    )
    ax.legend(loc="lower right", fontsize="small")
    ax.grid(alpha=0.3)
    fig.savefig(folder / "hard_cases_kepler.png", dpi=110)
    fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    numbers = np.array(list(growth))
    for name in growth[numbers[0]]:
        errors = np.array([growth[n][name] for n in numbers])
        (line,) = ax.loglog(numbers, errors, "o-", label=name)
        guide = errors[0] * (numbers / numbers[0]) ** 0.5
        ax.loglog(numbers, guide, ":", color=line.get_color())
    ax.set(
        xlabel="steps",
        ylabel="energy error from rounding (rms)",
        title="Pendulum, leapfrog, h = 1/8; dotted: square root of the steps",
    )
    ax.legend(fontsize="small")
    ax.grid(alpha=0.3)
    fig.savefig(folder / "hard_cases_rounding.png", dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer steps and orbits")
    parser.add_argument("--only", nargs="+", help="groups, by their functions")
    parser.add_argument("--pictures", type=pathlib.Path, help="folder to save them to")
    options = parser.parse_args()
    groups = (
        overflow,
        stability,
        long_times,
        kepler,
        encounters,
        figure_eight,
        chaos,
        singular_damping,
        non_smooth,
        conditioning,
        broken,
        every_scheme,
        prices,
    )
    out = {}
    for group in groups:
        if options.only is None or group.__name__ in options.only:
            out[group.__name__] = group(options.quick)
    if options.pictures and {"kepler", "long_times"} <= set(out):
        pictures(out["kepler"], out["long_times"], options.pictures)


if __name__ == "__main__":
    main()
