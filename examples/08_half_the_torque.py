"""A Panda with half its motor torque and with joint limits reaches a target with an unknown tool.

You will see: the same law, the same start and target, with its torque clipped and with the torque
limited by a QP. Clipping lets the joints run ten times too fast and into their stops.
The QP keeps torques and positions within their limits, and speeds as well as the believed inertia
(without the tool) predicts them. It gets there seconds later, and says in which steps the theorem's
decrease of V was kept.

You will learn: how to give a controller limits, and what its limit status says.

    python examples/08_half_the_torque.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity
from approxjac.robots import GravityRegressor

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.2, 0.5, axis="x"), arm.with_object(0.0)
task = aj.PositionTask(belief)
regressor = GravityRegressor(belief)
gravity = RegressorGravity(regressor, regressor.fit(truth)[0])  # known from elsewhere
law = aj.SetpointController(task, aj.default_gains(task, settling_time=0.5), gravity=gravity)

limits = aj.Limits.of(belief, scale=0.5)
plant = aj.Plant(truth, sensor=aj.PositionTask(truth), torque_limits=limits.effort)
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
target = plant.sensor.value([1.8, 0.4, 0.3, -1.9, -0.5, 2.4, 0.0])

low, high = arm.position_limits
figure, axes = view.new_figure(2, 2, title="Half the torque: clipped, and limited by a QP")
dt = 2e-3
clipped = aj.TorqueLimited(law, aj.Limits(limits.effort), proof=False, dt=dt)
for name, limiter in {"clipped": clipped, "QP": aj.TorqueLimited(law, limits, dt=dt)}.items():
    run = aj.simulate(
        plant,
        limiter,
        target,
        start,
        duration=8.0,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    torque = np.abs(run.tau / limits.effort).max(axis=1)
    speed = np.abs(run.v / arm.velocity_limits).max(axis=1)
    beyond = np.maximum(run.q - high, low - run.q).max(axis=1)  # below 0: all are within
    statuses = ", ".join(f"{status.name} {n}" for status, n in run.limit_status_counts().items())
    print(
        f"{name}: error {1e3 * run.error_norm[0]:.0f} -> {1e3 * run.error_norm[-1]:.1f} mm; "
        f"speed up to {speed.max():.2f} of its limit; joints up to "
        f"{max(0.0, beyond.max()):.2f} rad beyond theirs; {statuses}"
    )
    for ax, shown in zip(axes, (1e3 * run.error_norm, torque, speed, beyond), strict=True):
        ax.plot(run.t, shown, label=name)
labels = {
    "Size of the task error": "$‖x - x_d‖$ [mm]",
    "Largest torque of a joint": r"$|\tau|$ / limit [–]",
    "Largest speed of a joint": r"$|\dot q|$ / limit [–]",
    "Joint that is farthest beyond a stop": "beyond its limit [rad]",
}
for ax, (title, label), limit in zip(axes, labels.items(), (None, 1.0, 1.0, 0.0), strict=True):
    with view.style():
        if limit is not None:
            ax.axhline(limit, color=view.COLORS["neutral"], linestyle="--", label="limit")
        ax.set(xlabel="time [s]", ylabel=label, title=title, xlim=(0.0, 3.0))
    view.legend_below(ax)
axes[0].set_xlim(run.t[0], run.t[-1])
print(*view.save_figure(figure, out / "08_half_the_torque"), sep="\n")
title = "A Panda with half its motor torque, limited by a QP"
print(view.save_page(run, out / "08_half_the_torque.html", title))
print(view.write_index(out))
