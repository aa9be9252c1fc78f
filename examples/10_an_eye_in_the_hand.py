"""A camera on the hand of a UR5, and two laws with the same wrong model of it.

You will see: the paper's law (6) and classical velocity control, both with the same wrong camera
(rolled by 20 degrees, focal length wrong by 30 %), bring two points of the room to their targets in
the image. Neither knows where the points are: both always take them to be 1.5 times as far away as
they are at the goal. Both arrive; the torque of the classical law shakes with each image.

You will learn: how a camera is mounted on the arm, and how to compare laws on the same plant.

    python examples/10_an_eye_in_the_hand.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np
from studies.velocity_servo import VelocityServo

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity
from approxjac.robots import GravityRegressor
from approxjac.tasks import CombinedTask, FrameKinematics

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("ur5")
truth, belief = arm.with_object(0.1, 0.3, axis="y"), arm  # its load is not known either

# 5 cm before the flange, and looks sideways: along tool0's y axis, which points up at the goal.
# (Out of the arm points tool0's z axis.)
axes_of_camera = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
camera = aj.PinholeCamera(600.0, (640, 480), (0.0, 0.0, 0.05), axes_of_camera, mount="tool0")
wrong = camera.with_error(rotation=(0.0, 0.0, np.radians(20.0)), focal_factor=1.3)

# Two points of the room, 40 cm before the camera at the goal.
goal = np.array([0.0, -1.2, 1.8, -0.6, 0.3, 0.0])
start = goal + [0.18, 0.15, -0.19, 0.13, 0.36, -0.23]
in_camera = np.array([[-0.1, 0.02, 0.4], [0.1, -0.02, 0.4]])
R, p = FrameKinematics(truth, "tool0").placement(goal)
points = (in_camera @ axes_of_camera.T + camera.position) @ R.T + p

sensor = aj.ImageTask(truth, camera, points=points)
task = aj.ImageTask(belief, wrong, points=points, depth=0.6)  # in truth 0.4 m, at the goal
target = sensor.value(goal)
task = CombinedTask.balanced(task, target)

regressor = GravityRegressor(belief)
gravity = RegressorGravity(regressor, regressor.fit(truth)[0])  # known from elsewhere
laws = {
    "law (6)": aj.SetpointController(
        task, aj.default_gains(task, settling_time=1.5), gravity=gravity
    ),
    "classical": VelocityServo(task, rate=4.0 / 1.5, gravity=gravity),
}
vision = aj.Sensing(x_rate=30.0, x_delay=0.03, x_noise=0.5)
plant = aj.Plant(truth, sensor, sensing=vision, torque_limits=truth.effort_limits)

figure, axes = view.new_figure(
    3,
    2,
    size=(15.0, 10.0),
    title="A camera on the hand, calibrated badly: law (6) above, the classical law below",
)
axes[5].sharey(axes[2])  # torques at one scale
runs = {}
for row, (name, law) in enumerate(laws.items()):
    held = aj.HeldMeasurement(law, unseen=40.0)
    run = runs[name] = aj.simulate(
        plant,
        held,
        target,
        start,
        5.0,
        dt=2e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    print(f"{name}: {run}")
    view.plot_image(run, camera, axes[3 * row], title=f"Paths in the image: {name}")
    view.plot_error(run, axes[3 * row + 1], title=f"Task error: {name}")
    view.plot_torque(run, axes[3 * row + 2], title=f"Torque: {name}")
print(*view.save_figure(figure, out / "10_eye_in_the_hand"), sep="\n")
title = "A camera on the hand, calibrated badly: law (6)"
print(view.save_page(runs["law (6)"], out / "10_eye_in_the_hand.html", title))
print(view.write_index(out))
