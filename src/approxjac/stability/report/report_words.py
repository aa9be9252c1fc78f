"""Words of a `StabilityReport`: the verdict, what it covers, and the tests it rests on."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from approxjac.controllers import Latency
from approxjac.formatting import joined, numbers_of, percent, wrapped
from approxjac.stability.certificates.certificate import MatrixTest
from approxjac.stability.errors.region import JointBox
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import OF_WRONG_AXES
from approxjac.stability.loop.local import LocalTest
from approxjac.stability.loop.samples import Samples
from approxjac.stability.report import report_starts
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.validation import Array

if TYPE_CHECKING:
    from approxjac.stability.report.report import StabilityReport

Row = tuple[str, str, str]
"""Of the table: test, verdict, and the figures it rests on."""

_TINY = 1e-6
_BEWARE = ""
_SECTIONS = {
    _BEWARE: "beware",
    "as it runs": "as it runs (what the verdict is about)",
    "torque limits": "torque limits",
    "rollouts": "rollouts (simulated as it runs)",
    "in continuous time": "in continuous time (as if sampled infinitely fast, to compare)",
    "worst case": "worst cases (what to look at first)",
}

_FAMILIES = {
    "paper": "paper's weights",
    "free": "free potential",
    "wide": "widened",
    "full": "coupled",
}


def verdict(report: StabilityReport) -> str:
    """Return in one line whether the loop as it runs is certified, and why not."""
    runs = _timed(report.latency)
    if report.certified_by is not None and report.sampled is not None:
        if_it_stays = "" if report_starts.are_any(report) else f", {report_starts.IF_IT_STAYS}"
        margin = report.sampled.margin
        return f"certified: yes, margin {margin:.2g}, as it runs at {runs}{if_it_stays}"
    if report.passed:
        margin = max(test.margin for test in report.matrix.values())
        return (
            f"certified: in continuous time only, margin {margin:.2g}; with learnt gravity there "
            f"is no certificate as it runs at {runs}"
        )
    return f"certified: no, as it runs at {runs}: {report.reason}"


def text(report: StabilityReport) -> str:
    """Return all of it: the verdict, what it means, what it is about, and the figures."""
    rows = table(report)
    lines = [*wrapped(verdict(report)), *wrapped(_meaning(report))]
    lines += _block("about", [(name, "", told) for name, told in _about(report)])
    for section, title in _SECTIONS.items():
        found = [row for row in rows if _section(row) == section]
        lines += _block(title, [(row[0].removeprefix(f"{section}, "), *row[1:]) for row in found])
    return "\n".join(lines)


def table(report: StabilityReport) -> list[Row]:
    """Return a row for each test, and what else there is to be told."""
    return [
        *_beware(report),
        *_as_it_runs(report),
        *([] if report.limits is None else report.limits.rows()),
        *_in_continuous_time(report),
        *([] if report.rollouts is None else _rollouts(report.rollouts)),
    ]


def _section(row: Row) -> str:
    """Return the part of the text that a row is in."""
    return next((name for name in _SECTIONS if name and row[0].startswith(name)), _BEWARE)


def _block(title: str, rows: list[Row]) -> list[str]:
    """Return rows below their title, wrapped; nothing where there are none."""
    if not rows:
        return []
    first, second = (max(len(row[k]) for row in rows) for k in range(2))
    lines = []
    for name, said, figures in rows:
        start = f"  {name:<{first}}  " + (f"{said:<{second}}  " if second else "")
        lines += wrapped(figures, start)
    return ["", *wrapped(title), *lines]


def _meaning(report: StabilityReport) -> str:
    """Return what follows from the verdict, in a sentence or two."""
    runs = report.rollouts
    left = f" It left the region in {runs.n_left} of {runs.n} rollouts." if runs else ""
    if report.certified_by is not None:
        return (
            f"{report_starts.told(report)}{left} Checked on samples of the region, not proven "
            "between them."
        )
    if report.passed:
        return (
            "Sampled infinitely fast, the error would go to zero as long as the arm stays in the "
            f"region.{left} As it runs nothing is proven, though no instability was found."
        )
    judged = replace(report, gravity_error=0.0) if report.loop.takers else report
    if judged.contradiction:
        rounded = " Some tests round the delays: see beware." if _counted(report.latency) else ""
        return f"This is a problem found in the loop, not just a missing proof.{rounded}"
    where = "near targets and rollouts" if runs else "near targets"
    return f"No proof was found. The loop may still be stable: see {where}."


def _about(report: StabilityReport) -> list[tuple[str, str]]:
    """Return what the verdict is about."""
    truth, latency = report.loop.truth, report.latency
    errors = truth.describe_box() if isinstance(truth, Uncertainty) else "one true robot"
    late = [f"torques {_ms(latency.torque_delay)} late"] if latency.torque_delay else []
    if latency.velocity_filter:
        late.append(f"joint velocities filtered over {_ms(latency.velocity_filter)}")
    if latency.image_period or latency.image_age:
        every = f"every {_ms(latency.image_period)}, " if latency.image_period else ""
        late.append(f"x {every}{_ms(latency.image_age)} old on arrival")
    learns = report.loop.controller.adaptation is not None
    gravity = "gravity is learnt" if learns else "gravity is known exactly"
    paper = report.matrix["paper"]
    return [
        ("law", report.loop.controller.describe()[0]),
        ("timing", ", ".join([f"a period of {_ms(latency.period)}", *(late or ["no delays"])])),
        ("errors", errors),
        ("region", str(report.loop.region)),
        ("assumed", f"{gravity}, friction is viscous, no torque limit or joint stop is reached"),
        (
            "drawn",
            f"{len(paper.margins)} configurations to choose Lyapunov functions, {paper.checked} "
            f"others to check them, seed {report.seed}; nothing is proven between them",
        ),
        ("margin", "share of the designed damping left in the worst configuration: above 0 passes"),
    ]


def _beware(report: StabilityReport) -> list[Row]:
    """Rows about what is not as certificates assume, or as one may think."""
    rows = []
    if not report.gravity_is_exact:
        rows.append(("gravity", "not exact", _wrong_gravity(report)))
    if report.singular_q is not None:
        figures = (
            "the estimated Jacobian loses rank in the region, where the arm may stand still "
            f"away from its target: at q = {_angles(report, report.singular_q, 3)}; nothing below "
            "holds there; a bound on sigma_min leaves such configurations out (RegularPart)"
        )
        rows.append(("rank", "not regular", figures))
    if report.damped_q is not None:
        figures = (
            "learning uses a damped pseudo-inverse near singular configurations, such as q = "
            f"{_angles(report, report.damped_q, 3)}, which nothing below covers; a bound on "
            "sigma_min leaves them out (RegularPart)"
        )
        rows.append(("learning", "damped", figures))
    beyond = _beyond_limits(report)
    if beyond:
        figures = (
            f"the region goes beyond those of {', '.join(beyond)}: the arm would stop there, "
            "which nothing below accounts for"
        )
        rows.append(("joint limits", "beyond", figures))
    counted = _counted(report.latency)
    if counted:
        rows.append(("timing", "rounded", counted))
    return rows


def _wrong_gravity(report: StabilityReport) -> str:
    """Return what a gravity torque does that is neither compensated nor learnt."""
    error, learning = f"{report.gravity_error:.3g} N m", report.loop.controller.adaptation
    if learning is None:
        return (
            f"off by up to {error}: the error does not go to 0 but to where K_p makes up for it, "
            "unless gravity is learnt (AdaptiveGravity); if it is known exactly, leave it out (a "
            "robot without gravity, NoGravity)"
        )
    told = f"no learnt gravity parameters explain up to {error} of it, {OF_WRONG_AXES}"
    learnt = report.loop.takers
    if not learnt:
        return (
            f"{told}: the error need not go to 0, unless a task force or joint torques are learnt, "
            "too (task_force, joint_torque)"
        )
    # at rest θ̂ stands still: Ĵ y = α s(e) = 0 with d, and y = 0 with w
    return (
        f"{told}; the learnt {' and '.join(learnt)} can take it up, and then the error is 0 where "
        "the arm comes to rest, but nothing is proven"
    )


def _beyond_limits(report: StabilityReport) -> list[str]:
    """Names of joints that the region lets go beyond their limits."""
    region, robot = report.loop.region, report.loop.plants[0].robot
    zero = robot.neutral()
    if isinstance(region, JointBox):
        middle = pin.difference(robot.model, zero, region.center)
        low, high = middle + region.lower, middle + region.upper
    else:
        motions = np.array([pin.difference(robot.model, zero, q) for q in report.samples.q])
        low, high = motions.min(axis=0), motions.max(axis=0)
    least, most = robot.position_limits
    beyond = (low < least - _TINY) | (high > most + _TINY)
    return [name for name, is_so in zip(robot.joint_names, beyond, strict=True) if is_so]


def _counted(latency: Latency) -> str:
    """Return how rollouts and the linearisation round times; empty where they do not."""
    period = latency.period
    dt, _, age, late = latency.in_samples()
    told = {
        "rollouts": _rounded(
            latency, period, round(latency.torque_delay / period), round(latency.image_age / period)
        ),
        "the linearisation near targets": _rounded(latency, dt, late, age),
    }
    if told["rollouts"] == told["the linearisation near targets"]:
        told = {" and ".join(told): told["rollouts"]}
    found = [f"{who} take {what}" for who, what in told.items() if what]
    return f"in whole periods, {'; '.join(found)}" if found else ""


def _rounded(latency: Latency, dt: float, late: int, age: int) -> str:
    """Return what whole samples of dt [s] make of a latency; empty where it is the same."""
    times = {"late": (latency.torque_delay, late * dt), "old": (latency.image_age, age * dt)}
    told = [
        f"{'torques' if how == 'late' else 'x'} as {_ms(now)} {how}, not {_ms(given)}"
        for how, (given, now) in times.items()
        if abs(given - now) > _TINY * latency.period
    ]
    if dt > latency.period * (1.0 + _TINY):
        told = [f"samples of {_ms(dt)}", *told]
    return ", ".join(told)


def _as_it_runs(report: StabilityReport) -> list[Row]:
    """Rows about the loop that is sampled and late."""
    sampled = report.sampled
    near = _near_targets(report)
    if sampled is None:
        return [near]
    said = "holds" if sampled.certified else "does not hold"
    if sampled.certified and report.reason:
        said = "withdrawn"
    rows = [("as it runs, matrix form", said, f"{_margin(sampled)} ({_FAMILIES[sampled.family]})")]
    if not report.reason:
        starts = ("as it runs, starts", "", report_starts.covered(report))
        rows += [starts, report_starts.staying(report)]
    return [*rows, *_longest(report), near]


def _margin(test: MatrixTest) -> str:
    """The margin of a test, and how far it is to be trusted."""
    if not math.isfinite(test.margin):
        return "the period and delays are too long for any function of this kind"
    told = f"margin {test.margin:.3g}"
    if test.certified:
        told += f"; 0 of {test.checked} further configurations violate it"
        if test.independent:
            most = 100 * test.violating_at_most
            told += f", so at most {most:.2g} % of all do (95 % confidence)"
    elif test.margin > 0.0:
        told += f"; {test.violations} of {test.checked} further configurations violate it"
    else:
        told += f"; positive in {100 * test.share:.3g} % of the configurations"
    return told


def _near_targets(report: StabilityReport) -> Row:
    """Row about the exact linearisation of the loop as it runs."""
    unstable, worst = report.spectral_radii >= 1.0, float(report.spectral_radii.max())
    dt, frames, _, _ = report.latency.in_samples()
    if unstable.any():
        told = (
            f"errors grow at {unstable.sum()} of {len(unstable)} targets, at worst "
            f"{worst:.3g}-fold in {_ms(frames * dt)}"
        )
        return "as it runs, near targets", "unstable", told
    decay = -math.log(worst) / (frames * dt) if worst > 0.0 else math.inf
    told = f"at all {len(unstable)} targets; slowest decay {decay:.3g}/s{_learnt(report)}"
    return "as it runs, near targets", "stable", told


def _learnt(report: StabilityReport) -> str:
    """Return what is said of decays where parameters are learnt."""
    learns = report.loop.controller.adaptation is not None
    return " (learnt parameters, often slow, included)" if learns else ""


def _longest(report: StabilityReport) -> list[Row]:
    """Rows about how much slower and later the loop may be."""
    certified, exact = report.largest_period
    told = f"stable near targets {f'up to {_ms(exact)}' if exact else 'at no period tried'}"
    if not certified:
        return [("as it runs, longest period", "", f"{told}; the function found passes at none")]
    passes = f"the function found passes up to {_ms(certified)}, all else the same (margin 0 there)"
    rows = [("as it runs, longest period", "", f"{passes}; {told}")]
    delay, given = report.largest_delay, report.latency.torque_delay
    late = f"the function found passes {f'up to {_ms(delay)}' if delay else 'at none'}"
    late += ", all else the same" + (f"; here it is {_ms(given)}" if given else "")
    return [*rows, ("as it runs, longest delay of torques", "", late)]


def _in_continuous_time(report: StabilityReport) -> list[Row]:
    """Rows about the same loop if it were sampled infinitely fast."""
    first = report.theorem1
    passed = "holds" if report.is_as_assumed else "would hold"
    figures = (
        f"Jacobian error p = {first.p:.3g} {'<' if first.holds else '>='} "
        f"{max(first.allowed_p, 0.0):.3g} allowed{first.too_fast}"
    )
    said = passed if first.holds else "does not hold"
    rows = [("in continuous time, Theorem 1", said, figures)]
    for family, test in report.matrix.items():
        said = passed if test.certified else "does not hold"
        rows.append((f"in continuous time, {_FAMILIES[family]}", said, _margin(test)))
    local = report.local
    decays, slowest = local.decay_rates, local.decay_rates.min()
    said = "stable" if local.stable else "unstable"
    figures = (
        f"at all {len(decays)} targets; slowest decay {slowest:.3g}/s{_learnt(report)}, "
        f"damping ratio {local.damping_ratios.min():.2g}"
    )
    if not local.stable:
        grow = (decays <= 0.0).sum()
        figures = f"errors grow at {grow} of {len(decays)} targets, at worst at {-slowest:.3g}/s"
    rows.append(("in continuous time, near targets", said, figures))
    form = report.sampled or list(report.matrix.values())[-1]
    worst: list[tuple[str, Samples | LocalTest, int]] = [
        ("matrix form", report.samples, form.worst),
        ("near targets", local, local.worst),
        ("Theorem 1", report.samples, first.worst["p"]),
    ]
    rows += [(f"worst case, {name}", "", _case(report, among, k)) for name, among, k in worst]
    return rows


def _rollouts(found: Rollouts) -> list[Row]:
    """Rows about simulated runs."""
    low, high = found.interval
    worst, setting = found.worst, found.setting
    unit = joined(setting.controller.task.units)
    ended = "diverged" if worst.diverged else f"ended {worst.final_error:.3g} {unit} off"
    values = setting.uncertainty.describe(worst.values)
    torques: list[Row] = []
    if found.n_beyond_torque:
        torques = [("rollouts, torques", *found.beyond_torque)]
    return [
        (
            "rollouts, converged",
            f"{found.n_converged} of {found.n}",
            f"within {setting.accuracy:g} {unit} throughout the last tenth of {setting.duration:g} "
            f"s; {percent(low)} to {percent(high)} % of all do (95 % confidence)",
        ),
        ("rollouts, diverged", f"{found.n_diverged} of {found.n}", ""),
        ("rollouts, left the region", f"{found.n_left} of {found.n}", "without diverging"),
        *torques,
        ("rollouts, worst", f"run {worst.index}", f"{ended}, with {values}"),
    ]


def _case(report: StabilityReport, among: Samples | LocalTest, index: int) -> str:
    """One of the cases: the true robot and the configuration."""
    q = _angles(report, among.q[index], 2)
    return f"{report.describe_truth(int(among.truth[index]))} at q = {q}"


def _angles(report: StabilityReport, q: Array, digits: int) -> str:
    """Return a configuration as one number a joint."""
    return numbers_of(report.loop.plants[0].robot.angles(q).round(digits))


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def _timed(latency: Latency) -> str:
    rate = 1.0 / latency.period
    runs = f"{1e-3 * rate:.3g} kHz" if rate >= 1e3 else f"{rate:.3g} Hz"
    return f"{runs} with its delays" if latency.of_position > latency.period else runs
