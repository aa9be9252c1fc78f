"""Panda, xArm7 and Talos' arm bring an unknown tool to a target, and their elbows towards home.

You will see: seven joints for three task coordinates leave a self-motion. Added joint damping
brings it to rest anywhere; a posture torque, projected so that the task does not feel it, draws the
arm towards home, as far as a tip at the target allows. The target is reached either way, because at
rest the two torques cannot balance each other.

You will learn: what joints do that the task does not need, and how to place the elbow.

    python examples/04_seven_joints_keep_their_posture.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import Posture, RegressorGravity
from approxjac.robots import GravityRegressor

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

# a posture in the middle of the joint ranges, and the tool that each arm carries
ARMS = {
    "panda": ([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], {"length": 0.20, "mass": 0.5}),
    "xarm7": ([0.0, -0.3, 0.0, 1.2, 0.0, 1.5, 0.0], {"length": 0.20, "mass": 0.5}),
    "talos_arm": (
        [0.2, 0.5, 0.0, -1.4, 0.0, 0.0, 0.0],
        {"length": 0.20, "mass": 0.3, "axis": "-z"},
    ),
}
PUSHED = np.array([0.3, 0.2, -0.5, -0.2, 0.4, 0.2, 0.0])  # how far from home an arm starts
POSTURE, COLORS = 10.0, {"damped only": view.SERIES[1], "posture kept": view.SERIES[0]}

figure, axes = view.new_figure(3, 2, title="Seven joints, three coordinates, an unknown tool")
for column, (name, (home, tool)) in enumerate(ARMS.items()):
    arm = aj.load_robot(name)
    truth, belief = arm.with_object(**tool), arm.with_object(length=0.0, mass=0.0)
    plant, task = aj.Plant(truth, sensor=aj.PositionTask(truth)), aj.PositionTask(belief)
    target = plant.sensor.value(np.array(home)) + [0.05, 0.05, -0.05]
    regressor = GravityRegressor(belief)  # the tool's weight is known here, its length is not
    gravity = RegressorGravity(regressor, regressor.fit(truth)[0])
    error, away = axes[column], axes[3 + column]
    for label, posture in (("damped only", None), ("posture kept", Posture(home, POSTURE))):
        controller = aj.SetpointController(task, gravity=gravity, posture=posture)  # default gains
        run = aj.simulate(plant, controller, target, home + PUSHED, duration=5.0, dt=2e-3)
        distance = np.linalg.norm(run.q - home, axis=1)
        print(
            f"{name}, {label}: error {1e3 * run.error_norm[0]:.0f} -> "
            f"{1e3 * run.error_norm[-1]:.3f} mm, joints {distance[0]:.2f} -> {distance[-1]:.2f} "
            f"rad from home, still moving at {np.linalg.norm(run.v[-1]):.1g} rad/s"
        )
        if posture is not None:
            title = f"{name}: the tool is unknown, the posture is kept"
            print(view.save_page(run, out / f"04_seven_joints_{name}.html", title))
        error.semilogy(run.t, 1e3 * run.error_norm, color=COLORS[label], label=label)
        away.plot(run.t, distance, color=COLORS[label], label=label)
    with view.style():
        error.set(
            xlabel="time [s]", ylabel="$‖x - x_d‖$ [mm]", title=f"Size of the task error: {name}"
        )
        away.set(
            xlabel="time [s]",
            ylabel=r"$‖q - q_\mathrm{home}‖$ [rad]",
            ylim=(0.0, 1.0),
            title=f"Distance from the posture: {name}",
        )
    view.legend_below(error)
    view.legend_below(away)
print(*view.save_figure(figure, out / "04_seven_joints"), sep="\n")
print(view.write_index(out))
