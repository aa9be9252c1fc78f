"""A Panda with an unknown tool, watched by a camera that nobody calibrated.

You will see: two points of a 15 cm tool, of which the controller knows nothing, brought to their
targets in an image. The controller believes the camera rolled by 20 degrees, with a focal length
wrong by 30 % and the scene 1.5 times as far away. Images come 30 times a second, late and with
noise of half a pixel; between them the law goes on with the last one. The errors end below that
noise.

You will learn: how images take the place of positions, and what a slow camera needs around a law.

    python examples/09_a_camera_in_the_room.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity
from approxjac.robots import GravityRegressor
from approxjac.tasks import CombinedTask

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.15, 0.3), arm.with_object(0.0)
points = [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0)]  # of the tool: its tip, and one beside it [m]

camera = aj.PinholeCamera.looking_at(
    (0.45, 0.0, 0.4), (1.5, -0.8, 0.9), focal_length=600.0, size=(640, 480), distortion=(-0.1,)
)
wrong = aj.PinholeCamera(600.0, (640, 480), camera.position, camera.rotation).with_error(
    shift=(0.0, 0.0, -0.7), rotation=(0.0, 0.0, np.radians(20.0)), focal_factor=1.3
)
sensor, task = (
    aj.ImageTask(truth, camera, points=points),
    aj.ImageTask(belief, wrong, points=points),
)

start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
goal = np.array([0.5, -0.1, -0.2, -2.2, 0.2, 2.1, 0.3])
target = sensor.value(goal)  # an image: what of the arm it takes to get there is not used

regressor = GravityRegressor(belief)
gravity = RegressorGravity(regressor, regressor.fit(truth)[0])  # known from elsewhere
task = CombinedTask.balanced(task, target)  # all directions of an error count alike
law = aj.SetpointController(task, aj.default_gains(task, settling_time=1.5), gravity=gravity)
held = aj.HeldMeasurement(law, unseen=40.0)  # beyond 40 px of motion without an image it brakes

vision = aj.Sensing(x_rate=30.0, x_delay=0.03, x_noise=0.5)
plant = aj.Plant(truth, sensor, sensing=vision, torque_limits=truth.effort_limits)
run = aj.simulate(
    plant,
    held,
    target,
    start,
    12.0,
    dt=2e-3,
    computation=aj.simulation.Computation("semi_implicit_euler"),
)
last = run.error[run.t > 11.0]
print(run)
print(f"RMS of each coordinate over the last second: {np.sqrt((last**2).mean(axis=0)).round(2)} px")

figure, axes = view.new_figure(2, title="Two points of an unknown tool, in an uncalibrated camera")
view.plot_image(run, camera, axes[0], title="Paths of the points in the true camera's image")
view.plot_error(run, axes[1])
print(*view.save_figure(figure, out / "09_camera_in_the_room"), sep="\n")
title = "Two points of an unknown tool, seen by a camera that nobody calibrated"
print(view.save_page(run, out / "09_camera_in_the_room.html", title))
print(view.write_index(out))
