"""`calibrate`: an arm as it is, from recordings; `next_configurations`: where to measure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from approxjac.calibration.fit import TRACKER, Fit, Fitted, Recorded, TipAccuracy
from approxjac.calibration.recording import Recording
from approxjac.controllers.arguments import chosen_kinds
from approxjac.errors import InvalidInputError, MissingPackageError, package_of
from approxjac.formatting import aligned, plain
from approxjac.law import rotation_log
from approxjac.robots import (
    FittedDynamics,
    KinematicBelief,
    KinematicRegressor,
    Robot,
    fit_dynamics,
)
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.validation import Array, as_integer, as_number, require

KINDS = ("tool", "origins", "axes")
USUAL_SD: Mapping[str, float] = {"tool": 0.2, "origins": 1e-3, "axes": 3e-3, "encoders": 0.015}
_SCALES = (0.1, 0.3, 1.0, 3.0)  # of what is usual
_EXPLAINED = 1e-3, 2e-3  # m, that are left at most, in sockets and for a tracker with its noise
_TURNED, _ELSEWHERE = 0.02, 0.01  # rad, that is left of turns; m, where it was not fitted
_IN_PART = 2e-3  # m, sd of the tip at 95 % of a workspace of which only part is known
_FAR = 5.0  # usual errors of a drawing: more is none
_LONGEST = 2.0  # m, between sockets
_OUTLIER = 5.0  # standard deviations
_PARTS, _LEAST = 5, 10  # of one place, that are left out in turn; samples at least
_CANDIDATES = 1000
_NOISE = 2e-4  # m, sd of a measured coordinate
_ANYWHERE = 1.0  # m, sd of the place that is touched, or of the tracker's origin
_NEXT = 0.1  # of the usual distance of configurations: nearer ones are a motion's


class PlaceSpread(NamedTuple):
    """Accuracy of the arm at one place: rms residuals of position [m].

    The residual of a socket is the distance from the mean, that of a tracker from its measurement.

    Attributes:
        place: Its name.
        samples: Number of them.
        drawing: By the drawing, with the tool that fits all others best.
        left: By the calibration, which was fitted to this place, too.
        held_out: By a calibration without this place; NaN if no other data cover it.
    """

    place: str
    samples: int
    drawing: float
    left: float
    held_out: float


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(KinematicBelief):
    """The result of `calibrate`: an arm fitted to recordings, and its accuracy.

    Attributes:
        robot: The calibrated arm: with all learnt numbers or, if these are no better at places that
            were left out, with the learnt tool only.
        share: Share of each number that the recordings determine, from 0 to 1, shape (p,).
        scale: Size of the errors of the drawing, as a multiple of the usual ones.
        noise: Robust standard deviations of the residuals of position [m] and rotation [rad], (2,).
        places: Accuracy of the arm, place by place.
        residuals: Residual of each row, by its name [m].
        outliers: Rows far from all others, which weigh less or nothing.
        is_better: False if the drawing with a fitted tool is as good at places that were left out.
        why_not: Reason why these numbers do not explain the recordings; empty if they do.
        accuracy: Standard deviations of the tip (N,) [m] by configurations, `accuracy(q)`.
        dynamics: Friction and load by torques of the longest recording that has them.
        torques: Numbers that these torques do not determine, or the reason why nothing was fitted.
    """

    robot: Robot
    share: Array
    scale: float
    noise: Array
    places: tuple[PlaceSpread, ...]
    residuals: Mapping[str, float]
    outliers: tuple[str, ...]
    is_better: bool
    why_not: str
    accuracy: TipAccuracy
    dynamics: FittedDynamics | None = None
    torques: str = ""

    @property
    def is_explained(self) -> bool:
        """True if nothing else seems wrong."""
        return not self.why_not

    @property
    def sd(self) -> Array:
        """Standard deviations of the learnt numbers in their units, shape (p,)."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def held_out(self) -> float:
        """Residual at places that were left out [m], rms over the places; NaN without any."""
        return _rms([each.held_out for each in self.places])

    @cached_property
    def tip_sd(self) -> tuple[float, float, float]:
        """Sd of the tip [m]: median where it was recorded, median and 95 % of the workspace."""
        here, all_ = (self.accuracy(q) for q in (self.accuracy.recorded, self.accuracy.workspace))
        return float(np.median(here)), float(np.median(all_)), float(np.quantile(all_, 0.95))

    @property
    def coverage(self) -> str:
        """A sentence on the accuracy of the tip, where it was recorded and elsewhere."""
        here, middle, most = map(_mm, self.tip_sd)
        text = f"known to {here} (sd) at the configurations recorded, {middle} in the median and "
        text += f"{most} at 95 % of the workspace"
        in_part = ": only part of it is known; record postures where the arm is to work"
        return text + in_part * (self.tip_sd[2] > _IN_PART)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        left, drawing = math.sqrt(3.0) * self.noise[0], _rms([each.drawing for each in self.places])
        if self.why_not:
            return f"not explained: {self.why_not}"
        if math.isnan(self.held_out):
            return f"{_mm(left)} are left; record a second place to see how far that holds"
        if not self.is_better:
            return f"no better than the drawing where it was not fitted: {_mm(drawing)} are left"
        where = "where it was not fitted"
        if self.places[-1].place.endswith(f"{_PARTS}/{_PARTS}"):
            where = "of other rows at the same place"
        return f"{_mm(self.held_out)} are left {where}, {_mm(drawing)} by the drawing"

    def summary(self) -> dict[str, Any]:
        """Return the report for JSON, in SI units; None where a number is not known."""
        shown = (
            "verdict", "coverage", "is_explained", "is_better", "held_out", "tip_sd", "noise",
            "scale", "outliers", "torques",
        )  # fmt: skip
        contents = {name: getattr(self, name) for name in shown}
        fields = "name", "unit", "drawing", "learnt", "sd", "share"
        contents["places"] = [each._asdict() for each in self.places]
        contents["numbers"] = [dict(zip(fields, each, strict=True)) for each in self._numbers()]
        if (fit := self.dynamics) is not None:
            friction = fit.friction.viscous, fit.friction.coulomb, fit.friction.load
            contents |= {"payload": fit.payload, "payload_sd": fit.payload_sd}
            contents |= {"friction": friction, "friction_sd": fit.friction_sd}
        return dict(plain(contents))

    def _numbers(self) -> Iterator[tuple[str, str, float, float, float, float]]:
        values = self.believed, self.learnt, self.sd, self.share
        return zip(self.names, self.units, *values, strict=True)

    def __str__(self) -> str:
        table: list[tuple[str, ...]] = [("place", "samples", "drawing", "fitted", "left out")]
        table += [(each.place, f"{each.samples}", *map(_mm, each[2:])) for each in self.places]
        numbers: list[tuple[str, ...]] = [("number", "drawing", "learnt", "sd", "by data")]
        for name, unit, believed, learnt, sd, share in self._numbers():
            sizes = (f"{1e3 * each:.2f} m{unit}" for each in (believed, learnt, sd))
            numbers.append((name, *sizes, f"{100.0 * share:.0f} %"))
        head = f"{self.robot.name}: {self.verdict}\n{self.coverage}"
        parts = [head, aligned(table), aligned(numbers)]
        if self.outliers:
            parts.append(f"far from all others: {', '.join(self.outliers)}")
        parts += [f"{self.dynamics}"] * bool(self.dynamics) + [self.torques] * bool(self.torques)
        return "\n\n".join(parts)


def calibrate(
    arm: Robot,
    recordings: Sequence[Recording] | Recording,
    unknown: Sequence[str] = KINDS,
    apart: Mapping[tuple[str, str], float] | None = None,
) -> Calibration:
    """Return an arm calibrated by recordings: tool, joint origins, axes and encoders.

    Rows that do not fit weigh less, or nothing (Huber, then Tukey). How large errors of the drawing
    are is chosen by the evidence. Each place is left out once, or of a single place each fifth of
    its rows: the residual there is the accuracy to expect where nothing was measured.

    Args:
        arm: The arm as it is drawn.
        recordings: What was recorded of it.
        unknown: What may be wrong: "tool", "origins" and "axes", which are tilts of joint axes and
            offsets of encoders.
        apart: Distances between sockets that are known [m], by pairs of "place socket".

    Raises:
        InvalidInputError: Recordings of other arms, fewer than ten different postures, or an
            unknown socket.
    """
    arm = require("arm", arm, Robot, "a Robot")
    given = [recordings] if isinstance(recordings, Recording) else [*recordings]
    for each in given:
        require("recordings", each, Recording, "Recordings")
    given = [each.of(arm) for each in given]
    samples = Recorded.of([each for each in given if each.kind != "motion"])
    if (count := len(np.unique(np.round(samples.q, 4), axis=0))) < _LEAST:
        message = f"recordings must have at least {_LEAST} different postures, got {count}"
        if any(each.kind == "motion" for each in given):
            message += " beside free motions, which have torques and no x"
        raise InvalidInputError(message, given=recordings)
    kinds = chosen_kinds(unknown, KINDS)
    regressor = KinematicRegressor(arm, axes="axes" in kinds)
    unknowns = Unknowns(regressor, kinds, USUAL_SD)
    tool = Unknowns(regressor, ("tool",), {"tool": unknowns.sd[unknowns.is_tool].max(initial=0.2)})
    require("apart", apart := apart or {}, Mapping, "a mapping from pairs of sockets to metres")
    sockets = {*samples.frame} - {TRACKER}
    if unseen := [name for pair in apart for name in pair if name not in sockets]:
        there = ", ".join(sorted(sockets)) or "none"
        message = f"apart must name sockets, {there}, got {', '.join(unseen)}"
        raise InvalidInputError(message, given=apart)
    lengths = {
        pair: as_number("apart", each, unit="m", above=0.0, most=_LONGEST)
        for pair, each in apart.items()
    }

    fits = {scale: Fit(unknowns, samples, lengths, scale).solved() for scale in _SCALES}
    scale = max(fits, key=lambda each: fits[each].evidence)
    best, places = _mixed(fits, scale), list[PlaceSpread]()
    tried = list[tuple[Fitted, Recorded, Recorded]]()
    drawn = Fit(tool, samples, lengths, 1.0).solved()
    for place, is_here in _left_out(samples).items():
        here, others = samples.chosen(is_here), samples.chosen(~is_here)
        known, held_out = drawn, math.nan
        if _is_predicted(here, by=others):
            known = Fit(tool, others, lengths, 1.0).solved()
            without = Fit(unknowns, others, lengths, scale).solved()
            held_out = _spread(unknowns, without, here)
            tried.append((without, others, here))
        spreads = _spread(tool, known, here), _spread(unknowns, best, here), held_out
        places.append(PlaceSpread(place, len(here.q), *spreads))
    if len({*samples.place}) == 1:  # its other rows are too much alike
        halves = [(o, h) for o, h in _halves(samples) if _is_predicted(h, by=o)]
        tried = [(Fit(unknowns, o, lengths, scale).solved(), o, h) for o, h in halves]
    wide = [
        _spread(unknowns, without, here)
        / _predicted(TipAccuracy(arm, unknowns, without, others), without, here)
        for without, others, here in tried
    ]
    accuracy = TipAccuracy(arm, unknowns, best, samples)
    accuracy.widening = max(1.0, float(np.median(wide or 1.0)))  # whatever a single bad place says
    left, drawing = _rms([p.held_out for p in places]), _rms([p.drawing for p in places])
    is_better = left < drawing
    chosen, fitted = (unknowns, best) if is_better else (tool, drawn)
    sizes = np.linalg.norm(best.left[:, :3], axis=1)
    far = sizes > _OUTLIER * best.noise[0]
    prior = unknowns.sd * np.where(unknowns.is_tool, 1.0, scale)
    turn = rotation_log(fitted.sensor[2]) if samples.is_turned else None
    robot = regressor.robot_with(theta := chosen.theta(fitted.u), turn)
    learnt = theta[[regressor.names.index(name) for name in unknowns.names]]
    off = best.u - learnt  # of a robot with its tool only
    return Calibration(
        tuple(unknowns.names), tuple(unknowns.units), unknowns.u, learnt,
        best.P + np.outer(off, off), regressor.rotations,
        (regressor.frames[0], regressor.frames[0] if robot.tip == arm.tip else str(robot.tip)),
        kinds, robot, np.clip(1.0 - best.P.diagonal() / prior**2, 0.0, 1.0), scale, best.noise,
        tuple(places), dict(zip(samples.row.tolist(), sizes.tolist(), strict=True)),
        tuple(samples.row[far].tolist()), is_better,
        _why_not(unknowns, best, left, TRACKER in samples.frame), accuracy,
        *_torques(robot, [each for each in given if each.tau is not None]),
    )  # fmt: skip


def next_configurations(
    arm: Robot,
    calibration: Calibration | None = None,
    count: int = 16,
    candidates: Sequence[Sequence[float]] | Array | None = None,
) -> Array:
    """Return the configurations that tell most about an arm, shape (count, nq) [rad or m].

    One by one that whose measurement brings the most information, log det(1 + HPHᵀ/σ²), with what
    the ones before tell. The place at which the tip is held, or the tracker's origin, is unknown.
    No measurement is needed.

    Args:
        arm: The arm as it is drawn.
        calibration: What is known already of it; by default nothing.
        count: How many.
        candidates: Configurations to choose from, (N, nq): those at which the tip can be held at
            one place, if it is. By default a thousand random ones within the joints' ranges.

    Raises:
        InvalidInputError: Too few candidates, or a calibration of another arm.
    """
    arm = require("arm", arm, Robot, "a Robot")
    count = as_integer("count", count, 1)
    kinds = KINDS if calibration is None else calibration.kinds
    unknowns = Unknowns(KinematicRegressor(arm, axes="axes" in kinds), kinds, USUAL_SD)
    drawn = [*arm.configurations(_CANDIDATES)] if candidates is None else candidates
    rows = [arm.configuration(q) for q in drawn]
    if len(rows) < count:
        message = f"candidates must be at least {count} configurations, got {len(rows)}"
        raise InvalidInputError(message, given=candidates)
    P, u, n = np.diag(unknowns.sd**2), unknowns.u, len(unknowns.u)
    if calibration is not None:
        if calibration.names != tuple(unknowns.names):
            message = f"calibration must be of {arm.name}, got one of {calibration.robot.name}"
            raise InvalidInputError(message, given=calibration)
        P, u = calibration.covariance, calibration.learnt
    C = np.zeros((n + 3, n + 3))
    C[:n, :n], C[n:, n:] = P, _ANYWHERE**2 * np.eye(3)
    H = np.array([np.hstack([unknowns.at(q, u)[0], np.eye(3)]) for q in rows])
    chosen: list[int] = []
    for _ in range(count):
        S = np.eye(3) + H @ C @ H.transpose(0, 2, 1) / _NOISE**2
        gains = np.linalg.slogdet(S)[1]
        gains[chosen] = -np.inf
        chosen.append(int(gains.argmax()))
        best = H[chosen[-1]]
        CH = C @ best.T
        C = C - CH @ np.linalg.solve(best @ CH + _NOISE**2 * np.eye(3), CH.T)
    return np.array([rows[i] for i in chosen])


def _why_not(unknowns: Unknowns, fitted: Fitted, held_out: float, is_tracked: bool) -> str:
    """Return why the numbers of an arm do not explain what was recorded, or nothing."""
    left, turned = (math.sqrt(3.0) * fitted.noise).tolist()
    away = np.where(unknowns.is_tool, 0.0, np.abs(fitted.u - unknowns.u) / unknowns.sd)
    hint = "units, signs, the order of columns and known distances"
    if left > 0.05 or held_out > 0.05:
        return f"{_mm(max(left, held_out))} are left: check {hint}"
    if is_tracked and turned > _TURNED:
        return f"{1e3 * turned:.0f} mrad are left of turns: check order and sense of qx, qy, qz, qw"
    if left > _EXPLAINED[is_tracked]:
        return f"{_mm(left)} are left even where it was fitted, as of backlash or of what bends"
    if away.max(initial=0.0) > _FAR:
        name = unknowns.names[int(away.argmax())]
        return f"{name} would be {away.max():.0f} times as wrong as usual: check {hint}"
    if held_out > _ELSEWHERE:
        return f"{_mm(held_out)} are left where it was not fitted"
    return ""


def _mixed(fits: Mapping[float, Fitted], scale: float) -> Fitted:
    """Return one of the fits, with a covariance that also knows that its scale may be another."""
    best = fits[scale]
    shares = np.exp([each.evidence - best.evidence for each in fits.values()])
    parts = [each.P + np.outer(each.u - best.u, each.u - best.u) for each in fits.values()]
    return best._replace(P=np.average(parts, axis=0, weights=shares))


def _torques(arm: Robot, recordings: Sequence[Recording]) -> tuple[FittedDynamics | None, str]:
    """Return friction and load by the longest of some recordings, and what does not follow."""
    if not recordings:
        return None, ""
    longest = max(recordings, key=len)
    q, tau = longest.q.T, np.asarray(longest.tau).T
    if longest.t is None or not np.isfinite(tau).all() or not (np.diff(longest.t) > 0.0).all():
        return None, "friction and load need torques of all joints, at times t that increase"
    step = float(np.median(np.diff(longest.t)))
    t = np.arange(longest.t[0], longest.t[-1], step)
    try:
        package_of("study", "scipy")
        q, tau = (np.array([np.interp(t, longest.t, each) for each in of]).T for of in (q, tau))
        fit = fit_dynamics(arm, q, tau, step)
    except (InvalidInputError, MissingPackageError) as error:
        return None, f"torques do not show friction and load: {error}"
    kinds = ("viscous", "Coulomb", "load-dependent"), fit.friction_sd
    values = fit.friction.viscous, fit.friction.coulomb, fit.friction.load
    small = [
        f"{kind} friction of {name}"
        for kind, sds, each in zip(*kinds, np.array(values), strict=True)
        for name in np.array(arm.joint_names)[each < 2.0 * sds]
    ]
    small += ["payload"] * (abs(fit.payload) < 2.0 * fit.payload_sd)
    text = "torques are taken as true: motor constants may be off by 20 %"
    return fit, f"{text}; not distinguished from zero: {', '.join(small) or 'nothing'}"


def _left_out(samples: Recorded) -> dict[str, Any]:
    """Return the rows to leave out together: those of a place, or every fifth of a single place."""
    names, q = list(dict.fromkeys(samples.place.tolist())), samples.q
    if len(names) > 1:
        return {name: samples.place == name for name in names}
    rows = np.arange(len(q))
    step, apart = (
        np.median(np.linalg.norm(q - np.roll(q, k, axis=0), axis=1)) for k in (1, len(q) // 2)
    )
    is_motion = step < _NEXT * apart  # whose neighbours are alike
    part = rows * _PARTS // len(rows) if is_motion else rows % _PARTS
    return {f"{names[0]} {k + 1}/{_PARTS}".strip(): part == k for k in range(_PARTS)}


def _halves(samples: Recorded) -> list[tuple[Recorded, Recorded]]:
    """Return the two halves whose postures differ most, each with the other."""
    away = samples.q - samples.q.mean(axis=0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2][0]
    is_one = along > np.median(along)
    one, other = samples.chosen(is_one), samples.chosen(~is_one)
    return [(one, other), (other, one)]


def _is_predicted(here: Recorded, by: Recorded) -> bool:
    return len(by.q) >= _LEAST and (TRACKER in by.frame or TRACKER not in here.frame)


def _spread(unknowns: Unknowns, fitted: Fitted, samples: Recorded) -> float:
    """Return the rms of distances of samples from the mean of their socket, or from x [m]."""
    at = [unknowns.at(q, fitted.u) for q in samples.q]
    away = _about_sockets(np.array([o + H @ fitted.u for H, o in at]), samples)
    R, b, _ = fitted.sensor
    for i in np.flatnonzero(samples.frame == TRACKER):
        away[i] = R @ away[i] + b - samples.x[i]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def _predicted(accuracy: TipAccuracy, fitted: Fitted, samples: Recorded) -> float:
    """Return the expected `_spread` of samples left out, by covariance and noise [m]."""
    H = _about_sockets(accuracy.linear(samples.q)[1], samples)
    variances = np.einsum("nij,jk,nik->n", H, fitted.P, H)
    return float(np.sqrt(3.0 * fitted.noise[0] ** 2 + variances.mean()))


def _about_sockets(values: Array, samples: Recorded) -> Array:
    """Return values of samples (N, …) without the mean of those at the same socket."""
    values = values.copy()
    for frame in {*samples.frame} - {TRACKER}:
        values[samples.frame == frame] -= values[samples.frame == frame].mean(axis=0)
    return values


def _rms(values: Sequence[float]) -> float:
    known = [each for each in values if not math.isnan(each)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else math.nan


def _mm(length: float) -> str:
    return "–" if math.isnan(length) else f"{1e3 * length:.2f} mm"
