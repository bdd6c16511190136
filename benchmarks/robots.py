"""A robot of soromox, stepped by this package and by the solvers that soromox uses.

A chain of links with elastic and damped joints, saved at 101 times. Both sides use the
same inertia matrix and energy, those of soromox, whose own simulation integrates an
acceleration with solvers of Diffrax. The error is the largest one of the angles.

Needs `pip install "diffrax_presym[robots]"`.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from functools import partial

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _solve import states
from _timing import error_curves, least_to

import diffrax_presym as dps


TARGETS = (1e-3, 1e-6, 1e-9)
SPAN = 5.0
TS = jnp.linspace(0.0, SPAN, 101)
SAVEAT = dfx.SaveAt(ts=TS, fn=lambda t, y, args: y[0])


def pendulum(n):
    from soromox.systems.pendulum import Pendulum, PendulumParams

    return Pendulum(
        PendulumParams(
            mass=jnp.full(n, 0.3),
            moment_inertia=jnp.full(n, 0.002),
            length=jnp.full(n, 0.3),
            center_of_mass_length=jnp.full(n, 0.15),
            radius=jnp.full(n, 0.02),
            gravity=jnp.array([9.81, 0.0]),
            joint_stiffness=0.5 * jnp.eye(n),
            joint_damping=0.02 * jnp.eye(n),
            joint_rest_configuration=jnp.zeros(n),
        )
    )


def theirs(robot, q0, solver, tolerance):
    from soromox.systems.system_state import SystemState

    rollout = robot.rollout_to(
        SystemState(t=jnp.array(0.0), y=jnp.concatenate([q0, jnp.zeros_like(q0)])),
        t1=SPAN,
        solver_dt=1e-3,
        save_ts=TS,
        solver=solver,
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000,
    )
    return rollout.y[:, : len(q0)]


def main():
    options = command_line(__doc__).parse_args()
    sizes = (2,) if options.quick else (2, 4, 8)
    try:
        import soromox  # noqa: F401
    except ImportError:
        print('Not installed. Write: pip install "diffrax_presym[robots]"')
        return
    schemes = {
        f"PresymplecticGauss({n}), {tolerance:.0e}": dps.PresymplecticGauss(
            n, tolerance=tolerance
        )
        for n, tolerance in ((4, 0.0), (6, 0.0), (4, 1e-5), (4, 1e-8), (6, 1e-11))
    }
    counts = [50.0 * 2**k for k in range(3 if options.quick else 6)]
    tolerances = 10.0 ** -np.arange(3, 6 if options.quick else 13)
    for n in sizes:
        robot = pendulum(n)
        q0 = jnp.linspace(1.0, 0.2, n)
        system = dps.LagrangianSystem(
            mass_matrix=lambda t, q, args, robot=robot: robot.inertia_matrix(q),
            potential=lambda t, q, args, robot=robot: robot.potential_energy(q),
            # The coefficients are constant for this robot.
            friction=dps.ViscousDamping(robot.damping_matrix(q0)),
        )
        runs, start = {}, (q0, jnp.zeros_like(q0))
        for name, solver in schemes.items():
            run = partial(states, system, solver, (0.0, SPAN), start, saveat=SAVEAT)
            runs[name] = eqx.filter_jit(run), [jnp.asarray(x) for x in counts]
        for solver in (dfx.Tsit5(), dfx.Dopri5(), dfx.Dopri8()):
            run = eqx.filter_jit(partial(theirs, robot, q0, solver))
            name = f"soromox, {type(solver).__name__}"
            runs[name] = run, [jnp.asarray(x) for x in tolerances]
        exact = theirs(robot, q0, dfx.Dopri8(), 1e-13)
        error = lambda q, exact=exact: float(jnp.max(jnp.abs(q - exact)))
        curves = error_curves(runs, error, 2 if options.quick else 5)
        table = Table(
            f"{n} links: milliseconds to an error in radians",
            *("solver:<30", *(f"{target:.0e}:>9.2f" for target in TARGETS)),
        )
        for name, curve in curves.items():
            times = (least_to(curve, target) for target in TARGETS)
            table.row(name, *(1e3 * x for x in times))


if __name__ == "__main__":
    main()
