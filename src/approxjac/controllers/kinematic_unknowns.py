"""What may be wrong about a measured position, as numbers that it is linear in, and a rotation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import KinematicRegressor
from approxjac.tasks import PositionTask, StackedTask, Task, TrackerTask
from approxjac.validation import Array, as_number, require

KINDS = ("tool", "origins", "camera", "offset", "scale")
"""What may be unknown."""
USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "origins": 0.02, "camera": 1.0, "offset": 0.2, "scale": 0.2,
}  # fmt: skip
"""Plausible errors: of translations and offset along each axis [m], rotation [rad], and scale."""
_TURNABLE = ("xyz", "xy", "yx", "xz", "zx", "yz", "zy")


class Unknowns:
    """x = R(o(q) + H(q)Θ), with Θ = (u, c): translations and scale u, offset c = Rᵀb.

    Args:
        task: Position of a frame, of several, or as a tracker sees it, of the believed robot.
        unknown: Some of `KINDS`.
        sd: Plausible errors in place of those of `USUAL_SD`.

    Attributes:
        regressor: p(q) of the frames.
        names: Names of all that is learnt: u, then b, then the rotation.
        units: Their units.
        believed: Their values before the first frame.
        sd: Their standard deviations then.
        n_u: Length of u.
        d: Number of axes of a point.
        R: Believed rotation of the base's axes in the sensor's, shape (d, d).
        Theta: Believed Θ, shape (P,).
        turns: Whether the rotation is learnt.
        constant: What is to be added to p, as the offset is known, in the base's axes, shape (m,).
        has_scale: Whether a scale is learnt, the last entry of u.
    """

    def __init__(self, task: Task, unknown: Any, sd: Any) -> None:
        kinds, sds = _kinds(unknown), _deviations(sd)
        points = _points(task)
        axes, self.R, b = points[0][1:]
        self.turns, self.has_scale = "camera" in kinds, "scale" in kinds
        frames = list(dict.fromkeys(point.frame for point in points))
        self.regressor = regressor = KinematicRegressor(task.robot, frames)
        of_each = [(frames.index(point.frame), axis) for point in points for axis in point.axes]
        rows = [3 * frame + "xyz".index(axis) for frame, axis in of_each]
        self.rows: slice | Array = slice(None) if rows == list(range(3 * regressor.k)) else (
            np.array(rows)
        )  # fmt: skip
        if self.turns:
            if any(point.axes != axes or axes not in _TURNABLE for point in points):
                raise InvalidInputError(
                    f"a camera that may be turned needs the same axes of every point, one of "
                    f"{', '.join(_TURNABLE)}, got {task!r}",
                    given=task,
                )
        else:
            axes = "".join(letter for letter in "xyz" if any(letter == axis for _, axis in of_each))
            if len(axes) != len(b):  # points with other axes than the first: no tracker's
                self.R, b = np.eye(len(axes)), np.zeros(len(axes))
        self.d = len(axes)

        # p = o(q) + Y(q)(θ_known + S u)
        theta = regressor.theta.copy()
        is_tool = np.arange(regressor.p) >= regressor.p - 3 * len(frames)
        self.of_theta = np.flatnonzero(np.where(is_tool, "tool" in kinds, "origins" in kinds))
        columns = list(np.eye(regressor.p)[self.of_theta])
        u = theta[self.of_theta].tolist()
        names = [regressor.names[i] for i in self.of_theta]
        sd_u = [sds["tool" if is_tool[i] else "origins"] for i in self.of_theta]
        theta[self.of_theta] = 0.0
        if self.has_scale:
            if "origins" in kinds or "m" in task.robot.joint_units:
                raise InvalidInputError(
                    "scale can be learnt only where the origins are known and no joint slides, "
                    f"got unknown = {kinds} for {task.robot.name}, where lengths and scale are one",
                    given=unknown,
                )
            columns.append(theta)
            u, sd_u, names = [*u, 1.0], [*sd_u, sds["scale"]], [*names, "scale"]
            theta = np.zeros(regressor.p)
        self.theta, self.n_u = theta, len(u)
        self.S = np.array(columns).reshape(-1, regressor.p).T
        c = self.R.T.dot(b)
        self.constant: Array = np.zeros(len(rows))  # c, where it is known
        self.offsets = np.zeros((len(rows), 0))
        spins = len(law.generators(self.d)) if self.turns else 0
        believed, deviations = u, sd_u
        each = np.array([axes.index(axis) for _, axis in of_each])
        if self.turns or "offset" in kinds:
            self.offsets = np.eye(self.d)[each]
            names = names + [f"offset.{axis}" for axis in axes]
            believed, deviations = [*u, *b], [*sd_u, *[sds["offset"]] * self.d]
        elif c.any():
            self.constant = c[each]
        self.Theta = np.concatenate([u, c if self.offsets.size else np.zeros(0)])
        self.sd_Theta, self.sd_R = np.array(deviations), sds["camera"]
        if self.turns:
            names += [f"camera.r{axis}" for axis in "xyz"] if self.d == 3 else ["camera.turn"]
        turn = law.rotation_log(self.R) if self.turns else np.zeros(0)
        self.names = tuple(names)
        self.units = tuple(
            "" if name == "scale" else "rad" if name.startswith("camera") else "m" for name in names
        )
        self.believed = np.concatenate([believed, turn])
        self.sd = np.concatenate([deviations, np.full(spins, sds["camera"])])
        # how far x may move from one configuration to another
        self._usual = self.theta + self.S.dot(u)
        self._spread = self.S * np.array(sd_u)

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return H(q) without the offset's columns, shape (m, n_u), and o(q), shape (m,)."""
        Y = self.regressor.Y(q)[self.rows]
        known = Y.dot(self.theta) + self.constant
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q)[self.rows]
        return Y.dot(self.S), known

    def reach(self, q_0: Array, q: Array) -> Array:
        """Return how far each entry of x may move from one configuration to another, (m,) [m].

        Half as far again as the believed arm, and four standard deviations of what may be wrong.
        """
        moved = self.regressor.Y(q) - self.regressor.Y(q_0)
        known = moved.dot(self._usual)
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q) - self.regressor.offset(q_0)
        each = np.sqrt((known.reshape(-1, 3) ** 2).sum(axis=1))
        unsure = np.sqrt((moved.dot(self._spread).reshape(len(each), -1) ** 2).sum(axis=1))
        return np.asarray(np.repeat(1.5 * each + 4.0 * unsure, 3)[self.rows])


class _Point(NamedTuple):
    frame: str
    axes: str
    R: Array  # of the base in the sensor's axes
    b: Array


def _points(task: Task) -> list[_Point]:
    """Return the positions that a task is made of."""
    points: list[_Point] = []
    for each in task.tasks if isinstance(task, StackedTask) else [task]:
        if isinstance(each, TrackerTask):
            R = law.rotation_exp(each.rotation)
            points.append(_Point(each.frame, "xyz", R, each.offset))
        elif isinstance(each, PositionTask):
            d = len(each.axes)
            points.append(_Point(each.frame, each.axes, np.eye(d), np.zeros(d)))
        else:
            raise InvalidInputError(
                "task must be a PositionTask, a TrackerTask or a StackedTask of them, or a Robot, "
                f"got {task!r}",
                given=task,
            )
    first = points[0]
    if len(points) > 1 and isinstance(task, StackedTask):
        trackers = [each for each in task.tasks if isinstance(each, TrackerTask)]
        alike = all(
            np.array_equal(point.R, first.R) and np.array_equal(point.b, first.b)
            for point in points
        )
        if trackers and not (alike and len(trackers) == len(points)):
            raise InvalidInputError(
                f"task must be of one tracker, with one rotation and offset, got {task!r}",
                given=task,
            )
    return points


def _kinds(unknown: Any) -> tuple[str, ...]:
    wanted = f"unknown must be one or more of {', '.join(KINDS)}, got {unknown!r}"
    try:
        kinds = (unknown,) if isinstance(unknown, str) else tuple(unknown)
    except TypeError:
        kinds = ()
    if not kinds or any(kind not in KINDS for kind in kinds):
        raise InvalidInputError(wanted, given=unknown)
    return kinds


def _deviations(sd: Any) -> dict[str, float]:
    given = {} if sd is None else sd
    require("sd", given, Mapping, f"a mapping from some of {', '.join(USUAL_SD)} to numbers")
    for kind in given:
        if kind not in USUAL_SD:
            raise UnknownNameError("kind", kind, "sd", USUAL_SD)
    return {
        kind: as_number(f"sd of {kind}", given.get(kind, usual), above=0.0)
        for kind, usual in USUAL_SD.items()
    }
