"""Gravity of one's own, compiled, written as C and tried a thousand times.

You will see: a Panda that carries a camera of 0.8 kg on its wrist, which its URDF lacks. With the
model's gravity it comes to rest beside the target; with the model's and the camera's, as a class of
ten lines says it, it arrives. Both as machine code, and 1000 runs of arms that are built a little
otherwise.

You will learn: how to tell a law of a weight that no URDF has, from the Jacobian of a frame.

    python examples/21_own_gravity.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.codegen import compiled
from approxjac.controllers import ModelGravity
from approxjac.tasks import FrameKinematics

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)
STANDARD = 9.81  # m/s²


class WithCamera(ModelGravity):
    """Gravity of the model, and of a point mass at the origin of a frame."""

    def __init__(self, robot, frame, mass):
        super().__init__(robot)
        self.mass, self._frame = mass, FrameKinematics(robot, frame)

    def torque(self, q):
        """Return the gravity torque at q [N m]."""
        upwards = self._frame.jacobian(q)[2]
        return super().torque(q) + STANDARD * self.mass * upwards


arm, mass = aj.load_robot("panda"), 0.8
# in truth the tip carries a camera; the arm of the URDF, which the law believes in, carries none
truth, belief = (arm.with_object(0.0, each, axis="x") for each in (mass, 0.0))
errors = aj.Uncertainty(truth, joint_shifts={"panda_joint4": [0.01, 0.0, 0.01]})
plant, task = aj.Plant(truth), aj.PositionTask(belief)
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
target = plant.sensor.value(start) + [0.10, -0.20, 0.15]
region = aj.JointBox.around(truth, start, 0.3)
options = {
    "duration": 4.0,
    "dt": 1e-3,
    "computation": aj.simulation.Computation("semi_implicit_euler"),
}

figure, (left, right) = view.new_figure(2, title="A weight that no URDF has")
for name, gravity in (
    ("model", ModelGravity(belief)),
    ("model and camera", WithCamera(belief, belief.tip, mass)),
):
    law = aj.SetpointController(task, gravity=gravity)
    run, plain = (
        aj.simulate(plant, each, target, start, **options) for each in (compiled(law), law)
    )
    many = aj.Study(law, errors, region, duration=4.0).rollouts(1000)
    print(
        f"{name}: {1e3 * run.error_norm[-1]:.1f} mm away; machine code and Python differ by "
        f"{np.abs(run.tau - plain.tau).max():.0e} N m; half of 1000 runs end within "
        f"{1e3 * np.median(many.columns['final_error']):.1f} mm, in {many.setting.engine}"
    )
    with view.style():
        left.semilogy(run.t, run.error_norm, label=name)
        right.hist(1e3 * many.columns["final_error"], bins=40, label=name)
print(aj.export_c(law, out / "21_own_gravity"))
with view.style():
    left.set(xlabel="time [s]", ylabel="error [m]", title="Error of a reach")
    right.set(xlabel="final error [mm]", ylabel="runs", title="1000 other arms and reaches")
    view.legend_below(left)
    view.legend_below(right)
print(*view.save_figure(figure, out / "21_own_gravity"), sep="\n")
print(
    view.save_page(
        run,
        out / "21_own_gravity.html",
        "A weight that no URDF has: gravity of the model and of the camera",
    )
)
print(view.write_index(out))
