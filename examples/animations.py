"""Animations of a planet that spirals in and of a chain with dampers in its joints.

Saves `planet.webp` and `chain.webp` into `--folder` and prints their sizes. `--quick`
draws a few frames only.
"""

import argparse
import pathlib

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import diffrax_presym as dps


matplotlib.use("Agg")
import matplotlib.animation as animation
import matplotlib.pyplot as plt


jax.config.update("jax_enable_x64", True)

LINKS = 6


def planet(ts):
    """An orbit of eccentricity 0.6 around a star, in a thin gas."""
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: -1 / jnp.linalg.norm(q),
        dps.ConstantDamping(0.015),
    )
    sol = dfx.diffeqsolve(
        system,
        dps.TunedRKN6(),
        t0=0.0,
        t1=ts[-1],
        dt0=None,
        y0=(jnp.array([1.6, 0.0]), jnp.array([0.0, 0.5])),  # apocentre
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=dps.StepDensityController(0.05, system),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )
    return jax.device_get(sol.ys)[0]


def chain(ts):
    """The ends of links of unit length and mass, released at rest, for each time."""
    ones = jnp.eye(LINKS) - jnp.eye(LINKS, k=-1)  # from angles to those of the joints
    below = LINKS - jnp.maximum(*jnp.indices((LINKS, LINKS)))

    def mass_matrix(t, q, args):
        return below * jnp.cos(q[:, None] - q)

    def height(t, q, args):
        return -9.81 * jnp.sum(jnp.diagonal(below) * jnp.cos(q))

    dampers = dps.ViscousDamping(2.0 * ones.T @ ones)
    arm = dps.LagrangianSystem(mass_matrix, height, dampers)
    sol = dfx.diffeqsolve(
        arm,
        dps.PresymplecticGauss(4),
        t0=0.0,
        t1=ts[-1],
        dt0=0.02,
        y0=(jnp.full(LINKS, 2.0), jnp.zeros(LINKS)),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )
    q, _ = jax.device_get(sol.ys)
    links = np.stack([np.sin(q), -np.cos(q)], axis=-1)
    return np.concatenate([np.zeros((len(q), 1, 2)), np.cumsum(links, axis=1)], axis=1)


def save(path, lines, trails, limits):
    """A frame for each line, with the trail behind its last point."""
    fig, axes = plt.subplots(figsize=(3.2, 3.2), layout="constrained")
    axes.set(xlim=limits[:2], ylim=limits[2:], aspect="equal", xticks=[], yticks=[])
    (trail,) = axes.plot([], [], color="0.7", lw=0.8)
    axes.plot(0, 0, "o", color="#f9a825", ms=9)
    (line,) = axes.plot([], [], "o-", color="#3f51b5", ms=5, lw=2)

    def draw(frame):
        trail.set_data(*trails[frame].T)
        line.set_data(*lines[frame].T)

    writer = animation.PillowWriter(fps=20)
    animation.FuncAnimation(fig, draw, frames=len(lines)).save(path, writer, dpi=90)
    plt.close(fig)
    print(f"{path}: {len(lines)} frames, {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("."))
    options = parser.parse_args()
    frames = 3 if options.quick else 160

    fine = 20  # points of the orbit in a frame
    orbit = planet(np.linspace(0.0, 55.0, fine * frames))
    save(
        options.folder / "planet.webp",
        [orbit[[k]] for k in range(0, len(orbit), fine)],
        [orbit[: k + 1] for k in range(0, len(orbit), fine)],
        (-0.9, 1.8, -1.35, 1.35),
    )

    links = chain(np.linspace(0.0, 8.0, frames))
    tips = links[:, -1]
    save(
        options.folder / "chain.webp",
        links,
        [tips[max(0, k - 12) : k + 1] for k in range(frames)],
        (-6.5, 6.5, -6.8, 6.2),
    )
