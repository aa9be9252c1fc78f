"""A loop of your own at 1 kHz: deadlines, a camera that goes blind, bad encoders, and a stop.

You will see: a Panda with an unknown tool, in MuJoCo behind a driver of three methods, led in real
time by `control` of `own_loop.py`, which is there to be copied. From 1 s to 2 s the camera sees
nothing; at 3 s the encoders deliver NaN for 3 ms; at 6 s, on the way to a second target, a stop is
asked for (Ctrl-C asks too), and the arm comes to standstill. How long cycles took and how many
torques were late is told as it was: on a busy machine some are, and this simulated arm waits for
them, as no real one does.

You will learn: what a loop on a robot has to do around `step`: deadlines, measurements that
are lost or wrong, goals that move, limits, and a stop that is none too hard.

    python examples/11_your_own_loop.py --out results/examples
"""

import argparse
import signal
from pathlib import Path

import numpy as np
from own_loop import DT, UNKNOWN, control

import approxjac as aj
from approxjac import view


class SimulatedArm:
    """What stands here for the driver of an arm: give yours these three methods."""

    def __init__(self, plant, q):
        self.plant, self.q, self.v, self.cycle = plant, np.array(q), np.zeros(plant.robot.nv), 0

    def read(self):
        """Return q, q̇ and the camera's last image, of 50 a second; NaN where there is none."""
        if self.cycle % 20 == 0:
            sees = not 1000 <= self.cycle < 2000
            self.x = self.plant.sensor.value(self.q) if sees else np.full(3, np.nan)
        return self.q * (np.nan if 3000 <= self.cycle < 3003 else 1.0), self.v, self.x

    def send(self, torque):
        """Apply a torque for one period, however long the cycle really took."""
        self.v = self.v + DT * self.plant.acceleration(self.q, self.v, torque)
        self.q, self.cycle = self.q + DT * self.v, self.cycle + 1

    def brake(self):
        """Close the motors' own brakes, which hold an arm that nobody controls."""
        self.v = np.zeros_like(self.v)


arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

panda = aj.load_robot("panda")
truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
gravity = aj.AdaptiveGravity(belief)
law = aj.SetpointController(aj.PositionTask(belief), gravity=gravity)
limited = aj.TorqueLimited(law, aj.Limits.of(belief, scale=0.8))
plant = aj.MujocoPlant(truth, sensor=aj.PositionTask(truth))
start = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
goal = plant.sensor.value(start) + [0.10, -0.15, 0.16]
goals = {True: goal, False: goal + [0.0, 0.4, 0.0]}

asked = []
signal.signal(signal.SIGINT, lambda *_: asked.append(True))  # it does not interrupt a cycle
why, log, _ = control(
    SimulatedArm(plant, start),
    limited,
    goal=lambda t: goals[t < 5.0],
    stop=lambda t: t >= 6.0 or asked,
    unseen=0.03,
    speed=0.2,
    astray=0.3,
    longest=np.inf,  # 0.02 would do for an arm that does not wait
)

log_known = log[np.isfinite(log["q"]).all(axis=1)]
tip = np.array([plant.sensor.value(q) for q in log_known["q"]])
error = 1e3 * np.linalg.norm(tip - [goals[t < 5.0] for t in log_known["t"]], axis=1)
speed = np.abs(log_known["v"]).max(axis=1)
at = {t: np.searchsorted(log_known["t"], t) for t in (0.0, 1.0, 2.0, 5.0 - DT)}
jump = np.abs(log["torque"][0] - plant.dynamics.g(start)).max()
late = log["gap"] > 1.5 * DT
print(f"first torque: at most {jump:.2g} N m from what held the arm (the weight of the tool)")
reached = [f"{error[k]:.3g} mm at {t:.0f} s" for t, k in at.items() if k < len(error)]
print(f"error: {', '.join(reached)}")
print(f"stopped ({why}): {speed[-1]:.2g} rad/s at {log['t'][-1]:.2f} s")
names = {UNKNOWN: "joints unknown", **{int(status): status.name for status in aj.Status}}
counts = {names[n]: int((log["status"] == n).sum()) for n in names if (log["status"] == n).any()}
print(", ".join(f"{name} {count}" for name, count in counts.items()))
half, most, worst = 1e6 * np.percentile(log["work"], [50, 99, 100])
print(
    f"{len(log)} cycles: {half:.0f} µs in the median, 99 % within {most:.0f}, worst {worst:.0f}; "
    f"{late.sum()} torques late, longest gap {1e3 * log['gap'].max():.1f} ms"
)

figure, (left, middle, right) = view.new_figure(3, title="A Panda in a loop of one's own")
with view.style():
    left.semilogy(log_known["t"], error, color=view.SERIES[0])
    left.set(xlabel="time [s]", ylabel="|x − x_d| [mm]", title="True error to the goal")
    middle.plot(log_known["t"], speed, color=view.SERIES[0])
    middle.set(xlabel="time [s]", ylabel="max |q̇| [rad/s]", title="Speed of the fastest joint")
    for name, color in (("gap", view.SERIES[4]), ("work", view.SERIES[0])):
        right.semilogy(
            log["t"], 1e3 * log[name], ".", ms=2, color=color, label=name, rasterized=True
        )
    right.set(xlabel="time [s]", ylabel="[ms]", title="From torque to torque, and work in it")
    for ax in (left, middle):
        ax.axvspan(1.0, 2.0, color=view.SERIES[4], alpha=0.2, label="camera blind")
        ax.axvline(3.0, color=view.SERIES[3], linestyle=":", label="bad encoders")
        ax.axvline(6.0, color=view.COLORS["neutral"], linestyle="--", label="asked to stop")
    for ax in (left, middle, right):
        view.legend_below(ax)
for path in view.save_figure(figure, out / "your_own_loop"):
    print(path)
