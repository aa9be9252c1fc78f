"""`DriftWatch`: a slipped tool or a moved sensor, by the frames that what was learnt predicts."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from approxjac.controllers.controller import Controller
from approxjac.controllers.learning.estimator import Estimator, Expectation, Sight
from approxjac.controllers.learning.positions import AdaptiveKinematics
from approxjac.errors import InvalidInputError
from approxjac.interface import Condition, Measurement
from approxjac.tasks import ImageTask
from approxjac.validation import Array

_OWN = ("tool", "origins", "axes", "offset", "delay")  # learnt where the law learns nothing
_OF_IMAGE = ("tool", "origins", "camera", "delay")
_NOISE = 1e-3  # m, at least; more is seen
_SETTLES = 2.0  # s of frames, from which on what was learnt is compared
_LASTS, _WINDOWS = 3.0, 2  # s of frames that are compared with one state; such windows at a time
_PIECE, _OFTEN = 0.05, 3  # s, in which a change may have begun; such pieces from test to test
_RECENT = 1.0  # s, since when it may have
_APART = 8e-3  # s, between samples that are looked at
_FEWEST = 6  # frames after a change
_SLOW = 1e-3  # m, by which x may differ all along from what is predicted
_MOST = 0.3, 0.3  # m and rad, of a change
_SURE = 40.0  # of χ² that a change explains: what is no noise
_LEAST = 3e-3  # m, of a change
_CLEAR, _SHARE = 14.0, 0.02  # χ², and share of it, by which a cause explains more than the other
_SHOWS, _PATIENCE = 0.3, 1.3  # s, for which a change has to show, and in which its cause has


class Change(NamedTuple):
    """A change, as the frames explain it best.

    Attributes:
        condition: What moved.
        begin: Time since which it did [s].
        named: Time at which that was sure [s].
        size: Distance by which the seen tip moved [m], and its standard deviation `sd`.
        turn: Angle by which tool or sensor turned [rad], and its standard deviation `turn_sd`; NaN
            where it does not show.
    """

    condition: Condition
    begin: float
    named: float
    size: float
    sd: float
    turn: float
    turn_sd: float

    @property
    def figure(self) -> str:
        """Its size with units."""
        text = f"{1e3 * self.size:.3g} ± {1e3 * self.sd:.1g} mm at the tip"
        if math.isfinite(self.turn):
            turn, sd = (math.degrees(each) for each in (self.turn, self.turn_sd))
            text += f", turned by {turn:.2g} ± {sd:.1g} deg"
        return text


class DriftWatch:
    """A test for a slipped tool, or a moved camera or tracker, on new frames of x.

    What was learnt until some moment predicts the frames after it, up to noise, its covariance, and
    a slow error. The generalised likelihood ratio says how much more of them is explained by a
    motion of the tool, or of the sensor, from some frame on. Where the law learns no kinematics,
    the watch learns some of its own, of a position, pose or planar image.

    Args:
        controller: The controller.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller, self._state = controller, np.zeros(0)
        kinematics = controller.kinematics
        self._is_own = kinematics is None or not kinematics.names
        if self._is_own:
            task = controller.task.measured
            own = (_OF_IMAGE, None) if isinstance(task, ImageTask) else (_OWN, _NOISE)
            try:
                kinematics = AdaptiveKinematics(task, unknown=own[0], noise=own[1])
            except InvalidInputError:  # which x it does not know
                kinematics = None
        self._kinematics = kinematics if isinstance(kinematics, Estimator) else None
        self._t = self._taken = -math.inf
        self._windows: list[_Window] = []

    def look(self, measurement: Measurement, state: Array) -> Change | None:
        """Look at a sample, with the controller's state before it; return a change it shows."""
        kinematics = self._kinematics
        if kinematics is None or 0.0 <= measurement.t - self._t < _APART:
            return None
        since, self._t = measurement.t - self._t, measurement.t
        if self._is_own:
            if not 0.0 < since < math.inf:
                self._state, since = kinematics.initial_state(measurement), _APART
            known = self._state = kinematics.step(self._state, measurement, since)
        else:
            try:
                _, known = self._controller.kinematics_of(state)
            except InvalidInputError:  # a controller of a user's own that does not tell
                self._kinematics = None
                return None
        frame = kinematics.last_frame(known, measurement)
        if frame is None or frame.t == self._taken:
            return None
        if frame.t < self._taken:
            self._windows.clear()
        self._taken = frame.t
        self._windows = [
            each for each in self._windows
            if frame.t < each.begun + _LASTS or math.isfinite(each.crossed)
        ]  # fmt: skip
        begun = self._windows[-1].begun if self._windows else -math.inf
        for window in self._windows:  # the one that knows most of what was before comes first
            if change := window.look(frame):
                self._windows.clear()
                return change
        if frame.t >= begun + _LASTS / _WINDOWS and kinematics.seconds(known) > _SETTLES:
            expected = kinematics.expectation(known)
            if expected is not None:
                self._windows.append(_Window(frame.t, expected))
        return None


class _Window:
    """Frames since a moment, as what was learnt until then expects them.

    Sums of products of columns are kept by pieces of time: of what may be off all along, U, of
    motions of the tool and of the sensor, and of the residual.
    """

    def __init__(self, begun: float, expected: Expectation) -> None:
        self.begun, self._expected = begun, expected
        self.crossed = math.inf  # when a change showed first, and since when it was
        self._onset = math.nan
        values, axes = np.linalg.eigh(expected.covariance)
        self._root = axes * np.sqrt(np.maximum(values, 0.0))
        self._begins, self._counts, self._sums = list[float](), list[int](), list[Array]()

    def look(self, frame: Measurement) -> Change | None:
        """Add a frame; return the change that those before it show, at the end of some pieces."""
        sight, change = self._expected.sight(frame), None
        if not self._begins or frame.t >= self._begins[-1] + _PIECE:
            if self._begins and len(self._begins) % _OFTEN == 0:
                change = self._change(frame.t, sight)
            self._begins.append(frame.t)
            self._counts.append(0)
            self._sums.append(np.zeros(()))
        rows = np.column_stack([sight.H @ self._root, _SLOW * sight.shift, *sight[2:], sight.left])
        rows = rows[np.isfinite(sight.left)] / self._expected.noise
        self._sums[-1] = self._sums[-1] + rows.T @ rows
        self._counts[-1] += 1
        return change

    def _change(self, t: float, sight: Sight) -> Change | None:
        """Return the motion of tool or sensor that explains the frames best, if one does."""
        begins, since = np.array(self._begins), np.cumsum(self._counts[::-1])[::-1]
        is_tried = since >= _FEWEST
        is_tried &= (
            np.abs(begins - self._onset) < 2.5 * _PIECE
            if math.isfinite(self.crossed)
            else begins > t - _RECENT
        )
        if not is_tried.any():
            return None
        n = sight.H.shape[1] + sight.shift.shape[1]
        pieces = np.array(self._sums)
        whole, parts = pieces.sum(axis=0), (slice(2, 4), slice(4, 6))
        since_then: Array = np.cumsum(pieces[::-1, :, n:], axis=0)[::-1]
        first = [_caused(since_then[is_tried], whole, n, sight, part) for part in parts]
        k = int(np.flatnonzero(is_tried)[max(first, key=lambda cause: cause.explains).start])
        if k + 1 < len(pieces):  # without the pieces in which it may have begun
            whole = whole - pieces[max(k - 1, 0) : k + 1].sum(axis=0)
            first = [_caused(since_then[k + 1 : k + 2], whole, n, sight, part) for part in parts]
        tool, sensor = first
        apart = tool.explains - sensor.explains
        is_clear = abs(apart) > _CLEAR + _SHARE * max(tool.explains, sensor.explains)
        cause = sensor if is_clear and apart < 0.0 else tool  # which has fewer numbers
        if not (cause.explains > _SURE and cause.size > _LEAST):
            self.crossed = math.inf
            return None
        if self.crossed > t:
            self.crossed, self._onset = t, self._begins[k]
        if t < self.crossed + (_SHOWS if is_clear else _PATIENCE):
            return None
        kind = Condition.TOOL_SLIPPED if apart > 0.0 else Condition.SENSOR_MOVED
        turn = cause.turn if is_clear and cause.turn > 3.0 * cause.turn_sd else math.nan
        return Change(
            kind if is_clear else Condition.TOOL_OR_SENSOR_MOVED,
            self._begins[k], t, cause.size, cause.sd, turn, cause.turn_sd,
        )  # fmt: skip


def _caused(sums: Array, whole: Array, n: int, sight: Sight, part: slice) -> _Cause:
    """Return the motion by one cause that explains most, from one of some instants on.

    The sums (k, …) are of columns of motions and residual since each, the whole one is of all
    frames; the first n columns are U.
    """
    (moves, turns), A = sight[part], np.eye(n) + whole[:n, :n]
    count = moves.shape[1], turns.shape[1]
    first = sum(each.shape[1] for each in sight[2 : part.start])
    columns = slice(first, first + sum(count))
    C, own = sums[:, :n, columns], sums[:, n + first : n + columns.stop]
    k, _, g = C.shape
    both = np.column_stack([C.transpose(1, 0, 2).reshape(n, -1), whole[:n, -1]])
    solved = np.linalg.solve(A, both)
    e = own[..., -1] - solved[:, -1] @ C
    M = own[..., columns] - C.transpose(0, 2, 1) @ solved[:, :-1].reshape(n, k, g).swapaxes(0, 1)
    P = np.linalg.inv(M + np.diag(np.repeat(np.array(_MOST) ** -2.0, count)))
    explains = np.einsum("ki,kij,kj->k", e, P, e)
    i = int(explains.argmax())
    step, at_tip = P[i] @ e[i], np.hstack([moves, turns])[: sight.shift.shape[1]]
    size, turn = _length(at_tip, step, P[i]), _length(np.eye(g)[count[0] :], step, P[i])
    return _Cause(float(explains[i]), i, *size, *turn)


class _Cause(NamedTuple):
    """A motion that may be the cause."""

    explains: float  # χ²
    start: int  # which of the instants
    size: float  # of the motion of x [m], and its standard deviation
    sd: float
    turn: float  # [rad], and its standard deviation
    turn_sd: float


def _length(G: Array, step: Array, P: Array) -> tuple[float, float]:
    """Return the length of G step, and its standard deviation by the covariance P of step."""
    moved = G @ step
    length = float(np.linalg.norm(moved))
    way = G.T @ (moved / max(length, 1e-12))
    return length, math.sqrt(max(float(way @ P @ way), 0.0))
