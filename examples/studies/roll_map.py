"""Map the camera roll that is tolerated with each gain ratio: the local test beside simulations.

A Panda, one point, an eye to hand; the believed focal length, depth and tool are wrong, gravity is
exact. Two loops are tested: the continuous one with an ideal camera, and one with a camera of 30 Hz
that is late and noisy, which the local test knows as a mere delay. docs/studies/servo.md says what
comes out.

    python examples/studies/roll_map.py --out results/roll_map
"""

import math
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from common import head, parser, plain_law, row, run_all, write

import approxjac as aj
from approxjac import view
from approxjac.scenario import Scenario, build_scenario
from approxjac.scenario.starts import image_scene

ROLLS = tuple(10.0 * i for i in range(13))  # [deg]
RATIOS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # k_p / k_v [1/s]
LOOPS = {
    "ideal": "continuous, ideal camera",
    "late": "1 kHz, camera of 30 Hz, late and noisy",
}
DT, FRAME_RATE, DELAY, NOISE, UNSEEN = 1e-3, 30.0, 0.03, 0.5, 40.0  # [s], [Hz], [s], [px], [px]
START = {"ideal": 5.0, "late": 20.0}  # distance of the start's image from the goal's [px]
EVERY = 10  # steps from one look at a run to the next
WINDOW = 100  # looks in the second that an error has to stay small
SHRUNK, GROWN = 0.05, 3.0  # of the start, without noise; times the start
LONGEST = 10.0  # of a run [s]
CHANGED = 0.1  # by which the error must change from the middle third to the last to be judged
HARDEST = 80.0  # roll around which runs are longest [deg]
WORTH = {"converges": 1.0, "undecided": 0.5, "diverges": 0.0}


class Case(NamedTuple):
    """An error of the roll [deg] and the seed of a goal."""

    roll: float
    goal: int


class Cell(NamedTuple):
    """One loop with one roll, gain ratio and goal."""

    loop: str
    roll: float  # [deg]
    ratio: float  # [1/s]
    goal: int
    decay_rate: float  # of the slowest error as the local test has it [1/s]
    singular: bool  # the local test does not decide
    verdict: str  # of the simulated run
    duration: float  # until it was decided [s]
    end: float  # RMS error over its last second, as a share of the start's
    moved: float  # ‖Δq‖ of the joints from the goal's configuration at the end [rad]
    end_rate: float  # of the local test where a run converged; NaN elsewhere [1/s]

    @property
    def predicted(self):
        """Verdict of the local test."""
        return "undecided" if self.singular else "converges" if self.decay_rate > 0 else "diverges"


def run_case(case):
    """Test and simulate both loops with one roll and goal and every gain ratio."""
    built = prepared(case.roll, case.goal)
    sensor, q_goal = built.plant.sensor, goal(case.goal)
    task, gains, cells = built.law.task, built.law.gains, []
    kv = gains.diagonals(task.m, task.robot.nv).kv
    for ratio in RATIOS:
        law = aj.SetpointController(
            task, aj.Gains(ratio * kv, kv, gains.damping), gravity=built.law.gravity
        )
        for loop, distance in START.items():
            test = local_test(loop, built, law, q_goal)
            noise = NOISE * math.sqrt(sensor.m) if loop == "late" else 0.0
            small, target = max(noise, SHRUNK * distance), sensor.value(q_goal)
            watch = Watch(sensor, target, small, GROWN * distance)
            q0 = near_start(sensor, q_goal, distance, case.goal)
            simulate(loop, built, law, watch, q0, case.goal)
            verdict, rate = watch.judged(), math.nan
            if verdict == "converges":
                rate = local_test(loop, built, law, watch.q).decay_rate
            moved = float(np.linalg.norm(pin.difference(sensor.robot.model, q_goal, watch.q)))
            cells.append(
                Cell(
                    loop, case.roll, ratio, case.goal, test.decay_rate, test.singular, verdict,
                    watch.duration, watch.end, moved, rate,
                )
            )  # fmt: skip
    return cells


def prepared(roll, seed):
    """Return arm, cameras and default gains with a roll [deg]."""
    wrong = {"roll": math.radians(roll), "focal_factor": 1.3, "depth_factor": 1.5}
    built = build_scenario(
        Scenario(
            "panda",
            true={"object": {"length": 0.15, "mass": 0.3}},
            believed={"camera": wrong},
            task={"kind": "image"},
            sensor={"noise": NOISE, "rate": FRAME_RATE, "delay": DELAY},
            controller={"gravity": "exact", "settling_time": 1.5, "limits": "none"},
            run={"seed": seed},
        )
    )
    return plain_law(built, 1.5)


@cache
def goal(seed):
    """Return the configuration of a goal, that of the seed without roll, the same for all."""
    built = prepared(0.0, seed)
    truth, belief = built.plant.robot, built.law.task.robot
    rng = np.random.default_rng(seed)
    return image_scene(truth, belief, truth.tip_or(None), built.scenario, rng)[2]


def local_test(loop, built, law, q_goal):
    """Return what the local test says of a loop.

    Of images that are held until the next it knows their mean age, half a frame more than the
    delay; of noise and of motors that saturate it knows nothing.
    """
    truth, sensor = built.plant.robot, built.plant.sensor
    if loop == "ideal":
        return aj.local_stability(aj.Plant(truth, sensor), law, q_goal)
    sensing = aj.Sensing(x_delay=DELAY + 0.5 / FRAME_RATE)
    return aj.local_stability(aj.Plant(truth, sensor, sensing=sensing), law, q_goal, dt=DT)


def simulate(loop, built, law, watch, q0, seed):
    """Run a loop until its fate is decided."""
    plant, controller = built.plant, aj.HeldMeasurement(law, UNSEEN)
    if loop == "ideal":
        plant, controller = aj.Plant(plant.robot, plant.sensor), law
    try:
        aj.simulate(
            plant, controller, watch.target, q0, LONGEST, dt=DT, record_every=1.0,
            computation=aj.simulation.Computation("semi_implicit_euler"), seed=seed, observer=watch,
        )  # fmt: skip
    except aj.errors.SimulationError:
        watch.verdict = "diverges"


def near_start(sensor, q_goal, distance, seed):
    """Return a configuration whose image is so far from the goal's [px], in a seeded direction."""
    J = sensor.jacobian(q_goal, sensor.value(q_goal))
    direction = np.random.default_rng(seed).normal(size=sensor.m)
    motion = np.linalg.pinv(J) @ (distance * direction / np.linalg.norm(direction))
    return np.asarray(pin.integrate(sensor.robot.model, q_goal, motion))


class Watch:
    """An observer that ends a simulation once its fate is decided.

    It converges when the true error has been small for a second (root of the mean square), and
    diverges when it is large. Where neither happens in time, it is judged by the root of the mean
    square over the last third beside that over the middle third: a tenth less or more decides.
    """

    def __init__(self, sensor, target, small, large):
        self.errors, self.q, self.verdict = [], sensor.robot.neutral(), None
        self.sensor, self.target, self.small, self.large = sensor, target, small, large

    def __call__(self, loop):
        """Look at every tenth step."""
        if loop.step % EVERY == 0:
            self.q = loop.truth.q.copy()
            error = self.sensor.error(self.sensor.value(self.q), self.target)
            if self.see(float(np.linalg.norm(error))):
                loop.stop()

    def see(self, error):
        """Take note of an error [px], NaN behind the camera; return True if the fate is decided."""
        self.errors.append(error)
        if not error <= self.large:
            self.verdict = "diverges"
        elif (
            len(self.errors) >= WINDOW
            and error <= 3.0 * self.small  # seldom worth a mean
            and rms(self.errors[-WINDOW:]) <= self.small
        ):
            self.verdict = "converges"
        return self.verdict is not None

    @property
    def duration(self):
        """Time until the last look [s]."""
        return max(0, len(self.errors) - 1) * EVERY * DT

    @property
    def end(self):
        """RMS error over the last second, as a share of the start's."""
        return rms(self.errors[-WINDOW:]) / self.errors[0]

    def judged(self):
        """Return the verdict, by the trend where the run ended before it was decided."""
        if self.verdict is not None:
            return self.verdict
        third = max(1, len(self.errors) // 3)
        change = rms(self.errors[-third:]) / rms(self.errors[-2 * third : -third])
        if abs(change - 1.0) <= CHANGED:
            return "undecided"
        return "converges" if change < 1.0 else "diverges"


def rms(values):
    """Return the root of the mean square."""
    return math.sqrt(np.square(values).mean())


# -- tables ---------------------------------------------------------------------------------------


def table(cells):
    """Return agreement of test and simulation, tolerated roll and differences, as Markdown."""
    lines = head(
        "loop", "cells", "agree", "test says stable, simulation not",
        "test says unstable, simulation not", "simulation undecided", "test undecided",
    )  # fmt: skip
    lines += [agreement(loop, [c for c in cells if c.loop == loop]) for loop in LOOPS]
    lines += ["", "Tolerated roll in degrees, the smallest and the largest over the goals:", ""]
    kinds = [f"{name}: {kind}" for name in LOOPS.values() for kind in ("test", "simulation")]
    lines += head("a = k_p / k_v", *kinds)
    for ratio in sorted({cell.ratio for cell in cells}):
        mine = [[c for c in cells if (c.loop, c.ratio) == (loop, ratio)] for loop in LOOPS]
        lines.append(row(f"{ratio:g} 1/s", *(text for group in mine for text in tolerated(group))))
    found = [c for c in cells if c.predicted != c.verdict or c.verdict == "undecided"]
    found.sort(key=lambda c: (list(LOOPS).index(c.loop), c.ratio, c.roll, c.goal))
    lines += ["", "Where they differ:", "", *(map(difference, found) if found else ["- nowhere"])]
    return "\n".join(lines) + "\n"


def agreement(loop, cells):
    """Return the row of a loop: how often test and simulation say the same."""
    decided = [c for c in cells if "undecided" not in (c.predicted, c.verdict)]
    differing = [c for c in decided if c.predicted != c.verdict]
    agreeing = len(decided) - len(differing)
    optimistic = sum(c.predicted == "converges" for c in differing)
    return row(
        LOOPS[loop],
        len(cells),
        f"{agreeing} ({100.0 * agreeing / len(cells):.1f} %)",
        optimistic,
        len(differing) - optimistic,
        sum(c.verdict == "undecided" for c in cells),
        sum(c.singular for c in cells),
    )


def tolerated(cells):
    """Return the tolerated roll of the cells with one gain ratio, by the test and by simulation.

    The test's is where its decay rate first passes through zero, between two rolls in proportion;
    that of simulation is the last roll before the first with which a run does not converge.
    """
    tested, simulated = [], []
    for seed in sorted({cell.goal for cell in cells}):
        mine = sorted((c for c in cells if c.goal == seed), key=lambda cell: cell.roll)
        tested.append(boundary([c.roll for c in mine], [c.decay_rate for c in mine]))
        rolls = [math.nan, *(c.roll for c in mine)]
        failing = [i for i, cell in enumerate(mine) if cell.verdict != "converges"]
        simulated.append(rolls[failing[0] if failing else -1])
    return span(tested), span(simulated)


def boundary(rolls, rates):
    """Return where a decay rate first passes through zero: NaN at no roll, infinite at none."""
    if rates[0] <= 0.0:
        return math.nan
    for k in range(1, len(rates)):
        if rates[k] <= 0.0:
            share = rates[k - 1] / (rates[k - 1] - rates[k])
            return rolls[k - 1] + share * (rolls[k] - rolls[k - 1])
    return math.inf


def span(values):
    """Return the smallest and the largest of some rolls as text."""
    ordered = sorted(values, key=lambda v: -1.0 if math.isnan(v) else v)
    texts = ["none" if math.isnan(v) else "all" if math.isinf(v) else f"{v:.0f}" for v in ordered]
    return texts[0] if texts[0] == texts[-1] else f"{texts[0]} to {texts[-1]}"


def difference(cell):
    """Return a line on a cell where test and simulation do not say the same."""
    elsewhere = ""
    if cell.verdict == "converges":
        elsewhere = (
            f", at a configuration {cell.moved:.2g} rad from the goal's, where the test says "
            f"{cell.end_rate:.3g} 1/s"
        )
    return (
        f"- {LOOPS[cell.loop]}, roll {cell.roll:g}°, a = {cell.ratio:g} 1/s, goal "
        f"{cell.goal}: the test says {cell.predicted} ({cell.decay_rate:.3g} 1/s), simulation "
        f"{cell.verdict} (from {START[cell.loop]:g} px to {cell.end:.2g} times that after "
        f"{cell.duration:.1f} s{elsewhere})"
    )


def draw(cells):
    """Draw the share of goals that converge, and the local test's boundary for each goal."""
    figure, axes = view.new_figure(len(LOOPS), size=(4.9 * len(LOOPS), 4.6))
    rolls, heights = sorted({cell.roll for cell in cells}), np.log2(RATIOS)
    with view.style():
        for ax, loop in zip(axes, LOOPS, strict=True):
            mine = [cell for cell in cells if cell.loop == loop]
            share = grid(mine, rolls, lambda cell: WORTH[cell.verdict])
            shown = ax.pcolormesh(
                rolls, heights, share, cmap="RdYlBu", vmin=-0.25, vmax=1.25, shading="nearest",
                rasterized=True,
            )  # fmt: skip
            ax.plot([], [], color="k", label="boundary that the local test predicts, goal by goal")
            for seed in sorted({cell.goal for cell in mine}):
                rate = grid([c for c in mine if c.goal == seed], rolls, lambda c: c.decay_rate)
                if len(rolls) > 1 and rate.min() < 0.0 < rate.max():
                    ax.contour(rolls, heights, rate, levels=[0.0], colors=["k"], linewidths=1.4)
            differing = [c for c in mine if c.predicted != c.verdict]
            ax.plot(
                [c.roll for c in differing], [math.log2(c.ratio) for c in differing], "kx", ms=7,
                label="test and simulation differ",
            )  # fmt: skip
            ax.set_yticks(heights, [f"{ratio:g}" for ratio in RATIOS])
            ax.set(xlabel="error of the believed roll [°]", ylabel="$a = k_p / k_v$ [1/s]")
            ax.set_title(LOOPS[loop])
            ax.grid(visible=False)
        bar = figure.colorbar(shown, ax=axes, label="share of goals that converge (undecided: ½)")
        bar.ax.set_ylim(0.0, 1.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def grid(cells, rolls, value):
    """Return the mean of a value over the cells at each place, shape (ratios, rolls)."""
    return np.array(
        [
            [np.mean([value(c) for c in cells if (c.roll, c.ratio) == (x, y)]) for x in rolls]
            for y in RATIOS
        ]
    )


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/roll_map")
    options.add_argument("--goals", type=int, default=3)
    given = options.parse_args(arguments)
    rolls, goals = ((0.0, 60.0), 1) if given.quick else (ROLLS, given.goals)
    rolls = sorted(rolls, key=lambda roll: abs(roll - HARDEST))
    cases = [Case(roll, seed) for roll in rolls for seed in range(goals)]
    cells = [cell for cells in run_all(run_case, cases, given.jobs) for cell in cells]
    write(given.out, {"roll_map.md": table(cells)}, {"cells": cells})
    view.save_figure(draw(cells), given.out / "servo_map")
    return 0


if __name__ == "__main__":
    sys.exit(main())
