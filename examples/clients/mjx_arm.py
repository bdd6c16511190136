"""An arm of three links with damped joints, with MJX.

Needs `pip install mujoco mujoco-mjx`. Prints the largest error of the angles over 5 s,
compared with the RK4 integrator of MuJoCo at a small step.

    python examples/clients/mjx_arm.py
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# pyright: reportOptionalSubscript=false

import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

XML = """
<mujoco>
  <option timestep="0.0005" integrator="RK4"><flag contact="disable"/></option>
  <default>
    <joint type="hinge" axis="0 1 0" damping="0.05" armature="0.01"/>
    <geom type="capsule" size="0.03" mass="0.5"/>
  </default>
  <worldbody>
    <body>
      <joint/><geom fromto="0 0 0 0 0 -0.4"/>
      <body pos="0 0 -0.4">
        <joint axis="1 0 0"/><geom fromto="0 0 0 0 0 -0.3"/>
        <body pos="0 0 -0.3">
          <joint stiffness="0.5"/><geom fromto="0 0 0 0 0 -0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

model = mujoco.MjModel.from_xml_string(XML)
arm = mjx.put_model(model)
data = mjx.make_data(arm)


def placed(q):
    return mjx.com_pos(arm, mjx.kinematics(arm, data.replace(qpos=q)))


def mass_matrix(t, q, args):
    return mjx.full_m(arm, mjx.crb(arm, placed(q)))


def potential(t, q, args):
    weight = -jnp.sum(arm.body_mass * (placed(q).xipos @ arm.opt.gravity))
    return weight + jnp.sum(arm.jnt_stiffness * (q - arm.qpos_spring) ** 2) / 2


damping = dps.ViscousDamping(arm.dof_damping)
system = dps.LagrangianSystem(mass_matrix, potential, damping)
q0, ts = jnp.array([1.2, 0.4, -0.5]), jnp.linspace(0.0, 5.0, 101)
start = time.perf_counter()
sol = dfx.diffeqsolve(
    system,
    dps.PresymplecticGauss(4),
    t0=0.0,
    t1=5.0,
    dt0=0.01,
    y0=(q0, jnp.zeros(3)),
    saveat=dfx.SaveAt(ts=ts),
    adjoint=dps.FixedStepAdjoint(),
)
jax.block_until_ready(sol.ys)
print(f"compiled and run in {time.perf_counter() - start:.0f} s")

state = mujoco.MjData(model)
state.qpos[:] = q0
angles = [np.array(q0)]
for _ in ts[1:]:
    mujoco.mj_step(model, state, 100)
    angles.append(state.qpos.copy())
error = np.abs(sol.ys[0] - np.array(angles)).max()
print(f"largest error {error:.1e} radians")
assert error < 1e-8
