"""`Drives` and `Friction`: an arm's joints as they are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.robots.dynamics import Dynamics
from approxjac.robots.robot import Robot
from approxjac.validation import Array, as_diagonal, as_limits, as_number

Entries = float | Sequence[float] | Array
_DRAWN = 50  # configurations, for a joint's usual inertia and load
_MOTOR_SHARE = 2.0  # effort of a motor in its largest load, where a URDF has none


def usual_inertia(robot: Robot, *, held: bool = False) -> Array:
    """Return 1/mean (M⁻¹)_ii over random configurations, shape (n_v,) [kg m² or kg].

    With `held` the other joints stand: mean M_ii.
    """
    dynamics, drawn = Dynamics(robot), robot.configurations(_DRAWN)
    if held:
        return np.asarray(np.mean([np.diag(dynamics.M(q)) for q in drawn], axis=0))
    return np.asarray(1.0 / np.mean([np.diag(dynamics.M_inv(q)) for q in drawn], axis=0))


def usual_effort(robot: Robot) -> Array:
    """Return the effort limits; twice the largest gravity torque of an arm's joints without one."""
    effort = robot.effort_limits
    if np.isfinite(effort).all():
        return effort
    loads = np.abs([*map(Dynamics(robot).g, robot.configurations(_DRAWN))])
    most = _MOTOR_SHARE * np.max(loads, axis=0)
    least = 0.05 * float(np.max(most)) or 1.0
    return np.where(np.isfinite(effort), effort, np.maximum(most, least))


@dataclass(frozen=True, eq=False, repr=False)
class Friction:
    """Friction of joints: viscous, and dry with true sticking.

    Sliding at q̇ ≠ 0 a joint is braked by

        B q̇ + (F_c (1 + (s − 1) exp(−abs(q̇)/v_s)) + l abs(τ_load)) sgn(q̇),

    standing it takes what it needs to stand, up to as much. The paper's eq. (1) has the first term
    only. τ_load is what the joint carries: gravity and Coriolis torques, or the spring of an
    elastic joint. `Friction.usual` has figures of a real arm.

    Attributes:
        viscous: B ≥ 0, a number or shape (n_v,) [N m s/rad or N s/m].
        coulomb: Coulomb friction F_c ≥ 0, a number or shape (n_v,) [N m or N].
        stribeck: s ≥ 1, static friction in Coulomb friction.
        stribeck_velocity: v_s > 0, speed within which it falls to that [rad/s or m/s].
        load: Share l ≥ 0 of the load that is added to F_c, a number or shape (n_v,).

    Raises:
        InvalidInputError: Numbers that are negative, not finite or too small.
    """

    viscous: Entries = 0.0
    coulomb: Entries = 0.0
    stribeck: float = 1.0
    stribeck_velocity: float = 0.02
    load: Entries = 0.0
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("stribeck", self.stribeck, minimum=1.0)
        as_number("stribeck_velocity", self.stribeck_velocity, above=0.0)

    @classmethod
    def usual(cls, robot: Robot) -> Self:
        """Return friction in proportion to the motors, as measured on a Universal Robots UR10e.

        Its Coulomb friction is 5 to 6 % of each effort, its viscous friction 4 to 8 % a rad/s; of
        the two joints that carry the arm it grows by 6 % of the load.
        """
        effort = usual_effort(robot)
        return cls(0.06 * effort, 0.05 * effort, stribeck=1.2, load=0.06)

    def of(self, nv: int) -> Self:
        """Return it with an array (n_v,) for each that may be a number, checked."""
        return replace(
            self,
            viscous=as_diagonal("viscous", self.viscous, nv, unit="N m s/rad", positive=False),
            coulomb=as_diagonal("coulomb", self.coulomb, nv, unit="N m", positive=False),
            load=as_diagonal("load", self.load, nv, positive=False),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Drives:
    """Motors, gears and encoders of an arm's joints, between torque and link.

    Beside M(q) q̈ + C q̇ + g = τ_s of the links, each joint has a motor behind an elastic gear,

        J θ̈ + friction(θ̇) = τ − τ_s,   τ_s = K(θ − q) + D(θ̇ − q̇),

    θ and J at the joint's side of the gear. See M. W. Spong, Modeling and control of elastic joint
    robots, ASME J. Dyn. Sys. Meas. Control 109, 1987.

    Attributes:
        rotor_inertia: J ≥ 0, motor times gear ratio², a number or shape (n_v,) [kg m² or kg].
        stiffness: K > 0, infinite for a rigid joint, a number or (n_v,) [N m/rad or N/m]. An
            elastic joint needs J > 0.
        damping_ratio: Damping ratio ≥ 0 of motor against link while the other joints stand, which
            gives D.
        backlash: Half of the play of the gear, a number or (n_v,) [rad or m]; elastic joints only.
        ripple: Largest torque ripple, a number or (n_v,) [N m or N], a sine of θ.
        ripple_count: Its periods in a rad or m, > 0.
        encoders: "motor" measures θ and θ̇ for q and q̇, "joint" the link's.

    Raises:
        InvalidInputError: Numbers that are negative or not finite, or no such encoders.
    """

    rotor_inertia: Entries = 0.0
    stiffness: Entries = np.inf
    damping_ratio: float = 0.05
    backlash: Entries = 0.0
    ripple: Entries = 0.0
    ripple_count: float = 20.0
    encoders: Literal["motor", "joint"] = "motor"
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("damping_ratio", self.damping_ratio, minimum=0.0)
        as_number("ripple_count", self.ripple_count, above=0.0)
        if not isinstance(self.encoders, str) or self.encoders not in ("motor", "joint"):
            message = f'encoders must be "motor" or "joint", got {self.encoders!r}'
            raise InvalidInputError(message, given=self.encoders)

    @classmethod
    def usual(cls, robot: Robot) -> Self:
        """Return drives as geared arms have them, in proportion to the motors' torque.

        Rotors of 5e-3 s² times the effort and gears of 100/rad times it: a drive of 150 N m has
        0.75 kg m² and gives way by half a degree under its full torque. These are judgements.
        """
        effort = usual_effort(robot)
        return cls(5e-3 * effort, 100.0 * effort)

    def of(self, robot: Robot) -> Self:
        """Return it with an array (n_v,) for each that may be a number, checked for a robot."""
        nv = robot.nv
        arrays: dict[str, Any] = {}
        units = {"rotor_inertia": "kg m²", "backlash": "rad", "ripple": "N m"}
        for name, unit in units.items():
            arrays[name] = as_diagonal(name, getattr(self, name), nv, unit=unit, positive=False)
        K = as_limits("stiffness", self.stiffness, nv, unit="N m/rad")
        elastic = np.isfinite(K)
        for name, wrong, what in (
            ("rotor_inertia", elastic & (arrays["rotor_inertia"] == 0.0), "> 0 where a joint is"),
            ("backlash", ~elastic & (arrays["backlash"] > 0.0), "0 where no joint is"),
        ):
            if wrong.any():
                joint = robot.joint_names[int(wrong.argmax())]
                raise InvalidInputError(
                    f"{name} must be {what} elastic (stiffness < inf), got "
                    f"{arrays[name][wrong.argmax()]:g} at {joint}",
                    given=getattr(self, name),
                )
        return replace(self, stiffness=K, **arrays)

    def damping(self, inertia: Array) -> Array:
        """Return D, shape (n_v,) [N m s/rad or N s/m], for links of some inertia (n_v,)."""
        J, K = np.asarray(self.rotor_inertia), np.asarray(self.stiffness)
        reduced = J * inertia / np.maximum(J + inertia, 1e-300)
        K = np.where(np.isfinite(K), K, 0.0)
        return np.asarray(2.0 * self.damping_ratio * np.sqrt(K * reduced))
