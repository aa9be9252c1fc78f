"""The paper's two-link arm, watched by a camera that is believed to be rolled by 60 degrees.

You will see: the same camera, in truth not rolled, and two gain ratios a = K_p / K_v. With a = 1
the arm never settles (the paper's Figure 3), with a = 0.5 it does (Figure 4), and the eigenvalues
of the linearised closed loop say so before anything moves: their largest real part is positive with
a = 1 and negative with a = 0.5.

You will learn: that the gains decide how wrong a Jacobian may be, and how to ask before running.

    python examples/02_camera_nobody_calibrated.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.cameras import PlanarCamera
from approxjac.tasks import FrameKinematics

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("two_link").with_object(length=0.5, mass=0.5, radius=0.0, axis="x")
true_camera = PlanarCamera(focal_length=0.05, distance=3.0)
believed_camera = PlanarCamera(focal_length=0.05, distance=3.0, roll=np.radians(60.0))
plant = aj.Plant(arm, sensor=aj.ImageTask(arm, true_camera))

start, goal = np.radians([60.0, 90.0]), np.radians([90.0, 90.0])
target, reached = plant.sensor.value(goal), FrameKinematics(arm, arm.tip).position(goal)

figure, axes = view.new_figure(
    columns=2, rows=2, title="A camera that is believed to be rolled by 60°, and is not"
)
axes[2].sharey(axes[0])  # errors at one scale
for left, right, kv in ((axes[0], axes[1], 5000.0), (axes[2], axes[3], 10000.0)):
    controller = aj.SetpointController(
        aj.ImageTask(arm, believed_camera), aj.Gains(kp=5000.0, kv=kv)
    )
    local = aj.local_stability(plant, controller, goal)
    # dt is not given: (q, v) are integrated as one differential equation, as in the paper.
    run = aj.simulate(plant, controller, target, start, duration=60.0, dt=None)
    said = "stable" if local.stable else "unstable"
    print(f"a = {5000.0 / kv:g}: max Re λ = {local.max_real_eigenvalue:+.4f} 1/s ({said}); {run}")
    view.plot_error(run, left, title=f"Error in the image, a = {5000.0 / kv:g}: {said}")
    title = f"Path of the tip, a = {5000.0 / kv:g}"
    view.plot_path(run, arm, target=reached, ax=right, title=title)

print(*view.save_figure(figure, out / "02_uncalibrated_camera"), sep="\n")
title = "A camera that is believed to be rolled by 60°, and is not: a = 0.5 settles"
print(view.save_page(run, out / "02_uncalibrated_camera.html", title))
print(view.write_index(out))
