"""Hard cases: limits of stability, and strong friction."""

from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from _hard_cases import end, FEW, LEAPFROG, successful
from _report import Table
from _schemes import SCHEMES, stability_limit, step_matrices
from problems import mechanics

import diffrax_presym as dps


def stability(quick):
    """The end of the first interval of stability, by the trace of a step."""
    table = Table(
        "2. stability: the largest h * omega below which every step is stable",
        *("scheme:<21", "undamped:>8.2f", "gamma = omega / 2:>17.2f"),
    )
    for name in (*FEW, "TunedRKN6"):
        table.row(name, *(stability_limit(SCHEMES[name], x) for x in (0.0, 0.5)))
    # Frequencies 1 to 1e4 in one system, at and beyond the limit of the fastest.
    omega = jnp.logspace(0, 4, 5)
    stiff = mechanics(lambda t, q, args: jnp.sum((omega * q) ** 2) / 2)
    y0 = (jnp.ones(5) / omega, jnp.zeros(5))
    table = Table(
        "   frequencies 1 to 1e4, the leapfrog to t = 0.2: energy error",
        *("h * omega_max:>13", "error:>9.1e", "result:>10"),
    )
    for factor in (1.0, 1.9, 2.1):
        sol, (q, p) = end(stiff, LEAPFROG, 0.0, 0.2, factor * 1e-4, y0)
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.sum(p**2 + (np.asarray(omega) * q) ** 2) / 5
        table.row(str(factor), energy - 1, "" if successful(sol) else "reported")
    strong_friction(quick)
    slow_motion(quick)


def slow_motion(quick):
    """Errors of position and momentum of an oscillator with h omega = 0.3, relative to
    the exact values, at the time in which friction lets the slow motion fall by 1 / e,
    20 steps or more; in two loops, whose results are the same."""
    products = (0.1, 1.0, 10.0, 100.0)
    table = Table(
        "   strong friction: errors of q and p for each h gamma, h omega = 0.3",
        "scheme:<38",
        *(f"{x:g}, {part}:>8.0e" for x in products for part in "qp"),
    )
    strang = dps.Strang()
    solvers: dict[str, Any] = {name: x.solver for name, x in SCHEMES.items()}
    solvers |= {
        "SuzukiYoshida(4, Strang)": dps.SuzukiYoshida(4, strang),
        "SofroniouSpaletta(6, Strang)": dps.SofroniouSpaletta(6, strang),
        "Compensated(TunedRKN6)": dps.Compensated(dps.TunedRKN6()),
        "PresymplecticGauss(4)": dps.PresymplecticGauss(4),
        "PresymplecticGauss(4, Newton)": dps.PresymplecticGauss(
            4, optx.Newton(1e-12, 1e-12)
        ),
    }
    loops = dps.FixedStepAdjoint(), dfx.ForwardMode()
    for name, solver in solvers.items():
        rows = []
        for adjoint in loops[: 1 if quick else 2]:
            cells = []
            for x in products:
                system = mechanics(
                    dps.QuadraticPotential(0.09), dps.ConstantDamping(jnp.asarray(x))
                )
                # Two rates; the smaller one without cancellation.
                root = (x * x / 4 - 0.09 + 0j) ** 0.5
                fast = -x / 2 - root
                slow = 0.09 / fast
                t = float(max(20, np.ceil(x / 0.09)))
                y0 = (jnp.ones(1), jnp.zeros(1))
                sol, y = end(system, solver, 0.0, t, 1.0, y0, adjoint=adjoint)
                grow, decay = np.exp(slow * t), np.exp(fast * t)
                exact = (fast * grow - slow * decay) / (fast - slow), grow - decay
                exact = exact[0].real, (slow * fast / (fast - slow) * exact[1]).real
                good = successful(sol)
                pairs = zip(y, exact, strict=True)
                cells += [a[0] / b - 1 if good else np.inf for a, b in pairs]
            rows.append(cells)
        np.testing.assert_allclose(rows[0], rows[-1], rtol=0.05, atol=1e-11)
        table.row(name, *rows[0])


def strong_friction(quick):
    """From which friction a solution grows, by the eigenvalues of a step, and from
    which a solve fails, as it is more than the scheme resolves."""
    parts = "stable to", "error", "fails"
    table = Table(
        "   strong friction of q'' = -q - gamma q': the largest h gamma at which no "
        "solution\n   grows, the error of the slow motion there, and the first h gamma "
        "that fails",
        "scheme:<21",
        *(f"h = {h:g}, {x}:>18.3g" for h in (0.5, 1.0) for x in parts),
    )
    products = np.geomspace(0.05, 400, 60 if quick else 1200)
    for name in (*FEW, "Strang", "TunedRKN6", "SofroniouSpaletta(10)"):
        cells = []
        for h in (0.5, 1.0):
            gamma, steps = products / h, jnp.full(len(products), h)
            solver = SCHEMES[name].solver
            matrices = np.array(step_matrices(solver, steps, jnp.asarray(gamma)))
            fails = ~np.all(np.isfinite(matrices), axis=(1, 2))
            matrices[fails] = np.diag([2.0, 2.0])
            radius = np.max(np.abs(np.linalg.eigvals(matrices)), axis=1)
            # Of the motion that friction slows down.
            rate = (-gamma + np.sqrt((gamma**2 - 4).astype(complex))) / 2
            error = np.abs(radius - np.abs(np.exp(h * rate)))
            first = lambda bad: int(np.argmax(np.append(bad, True)))
            stable, failed = first(radius > 1 + 1e-12), first(fails)
            limits = np.append(products, np.inf)
            last_stable = np.inf if stable == len(products) else products[stable - 1]
            cells += [last_stable, error[stable - 1], limits[failed]]
        table.row(name, *cells)
