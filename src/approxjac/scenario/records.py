"""The parts of a scenario: keys, types, ranges, and their help texts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from approxjac.simulation import VelocityServo

Numbers = tuple[float, ...]
Vector = tuple[float, float, float]
Interval = tuple[float, float]
Vectors = dict[str, Vector]  # joint name → vector


def positive(default: Any) -> Any:
    """Return a field whose numbers are above 0."""
    return field(default=default, metadata={"above": 0.0})


def at_least(default: Any, bound: float = 0.0) -> Any:
    """Return a field whose numbers are at least a bound."""
    return field(default=default, metadata={"minimum": bound})


@dataclass(frozen=True)
class Object:
    """An object that the arm holds.

    Attributes:
        length: Length of the object, from the arm's tip to its own, m.
        mass: Mass of the object, kg.
        axis: Direction in the tip's axes, such as z, -x or 0,1,1; outward by default.
        radius: Radius of the cylinder, m; 0.01 by default, or that of the true object.
    """

    length: float = at_least(0.0)
    mass: float = at_least(0.0)
    axis: Vector | str | None = None
    radius: float | None = at_least(None)

    def like(self, true: Object) -> Object:
        """Return a believed object; numbers that are not given are the true ones."""
        said = {name: value for name, value in vars(self).items() if value is not None}
        return replace(true, **said)


@dataclass(frozen=True)
class CameraRecord:
    """The true camera of an image task.

    Attributes:
        kind: "pinhole", in px; or "planar", the paper's, parallel to a plane, in m on its sensor.
        mount: Frame of the arm that carries it, "tip" for the arm's own; the world by default.
        position: Position of the camera in the world, or relative to its mount, m.
        looking_at: Point that a camera in the world looks at, m.
        focal_length: Focal length, px, 600 by default; of a planar camera m, 0.05 by default.
        size: Width and height of the image, px.
        distortion: Radial distortion (k1 k2 k3), unknown to the controller.
        distance: Distance of a planar camera from the plane, m.
        roll: Rotation of a planar camera about its optical axis, rad.
    """

    kind: Literal["pinhole", "planar"] = "pinhole"
    mount: str | None = None
    position: Vector | None = None
    looking_at: Vector | None = None
    focal_length: float | None = positive(None)
    size: tuple[int, int] = (640, 480)
    distortion: Numbers = (-0.1, 0.02)
    distance: float = positive(3.0)
    roll: float = 0.0


@dataclass(frozen=True)
class CameraError:
    """Errors of the believed camera, which is otherwise the true one without distortion.

    Attributes:
        roll: Error of the rotation about the optical axis, rad.
        focal_factor: Focal length as a multiple of the true one.
        depth_factor: Depth of the scene as a multiple of the true one.
        shift: Further error of its position, along its own axes (right, down, forward), m.
        rotation: Further error of its orientation, a rotation vector in its own axes, rad.
    """

    roll: float = 0.0
    focal_factor: float = positive(1.0)
    depth_factor: float = positive(1.0)
    shift: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Tracker:
    """The tracker that measures positions, or poses: x = R p + b of a p in the world.

    Attributes:
        rotation: R as a rotation vector, from the axes of the world to its own, rad.
        offset: b, the origin of the world in its axes, m.
    """

    rotation: Vector = (0.0, 0.0, 0.0)
    offset: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Truth:
    """The truth, which only the plant gets to see.

    Attributes:
        object: Object that the arm holds.
        shifts: Errors of the URDF's joint origins, m, such as panda_joint4 0 0.01 0.
        rotations: Errors of the URDF's joint axes, as rotation vectors, rad.
        calibration: File of the arm's calibration, beside this one: errors are by its covariance.
        friction: Viscous friction of every joint, N m s/rad.
        coulomb: Coulomb friction of every joint, N m.
        drives: Joints: "ideal", or the "usual" rotors, elastic gears and friction of geared arms
            (friction as given, if it is). By default usual in a simulation that names no law and
            no gains, else ideal.
        camera: Camera of an image task.
        tracker: Tracker with axes of its own, for x and targets; the world's by default.
        servo: Velocity servo of a robot that takes joint velocities.
        engine: Simulator of the robot.
        floor: Height of a floor, m, for the engine mujoco.
    """

    object: Object = Object(length=0.2, mass=0.5)
    shifts: Vectors = field(default_factory=dict)
    rotations: Vectors = field(default_factory=dict)
    calibration: str | None = None
    friction: float = at_least(0.0)
    coulomb: float = at_least(0.0)
    drives: Literal["ideal", "usual"] | None = None
    camera: CameraRecord = CameraRecord()
    tracker: Tracker = Tracker()
    servo: VelocityServo = VelocityServo()
    engine: Literal["pinocchio", "mujoco"] = "pinocchio"
    floor: float | None = None


@dataclass(frozen=True)
class Belief:
    """The belief of the controller.

    Attributes:
        object: Object that the arm holds.
        shifts: Errors of the believed joint origins, m, such as panda_joint4 0 0.01 0.
        rotations: Errors of the believed joint axes, as rotation vectors, rad.
        camera: Errors of the believed camera of an image task.
    """

    object: Object = Object()
    shifts: Vectors = field(default_factory=dict)
    rotations: Vectors = field(default_factory=dict)
    camera: CameraError = CameraError()


@dataclass(frozen=True)
class TaskChoice:
    """The task, measured and controlled.

    Attributes:
        kind: Task: position or pose of the object's tip, image of points, positions of frames.
        axes: World axes of a position; those that the arm commands best by default.
        frames: Frames of a stacked task, such as object_tip panda_link4.
        points: Count of the points that a pinhole camera sees: m is twice as many.
        spread: Distance between the points, m.
        depth: Source of depths; "believed" of a camera in the world, "constant" in hand by default.
    """

    kind: Literal["position", "pose", "image", "stacked"] = "position"
    axes: str | None = None
    frames: tuple[str, ...] = ()
    points: int = 1
    spread: float = positive(0.2)
    depth: Literal["believed", "constant", "measured"] | None = None


@dataclass(frozen=True)
class Sensor:
    """Errors of measurements; none by default.

    Attributes:
        noise: Standard deviation of noise on x, m, rad or px.
        quantum: Steps that x is rounded to, m, rad or px.
        rate: Frames of x a second, Hz; one a step by default.
        delay: Age of x when it arrives, s.
        dropout: Probability that a frame of x is lost, 0 to 1.
        lost: Start and end of the time in which x is lost, such as 2 3, s.
        frozen: Start and end of the time in which the sensor repeats one x, s.
        q_noise: Standard deviation of noise on the encoders, rad or m.
        q_quantum: Steps of the encoders, rad or m.
        velocity_filter: Time constant of q̇ from differences of q, s; exact by default.
    """

    noise: float = at_least(0.0)
    quantum: float = at_least(0.0)
    rate: float | None = positive(None)
    delay: float = at_least(0.0)
    dropout: float = at_least(0.0)
    lost: Interval | None = None
    frozen: Interval | None = None
    q_noise: float = at_least(0.0)
    q_quantum: float = at_least(0.0)
    velocity_filter: float | None = at_least(None)


@dataclass(frozen=True)
class ControllerChoice:
    """The law, its gains, and its limits.

    Attributes:
        law: "setpoint", the paper's; or "tracking", adaptive, for paths, too. Without other options
            but limits a simulation of position or pose tracks, and learns tool, origins and axes.
        unknown: Parts of the kinematics that are learnt from x (tool, origins, axes, camera,
            offset, delay): then x̂ is controlled. Of an image "camera" is its pose and focal length,
            and "tool" where the points are.
        command: "torque", or "velocity" for robots that take joint velocities (law "tracking").
        differentiator: Time constant of Ẋ from the differentiated x, s: law (5), or law (6).
        gravity: Gravity that is compensated: learnt, by default (with all dynamics by the law
            tracking); the true one, the believed one or none; or a learnt residual, for robots
            that add the believed arm's (Franka, UR).
        integral_action: Learn a task force and joint torques; by default if gravity is learnt.
        settling_time: Time to settle, s; by default as short as arm, motors and latency allow.
        kp: Gain K_p, one number or one per task coordinate; by the rule of default gains.
        kv: Gain K_v, one number or one per task coordinate; by the rule of default gains.
        damping: Added joint damping, one number or one per joint; by the rule of default gains.
        gamma: Saturation of the error by γ sin(e/γ), in the unit of the task; by default the tanh
            of the rule, or none with gains that are given.
        detours: Leave dead ends by a motion of the joints to another configuration that reaches the
            target; by the law tracking, for positions. By default if a simulation chooses the law.
        self_motion: "teach" moves a redundant arm besides the task, so that learnt kinematics are
            known elsewhere; by the law tracking.
        limits: Limits to keep: those of the "urdf"; a multiple of its effort limits, then the
            motors' too; or "none", as in continuous control.
        unseen: Largest motion for which the last x is held, m, rad or px; none by default.
    """

    law: Literal["setpoint", "tracking"] | None = None
    unknown: tuple[str, ...] = ()
    command: Literal["torque", "velocity"] = "torque"
    differentiator: float | None = positive(None)
    gravity: Literal["learnt", "exact", "believed", "none", "learn_residual"] | None = None
    integral_action: bool | None = None
    settling_time: float | None = positive(None)
    kp: Numbers | None = positive(None)
    kv: Numbers | None = positive(None)
    damping: Numbers | None = at_least(None)
    gamma: float | None = positive(None)
    detours: bool | None = None
    self_motion: Literal["teach"] | None = None
    limits: float | Literal["urdf", "none"] = positive("urdf")
    unseen: float | None = positive(None)


@dataclass(frozen=True)
class LoopRecord:
    """Period and delay of control.

    Attributes:
        dt: Sampling time of control, s; "continuous" integrates one differential equation.
        actuator_delay: Time from a command to its effect, s.
    """

    dt: float | Literal["continuous"] = positive(1e-3)
    actuator_delay: float = at_least(0.0)


@dataclass(frozen=True)
class CirclePath:
    """A circle at constant speed, in a horizontal plane or that of a task with two coordinates.

    Attributes:
        radius: Radius of the circle, m; no circle by default.
        period: Time of one turn, s.
        center: Center of the circle, m; by default the circle begins where the task starts.
    """

    radius: float | None = positive(None)
    period: float = positive(4.0)
    center: Numbers | None = None


@dataclass(frozen=True)
class LinePath:
    """A straight line from where the task starts, at rest at both ends.

    Attributes:
        offset: Offset of the line's end from its start, m; no line by default.
        duration: Time from start to end, s.
    """

    offset: Numbers | None = None
    duration: float = positive(4.0)


@dataclass(frozen=True)
class WaypointPath:
    """Straight lines from where the task starts through points, at rest in each.

    Attributes:
        points: Coordinates of one point after the other, m; no waypoints by default.
        speed: Largest speed, m/s.
        acceleration: Largest acceleration, m/s².
    """

    points: Numbers | None = None
    speed: float = positive(0.2)
    acceleration: float = positive(0.5)


@dataclass(frozen=True)
class Goal:
    """The target, given in one of these ways; a list of numbers in a file is `at`.

    Attributes:
        at: Target: position (m), pose (x y z qx qy qz qw), images (u v of each point); random by
            default.
        offset: Target relative to where the task starts, m (and rad of a pose).
        configuration: Joint positions at which the true sensor measures the target, rad or m.
        circle: Circle to follow.
        line: Line to follow.
        waypoints: Points to follow.
    """

    at: Numbers | None = None
    offset: Numbers | None = None
    configuration: Numbers | None = None
    circle: CirclePath = CirclePath()
    line: LinePath = LinePath()
    waypoints: WaypointPath = WaypointPath()


@dataclass(frozen=True)
class Run:
    """Start, target and duration of a run.

    Attributes:
        start: Joint positions, rad or m, or "random" by the seed; far from singular by default.
        target: Value or path of the task; by default random by the seed: unless the start is, too,
            above the floor that the arm stands on, and where no joint stop bars the straight way.
        duration: Length of the run, s.
        tolerance: Error below which it is done, m, rad or px; by default 1e-3 m and rad or three
            times the noise, 0.5 px or the noise; of a path a twentieth of how far it leads from its
            start, if that is more.
        seed: Seed of target, noise and dropouts, and of a random start.
    """

    start: Numbers | Literal["random"] | None = None
    target: Goal = Goal()
    duration: float = positive(20.0)
    tolerance: float | None = positive(None)
    seed: int = at_least(0, 0)


@dataclass(frozen=True)
class Analysis:
    """Errors and region of `approxjac stability`; without ranges of errors those of the true robot.

    Attributes:
        object_length: Smallest and largest true length of the object, m.
        object_mass: Smallest and largest true mass of the object, kg.
        joint_shifts: Largest errors of joint origins either way, m, such as panda_joint4 0 0.01 0.
        joint_rotations: Largest errors of joint axes either way, as rotation vectors, rad.
        focal_length: Smallest and largest true focal length of the camera, px or m.
        distance: Smallest and largest true distance of a planar camera, or error of it, m.
        roll: Smallest and largest true roll of the camera, of a pinhole one its error, rad.
        tilt: Largest errors of a pinhole camera's view about its axes right and down, rad.
        shift: Largest errors of a pinhole camera's place along right, down and forward, m.
        around: Center of the region, one position a joint, rad or m; `radius` is its size.
        radius: Largest distance of each joint from the center of the region, rad or m.
        sigma_min: Leave out configurations where σ_min of the believed Jacobian is smaller, m/rad.
        target: The one target; by default all targets within the region.
        configurations: Number of configurations that are drawn.
        runs: Number of rollouts, with the sensors, delays, duration and tolerance of a run.
        moves: Length of moves along each axis of a position, to both sides, whose certified speed
            is sought, m; 0 seeks none.
        map: Two parameters of the stability map, of error, a, kv and damping.
        map_points: Values of each parameter of the map; 0 draws no map.
        map_runs: Rollouts at each point of the map.
    """

    object_length: Interval | None = None
    object_mass: Interval | None = None
    joint_shifts: Vectors = field(default_factory=dict)
    joint_rotations: Vectors = field(default_factory=dict)
    focal_length: Interval | None = None
    distance: Interval | None = None
    roll: Interval | None = None
    tilt: Interval | None = None
    shift: Vector | None = None
    around: Numbers | None = None
    radius: float = positive(0.3)
    sigma_min: float | None = at_least(None)
    target: Numbers | None = None
    configurations: int = at_least(2000, 20)
    runs: int = at_least(20)
    moves: float = at_least(0.2, 0.0)
    map: tuple[str, str] = ("error", "a")
    map_points: int = at_least(8)
    map_runs: int = at_least(20, 1)
