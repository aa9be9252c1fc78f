"""What to simulate: the settings of one visual servoing run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ServoSettings:
    """What to simulate. Lengths in m, masses in kg, angles in rad, times in s, images in px.

    Attributes:
        tip: End-effector frame that holds the object, or carries the camera; the robot's own by
            default.
        base: Link that the chain to the tip starts from.
        object_length: True length of the object, m.
        object_mass: True mass of the object, kg.
        object_axis: Axis of the tip's frame that the object points along; the one that leads on
            from the arm by default.
        believed_length: Length of the object that the controller believes, m.
        believed_mass: Mass of the object that the controller believes, kg.
        eye: "to-hand", a camera in the world that watches points of the object; or "in-hand", a
            camera on the arm that watches points of the world.
        camera_position: Where the true camera stands, m; in front of the arm, to its right, by
            default. In hand it is relative to the tip; there the camera looks along the axis that
            leads on from the arm.
        camera_target: What it looks at, m; the middle of where the arm reaches by default. For an
            eye to hand.
        focal_length: True focal length, px.
        image_size: Width and height, px.
        distortion: True radial distortion (k1 k2 k3), of which the controller knows nothing.
        roll: How far the believed camera is turned about its optical axis, rad.
        focal_factor: Believed focal length as a multiple of the true one.
        depth_factor: Believed depth of the scene as a multiple of the true one: the believed camera
            stands so much nearer or farther back, or constant depths are wrong by it.
        camera_shift: Further error of the believed camera's position, along its own axes (right,
            down, forward), m.
        camera_rotation: Further error of its orientation, a rotation vector in its own axes,
            rad.
        points: How many points are seen: m is twice as many.
        spread: How far the points are apart, m.
        depth: Where the controller takes a point's depth from: the believed camera and robot, a
            constant (that of the scene, times depth_factor), or a camera that measures it.
            "believed" for an eye to hand, "constant" for one in hand by default.
        start: Joint positions at the start, one a joint, rad; a posture of the seed by default.
        target: Image of each point (u v ...) at the target; that of a posture of the seed by
            default.
        law: "6", the paper's; "5", which differentiates the image; or "ibvs", the classical
            velocity-level control with an inner velocity loop.
        differentiator: Time constant of the differentiated image in law 5, s.
        gravity: "learnt", "exact", "believed" or "none"; see `approxjac simulate`. Not learnt by
            ibvs.
        settling_time: Wanted by the default gains, s.
        kp: K_p instead of the default gains' one; one number, or one an image coordinate.
        kv: K_v instead of the default gains' one; one number, or one an image coordinate.
        damping: Added joint damping instead of the default gains' one; one number, or one a joint.
        frame_rate: Images a second, Hz.
        latency: Age of an image when it arrives, s.
        noise: Standard deviation of noise on each image coordinate, px.
        quantum: Steps that image coordinates are rounded to, px.
        dropout: Probability that an image shows nothing.
        lost: Time from which and to which a point is occluded, such as 2 3, s.
        lost_point: Which one, 1 for the first; all by default.
        frozen: Time from which and to which the camera delivers the same image, s.
        unseen: Motion of the image that the controller believes to have made since the last new
            one, above which it only brakes, px.
        velocity_filter: Time constant of q̇ from differences of q, s; an exact tachometer by
            default.
        torque_limits: Lets the controller keep limits of torques, joint speeds and positions:
            "urdf" those of the URDF, a number with its effort limits times that, which are then
            the motors' too. Unknown by default.
        duration: Of the run, s.
        rate: Of control, Hz.
        tolerance: RMS of each image coordinate's true error over the last tenth of the run below
            which the task counts as done, px; that of the noise by default, or half a pixel.
        seed: Of start, target and noise.
    """

    tip: str | None = None
    base: str | None = None
    object_length: float = 0.15
    object_mass: float = 0.3
    object_axis: str | None = None
    believed_length: float = 0.0
    believed_mass: float = 0.0
    eye: Literal["to-hand", "in-hand"] = "to-hand"
    camera_position: tuple[float, float, float] | None = None
    camera_target: tuple[float, float, float] | None = None
    focal_length: float = 600.0
    image_size: tuple[int, int] = (640, 480)
    distortion: tuple[float, ...] = (-0.1, 0.02)
    roll: float = 0.0
    focal_factor: float = 1.0
    depth_factor: float = 1.0
    camera_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    points: int = 1
    spread: float = 0.2
    depth: Literal["believed", "constant", "measured"] | None = None
    start: tuple[float, ...] | None = None
    target: tuple[float, ...] | None = None
    law: Literal["6", "5", "ibvs"] = "6"
    differentiator: float = 0.1
    gravity: Literal["learnt", "exact", "believed", "none"] = "exact"
    settling_time: float = 1.5
    kp: tuple[float, ...] | None = None
    kv: tuple[float, ...] | None = None
    damping: tuple[float, ...] | None = None
    frame_rate: float = 30.0
    latency: float = 0.03
    noise: float = 0.5
    quantum: float = 0.0
    dropout: float = 0.0
    lost: tuple[float, float] | None = None
    lost_point: int | None = None
    frozen: tuple[float, float] | None = None
    unseen: float = 40.0
    velocity_filter: float | None = None
    torque_limits: str | None = None
    duration: float = 15.0
    rate: float = 1000.0
    tolerance: float | None = None
    seed: int = 0
