"""`Posture` and `AwayFromStops`: torques in the null space of a redundant arm's task."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac.controllers.gains.gains import Diagonals
from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.robots.traced import motion_between, positions_at
from approxjac.tasks import Task
from approxjac.validation import Array, as_array, as_diagonal, as_number, is_scalar, shape_of

_WIDEST = 0.6  # zone at a stop at most [rad or m]
Torque = Callable[[Array], Array]


@dataclass(frozen=True, eq=False, repr=False)
class Posture:
    """The torque N τ₀ with τ₀ = −k (q ⊖ q_posture) and N = I − Ĵ⁺Ĵ.

    N keeps the part of τ₀ that Ĵᵀ cannot produce, faded out near a singular Ĵ. e = 0 remains the
    only equilibrium of the task for any Ĵ of full row rank. The proof is weaker:
    V̇ = −W + yᵀN τ₀, so V may rise while the arm moves towards the posture. The self-motion is
    damped by B_c only.

    Attributes:
        q: Posture, shape (nq,) [rad or m].
        stiffness: k > 0, a number or shape (n_v,) [N m/rad or N/m].

    Raises:
        InvalidInputError: Not finite, or a stiffness that is not positive.
    """

    q: Sequence[float] | Array
    stiffness: float | Sequence[float] | Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", as_array("q of the posture", self.q, shape_of(self.q), "rad"))
        diagonal = as_diagonal("stiffness", self.stiffness, unit="N m/rad")
        scalar = is_scalar(self.stiffness)
        object.__setattr__(self, "stiffness", float(diagonal[0]) if scalar else diagonal)

    __repr__ = short_fields

    def torque(self, task: Task, gains: Diagonals, rate: float) -> Torque:
        """Return the function τ₀ of q (nq,) for the robot of a task, independent of gains.

        Raises:
            InvalidInputError: A robot without self-motion, or wrong shapes.
        """
        robot = task.robot
        require_redundant(self, task)
        wanted = robot.configuration(self.q, "q of the posture")
        robot.require_radians("q of the posture", wanted)
        stiffness = as_diagonal("stiffness", self.stiffness, robot.nv, unit="N m/rad")
        return lambda q: stiffness * motion_between(robot, q, wanted)


@dataclass(frozen=True)
class AwayFromStops:
    """The torque N τ₀ that pushes joints away from position limits that are near.

    τ₀ = k (δ − d) for a joint at a distance d < δ from its stop, else zero; k is r B_c with r the
    rate of the task's slow pole: self-motion out of the zone is as fast as the task.

    In all else it is like `Posture`. It does not plan: an arm whose way is blocked by a stop stays
    there.

    Attributes:
        share: δ as a share of a joint's range, 0 to 0.5; δ is at most 0.6 rad or m.

    Raises:
        InvalidInputError: Another share.
    """

    share: float = 0.12

    def __post_init__(self) -> None:
        as_number("share", self.share, above=0.0, most=0.5)

    def torque(self, task: Task, gains: Diagonals, rate: float) -> Torque:
        """Return the function τ₀ of q (nq,) for the robot of a task.

        Raises:
            InvalidInputError: A robot without self-motion.
        """
        robot = task.robot
        require_redundant(self, task)
        lower, upper = robot.position_limits
        width = np.minimum(self.share * (upper - lower), _WIDEST)
        lower, upper, stiffness = lower + width, upper - width, rate * gains.damping

        def torque(q: Array) -> Array:
            motion = positions_at(robot, q)
            return stiffness * (np.minimum(np.maximum(motion, lower), upper) - motion)

        return torque


def require_redundant(posture: Any, task: Task) -> None:
    """Raise an InvalidInputError for a posture of an arm without self-motion."""
    robot = task.robot
    if robot.nv <= task.m:
        raise InvalidInputError(
            f"posture is for arms with more joints than task coordinates, got one for "
            f"{robot.name} with {robot.nv} joints and {task.m} coordinates",
            given=posture,
        )
