"""The interface of plant and controller: measurement, target, evaluation, status.

The plant owns the true robot, the controller the believed one. Only a `Measurement` goes
one way and a torque goes the other; neither side ever sees the other's model.
"""

from __future__ import annotations

import enum
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

from approxjac.formatting import listed
from approxjac.validation import Array


class _Outcome(enum.IntEnum):
    """An outcome with a name and a message; files of runs rely on the order, its number."""

    message: str

    def __new__(cls, message: Any) -> Self:  # a text; Outcome(number) works, too
        value = len(cls.__members__)
        outcome = int.__new__(cls, value)
        outcome._value_, outcome.message = value, message
        return outcome

    def __str__(self) -> str:
        return self.name

    @property
    def words(self) -> str:
        """Return the name as text: "near singular"."""
        return "ok" if self.name == "OK" else self.name.lower().replace("_", " ")


class Status(_Outcome):
    """Outcome of one step of a controller."""

    OK = "the law was evaluated as written"
    NEAR_SINGULAR = (
        "the estimated Jacobian is near a singular pose: in one direction hardly any force acts, "
        "and its pseudo-inverse is damped"
    )
    MEASUREMENT_LOST = (
        "the task measurement is not finite, or none was seen yet that can be learnt from: no "
        "position force, damping and gravity compensation only, adaptation frozen (the tracking "
        "law goes on learning what holds the arm)"
    )
    TORQUE_SATURATED = (
        "the law asks for more than the robot's effort limits: what it learns stands still"
    )
    MEASUREMENT_HELD = (
        "the task measurement is that of an earlier instant: the law was evaluated with it"
    )
    OUT_OF_REACH = (
        "the target is farther away than the believed arm reaches, with an unmodelled tool: "
        "adaptation paused"
    )
    PREDICTED = (
        "the task measurement is not finite, or too old to be learnt from: the law uses "
        "the predicted value, adaptation paused"
    )
    NOT_PREDICTED = (
        "there is no prediction to go by, such as of a point that the believed camera does not "
        "see: the joints are brought to rest, nothing is learnt of the dynamics"
    )


class LimitStatus(_Outcome):
    """Outcome of limits for the torque that a law asks for, in one step of a controller.

    The proof is that of Theorem 1, V̇ ≤ −W. Where what is learnt stands still, V̇ has
    −yᵀY(θ − θ̂) besides the slack.
    """

    UNLIMITED = "the controller knows no limits"
    FREE = "the torque of the law is within all limits"
    LIMITED = (
        "the torque was brought within the limits; nothing is said of the proof, which was not "
        "asked for, or x is lost, or the estimated Jacobian near a singular pose"
    )
    PROOF_KEPT = (
        "the torque was brought within the limits such that V falls no slower than with the law's "
        "own torque: V̇ ≤ −W still holds where it held"
    )
    PROOF_GIVEN_UP = (
        "the torque was brought within the limits, which adds the slack to V̇; learning goes on "
        "without the joints that are at a limit"
    )
    INFEASIBLE = (
        "no torque keeps all limits at once: joints are braked as hard as their motors can, within "
        "the limits of torques and their rates"
    )
    SOLVER_FAILED = (
        "the solver gave no usable torque in time: joints are braked, within the limits of torques "
        "and their rates"
    )
    EXCEEDED = (
        "a joint is faster or further than it may be; the torque of the law leads it back, within "
        "all limits"
    )


class Measurement(NamedTuple):
    """All that a controller may know about the true robot at one instant.

    Attributes:
        t: Time [s].
        q: Joint configuration, shape (nq,) [rad or m].
        v: Joint velocity q̇, shape (nv,) [rad/s or m/s].
        x: Task value measured by a sensor, shape (n_x,) [unit of the task]; NaN when lost.
        t_x: Time at which x was taken, by the clock of t [s]; None if it is not known.
    """

    t: float
    q: Array
    v: Array
    x: Array
    t_x: float | None = None

    def __repr__(self) -> str:
        q, v, x = listed(self.q), listed(self.v), listed(self.x)
        taken = "" if self.t_x is None else f", t_x={self.t_x:g} s"
        return f"Measurement(t={self.t:g} s, q={q}, v={v}, x={x}{taken})"


class Target(NamedTuple):
    """Wanted task value and its motion. Wherever a target is taken, an array is one at rest.

    Attributes:
        x: x_d, shape (n_x,) [unit of the task].
        v: ẋ_d in the sensor's error coordinates, shape (m,) [unit of the task/s]; None is at rest.
        a: ẍ_d in the same coordinates, shape (m,) [unit of the task/s²]; None is none.
    """

    x: Array
    v: Array | None = None
    a: Array | None = None


@runtime_checkable
class TargetPath(Protocol):
    """Any object that says where the target is at a time."""

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        ...


class Evaluation(NamedTuple):
    """Answer of a controller to one measurement; `answer._replace(torque=...)` is a changed copy.

    Attributes:
        torque: Joint torque τ, shape (nv,) [N m or N]; from a controller with command="velocity"
            the joint velocity that it commands, q̇_cmd [rad/s or m/s].
        state_rate: Time derivative of the state of the law, shape (n_state,). A controller that
            only steps has that of the law inside it, or None.
        status: What happened.
        e: Task error, shape (m,) [unit of the task].
        J_hat: Estimated Jacobian Ĵ, shape (m, n_v); None from controllers that have none.
        gravity: Gravity torque that the law compensates, part of its torque, shape (n_v,) [N m or
            N]; None from controllers that have none.
        limit_status: What limits did to the torque.
        slack: σ ≥ 0, what limits add to V̇ [W]; NaN where it is not known.
        reference: Joint velocity that the law leads the joints to, shape (n_v,) [rad/s or m/s]: q̇_r
            of the tracking law, Ĵ⁺ẋ_d of the set-point laws on a path; None is none.
    """

    torque: Array
    state_rate: Array | None
    status: Status
    e: Array
    J_hat: Array | None = None
    gravity: Array | None = None
    limit_status: LimitStatus = LimitStatus.UNLIMITED
    slack: float = 0.0
    reference: Array | None = None

    def __repr__(self) -> str:
        said = str(self.status)
        if self.limit_status is not LimitStatus.UNLIMITED:
            said += f", {self.limit_status}, slack={self.slack:.4g} W"
        return f"Evaluation({said}, torque={listed(self.torque)}, e={listed(self.e)})"
