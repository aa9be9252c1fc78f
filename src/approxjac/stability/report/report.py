"""`StabilityReport`: the tests over a region, before anything moves."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from approxjac.controllers import Latency, TorqueLimited
from approxjac.formatting import joined, numbers_of, percent
from approxjac.stability.certificates.certificate import (
    RESERVE,
    EffortRoom,
    MatrixTest,
    SampledTest,
    Theorem1,
    effort_room,
    theorem1,
)
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import EXACT_GRAVITY, SHARED, ClosedLoop
from approxjac.stability.loop.samples import Samples
from approxjac.stability.report.move_bounds import Moves
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.stability.rows import Row, about_timing, as_json, as_text, ms
from approxjac.stability.search.worst import ROUNDS, Growth, fastest_growth, searched_test
from approxjac.validation import Array

_IF_IT_STAYS = "as long as the arm stays in the region"
_REASONS = {
    "unstable": "errors grow at {rate:.3g}/s near the target {where}, with {robot}",
    "rollouts diverged": "{diverged} of {runs} rollouts diverged",
    "gravity": "gravity is off by up to {error:.3g} {unit}",
    "rank": "the estimated Jacobian loses rank in the region",
    "damped": "the region holds configurations near singular ones, where learning is damped",
    "motors": "the motors cannot hold the arm everywhere in the region",
    "violated": "the Lyapunov function found fails in {violations} of {checked} further "
    "configurations",
    "none": "no Lyapunov function was found for all errors, configurations and targets",
}
_REFUTED = {"unstable", "rollouts diverged"}
_TINY = 1e-6
_DRAWN = 400  # starts that tell what is usual
_CHOOSE = 200  # samples at most that functions are chosen on, besides those that a search finds
_STARTS = 12  # of the search for instability, and 40 where few numbers are uncertain
_FEW, _MANY = 6, 40
_NAMED = 6  # uncertain numbers that are all written out


@dataclass(frozen=True, eq=False, repr=False)
class StabilityReport:
    """Findings of the tests about a controller.

    Three words are never mixed. *Refuted*: a search found a true robot and a target near which
    errors grow, or a rollout diverged. *Certified*: there is one Lyapunov function, and a search
    over robots, configurations and targets found no case in which it fails. *Proven* would be a
    proof between the cases, too; nothing here is. Certificates are of motions that stay in the
    region.

    Attributes:
        loop: The closed loop: controller, truth, region and target.
        latency: Latency of the loop.
        samples: Samples of the tests; those that the function was chosen on come first.
        test: Matrix form of the sampled loop with its delays (`SampledTest`); with learnt gravity,
            of which there is a certificate in continuous time only, that one.
        growth: Worst target of the exact linearisation of the sampled loop with its delays.
        theorem1: Theorem 1 of the paper, in continuous time.
        rollouts: The rollouts, or None if not requested.
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
        singular_q: A configuration of the region where Ĵ loses rank, shape (nq,), which prevents
            any certificate; None if none was found.
        damped_q: The same where the Ĵ⁺ of learning is damped, which no certificate covers.
        seed: Seed of all random draws.
        limits: Room of the motors within torque limits; None without them.
        moves: Certified moves; None if not requested, or not covered.
        unmoved: Why moves are not covered, if they were requested; "" otherwise.
    """

    loop: ClosedLoop
    latency: Latency
    samples: Samples
    test: MatrixTest
    growth: Growth
    theorem1: Theorem1
    rollouts: Rollouts | None
    gravity_error: float
    singular_q: Array | None
    damped_q: Array | None
    seed: int
    limits: EffortRoom | None = None
    moves: Moves | None = None
    unmoved: str = ""

    @property
    def gravity_is_exact(self) -> bool:
        """True if gravity is compensated, or can be learnt, to within 1e-5 N m."""
        return self.gravity_error <= EXACT_GRAVITY

    @property
    def is_sampled(self) -> bool:
        """True if the test is of the sampled loop; with learnt gravity it is not."""
        return isinstance(self.test, SampledTest)

    @property
    def passed(self) -> bool:
        """True if it is certified as far as there are certificates.

        With learnt gravity there is none for the sampled loop: then the one in continuous time
        counts, if nothing contradicts it.
        """
        return not self.reason

    @property
    def covers(self) -> bool:
        """True if something is certified, moves or starts, and nothing refuted."""
        moving = self.moves is not None and any(move.speed for move in self.moves.moves)
        starts = self.passed and not (isinstance(self.test, SampledTest) and self.test.level <= 0.0)
        return not self.refuted and (moving or starts)

    @property
    def refuted(self) -> bool:
        """True if the loop is unstable with a true robot that was found."""
        return self.reason in _REFUTED

    @property
    def reason(self) -> str:
        """The reason why it is not certified: a `contradiction`, "violated" or "none"; or ""."""
        if self.contradiction or self.test.certified:
            return self.contradiction
        return "violated" if self.test.violations and self.test.margin > 0.0 else "none"

    @property
    def contradiction(self) -> str:
        """A finding that contradicts any certificate; "" if there is none."""
        rollouts = self.rollouts
        reasons = {
            "unstable": self.growth.grows,
            "rollouts diverged": rollouts is not None and rollouts.n_diverged > 0,
            "gravity": not self.gravity_is_exact,
            "rank": self.singular_q is not None,
            "damped": self.damped_q is not None,
            "motors": self.limits is not None and not self.limits.holds,
        }
        return next((reason for reason, is_so in reasons.items() if is_so), "")

    def describe_truth(self, index: int) -> str:
        """Describe the true robot of the index of a sample's `truth`."""
        return self._describe(self.loop.values[index])

    def _describe(self, values: Array) -> str:
        truth = self.loop.truth
        if isinstance(truth, Uncertainty) and truth.d > 0:
            return truth.describe(values)
        return "the true robot"

    @cached_property
    def rows(self) -> list[Row]:
        """The findings: part of the report, test, verdict and figures."""
        moves = [] if self.moves is None else self.moves.rows
        rows = [_verdict(self), *moves, _covers(self), _near(self), _function(self)]
        rows += [_theorem1(self), *_beware(self)]
        if self.unmoved:
            rows.append(Row("moves", "any", "not covered", {}, self.unmoved))
        rows += [] if self.limits is None else _limits(self.limits)
        rows += [] if self.rollouts is None else self.rollouts.rows
        return [*rows, *_worst(self), *_about(self)]

    def verdict(self) -> str:
        """Return the verdict on the loop in one line."""
        return _verdict(self).text

    def __repr__(self) -> str:
        name, where = self.loop.controller.task.robot.name, repr(self.loop.region)
        return f"StabilityReport({name!r}: {self.verdict()}, on {where}; print it for the tests)"

    def __str__(self) -> str:
        return as_text(self.rows)

    def summary(self) -> dict[str, Any]:
        """Return the part of summary.json: the rows by part and name, and the verdict."""
        about = {
            "robot": self.loop.controller.task.robot.name,
            "seed": self.seed,
            "certified": self.passed,
            "refuted": self.refuted,
            "reason": self.reason,
        }
        return about | as_json(self.rows)


def report_of(
    loop: ClosedLoop,
    latency: Latency,
    configurations: int,
    seed: int,
    tell: Callable[[str, float], None],
    limiter: TorqueLimited | None = None,
    rollouts: Rollouts | None = None,
) -> StabilityReport:
    """Return the report of a loop; see `Study.report`."""
    rng, half = np.random.default_rng(seed), min(configurations // 2, _CHOOSE)
    tell("configurations", 0.0)
    samples = loop.draw(half, rng, inside=SHARED)
    fresh = loop.draw(configurations - half, rng, uniform=True)
    tell("near targets", 0.0)
    starts = _MANY if loop.corners.shape[1] <= _FEW else _STARTS
    growth = fastest_growth(loop, latency.in_samples(), starts, rng)
    learns = loop.controller.adaptation is not None
    held = None if learns else latency
    on = partial(tell, "one function")
    rounds = 0 if growth.grows else ROUNDS
    test = searched_test(loop, held, samples, rng, on, rounds).checked_on(fresh)
    chosen = test.form.samples
    everywhere = chosen.join(fresh)
    report = StabilityReport(
        loop, latency, everywhere, test, growth, theorem1(everywhere, loop.setting), rollouts,
        loop.gravity_error(chosen.q[:: max(1, len(chosen) // 20)]),
        loop.singular_configuration(samples), loop.damped_configuration(everywhere), seed,
    )  # fmt: skip
    if limiter is None:
        return report
    sampled = test if isinstance(test, SampledTest) and test.certified else None
    room = effort_room(loop, np.asarray(limiter.limits.effort), everywhere, sampled)
    if sampled is not None:
        report = replace(report, test=sampled.below(room.level))
    return replace(report, limits=room)


# -- rows -----------------------------------------------------------------------------------------


def _verdict(report: StabilityReport) -> Row:
    period, test, rollouts = report.latency.period, report.test, report.rollouts
    late = report.latency.of_position > period
    rate = 1.0 / period
    runs = "sampled at " + (f"{1e-3 * rate:.3g} kHz" if rate >= 1e3 else f"{rate:.3g} Hz")
    runs += " with its delays" if late else ""
    figures: dict[str, Any] = {"period": period, "late": late}
    if report.passed:
        figures["margin"] = test.margin
        if not report.is_sampled:
            verdict = "in continuous time only"
            text = f"with learnt gravity there is no certificate {runs}"
            text = f"certified {verdict}, margin {test.margin:.2g}; {text}"
            return Row("verdict", "certified", verdict, figures, text)
        text = f"certified, margin {test.margin:.2g}, {runs}, {_IF_IT_STAYS}"
        return Row("verdict", "certified", "yes", figures, text)
    figures |= {"reason": report.reason, "error": report.gravity_error}
    figures |= {"rate": report.growth.rate, "robot": _short(report, report.growth.values)}
    figures["where"] = _where(report, report.growth.q)
    if rollouts is not None:
        figures |= {"diverged": rollouts.n_diverged, "runs": rollouts.n}
    figures |= {"violations": test.violations, "checked": test.checked}
    why = _REASONS[report.reason].format(**figures, unit=report.loop.force_unit)
    word = "refuted" if report.refuted else "not certified"
    return Row("verdict", "certified", word, figures, f"{word}, {runs}: {why}")


def _covers(report: StabilityReport) -> Row:
    """The consequence of the verdict, in a sentence or two."""
    runs, figures, left = report.rollouts, dict[str, Any](), ""
    if runs is not None:
        figures = {"left": runs.n_left, "runs": runs.n}
        left = f" It left the region in {runs.n_left} of {runs.n} rollouts."
    if report.passed and isinstance(report.test, SampledTest):
        text = _covered_starts(report, report.test, figures)
        text += f"{left} Searched for a counterexample, not proven."
        return Row("verdict", "covers", "certified", figures, text)
    if report.passed:
        text = (
            f"In continuous time the error would go to zero {_IF_IT_STAYS}.{left} Of the sampled "
            "loop nothing is certified, though no instability was found."
        )
        return Row("verdict", "covers", "continuous", figures, text)
    judged = replace(report, gravity_error=0.0) if report.loop.integral_terms else report
    if judged.contradiction:
        text = "This is a problem found in the loop, not just a missing proof."
        return Row("verdict", "covers", "problem", figures, text)
    text = "No proof was found. The loop may still be stable: see near targets and rollouts."
    return Row("verdict", "covers", "unknown", figures, text)


def _covered_starts(report: StabilityReport, sampled: SampledTest, figures: dict[str, Any]) -> str:
    """Describe the starts that a certificate covers, among the usual ones."""
    e, units = usual_errors(report), report.loop.controller.task.units
    energies = sampled.weights.at_rest(e, report.loop.controller.saturation)
    share, usual = float((energies <= sampled.level).mean()), np.median(np.linalg.norm(e, axis=1))
    figures |= {"share": share, "usual": float(usual), "unit": joined(units)}
    figures["certified_error"] = each = sampled.certified_error
    least = {unit: min(each[k] for k in range(len(each)) if units[k] == unit) for unit in units}
    alone = " or ".join(f"{value:.2g} {unit}" for unit, value in least.items())
    if sampled.level <= 0.0:
        return "No start away from its target is certified: the region, or a limit, leaves no room."
    return (
        f"The error goes to zero, {_IF_IT_STAYS}, from starts at rest with a coordinate off by up "
        f"to {alone}: {percent(share)} % of the usual starts ({usual:.2g} {joined(units)} from "
        "their target in the median)."
    )


def usual_errors(report: StabilityReport) -> Array:
    """Return errors between configurations of the region, or to its one target, shape (N, m)."""
    loop, rng = report.loop, np.random.default_rng(report.seed)
    truths = np.arange(_DRAWN) % len(loop.corners)
    q, ends = (loop.seen(truths, loop.region.sample(_DRAWN, rng), rng) for _ in range(2))
    x_d = None if loop.target is not None else loop.terms(truths, ends).x
    return loop.terms(truths, q, x_d).e


def _about(report: StabilityReport) -> Iterator[Row]:
    loop, test = report.loop, report.test
    law, learns = loop.controller.describe()[0], loop.controller.adaptation is not None
    truth, region = loop.truth, str(loop.region)
    errors = truth.describe_box() if isinstance(truth, Uncertainty) else "one true robot"
    yield Row("about", "law", "", {"law": law}, law)
    yield about_timing(report.latency)
    yield Row("about", "errors", "", {"errors": errors}, errors)
    yield Row("about", "region", "", {"region": region}, region)
    assumed = (
        f"gravity is {'learnt' if learns else 'known exactly'}, friction is viscous, no torque "
        "limit or joint stop is reached"
    )
    yield Row("about", "assumed", "", {"learns": learns}, assumed)
    drawn = {"chosen": len(test.margins), "checked": test.checked, "seed": report.seed}
    text = (
        f"{drawn['chosen']} cases, drawn and found, to choose the function, {test.checked} drawn "
        f"to check it, seed {report.seed}"
    )
    yield Row("about", "drawn", "", drawn, text)


def _beware(report: StabilityReport) -> Iterator[Row]:
    """Rows about departures from the assumptions of certificates."""
    robot, latency = report.loop.plants[0].robot, report.latency
    if not report.gravity_is_exact:
        yield of_gravity(report.loop, report.gravity_error)
    for name, verdict, at, what in (
        ("rank", "lost", report.singular_q, "the estimated Jacobian loses rank in the region, "
         "where the arm may stand still away from its target:"),
        ("learning", "damped", report.damped_q, "learning uses a damped pseudo-inverse near "
         "singular configurations, such as"),
    ):  # fmt: skip
        if at is not None:
            q = robot.angles(at)
            where = numbers_of(np.round(q, 3))
            text = f"{what} q = {where}; a bound on sigma_min leaves it out (RegularPart)"
            yield Row("beware", name, verdict, {"q": q}, text)
    excess = robot.beyond_limits(report.samples.q).max(axis=0)
    if beyond := [n for n, far in zip(robot.joint_names, excess, strict=True) if far > _TINY]:
        text = f"the region goes beyond those of {', '.join(beyond)}, where the arm would stop"
        yield Row("beware", "joint limits", "beyond", {"joints": beyond}, text)
    dt, _, age, late, _ = latency.in_samples()
    taken = {"period": dt, "torque_delay": late * dt, "image_age": age * dt}
    off = [abs(time - getattr(latency, name)) for name, time in taken.items()]
    if max(off) > _TINY * latency.period:
        text = (
            f"near targets the loop is taken in samples of {ms(dt)}, torques {ms(late * dt)} "
            f"late, x {ms(age * dt)} old; rollouts round delays to whole periods"
        )
        yield Row("beware", "timing", "rounded", taken, text)


def of_gravity(loop: ClosedLoop, error: float) -> Row:
    """Return the row about a gravity torque that is neither compensated nor learnt [N m]."""
    learns, by = loop.controller.adaptation is not None, loop.integral_terms
    figures, unit = {"error": error, "learns": learns, "by": by}, loop.force_unit
    text = (
        f"off by up to {error:.3g} {unit}: the error does not go to 0 but to where K_p makes up "
        "for it, unless gravity is learnt (AdaptiveGravity) or known and left out (NoGravity)"
    )
    if learns:  # at rest θ̂ stands still: Ĵ y = α s(e) = 0 with a task force, y = 0 with torques
        takes = f"the learnt {' and '.join(by)} can" if by else "a learnt task force could"
        text = (
            f"no learnt gravity parameters explain up to {error:.3g} {unit} of it, as of wrong "
            f"joint axes or a tilted base; {takes} take it up, but nothing is proven"
        )
    return Row("beware", "gravity", "not exact", figures, text)


def _function(report: StabilityReport) -> Row:
    """Row of the Lyapunov function."""
    test, most = report.test, report.test.violating_at_most
    figures: dict[str, Any] = {
        **{name: getattr(test, name) for name in ("family", "margin", "share", "violations")},
        **{"checked": test.checked, "violating_at_most": most, "certified": test.certified},
        **test.weights._asdict(),
    }
    if isinstance(test, SampledTest):
        figures |= {"speed": test.speed, "level": test.level}
    verdict = "holds" if test.certified else "none"
    if test.certified and report.reason:
        verdict = "withdrawn"
    if not math.isfinite(test.margin):
        text = "the period and delays are too long for any function of this kind"
    elif test.margin < RESERVE:
        text = f"margin {test.margin:.3g} in the worst case, {RESERVE:g} is needed; positive in "
        text += f"{100.0 * test.share:.3g} % of the cases"
    else:
        of = (
            "the drawn cases alone" if report.growth.grows else "the worst case that a search found"
        )
        text = f"margin {test.margin:.3g} in {of}; "
        text += f"{test.violations} of {test.checked} drawn cases fail"
        if test.certified:
            text += f", at most {100.0 * most:.2g} % of all do (95 % confidence)"
    text += "" if report.is_sampled else "; in continuous time"
    return Row("tests", "one function", verdict, figures, text)


def _near(report: StabilityReport) -> Row:
    """Row of the exact linearisation near targets."""
    growth, learns = report.growth, report.loop.controller.adaptation is not None
    figures: dict[str, Any] = {**growth._asdict(), "decay": -growth.rate, "learns": learns}
    figures["truth"] = report._describe(growth.values)
    looks = f"(a search over robots and targets, {growth.looks} looks)"
    if growth.grows:
        text = f"errors grow at {growth.rate:.3g}/s near the worst target {looks}"
        return Row("tests", "near targets", "unstable", figures, text)
    learnt = " (learnt parameters, often slow, included)" if learns else ""
    text = f"slowest decay found {-growth.rate:.3g}/s{learnt} {looks}"
    return Row("tests", "near targets", "stable", figures, text)


def _theorem1(report: StabilityReport) -> Row:
    """Row of Theorem 1 of the paper."""
    first = report.theorem1
    names = ("p", "allowed_p", "alpha", "alpha_max", "margin", "b_J", "lambda_m", "lambda_1",
             "lambda_2", "c0", "c1")  # fmt: skip
    figures: dict[str, Any] = {name: getattr(first, name) for name in names}
    figures |= {"holds": first.holds, "too_fast": first.is_too_fast}
    verdict = "holds" if first.holds else "does not hold"
    text = f"Jacobian error {first}; of the paper, in continuous time"
    return Row("tests", "Theorem 1", verdict, figures, text)


def _worst(report: StabilityReport) -> Iterator[Row]:
    test, growth = report.test, report.growth
    k = test.worst
    for name, values, q in (
        ("one function", report.loop.values[test.form.samples.truth[k]], test.form.samples.q[k]),
        ("near targets", growth.values, growth.q),
    ):
        angles = report.loop.plants[0].robot.angles(q)
        figures = {"truth": report._describe(values), "values": values, "q": angles}
        text = f"{_short(report, values)} {_where(report, q)}"
        yield Row("worst", name, "", figures, text)


def _where(report: StabilityReport, q: Array) -> str:
    return f"q = {numbers_of(np.round(report.loop.plants[0].robot.angles(q), 2))}"


def _short(report: StabilityReport, values: Array) -> str:
    """Describe a true robot by the errors that are largest within their ranges."""
    truth = report.loop.truth
    if not isinstance(truth, Uncertainty) or truth.d <= _NAMED or truth.covariance is not None:
        return report._describe(values)
    largest = np.sort(np.argsort(-np.abs(truth.units_of(values[None])[0]), kind="stable")[:_NAMED])
    some = truth.believed.copy()
    some[largest] = values[largest]
    named = truth.describe(some).split(", ")
    some_of = ", ".join(named[k] for k in largest)
    return f"{some_of} and {truth.d - _NAMED} other errors (summary() names all)"


def _limits(room: EffortRoom) -> Iterator[Row]:
    """Rows about limits of effort."""
    if not room.holds:
        yield Row("limits", "motors", "cannot hold", {"level": 0.0}, _REASONS["motors"])
        return
    text = "no torque limit acts on motions of the starts covered; on others nothing is certified"
    yield Row("limits", "certified", "", {"level": room.level}, text)
    text = "limits of speed, position and rate, and the weight of an arm taken without gravity"
    yield Row("limits", "not checked", "", {}, text)
