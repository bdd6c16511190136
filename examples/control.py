"""Throw a ball with air friction to a given target, with the least initial speed.

At a given angle, the speed at which the ball lands on the target is the solution of a
shooting problem. The flight is terminated by an event, when the ball reaches the
ground, and Newton's method differentiates through the event. At the optimal angle the
derivative of the landing position in the angle vanishes, which is a second equation,
with second derivatives through the event. The friction increases from case to case,
each of which starts from the solution of the previous one.

The derivatives are checked against finite differences, and the trajectories against
the exact solution.

    python examples/control.py [--quick] [--output control.png]
"""

import argparse
import pathlib

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

# In metres and seconds. The ball is thrown from two metres above the ground.
GRAVITY, HAND, TARGET, STEP = 9.81, 2.0, 50.0, 0.1
NEWTON = optx.Newton(rtol=1e-12, atol=1e-12)


def potential(t, q, args):
    return GRAVITY * q[1]


def height(t, y, args, **kwargs):
    q, _ = y
    return q[1]


def direction(angle):
    return jnp.array([jnp.cos(angle), jnp.sin(angle)])


def throw(speed, angle, friction, adjoint, dense=False):
    """The flight of a ball of unit mass, until it reaches the ground."""
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(friction)
    )
    return dfx.diffeqsolve(
        system,
        # Order six at the steps and between them, where the event is located.
        dps.BlanesMoanRKN6(),
        t0=0.0,
        t1=100.0,
        dt0=STEP,
        y0=(jnp.array([0.0, HAND]), speed * direction(angle)),
        event=dfx.Event(height, NEWTON, direction=False),
        saveat=dfx.SaveAt(t1=True, dense=dense),
        adjoint=adjoint,
    )


def landing(speed, angle, friction, adjoint):
    sol = throw(speed, angle, friction, adjoint)
    assert sol.ys is not None
    return sol.ys[0][-1, 0]


@jax.jit
def slopes(speed, angle, friction):
    """The landing position and its derivatives, in reverse mode."""
    # `dps.FixedStepAdjoint` does not support events.
    by = jax.value_and_grad(landing, argnums=(0, 1, 2))
    return by(speed, angle, friction, dfx.RecursiveCheckpointAdjoint())


def reach(log_speed, angle, friction):
    """The logarithm of the range, which is nearly linear in the logarithm of speed."""
    place = landing(jnp.exp(log_speed), angle, friction, dfx.ForwardMode())
    return jnp.log(place / TARGET)


@jax.jit
def launch(angle, friction, guess):
    """The speed at which the ball lands on the target."""
    miss = lambda log_speed, _: reach(log_speed, angle, friction)
    return jnp.exp(optx.root_find(miss, NEWTON, jnp.log(guess)).value)


@jax.jit
def best(friction, angle, guess):
    """The angle at which this speed is minimal, and the speed."""

    def miss(unknown, _):
        log_speed, angle = unknown
        # At this speed, the range is maximal at this angle.
        by_angle = lambda angle: reach(log_speed, angle, friction)
        return jax.jvp(by_angle, (angle,), (jnp.ones_like(angle),))

    log_speed, angle = optx.root_find(miss, NEWTON, (jnp.log(guess), angle)).value
    return angle, jnp.exp(log_speed)


@jax.jit
def flight(speed, angle, friction):
    """Times from the throw to the landing, and the positions of the ball."""
    sol = throw(speed, angle, friction, dfx.ForwardMode(), dense=True)
    assert sol.ts is not None
    ts = jnp.linspace(0, sol.ts[-1], 200)
    return ts, jax.vmap(sol.evaluate)(ts)[0]


def exact(t, speed, angle, friction):
    """The position of the ball, by the exact solution."""
    reach = -np.expm1(-friction * t) / friction if friction else t
    drop = GRAVITY * ((t - reach) / friction if friction else t**2 / 2)
    return speed * reach * direction(angle) + np.array([0, HAND - drop])


def check(*throw):
    print("Derivatives of the landing position: ", end="")
    print("through the event, by finite differences")
    for i, (name, slope) in enumerate(
        zip(("speed", "angle", "friction"), slopes(*throw)[1], strict=True)
    ):
        h = 1e-5 * np.eye(3)[i]
        difference = (slopes(*(throw + h))[0] - slopes(*(throw - h))[0]) / 2e-5
        print(f"{name:10}{slope:16.9f}{difference:16.9f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a short run")
    parser.add_argument("--output", type=pathlib.Path, default="control.png")
    options = parser.parse_args()
    frictions, number = ([0.0, 0.3], 9) if options.quick else ([0.0, 0.1, 0.3, 1.0], 99)

    check(*np.array([25.0, 0.8, 0.3]))

    print(f"\nMinimal speeds to reach {TARGET:.0f} m")
    print("friction, 1/s  angle, deg  speed, m/s  flight, s    landing error, m")
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    angles = np.radians(np.linspace(5, 75, number))
    target = np.array([TARGET, 0])
    # The solution without friction, thrown from the ground.
    angle, speed = np.radians(45.0), np.sqrt(GRAVITY * TARGET)
    for friction in np.array(frictions):
        angle, speed = best(friction, angle, speed)
        ts, places = flight(speed, angle, friction)
        off = np.linalg.norm(exact(ts[-1], speed, angle, friction) - target)
        print(f"{friction:13.1f}{np.degrees(angle):12.3f}{speed:12.4f}", end="")
        print(f"{ts[-1]:11.4f}{off:20.1e}")
        label = f"friction {friction:.1f} / s"
        (line,) = left.plot(*np.transpose(places), label=label)
        speeds = [launch(angle, friction, speed) for angle in angles]
        right.plot(np.degrees(angles), speeds, color=line.get_color())
        right.plot(np.degrees(angle), speed, "o", color=line.get_color())
    left.plot(*target, "kx", ms=9, mew=2, label="target", clip_on=False, zorder=3)
    left.set(xlabel="place, m", ylabel="height, m", title="Flights of the least speed")
    left.set_ylim(bottom=0)
    right.set(xlabel="angle, degrees", ylabel="speed, m / s", yscale="log")
    right.set_title("Speed that is needed, and where it is least")
    right.set_yticks([20, 30, 50, 100, 200], ["20", "30", "50", "100", "200"])
    right.minorticks_off()
    left.legend()
    for ax in (left, right):
        ax.grid(alpha=0.3)
    fig.savefig(options.output, dpi=110)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
