"""`StabilityReport`: the tests over a region, before anything moves."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from approxjac.controllers import Latency, TorqueLimited
from approxjac.formatting import joined, numbers_of, percent
from approxjac.stability.certificates.attraction import Attraction, attraction
from approxjac.stability.certificates.certificate import (
    MatrixTest,
    SampledTest,
    Theorem1,
    refine_constants,
    refine_weights,
    sampled_test,
    theorem1,
)
from approxjac.stability.certificates.limit_cost import LimitCost, limit_cost
from approxjac.stability.certificates.matrix_form import Best, Family, MatrixForm, Weights, on_more
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import EXACT_GRAVITY, SHARED, ClosedLoop
from approxjac.stability.loop.linearization import LocalTest
from approxjac.stability.loop.samples import Samples
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.stability.rows import Row, about_timing, as_json, as_text, ms
from approxjac.validation import Array

FAMILY_NAMES: dict[Family, str] = {
    "paper": "paper's weights",
    "free": "free potential",
    "wide": "widened",
    "full": "coupled",
}
_IF_IT_STAYS = "as long as the arm stays in the region"
_REASONS = {
    "gravity": "gravity is off by up to {error:.3g} {unit}",
    "unstable": "errors grow at {percent:.3g} % of the targets (exact linearisation)",
    "rollouts diverged": "{diverged} of {runs} rollouts diverged",
    "violated": "the Lyapunov function found fails in {violations} of {checked} further "
    "configurations",
    "rank": "the estimated Jacobian loses rank in the region",
    "damped": "the region holds configurations near singular ones, where learning is damped",
    "motors": "the motors cannot hold the arm everywhere in the region",
    "unstable in continuous time": "errors grow at some targets in continuous time",
    "too slow": "no Lyapunov function was found for this period and these delays",
    "none": "no Lyapunov function was found, not even in continuous time",
    "learnt, none": "with learnt gravity there are certificates in continuous time only, and none "
    "was found",
}
_LIMITS = {
    "cannot hold": _REASONS["motors"],
    "V falls": "in steps of status PROOF_KEPT, in continuous time; of the sampled loop nothing is "
    "proven there",
    "another V": "the limiter keeps another Lyapunov function V falling, so nothing here is proven "
    "there",
    "no proof": "the limiter clips, and nothing is proven there",
}
_TINY = 1e-6
_DRAWN = 400  # starts that tell what is usual
_TARGETS = 1000  # that the sampled loop is linearised at
_CHOOSE = 1000  # samples at most that functions are chosen on: more of them check instead


@dataclass(frozen=True, eq=False, repr=False)
class StabilityReport:
    """Findings of the tests about a controller.

    "Certified" refers to the sampled loop with its delays, Theorem 1 and the matrix form to
    continuous time. All are sufficient conditions, checked at random samples; that they hold at all
    other configurations of the region is not proven, but the share of violations is bounded
    (`MatrixTest.violating_at_most`). They apply to motions that stay in the region.

    Attributes:
        loop: The closed loop: controller, truth, region and target.
        latency: Latency of the loop.
        samples: Samples of all tests but the local one and rollouts; those that the Lyapunov
            functions were chosen on come first.
        sampled: Matrix form of the sampled loop, or None with learnt gravity, not covered by it.
        theorem1: Test 1, in continuous time.
        matrix: Test 2 in continuous time by family, from the smallest to the first that certifies.
        local: Test 3, in continuous time.
        spectral_radii: Spectral radii of the exact linearisation of the sampled loop with its
            delays, from one frame of x to the next, at targets, shape (k,); below 1 if stable.
        rollouts: Test 4, or None if not requested.
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
        singular_q: A configuration of the region where Ĵ loses rank, shape (nq,), which prevents
            any certificate; None if none was found.
        damped_q: The same where the Ĵ⁺ of learning is damped, which no certificate covers.
        seed: Seed of all random draws.
        limits: Cost of torque limits; None without them.
    """

    loop: ClosedLoop
    latency: Latency
    samples: Samples
    sampled: SampledTest | None
    theorem1: Theorem1
    matrix: Mapping[Family, MatrixTest]
    local: LocalTest
    spectral_radii: Array
    rollouts: Rollouts | None
    gravity_error: float
    singular_q: Array | None
    damped_q: Array | None
    seed: int
    limits: LimitCost | None = None

    @property
    def gravity_is_exact(self) -> bool:
        """True if gravity is compensated, or can be learnt, to within 1e-5 N m."""
        return self.gravity_error <= EXACT_GRAVITY

    @property
    def is_as_assumed(self) -> bool:
        """True if gravity, the rank of Ĵ and Ĵ⁺ are as every certificate assumes."""
        return self.gravity_is_exact and self.singular_q is None and self.damped_q is None

    @property
    def certified_by(self) -> str | None:
        """Name of the test that certifies the sampled loop, "sampled form", or None."""
        return None if self.reason else "sampled form"

    @property
    def passed(self) -> bool:
        """True if it is certified as far as there are certificates.

        With learnt gravity there is none for the sampled loop: then the one in continuous time
        counts, if nothing contradicts it.
        """
        return self.reason in ("", "learnt")

    @property
    def certified_in_continuous_time(self) -> str | None:
        """The strongest test that certifies the region, "theorem1" or "matrix", or None.

        It says nothing of what sampling and delays do.
        """
        if not self.is_as_assumed or not self.local.stable:
            return None
        if self.theorem1.holds:
            return "theorem1"
        return "matrix" if any(test.certified for test in self.matrix.values()) else None

    @property
    def certifying(self) -> Weights | None:
        """Weights of the V that certifies; None if none does."""
        if not self.passed:
            return None
        test: MatrixTest | None = self.sampled
        if test is None:  # gravity is learnt
            test = max(self.matrix.values(), key=lambda test: (test.certified, test.margin))
        return test.weights

    @property
    def reason(self) -> str:
        """The reason why the sampled loop is not certified; "" if it is.

        It is a `contradiction`; "violated", "too slow" or "none" (no Lyapunov function); or, with
        learnt gravity, "learnt" or "learnt, none" (certificates in continuous time only).
        """
        if self.contradiction:
            return self.contradiction
        nowhere = self.certified_in_continuous_time is None
        if self.sampled is None:
            return "learnt, none" if nowhere else "learnt"
        return "none" if self.sampled.margin <= 0.0 and nowhere else self.sampled.reason

    @property
    def contradiction(self) -> str:
        """A finding that contradicts any certificate; "" if there is none."""
        rollouts = self.rollouts
        reasons = {
            "gravity": not self.gravity_is_exact,
            "rank": self.singular_q is not None,
            "damped": self.damped_q is not None,
            "motors": self.limits is not None and not self.limits.holds,
            "unstable": bool((self.spectral_radii >= 1.0).any()),
            "unstable in continuous time": not self.local.stable,
            "rollouts diverged": rollouts is not None and rollouts.n_diverged > 0,
        }
        return next((reason for reason, is_so in reasons.items() if is_so), "")

    def describe_truth(self, index: int) -> str:
        """Describe the true robot of the index of a sample's `truth`."""
        truth = self.loop.truth
        if isinstance(truth, Uncertainty) and truth.d > 0:
            return truth.describe(self.loop.values[index])
        return "the true robot"

    @cached_property
    def attraction(self) -> Attraction | None:
        """Starts that never leave the region; None without a certificate, or if it is no box."""
        if self.sampled is None or self.reason:
            return None
        return attraction(self.loop, self.sampled, np.random.default_rng(self.seed))

    @cached_property
    def rows(self) -> list[Row]:
        """The findings: part of the report, test, verdict and figures."""
        rows = [_verdict(self), _covers(self), *_about(self), *_beware(self), *_sampled(self)]
        rows += [] if self.limits is None else of_limits(self.limits)
        rows += _continuous(self)
        return rows if self.rollouts is None else [*rows, *self.rollouts.rows]

    def verdict(self) -> str:
        """Return the verdict on the sampled loop in one line."""
        return _verdict(self).text

    def __repr__(self) -> str:
        name, where = self.loop.controller.task.robot.name, repr(self.loop.region)
        return f"StabilityReport({name!r}: {self.verdict()}, on {where}; print it for the tests)"

    def __str__(self) -> str:
        return as_text(self.rows)

    def summary(self) -> dict[str, Any]:
        """Return the part of summary.json: the rows by part and name, and what is certified."""
        certified = {
            "robot": self.loop.controller.task.robot.name,
            "seed": self.seed,
            "certified_by": self.certified_by,
            "certified_in_continuous_time": self.certified_in_continuous_time,
            "reason": self.reason,
        }
        return certified | as_json(self.rows)


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
    rng, setting = np.random.default_rng(seed), loop.setting
    half = min(configurations // 2, _CHOOSE)
    tell("configurations", 0.0)
    samples = loop.draw(half, rng, inside=SHARED)
    tell("configurations", 0.5)
    fresh = loop.draw(configurations - half, rng, inside=1)
    samples = refine_constants(loop, samples, rng)
    form, check = MatrixForm(samples, setting), MatrixForm(fresh, setting)
    bests: dict[Family, Best] = {}
    for k, family in enumerate(setting.families):
        tell("matrix form", k / len(setting.families))
        form, best = refine_weights(loop, form, family, rng)
        bests[family] = best
        if best.margins.min() > 0.0 and not check.violations(best.weights):
            break
    samples = form.samples
    matrix: dict[Family, MatrixTest] = {}
    for family, each in bests.items():
        last = on_more(form, family, each)  # a later family may have bests worse ones
        matrix[family] = MatrixTest(
            family, last.weights, last.margins, len(fresh), check.violations(last.weights)
        )
    sampled = None
    if loop.controller.adaptation is None:
        tell("sampled form", 0.0)
        sampled = sampled_test(loop, best, form, check, latency)
    tell("local", 0.0)
    truths, configured = samples.truth, samples.q
    if loop.target is not None:
        truths, configured = loop.targets(0, rng)
    local = loop.local_test(truths, configured)
    everywhere = samples.join(fresh)
    first = theorem1(everywhere, setting)
    singular_q = loop.singular_configuration(samples)
    damped_q = loop.damped_configuration(everywhere)
    gravity_error = loop.gravity_error(samples.q[:: max(1, len(samples) // 20)])
    radii = loop.spectral_radii(samples.take(slice(_TARGETS)), latency)
    report = StabilityReport(
        loop, latency, everywhere, sampled, first, matrix, local, radii, rollouts, gravity_error,
        singular_q, damped_q, seed,
    )  # fmt: skip
    if limiter is None:
        return report
    cost = limit_cost(loop, limiter, everywhere, sampled, report.certifying)
    if sampled is not None and sampled.certified:
        sampled = sampled.below(cost.level)
    return replace(report, sampled=sampled, limits=cost)


# -- rows -----------------------------------------------------------------------------------------


def _verdict(report: StabilityReport) -> Row:
    period, sampled, rollouts = report.latency.period, report.sampled, report.rollouts
    late = report.latency.of_position > period
    rate = 1.0 / period
    runs = "sampled at " + (f"{1e-3 * rate:.3g} kHz" if rate >= 1e3 else f"{rate:.3g} Hz")
    runs += " with its delays" if late else ""
    figures: dict[str, Any] = {"period": period, "late": late}
    if report.passed:
        tests = report.matrix.values() if sampled is None else [sampled]
        figures["margin"] = max(test.margin for test in tests)
        if sampled is None:
            verdict = "in continuous time only"
            text = f"with learnt gravity there is no certificate {runs}"
            text = f"certified: {verdict}, margin {figures['margin']:.2g}; {text}"
            return Row("verdict", "certified", verdict, figures, text)
        figures["stays"] = report.attraction is not None
        text = f"certified: yes, margin {figures['margin']:.2g}, {runs}"
        text += "" if figures["stays"] else f", {_IF_IT_STAYS}"
        return Row("verdict", "certified", "yes", figures, text)
    figures |= {"reason": report.reason, "error": report.gravity_error}
    figures["percent"] = 100.0 * float((report.spectral_radii >= 1.0).mean())
    if rollouts is not None:
        figures |= {"diverged": rollouts.n_diverged, "runs": rollouts.n}
    if sampled is not None:
        figures |= {"violations": sampled.violations, "checked": sampled.checked}
    why = _REASONS[report.reason].format(**figures, unit=report.loop.force_unit)
    return Row("verdict", "certified", "no", figures, f"certified: no, {runs}: {why}")


def _covers(report: StabilityReport) -> Row:
    """The consequence of the verdict, in a sentence or two."""
    runs, figures, left = report.rollouts, dict[str, Any](), ""
    if runs is not None:
        figures = {"left": runs.n_left, "runs": runs.n}
        left = f" It left the region in {runs.n_left} of {runs.n} rollouts."
    if report.passed and report.sampled is not None:
        text = _covered_starts(report, report.sampled, figures)
        text += f"{left} Checked on samples of the region, not proven between them."
        return Row("verdict", "covers", "certified", figures, text)
    if report.passed:
        text = (
            f"In continuous time the error would go to zero {_IF_IT_STAYS}.{left} Of the sampled "
            "loop nothing is proven, though no instability was found."
        )
        return Row("verdict", "covers", "continuous", figures, text)
    judged = replace(report, gravity_error=0.0) if report.loop.integral_terms else report
    if judged.contradiction:
        text = "This is a problem found in the loop, not just a missing proof."
        return Row("verdict", "covers", "problem", figures, text)
    text = "No proof was found. The loop may still be stable: see near targets and rollouts."
    return Row("verdict", "covers", "unknown", figures, text)


def _covered_starts(report: StabilityReport, sampled: SampledTest, figures: dict[str, Any]) -> str:
    """Describe the starts that a certificate covers, and the errors of the usual ones."""
    stays, e = report.attraction, usual_errors(report)
    energies = sampled.weights.at_rest(e, report.loop.controller.saturation)
    share, usual = float((energies <= sampled.level).mean()), np.median(np.linalg.norm(e, axis=1))
    unit = joined(report.loop.controller.task.units)
    figures |= {"share": share, "usual": float(usual), "radius": 0.0, "unit": unit}
    figures["certified_error"] = sampled.certified_error
    begins = "From no start is it proven that the arm stays in the region"
    if stays is not None:
        names = ("radius", "error", "travel", "rate")
        figures |= {name: getattr(stays, name) for name in names} | stays.weights._asdict()
        both = "start and target" if report.loop.target is None else "start"
        joints = joined(report.loop.plants[0].robot.joint_units)
        begins = (
            f"Covers starts at rest up to {stays.error:.2g} {unit} from their target ({both} "
            f"within {stays.radius:.2g} {joints} of the region's middle)"
        )
    goes = f"the error goes to zero {_IF_IT_STAYS}" if share else "is anything proven"
    of_these = f"{percent(share)} %" if share else "none"
    away = f"{usual:.2g} {unit} from their target in the median"
    return f"{begins}. From {of_these} of the usual starts ({away}) {goes}."


def usual_errors(report: StabilityReport) -> Array:
    """Return errors between configurations of the region, or to its one target, shape (N, m)."""
    loop, rng = report.loop, np.random.default_rng(report.seed)
    truths = np.arange(_DRAWN) % len(loop.corners)
    q, ends = (loop.seen(truths, loop.region.sample(_DRAWN, rng), rng) for _ in range(2))
    x_d = None if loop.target is not None else loop.terms(truths, ends).x
    return loop.terms(truths, q, x_d).e


def _about(report: StabilityReport) -> Iterator[Row]:
    loop, paper = report.loop, report.matrix["paper"]
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
    drawn = {"chosen": len(paper.margins), "checked": paper.checked, "seed": report.seed}
    text = (
        f"{drawn['chosen']} configurations to choose Lyapunov functions, {paper.checked} others to "
        f"check them, seed {report.seed}; nothing is proven between them"
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


def _sampled(report: StabilityReport) -> Iterator[Row]:
    sampled, radii, frame = report.sampled, report.spectral_radii, report.latency.in_samples().frame
    if sampled is not None:
        verdict = "holds" if sampled.certified else "does not hold"
        if sampled.certified and report.reason:
            verdict = "withdrawn"
        text = _margin(sampled)
        if math.isfinite(sampled.margin):
            text += f" ({FAMILY_NAMES[sampled.family]})"
        names = ("family", "speed", "level")
        figures = _figures(report, sampled) | {name: getattr(sampled, name) for name in names}
        yield Row("sampled", "matrix form", verdict, figures, text)
    worst, unstable = float(radii.max()), int((radii >= 1.0).sum())
    decay = -math.log(worst) / frame if worst > 0.0 else math.inf
    figures = {"spectral_radius": worst, "frame": frame}
    yield _near(report, "sampled", figures, len(radii), unstable, decay)


def _figures(report: StabilityReport, test: MatrixTest) -> dict[str, Any]:
    names = ("margin", "share", "violations", "checked", "violating_at_most", "certified")
    return {
        **{name: getattr(test, name) for name in names},
        **_case(report, int(report.samples.truth[test.worst]), report.samples.q[test.worst]),
        **test.weights._asdict(),
    }


def _case(report: StabilityReport, truth: int, q: Array) -> dict[str, Any]:
    angles = report.loop.plants[0].robot.angles(q)
    return {"worst_truth": report.describe_truth(truth), "worst_q": angles}


def _margin(test: MatrixTest) -> str:
    """The margin of a test, and how far it is to be trusted."""
    if not math.isfinite(test.margin):
        return "the period and delays are too long for any function of this kind"
    text, most = f"margin {test.margin:.3g}", test.violating_at_most
    if test.margin <= 0.0:
        return f"{text}; positive in {100.0 * test.share:.3g} % of the configurations"
    text += f"; {test.violations} of {test.checked} further configurations violate it"
    if test.certified:
        text += f", so at most {100.0 * most:.2g} % of all do (95 % confidence)"
    return text


def _near(
    report: StabilityReport,
    part: str,
    figures: dict[str, Any],
    targets: int,
    unstable: int,
    decay: float,
) -> Row:
    """Row of an exact linearisation, sampled or in continuous time."""
    learns, ratio = report.loop.controller.adaptation is not None, figures.get("damping_ratio")
    figures |= {"targets": targets, "unstable": unstable, "decay": decay, "learns": learns}
    if unstable:
        worst = f"at {-decay:.3g}/s"
        if ratio is None:
            worst = f"{figures['spectral_radius']:.3g}-fold in {ms(figures['frame'])}"
        text = f"errors grow at {unstable} of {targets} targets, at worst {worst}"
        return Row(part, "near targets", "unstable", figures, text)
    learnt = " (learnt parameters, often slow, included)" if learns else ""
    text = f"at all {targets} targets; slowest decay {decay:.3g}/s{learnt}"
    text += "" if ratio is None else f", damping ratio {ratio:.2g}"
    return Row(part, "near targets", "stable", figures, text)


def _continuous(report: StabilityReport) -> Iterator[Row]:
    """Rows about the same loop in continuous time, and the worst cases."""
    first, local, samples = report.theorem1, report.local, report.samples
    passed = "holds" if report.is_as_assumed else "would hold"
    names = ("p", "allowed_p", "alpha", "alpha_max", "margin", "b_J", "lambda_m", "lambda_1",
             "lambda_2", "c0", "c1")  # fmt: skip
    figures: dict[str, Any] = {name: getattr(first, name) for name in names}
    figures |= {"holds": first.holds, "too_fast": first.is_too_fast}
    verdict = passed if first.holds else "does not hold"
    yield Row("continuous", "Theorem 1", verdict, figures, f"Jacobian error {first}")
    for family, test in report.matrix.items():
        verdict = passed if test.certified else "does not hold"
        figures = _figures(report, test)
        yield Row("continuous", FAMILY_NAMES[family], verdict, figures, _margin(test))
    figures = {"damping_ratio": float(local.damping_ratios.min())}
    unstable, decay = int((local.decay_rates <= 0.0).sum()), float(local.decay_rates.min())
    yield _near(report, "continuous", figures, len(local.q), unstable, decay)
    form = report.sampled or list(report.matrix.values())[-1]
    for name, truths, q, k in (
        ("matrix form", samples.truth, samples.q, form.worst),
        ("near targets", local.truth, local.q, local.worst),
        ("Theorem 1", samples.truth, samples.q, first.worst["p"]),
    ):
        case = _case(report, int(truths[k]), q[k])
        text = f"{case['worst_truth']} at q = {numbers_of(np.round(case['worst_q'], 2))}"
        yield Row("worst", name, "", case, text)


def of_limits(cost: LimitCost) -> list[Row]:
    """Return rows about limits of effort."""
    acting = Row("limits", "where they act", cost.verdict, {}, _LIMITS[cost.verdict])
    if not cost.holds:
        return [acting._replace(figures={"free": cost.free})]
    ends = [f"{value:.2g} {unit}" for unit, value in cost.free.items() if np.isfinite(value)]
    text = "no error asks for more torque than the motors have"
    if ends:
        text = (
            f"errors below {' or '.join(ends)} never ask for more than the motors have; larger "
            f"ones may: {100.0 * cost.clipped:.3g} % of the samples do"
        )
    rows = [Row("limits", "at rest", "", {"free": cost.free, "clipped": cost.clipped}, text)]
    if cost.level:
        text = "only for starts whose motions never ask for more than the motors have"
        rows.append(Row("limits", "certified", "", {"level": cost.level}, text))
    text = "limits of speed, position and rate, and the weight of an arm taken without gravity"
    return [*rows, acting, Row("limits", "not checked", "", {}, text)]
