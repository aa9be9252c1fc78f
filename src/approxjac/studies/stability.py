"""The stability of an arm whose controller believes a wrong robot, before anything moves."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from approxjac.controllers import (
    AdaptiveGravity,
    Gains,
    NoGravity,
    SetpointController,
    default_gains,
)
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.law import Linear, Sine
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.simulation import Trajectory
from approxjac.stability import (
    JointBox,
    Region,
    RegularPart,
    StabilityMap,
    StabilityReport,
    SublevelSet,
    Tolerance,
    Tube,
    Uncertainty,
    damping_that_certifies,
    part_that_certifies,
    stability_map,
    stability_report,
    tolerance,
)
from approxjac.stability.closed_loop import ClosedLoop
from approxjac.stability.map import PARAMETERS
from approxjac.stability.tolerance import Test
from approxjac.tasks import PlanarCamera, PositionTask
from approxjac.validation import Array, as_number

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class StabilitySettings:
    """What to look at. Lengths in m, masses in kg, angles in rad, times in s.

    Attributes:
        tip: End-effector frame that holds the object; the robot's own by default.
        base: Link that the chain to the tip starts from.
        free: Joints that are not locked although the tip does not need them.
        object_length: Smallest and largest true length of the object, m.
        object_mass: Smallest and largest true mass of the object, kg.
        object_axis: Axis of the tip's frame that the object points along, such as "z" or "-x"; the
            one that leads on from the arm by default.
        believed_length: Length of the object that the controller believes, m.
        believed_mass: Mass of the object that the controller believes, kg.
        joint_shifts: How far joint origins may be off either way, m, such as panda_joint4 0 0.01 0.
        joint_rotations: The same for joint axes, as rotation vectors, rad.
        axes: World axes of the position task; those that the arm commands best by default.
        camera: Focal length, distance and roll of a believed camera that looks at the arm's x-z
            plane; the task is then the tip's image.
        focal_length: Smallest and largest true focal length, m.
        distance: Smallest and largest true distance of the camera, m.
        roll: Smallest and largest true roll of the camera, rad.
        friction: Viscous friction of every true joint, N m s/rad.
        gravity: "exact" takes gravity as compensated exactly, "learnt" is the law (28), (29).
        settling_time: Wanted by the default gains, s.
        kp: K_p instead of the default gains' one; one number, or one a task coordinate.
        kv: K_v instead of the default gains' one; one number, or one a task coordinate.
        damping: Added joint damping instead of the default gains' one; one number, or one a joint.
        gamma: Saturation of the error by γ sin(e/γ), in the unit of the task; none by default.
        around: Joint positions, one a joint, rad or m: look within `radius` of them; by default
            within the joint limits, where the believed Jacobian is not near singular.
        radius: How far each joint may be from `around`, or from a run's postures, rad or m.
        run: File run.npz of `approxjac simulate`: look near its postures.
        reach_from: Joint positions of a start: look where V lets the arm get to the target.
        sigma_min: Leave out postures where σ_min of the believed Jacobian is smaller, m/rad.
        target: The one target; by default all targets within the region.
        postures: How many to draw.
        runs: Rollouts of 10 s.
        map: Two parameters of the stability map, of error, a, kv and damping.
        map_points: Values of each parameter; 0 draws no map.
        map_runs: Rollouts at each point of the map's coarse grid.
        seed: Of all drawing.
    """

    tip: str | None = None
    base: str | None = None
    free: tuple[str, ...] = ()
    object_length: tuple[float, float] | None = None
    object_mass: tuple[float, float] | None = None
    object_axis: str | None = None
    believed_length: float = 0.0
    believed_mass: float = 0.0
    joint_shifts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    joint_rotations: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    axes: str | None = None
    camera: tuple[float, float, float] | None = None
    focal_length: tuple[float, float] | None = None
    distance: tuple[float, float] | None = None
    roll: tuple[float, float] | None = None
    friction: float = 0.0
    gravity: Literal["exact", "learnt"] = "exact"
    settling_time: float = 1.0
    kp: tuple[float, ...] | None = None
    kv: tuple[float, ...] | None = None
    damping: tuple[float, ...] | None = None
    gamma: float | None = None
    around: tuple[float, ...] | None = None
    radius: float = 0.3
    run: str | None = None
    reach_from: tuple[float, ...] | None = None
    sigma_min: float | None = None
    target: tuple[float, ...] | None = None
    postures: int = 2000
    runs: int = 20
    map: tuple[str, str] = ("error", "a")
    map_points: int = 40
    map_runs: int = 2
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Case:
    """A controller, the errors that it may meet, and where to look."""

    settings: StabilitySettings
    uncertainty: Uncertainty
    controller: SetpointController
    region: Region
    target: Array | None


@dataclass(frozen=True, eq=False)
class StabilityResult:
    """What was found.

    Attributes:
        case: What was looked at.
        report: The four tests.
        tolerances: How far the errors may be scaled for each test; nothing if none are given.
        raised_damping: The smallest damping tried, times the given one, with which a report on as
            many postures certifies all errors; None if they are certified already, or not with any.
        certified_part: The errors, scaled down, that a report on as many postures certifies as it
            is; None if they are certified as a whole, or no part tried is.
        map: The stability map, or None.
    """

    case: Case
    report: StabilityReport
    tolerances: dict[Test, Tolerance]
    raised_damping: float | None
    certified_part: Uncertainty | None
    map: StabilityMap | None


def prepare(robot: str, settings: StabilitySettings) -> Case:
    """Build the errors, the controller and the region.

    Raises:
        ApproxJacError: Settings that are out of range or do not fit the robot.
    """
    _require_map(settings)
    arm = load_robot(robot, tip=settings.tip, base=settings.base, free=settings.free)
    if settings.gravity == "exact":
        arm = arm.with_gravity((0.0, 0.0, 0.0))  # eq. (9): what is compensated exactly is not felt
    uncertainty = _uncertainty(arm, settings)
    task = uncertainty.believed_task()
    belief = uncertainty.belief()
    gravity = (
        NoGravity(belief)
        if settings.gravity == "exact"
        else AdaptiveGravity(GravityRegressor(belief))
    )
    controller = SetpointController(
        task,
        _gains(uncertainty, settings),
        gravity=gravity,
        saturation=Linear() if settings.gamma is None else Sine(settings.gamma),
    )
    target = None if settings.target is None else task.target(settings.target)
    region = _region(uncertainty, controller, settings, target)
    return Case(settings, uncertainty, controller, region, target)


def run(
    case: Case,
    executor: Executor | None = None,
    progress: Progress | None = None,
    found: Callable[[StabilityReport], None] = lambda report: None,
) -> StabilityResult:
    """Make the tests, find what they tolerate, and draw the map's figures.

    Args:
        case: What to look at.
        executor: What shares the runs; this process by default.
        progress: Called with what is being done and the share of it that is.
        found: Called with the report of the tests, long before the rest is known.

    Raises:
        ApproxJacError: An empty region, or a target out of reach.
    """
    settings, tell = case.settings, progress or (lambda what, share: None)
    report = stability_report(
        case.controller, case.uncertainty, case.region, target=case.target,
        seed=settings.seed, configurations=settings.postures, runs=settings.runs,
        executor=executor, progress=tell,
    )  # fmt: skip
    found(report)
    tolerances: dict[Test, Tolerance] = {}
    raised, part, drawn = None, None, None
    if case.uncertainty.d > 0:
        tolerances = tolerance(
            case.controller, case.uncertainty, case.region, target=case.target,
            seed=settings.seed, progress=lambda share: tell("tolerance", share),
        )  # fmt: skip
        if report.certified_by is None:
            raised = damping_that_certifies(
                case.controller, case.uncertainty, case.region, target=case.target,
                configurations=settings.postures, seed=settings.seed,
                progress=lambda share: tell("more damping", share),
            )  # fmt: skip
            part = part_that_certifies(
                case.controller, case.uncertainty, case.region, target=case.target,
                largest=min(1.0, tolerances["matrix"].scale),
                configurations=settings.postures, seed=settings.seed,
                progress=lambda share: tell("smaller errors", share),
            )  # fmt: skip
        if settings.map_points:
            drawn = _map(case, executor, tell)
    return StabilityResult(case, report, tolerances, raised, part, drawn)


def _require_map(settings: StabilitySettings) -> None:
    """Refuse at once what would be refused at the end only."""
    if settings.map_points and settings.map_points < 2:
        raise InvalidInputError(
            f"map_points must be 0 or >= 2, got {settings.map_points}", given=settings.map_points
        )
    for name in settings.map:
        if name not in PARAMETERS:
            raise UnknownNameError("parameter", name, "the map", PARAMETERS)


def _uncertainty(arm: Robot, settings: StabilitySettings) -> Uncertainty:
    camera, make = None, functools.partial(PositionTask, axes=settings.axes)
    if settings.camera is not None:
        camera = PlanarCamera(*settings.camera)
        if settings.axes is not None:
            raise InvalidInputError(
                "axes are those of a position task, which a camera takes the place of, got "
                f"{settings.axes!r}",
                given=settings.axes,
            )
    return Uncertainty(
        arm,
        None if camera is not None else make,
        object_length=settings.object_length,
        object_mass=settings.object_mass,
        believed_length=settings.believed_length,
        believed_mass=settings.believed_mass,
        object_axis=settings.object_axis,
        joint_shifts=settings.joint_shifts,
        joint_rotations=settings.joint_rotations,
        camera=camera,
        focal_length=settings.focal_length,
        distance=settings.distance,
        roll=settings.roll,
        friction=settings.friction,
    )


def _gains(uncertainty: Uncertainty, settings: StabilitySettings) -> Gains:
    default = default_gains(uncertainty.believed_task(), settings.settling_time)
    given = {name: getattr(settings, name) for name in ("kp", "kv", "damping")}
    chosen = {
        name: getattr(default, name) if value is None else value[0] if len(value) == 1 else value
        for name, value in given.items()
    }
    return Gains(**chosen)


def _region(
    uncertainty: Uncertainty,
    controller: SetpointController,
    settings: StabilitySettings,
    target: Array | None,
) -> Region:
    given = {
        name: getattr(settings, name) for name in ("around", "run", "reach_from")
        if getattr(settings, name) is not None
    }  # fmt: skip
    if len(given) > 1:
        raise InvalidInputError(f"one region must be given, got {' and '.join(given)}", given=given)
    belief = uncertainty.belief()
    as_number("radius", settings.radius, unit="rad", above=0.0)
    region: Region
    if settings.around is not None:
        region = JointBox.around(belief, _posture(belief, settings.around), settings.radius)
    elif settings.run is not None:
        region = Tube(belief, Trajectory.load(settings.run).q, settings.radius)
    elif settings.reach_from is not None:
        if target is None:
            raise InvalidInputError("reach_from needs a target, got none", given=None)
        nominal = uncertainty.plant(uncertainty.believed)
        start = _posture(belief, settings.reach_from)
        region = SublevelSet(nominal, controller, target, start)
    elif settings.sigma_min is None:
        return ClosedLoop(controller, uncertainty).region
    else:
        region = JointBox(belief)
    if settings.sigma_min is None:
        return region
    return RegularPart(region, controller.task, settings.sigma_min)


def _posture(robot: Robot, joints: tuple[float, ...]) -> Array:
    """Configuration from one number a joint."""
    point = JointBox(robot, joints, joints)
    return np.array(point.sample(1, np.random.default_rng(0))[0])


def _map(case: Case, executor: Executor | None, tell: Progress) -> StabilityMap:
    settings = case.settings
    x, y = (_values(case, name) for name in settings.map)
    return stability_map(
        case.controller, case.uncertainty, case.region, names=settings.map, x=x, y=y,
        target=case.target, runs=settings.map_runs, seed=settings.seed, executor=executor,
        progress=lambda share: tell("map", share),
    )  # fmt: skip


def _values(case: Case, name: str) -> Array:
    """Values of a parameter of the map."""
    shares = np.linspace(0.0, 1.0, case.settings.map_points)
    if name == "error":
        return case.uncertainty.largest_scale(3.0) * shares
    kp, kv, _ = case.controller.diagonals
    middle = float(np.mean(kp / kv)) if name == "a" else 1.0
    values: Array = middle * 10.0 ** (2.0 * shares - 1.0)
    return values
