"""Least squares over recordings: numbers of the arm, and places and trackers nobody measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.calibration.recording import Recording
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.validation import Array

TRACKER = "\0tracker"  # no socket has that name
_STEPS = 40  # of Gauss and Newton at most
_NEAR, _SETTLED = 0.3, 1e-3  # steps near the end, and the last, in standard deviations
_FARTHEST = 8.0  # standard deviations, from which on a sample has no part
_MEDIAN = 1.538  # of the length of three normal numbers
_FIRST = 0.01  # m and rad, of what is left at first
_APART = 1e-4  # sd of a distance that is known [m]
_LEAST = 1e-6  # noise [m or rad]
_FREE = 0.1  # share of what was measured that is not fitted, at least
_MAP = 1000  # configurations of the workspace
_WEAK = 1.0  # 1/m² or 1/rad², of what is known of places and trackers: as good as nothing


class Recorded(NamedTuple):
    """Rows of recordings, column by column; NaN where nothing was measured."""

    q: Array  # (N, nq)
    x: Array  # (N, 3), where a tracker saw the tip
    turn: Array  # (N, 3, 3), and how it was turned
    frame: Any  # names: of the tracker, or the name of the socket with that of its place
    place: Any
    row: Any  # what it is called

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> Recorded:
        """Return all rows; there is one tracker.

        Raises:
            InvalidInputError: Two recordings of one socket, by its name and that of its place.
        """
        rows, counts = list[tuple[Any, ...]](), Counter[str]()
        for each in recordings:
            seen, turns = {*counts} - {TRACKER}, np.full((len(each), 3, 3), np.nan)
            x = turns[:, 0] if each.x is None else each.x
            for i, quaternion in enumerate(() if each.quaternion is None else each.quaternion):
                turns[i] = pin.Quaternion(quaternion).normalized().matrix()
            measured = zip(each.q, x, turns, each.socket, each.place, strict=True)
            for q, x_i, turn, socket, place in measured:
                frame = f"{place} {socket}".strip() if each.x is None else TRACKER
                if frame in seen:
                    message = f"recordings must be of one socket each, got two of {frame!r}"
                    raise InvalidInputError(message, given=frame)
                counts[frame] += 1
                name = f"{frame.strip(TRACKER[0])} row {counts[frame]}"
                rows.append((q, x_i, turn, frame, place, name))
        return cls(*map(np.array, zip(*rows, strict=True) if rows else [()] * 6))

    @property
    def is_turned(self) -> bool:
        """True if a tracker saw how the tip was turned."""
        return bool(np.isfinite(self.turn).any())

    def chosen(self, which: Array) -> Recorded:
        """Return some of them."""
        return Recorded(*(column[which] for column in self))


class Fitted(NamedTuple):
    """The best fit to some samples.

    Attributes:
        u: Numbers of the arm, shape (n_u,).
        P: Their covariance, shape (n_u, n_u).
        noise: Robust standard deviations of the residuals of position [m] and rotation [rad].
        left: Residuals of each sample [m, rad], shape (N, 6), NaN where nothing was measured.
        evidence: Logarithm of the evidence.
        sensor: R and b of the tracker, and T, by which the tip is turned from the frame.
    """

    u: Array
    P: Array
    noise: Array
    left: Array
    evidence: float
    sensor: tuple[Array, Array, Array]


class Fit:
    """Gauss and Newton's method, with a prior, and weights by what is left.

    Of a socket r = p(q, u) − c; of a tracker r = R p(q, u) + b − x and, of an orientation,
    log(R R_f(q, u) T R_xᵀ). Unknown are u, each c, and R, b and T.

    Args:
        unknowns: The numbers of the arm, with their usual errors.
        samples: The recorded samples.
        apart: Distances between sockets that are known [m].
        scale: Size of the errors of the drawing, as a multiple of the usual ones.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        samples: Recorded,
        apart: Mapping[tuple[str, str], float],
        scale: float,
    ) -> None:
        self.unknowns, self.samples = unknowns, samples
        self.sd = unknowns.sd * np.where(unknowns.is_tool, 1.0, scale)
        n, frames = len(unknowns.u), list(dict.fromkeys(samples.frame))
        sockets = [name for name in frames if name != TRACKER]
        self._n, self._of_socket = n, {name: n + 3 * i for i, name in enumerate(sockets)}
        self._of_sensor = n + 3 * len(sockets)  # R, b and T
        self._size = self._of_sensor + 3 * (2 * (TRACKER in frames) + samples.is_turned)
        self.apart = {
            pair: distance for pair, distance in apart.items() if {*pair} <= {*self._of_socket}
        }
        self._u, self._c = unknowns.u.copy(), dict[str, Array]()
        self._R, self._b, self._T = np.eye(3), np.zeros(3), np.eye(3)

    def solved(self) -> Fitted:
        """Return the best fit."""
        noise, n = np.full(2, _FIRST), self._n
        self._place()
        is_near = False
        for _ in range(_STEPS):
            left, J = self._residuals()
            noise, weights = _weighed(left, noise, is_near)
            rows, w = np.isfinite(left), np.repeat(weights / noise**2, 3, axis=1)
            r, w, J = left[rows], w[rows], J[rows]
            A, g = J.T @ (w[:, np.newaxis] * J), J.T @ (w * r)
            for (one, other), distance in self.apart.items():
                self._hold(A, g, one, other, distance)
            known = np.append(self.sd**-2.0, np.full(self._size - n, _WEAK))
            np.einsum("ii->i", A)[:] += known
            g[:n] += known[:n] * (self._u - self.unknowns.u)
            P: Array = np.asarray(np.linalg.inv(A))
            step = -P.dot(g)
            self._move(step)
            size = float(np.abs(step / np.sqrt(P.diagonal())).max())
            if is_near and size < _SETTLED:
                break
            is_near |= size < _NEAR
        away = (self._u - self.unknowns.u) / self.sd
        cost = float(w @ r**2 + away @ away - np.log(np.maximum(w, _LEAST)).sum())
        spread = float(np.linalg.slogdet(A)[1] + 2.0 * np.log(self.sd).sum())
        fitted = self._size - float(P.diagonal() @ known)  # numbers that the samples determine
        free = max(1.0 - fitted / np.count_nonzero(w), _FREE)
        P, noise = P[:n, :n] / free, noise / np.sqrt(free)
        left, _ = self._residuals()
        sensor = self._R, self._b, self._T
        return Fitted(self._u, P, noise, left, -0.5 * (cost + spread), sensor)

    def _residuals(self) -> tuple[Array, Array]:
        """Return r (N, 6), NaN where nothing was measured, and its derivatives (N, 6, size)."""
        samples, n, u, R = self.samples, self._n, self._u, self._R
        left = np.full((len(samples.q), 6), np.nan)
        J, at = np.zeros((*left.shape, self._size)), self._of_sensor
        for i, (q, x, turn, frame, *_) in enumerate(zip(*samples, strict=True)):
            H, o = self.unknowns.at(q, u)
            p = o + H @ u
            if frame != TRACKER:
                where = self._of_socket[frame]
                left[i, :3], J[i, :3, :n] = p - self._c[frame], H
                J[i, :3, where : where + 3] = -np.eye(3)
                continue
            p = R @ p
            left[i, :3], J[i, :3, :n] = p + self._b - x, R @ H
            J[i, :3, at : at + 3], J[i, :3, at + 3 : at + 6] = -law.cross_matrix(p), np.eye(3)
            if np.isfinite(turn).all():
                R_f, _, _, of_u = self.unknowns.turn(q, u)
                seen = R @ R_f @ self._T
                left[i, 3:], J[i, 3:, :n] = law.rotation_log(seen @ turn.T), R @ of_u
                J[i, 3:, at : at + 3], J[i, 3:, at + 6 : at + 9] = np.eye(3), seen
        return left, J

    def _move(self, step: Array) -> None:
        self._u = self._u + step[: self._n]
        for name, i in self._of_socket.items():
            self._c[name] = self._c[name] + step[i : i + 3]
        given = step[self._of_sensor :].reshape(-1, 3)
        turn, shift, tool = (*given, *np.zeros((3 - len(given), 3)))
        self._R, self._b = law.rotation_exp(turn) @ self._R, self._b + shift
        self._T = self._T @ law.rotation_exp(tool)

    def _hold(self, A: Array, g: Array, one: str, other: str, distance: float) -> None:
        """Add a known distance between two sockets to the normal equations, in place."""
        way = self._c[one] - self._c[other]
        size = max(float(np.linalg.norm(way)), _LEAST)
        row = np.zeros(self._size)
        for name, sign in ((one, 1.0), (other, -1.0)):
            at = self._of_socket[name]
            row[at : at + 3] = sign * way / size
        A += np.outer(row, row) / _APART**2
        g += row * ((size - distance) / _APART**2)

    def _place(self) -> None:
        """Set places and the tracker as the believed arm has them."""
        samples, u = self.samples, self._u
        points = np.array([o + H @ u for H, o in (self.unknowns.at(q, u) for q in samples.q)])
        for name in self._of_socket:
            self._c[name] = np.median(points[samples.frame == name], axis=0)
        seen = samples.frame == TRACKER
        if not seen.any():
            return
        x, points = samples.x[seen], points[seen]
        turned = [
            (self.unknowns.turn(q, u).R, turn)
            for q, turn in zip(samples.q, samples.turn, strict=True)
            if np.isfinite(turn).all()
        ]
        if turned:  # R_i R_jᵀ of the tracker is R (R_i R_jᵀ) Rᵀ of the arm, whatever the tool's T
            (first, shown), *others = turned
            ways = [
                (law.rotation_log(each @ first.T), law.rotation_log(turn @ shown.T))
                for each, turn in others
            ]
            self._R = law.nearest_rotation(np.sum([np.outer(b, a) for a, b in ways], axis=0))
            tools = [(self._R @ each).T @ turn for each, turn in turned]
            self._T = law.nearest_rotation(np.sum(tools, axis=0))
        else:  # Kabsch
            away = points - points.mean(axis=0)
            self._R = law.nearest_rotation((x - x.mean(axis=0)).T @ away)
        self._b = x.mean(axis=0) - self._R @ points.mean(axis=0)


class TipAccuracy:
    """Standard deviation of the tip at configurations, by the covariance of what was learnt.

    The base is aligned with the recordings: with the tracker's axes or, as sockets do not show
    where it is, as fits the workspace best.

    Attributes:
        recorded, workspace: Configurations of the recordings, and random ones within the joints'
            ranges, shapes (N, nq) and (M, nq).
        widening: Factor on all standard deviations, √χ² of the places that were left out or, of
            one place, of the two halves of its postures that differ most; at least 1.
    """

    def __init__(self, arm: Robot, unknowns: Unknowns, fitted: Fitted, samples: Recorded) -> None:
        self._unknowns, self._u, self._P, self.widening = unknowns, fitted.u, fitted.P, 1.0
        self.recorded, self.workspace = samples.q, np.array([*arm.configurations(_MAP)])
        tracked = samples.q[samples.frame == TRACKER]
        self._base = np.zeros((6, len(fitted.u)))  # its motion with the numbers
        p, H = self.linear(tracked if len(tracked) else self.workspace)
        self._base = np.linalg.lstsq(np.concatenate(_motions(p)), np.concatenate(H), rcond=None)[0]

    def __call__(self, q: Sequence[Any] | Array) -> Array:
        """Return the root of the tip's summed variances at configurations (N, nq), (N,) [m]."""
        H = self.linear(q)[1]
        return np.asarray(self.widening * np.sqrt(np.einsum("nij,jk,nik->n", H, self._P, H)))

    def linear(self, q: Sequence[Any] | Array) -> tuple[Array, Array]:
        """Return the tip at q, (N, 3) [m], and its derivatives by the numbers, (N, 3, n_u)."""
        H, o = map(np.array, zip(*(self._unknowns.at(each, self._u) for each in q), strict=True))
        p = H @ self._u + o
        return p, H - _motions(p) @ self._base


def _motions(p: Array) -> Array:
    """Return the motion of points (N, 3) by the base's translation and rotation, (N, 3, 6)."""
    return np.array([np.hstack([np.eye(3), -law.cross_matrix(each)]) for each in p])


def _weighed(left: Array, before: Array, is_near: bool) -> tuple[Array, Array]:
    """Return robust standard deviations of positions and turns, and weights of samples, (N, 2).

    Those of Huber, and near the end those of Tukey, by which what is far has no part at all.
    """
    sizes = np.linalg.norm(left.reshape(-1, 2, 3), axis=2)
    noise = before.copy()
    for i, size in enumerate(sizes.T):
        if (seen := np.isfinite(size)).any():
            noise[i] = max(float(np.median(size[seen])) / _MEDIAN, _LEAST)
    share = np.nan_to_num(sizes) / (_FARTHEST * noise)
    if is_near:
        return noise, np.maximum(1.0 - share**2, 0.0) ** 2
    return noise, np.minimum(1.0, 0.5 / np.maximum(share, _LEAST))
