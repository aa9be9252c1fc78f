"""`calibrate`: an arm as it is, from recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from approxjac.calibration.fit import TRACKER, Fit, Fitted, Recorded
from approxjac.calibration.recording import Recording
from approxjac.controllers.arguments import chosen_deviations, chosen_kinds
from approxjac.errors import InvalidInputError
from approxjac.formatting import aligned
from approxjac.law import rotation_log
from approxjac.robots import KinematicBelief, KinematicRegressor, Robot
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.validation import Array, as_number, require

KINDS = ("tool", "origins", "axes")
USUAL_SD: Mapping[str, float] = {"tool": 0.2, "origins": 1e-3, "axes": 3e-3, "encoders": 0.015}
_SCALES = (0.1, 0.3, 1.0, 3.0)  # of what is usual
_EXPLAINED = 1e-3, 2e-3  # m, that are left at most, in sockets and for a tracker with its noise
_TURNED, _ELSEWHERE = 0.02, 0.01  # rad, that is left of turns; m, where it was not fitted
_FAR = 5.0  # usual errors of a drawing: more is none
_LONGEST = 2.0  # m, between sockets
_OUTLIER = 5.0  # standard deviations
_PARTS, _LEAST = 5, 10  # of one place, that are left out in turn; samples at least
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

    def __str__(self) -> str:
        table: list[tuple[str, ...]] = [("place", "samples", "drawing", "fitted", "left out")]
        table += [(each.place, f"{each.samples}", *map(_mm, each[2:])) for each in self.places]
        numbers: list[tuple[str, ...]] = [("number", "drawing", "learnt", "sd", "by data")]
        columns = zip(
            self.names, self.units, self.believed, self.learnt, self.sd, self.share, strict=True
        )
        for name, unit, believed, learnt, sd, share in columns:
            sizes = (f"{1e3 * each:.2f} m{unit}" for each in (believed, learnt, sd))
            numbers.append((name, *sizes, f"{100.0 * share:.0f} %"))
        parts = [f"{self.robot.name}: {self.verdict}", aligned(table), aligned(numbers)]
        if self.outliers:
            parts.append(f"far from all others: {', '.join(self.outliers)}")
        return "\n\n".join(parts)


def calibrate(
    arm: Robot,
    recordings: Sequence[Recording] | Recording,
    unknown: Sequence[str] = KINDS,
    sd: Mapping[str, float] | None = None,
    apart: Mapping[tuple[str, str], float] | None = None,
    frame: str | None = None,
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
        sd: Usual errors of a drawing: "tool" and "origins" [m], "axes" and "encoders" [rad]; by
            default 0.2, 0.001, 0.003 and 0.015, as of five Pandas.
        apart: Distances between sockets that are known [m], by pairs of "place socket".
        frame: The frame that was held or seen; by default the arm's tip.

    Raises:
        InvalidInputError: Recordings of other arms, fewer than ten different postures, or an
            unknown socket.
        UnknownNameError: No such frame.
    """
    arm = require("arm", arm, Robot, "a Robot")
    given = [recordings] if isinstance(recordings, Recording) else [*recordings]
    for each in given:
        require("recordings", each, Recording, "Recordings")
    samples = Recorded.of([each.of(arm) for each in given])
    if (count := len(np.unique(np.round(samples.q, 4), axis=0))) < _LEAST:
        message = f"recordings must have at least {_LEAST} different postures, got {count}"
        raise InvalidInputError(message, given=recordings)
    kinds = chosen_kinds(unknown, KINDS)
    used = {*kinds, *(("encoders",) if "axes" in kinds else ())}
    regressor = KinematicRegressor(arm, frame, axes="axes" in kinds)
    unknowns = Unknowns(regressor, kinds, chosen_deviations(sd, USUAL_SD, used))
    tool = Unknowns(regressor, ("tool",), {"tool": unknowns.sd[unknowns.is_tool].max(initial=0.2)})
    lengths = _distances(apart or {}, samples)

    fits = {scale: Fit(unknowns, samples, lengths, scale).solved() for scale in _SCALES}
    scale = max(fits, key=lambda each: fits[each].evidence)
    best, places = fits[scale], list[PlaceSpread]()
    drawn = Fit(tool, samples, lengths, 1.0).solved()
    for place, is_here in _left_out(samples).items():
        here, others = samples.chosen(is_here), samples.chosen(np.logical_not(is_here))
        known, held_out = drawn, math.nan
        if len(others.q) >= _LEAST and (TRACKER in others.frame or TRACKER not in here.frame):
            known = Fit(tool, others, lengths, 1.0).solved()
            held_out = _spread(unknowns, Fit(unknowns, others, lengths, scale).solved(), here)
        spreads = _spread(tool, known, here), _spread(unknowns, best, here), held_out
        places.append(PlaceSpread(place, len(here.q), *spreads))
    left, drawing = _rms([p.held_out for p in places]), _rms([p.drawing for p in places])
    is_better = left < drawing
    chosen, fitted = (unknowns, best) if is_better else (tool, drawn)
    sizes = np.linalg.norm(best.left[:, :3], axis=1)
    far = sizes > _OUTLIER * best.noise[0]
    prior = unknowns.sd * np.where(unknowns.is_tool, 1.0, scale)
    is_turned = any(each is not None for each in samples.turn)
    turn = rotation_log(fitted.sensor[2]) if is_turned else None
    robot = regressor.robot_with(theta := chosen.theta(fitted.u), turn)
    learnt = theta[[regressor.names.index(name) for name in unknowns.names]]
    off = best.u - learnt  # of a robot with its tool only
    return Calibration(
        tuple(unknowns.names), tuple(unknowns.units), unknowns.u, learnt,
        best.P + np.outer(off, off), regressor.rotations,
        (regressor.frames[0], regressor.frames[0] if robot.tip == arm.tip else str(robot.tip)),
        kinds, robot, np.clip(1.0 - best.P.diagonal() / prior**2, 0.0, 1.0), scale, best.noise,
        tuple(places), dict(zip(samples.row, sizes.tolist(), strict=True)),
        tuple(samples.chosen(far).row), is_better,
        _why_not(unknowns, best, left, TRACKER in samples.frame),
    )  # fmt: skip


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


def _distances(
    apart: Mapping[tuple[str, str], float], samples: Recorded
) -> dict[tuple[str, str], float]:
    sockets = {*samples.frame} - {TRACKER}
    require("apart", apart, Mapping, "a mapping from pairs of sockets to metres")
    for pair in apart:
        if unseen := [name for name in pair if name not in sockets]:
            known = ", ".join(sorted(sockets)) or "none"
            message = f"apart must name sockets, {known}, got {', '.join(unseen)}"
            raise InvalidInputError(message, given=apart)
    return {
        pair: as_number("apart", each, unit="m", above=0.0, most=_LONGEST)
        for pair, each in apart.items()
    }


def _left_out(samples: Recorded) -> dict[str, Array]:
    """Return the rows to leave out together: those of a place, or every fifth of a single place."""
    places = np.array(samples.place)
    names = list(dict.fromkeys(samples.place))
    if len(names) > 1:
        return {name: places == name for name in names}
    rows, q = np.arange(len(places)), np.array(samples.q)
    step, apart = (
        np.median(np.linalg.norm(q - np.roll(q, k, axis=0), axis=1)) for k in (1, len(q) // 2)
    )
    is_motion = step < _NEXT * apart  # whose neighbours are alike
    part = rows * _PARTS // len(rows) if is_motion else rows % _PARTS
    return {f"{names[0]} {k + 1}/{_PARTS}".strip(): part == k for k in range(_PARTS)}


def _spread(unknowns: Unknowns, fitted: Fitted, samples: Recorded) -> float:
    """Return the rms of distances of samples from the mean of their socket, or from x [m]."""
    R, b, _ = fitted.sensor
    found: dict[str, list[Array]] = {}
    for q, x, frame in zip(samples.q, samples.x, samples.frame, strict=True):
        H, o = unknowns.at(q, fitted.u)
        p = o + H @ fitted.u
        found.setdefault(frame, []).append(p if x is None else R @ p + b - x)
    away = [
        np.subtract(points, 0.0 if frame == TRACKER else np.mean(points, axis=0))
        for frame, points in found.items()
    ]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(away) ** 2, axis=1))))


def _rms(values: Sequence[float]) -> float:
    known = [each for each in values if not math.isnan(each)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else math.nan


def _mm(length: float) -> str:
    return "–" if math.isnan(length) else f"{1e3 * length:.2f} mm"
