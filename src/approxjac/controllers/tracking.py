"""`TrackingController`: the adaptive tracking law, with learnt kinematics and dynamics.

Its reference includes a self-motion (`RestConfiguration`); its command is a torque or a velocity
(`VelocityCommand`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np

from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers import arguments
from approxjac.controllers.adaptive_dynamics import AdaptiveDynamics, MotionDynamics
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Latency
from approxjac.controllers.gains.motors import (
    JointGains,
    RaisedGains,
    UsedGains,
    is_hardly_damped,
    slow_feedback,
    strong_drives,
)
from approxjac.controllers.gains.sample_configurations import max_damping_rate, singular_ratio
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.learning.learnt_camera import AdaptiveCamera
from approxjac.controllers.learning.positions import AdaptiveKinematics
from approxjac.controllers.limits.limits import Limits, sure_deceleration
from approxjac.controllers.posture import require_redundant
from approxjac.errors import InvalidInputError
from approxjac.formatting import spaced
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.robots import Drives, Dynamics, Friction, Robot
from approxjac.robots.traced import motion_between, moved, positions_at
from approxjac.tasks import ImageTask, PoseTask, PositionTask, StackedTask, Task
from approxjac.tasks.analysis import (
    require_as_believed,
    require_controllable,
    seen_configurations,
    vanishing,
)
from approxjac.validation import (
    Array,
    Immutable,
    as_array,
    as_limits,
    as_number,
    as_vector,
    require,
)

_OK, _SINGULAR = Status.OK, Status.NEAR_SINGULAR  # members of an enum are slow to look up
_PREDICTED, _UNPREDICTED, _LOST = Status.PREDICTED, Status.NOT_PREDICTED, Status.MEASUREMENT_LOST
_ALPHA, _SERVO_ALPHA = 6.0, 4.0  # α, that of a robot's own servo, which lags [1/s]
_ROOM = 0.5  # κ dt λ_max(M⁻¹M̂) at most
_EASE = 4.0  # ω of an eased target at least [1/s]
_SINGULAR_RATIO = 0.08  # of σ_max, below which Ĵ⁺ is damped
_SHARE = 0.9  # of the speed limits of joints
_SPEEDS = {"m": 0.5, "rad": 1.0}  # at which errors of a task are reduced
_TURN = 0.5  # [rad/s], at which those of other tasks go by their Jacobian
_SELF_MOTION = 0.5  # at most [rad/s or m/s]
_FREE = 0.45  # of a joint's range: so far from its middle nothing pulls it back
_WHOLE = 0.999  # of a turn
_ZONE, _WIDEST = 0.12, 0.6  # share of a joint's range in front of its ends, at most [rad or m]
_SLOW = 0.1  # of the speed limit, towards an end; and at most [rad/s or m/s]
_NO_END = 1e6  # of a range [rad or m]
_APPROACH = 5.0  # κ of `law.JointRange` [1/s]
_LAG_GAIN = 1.0  # of what learns the lag
_LONGEST_LAG = 0.1  # [s]
_RIGID = 1e9  # damping that is no bound [N m s/rad]
_SOONEST = 0.1  # that a joint gets to its full speed in [s]
_INSIDE, _FARTHEST = 0.03, 0.1  # share of a range that detours keep from its ends, at most
_TEACHES, _SINES = 0.15, (0.3, 0.9)  # self-motion that teaches [rad/s or m/s], ω [rad/s]
_APART = 2.4  # phases of joint after joint [rad]
_UNTOLD = 1.0  # speed of a detour where there is no limit [rad/s or m/s]


@dataclass(frozen=True)
class TrackingGains:
    """Gains of a `TrackingController`: rates, and the speed at which large errors are reduced.

    Attributes:
        alpha: α, rate at which small errors decay > 0 [1/s]. By default 6, with velocity
            commands 4, or less where motors with a lag do not allow its damping αM̂.
        kappa: κ, rate at which the joints follow their reference > 0 [1/s]. By default 60, or
            0.25/dt if that is less.
        self_motion: k_n, rate of the self-motion [1/s]; or "teach", for a redundant arm: besides
            k_n = 1, the joints move at up to 0.15 rad/s while the target moves, to show learnt
            kinematics more than the task does (`law.TeachingMotion`). It yields to stops, limits
            of speed and singular postures.
        speed: Largest speed at which errors are reduced, a number or one for each coordinate, (m,)
            [unit of the task/s]. By default 0.5 m/s and 1 rad/s, for other units that of joint
            speeds of 0.5 rad/s.
        detours: Leave dead ends, where the arm stands at stops or a singular Ĵ before a target at
            rest, by a motion of the joints to another configuration that reaches it (`law.Detour`).
            For torques, and errors that are x - x_d; at stops for arms with more joints than task
            coordinates. What is in the way is not known.
    """

    alpha: float | None = None
    kappa: float | None = None
    self_motion: float | Literal["teach"] = 1.0
    speed: float | Sequence[float] | Array | None = None
    detours: bool = False

    def __post_init__(self) -> None:
        if self.alpha is not None:
            as_number("alpha", self.alpha, unit="1/s", above=0.0)
        if self.kappa is not None:
            as_number("kappa", self.kappa, unit="1/s", above=0.0)
        if self.self_motion != "teach":
            as_number("self_motion", self.self_motion, unit="1/s", minimum=0.0)
        require("detours", self.detours, bool, "True or False")


class TrackingController(Immutable, Controller):
    """The adaptive tracking law (after Slotine and Li), with learnt kinematics and dynamics.

    τ = Y_d(q, q̇, q̇_r, q̈_r) â − κM̂σ with σ = q̇ − q̇_r, where the reference velocity

        q̇_r = Ĵ⁺(u − Ĵn₀) + n₀,   u = ẋ_d − αs(z),   n₀ = −k_n s(q ⊖ q_rest)

    brings the predicted error z to zero and q̈_r is its exact derivative. (In Ĵ⁺ joints near a stop
    leave the motion to others, and where some slide and some turn, fast joints do more of it:
    `law.reference_step`.) The measured x is used only to learn the kinematics; while it is lost,
    control continues with the prediction. With
    learnt kinematics the joints rest until x is first seen: q̇_r = 0, `MEASUREMENT_LOST`.

    With a latency the law begins with gains that the rotors of `drives` tolerate, or the lightest
    usual ones if none are given. It then raises α, the bound of κM̂ and the learning of dynamics
    until a joint oscillates or they are those of heavy rotors (`law.RaisedDamping`): V̇₂ ≤ 0 holds
    with any of them while they do not fall.

    Its state is that of the dynamics, followed by that of the kinematics and, for velocity
    commands, the last command, else that of the raising.

    Immutable, but it owns scratch memory: one instance per thread.

    Args:
        task: The task of the believed robot.
        kinematics: Kinematics that predict z, for the same dt. By default `AdaptiveKinematics` of
            tool and joint origins, and `AdaptiveCamera` for images of a `PinholeCamera`;
            `KnownKinematics` takes the believed arm's as true.
        dynamics: Source of the feedforward torque Y_d â; `AdaptiveDynamics` of the believed robot
            by default, or `ModelDynamics`.
        posture: Rest configuration q_rest of a redundant arm's self-motion, shape (nq,); by default
            none, but joints that turn less than once are kept off the last 5 % of their ranges.
        dt: Sampling time [s]; by default the latency's period, else 1 ms.
        gains: α, κ, k_n and the largest speed; by default those of `TrackingGains()`.
        command: "torque", or "velocity" for a robot that takes joint velocities: then the command
            is q̇_r, advanced by the servo's lag, which is learnt in place of the dynamics, and
            within the URDF's limits of speed and position.
        latency: Lag of the joints' loop, from q̇ to torque. Without it, and without drives, joints
            are taken as rigid and the loop as ideal: elastic ones may diverge.
        drives: Rotors and gears of the joints, as far as they are known: what the gains begin
            with. `Drives()` says that there are none.
        friction: Friction of the joints, as far as it is known, for the default dynamics, which
            learn the rest of it.

    Raises:
        InvalidInputError: Numbers out of range or of the wrong shape, kinematics or dynamics of
            another robot, a posture for an arm without self-motion, or detours where there are
            none.
    """

    dt: float
    kinematics: Kinematics

    def __init__(
        self,
        task: Task,
        *,
        kinematics: Kinematics | None = None,
        dynamics: MotionDynamics | None = None,
        posture: Sequence[float] | Array | None = None,
        dt: float | None = None,
        gains: TrackingGains | None = None,
        command: Literal["torque", "velocity"] = "torque",
        latency: Latency | None = None,
        drives: Drives | None = None,
        friction: Friction | None = None,
    ) -> None:
        require_controllable(task)
        robot = task.robot
        require("latency", latency, Latency | None, "Latency(...) or None")
        require("command", command, str, '"torque" or "velocity"')
        if command not in ("torque", "velocity"):
            message = f'command must be "torque" or "velocity", got {command!r}'
            raise InvalidInputError(message, given=command)
        self.task, self.latency, self.command = task, latency, command
        self.dt = dt = arguments.sampling_time(dt, None, latency)
        self.kinematics = _usual_kinematics(task, dt) if kinematics is None else kinematics
        gains = TrackingGains() if gains is None else gains
        require("gains", gains, TrackingGains, "TrackingGains(...) or None")
        require("drives", drives, Drives | None, "Drives(...) or None")
        drives = None if drives is None else drives.of(robot)
        usual = _ALPHA if command == "torque" else _SERVO_ALPHA

        def stood(drives: Drives | None, slowly: bool = False) -> JointGains:
            given = gains.alpha, gains.kappa, usual, dt, latency, drives, slowly
            return JointGains.of(robot, *given)

        is_late = latency is not None and command == "torque"
        first, is_own = stood(drives), dynamics is not None
        is_heavy = is_late and is_hardly_damped(robot, first)
        if is_heavy:
            first = stood(drives, slowly=True)
        self.alpha, self.kappa = float(first.alpha.min()), first.kappa
        self._most = first.most
        self.dynamics = _learnt(robot, first, friction) if dynamics is None else dynamics
        self._require_parts()
        fast = _usual_speeds(task) if gains.speed is None else gains.speed
        self.speed = as_limits("speed", fast, task.m, unit="unit of the task/s")
        pull = TrackingGains.self_motion if gains.self_motion == "teach" else gains.self_motion
        assert not isinstance(pull, str)
        self._rest = RestConfiguration(task, posture, pull)
        limits = Limits.of(robot).for_joints(robot.nv)
        self.gain_values = {"alpha": self.alpha, "kappa": self.kappa}
        self._commands, self._added = None, np.zeros(robot.nv)
        if command == "velocity":
            self._commands, self.resting = VelocityCommand(robot, limits, self.dt), 1
            self.parameters = {"lag of the servo": "s"} | {**self.kinematics.parameters}
        else:
            self.parameters = {**self.dynamics.parameters, **self.kinematics.parameters}
            if drives is None and not (is_own and self.dynamics.rotor_inertia.any()):
                room = max(1.0, _ROOM / (self.kappa * self.dt))
                more = self.dynamics.gain_inertia(room) - self.dynamics.rotor_inertia
                self._added = np.maximum(more, 0.0)
            self.resting = self.dynamics.n_state
        self._end = self.resting + self.kinematics.n_state
        self._raised: RaisedGains | None = None
        if is_late and np.isfinite(first.most).all():
            assert latency is not None
            strong = stood(strong_drives(robot))
            gamma = None if is_own else _learnt(robot, strong, None).gamma
            added = np.maximum(self._added, strong.rotors - self.dynamics.rotor_inertia)
            own = None if gamma is None else self.dynamics.gamma  # type: ignore[attr-defined]
            self._raised = RaisedGains(
                robot, latency, self.dt,
                UsedGains(first.alpha, first.most, self._added, own),
                UsedGains(strong.alpha, strong.most, added, gamma),
            )  # fmt: skip
        last = 0 if self._commands is None else self._commands.n_state
        self._last = self._end + (last if self._raised is None else self._raised.n_state)
        # of metres and radians at once it is usually 0.05, where nothing is singular
        most = _SINGULAR_RATIO if len(set(task.units)) == 1 else law.SINGULAR_RATIO
        self._gains = law.ReferenceGains(
            # as arrays, which NumPy multiplies with in a third of the time of numbers
            np.array(self.alpha), 1.0 / self.speed, _SHARE * np.asarray(limits.velocity),
            singular_ratio(task, most), vanishing(task), _stops(task, limits),
            _shares(task, limits),
        )  # fmt: skip
        self._kappa = np.array(self.kappa)
        self._used = UsedGains(self._gains.alpha, self._most, self._added)
        self._continuous = robot.nq != robot.nv
        if command == "torque" and np.isfinite(self._most).any():
            self.rotors = first.rotors
        self._still = np.zeros(task.measured.m)
        self._eased: law.EasedTarget | None = None
        if self.rotors is not None and task.measured is task and task.subtracts:
            self._eased = law.EasedTarget(_EASE, 1.0 / self.speed, dt)
        self._led = self._last + (0 if self._eased is None else 2 * task.measured.m + 1)
        self._slow: law.SlowFeedback | None = None
        if is_heavy:
            assert latency is not None
            self._slow = slow_feedback(robot, latency, dt, first)
        self._ways = self._led + (0 if self._slow is None else robot.nv + task.m)
        self._detour: law.Detour | None = None
        if gains.detours:
            if command != "torque" or task.measured is not task or not task.subtracts:
                message = f"detours are for torques and errors x - x_d, got {command} and {task!r}"
                raise InvalidInputError(message, given=gains)
            self._detour = _detour(task, self._gains, dt)
        self._taught = self._ways + (0 if self._detour is None else self._detour.size)
        self._teaching: law.TeachingMotion | None = None
        if gains.self_motion == "teach":
            if not self.kinematics.names:
                message = f"self_motion may teach kinematics that learn, got {self.kinematics!r}"
                raise InvalidInputError(message, given=gains)
            self._teaching = _teaching(task, self._gains, dt)
        self.n_state = self._taught + (0 if self._teaching is None else 1 + robot.nv)

    def _require_parts(self) -> None:
        """Refuse kinematics or dynamics that are none, or of another robot."""
        task, of = self.task, self.kinematics
        require("kinematics", of, Kinematics, "AdaptiveKinematics(task) or None")
        wanted, names = "AdaptiveDynamics(robot) or ModelDynamics(robot)", task.robot.joint_names
        require("dynamics", self.dynamics, MotionDynamics, wanted)
        seen = of.task.robot.joint_names == names and of.task.labels == task.labels
        for name, part, fits in (
            ("kinematics", of, seen),
            ("dynamics", self.dynamics, self.dynamics.robot.joint_names == names),
        ):
            if not fits:
                message = f"{name} must be of the task {task!r}, got {part!r}"
                raise InvalidInputError(message, given=part)

    def begin(self, measurement: Measurement) -> Array:
        """Return the state before the first step.

        Raises:
            InvalidInputError: A measurement of the wrong shapes, or of mirrored corners.
        """
        if not hasattr(getattr(measurement, "q", None), "arm_of"):  # or it is of symbols
            state, x_d = np.zeros(self.n_state), np.zeros(self.task.n_x)
            q, _, x = arguments.require_arrays(state, measurement, x_d, self.task, self.n_state)
            require_as_believed(self.task, q, x)
        _, q, v, *_ = measurement
        v = np.where(np.isfinite(v), v, 0.0)
        state = np.zeros_like(q, shape=self.n_state)
        if self._commands is None:
            state[: self.resting] = self.dynamics.initial_state()
        else:
            state[self._end : self._last] = self._commands.start(q, v)
        if self._raised is not None:
            state[self._end : self._last] = self._raised.watch.start(v)
        if self._eased is not None:
            begin = self.task.value(q), self.task.jacobian(q).dot(v)
            state[self._last : self._led] = self._eased.start(*begin)
        state[self.resting : self._end] = self.kinematics.initial_state(measurement)
        return state

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        state = as_vector("state", self._own_part(state), self.n_state)
        fresh, (p, end) = self.initial_state(measurement), (self.resting, self._end)
        fresh[:p] = state[:p]
        fresh[p:end] = self.kinematics.resumed(state[p:end], measurement)
        if self._raised is not None:  # shares, and how far they may rise
            n = 2 * self.task.robot.nv
            fresh[end : end + n] = state[end : end + n]
        return fresh

    def advance(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and its output with a torque (or a velocity).

        The output's e is that of the measured x, NaN where that is lost; its Ĵ is that of the
        prediction, and its reference is q̇_r.

        Raises:
            MeasurementError: q or v not finite, or numbers that overflow.
            InvalidInputError: Wrong shapes or types, a target or state that is not finite, (cos,
                sin) pairs of continuous joints off the unit circle, or a dt that is not this
                controller's.
        """
        target = target if isinstance(target, Target) else Target(target)
        if hasattr(state, "arm_of"):  # symbols
            return self.evolve(state, measurement, target)
        if dt != self.dt:
            arguments.require_dt(dt, self.dt)
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is a named error
            target, measurement = self._checked(state, measurement, target)
            self.kinematics.check(state[self.resting : self._end], measurement, dt)
            try:
                after, answer = self.evolve(state, measurement, target)
                if math.isfinite(float(after.dot(after) + answer.torque.dot(answer.torque))):
                    return after, answer
            except (ArithmeticError, np.linalg.LinAlgError):  # what has overflowed, Ĵ too
                pass
        raise arguments.overflow(measurement)

    def evolve(
        self, state: Array, measurement: Measurement, target: Target
    ) -> tuple[Array, Evaluation]:
        """Do the work of `advance`, with checked arguments or symbols."""
        _, q, v, x, _ = measurement
        p, end, dt = self.resting, self._end, self.dt
        known = state[p:end]
        used, rates = self._used, self._gains
        after = state.copy()
        if self._raised is not None:
            after[end : self._last], used = self._raised.step(state[end : self._last], v)
            rates = rates._replace(alpha=used.alpha, alpha_dot=used.alpha_dot)
        now = self.kinematics.status(known, measurement)
        waits, is_old, aim = now == _LOST, now == _PREDICTED, target
        if self._eased is not None:
            goal_v, goal_a = (self._still if each is None else each for each in target[1:])
            goal = target.x, goal_v, goal_a
            last, led = self._last, self._led
            after[last:led], eased = self._eased.step(state[last:led], x, goal, rates.alpha, waits)
            aim = Target(*eased)
        w = None if self._slow is None else state[self._led + len(v) : self._ways]
        besides: tuple[Array, Array] | None = None
        if self._teaching is not None:
            taught, motion = state[self._taught :], positions_at(self.task.robot, q)
            J, rests = self.kinematics.predict(known, q, v, aim).J, waits | _rests(target)
            after[self._taught :], n_dot = self._teaching.step(taught, J, motion, v, rests)
            besides = taught[1:], n_dot
        J_hat, v_r, a_r, damped, is_known, w_dot, z = self._reference(
            known, q, v, aim, waits, rates, w, besides
        )
        if self._detour is not None:
            far = z + aim.x - target.x
            stands = damped & _rests(target) & self._detour.stands(far, J_hat, v, rates.alpha)
            ways = slice(self._ways, self._taught)
            after[ways], v_r, a_r = self._around(
                known, q, v, target.x, (v_r, a_r), state[ways], stands
            )
        learns = is_known | waits
        self.kinematics.correct(after[p:end], measurement, dt)
        e = self.task.error(x, target.x)
        status = law.select(is_old | law.complement(law.is_finite(e)), _PREDICTED, _OK)
        status = law.select(damped, _SINGULAR, status)
        status = law.select(waits, _LOST, law.select(is_known, status, _UNPREDICTED))
        if self._commands is not None:
            _, _, a_v, *_ = self._reference(known, q, v_r, target, waits, besides=besides)
            sends = slice(end, self._last)
            after[:1], after[sends] = self._commands.step(state[:1], state[sends], q, v_r, a_v)
            sent = after[sends][: len(v)]
            return after, Evaluation(sent, None, status, e, J_hat, None, reference=v_r)
        learnt: Any = {} if used.gamma is None else {"gamma": used.gamma}
        a_hat, motion, g = self.dynamics.step(state[:p], q, v, v_r, a_r, learns, dt, **learnt)
        after[:p] = a_hat
        sigma, M = v - v_r, self.dynamics.inertia(q)
        damped = self._kappa * (M.dot(sigma) + used.added * sigma)
        if self.rotors is not None:
            A = self.kappa * (M + np.diag(used.added))
            most = np.minimum(used.most, _RIGID)
            damped = law.bounded_damping(A, damped, most)
            if self._slow is not None and w_dot is not None:
                phi, at = state[self._led :][: len(v)], self._led + len(v)
                after[self._led : at], slow = self._slow.damping(phi, sigma, A, most)
                rests = slice(at, self._ways)
                shifted = law.select(is_known, state[rests] + dt * w_dot, state[rests])
                after[rests] = law.select(waits, 0.0 * shifted, shifted)
                damped = damped + slow
        torque = law.tracking_torque(motion, damped)
        return after, Evaluation(torque, None, status, e, J_hat, g, reference=v_r)

    def _reference(
        self,
        known: Array,
        q: Array,
        v: Array,
        target: Target,
        waits: Any = False,
        gains: law.ReferenceGains | None = None,
        w: Array | None = None,
        besides: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array, Array, Any, Any, Array | None, Array]:
        gains = self._gains if gains is None else gains
        predicted, w_dot = self.kinematics.predict(known, q, v, target), None
        if self._slow is not None and w is not None:
            w_dot = self._slow.rate(w, predicted.z, gains.alpha, gains.per_speed)
            gains = gains._replace(beside=(w, w_dot))
        null, motion = self._rest.velocity(q, v), positions_at(self.task.robot, q)
        if besides is not None:
            null = null[0] + besides[0], null[1] + besides[1]
        found = law.reference_step(predicted, v, null, waits, gains, motion)
        return predicted.J, *found, w_dot, predicted.z

    def _around(
        self, known: Array, q: Array, v: Array, x_d: Array, led: tuple[Array, Array],
        memory: Array, stands: Any,
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Return the memory of detours a period later; q̇_r and q̈_r, which are `led` without."""
        assert self._detour is not None
        (v_r, a_r), robot = led, self.task.robot
        motion = positions_at(robot, q)

        def look(place: Array) -> tuple[Array, Array]:
            there = moved(robot, q, place - motion)
            error = self.kinematics.predict(known, there, 0.0 * v, Target(x_d))
            return error.z, error.J

        after, h, h_dot, speed = self._detour.step(memory, stands, motion, x_d, look)
        away = speed - v_r
        return after, v_r + h * away, a_r - h * a_r + h_dot * away

    def _checked(
        self, state: Array, measurement: Measurement, target: Target
    ) -> tuple[Target, Measurement]:
        task, x_d = self.task, target.x
        target = arguments.with_rates(target, task.measured.m)
        q, v, x = arguments.require_arrays(state, measurement, x_d, task, self.n_state)
        largest = math.hypot(*q.tolist(), *v.tolist(), *x_d.tolist())
        if not (largest < arguments.HUGE and state.dot(state) < arguments.HUGE):
            arguments.require_finite(q, v, x_d, state, task)
        if not x.dot(x) < arguments.HUGE:  # lost, or beyond what can be learnt from
            measurement = measurement._replace(x=np.where(x * x < arguments.HUGE, x, math.nan))
        if self._continuous:
            task.robot.configuration(q)
        if not task.subtracts:
            task.target(x_d)
        return target, measurement

    def learnt(self, state: Array) -> Array:
        """Return the learnt numbers of dynamics and kinematics, shape (…, p)."""
        known = self.kinematics.learnt(state[..., self.resting : self._end])
        return np.concatenate([state[..., : self.resting], known], axis=-1)

    def learnt_sd(self, state: Array) -> Array:
        """Return the standard deviations of `learnt`, NaN for the dynamics, shape (p,)."""
        kinematics, known = self.kinematics_of(state)
        return np.concatenate([np.full(self.resting, np.nan), kinematics.sd_of(known)])

    def kinematics_of(self, state: Array) -> tuple[Kinematics, Array]:
        state = as_vector("state", self._own_part(state), self.n_state)
        return self.kinematics, state[self.resting : self._end]

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, such as that of another believed robot.

        Raises:
            InvalidInputError: Its kinematics or dynamics were given, for the old task.
        """
        for name in ("kinematics", "dynamics"):
            if self._arguments[name] is not None:
                raise InvalidInputError(
                    f"{name} must be left to the controller for its belief to be changed, got "
                    f"{self._arguments[name]!r}",
                    given=self,
                )
        return self._rebuilt(task=task)

    # -- what limits of torques need to know ----------------------------------------------------

    def is_proven(self, answer: Evaluation) -> bool:
        """Return True: V̇₂ is always known, because the kinematics do not enter it."""
        return True

    def damping_rate(self, inertias: Array) -> float:
        """Return the rate of joint damping by κ(M̂ + F) [1/s]."""
        return self.kappa * (1.0 + max_damping_rate(inertias, self._added))

    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        return Dynamics(self.dynamics.robot), True

    def gravity_torque(self, state: Array, q: Array) -> Array:
        return self.dynamics.gravity(state[: self.resting], q)

    def describe(self) -> list[str]:
        kinds = [spaced(type(part).__name__) for part in (self.kinematics, self.dynamics)]
        parts = " and ".join(kinds).replace("adaptive", "learnt").replace("model", "known")
        alpha = f"{self.alpha:.4g}"
        if self._raised is not None:
            alpha += f" at first, up to {(self._raised.low.alpha + self._raised.alpha).min():.4g}"
        first = f"tracking law, alpha {alpha}, kappa {self.kappa:.4g}; {parts}"
        most = ", ".join(f"{each:.3g}" for each in self._most)
        late = "no lag" if self.latency is None else f"a lag of {self.latency.of_velocity:.2g} s"
        joints = f"rigid joints and {late} taken for granted"
        if self.rotors is not None:
            raised = "" if self._raised is None else "; initial; raised until a joint oscillates"
            joints = f"damping at most {most} N m s/rad, for motors behind elastic gears{raised}"
        first += f"; {joints}" if self.command == "torque" else ""
        return [first, super().describe()[1]]

    def describe_learnt(self, state: Array) -> str:
        """Describe the damping that was raised until joints swing; "" if it is constant."""
        if self._raised is None:
            return ""
        used = self._raised.used(self._own_part(state)[self._end : self._last])
        most = ", ".join(f"{each:.3g}" for each in used.most)
        return f"joint damping is at most {most} N m s/rad, alpha is {used.alpha:.3g} 1/s"

    def __repr__(self) -> str:
        parts = f"{self.task!r}, {self.kinematics!r}, {self.dynamics!r}"
        return f"TrackingController({parts}, alpha={self.alpha:g}, kappa={self.kappa:g})"


class RestConfiguration:
    """n₀ = −k_n s(q ⊖ q_rest), no faster than 0.5 rad/s, and its derivative.

    For continuous joints the sine of the angle replaces the angle, so that n₀ does not jump half a
    turn away. By default joints that turn less than once, or slide less than 2 m, are pulled back
    from the last 5 % of their ranges only: to pull all to their middles costs torque and meets more
    stops than it avoids.
    """

    def __init__(self, task: Task, q: Sequence[float] | Array | None, rate: float) -> None:
        robot = task.robot
        if q is not None:
            require_redundant(q, task)
        # as arrays, which NumPy multiplies with in a third of the time of numbers
        self._pull, self._share = np.full(robot.nv, -rate), np.array(rate / _SELF_MOTION)
        self._is_vector = robot.nq == robot.nv
        joints = robot._joints.values()
        self._continuous = np.array([joint.nq > joint.nv for joint in joints])
        self._first = np.array([joint.idx_q for joint in joints])  # the cosine of (cos, sin)
        self._second = self._first + self._continuous
        self._none = np.zeros(robot.nv) if robot.nv <= task.m or rate == 0.0 else None
        self._free: Array | None = None
        if q is None:
            lower, upper = robot.usual_range
            whole = np.where(np.array(robot.joint_units) == "m", 2.0, 2.0 * np.pi)
            self._pull[upper - lower > _WHOLE * whole] = 0.0
            self._free = _FREE * (upper - lower)
            self._at_ease = self._pull * 0.0  # of joints that nothing pulls back
            self.q = robot.configuration(0.5 * (lower + upper))
            return
        self.q = as_array("posture", robot.configuration(q, "posture"), (robot.nq,))
        robot.require_radians("posture", self.q)

    def velocity(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return n₀ and its derivative at q (nq,) and q̇ (n_v,)."""
        if self._none is not None:
            return self._none, self._none
        if self._is_vector:
            away, rate = q - self.q, v
        else:
            a, b = q.take(self._first), q.take(self._second)
            c, s = self.q.take(self._first), self.q.take(self._second)
            away = np.where(self._continuous, b * c - a * s, a - c)
            rate = np.where(self._continuous, a * c + b * s, 1.0) * v
        if self._free is not None:
            within = np.minimum(np.maximum(away, -self._free), self._free)
            if law.surely(law.all_equal(within, away)):
                return self._at_ease, self._at_ease
            away, rate = away - within, np.where(within == away, 0.0, rate)
        s, s_dot = law.saturated(away, rate, self._share)
        return self._pull * s, self._pull * s_dot


class VelocityCommand:
    """The allowed joint velocity nearest to q̇_r + L̂w, with a learnt servo lag L̂.

    w = ∂q̇_r/∂t + Dq̇_r with D = ∂q̇_r/∂q is the q̈_r = w + Dσ of joints that follow exactly (σ = 0).
    It has no noise of q̇, which in both q̈_r and σ would make L̂ grow. V₃ of `law.servo_lag_rate`
    falls with D near −αĴ⁺Ĵ for a lag below 1/α. A delay acts as lag, without a proof. σ is a mean
    over the last period: how fast q went, less the mean of q̇_r at both of its ends. By q̇ itself an
    ideal servo would seem late by a period, and q is late by half of that, as commands are held.

    Its memory are the last command, q and q̇_r.

    Before, q̇_r is scaled as a whole to the speed limits (`law.within_speeds`). Joints near their
    position limits are slowed down one by one, and commands change by at most `sure_deceleration`,
    or full speed in 0.1 s if that is less. While a command is limited, L̂ does not change.
    """

    def __init__(self, robot: Robot, limits: Limits, dt: float) -> None:
        sure = sure_deceleration(robot, np.asarray(limits.effort))
        self.acceleration = np.minimum(sure, np.asarray(limits.velocity) / _SOONEST)
        self._joints = law.JointRange.of(
            limits.position, limits.velocity, _APPROACH, self.acceleration
        )
        self._robot, self._dt, self._change = robot, dt, dt * self.acceleration
        self.n_state = 2 * robot.nv + robot.nq

    def start(self, q: Array, v: Array) -> Array:
        """Return the memory before the first step, as if q̇ had been so for a period."""
        return np.concatenate([v, moved(self._robot, q, -self._dt * v), v])

    def step(
        self, state: Array, memory: Array, q: Array, v_r: Array, w: Array
    ) -> tuple[Array, Array]:
        """Return the next L̂ [s], shape (1,), and memory; w is q̈_r at q̇ = q̇_r."""
        before, q_before, v_r_before = np.split(memory, (len(v_r), len(v_r) + len(q)))
        wanted = v_r + state[0] * w
        low, high = self._joints.speed_bounds(positions_at(self._robot, q))
        sent = np.minimum(np.maximum(wanted, low), high)
        sent = np.minimum(np.maximum(sent, before - self._change), before + self._change)
        went = motion_between(self._robot, q_before, q) / self._dt
        lag = state + self._dt * law.servo_lag_rate(_LAG_GAIN, w, went - 0.5 * (v_r_before + v_r))
        lag = np.minimum(np.maximum(lag, 0.0), _LONGEST_LAG)
        lag = law.select(law.all_equal(sent, wanted), lag, state)
        return lag, np.concatenate([sent, q, v_r])


def _learnt(robot: Robot, gains: JointGains, friction: Friction | None) -> AdaptiveDynamics:
    """Return dynamics that are learnt as fast as motors stand."""
    return AdaptiveDynamics(
        robot,
        rotor_inertia=gains.rotors,
        fastest=gains.fastest,
        most_damping=gains.most if np.isfinite(gains.most).any() else None,
        integral=gains.integral,
        friction=friction,
    )


def _stops(task: Task, limits: Limits) -> law.StopZones | None:
    if task.robot.nv <= task.m:  # no other joints can do it
        return None
    low, high = np.clip(np.array(limits.position), -_NO_END, _NO_END)
    slow = np.minimum(_SLOW * np.asarray(limits.velocity), _SLOW)
    return law.StopZones.of(low, high, np.minimum(_ZONE * (high - low), _WIDEST), slow)


def _detour(task: Task, gains: law.ReferenceGains, dt: float) -> law.Detour:
    """Return detours within the joints' ranges, whose searches begin at the points of Roberts.

    Each point is x⁻¹, x⁻², … further than the last, with x^(n_v + 1) = x + 1: M. Roberts, "The
    unreasonable effectiveness of quasirandom sequences", 2018.
    """
    robot = task.robot
    turns = np.array([joint.nq > joint.nv for joint in robot._joints.values()], dtype=np.float64)
    low, high = robot.usual_range
    inside = (1.0 - turns) * np.minimum(_INSIDE * (high - low), _FARTHEST)
    roots = np.roots([1.0, *[0.0] * (robot.nv - 1), -1.0, -1.0])
    spread = roots.real.max() ** -np.arange(1.0, robot.nv + 1.0)
    fastest = np.where(np.isfinite(gains.fastest), gains.fastest, _UNTOLD)
    rest = fastest, np.broadcast_to(gains.per_speed, (task.m,)), gains.singular_ratio, dt
    return law.Detour(low + inside, high - inside, turns, spread, *rest)


def _rests(target: Target) -> Any:
    moves = [each for each in target[1:] if each is not None]
    return law.all_of(np.concatenate([np.zeros(1), *moves]) == 0.0)


def _teaching(task: Task, gains: law.ReferenceGains, dt: float) -> law.TeachingMotion:
    require_redundant("teach", task)
    assert gains.stops is not None
    n = task.robot.nv
    omega, phase = (x.astype(np.float64) for x in (np.geomspace(*_SINES, n), _APART * np.arange(n)))
    bounds = gains.fastest, gains.singular_ratio
    return law.TeachingMotion(_TEACHES, omega, phase, gains.stops, *bounds, dt)


def _shares(task: Task, limits: Limits) -> Array | None:
    """Return shares by speed limits where some joints slide, as Ĵ⁺ alone would add m² to rad²."""
    fastest = np.asarray(limits.velocity)
    if len(set(task.robot.joint_units)) == 1 or not np.isfinite(fastest).all():
        return None
    return np.asarray(fastest / fastest.max())


def _usual_kinematics(task: Task, dt: float) -> Kinematics:
    parts = task.tasks if isinstance(task, StackedTask) else (task,)
    if isinstance(task, PoseTask) or all(isinstance(part, PositionTask) for part in parts):
        return AdaptiveKinematics(task, unknown=("tool", "origins", "axes"), dt=dt)
    if isinstance(task, ImageTask):
        planar = isinstance(task.camera, PlanarCamera)
        return AdaptiveKinematics(task, dt=dt) if planar else AdaptiveCamera(task, dt=dt)
    raise InvalidInputError(
        f"kinematics must be given for {task!r}, as defaults are for positions, poses and images; "
        "KnownKinematics(task) takes the believed arm as true",
        given=task,
    )


def _usual_speeds(task: Task) -> list[float]:
    known = {} if isinstance(task, ImageTask) else _SPEEDS  # of a sensor's metres nothing is
    if set(task.units) <= set(known):
        return [known[unit] for unit in task.units]
    rows = [np.linalg.norm(task.jacobian(q), axis=1) for q in seen_configurations(task, 20)]
    usual = _TURN * np.median(rows, axis=0)
    return [known.get(unit, value) for unit, value in zip(task.units, usual, strict=True)]
