"""Friction of a joint in MuJoCo: LuGre decides the torque at each step of a pendulum that comes to rest.

    pip install mujoco
    python examples/python/mujoco_joint.py

Both take the same step. The torque is applied as MuJoCo applies that of a motor, and the energy that the pendulum loses is
compared with the work of friction: what is left over is the drift of the two steps together. Friction of MuJoCo's own
(`frictionloss`) and damping are 0.
"""

import mujoco
import numpy as np

import fric

JOINT = """
import std.friction

/// A joint with friction: angular speed in, torque out.
model Joint {
  input  w [rad/s]
  part   fr = rotary LuGre(
           v = w, sigma0 = 260 N·m/rad, sigma1 = 0.6 N·m·s/rad, sigma2 = 0.018 N·m·s/rad,
           Fc = 0.28 N·m, Fs = 0.34 N·m, vs = 0.01 rad/s, vd = 0.1 rad/s)
  output torque [N·m] = fr.F
}
"""

PENDULUM = """
<mujoco>
  <option timestep="{step}" integrator="Euler"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""


def swing(step: float = 1e-4, duration: float = 8.0, angle: float = 1.2) -> dict[str, float]:
    """Lets the pendulum go at an angle; returns the angle at the end, energies in J, and the drift relative to the loss."""
    world = mujoco.MjModel.from_xml_string(PENDULUM.format(step=step))
    world.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(world)
    data.qpos[0] = angle
    mujoco.mj_forward(world, data)
    first = data.energy.sum()
    joint = fric.loads(JOINT).model("Joint").start(step=step, outputs=["torque"])
    work, angles = 0.0, []
    for _ in range(round(duration / step)):
        torque = joint.step(data.qvel[0])
        data.qfrc_applied[0] = -torque
        before = data.qpos[0]
        mujoco.mj_step(world, data)
        work += torque * (data.qpos[0] - before)
        angles.append(data.qpos[0])
    mujoco.mj_forward(world, data)
    lost = first - data.energy.sum()
    return {"angle": float(np.array(angles)[-1]), "speed": float(data.qvel[0]), "lost": float(lost), "work": float(work)}


def main() -> None:
    """Prints the balance for two steps: the drift falls with the step."""
    print(f"{'step':>9} {'rests at':>10} {'lost':>10} {'friction':>10} {'drift':>9}")
    for step in (4e-4, 2e-4, 1e-4):
        found = swing(step)
        drift = found["lost"] / found["work"] - 1
        print(f"{1e3 * step:6.1f} ms {found['angle']:8.4f} rad {found['lost']:8.4f} J {found['work']:8.4f} J {drift:9.1e}")


if __name__ == "__main__":
    main()
