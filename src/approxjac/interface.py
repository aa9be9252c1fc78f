"""The interface of plant and controller: measurement, target, evaluation, status.

The plant owns the true robot, the controller the believed one. Only a `Measurement` passes
one way and a torque the other; neither side ever sees the other's model.
"""

import enum
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

from approxjac.formatting import listed, shown
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
    def label(self) -> str:
        """The name as text, such as "near singular"."""
        return self.name.lower().replace("_", " ")


class Status(_Outcome):
    """Outcome of one step of a controller."""

    OK = "the law was evaluated as written"
    NEAR_SINGULAR = (
        "the estimated Jacobian is nearly singular: in one task direction hardly any force acts, "
        "and its pseudo-inverse is damped"
    )
    MEASUREMENT_LOST = (
        "the task measurement is not finite, or none that can be learnt from has arrived yet: "
        "damping and gravity compensation only, no position force, adaptation paused (the "
        "tracking law still learns the torque that holds the arm)"
    )
    TORQUE_SATURATED = "the law asks for more than the robot's effort limits: adaptation paused"
    MEASUREMENT_HELD = "the law was evaluated with a task measurement of an earlier instant"
    OUT_OF_REACH = (
        "the target is farther away than the believed arm reaches, with an unmodelled tool: "
        "adaptation paused"
    )
    PREDICTED = (
        "the task measurement is not finite, or too old to be learnt from: the law uses "
        "the predicted value, adaptation paused"
    )
    NOT_PREDICTED = (
        "no prediction exists, such as for a point that the believed camera does not see: the "
        "joints are brought to rest, adaptation of the dynamics paused"
    )
    # a bad sample, with the last command in place of the law's, and nothing learnt
    JOINTS_UNKNOWN = "q, q̇ or t is not finite: the last command once more"
    POSITION_JUMPED = "q jumped farther than a joint can move: the last command once more"
    VELOCITY_JUMPED = (
        "q̇ jumped farther than motors and loads can change it: the last command once more"
    )
    VELOCITY_DISAGREES = "q̇ is not the rate of q: the last command once more"
    STATE_REPEATED = "q and q̇ of a moving arm are the same again: the last command once more"
    CLOCK_JUMPED = "the clock stands, or jumped: the last command once more"
    SENSOR_JUMPED = "x jumped farther than the arm moved, or is from the future: it counts as lost"
    STOPPED = (
        "too many bad samples in a row: the arm is held where it stops, until the controller "
        "begins anew"
    )
    HOLDING = "the joints stand within the fine error of the target: adaptation paused"


class LimitStatus(_Outcome):
    """Effect of limits on the torque of a law, in one step of a controller.

    The proof is that of Theorem 1: V̇ ≤ −W, with the Lyapunov function V and W ≥ 0. While
    adaptation is paused, V̇ has −yᵀY(θ − θ̂) besides the slack (docs/theory.md).
    """

    UNLIMITED = "the controller knows no limits"
    FREE = "the torque of the law is within all limits"
    LIMITED = (
        "the torque was brought within the limits without a statement on the proof: none was "
        "requested, x is lost, or the estimated Jacobian is nearly singular"
    )
    PROOF_KEPT = (
        "the torque was brought within the limits and V falls no slower than with the law's own "
        "torque: V̇ ≤ −W still holds where it held"
    )
    PROOF_GIVEN_UP = (
        "the torque was brought within the limits, which adds the slack to V̇; adaptation continues "
        "without the joints that are at a limit"
    )
    INFEASIBLE = (
        "no torque keeps all limits at once: the joints are braked as hard as the limits of "
        "torque and torque rate allow"
    )
    SOLVER_FAILED = (
        "the solver gave no usable torque in time: the joints are braked within the limits of "
        "torque and torque rate"
    )
    EXCEEDED = (
        "a joint is beyond its speed or position limit; the law's torque, within all limits, "
        "brings it back"
    )


class Condition(_Outcome):
    """An event of an arm under control; the text says what to do."""

    OSCILLATES = (
        "a joint swings with little or no damping, because of a payload, elastic joints, friction, "
        "a delay or a wrong Jacobian; lower kp, or give the controller its latency and payload"
    )
    PUSHED = "a force that the believed robot does not explain moves the tip"
    PRESSES = "the tip met something and presses against it"
    TOOL_CHANGED = "the weight at the tip changed: something was grasped, or dropped"
    NOT_EXPLAINED = "x differs from what was learnt by more than noise"
    MOTOR_WEAK = "a motor does not give the torque that it is asked for"
    TOOL_SLIPPED = (
        "the tool moved on its flange, or x sees another point of it: fasten it, and wait until it "
        "is learnt again, or call relearn"
    )
    SENSOR_MOVED = (
        "the camera or tracker that gives x was moved, or the base: targets in its axes moved "
        "along; put it back, or wait until it is learnt again, or call relearn"
    )
    TOOL_OR_SENSOR_MOVED = (
        "the tool slipped or the sensor of x was moved, which this motion does not tell apart: "
        "look at both; then wait until it is learnt again, or call relearn"
    )


class Measurement(NamedTuple):
    """All that a controller may know about the true robot at one instant.

    Attributes:
        t: Time [s].
        q: Joint configuration, shape (nq,) [rad or m].
        v: Joint velocity q̇, shape (nv,) [rad/s or m/s].
        x: Task value measured by a sensor, shape (n_x,) [unit of the task]; NaN when lost.
        t_x: Time at which x was taken, on the clock of t [s]; None if unknown.
    """

    t: float
    q: Array
    v: Array
    x: Array
    t_x: float | None = None

    def __repr__(self) -> str:
        q, v, x = listed(self.q), listed(self.v), listed(self.x)
        try:
            taken = "" if self.t_x is None else f", t_x={self.t_x:g} s"
            return f"Measurement(t={self.t:g} s, q={q}, v={v}, x={x}{taken})"
        except (TypeError, ValueError, OverflowError):
            t, t_x = shown(self.t), shown(self.t_x)
            return f"Measurement(t={t}, q={q}, v={v}, x={x}, t_x={t_x})"


class Target(NamedTuple):
    """Desired task value and its motion. An array in its place is a target at rest.

    Attributes:
        x: x_d, shape (n_x,) [unit of the task].
        v: ẋ_d in the sensor's error coordinates, shape (m,) [unit of the task/s]; None is zero.
        a: ẍ_d in the same coordinates, shape (m,) [unit of the task/s²]; None is zero.
    """

    x: Array
    v: Array | None = None
    a: Array | None = None


@runtime_checkable
class TargetPath(Protocol):
    """Any object that gives the target at a time."""

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""


class Evaluation(NamedTuple):
    """Output of a controller for one measurement; `answer._replace(torque=...)` is a changed copy.

    Attributes:
        torque: Joint torque τ, shape (nv,) [N m or N]; the joint velocity q̇_cmd [rad/s or m/s]
            from a controller with command="velocity".
        state_rate: Time derivative of the law's state, shape (n_state,). A discrete controller
            gives that of the law inside it, or None.
        status: Outcome of this step.
        e: Task error, shape (m,) [unit of the task].
        J_hat: Estimated Jacobian Ĵ, shape (m, n_v); None from controllers without one.
        gravity: Gravity torque that the law compensates, part of its torque, shape (n_v,) [N m or
            N]; None from controllers without one.
        limit_status: Effect of the limits on the torque.
        slack: σ ≥ 0, the power that limits add to V̇ [W]; NaN where it is not known.
        reference: Desired joint velocity, shape (n_v,) [rad/s or m/s]: q̇_r of the tracking law,
            Ĵ⁺ẋ_d of the set-point laws on a path; None if there is none.
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
