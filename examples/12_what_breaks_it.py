"""What breaks it: a Panda with an unknown tool, made worse until it fails.

You will see: six ways to fail, from a camera rolled too far to weak motors, as curves of what is
left after 6 s. At the upper edge they diverged. Dashed: stable up to here, by the local test.

You will learn: what the limits of the law look like, and which of them can be predicted.

    python examples/12_what_breaks_it.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)
FAR = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
GOAL = FAR + [0.3, 0.2, -0.2, 0.3, 0.2, -0.2, 0.1]
NEAR, EULER = GOAL + 0.05 * (FAR - GOAL), aj.simulation.Computation("semi_implicit_euler")
arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.2, 0.5, axis="x"), arm.with_object(0.0)
sensor, task = aj.PositionTask(truth), aj.PositionTask(belief)
plant, Z, tip = aj.Plant(truth, sensor), aj.robots.GravityRegressor(belief), sensor.value(GOAL)
known, gains = RegressorGravity(Z, Z.fit(truth)[0]), aj.default_gains(task)
camera = aj.PinholeCamera.looking_at(tip, tip + [1.0, -0.7, 0.5], 600.0, (640, 480))
watched = aj.Plant(truth, aj.ImageTask(truth, camera))
usual = aj.default_gains(aj.ImageTask(belief, camera))
aside = np.random.default_rng(0).choice([-1.0, 1.0], (7, 3)) / np.sqrt(3.0)  # unit vectors


def rolled_camera(degrees, a):
    """A camera with a roll that its controller does not know, at the gain ratio a = k_p/k_v."""
    wrong = aj.ImageTask(belief, camera.with_error(rotation=(0.0, 0.0, np.radians(degrees))))
    scaled = aj.Gains(a * usual.kv, usual.kv, usual.damping)
    return watched, aj.SetpointController(wrong, scaled, gravity=known), 4e-3


def late_x(age, settling_time):
    """A measurement of that age [ms]."""
    law = aj.SetpointController(task, aj.default_gains(task, settling_time), gravity=known)
    return aj.Plant(truth, sensor, sensing=aj.Sensing(x_delay=1e-3 * age)), law, 4e-3


def slow_sampling(period, times):
    """So many times the default joint damping, sampled with that period [ms]."""
    more = aj.Gains(gains.kp, gains.kv, times * gains.damping)
    return plant, aj.SetpointController(task, more, gravity=known), 1e-3 * period


def tilted_axes(degrees, learns):
    """Each joint axis of the believed arm turned, in a direction of its own."""
    turns = dict(zip(arm.joint_names, np.radians(degrees) * aside, strict=True))
    wrong = belief.with_kinematic_error(rotations=turns)
    Z = aj.robots.GravityRegressor(wrong)
    gravity = aj.AdaptiveGravity(Z) if learns else RegressorGravity(Z, Z.fit(truth)[0])
    return plant, aj.SetpointController(aj.PositionTask(wrong), gravity=gravity), 4e-3


def unknown_load(mass, learns):
    """A payload [kg] of which the controller knows nothing."""
    held = aj.PositionTask(arm.with_object(0.2, mass, axis="x"))
    gravity = aj.AdaptiveGravity(Z) if learns else aj.controllers.ModelGravity(belief)
    return aj.Plant(held.robot, held), aj.SetpointController(task, gravity=gravity), 4e-3


def weak_motors(share, proof):
    """Motors with a share of their torques."""
    law, urdf = aj.SetpointController(task, gravity=known), aj.Limits.of(belief, share)
    kept = urdf if proof else aj.Limits(urdf.effort)
    return plant, aj.TorqueLimited(law, kept, proof=bool(proof), dt=4e-3), 4e-3


def left(truly, law, dt, start, shown):
    """The largest error in the last tenth of 6 s, or the largest speed."""
    x_d, duration = truly.sensor.value(GOAL), round(6.0 / dt) * dt
    try:
        run = aj.simulate(truly, law, x_d, start, duration, dt=dt, computation=EULER)
    except aj.errors.SimulationError:  # it diverged
        return np.inf
    e, e_0 = run.error_norm[run.t > 5.4].max(), run.error_norm[0]
    return {SHARE: e / e_0, MM: 1e3 * e, SPEED: np.abs(run.v).max()}[shown]


SHARE, MM, SPEED = "error left, share of the first", "error left [mm]", "largest speed [rad/s]"
PANELS = [  # what is made worse, by how much, a curve for each of, what is shown; test up to there
    (rolled_camera, "roll [°]", [60, 70, 80, 90], {"a = 1 1/s": 1, "a = 8 1/s": 8}, SHARE, 120),
    (late_x, "age of x [ms]", [80, 120, 200, 240], {"settled in 0.5 s": 0.5, "1 s": 1}, SHARE, 400),
    (slow_sampling, "period [ms]", [3, 7, 19, 21], {"usual damping": 1, "× 4": 4}, SPEED, 40),
    (tilted_axes, "axes off by [°]", [0, 10, 30, 40], {"θ fitted": 0, "θ learnt": 1}, MM, 0),
    (unknown_load, "payload [kg]", [0, 0.1, 1, 3], {"g believed": 0, "g learnt": 1}, MM, 0),
    (weak_motors, "share of torques [–]", [0.2, 0.28, 0.3], {"clipped": 0, "QP": 1}, MM, 0),
]  # fmt: skip
figure, axes = view.new_figure(3, 2, title="After 6 s; points at the upper edge have diverged")
for ax, (make, name, values, curves, shown, limit) in zip(axes, PANELS, strict=True):
    for color, (label, setting) in zip(view.SERIES, curves.items(), strict=False):
        y = [left(*make(value, setting), NEAR if limit else FAR, shown) for value in values]
        low, high = 0.0, limit
        while high - low > 1e-3 * limit:  # by bisection: up to where it is stable
            truly, law, dt = make(middle := 0.5 * (low + high), setting)
            stable = aj.local_stability(truly, law, GOAL, dt=dt).stable
            low, high = (middle, high) if stable else (low, middle)
        with view.style():
            ax.semilogy(values, np.minimum(y, 1e5), "o-", color=color, markersize=3, label=label)
            if limit:
                ax.axvline(low, color=color, ls="--", label=f"stable up to {low:.3g}: local test")
            ax.set(title=make.__name__.replace("_", " ").capitalize())
        points = ", ".join(f"{value:g}: {e:.2g}" for value, e in zip(values, y, strict=True))
        print(f"{name}, {label} → {shown}: {points}", f"(stable up to {low:.4g})" if limit else "")
    ax.set(xlabel=name, ylabel=shown, ylim=(None, 2e5))
    view.legend_below(ax)
print(*view.save_figure(figure, out / "12_what_breaks_it"), sep="\n")
run = aj.simulate(*tilted_axes(30, True)[:2], tip, FAR, dt=4e-3)  # one of them in motion
print(view.save_page(run, out / "12_what_breaks_it.html", "Each believed joint axis is off by 30°"))
print(view.write_index(out))
