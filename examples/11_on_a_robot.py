"""The loop on a robot: a Panda with an unknown tool, and an encoder that freezes.

You will see: `aj.control` runs an arm through a driver at 1 kHz, here one in MuJoCo with friction,
a camera of 60 images a second and encoders. The target starts at the tip and is eased in; at the
end the arm is brought to rest and braked. In a second run an encoder freezes in mid-motion: the arm
is braked at once. This arm waits for its commands (`pace=math.inf`), so that a busy machine changes
nothing but the times of work; a real one, or one with `pace=1`, goes on with the last torque where
a command is late.

You will learn: what a driver is, what `control` takes care of, and what its run records.

    pip install 'approxjac[mujoco]'
    python examples/11_on_a_robot.py --out results/examples
"""

import argparse
import math
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.realtime import Accuracy, SimulatedDriver, Tolerances

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

panda = aj.load_robot("panda")
truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
camera = aj.Sensing(x_noise=5e-4, x_rate=60.0, x_delay=0.03)
plant = aj.MujocoPlant(
    truth, aj.PositionTask(truth), friction=aj.robots.Friction(0.5, coulomb=0.2), sensing=camera
)  # stands in for your arm
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])

latency = aj.Latency(image_period=1 / 60, image_age=0.03)
law = aj.SetpointController(
    aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief), latency=latency
)
controller = aj.TorqueLimited(law, aj.Limits.of(belief))
accuracy = Accuracy(q=1e-5, v=1e-3, x=5e-4)  # of encoders, velocities and camera
tolerances = Tolerances(accuracy, max_period=5.0)  # on a real arm leave out the period: 20 ms
goal = plant.sensor.value(start) + [0.10, -0.15, 0.16]

# yours: FrankaDriver(...), or a class of three methods, and the default period
driver = SimulatedDriver(plant, start, pace=math.inf)
run = aj.control(driver, controller, goal, duration=3.0, tolerances=tolerances)
print(run)


class Frozen(SimulatedDriver):
    """An arm whose fourth encoder tells the same from 0.6 s on."""

    def read(self):
        """Return a measurement with one joint as it was."""
        measured = super().read()
        if self.t < 0.6:
            self.kept = measured.q[3]
            return measured
        q, v = measured.q.copy(), measured.v.copy()
        q[3], v[3] = self.kept, 0.0
        return measured._replace(q=q, v=v)


stuck = Frozen(plant, start, pace=math.inf)
broken = aj.control(stuck, controller, goal, duration=3.0, tolerances=tolerances)
print(f"\nencoder frozen at 0.6 s: {broken.ended}")

figure, (left, middle, right) = view.new_figure(3, title="A Panda in the loop of a robot")
with view.style():
    for one, name in ((run, "sound"), (broken, "encoder frozen at 0.6 s")):
        error = np.linalg.norm(one.x_measured - goal, axis=1)
        left.plot(one.t, 1e3 * error, label=name)
        middle.plot(one.t, np.abs(one.v).max(axis=1), label=name)
    left.set(xlabel="time [s]", ylabel="|x − goal|, measured [mm]", title="Error to the goal")
    middle.set(xlabel="time [s]", ylabel="max |q̇| [rad/s]", title="Fastest joint, as told")
    right.plot(run.t[:-1], 1e3 * run.work, ".", markersize=2)
    right.axhline(1.0, color=view.COLORS["neutral"], linestyle="--", label="period of 1 ms")
    right.set(xlabel="time [s]", ylabel="computing time [ms]", title="Computing time of each step")
for ax in (left, middle, right):
    ax.set(xlim=(0.0, run.t[-1]), ylim=(0.0, None))
    view.legend_below(ax)
for path in view.save_figure(figure, out / "11_on_a_robot"):
    print(path)
title = "A Panda with an unknown tool in the loop of a robot, as its controller sees it"
print(view.save_page(run, out / "11_on_a_robot.html", title))
print(view.write_index(out))
