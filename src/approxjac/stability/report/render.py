"""The one renderer of rows: for the terminal, and for summary.json."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from approxjac.formatting import numbers_of, percent, plain, wrapped
from approxjac.stability.report.rows import FAMILIES, Row

OF_WRONG_AXES = "as of wrong joint axes or a tilted base"
_IF_IT_STAYS = "as long as the arm stays in the region"
_PARTS = {
    "beware": "beware",
    "sampled": "sampled, with delays (what the verdict is about)",
    "limits": "torque limits",
    "rollouts": "rollouts (simulated, sampled, with delays)",
    "continuous": "in continuous time (to compare)",
    "worst": "worst cases (what to look at first)",
}
_REASONS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "gravity": lambda f: f"gravity is off by up to {f['error']:.3g} N m",
    "rank": lambda f: "the estimated Jacobian loses rank in the region",
    "damped": lambda f: (
        "the region holds configurations near singular ones, where learning is damped"
    ),
    "motors": lambda f: "the motors cannot hold the arm everywhere in the region",
    "unstable": lambda f: (
        f"errors grow at {100.0 * f['share']:.3g} % of the targets (exact linearisation)"
    ),
    "unstable in continuous time": lambda f: "errors grow at some targets in continuous time",
    "rollouts diverged": lambda f: f"{f['diverged']} of {f['runs']} rollouts diverged",
    "violated": lambda f: (
        f"the Lyapunov function found fails in {f['violations']} of "
        f"{f['checked']} further configurations"
    ),
    "too slow": lambda f: "no Lyapunov function was found for this period and these delays",
    "none": lambda f: "no Lyapunov function was found, not even in continuous time",
    "learnt": lambda f: "with learnt gravity there are certificates in continuous time only",
    "learnt, none": lambda f: (
        "with learnt gravity there are certificates in continuous time only, and none was found"
    ),
}


def text(rows: Sequence[Row]) -> str:
    """Return all of a report: the verdict, what it means and is about, and the figures."""
    verdict, covers = (row for row in rows if row.part == "verdict")
    lines = [*wrapped(headline(verdict)), *wrapped(meaning(covers))]
    lines += _block("about", [row for row in rows if row.part == "about"])
    for part, title in _PARTS.items():
        lines += _block(title, [row for row in rows if row.part == part])
    return "\n".join(lines)


def as_json(rows: Iterable[Row]) -> dict[str, Any]:
    """Return rows as JSON has them: part → name → verdict and figures."""
    found: dict[str, Any] = {}
    for row in rows:
        verdict = {"verdict": row.verdict} if row.verdict else {}
        figures = {name: plain(value) for name, value in row.figures.items()}
        found.setdefault(row.part, {})[row.name] = verdict | figures
    return found


def headline(row: Row) -> str:
    """Return the verdict in one line."""
    f = row.figures
    rate = 1.0 / f["period"]
    runs = f"{1e-3 * rate:.3g} kHz" if rate >= 1e3 else f"{rate:.3g} Hz"
    runs = f"sampled at {runs} with its delays" if f["late"] else f"sampled at {runs}"
    if row.verdict == "yes":
        if_it_stays = "" if f["stays"] else f", {_IF_IT_STAYS}"
        return f"certified: yes, margin {f['margin']:.2g}, {runs}{if_it_stays}"
    if row.verdict == "no":
        return f"certified: no, {runs}: {_REASONS[f['reason']](f)}"
    return (
        f"certified: {row.verdict}, margin {f['margin']:.2g}; with learnt gravity there is no "
        f"certificate {runs}"
    )


def meaning(row: Row) -> str:
    """Return what follows from the verdict, in a sentence or two."""
    f = row.figures
    left = f" It left the region in {f['left']} of {f['runs']} rollouts." if "runs" in f else ""
    if row.verdict == "certified":
        return f"{starts(row)}{left} Checked on samples of the region, not proven between them."
    if row.verdict == "continuous":
        return (
            f"In continuous time the error would go to zero {_IF_IT_STAYS}.{left} Of the sampled "
            "loop nothing is proven, though no instability was found."
        )
    if row.verdict == "problem":
        rounded = " Some tests round the delays: see beware." if f["rounded"] else ""
        return f"This is a problem found in the loop, not just a missing proof.{rounded}"
    where = "near targets and rollouts" if "runs" in f else "near targets"
    return f"No proof was found. The loop may still be stable: see {where}."


def starts(row: Row) -> str:
    """Return for which starts a certificate holds, and how far the usual ones are away."""
    f = row.figures
    share, unit = f["share"], f["unit"]
    of_these = "all" if share == 1.0 else f"{percent(share)} %" if share else "none"
    goes = f"the error goes to zero {_IF_IT_STAYS}" if share else "is anything proven"
    away = f"{f['usual']:.2g} {unit} from their target in the median"
    begins = "From no start is it proven that the arm stays in the region"
    if f["radius"]:
        begins = (
            f"Covers starts at rest up to {f['error']:.2g} {unit} from their target "
            f"({_within(f)} of the region's middle)"
        )
    return f"{begins}. From {of_these} of the usual starts ({away}) {goes}."


def sentence(row: Row) -> str:
    """Return the figures of a row, as a sentence."""
    f = row.figures
    if row.part == "worst":
        return f"{f['worst_truth']} at q = {_angles(f['worst_q'], 2)}"
    if row.part == "limits" and row.verdict:
        return _LIMITS[row.verdict]
    if row.name in _MATRIX:
        return _margin(f)
    return _SENTENCES[row.part, row.name](f)


def in_one_line(rows: Iterable[Row]) -> str:
    """Return rows without their verdicts."""
    return "; ".join(f"{row.name}: {sentence(row)}" for row in rows)


def _block(title: str, rows: list[Row]) -> list[str]:
    """Return rows below their title, wrapped; nothing where there are none."""
    if not rows:
        return []
    first, second = (max(len(row[k]) for row in rows) for k in (1, 2))
    lines = []
    for row in rows:
        start = f"  {row.name:<{first}}  " + (f"{row.verdict:<{second}}  " if second else "")
        lines += wrapped(sentence(row), start)
    return ["", *wrapped(title), *lines]


def _timing(f: Mapping[str, Any]) -> str:
    late = [f"torques {_ms(f['torque_delay'])} late"] if f["torque_delay"] else []
    if f["velocity_filter"]:
        late.append(f"joint velocities filtered over {_ms(f['velocity_filter'])}")
    if f["image_period"] or f["image_age"]:
        every = f"every {_ms(f['image_period'])}, " if f["image_period"] else ""
        late.append(f"x {every}{_ms(f['image_age'])} old on arrival")
    return ", ".join([f"a period of {_ms(f['period'])}", *(late or ["no delays"])])


def _gravity(f: Mapping[str, Any]) -> str:
    """What a gravity torque does that is neither compensated nor learnt."""
    error = f"{f['error']:.3g} N m"
    if not f["learns"]:
        return (
            f"off by up to {error}: the error does not go to 0 but to where K_p makes up for it, "
            "unless gravity is learnt (AdaptiveGravity); if it is known exactly, leave it out (a "
            "robot without gravity, NoGravity)"
        )
    known = f"no learnt gravity parameters explain up to {error} of it, {OF_WRONG_AXES}"
    if not f["by"]:
        return (
            f"{known}: the error need not go to 0, unless a task force or joint torques are "
            "learnt, too (task_force, joint_torque)"
        )
    # at rest θ̂ stands still: Ĵ y = α s(e) = 0 with d, and y = 0 with w
    return (
        f"{known}; the learnt {' and '.join(f['by'])} can take it up, and then the error is 0 "
        "where the arm comes to rest, but nothing is proven"
    )


def _rounded(f: Mapping[str, Any]) -> str:
    """How rollouts and the linearisation round times."""
    names = {"rollouts": "rollouts", "near targets": "the linearisation near targets"}
    taken = {names[who]: ", ".join(_taken(each)) for who, each in f.items()}
    if len(taken) == 2 and len(set(taken.values())) == 1:
        taken = {" and ".join(taken): next(iter(taken.values()))}
    found = [f"{who} take {what}" for who, what in taken.items()]
    return f"in whole periods, {'; '.join(found)}"


def _taken(times: Mapping[str, float]) -> list[str]:
    said = [f"samples of {_ms(times['period'])}"] if "period" in times else []
    for name, what, how in (("torque_delay", "torques", "late"), ("image_age", "x", "old")):
        if name in times:
            now, given = times[name], times[f"given_{name}"]
            said.append(f"{what} as {_ms(now)} {how}, not {_ms(given)}")
    return said


def _margin(f: Mapping[str, Any]) -> str:
    """The margin of a test, and how far it is to be trusted."""
    if not math.isfinite(f["margin"]):
        return "the period and delays are too long for any function of this kind"
    said = f"margin {f['margin']:.3g}"
    if f["certified"]:
        said += f"; 0 of {f['checked']} further configurations violate it"
        if math.isfinite(f["violating_at_most"]):
            most = 100.0 * f["violating_at_most"]
            said += f", so at most {most:.2g} % of all do (95 % confidence)"
    elif f["margin"] > 0.0:
        said += f"; {f['violations']} of {f['checked']} further configurations violate it"
    else:
        said += f"; positive in {100.0 * f['share']:.3g} % of the configurations"
    return f"{said} ({FAMILIES[f['family']]})" if "family" in f else said


def _near(f: Mapping[str, Any]) -> str:
    """Verdict of an exact linearisation, sampled or in continuous time."""
    if f["unstable"]:
        worst = f"at {-f['decay']:.3g}/s"
        if "frame" in f:
            worst = f"{f['spectral_radius']:.3g}-fold in {_ms(f['frame'])}"
        return f"errors grow at {f['unstable']} of {f['targets']} targets, at worst {worst}"
    learnt = " (learnt parameters, often slow, included)" if f["learns"] else ""
    said = f"at all {f['targets']} targets; slowest decay {f['decay']:.3g}/s{learnt}"
    return said if "frame" in f else f"{said}, damping ratio {f['damping_ratio']:.2g}"


def _covered(f: Mapping[str, Any]) -> str:
    units, errors = f["units"], f["certified_error"]
    each = ", ".join(f"{r:.2g} {unit}" for r, unit in zip(errors, units, strict=True))
    if len(set(units)) == 1:
        each = f"{', '.join(f'{r:.2g}' for r in errors)} {units[0]}"
    return (
        f"at rest, with an error of up to {each} in one coordinate, none in the others; "
        f"{100.0 * f['covered']:.3g} % of the starts drawn, about half near their targets"
    )


def _staying(f: Mapping[str, Any]) -> str:
    if not f["radius"]:
        return "from no start is it proven that the arm stays in the region"
    return (
        f"holds from rest, {_within(f)} of the region's middle in every joint (errors of up to "
        f"{f['error']:.2g} {f['unit']}); assumed elsewhere"
    )


def _within(f: Mapping[str, Any]) -> str:
    """What must be near the region's middle: the start, and a target that is not fixed."""
    both = "start and target" if f["any_target"] else "start"
    return f"{both} within {f['radius']:.2g} {f['joint_unit']}"


def _longest_period(f: Mapping[str, Any]) -> str:
    stable = f"stable near targets {_up_to(f['stable'], 'at no period tried')}"
    if not f["certified"]:
        return f"{stable}; the function found passes at none"
    passes = _up_to(f["certified"], "")
    return f"the function found passes {passes}, all else the same (margin 0 there); {stable}"


def _longest_delay(f: Mapping[str, Any]) -> str:
    given = f"; here it is {_ms(f['given'])}" if f["given"] else ""
    passes = _up_to(f["certified"], "at none")
    return f"the function found passes {passes}, all else the same{given}"


def _up_to(seconds: float, none: str) -> str:
    return f"up to {_ms(seconds)}" if seconds else none


def theorem1(f: Mapping[str, Any]) -> str:
    """Return the Jacobian error of Theorem 1 against what it allows."""
    too_fast = ""
    if f["too_fast"]:
        allowed = f"(14) allows {f['alpha_max']:.3g}"
        too_fast = f": learning has alpha = {f['alpha']:.3g} 1/s, {allowed}"
    sign, allowed = "<" if f["holds"] else ">=", max(f["allowed_p"], 0.0)
    return f"p = {f['p']:.3g} {sign} {allowed:.3g} allowed{too_fast}"


def _at_rest(f: Mapping[str, Any]) -> str:
    ends = {unit: value for unit, value in f["free"].items() if np.isfinite(value)}
    if not ends:
        return "no error asks for more torque than the motors have"
    sizes = " or ".join(f"{value:.2g} {unit}" for unit, value in ends.items())
    return (
        f"errors below {sizes} never ask for more than the motors have; larger ones may: "
        f"{100.0 * f['clipped']:.3g} % of the samples do"
    )


def _not_checked(f: Mapping[str, Any]) -> str:
    said = "limits of speed, position and rate"
    if f["uncounted"]:
        said += (
            ", and the arm's weight, as it is given without gravity: with its base upright that "
            f"takes up to {100.0 * f['uncounted']:.2g} % of a motor's torque"
        )
    return said


def _ended(f: Mapping[str, Any]) -> str:
    ended = "diverged" if f["diverged"] else f"ended {f['error']:.3g} {f['unit']} off"
    return f"{ended}, with {f['values']}"


def _other_near(f: Mapping[str, Any]) -> str:
    """The linearisation of a law that no certificate is for."""
    left_out = [f"{n} left out: {why}" for why, n in f["refused"].items()]
    if "targets" not in f:
        return "; ".join(left_out)
    said = (
        f"stable at {percent(f['share'])} % of {f['targets']} targets, slowest decay "
        f"{f['decay']:.3g} 1/s, damping ratio at least {f['damping_ratio']:.2g}; the slowest with "
        f"{f['worst_truth']}"
    )
    return "; ".join([said, *left_out])


def _other_rollouts(f: Mapping[str, Any]) -> str:
    if not f:
        return "report(runs=100) runs them"
    return (
        f"{f['converged']} of {f['runs']} converged, {percent(f['low'])} to {percent(f['high'])} % "
        "of all by the interval"
    )


_LIMITS = {
    "cannot hold": "the motors cannot hold the arm everywhere in the region",
    "V falls": "in steps of status PROOF_KEPT, in continuous time; of the sampled loop nothing is "
    "proven there",
    "another V": "the limiter keeps another Lyapunov function V falling, so nothing here is proven "
    "there; TorqueLimited(..., cross_weight=report.cross_weight) keeps a certified one",
    "no proof": "the limiter clips, and nothing is proven there",
}
_MATRIX = {"matrix form", *FAMILIES.values()}
_LEAVE_OUT = "a bound on sigma_min leaves {} out (RegularPart)"
_SENTENCES: dict[tuple[str, str], Callable[[Mapping[str, Any]], str]] = {
    ("about", "law"): lambda f: str(f["law"]),
    ("about", "timing"): _timing,
    ("about", "errors"): lambda f: str(f["errors"]),
    ("about", "region"): lambda f: str(f["region"]),
    ("about", "assumed"): lambda f: (
        f"gravity is {'learnt' if f['learns'] else 'known exactly'}, "
        "friction is viscous, no torque limit or joint stop is reached"
    ),
    ("about", "drawn"): lambda f: (
        f"{f['chosen']} configurations to choose Lyapunov functions, "
        f"{f['checked']} others to check them, seed {f['seed']}; nothing is proven between them"
    ),
    ("about", "margin"): lambda f: (
        "share of the designed damping left in the worst configuration: above 0 passes"
    ),
    ("beware", "gravity"): _gravity,
    ("beware", "rank"): lambda f: (
        "the estimated Jacobian loses rank in the region, where the arm "
        f"may stand still away from its target: at q = {_angles(f['q'], 3)}; nothing below holds "
        f"there; {_LEAVE_OUT.format('such configurations')}"
    ),
    ("beware", "learning"): lambda f: (
        "learning uses a damped pseudo-inverse near singular "
        f"configurations, such as q = {_angles(f['q'], 3)}, which nothing below covers; "
        f"{_LEAVE_OUT.format('them')}"
    ),
    ("beware", "joint limits"): lambda f: (
        f"the region goes beyond those of "
        f"{', '.join(f['joints'])}: the arm would stop there, which nothing below accounts for"
    ),
    ("beware", "timing"): _rounded,
    ("sampled", "starts"): _covered,
    ("sampled", "staying"): _staying,
    ("sampled", "longest period"): _longest_period,
    ("sampled", "longest delay of torques"): _longest_delay,
    ("sampled", "near targets"): _near,
    ("continuous", "Theorem 1"): lambda f: f"Jacobian error {theorem1(f)}",
    ("continuous", "near targets"): _near,
    ("limits", "at rest"): _at_rest,
    ("limits", "certified"): lambda f: (
        "only for starts whose motions never ask for more than the motors have"
    ),
    ("limits", "not checked"): _not_checked,
    ("other law", "certificates"): lambda f: str(f["reason"]),
    ("other law", "near targets"): _other_near,
    ("other law", "rollouts"): _other_rollouts,
    ("rollouts", "converged"): lambda f: (
        f"within {f['accuracy']:g} {f['unit']} throughout the last tenth of {f['duration']:g} s; "
        f"{percent(f['low'])} to {percent(f['high'])} % of all do (95 % confidence)"
    ),
    ("rollouts", "diverged"): lambda f: "",
    ("rollouts", "left the region"): lambda f: "without diverging",
    ("rollouts", "torques"): lambda f: (
        f"beyond motors, which are not limited here: up to {f['most']:.3g} times their limits"
    ),
    ("rollouts", "worst"): _ended,
}


def _angles(q: Any, digits: int) -> str:
    """Return a configuration as one number a joint."""
    return numbers_of(np.round(q, digits))


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
