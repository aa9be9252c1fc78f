"""A simulated FR3 behind Franka's own network protocol, at port 1337 of an address.

This is run by the Python of the environment that `make_environment` makes; `simulated_franka.py`
starts and stops it. It is the server of franka-sim with all that it enforces, but

- physics go on with each state that is sent, as in the robot. By itself the package steps by a
  clock of its own: on a busy machine the arm then moves farther than its time stamps say, by a
  fifth and more.
- the arm is that of the URDF that it is given. What hangs on its last link has a weight that the
  robot does not know of, and does not compensate.
- velocities are integrated, and the positions held, as the robot does it. The package's servo of
  velocities alone sinks under a weight, and swings at 1 ms on an arm with light links.
"""

import argparse
import contextlib
import logging
import os
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import franka_sim
import mujoco
import numpy as np
from franka_sim.control_modes import ControlMode
from franka_sim.franka_sim_server import FrankaSimServer
from franka_sim.mujoco_franka_sim import ARM_POSITION_KD, ARM_POSITION_KP, MujocoFrankaSim
from franka_sim.sim_common import FR3_FORCE_LIMITS

URDF = Path(franka_sim.__file__).parent / "models" / "fr3.urdf"
LAST = "link8"
PERIOD, STEPS = 1e-3, 2  # of states [s], and steps of physics in it


class Arm(MujocoFrankaSim):
    """The arm of a URDF; somebody else steps its physics."""

    def __init__(self, urdf, armature, friction, damping):
        self._folder = tempfile.TemporaryDirectory(prefix="fr3-")
        path = Path(self._folder.name, "arm.xml")
        path.write_text(mjcf_of(urdf, armature, friction, damping), encoding="utf-8")
        super().__init__(model_path=path)
        self.dt = PERIOD / STEPS
        self._held = None  # where velocities have led the joints to

    def initialize_simulation(self):
        """As the package's, but what the last link holds has weight."""
        super().initialize_simulation()
        loads = {LAST}
        for i in range(1, self.model.nbody):  # parents come before children
            if self.model.body(self.model.body_parentid[i]).name in loads:
                loads.add(self.model.body(i).name)
                self.model.body_gravcomp[i] = 0.0

    def arm_control_torque(self):
        """As the package's, but velocities are integrated."""
        if self.control_mode is not ControlMode.VELOCITY:
            self._held = None
            return super().arm_control_torque()
        q, v = self.data.qpos[self.arm_qpos_adr], self.data.qvel[self.arm_dofs_idx]
        wanted = self.latest_joint_velocities
        self._held = (q.copy() if self._held is None else self._held) + self.dt * wanted
        tau = ARM_POSITION_KP * (self._held - q) + ARM_POSITION_KD * (wanted - v)
        return np.clip(tau, -FR3_FORCE_LIMITS, FR3_FORCE_LIMITS)

    def run_simulation(self):
        """Say that the server listens, and leave the steps to it, until nobody wants it."""
        print("ready", flush=True)
        sys.stdin.read()


class Server(FrankaSimServer):
    """Lets the arm go on by a period with each state that it sends."""

    def _account_for_communication_cycle(self):
        super()._account_for_communication_cycle()  # the last thing before it sends
        self.physics_sim.step(STEPS)


def mjcf_of(urdf, armature, friction, damping):
    """Return the arm of a URDF for MuJoCo, without its meshes."""
    root = ElementTree.parse(urdf).getroot()
    for link in root.iter("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    for options in root.findall("mujoco"):
        root.remove(options)
    options = ElementTree.SubElement(root, "mujoco")
    ElementTree.SubElement(options, "compiler", fusestatic="false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    for joint in spec.joints:
        joint.armature, joint.frictionloss, joint.damping = armature, friction, damping
    spec.compile()
    return spec.to_xml()


def like_a_robot():
    """Take a processor for itself, where the system allows that: a robot has its own."""
    processors = os.sched_getaffinity(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not that of its client
        if len(processors) > 1:
            os.sched_setaffinity(0, {max(processors)})
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))


def main():
    """Serve until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("urdf", nargs="?", default=URDF, help="arm with what it holds")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at")
    parser.add_argument("--armature", type=float, default=0.1, help="of each joint [kg m^2]")
    parser.add_argument("--friction", type=float, default=0.2, help="Coulomb's [N m]")
    parser.add_argument("--damping", type=float, default=0.003, help="[N m s]")
    parser.add_argument("--where", action="store_true", help="print the URDF of the bare arm")
    given = parser.parse_args()
    if given.where:
        print(URDF)
        return
    like_a_robot()
    logging.basicConfig(level=logging.WARNING)
    server = Server(
        host=given.host,
        physics_sim=Arm(given.urdf, given.armature, given.friction, given.damping),
        urdf_path=URDF,  # what the robot knows of itself
        enable_gripper=False,
        enforce_comm_constraints=True,
        enforce_motion_limits=True,
    )
    try:
        server.start()
    finally:
        server.stop()


if __name__ == "__main__":
    main()
