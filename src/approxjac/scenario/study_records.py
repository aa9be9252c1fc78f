"""Errors and region of a scenario's stability report; attributes are the help of its options."""

from __future__ import annotations

from dataclasses import dataclass, field

from approxjac.scenario.records import Interval, Numbers, Vectors, above, at_least


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
        around: Joint positions, one a joint, rad or m: the region is within the radius of them.
        radius: Of the region: of each joint, around such positions or a run's, rad or m.
        run: File run.npz of approxjac simulate: the region is near its configurations.
        reach_from: Joint positions of a start: look where V lets the arm get to the target.
        sigma_min: Leave out configurations where σ_min of the believed Jacobian is smaller, m/rad.
        target: The one target; by default all targets within the region.
        configurations: How many configurations are drawn.
        runs: How many rollouts are made, with the sensors, delays, duration and tolerance of a run.
        map: Two parameters of the stability map, of error, a, kv and damping; or two of the errors,
            or of x, y and z of the believed tip at the start.
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
    around: Numbers | None = None
    radius: float = above(0.3)
    run: str | None = None
    reach_from: Numbers | None = None
    sigma_min: float | None = at_least(None)
    target: Numbers | None = None
    configurations: int = at_least(2000, 20)
    runs: int = at_least(20)
    map: tuple[str, str] = ("error", "a")
    map_points: int = at_least(8)
    map_runs: int = at_least(20, 1)
