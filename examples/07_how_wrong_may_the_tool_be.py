"""How long may an unknown tool be? A Panda's stability, known before anything moves.

You will see: what one Lyapunov function and the linearisation say about tools of up to 30 cm that
the controller believes absent, around one configuration; and how long a tool each of them lets
pass, with more and more joint damping. The function, in which a search over tools, configurations
and targets finds no case that fails, certifies decimetres. The linearisation, which covers small
motions only, lets all pass that are tried.

You will learn: how to ask before anything moves, and that a test that fails may only be too strict.

    python examples/07_how_wrong_may_the_tool_be.py --out results/examples
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

HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
DAMPING = (1.0, 3.0, 9.0)  # N m s/rad
LONGEST = 0.90  # tool to try [m]

# without gravity in truth and belief: the closed loop of a controller that knows gravity, eq. (9)
arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
tools = aj.Uncertainty(arm, object_length=(0.0, 0.30), object_axis="x")
task = tools.believed_task()
region = aj.JointBox.around(arm, HOME, 0.3)


def controller_with(damping):
    """The controller of the bare hand with some added damping [N m s/rad]."""
    return aj.SetpointController(task, aj.Gains(400.0, 80.0, damping), gravity=aj.NoGravity(arm))


print(aj.Study(controller_with(9.0), tools, region).report(100))

# few configurations and a coarse search, to be quick: the defaults are finer
tolerated = {"certified": [], "stable": []}
for damping in DAMPING:
    found = aj.Study(controller_with(damping), tools, region).tolerance(
        largest=LONGEST / 0.3, precision=0.6, draws=20
    )
    for test, each in found.items():
        tolerated[test].append(each.uncertainty.high[0])  # the longest tool at that scale
    lengths = ", ".join(f"{each[-1]:.2g} m ({test})" for test, each in tolerated.items())
    print(f"damping {damping:g} N m s/rad tolerates {lengths} of at most {LONGEST} m")

figure, (ax,) = view.new_figure(size=(6.5, 4.5))
NAMES = {"certified": "one Lyapunov function", "stable": "linearisation"}
with view.style():
    for (test, lengths), color, marker in zip(tolerated.items(), view.SERIES, "o^", strict=False):
        ax.loglog(DAMPING, lengths, color=color, marker=marker, label=NAMES[test])
    ax.axhline(0.30, color=view.COLORS["neutral"], linestyle="--", label="the tools of up to 30 cm")
    ax.axhline(
        LONGEST, color=view.COLORS["neutral"], linestyle=":", label="the longest that was tried"
    )
    ax.set_xticks(DAMPING, [f"{damping:g}" for damping in DAMPING])
    ax.set_xticks([], minor=True)
    ax.set(
        xlabel="added joint damping $B_c$ [N m s/rad]",
        ylabel="tolerated length [m]",
        title="Panda: the longest unknown tool that each test lets pass",
    )
view.legend_below(ax)
print(*view.save_figure(figure, out / "07_tolerated_tools"), sep="\n")

# a tool of half a metre in motion, which the controller believes absent
truth = arm.with_object(0.5, axis="x")
plant = aj.Plant(truth)
target = plant.sensor.value(HOME + 0.2)
run = aj.simulate(plant, controller_with(DAMPING[-1]), target, HOME, duration=3.0, dt=1e-3)
print(f"a tool of 0.5 m: {1e3 * run.error_norm[0]:.0f} -> {1e3 * run.error_norm[-1]:.2g} mm")
title = "A tool of half a metre that a Panda believes absent, with much joint damping"
print(view.save_page(run, out / "07_tolerated_tools.html", title))
print(view.write_index(out))
