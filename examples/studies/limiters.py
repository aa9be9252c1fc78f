"""Compare torque limiters on the same reaches, while the motors get weaker.

Each case is a random start and target of an arm whose effort limits are scaled, run with every
limiter. docs/studies/limiters.md says what comes out.

    python examples/studies/limiters.py --out results/limiters

Exit code 1 means that the QP broke a torque limit, that V̇ exceeded −W by more than the slack that a
limiter reported, or that with the weakest motors fewer runs converged within the joints' limits
with the QP than with clipping.
"""

import math
import sys
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np
import usual_limiters
from common import carried_object, head, parser, plain_law, row, run_all, write
from lyapunov_decrease import Decrease, decrease

import approxjac as aj
from approxjac import view
from approxjac.scenario import Scenario, build_scenario, run_scenario
from approxjac.scenario.starts import regular_configuration

ROBOTS = ("panda", "xarm7", "two_link")
SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)
LIMITERS = ("qp", "qp-torque", "clip", "scale")
TORQUE_TOLERANCE = 1e-9  # by which rounding may carry a torque beyond its limit [N m or N]
SETTLING_TIME = 0.5  # gains fast enough for limits to matter [s]
TRIES = 20_000  # few configurations can be held with weak motors
RESERVE, SPEED = 2.0, 3.0  # where a URDF knows no limits: over the weight, and [rad/s]
AT_LIMIT = 0.01  # beyond its position limits a joint may be [rad]
STATUSES = {
    "FREE": "free",
    "LIMITED": "limited",
    "PROOF_KEPT": "kept",
    "PROOF_GIVEN_UP": "given up",
    "INFEASIBLE": "infeasible",
    "SOLVER_FAILED": "failed",
}


class Case(NamedTuple):
    """A start and a target of an arm whose effort limits are scaled."""

    robot: str
    scale: float
    seed: int
    duration: float


class Outcome(NamedTuple):
    """What became of one case with one limiter."""

    case: Case
    limiter: str
    start_error: float = math.nan  # [m]
    final_error: float = math.inf  # [m]
    settling_time: float = math.nan  # [s]
    converged: bool = False
    within: bool = False  # converged, and no joint was beyond its position limits
    reason: str = ""  # that it did not converge
    peak_torque: float = math.nan  # as a share of what the motor delivers
    torque_violation: float = math.nan  # beyond its limit, in any step [N m or N]
    peak_speed: float = math.nan  # as a share of its limit
    position_excess: float = math.nan  # of a joint beyond its position limits [rad or m]
    statuses: dict = {}  # noqa: RUF012 - steps by name of the LimitStatus, never changed
    proof: Decrease | None = None


def run_case(case):
    """Run one case with every limiter, at 1 kHz, with motors that saturate."""
    built = prepare(case)
    return [run_limiter(case, name, built, limiter(name, built)) for name in LIMITERS]


def prepare(case):
    """Return the start, target and law that all limiters get, with their limits."""
    built, full = arm(case.robot)
    limits = replace(full, effort=case.scale * np.asarray(full.effort))
    effort, rng = np.asarray(limits.effort), np.random.default_rng(case.seed)
    sensor, task = built.plant.sensor, built.law.task
    q0, goal = (regular_configuration(sensor, task, rng, effort, TRIES) for _ in range(2))
    run = replace(built.scenario.run, duration=case.duration, seed=case.seed)
    return replace(
        built,
        scenario=replace(built.scenario, run=run),
        plant=aj.Plant(sensor.robot, sensor, torque_limits=effort),
        q0=q0,
        target=sensor.value(goal),
        limits=limits,
    )


@cache
def arm(robot):
    """Return an arm with an object believed absent and exact gravity, and its unscaled limits."""
    length, mass = carried_object(robot)
    built = build_scenario(
        Scenario(
            robot,
            true={"object": {"length": length, "mass": mass}},
            controller={"gravity": "exact", "settling_time": SETTLING_TIME, "limits": "none"},
        )
    )
    return plain_law(built, SETTLING_TIME), full_limits(built.plant.robot)


def full_limits(truth):
    """Return the limits of the URDF, and others in place of those that it does not know.

    An effort limit that is not known is twice the largest gravity torque of the joint over 2000
    seeded configurations of the true arm, a speed limit 3 rad/s.
    """
    dynamics, rng = aj.robots.Dynamics(truth), np.random.default_rng(0)
    weights = [np.abs(dynamics.g(truth.random_configuration(rng))) for _ in range(2000)]
    effort, velocity = truth.effort_limits, truth.velocity_limits
    return aj.Limits(
        np.where(np.isfinite(effort), effort, RESERVE * np.max(weights, axis=0)),
        position=truth.position_limits,
        velocity=np.where(np.isfinite(velocity), velocity, SPEED),
    )


def limiter(name, built):
    """Return a limiter by its name."""
    law, limits = built.law, built.limits
    if name == "clip":
        return usual_limiters.clipped(law, limits)
    if name == "scale":
        return usual_limiters.TaskTorqueScaled(law, aj.Limits(limits.effort, limits.rate))
    if name == "qp-torque":
        limits = aj.Limits(limits.effort)
    return aj.TorqueLimited(law, limits)


def run_limiter(case, name, built, controller):
    """Run a case with one limiter; what cannot run is an outcome too."""
    tally = Tally(np.asarray(built.limits.effort))
    try:
        result = run_scenario(replace(built, controller=controller), observer=tally)
    except aj.errors.ApproxJacError as error:
        return Outcome(case, name, reason=f"{error}")
    run = result.run
    plant = aj.Plant(built.plant.robot, built.plant.sensor)
    alpha = aj.TorqueLimited(built.law).alpha
    return Outcome(
        case,
        name,
        start_error=float(run.error_norm[0]),
        final_error=float(run.error_norm[-1]),
        settling_time=result.settling_time,
        converged=result.converged,
        within=result.converged and result.joint_limit_excess <= AT_LIMIT,
        reason=result.reason,
        peak_torque=result.peak_torque_ratio,
        torque_violation=tally.torque_violation,
        peak_speed=result.peak_speed_ratio,
        position_excess=result.joint_limit_excess,
        statuses={status.name: n for status, n in sorted(tally.counts.items())},
        proof=decrease(plant, built.law, alpha, run, tally.effort),
    )


class Tally:
    """An observer that counts what limits did in every step, of which a record has only some."""

    def __init__(self, effort):
        self.effort, self.counts, self.torque_violation = effort, Counter(), 0.0

    def __call__(self, loop):
        """Count a step."""
        self.counts[loop.answer.limit_status] += 1
        beyond = float((np.abs(loop.answer.torque) - self.effort).max())
        self.torque_violation = max(self.torque_violation, beyond)


# -- tables ---------------------------------------------------------------------------------------


def groups(outcomes):
    """Return the outcomes by arm, scale (the largest first) and limiter."""
    keys = dict.fromkeys((o.case.robot, o.case.scale, o.limiter) for o in outcomes)
    robots = list(dict.fromkeys(key[0] for key in keys))
    order = sorted(keys, key=lambda k: (robots.index(k[0]), -k[1], LIMITERS.index(k[2])))
    return {
        key: [o for o in outcomes if (o.case.robot, o.case.scale, o.limiter) == key]
        for key in order
    }


def table(outcomes):
    """Return how often each limiter did the task, as Markdown."""
    grouped = groups(outcomes)
    robots = dict.fromkeys(robot for robot, _, _ in grouped)
    places = dict.fromkeys((robot, scale) for robot, scale, _ in grouped)
    lines = head("arm", "limits", "runs", *LIMITERS)
    for robot, scale in places:
        mine = [grouped[robot, scale, name] for name in LIMITERS]
        lines.append(row(robot, f"× {scale:g}", len(mine[0]), *map(done, mine)))
    for scale in dict.fromkeys(scale for _, scale in places) if len(robots) > 1 else ():
        mine = [
            list(chain.from_iterable(grouped.get((robot, scale, name), ()) for robot in robots))
            for name in LIMITERS
        ]
        lines.append(row("**all**", f"× {scale:g}", len(mine[0]), *map(done, mine)))
    return "\n".join([*lines, "", proof_line(grouped)]) + "\n"


def arms(outcomes):
    """Return all numbers arm by arm, then failures, as Markdown."""
    grouped, lines = groups(outcomes), []
    for robot in dict.fromkeys(robot for robot, _, _ in grouped):
        lines += head(
            robot, "limiter", "settled", "V̇ > −W", "by at most", "peak torque",
            "beyond torque limits", "speed, median (largest)", "beyond position limits",
            " / ".join(STATUSES.values()),
        )  # fmt: skip
        lines += [
            row(f"× {scale:g}", name, *numbers(mine))
            for (each, scale, name), mine in grouped.items()
            if each == robot
        ]
        lines.append("")
    lines += ["Runs that did not do the task, or did it beyond the joints' limits:", ""]
    return "\n".join([*lines, *failures(outcomes)]) + "\n"


def done(mine):
    """Return how many runs did the task within the joints' limits, and wherever these went."""
    return f"{sum(o.within for o in mine)} ({sum(o.converged for o in mine)})"


def proof_line(grouped):
    """Return what came of comparing V̇ with −W."""
    proofs = [[o.proof for o in mine if o.proof is not None] for mine in grouped.values()]
    found = list(chain.from_iterable(proofs))
    usual = median([median([proof.usual_error for proof in mine]) for mine in proofs])
    return (
        f"V̇ was compared with −W at {sum(p.instants for p in found)} instants, by differences with "
        f"an error of {usual:.1g} W usually and {most(p.error for p in found):.1g} W at most; "
        f"{sum(p.singular for p in found)} near a singular Ĵ are left out. V̇ was above −W by more "
        f"than the slack that was reported (and the error) at {sum(p.breaches for p in found)} of "
        f"them; the largest V̇ + W − σ is {most(p.largest_breach for p in found):.1g} W."
    )


def risen(mine):
    """Return the share of the instants with V̇ > −W."""
    proofs = [o.proof for o in mine if o.proof is not None]
    instants = sum(proof.instants for proof in proofs)
    return sum(proof.risen for proof in proofs) / instants if instants else math.nan


def numbers(mine):
    """Return the cells of a row: all runs of one arm at one scale with one limiter."""
    settled = median([o.settling_time for o in mine if o.converged])
    violation = most(o.torque_violation for o in mine)
    speeds = [o.peak_speed for o in mine]
    counts = sum((Counter(o.statuses) for o in mine), Counter())
    # what is there but less than a half of a per cent is not shown as nothing
    shares = [counts[name] / max(1, counts.total()) for name in STATUSES]
    texts = ["<1" if 0.0 < share < 0.005 else f"{100.0 * share:.0f}" for share in shares]
    return (
        f"{settled:.1f} s" if math.isfinite(settled) else "–",
        f"{100.0 * risen(mine):.0f} %",
        f"{max(0.0, most(o.proof.largest_excess for o in mine if o.proof)):.3g} W",
        f"{most(o.peak_torque for o in mine):.2f}",
        f"{violation:.0e} N m" if violation else "0",
        f"{median(speeds):.2f} ({most(speeds):.1f})",
        f"{most(o.position_excess for o in mine):.3f} rad",
        f"{' / '.join(texts)} %",
    )


def failures(outcomes):
    """Return each kind of failure of each limiter: how often, at which scales, and one of them."""
    lines = []
    for name in LIMITERS:
        kinds = {}
        for outcome in outcomes:
            if outcome.limiter == name and not outcome.within:
                kinds.setdefault(kind(outcome), []).append(outcome)
        for text, mine in sorted(kinds.items(), key=lambda item: -len(item[1])):
            scales = sorted(Counter(o.case.scale for o in mine).items(), reverse=True)
            where = ", ".join(f"{n} at {scale:g}" for scale, n in scales)
            lines.append(f"- {name}, {len(mine)} × {text} ({where}); {example(mine[0])}")
    return lines or ["- none"]


def kind(outcome):
    """Return what went wrong, without the names and numbers of the run."""
    if outcome.converged:
        return f"done, but with a joint more than {AT_LIMIT:g} rad beyond its position limits"
    if outcome.reason.startswith("within the tolerance"):
        return "within the tolerance too late to judge"
    return outcome.reason.split(":")[0]


def example(outcome):
    """Return one run of a kind of failure, in words."""
    case, off = outcome.case, outcome.position_excess
    errors = f"{1e3 * outcome.start_error:.0f} -> {1e3 * outcome.final_error:.2g} mm"
    beyond = f", a joint {off:.2g} rad beyond its limits" if off > AT_LIMIT else ""
    detail = "" if outcome.reason in ("", kind(outcome)) else f", {outcome.reason}"
    return f"such as {case.robot}, seed {case.seed}: {errors}{beyond}{detail}"


def shortcomings(outcomes):
    """Return what fell short of what the QP promises; nothing if it kept all."""
    found = []
    violation = most(o.torque_violation for o in outcomes if o.limiter.startswith("qp"))
    if violation > TORQUE_TOLERANCE:
        found.append(f"qp went beyond a torque limit by {violation:.2g} N m")
    proofs = [o.proof for o in outcomes if o.proof is not None]
    breaches = sum(proof.breaches for proof in proofs)
    if breaches:
        worst = most(proof.largest_breach for proof in proofs)
        found.append(
            f"at {breaches} instants V̇ was above −W by more than the slack that was reported, by "
            f"up to {worst:.2g} W"
        )
    weakest = min(o.case.scale for o in outcomes)
    kept = Counter(o.limiter for o in outcomes if o.within and o.case.scale == weakest)
    if kept["qp"] < kept["clip"]:
        found.append(
            f"at {weakest:g} of the limits fewer runs converged within the joints' limits with qp "
            f"({kept['qp']}) than with clip ({kept['clip']})"
        )
    return found


def median(values):
    """Return the median of the finite numbers; NaN of none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def most(values):
    """Return the largest of the finite numbers; −∞ of none."""
    return max((float(value) for value in values if math.isfinite(value)), default=-math.inf)


def draw(outcomes):
    """Draw convergence, speeds and V̇ > −W against the scale of the limits, an arm a column."""
    grouped = groups(outcomes)
    robots = list(dict.fromkeys(robot for robot, _, _ in grouped))
    panels = {
        "task done within joint limits [%]": lambda mine: 100.0 * np.mean([o.within for o in mine]),
        "largest speed / its limit, median": lambda mine: median([o.peak_speed for o in mine]),
        "instants with V̇ > −W [%]": lambda mine: 100.0 * risen(mine),
    }
    figure, axes = view.new_figure(len(robots), 3, size=(4.2 * len(robots), 9.4))
    with view.style():
        for i, (label, value) in enumerate(panels.items()):
            for j, robot in enumerate(robots):
                ax = axes[i * len(robots) + j]
                for name, color, marker in zip(LIMITERS, view.SERIES, "os^D", strict=False):
                    mine = {s: g for (r, s, n), g in grouped.items() if (r, n) == (robot, name)}
                    line = [value(group) for group in mine.values()]
                    ax.plot(list(mine), line, color=color, marker=marker, ms=5, label=name)
                    if i == 0:
                        anywhere = [
                            100.0 * np.mean([o.converged for o in g]) for g in mine.values()
                        ]
                        ax.plot(list(mine), anywhere, color=color, linestyle=":")
                scales = sorted({scale for _, scale, _ in grouped})
                ax.set_xscale("log")
                ax.set_xticks(scales, [f"{scale:g}" for scale in scales])
                ax.minorticks_off()
                ax.set(xlabel="effort limits, share of the full ones")
                ax.set(ylabel=label if j == 0 else "", title=robot if i == 0 else "")
                if i == 1:
                    ax.set_yscale("log", base=2)
                    ax.yaxis.set_major_formatter("{x:g}")
                    ax.axhline(1.0, color="0.5", linewidth=1.0)
                else:
                    ax.set_ylim(-4.0, 104.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(labels), frameon=False,
            title="dotted: the task was done, wherever the joints went",
        )  # fmt: skip
    return figure


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/limiters")
    options.add_argument("--robots", nargs="+", default=ROBOTS)
    options.add_argument("--scales", nargs="+", type=float, default=SCALES)
    options.add_argument("--starts", type=int, default=15, help="for each arm and scale")
    options.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    given = options.parse_args(arguments)
    scales, starts = ((1.0, 0.5), 2) if given.quick else (given.scales, given.starts)
    cases = [  # those of weak motors first, as they take longest
        Case(robot, scale, seed, given.duration)
        for scale in sorted(scales)
        for robot in given.robots
        for seed in range(starts)
    ]
    outcomes = list(chain.from_iterable(run_all(run_case, cases, given.jobs)))
    short = shortcomings(outcomes)
    summary = {"shortcomings": short, "runs": outcomes}
    tables = {"limiters.md": table(outcomes), "limiters_arms.md": arms(outcomes)}
    write(given.out, tables, summary)
    view.save_figure(draw(outcomes), given.out / "limiters")
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
