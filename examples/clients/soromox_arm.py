"""A chain of four links with elastic and damped joints, with soromox.

Needs `pip install soromox`. Prints the largest error of the angles over 5 s, compared
with a rollout of soromox at a small tolerance.

    python examples/clients/soromox_arm.py
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# pyright: reportOptionalSubscript=false

import diffrax as dfx
import jax
import jax.numpy as jnp
from soromox.systems.pendulum import Pendulum, PendulumParams
from soromox.systems.system_state import SystemState

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

n = 4
robot = Pendulum(
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
q0, v0 = jnp.array([1.0, 0.5, -0.3, 0.2]), jnp.zeros(n)

system = dps.LagrangianSystem(
    mass_matrix=lambda t, q, args: robot.inertia_matrix(q),
    potential=lambda t, q, args: robot.potential_energy(q),
    friction=dps.ViscousDamping(robot.damping_matrix(q0)),  # constant for this robot
)
ts = jnp.linspace(0.0, 5.0, 101)
sol = dfx.diffeqsolve(
    system,
    dps.PresymplecticGauss(6),
    t0=0.0,
    t1=5.0,
    dt0=0.01,
    y0=system.from_velocity(0.0, (q0, v0)),
    saveat=dfx.SaveAt(ts=ts),
    adjoint=dps.FixedStepAdjoint(),
)

rollout = robot.rollout_to(
    SystemState(t=jnp.array(0.0), y=jnp.concatenate([q0, v0])),
    t1=5.0,
    solver_dt=1e-3,
    save_ts=ts,
    solver=dfx.Dopri8(),
    stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
    max_steps=100_000,
)
error = jnp.abs(sol.ys[0] - rollout.y[:, :n]).max()
print(f"largest error {error:.1e} radians")
assert error < 1e-7
