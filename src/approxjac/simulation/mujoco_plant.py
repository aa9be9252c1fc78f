"""A plant whose physics MuJoCo computes, an independent engine."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError, UrdfError, package_of
from approxjac.robots import Robot
from approxjac.robots.drives import Friction
from approxjac.simulation.plant import Plant
from approxjac.simulation.transmission import Motors, Transmission
from approxjac.tasks import Task
from approxjac.validation import Array, as_number

if TYPE_CHECKING:
    import mujoco

_SPRING = " (spring)"  # of the joint between a motor and its link
_LONGEST, _TINY = 1e-4, 1e-6  # step of MuJoCo's where joints are not ideal [s]; part of a step


class MujocoPlant(Plant):
    """A plant simulated by MuJoCo, with joint limits and a floor.

    MuJoCo opens the URDF that `Robot.save_urdf` writes. Without contact and within the joint
    limits, accelerations are those of `Plant` to rounding. With drives or dry friction it runs
    MuJoCo's own steps of at most 0.1 ms: an elastic joint is two on one axis, motor and spring, and
    dry friction a soft constraint, with which joints creep a little. Limits and floor are soft
    constraints with a time constant of 20 ms; their forces jump, so give `simulate` a dt. The arm
    and its object can touch the floor, but not each other; shapes are those of <collision> in
    the URDF, meshes as their convex hulls.

    Needs `pip install 'approxjac[mujoco]'`. Owns scratch memory: one instance per thread.

    Args:
        robot: The true robot.
        sensor, friction: As for `Plant`.
        floor: Height z of a horizontal floor in the world frame [m]; None for no floor. Links
            fixed to the base may be below it.
        **options: Other arguments of `Plant`.

    Attributes:
        mujoco_model: MuJoCo's model of the robot and the floor, such as for its viewer. Read-only.

    Raises:
        InvalidInputError: As for `Plant`, a floor that is no number, moving mimic joints, or what
            MuJoCo has not: static friction above Coulomb's, friction by load, backlash, ripple.
        MissingPackageError: MuJoCo is not installed.
        UrdfError: MuJoCo cannot open the URDF, for example because of missing collision meshes
            or physically impossible inertias.
    """

    stops = None  # MuJoCo has its own

    def __init__(
        self,
        robot: Robot,
        sensor: Task | None = None,
        friction: float | Sequence[float] | Array | Friction = 0.0,
        *,
        floor: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(robot, sensor, friction, **options)
        if robot.mimic_joints.G is not None:
            raise InvalidInputError(
                f"robot must have no mimic joints that move, which MuJoCo couples by a soft "
                f"constraint only; lock those of {robot.name} (with_locked_joints)",
                given=robot,
            )
        self.floor = None if floor is None else as_number("floor", floor, unit="m")
        rubs, drives = self.transmission.friction, self.drives
        more = rubs.stribeck > 1.0 or np.any(rubs.load) or np.any(drives.backlash)
        if more or np.any(drives.ripple):
            raise InvalidInputError(
                "friction and drives of a MujocoPlant must be without stribeck, load, backlash and "
                f"ripple, got {rubs!r} and {drives!r}",
                given=drives,
            )
        real = self.transmission if self.is_stepped else None
        self.mujoco_model = _mujoco_model(robot, self.floor, self.joint_limits, real)
        import mujoco

        self._mujoco, self._mujoco_data = mujoco, mujoco.MjData(self.mujoco_model)
        self._neutral = robot.neutral()
        # MuJoCo has one number a joint, continuous joints included, but another order of joints
        joints = [self.mujoco_model.joint(name) for name in robot.joint_names]
        self._places = np.array([joint.dofadr[0] for joint in joints])
        elastic = np.isfinite(self.drives.stiffness)
        self._springs = np.array(
            [
                self.mujoco_model.joint(f"{name}{_SPRING}").dofadr[0] if soft else -1
                for name, soft in zip(robot.joint_names, elastic, strict=True)
            ]
        )

    @property
    def is_stepped(self) -> bool:
        """True with dry friction, too, which is a constraint of MuJoCo's."""
        return not self.is_ideal

    def _transmitted(
        self, q: Array, v: Array, motors: Motors, tau: Array, h: float
    ) -> tuple[Array, Array, Motors]:
        """Return (q, v, motors) after a step h [s], of MuJoCo's own steps."""
        data, model, places = self._mujoco_data, self.mujoco_model, self._places
        soft = self._springs >= 0
        springs = self._springs[soft]
        at = np.asarray(pin.difference(self.robot.model, self._neutral, q))
        data.qpos[places] = at + motors.twist
        data.qvel[places] = motors.rate
        data.qpos[springs], data.qvel[springs] = -motors.twist[soft], (v - motors.rate)[soft]
        data.qfrc_applied[places] = tau
        count = max(1, math.ceil(h / _LONGEST - _TINY))
        model.opt.timestep = h / count
        for _ in range(count):
            self._mujoco.mj_step(model, data)
        turned, rate, twist = data.qpos[places] - at, data.qvel[places].copy(), 0.0 * at
        twist[soft] = -data.qpos[springs]
        change, v_end = v, rate.copy()
        v_end[soft] += data.qvel[springs]
        after = Motors(twist, rate, motors.held, v_end - change)
        return self._moved(q, turned - twist), v_end, after

    def _forward(self, q: Array, v: Array, tau: Array) -> Array:
        """Return q̈ by MuJoCo (n_v,), the same bits whatever was asked before."""
        data, places = self._mujoco_data, self._places
        data.qpos[places] = pin.difference(self.robot.model, self._neutral, q)
        data.qvel[places] = v
        data.qfrc_applied[places] = tau
        self._mujoco.mj_forward(self.mujoco_model, data)
        return np.array(data.qacc[places])

    def _is_free(self, q: Array) -> bool:
        data = self._mujoco_data
        data.qpos[:] = 0.0  # springs, which a run may have left bent
        data.qpos[self._places] = pin.difference(self.robot.model, self._neutral, q)
        self._mujoco.mj_kinematics(self.mujoco_model, data)
        self._mujoco.mj_collision(self.mujoco_model, data)
        return not data.ncon


def _mujoco_model(
    robot: Robot, floor: float | None, joint_limits: bool, transmission: Transmission | None
) -> mujoco.MjModel:
    mujoco = package_of("mujoco", "mujoco")
    with tempfile.TemporaryDirectory() as folder:
        path = robot.save_urdf(Path(folder) / "robot.urdf")
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            _same_physics(spec, robot)
            _constraints(spec, robot, floor, joint_limits)
            if transmission is not None:
                _joints(spec, robot, transmission)
            return spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())  # MuJoCo's own is of several lines
            raise UrdfError(
                f"MuJoCo cannot open the URDF of {robot.name}: {reason}; it needs every collision "
                "mesh that the URDF names, and inertias that a body can have: no principal moment "
                "larger than the other two together",
                given=robot,
            ) from error


def _same_physics(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Remove from a MuJoCo model the physics that `Plant` does not have."""
    import mujoco

    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.compiler.balanceinertia = False
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.settotalmass = -1.0  # which is MuJoCo's way to say: as it is
    spec.option.gravity = robot.gravity
    spec.option.density = spec.option.viscosity = 0.0
    # a warm start, or bodies that sleep, would make accelerations depend on what came before
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_WARMSTART
    spec.option.enableflags = 0
    spec.option.tolerance = 1e-12
    for joint in spec.joints:
        joint.damping = np.zeros_like(joint.damping)
        joint.stiffness = np.zeros_like(joint.stiffness)
        joint.frictionloss = joint.armature = 0.0
    for mimic in list(spec.equalities):
        spec.delete(mimic)


def _joints(spec: mujoco.MjSpec, robot: Robot, transmission: Transmission) -> None:
    """Give the joints rotors, springs and friction."""
    import mujoco

    drives, friction, D = transmission.drives, transmission.friction, transmission.damping
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for i, name in enumerate(robot.joint_names):
        motor = spec.joint(name)
        motor.armature = np.asarray(drives.rotor_inertia)[i]
        motor.damping[0] = np.asarray(friction.viscous)[i]
        motor.frictionloss = np.asarray(friction.coulomb)[i]
        # as hard as its step allows: a light joint would be slowed by less than its friction
        motor.solref_friction = (2.0 * _LONGEST, 1.0)
        motor.solimp_friction = (0.999, 0.9999, 1e-3, 0.5, 2.0)
        K = np.asarray(drives.stiffness)[i]
        if np.isfinite(K):
            spring = motor.parent.add_joint(
                name=f"{name}{_SPRING}", type=motor.type, axis=motor.axis, pos=motor.pos
            )
            spring.stiffness[0], spring.damping[0] = K, D[i]
            if motor.limited == mujoco.mjtLimited.mjLIMITED_TRUE:  # of the link, not the motor
                low, high = motor.range
                motor.limited = mujoco.mjtLimited.mjLIMITED_FALSE
                both = spec.add_tendon(limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=(low, high))
                both.wrap_joint(name, 1.0)
                both.wrap_joint(spring.name, 1.0)


def _constraints(
    spec: mujoco.MjSpec, robot: Robot, floor: float | None, joint_limits: bool
) -> None:
    """Put limits onto the joints, a floor under the arm, and let nothing else touch."""
    import mujoco

    for name, low, high in zip(robot.joint_names, *robot.position_limits, strict=True):
        limited = joint_limits and bool(np.isfinite([low, high]).all())
        joint = spec.joint(name)
        joint.limited = mujoco.mjtLimited(int(limited))
        if limited:
            joint.range = (low, high)
    for geom in spec.geoms:
        # two shapes touch if the contype of one meets the conaffinity of the other
        geom.contype, geom.conaffinity = int(geom.contype or geom.conaffinity), 0
    if floor is not None:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            pos=(0.0, 0.0, floor),
            size=(0.0, 0.0, 0.1),  # without end; the last is for drawing only
            contype=0,
            conaffinity=1,
        )
