"""What to simulate: the settings of one reach."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Settings:
    """What to simulate. Lengths in m, masses in kg, angles in rad, times in s.

    Attributes:
        tip: End-effector frame that holds the object; the robot's own by default.
        base: Link that the chain to the tip starts from.
        free: Joints that are not locked although the tip does not need them.
        object_length: True length of the object, m.
        object_mass: True mass of the object, kg.
        object_axis: Axis of the tip's frame that the object points along, such as z, or -x as
            --object-axis=-x; the one that leads on from the arm by default.
        believed_length: Length of the object that the controller believes, m.
        believed_mass: Mass of the object that the controller believes, kg.
        joint_shifts: Errors of the believed joint origins, m, such as panda_joint4 0 0.01 0.
        joint_rotations: Errors of the believed joint axes, as rotation vectors, rad.
        task: Bring the object's tip to a position, or to a pose.
        axes: World axes of a position; those that the arm commands best by default.
        start: Joint positions at the start, one a joint, rad or m, or "random" for a posture of the
            seed; by default one that is far from singular, the same for each seed
            (`Plant.ready_configuration`).
        target: Position (one number for each of axes, m) or pose (x y z qx qy qz qw); that of a
            posture of the seed by default.
        target_offset: Target of a position relative to where the tip starts, m.
        gravity: "learnt" (the law (28), (29)), "exact" (the parameters with which the believed
            robot's regressor fits the true gravity, which wrong joint axes keep it from doing
            exactly), "believed" (the believed robot's), or "none".
        settling_time: Wanted by the default gains, s.
        kp: K_p instead of the default gains' one; one number, or one a task coordinate.
        kv: K_v instead of the default gains' one; one number, or one a task coordinate.
        damping: Added joint damping instead of the default gains' one; one number, or one a joint.
        gamma: Saturation of the error by γ sin(e/γ), m; none by default.
        posture_stiffness: Draws the self-motion back to the start posture, N m/rad; 0 does not.
        duration: Of the run, s.
        rate: Of control, Hz.
        tolerance: Error below which the task counts as done, m (and rad of a pose).
        seed: Of target, noise and dropouts, and of a random start.
        friction: Viscous friction of every true joint, N m s/rad, unknown to the controller.
        coulomb: Coulomb friction of every true joint, N m, unknown to the controller.
        x_noise: Standard deviation of noise on x, m.
        x_quantum: Steps that x is rounded to, m.
        x_delay: Age of x when it arrives, s.
        x_dropout: Probability that a sample of x is lost, 0 to 1.
        q_noise: Standard deviation of noise on the encoders, rad or m.
        q_quantum: Steps of the encoders, rad or m.
        velocity_filter: Time constant of q̇ from differences of q, s; an exact tachometer by
            default.
        actuator_delay: From a torque to its effect, s.
        torque_limits: Lets the controller know limits and keep them: "urdf" those of the URDF, a
            number the effort limits times it, which are then the motors' too. Unknown by default.
        limiter: How: "qp" (with the position and velocity limits, and the proof kept where it can
            be; the default where there are limits), "clip" or "scale".
        torque_rate: Largest change of a torque that the limiter allows, N m/s; any by default.
        solver: Of the limiter qp, such as "daqp", "osqp" or another one of qpsolvers'.
        engine: What simulates the true robot.
        floor: Height of a floor, m, for the engine mujoco.
    """

    tip: str | None = None
    base: str | None = None
    free: tuple[str, ...] = ()
    object_length: float = 0.2
    object_mass: float = 0.5
    object_axis: str | None = None
    believed_length: float = 0.0
    believed_mass: float = 0.0
    joint_shifts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    joint_rotations: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    task: Literal["position", "pose"] = "position"
    axes: str | None = None
    start: tuple[float, ...] | Literal["random"] | None = None
    target: tuple[float, ...] | None = None
    target_offset: tuple[float, ...] | None = None
    gravity: Literal["learnt", "exact", "believed", "none"] = "learnt"
    settling_time: float = 1.0
    kp: tuple[float, ...] | None = None
    kv: tuple[float, ...] | None = None
    damping: tuple[float, ...] | None = None
    gamma: float | None = None
    posture_stiffness: float = 0.0
    duration: float = 20.0
    rate: float = 1000.0
    tolerance: float = 1e-3
    seed: int = 0
    friction: float = 0.0
    coulomb: float = 0.0
    x_noise: float = 0.0
    x_quantum: float = 0.0
    x_delay: float = 0.0
    x_dropout: float = 0.0
    q_noise: float = 0.0
    q_quantum: float = 0.0
    velocity_filter: float | None = None
    actuator_delay: float = 0.0
    torque_limits: str | None = None
    limiter: Literal["qp", "clip", "scale"] | None = None
    torque_rate: float | None = None
    solver: str | None = None
    engine: Literal["pinocchio", "mujoco"] = "pinocchio"
    floor: float | None = None
