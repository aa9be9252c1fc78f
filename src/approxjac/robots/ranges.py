"""Guaranteed bounds of gravity torques and Jacobian columns over a range of the joints.

Both are moments about the joints' axes: the gravity torque of joint i is aᵢ·(μᵢ × g), with aᵢ its
axis and μᵢ the first mass moment about it of all that it carries; and the column of a point's
velocity along a direction d is aᵢ·(μᵢ × d), with μᵢ that of a unit mass in the point. A prismatic
joint has aᵢ·d times the mass that it carries, an angular velocity has aᵢ·d.

Over a box of joint positions, μᵢ and d in the frame of link i are enclosed in balls: a joint turns
a ball's centre along an arc, and the arc and what was the ball lie in a new one. What two balls
leave of a product is a bound that no posture of the box exceeds. Boxes with large bounds are halved
until the largest bound is near the largest value found (branch and bound).

Source: R. E. Moore et al., "Introduction to Interval Analysis", SIAM 2009, for the principle.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.checks import Array
from approxjac.robots.robot import Robot

_TIGHT = 0.03  # a bound this share above the largest value found is near enough
_MOST_BOXES = 3000  # looked at for one joint; after them the bound is as guaranteed, but looser
_AT_ONCE = 500
_LATER = 0.1
_ROUNDING = 1e-9  # share that covers floating point, which the balls do not enclose


@dataclass(frozen=True, eq=False)
class Load:
    """Point masses on the links, and the world's directions along which they are pulled.

    Attributes:
        masses: On each link, shape (n_all,).
        moments: Their first moments about the link's joint, in the link's frame, (n_all, 3).
        pulls: Directions with their weights, shape (k, 3): torques aᵢ·(μᵢ × d).
        turns: Directions with their weights, shape (l, 3): aᵢ·d of joints that carry a mass.
    """

    masses: Array
    moments: Array
    pulls: Array
    turns: Array


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of joint positions by their middle and half width, each of shape (N, n_all)."""

    middle: Array
    half: Array

    def take(self, which: NDArray[np.intp]) -> _Boxes:
        return _Boxes(self.middle[which], self.half[which])

    def joined(self, others: _Boxes) -> _Boxes:
        return _Boxes(
            np.concatenate([self.middle, others.middle]), np.concatenate([self.half, others.half])
        )

    def halved(self, joint: NDArray[np.intp]) -> _Boxes:
        """Twice as many boxes, each halved along the joint (N,) that is named for it."""
        rows = np.arange(len(joint))
        half = self.half.copy()
        half[rows, joint] *= 0.5
        low, high = self.middle.copy(), self.middle.copy()
        low[rows, joint] -= half[rows, joint]
        high[rows, joint] += half[rows, joint]
        return _Boxes(np.concatenate([low, high]), np.concatenate([half, half]))


@dataclass(frozen=True, eq=False)
class _Ball:
    """For each box a ball that holds a vector: centre (N, 3), and each joint's share of the radius.

    For a moment also a bound of its length (N,), which is a sum of link lengths where the ball is
    wide, the mass that it is of, and whether there is anything.
    """

    centre: Array
    shares: Array
    reach: Array
    mass: float = 0.0
    loaded: bool = True

    @property
    def length(self) -> Array:
        """The smaller bound of the vector's length, shape (N,)."""
        outermost = np.linalg.norm(self.centre, axis=1) + self.shares.sum(axis=1)
        return np.asarray(np.minimum(self.reach, outermost))


class JointRange:
    """A robot with its joints anywhere within a range.

    Args:
        robot: The robot.
        lower: Motions from zero, shape (n_v,) [rad or m].
        upper: Motions from zero, not below `lower`.
    """

    def __init__(self, robot: Robot, lower: Array, upper: Array) -> None:
        self.robot = robot
        model = robot.coupling.model  # mimic joints count as joints of their own
        self.n = model.njoints - 1
        self.parents = [int(parent) - 1 for parent in list(model.parents)[1:]]
        placements = list(model.jointPlacements)[1:]
        self._rotations = [np.array(placement.rotation) for placement in placements]
        self._shifts = [np.array(placement.translation) for placement in placements]
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        self.slides, self._axes = [], []
        for i, joint in enumerate(list(model.joints)[1:], start=1):
            J = pin.getJointJacobian(model, data, i, pin.ReferenceFrame.LOCAL).reshape(6, -1)
            motion = J[:, joint.idx_v]
            self.slides.append(bool(motion[:3].any()))
            self._axes.append(motion[:3] if self.slides[-1] else motion[3:])
        at_zero = robot.coupling.q(robot.neutral())
        zero = np.array([at_zero[j.idx_q] if j.nq == 1 else 0.0 for j in list(model.joints)[1:]])
        self._box = _Boxes(
            (zero + robot.coupling.v(0.5 * (lower + upper)))[np.newaxis],
            (np.abs(np.eye(self.n) if robot.coupling.G is None else robot.coupling.G)).dot(
                0.5 * (upper - lower)
            )[np.newaxis],
        )

    def point_load(self, frame: str, pulls: Array, turns: Array) -> Load:
        """A unit mass in the origin of a frame: rows of its Jacobian, weighted."""
        model = self.robot.coupling.model
        own = self.robot.model.frames[self.robot.frame_id(frame)]
        there = model.frames[model.getFrameId(frame, own.type)]
        masses, moments = np.zeros(self.n), np.zeros((self.n, 3))
        if there.parentJoint > 0:
            masses[there.parentJoint - 1] = 1.0
            moments[there.parentJoint - 1] = there.placement.translation
        return Load(masses, moments, pulls, turns)

    def weight(self, masses: Array, moments: Array) -> Load:
        """Masses of the links and their first moments under the robot's gravity."""
        return Load(masses, moments, self.robot.gravity[np.newaxis], np.zeros((0, 3)))

    def own_weight(self) -> Load:
        """The robot's own links."""
        inertias = list(self.robot.coupling.model.inertias)[1:]
        masses = np.array([inertia.mass for inertia in inertias])
        return self.weight(masses, np.array([i.mass * i.lever for i in inertias]))

    def largest(self, loads: Sequence[Load]) -> Array:
        """Bound of Σ |τᵢ| over all directions of all loads, for each joint; shape (n_v,).

        No posture within the range exceeds it. Often some posture comes within 3 %; it is less near
        where there would be very many boxes to look at, and where parts of coupled joints cancel.
        """
        every = np.array([self._largest_of(i, loads) for i in range(self.n)])
        G = self.robot.coupling.G
        bounds: Array = every if G is None else np.abs(G).T.dot(every)
        rounded: Array = bounds + _ROUNDING * (bounds + bounds.max())
        return rounded

    def _largest_of(self, joint: int, loads: Sequence[Load]) -> float:
        boxes = self._box
        bounds, widest = self._bounds(joint, loads, boxes)
        found, looked_at = 0.0, 0
        newest = boxes
        while True:
            points = _Boxes(newest.middle, np.zeros_like(newest.half))
            found = max(found, float(self._bounds(joint, loads, points)[0].max()))
            worst = np.argsort(bounds)[::-1][:_AT_ONCE]
            worst = worst[bounds[worst] > found * (1.0 + _TIGHT) + 1e-12]
            looked_at += len(worst)
            if not len(worst) or looked_at > _MOST_BOXES:
                return float(bounds.max())
            newest = boxes.take(worst).halved(widest[worst])
            more, wide = self._bounds(joint, loads, newest)
            kept = np.ones(len(bounds), dtype=bool)
            kept[worst] = False
            boxes = boxes.take(kept).joined(newest)
            bounds = np.concatenate([bounds[kept], more])
            widest = np.concatenate([widest[kept], wide])

    def _bounds(
        self, joint: int, loads: Sequence[Load], boxes: _Boxes
    ) -> tuple[Array, NDArray[np.intp]]:
        """Bound of each box, shape (N,), and the joint that blows it up most."""
        total = np.zeros(len(boxes.middle))
        blame = np.zeros(boxes.middle.shape)
        for load in loads:
            carried = self._carried(joint, load, boxes)
            if carried is None:
                continue
            if self.slides[joint]:
                self._add_pushes(joint, carried.mass * load.pulls, boxes, total, blame)
            else:
                self._add_moments(joint, load.pulls, carried, boxes, total, blame)
                self._add_pushes(joint, load.turns, boxes, total, blame)
        return total, blame.argmax(axis=1)

    def _add_moments(
        self, joint: int, pulls: Array, ball: _Ball, boxes: _Boxes, total: Array, blame: Array
    ) -> None:
        """Add Σ |a·(μ × d)| over the pulls d, by the smaller of two bounds.

        One multiplies the balls of μ and d. The other is the longest lever times the largest part
        of a pull across the axis, whatever their angle: it needs no look at the joint itself.
        """
        axis = self._axes[joint]
        radius = ball.shares.sum(axis=1)
        lever = np.linalg.norm(np.cross(axis, ball.centre), axis=1)
        product, guilt = np.zeros_like(total), np.zeros_like(blame)
        for pull in pulls:
            d = self._in_link(joint, pull, boxes)
            spread, across = d.shares.sum(axis=1), np.linalg.norm(np.cross(axis, d.centre), axis=1)
            product += np.abs(np.cross(ball.centre, d.centre).dot(axis))
            product += lever * spread + across * radius + radius * spread
            guilt += (lever + radius)[:, np.newaxis] * d.shares
            guilt += across[:, np.newaxis] * ball.shares
        across, turns = np.zeros_like(total), np.zeros_like(blame)
        for corner in _corners(pulls):
            d = self._in_link(joint, corner, boxes, turned=False)
            length = np.linalg.norm(np.cross(axis, d.centre), axis=1) + d.shares.sum(axis=1)
            across = np.maximum(across, np.minimum(length, np.linalg.norm(corner)))
            turns = np.maximum(turns, d.shares)
        separate = np.minimum(lever + radius, ball.length) * across
        total += np.minimum(product, separate)
        # a turn of the pulls matters to the second bound only once it is small
        other = across[:, np.newaxis] * ball.shares + _LATER * (lever + radius)[:, np.newaxis] * (
            turns + _LATER * self._own(joint, boxes)
        )
        blame += np.where((product < separate)[:, np.newaxis], guilt, other)

    def _add_pushes(
        self, joint: int, pushes: Array, boxes: _Boxes, total: Array, blame: Array
    ) -> None:
        """Add Σ |a·d| over the directions d."""
        axis = self._axes[joint]
        largest = np.zeros_like(total)
        for corner in _corners(pushes):
            d = self._in_link(joint, corner, boxes, turned=False)
            length = np.abs(d.centre.dot(axis)) + d.shares.sum(axis=1)
            largest = np.maximum(largest, np.minimum(length, np.linalg.norm(corner)))
            blame += d.shares
        total += largest

    def _own(self, joint: int, boxes: _Boxes) -> Array:
        """Half widths of one joint only, shape (N, n_all)."""
        own = np.zeros_like(boxes.half)
        own[:, joint] = boxes.half[:, joint]
        return own

    def _carried(self, joint: int, load: Load, boxes: _Boxes) -> _Ball | None:
        """What a joint carries of a load: its moment in the link's frame; None if nothing."""
        balls = {
            i: _Ball(
                np.tile(load.moments[i], (len(boxes.middle), 1)),
                np.zeros_like(boxes.half),
                np.full(len(boxes.middle), np.linalg.norm(load.moments[i])),
                float(load.masses[i]),
                bool(load.masses[i] or load.moments[i].any()),
            )
            for i in range(joint, self.n)
        }
        for i in range(self.n - 1, joint, -1):
            ball, parent = balls[i], balls.get(self.parents[i])
            if parent is None or not ball.loaded:
                continue
            reach = ball.length + abs(ball.mass) * float(np.linalg.norm(self._shifts[i]))
            if self.slides[i]:
                reach += abs(ball.mass) * (np.abs(boxes.middle[:, i]) + boxes.half[:, i])
                centre = ball.centre + ball.mass * boxes.middle[:, [i]] * self._axes[i]
                ball.shares[:, i] += abs(ball.mass) * boxes.half[:, i]
            else:
                centre, ball.shares[:, i] = _turned(ball.centre, self._axes[i], boxes, i, 1.0)
            centre = centre @ self._rotations[i].T + ball.mass * self._shifts[i]
            balls[self.parents[i]] = _Ball(
                parent.centre + centre,
                parent.shares + ball.shares,
                parent.length + reach,
                parent.mass + ball.mass,
            )
        return balls[joint] if balls[joint].loaded else None

    def _in_link(
        self, joint: int, direction: Array, boxes: _Boxes, *, turned: bool = True
    ) -> _Ball:
        """A direction of the world in the frame of a link, before the link's own turn if wanted."""
        path = [joint]
        while self.parents[path[-1]] >= 0:
            path.append(self.parents[path[-1]])
        centre = np.tile(direction, (len(boxes.middle), 1))
        shares = np.zeros_like(boxes.half)
        for i in reversed(path):
            centre = centre @ self._rotations[i]
            if not self.slides[i] and (turned or i != joint):
                centre, shares[:, i] = _turned(centre, self._axes[i], boxes, i, -1.0)
        return _Ball(centre, shares, np.full(len(centre), np.linalg.norm(direction)))


def _corners(directions: Array) -> Array:
    """Sums of directions (k, 3) with all signs, of which one of each opposite pair is enough."""
    if not len(directions):
        return np.zeros((0, 3))
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=len(directions) - 1)))
    corners: Array = directions[0] + signs @ directions[1:]
    return corners


def _turned(
    centre: Array, axis: Array, boxes: _Boxes, joint: int, sign: float
) -> tuple[Array, Array]:
    """Centre (N, 3) of the smallest ball around an arc, and its radius (N,)."""
    angle, half = sign * boxes.middle[:, joint], boxes.half[:, joint]
    along = centre.dot(axis)[:, np.newaxis] * axis
    across = centre - along
    quarter = half < 0.5 * np.pi
    shrink = np.where(quarter, np.cos(half), 0.0)[:, np.newaxis]
    spread = np.where(quarter, np.sin(half), 1.0)
    c, s = np.cos(angle)[:, np.newaxis], np.sin(angle)[:, np.newaxis]
    turned = along + shrink * (c * across + s * np.cross(axis, across))
    return turned, spread * np.linalg.norm(across, axis=1)
