"""Servo a Panda with a badly wrong camera from many starts, and compare laws on the same starts.

The arm holds an object that its controller believes absent, and every number of the camera is
believed wrong, with signs that are drawn for each start. docs/studies/servo.md says what comes out.

    python examples/studies/visual_servoing.py --out results/servo

Exit code 1 means that fewer than 95 % of the starts whose path stays in view converged to within
the noise.
"""

import math
import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from common import head, parser, plain_law, row, run_all, write
from velocity_servo import VelocityServo

import approxjac as aj
from approxjac import view
from approxjac.controllers.gains.tuning import position_gains
from approxjac.scenario import Scenario, build_scenario, run_scenario
from approxjac.tasks.analysis import sees

WANTED = 0.95  # share of the starts whose path stays in view that has to converge
ROLL, FOCAL, DEPTH = math.radians(30.0), 0.3, 0.5  # how wrong the believed camera is
NOISES, NOISE = (0.0, 0.5, 2.0), 0.5  # of the comparison, and the usual one [px]
SETTLING_TIME, UNSEEN = 1.5, 40.0  # [s], [px]
MOST_SEEDS = 3  # as many seeds as starts are wanted, before it is given up


class Law(NamedTuple):
    """A law of the comparison."""

    differentiator: float | None = None  # of law (5) [s]
    gains: str | None = None  # name of the law whose default gains it gets; its own by default
    damping: str | None = None  # name of the law whose B_c it gets, and K_p as the rule has it then


LAWS = {  # by name, which says whose gains a law has, if not its own
    "law 6": Law(),
    "law 5, 0.03 s": Law(0.03),
    "law 5, 0.1 s": Law(0.1),
    "law 5, 0.3 s": Law(0.3),
    "law 5, 0.1 s, B_c of law 6": Law(0.1, damping="law 6"),
    "law 5, 0.1 s, gains of law 6": Law(0.1, gains="law 6"),
    "law 6, gains of law 5, 0.1 s": Law(gains="law 5, 0.1 s"),
    "IBVS": Law(),
}


class Scene(NamedTuple):
    """An arm and what is seen of it; laws and noises with which they are compared there."""

    robot: str
    laws: tuple = ()
    noises: tuple = ()
    points: int = 1
    in_hand: bool = False
    limits: str = "none"


ONE_POINT, WITHIN_LIMITS = "panda, one point", "panda, one point, limits kept"
SCENES = {
    ONE_POINT: Scene("panda", tuple(LAWS), NOISES),
    WITHIN_LIMITS: Scene("panda", limits="urdf"),
    "panda, two points": Scene("panda", ("law 6", "IBVS"), (NOISE,), 2),
    "ur5, camera in hand, two points": Scene("ur5", ("law 6", "IBVS"), (NOISE,), 2, True),
}


class Case(NamedTuple):
    """One run: where, with which law, noise [px] and gravity, and the seed of all that is drawn."""

    scene: str
    law: str
    noise: float
    gravity: str
    seed: int


class Outcome(NamedTuple):
    """What became of one run."""

    case: Case
    start_error: float = math.nan  # largest distance of a point from its target [px]
    final_error: float = math.inf  # RMS of the worst coordinate's true error [px]
    settling_time: float = math.nan  # [s]
    peak_torque: float = math.nan  # asked for, as a share of its limit
    roughness: float = math.nan  # RMS change of torques from record to record at the end [N m]
    converged: bool = False  # within the noise, or half a pixel
    in_view: bool = True  # throughout; true where a run has no record, so that it counts
    left_at: float = math.nan  # when a point first left the view [s]
    reason: str = ""  # that it did not converge


def built(case):
    """Return plant, controller, start and target of a case, ready to run."""
    ready, law = with_default_gains(case, case.law), LAWS[case.law]
    own = ready.law
    task = own.task
    if case.law == "IBVS":
        chosen = VelocityServo(task, 4.0 / SETTLING_TIME, own.gravity)
    elif law.gains is not None or law.damping is not None:
        gains = with_default_gains(case, law.gains or law.damping).law.gains
        if law.damping is not None:
            _, kv, _ = own.diagonals
            damping = gains.diagonals(task.m, task.robot.nv).damping
            gains = aj.Gains(position_gains(task, kv, damping, SETTLING_TIME), kv, damping)
        chosen = aj.SetpointController(task, gains, gravity=own.gravity, velocity=own.velocity)
    else:
        return ready
    return replace(ready, law=chosen, controller=aj.HeldMeasurement(chosen, UNSEEN))


def with_default_gains(case, law):
    """Return a case with another law and the default gains of that law."""
    scene = SCENES[case.scene]
    signs = np.random.default_rng([case.seed, 1]).choice([-1.0, 1.0], 3).tolist()
    wrong = {
        "roll": signs[0] * ROLL,
        "focal_factor": 1.0 + signs[1] * FOCAL,
        "depth_factor": 1.0 + signs[2] * DEPTH,
    }
    held = {"length": 0.0, "mass": 0.0} if scene.in_hand else {"length": 0.15, "mass": 0.3}
    built = build_scenario(
        Scenario(
            scene.robot,
            true={"object": held, "camera": {"mount": "tip"} if scene.in_hand else {}},
            believed={"camera": wrong},
            task={"kind": "image", "points": scene.points},
            sensor={"noise": case.noise, "rate": 30.0, "delay": 0.03},
            controller={
                "gravity": case.gravity,
                "settling_time": SETTLING_TIME,
                "unseen": UNSEEN,
                "limits": scene.limits,
                "differentiator": LAWS[law].differentiator,
            },
            run={"duration": 15.0, "seed": case.seed},
        )
    )
    return plain_law(built, SETTLING_TIME)


def run_case(case):
    """Run one case at 1 kHz, with motors that saturate; what cannot run is an outcome too."""
    try:
        result = run_scenario(built(case))
    except aj.errors.ApproxJacError as error:
        return Outcome(case, reason=f"{error}")
    run, sensor = result.run, result.built.plant.sensor
    unseen = np.array([not sees(sensor, q) for q in run.q])
    last = run.tau[-max(2, len(run.t) // 10) :]
    return Outcome(
        case,
        start_error=float(result.errors[0].max()),
        final_error=result.final_error["px"],
        settling_time=result.settling_time,
        peak_torque=result.peak_torque_ratio,
        roughness=float(np.sqrt((np.diff(last, axis=0) ** 2).sum(axis=1).mean())),
        converged=result.converged,
        in_view=not unseen.any(),
        left_at=float(run.t[unseen.argmax()]) if unseen.any() else math.nan,
        reason=result.reason,
    )


def from_many_starts(count, scene, jobs=None):
    """Run law (6) from seed after seed, until enough paths stayed in view.

    Gravity is exact for even seeds and learnt for odd ones. It ends without enough of them after
    three times as many seeds.
    """
    outcomes = []
    while (missing := count - len(seen(outcomes))) and len(outcomes) < MOST_SEEDS * count:
        seeds = range(len(outcomes), len(outcomes) + missing)
        cases = [Case(scene, "law 6", NOISE, ("exact", "learnt")[s % 2], s) for s in seeds]
        outcomes += run_all(run_case, cases, jobs)
    return outcomes


def comparison(starts):
    """Return the cases of the comparison: each law and noise from the same starts."""
    return [
        Case(name, law, noise, "exact", seed)
        for name, scene in SCENES.items()
        for noise in scene.noises
        for law in scene.laws
        for seed in range(starts)
    ]


def seen(outcomes):
    """Return those whose path stayed in view."""
    return [outcome for outcome in outcomes if outcome.in_view]


# -- tables ---------------------------------------------------------------------------------------


def shown_table(outcomes):
    """Return convergence from many starts, and every failure, as Markdown."""
    kept, left = seen(outcomes), [o for o in outcomes if not o.in_view]
    lines = [
        f"**{sum(o.converged for o in kept)} of {len(kept)}** starts whose path stays in view "
        f"converged to within the noise; {len(left)} more left the view.",
        "",
        *head(
            "gravity", "in view", "converged", "settled, median (slowest)",
            "error at the end, median (largest)", "peak torque, median (largest)",
            "asked for too much torque",
        ),
    ]  # fmt: skip
    for gravity in ("exact", "learnt"):
        mine = [o for o in kept if o.case.gravity == gravity]
        if mine:
            lines.append(
                row(
                    gravity,
                    len(mine),
                    sum(o.converged for o in mine),
                    both([o.settling_time for o in mine if o.converged], ".1f", " s"),
                    both([o.final_error for o in mine], ".2f", " px"),
                    both([o.peak_torque for o in mine], ".2f", ""),
                    sum(o.peak_torque > 1.0 for o in mine),
                )
            )
    failed = [f"- {named(o)}" for o in kept if not o.converged]
    out = [f"- {named(o)}, out of view from {o.left_at:.2f} s" for o in left]
    lines += ["", "Failures with the path in view:", "", *(failed or ["- none"])]
    lines += ["", "Not counted, as they left the view:", "", *(out or ["- none"]), ""]
    return "\n".join(lines) + "\n"


def named(outcome):
    """Return a run by its seed, and what became of it."""
    case, errors = outcome.case, ""
    if math.isfinite(outcome.final_error):
        errors = f"{outcome.start_error:.0f} -> {outcome.final_error:.2g} px; "
    return f"seed {case.seed}, gravity {case.gravity}: {errors}{outcome.reason or 'converged'}"


def compared_table(outcomes):
    """Return the comparison, scene by scene, as Markdown."""
    lines = []
    for scene in dict.fromkeys(o.case.scene for o in outcomes):
        mine = [o for o in outcomes if o.case.scene == scene]
        lines += [f"Comparison, {scene}:", ""]
        lines += head(
            "noise", "law", "converged", "settled, median", "error at the end, median",
            "roughness of the torque, median", "peak torque, median", "asked for too much torque",
            "left the view",
        )  # fmt: skip
        lines += [numbers(group) for group in groups(mine).values()]
        lines.append("")
    return "\n".join(lines)


def failed_table(outcomes):
    """Return what did not converge in the comparison, scene by scene, as Markdown."""
    lines = []
    for scene in dict.fromkeys(o.case.scene for o in outcomes):
        mine = [o for o in outcomes if o.case.scene == scene]
        lines += [f"What did not converge, {scene}:", "", *kinds(mine), ""]
    return "\n".join(lines)


def groups(outcomes):
    """Return the outcomes by noise and law."""
    found = {}
    for outcome in outcomes:
        found.setdefault((outcome.case.noise, outcome.case.law), []).append(outcome)
    return found


def numbers(mine):
    """Return the row of one law with one noise."""
    return row(
        f"{mine[0].case.noise:g} px",
        mine[0].case.law,
        f"{sum(o.converged for o in mine)} of {len(mine)}",
        number(settled(mine), ".1f", " s"),
        number(float(np.median([o.final_error for o in mine])), ".2g", " px"),
        number(roughness(mine), ".2g", " N m"),
        number(median([o.peak_torque for o in mine]), ".2f"),
        sum(o.peak_torque > 1.0 for o in mine),
        sum(not o.in_view for o in mine),
    )


def kinds(outcomes):
    """Return every kind of failure of each law, with the noises and seeds."""
    found = {}
    for o in outcomes:
        if not o.converged:
            seeds = found.setdefault((o.case.law, o.reason), {})
            seeds.setdefault(o.case.noise, []).append(o.case.seed)
    lines = []
    for (law, reason), noises in found.items():
        where = "; ".join(
            f"{noise:g} px: seeds {', '.join(map(str, seeds))}" for noise, seeds in noises.items()
        )
        lines.append(f"- {law}, {sum(map(len, noises.values()))} × {reason} ({where})")
    return lines or ["- none"]


def settled(mine):
    """Return the median settling time [s]: a run that does not settle takes longer than any."""
    times = [o.settling_time for o in mine]
    return float(np.median([t if math.isfinite(t) else math.inf for t in times]))


def roughness(mine):
    """Return the median roughness [N m] in view: an arm that sees nothing stands still."""
    return median([o.roughness for o in seen(mine)])


def median(values):
    """Return the median of the finite numbers; NaN of none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def both(values, form, unit):
    """Return median and largest of the finite numbers as text."""
    finite = [value for value in values if math.isfinite(value)]
    return f"{np.median(finite):{form}} ({max(finite):{form}}){unit}" if finite else "–"


def number(value, form, unit=""):
    """Return a number as text."""
    return f"{value:{form}}{unit}" if math.isfinite(value) else "–"


def draw(outcomes):
    """Draw convergence, error, roughness and peak of the torque against noise, law by law."""
    panels = {
        "converged to within the noise [%]": lambda g: 100.0 * np.mean([o.converged for o in g]),
        "error at the end, median [px], at least 0.01": lambda g: max(
            0.01, float(np.median([o.final_error for o in g]))
        ),
        "torque roughness at the end, median [N m], at least 0.001": lambda g: max(
            roughness(g), 1e-3
        ),
        "peak torque / its limit, median": lambda g: median([o.peak_torque for o in g]),
    }
    grouped = groups([o for o in outcomes if o.case.scene == ONE_POINT])
    noises = sorted({noise for noise, _ in grouped})
    figure, axes = view.new_figure(2, 2, size=(9.4, 8.2), title=ONE_POINT)
    with view.style():
        for i, (ax, (label, value)) in enumerate(zip(axes, panels.items(), strict=True)):
            for k, (name, law) in enumerate(LAWS.items()):
                # beside each other, or equal ones would hide each other
                places = np.arange(len(noises)) + 0.03 * (k - 0.5 * (len(LAWS) - 1))
                ax.plot(
                    places, [value(grouped[noise, name]) for noise in noises], "osv^D<>P"[k], ms=5,
                    linestyle="--" if law.gains or law.damping else "-",
                    color=(*view.SERIES, "0.5")[k % (len(view.SERIES) + 1)], label=name,
                )  # fmt: skip
            ax.set_xticks(range(len(noises)), [f"{noise:g}" for noise in noises])
            ax.set(xlabel="noise of the image [px]", ylabel=label)
            if i > 0:
                ax.set_yscale("log")
        axes[3].axhline(1.0, color="0.5", linewidth=1.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/servo")
    options.add_argument("--starts", type=int, default=100, help="whose path stays in view")
    options.add_argument("--comparisons", type=int, default=8, help="starts of each law and noise")
    options.add_argument(
        "--limits", action="store_true", help="keep the URDF's limits from the many starts"
    )
    given = options.parse_args(arguments)
    starts, comparisons = (12, 1) if given.quick else (given.starts, given.comparisons)
    scene = WITHIN_LIMITS if given.limits else ONE_POINT
    shown = from_many_starts(starts, scene, given.jobs)
    compared = run_all(run_case, comparison(comparisons), given.jobs)
    tables = {
        "servo.md": shown_table(shown) + compared_table(compared),
        "servo_failures.md": failed_table(compared),
    }
    kept = seen(shown)
    done = sum(o.converged for o in kept)
    write(given.out, tables, {"shown": shown, "compared": compared})
    if compared:
        view.save_figure(draw(compared), given.out / "servo_noise")
    return 0 if len(kept) >= starts and done >= WANTED * len(kept) else 1


if __name__ == "__main__":
    sys.exit(main())
