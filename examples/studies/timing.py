"""Run the loop on a robot for ten minutes at 1 kHz, and tell how long periods and steps took.

A panda with an unknown tool follows a circle under `aj.control`, behind `SimulatedDriver` in real
time: by plain Python and with the compiled step, on an idle machine and beside as many processes as
there are processors. Told are the time from command to command, the work within a period, the step
of the controller alone in that loop (its caches are cold after each sleep) and in a loop without
pauses, and how many commands were late. Every run is saved, and opened again as page and picture.

    python examples/studies/timing.py --minutes 10 --out results/timing

Exit code 1 means that a run ended before its time.
"""

import gc
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from common import head, parser, row, write

import approxjac as aj
from approxjac import view
from approxjac.realtime import Scheduling, SimulatedDriver, Tolerances

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
OPTIONS = {
    "plain, SCHED_FIFO": {"priority": 50},
    "plain, garbage collected": {"collects": True},
}
LATE = (1.5e-3, 2e-3, 5e-3, 20e-3)  # [s]


class Stepped(aj.controllers.ControllerWrapper):
    """A controller that notes how long its steps take."""

    _memory = 0

    def __init__(self, controller):
        self.controller, self.took = controller, []

    def begin(self, measurement):
        """Return that of the controller inside."""
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        """Step the controller inside."""
        begun = time.perf_counter()
        stepped = self.controller.advance(state, measurement, target, dt)
        self.took.append(time.perf_counter() - begun)
        return stepped


class Collecting(Stepped):
    """One that lets garbage be collected, as an ordinary program does."""

    def advance(self, state, measurement, target, dt):
        """Step the controller inside."""
        if not gc.isenabled():
            gc.enable()
        return super().advance(state, measurement, target, dt)


def busy():
    """Keep a processor busy."""
    values = np.random.default_rng(0).standard_normal((200, 200))
    while True:
        values = np.tanh(values @ values / 200.0)


def run_once(minutes, compiled, out, priority=None, collects=False):
    """Run a circle in real time; return the run, the steps in it, and steps without pauses [s]."""
    panda = aj.load_robot("panda")
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    law = aj.SetpointController(
        aj.PositionTask(belief),
        gravity=aj.AdaptiveGravity(belief),
        posture=aj.controllers.Posture(START, stiffness=10.0),  # else it drifts to its stops
    )
    controller = aj.TorqueLimited(law, aj.Limits(effort=belief.effort_limits))
    if compiled:
        controller = aj.codegen.compiled(controller)
    stepped = Collecting(controller) if collects else Stepped(controller)
    path = aj.Circle(plant.sensor.value(START) + [-0.08, 0.0, 0.05], 0.08, 4.0)
    driver = SimulatedDriver(plant, START)
    run = aj.control(
        driver,
        stepped,
        path,
        60.0 * minutes,
        tolerances=Tolerances(max_period=5.0),
        scheduling=Scheduling(priority=priority),
    )
    run.save(out)
    cold = np.array(stepped.took[100:])
    m = aj.Measurement(0.0, START, np.zeros(7), plant.sensor.value(START))
    state, warm = controller.initial_state(m), []
    for k in range(5000):
        m = m._replace(t=1e-3 * k)
        begun = time.perf_counter()
        state, _ = controller.step(state, m, path.at(0.0), 1e-3)
        warm.append(time.perf_counter() - begun)
    return run, cold, np.array(warm)


def opened(path, out):
    """Open a saved run as page and picture; return how large the page is [MB]."""
    run = aj.realtime.RobotRun.load(path)
    page = view.save_page(run, out / f"{path.stem}.html")
    figure, axes = view.new_figure(2, title="A run of a robot, opened again")
    view.plot_error(run, axes[0])
    view.plot_torque(run, axes[1])
    view.save_figure(figure, out / path.stem)
    return Path(page).stat().st_size / 1e6


def drawn(found, out):
    """Save the histograms."""
    figure, axes = view.new_figure(2, title="The loop at 1 kHz")
    bins = np.geomspace(5e-3, 50.0, 120)
    for name, (run, cold, _) in found.items():
        axes[0].hist(1e3 * run.gap, bins, histtype="step", label=name)
        axes[1].hist(1e3 * cold, bins, histtype="step", label=name)
    for ax, what in zip(axes, ("From command to command", "Step of the controller"), strict=False):
        ax.set(xscale="log", yscale="log", xlabel="[ms]", ylabel="periods", title=what)
        view.legend_below(ax)
    view.save_figure(figure, out / "timing")


def table(found):
    """Return a row a run."""
    lines = head(
        "loop", "periods", "period: median, 99 %, 99.9 %, worst [ms]", "late: 1.5, 2, 5, 20 ms",
        "work: median, 99 % [µs]", "step in it: median, 99 % [µs]", "step without pauses [µs]",
    )  # fmt: skip
    for name, (run, cold, warm) in found.items():
        gaps = 1e3 * np.percentile(run.gap, [50.0, 99.0, 99.9, 100.0])
        work = 1e6 * np.percentile(run.work, [50.0, 99.0])
        step = 1e6 * np.percentile(cold, [50.0, 99.0])
        lines.append(
            row(
                name,
                len(run.gap),
                ", ".join(f"{gap:.3g}" for gap in gaps),
                ", ".join(str((run.gap > late).sum()) for late in LATE),
                ", ".join(f"{value:.0f}" for value in work),
                ", ".join(f"{value:.0f}" for value in step),
                f"{1e6 * np.median(warm):.1f}",
            )
        )
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run all loops, write the table, and return the exit code."""
    options = parser(__doc__, "results/timing")
    options.add_argument("--minutes", type=float, default=10.0, help="of each run")
    options.add_argument("--load", nargs="+", choices=("idle", "busy"), default=["idle", "busy"])
    args = options.parse_args(arguments)
    minutes = 0.05 if args.quick else args.minutes
    args.out.mkdir(parents=True, exist_ok=True)
    found = {}
    for load in args.load:
        cores = multiprocessing.cpu_count() if load == "busy" else 0
        others = [multiprocessing.Process(target=busy, daemon=True) for _ in range(cores)]
        for other in others:
            other.start()
        for name, compiled in (("plain", False), ("compiled", True)):
            path = args.out / f"{name}_{load}.npz"
            found[f"{name}, {load}"] = run_once(minutes, compiled, path)
        if load == "busy":  # what the system and the interpreter can do about it
            for name, options in OPTIONS.items():
                path = args.out / f"{name.replace(', ', '_').replace(' ', '_')}.npz"
                try:
                    found[f"{name}, {load}"] = run_once(minutes / 5.0, False, path, **options)
                except aj.InvalidInputError as error:  # a priority that this user may not take
                    print(error)
        for other in others:
            other.terminate()
    sizes = [opened(path, args.out) for path in sorted(args.out.glob("*.npz"))]
    drawn(found, args.out)
    text = table(found) + f"\nPages of these runs: {max(sizes):.1f} MB at most.\n"
    summary = {
        name: {"ended": run.ended, "t": float(run.t[-1])} for name, (run, *_) in found.items()
    }
    write(args.out, {"timing.md": text}, summary)
    return 1 if any(run.fault for run, *_ in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
