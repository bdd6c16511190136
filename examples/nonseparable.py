"""Three nonseparable systems with friction.

- A charged particle with drag, in a trap and a magnetic field that decays at the rate
  of the drag; for this field the system is Hamiltonian. Checked against Newton's second
  law.
- A double pendulum with friction.
- A relativistic particle around a black hole, in the Schwarzschild metric, with slow
  loss of momentum.

Prints a table of errors and numbers of steps, and saves one figure. `--quick` runs a
smaller version.
"""

import argparse
import pathlib
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import optimistix as optx

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle


jax.config.update("jax_enable_x64", True)

FIELD, DRAG = 4.0, 0.05


def vector_potential(t, q):
    """The vector potential of a uniform field perpendicular to the plane."""
    return jnp.exp(-DRAG * t) * FIELD / 2 * jnp.array([-q[1], q[0]])


def trap(q):
    return q[0] ** 2 / 2 + q[1] ** 2


def charged(t, q, p, args):
    return jnp.sum((p - vector_potential(t, q)) ** 2) / 2 + trap(q)


def newton(t, y, args):
    """The vector field with drag, Lorentz force and trap."""
    q, v = y
    magnetic = jnp.exp(-DRAG * t) * FIELD * jnp.array([v[1], -v[0]])
    return v, magnetic - DRAG * v - jax.grad(trap)(q)


def double_pendulum(t, q, p, args):
    """A double pendulum with unit lengths, masses and gravity."""
    a, b = q
    cos = jnp.cos(a - b)
    kinetic = p[0] ** 2 + 2 * p[1] ** 2 - 2 * p[0] * p[1] * cos
    return kinetic / (2 * (2 - cos**2)) - 2 * jnp.cos(a) - jnp.cos(b)


def black_hole(t, q, p, args):
    """The energy of a unit mass, in units of the mass of the black hole."""
    r = jnp.sqrt(q @ q)
    lapse = 1 - 2 / r
    radial = q @ p / r
    return jnp.sqrt(lapse * (1 + p @ p - 2 / r * radial**2))


def system(energy, gamma):
    return dps.Hamiltonian(energy, dps.ConstantDamping(gamma))


# Hamiltonian, initial state, final time, and the longest step
SYSTEMS = {
    "charged particle": (
        system(charged, DRAG),
        (jnp.array([1.0, 0.0]), jnp.array([0.0, 2.5])),
        (40.0, 0.2),
    ),
    "double pendulum": (
        system(double_pendulum, 0.05),
        (jnp.array([2.0, 1.0]), jnp.array([0.0, 0.0])),
        (20.0, 0.1),
    ),
    "black hole": (
        system(black_hole, 2e-5),
        (jnp.array([16.0, 0.0]), jnp.array([0.0, 0.27])),
        (3000.0, 8.0),
    ),
}
FINDER = optx.Newton(rtol=1e-12, atol=1e-12)
# Schemes, and how many times as many steps they take
SCHEMES = {
    "Gauss, 2 stages": (dps.PresymplecticGauss(2), 1),
    "Gauss, 4 stages": (dps.PresymplecticGauss(4), 1),
    "Tao": (dps.PresymplecticTao(), 10),
    "Midpoint, implicit": (dps.PresymplecticGauss(1, FINDER), 2),
}


def solve(hamiltonian, solver, y0, t1, steps, saveat, max_steps=None) -> Any:
    return dfx.diffeqsolve(
        hamiltonian,
        solver,
        t0=0.0,
        t1=t1,
        dt0=t1 / steps,
        y0=y0,
        saveat=saveat,
        max_steps=max_steps,
        throw=False,
    )


def table(quick):
    print("Error at the final time, and number of steps\n")
    print(f"{'':20}" + "".join(f"{name:>24}" for name in SYSTEMS))
    exact = {}
    for name, (H, y0, (t1, h)) in SYSTEMS.items():
        controller = dfx.PIDController(rtol=1e-12, atol=1e-12)
        sol: Any = dfx.diffeqsolve(
            H,
            dfx.Dopri8(),
            t0=0.0,
            t1=t1,
            dt0=h / 100,
            y0=y0,
            stepsize_controller=controller,
            max_steps=None,
        )
        exact[name] = np.concatenate([np.asarray(y[-1]) for y in sol.ys])
    for scheme, (solver, more) in SCHEMES.items():
        if quick and scheme == "Midpoint, implicit":
            continue
        row = f"{scheme:20}"
        for name, (H, y0, (t1, h)) in SYSTEMS.items():
            steps = round(t1 / h * (1 if quick else 4) * more)
            sol = solve(H, solver, y0, t1, steps, dfx.SaveAt(t1=True))
            end = np.concatenate([np.asarray(y[-1]) for y in sol.ys])
            error = np.max(np.abs(end - exact[name]))
            row += f"{error:>12.1e}{steps:>12}"
        print(row, flush=True)


def against_newton():
    """The largest difference of the positions to a solution of Newton's equation."""
    H, (q0, p0), (t1, _) = SYSTEMS["charged particle"]
    v0 = p0 - vector_potential(0.0, q0)
    ts = jnp.linspace(0.0, t1, 201)
    law: Any = dfx.diffeqsolve(
        dfx.ODETerm(newton),
        dfx.Dopri8(),
        t0=0.0,
        t1=t1,
        dt0=0.01,
        y0=(q0, v0),
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
    )
    solver, saveat = dps.PresymplecticGauss(6), dfx.SaveAt(ts=ts)
    mine = solve(H, solver, (q0, p0), t1, 2000, saveat)
    difference = np.max(np.abs(np.asarray(law.ys[0] - mine.ys[0])))
    print(f"\nCharged particle against Newton's second law: {difference:.1e}")


def picture(path):
    fig, axes = plt.subplots(1, 3, figsize=(14, 4.6), layout="constrained")
    for ax, (name, (H, y0, (t1, h))) in zip(axes, SYSTEMS.items(), strict=True):
        steps = round(t1 / h * 10)
        saveat = dfx.SaveAt(t0=True, steps=True)
        solver = dps.PresymplecticGauss(4)
        sol = solve(H, solver, y0, t1, steps, saveat, steps + 2)
        kept = np.isfinite(np.asarray(sol.ts))
        q = np.asarray(sol.ys[0])[kept]
        if name == "double pendulum":
            a, b = q.T
            q = np.stack([np.sin(a) + np.sin(b), -np.cos(a) - np.cos(b)], 1)
            ax.set_title("double pendulum: the end of the lower arm")
        elif name == "black hole":
            ax.add_patch(Circle((0, 0), 2, color="black"))
            ax.set_title("black hole: an orbit that precesses and shrinks")
        else:
            ax.set_title("charged particle: trap, fading field and drag")
        colors = plt.get_cmap("viridis")(np.linspace(0, 1, 50))
        for part, color in zip(
            np.array_split(np.arange(len(q)), 50), colors, strict=True
        ):
            part = np.append(part, min(part[-1] + 1, len(q) - 1))
            ax.plot(*q[part].T, color=color, lw=1)
        ax.set(xlabel="x", ylabel="y")
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.3)
    fig.suptitle("Three nonseparable systems; time increases from dark to bright")
    fig.savefig(path, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument("--output", type=pathlib.Path, default="nonseparable.png")
    options = parser.parse_args()
    table(options.quick)
    against_newton()
    picture(options.output)
    print(f"\nFigure saved to {options.output}")


if __name__ == "__main__":
    main()
