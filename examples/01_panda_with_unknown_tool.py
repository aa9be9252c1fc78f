"""A Panda holds a 20 cm tool that its controller knows nothing about.

You will see: the tool's tip comes from 24 cm away to within a tenth of a millimetre of its target,
although the controller works with the Jacobian of the bare hand. It never learns the tool's length;
measuring the tip is enough. Open the page that it writes to see both robots move.

You will learn: what the plant is told and what the controller is; what a task, gains, gravity and a
run are; how to look at a run.

    python examples/01_panda_with_unknown_tool.py --out results/examples
"""

import argparse
from pathlib import Path

import approxjac as aj
from approxjac import view

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

# The truth, which only the simulated plant owns: a 20 cm tool in the hand.
arm = aj.load_robot("panda")
truth = arm.with_object(length=0.20, mass=0.5, axis="x")
plant = aj.Plant(truth)  # measures the position of the tool's tip

# The belief, which only the controller owns: no tool at all. The tool's weight is unknown to it
# too, so gravity is learnt while the arm moves. Gains are chosen from the believed arm's inertia.
belief = arm.with_object(length=0.0)
task = aj.PositionTask(belief)
controller = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief))

# Where it stands, where the tip is to go, and 10 s sampled at 1 kHz as on the robot.
q0 = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
x_d = plant.sensor.value(q0) + [0.10, -0.15, 0.16]
run = aj.simulate(plant, controller, target=x_d, q0=q0)
print(run)

title = "A Panda with a 20 cm tool that its controller believes absent"
figure, (left, middle, right) = view.new_figure(3, title=title)
view.plot_error(run, left)
view.plot_path(run, truth, plane="xz", ax=middle, believed=belief, target=x_d)
view.plot_torque(run, right)
print(*view.save_figure(figure, out / "01_panda_unknown_tool"), sep="\n")

# A page to keep: both robots, moving. One file, to be opened in any browser.
print(view.save_page(run, out / "01_panda_unknown_tool.html", title))
print(view.write_index(out))  # of all pages in this folder
