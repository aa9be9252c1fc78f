"""A Panda with an unknown tool is sent to a target behind a wall, and stays in front of it.

You will see: the same law twice. Alone it goes through the wall, 10 cm deep. With the wall and a
speed of the tip among its limits it comes to rest in front of the wall, a third of a metre from
the target, although the tip that it believes in is 12 cm away from the true one: the wall has that
margin. It is the believed tip that moves with 20 cm/s at most. A posture holds the other joints:
without one, the tip slides on along the wall.

You will learn: how to give a controller limits of motion besides those of motors and joints, and
what to take for the margin.

    python examples/17_wall.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import CartesianSpeed, Posture, Wall

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

# The belief lacks the tool's length, not its mass: speeds are predicted with it.
arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.12, 0.5, axis="x"), arm.with_object(0.0, 0.5)
plant, task = aj.Plant(truth), aj.PositionTask(belief)
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
law = aj.SetpointController(
    task, gravity=aj.AdaptiveGravity(belief), posture=Posture(start, stiffness=20.0)
)
target = plant.sensor.value(start) + [0.10, -0.35, 0.0]
normal = np.array([0.0, 1.0, 0.0])  # towards the side to stay on
point = target - np.array([0.0, -0.10, 0.0])  # the target is 10 cm behind it
wall = Wall(point, normal, margin=0.12)  # what the tip may be elsewhere than believed

colors = {"true tip": view.COLORS["true"], "believed tip": view.COLORS["believed"]}
dt = 2e-3
alone = aj.TorqueLimited(law, dt=dt)
limited = aj.TorqueLimited(law, [aj.Limits.of(belief), wall, CartesianSpeed(0.20)], dt=dt)

figure, axes = view.new_figure(2, 2, title="A target behind a wall, with an unknown tool of 12 cm")
for row, (name, controller) in enumerate({"alone": alone, "wall and speed": limited}.items()):
    run = aj.simulate(
        plant,
        controller,
        target,
        start,
        duration=4.0,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    believed = np.array([task.value(q) for q in run.q])
    paths = {"true tip": run.x, "believed tip": believed}
    speeds = {
        label: np.linalg.norm(np.gradient(path, run.t, axis=0), axis=1)
        for label, path in paths.items()
    }
    heights = {label: (path - point) @ normal for label, path in paths.items()}
    statuses = ", ".join(f"{status.name} {n}" for status, n in run.limit_status_counts().items())
    print(
        f"{name}: the tip comes to {1e3 * heights['true tip'].min():.0f} mm from the wall, the "
        f"believed one at up to {speeds['believed tip'].max():.2f} m/s, and ends "
        f"{1e3 * run.error_norm[-1]:.0f} mm from the target; {statuses}"
    )
    left, right = axes[2 * row : 2 * row + 2]
    with view.style():
        for label, height in heights.items():
            left.plot(run.t, height, color=colors[label], label=label)
        left.axhline(0.0, color=view.COLORS["neutral"], label="wall")
        left.axhline(wall.margin, color=view.COLORS["neutral"], linestyle="--", label="margin")
        left.set(xlabel="time [s]", ylabel="in front of the wall [m]", title=f"Tips: {name}")
        view.legend_below(left)
        for label, speed in speeds.items():
            right.plot(run.t, speed, color=colors[label], label=label)
        right.axhline(0.20, color=view.COLORS["neutral"], linestyle="--", label="limit")
        right.set(xlabel="time [s]", ylabel="speed [m/s]", title=f"Speed: {name}")
        view.legend_below(right)
        for ax in (left, right):
            ax.set_xlim(run.t[0], run.t[-1])
print(*view.save_figure(figure, out / "17_wall"), sep="\n")
title = "A target behind a wall, with an unknown tool of 12 cm"
print(view.save_page(run, out / "17_wall.html", title))
print(view.write_index(out))
