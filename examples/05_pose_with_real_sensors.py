"""A Panda brings the pose of an unknown tool to its target, with imperfect sensors and joints.

You will see: position and orientation reach their targets, six coordinates for seven joints. The
pose is measured with noise, 10 ms late, and a tenth of the samples is lost; q̇ comes from filtered
differences of encoder readings, not from a tachometer; torques act 1 ms late; the joints have
friction that the controller does not know.

You will learn: how to make a simulated plant as bad as your robot, and how gains allow for that.

    python examples/05_pose_with_real_sensors.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("panda")
truth = arm.with_object(length=0.15, mass=0.4)
belief = arm.with_object(length=0.0, mass=0.0)
plant = aj.Plant(
    truth,
    sensor=aj.PoseTask(truth),
    friction=aj.robots.Friction(0.5, coulomb=0.2),
    sensing=aj.Sensing(
        x_noise=[5e-4] * 3 + [2e-3] * 3,  # m, rad
        x_delay=0.010,
        x_dropout=0.1,
        q_quantum=1e-5,
        velocity_filter=0.003,
    ),
    actuator_delay=0.001,
)
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
target = plant.sensor.value(start + [0.3, 0.2, -0.2, 0.3, 0.4, -0.3, 0.8])

# The damping may not be faster than q̇ is known and torques act: 1 ms + 3 ms + 1 ms.
task = aj.PoseTask(belief)
controller = aj.SetpointController(
    task,
    aj.default_gains(task, settling_time=1.0, bandwidth=200.0),
    gravity=aj.AdaptiveGravity(belief),
)
run = aj.simulate(plant, controller, target, start, duration=5.0, dt=1e-3, seed=1)
position, turn = run.error[:, :3], run.error[:, 3:]
print(run)
print(
    f"position {1e3 * np.linalg.norm(position[0]):.0f} -> "
    f"{1e3 * np.linalg.norm(position[-1]):.2g} mm, orientation "
    f"{np.degrees(np.linalg.norm(turn[0])):.0f} -> {np.degrees(np.linalg.norm(turn[-1])):.2g} deg"
)

title = "A Panda turns an unknown 15 cm tool, with sensors as they are"
figure, (left, middle, right) = view.new_figure(3, title=title)
for i, label in enumerate("xyz"):
    left.plot(run.t, 1e3 * position[:, i], color=view.SERIES[i], label=label)
    middle.plot(run.t, np.degrees(turn[:, i]), color=view.SERIES[i], label=f"r{label}")
with view.style():
    left.set(xlabel="time [s]", ylabel="$p - p_d$ [mm]", title="True error of the position")
    middle.set(
        xlabel="time [s]", ylabel=r"$\log(R R_d^T)$ [deg]", title="True error of the orientation"
    )
for ax in (left, middle):
    ax.set_xlim(run.t[0], run.t[-1])
    ax.axhline(0.0, color=view.COLORS["neutral"], linewidth=0.8)
    view.legend_below(ax)
view.plot_torque(run, right, limits=truth.effort_limits)
print(*view.save_figure(figure, out / "05_panda_pose"), sep="\n")
print(view.save_page(run, out / "05_panda_pose.html", title))
print(view.write_index(out))
