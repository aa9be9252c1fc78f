"""`TrackingController`: follow what kinematics predict, with dynamics that learn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

import numpy as np

from approxjac import law
from approxjac.controllers.adaptive_dynamics import AdaptiveDynamics, MotionDynamics
from approxjac.controllers.arguments import (
    FLOAT64,
    HUGE,
    overflow,
    require_arrays,
    require_dt,
    require_finite,
    require_state,
    with_rates,
)
from approxjac.controllers.controller import Controller
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.controllers.learning.tracking_defaults import usual_kinematics, usual_speeds
from approxjac.controllers.limits.limits import Limits
from approxjac.controllers.pseudoinverse import singular_ratio
from approxjac.controllers.rest_configuration import RestConfiguration
from approxjac.controllers.velocity_command import VelocityCommand
from approxjac.errors import InvalidInputError
from approxjac.formatting import spaced
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task
from approxjac.tasks.analysis import require_as_believed, require_controllable, vanishing
from approxjac.validation import Array, Immutable, as_limits, as_number, require

_OK, _SINGULAR = Status.OK, Status.NEAR_SINGULAR  # members of an enum are slow to look up
_PREDICTED, _UNPREDICTED, _LOST = Status.PREDICTED, Status.NOT_PREDICTED, Status.MEASUREMENT_LOST
_KAPPA = 60.0  # [1/s]
_STEADY = 0.25  # κ dt at most
_ROOM = 0.5  # κ dt λ_max(M⁻¹M̂) at most
_QUICK = 2.0  # times κ, how fast a parameter may learn
_SINGULAR_RATIO = 0.08  # of σ_max, below which Ĵ⁺ is damped
_SHARE = 0.9  # of the speed limits of joints


class TrackingController(Immutable, Controller):
    """Follow a target with a predicted error, learnt kinematics and learnt dynamics.

    It is the tracking law, adaptive, after Slotine and Li.

    τ = Y_d(q, q̇, q̇_r, q̈_r) â − κM̂σ with σ = q̇ − q̇_r, where the reference velocity

        q̇_r = Ĵ⁺(u − Ĵn₀) + n₀,   u = ẋ_d − αs(z),   n₀ = −k_n s(q ⊖ q_rest)

    leads the predicted error z to zero and q̈_r is its exact derivative. The measured x only
    teaches the kinematics; where it is lost, control goes on with what is predicted. Kinematics
    that learn hold the joints still until x was seen once: q̇_r = 0, `MEASUREMENT_LOST`.

    Its state is that of the dynamics, followed by that of the kinematics and, of velocity commands,
    the command before.

    Immutable, but it owns scratch memory: one instance a thread.

    Args:
        task: The task of the believed robot.
        kinematics: What predicts z, for the same dt. By default, for positions and poses,
            `AdaptiveKinematics` of tool and joint origins; `KnownKinematics` takes the believed
            arm's own for true.
        dynamics: What the torque of a motion comes from; `AdaptiveDynamics` of the believed robot
            by default, or `ModelDynamics`.
        posture: Configuration that the self-motion of a redundant arm is drawn to, shape (nq,); by
            default the middle of the ranges of joints that turn less than once, others nowhere.
        speed: How fast an error is reduced at most, a number or one for each coordinate, shape (m,)
            [unit of the task/s]. By default 0.5 m/s and 1 rad/s, and of other units what half a
            rad/s of the joints makes.
        dt: Sampling time [s].
        alpha: α, how fast small errors are reduced > 0 [1/s].
        kappa: κ, how fast the joints follow their reference > 0 [1/s]. By default 60, or 0.25/dt
            where that is less.
        self_motion: k_n [1/s].
        command: "torque", or "velocity" for a robot that takes joint velocities: then q̇_r is the
            command, ahead of the lag of the robot's servo, which is learnt in place of the
            dynamics, and within the URDF's limits of speed and position.
        acceleration: Largest change of a velocity command, a number or shape (n_v,) [rad/s² or
            m/s²]; by default what the motors of the believed arm surely have, up to full speed in
            0.1 s.

    Raises:
        InvalidInputError: Numbers out of range or of the wrong shape, kinematics or dynamics of
            another robot, or a posture for an arm without self-motion.
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
        speed: float | Sequence[float] | Array | None = None,
        dt: float = 1e-3,
        alpha: float = 4.0,
        kappa: float | None = None,
        self_motion: float = 1.0,
        command: Literal["torque", "velocity"] = "torque",
        acceleration: float | Sequence[float] | Array | None = None,
    ) -> None:
        self._remember(locals())
        require_controllable(task)
        robot = task.robot
        self.task = task
        self.dt = dt = as_number("dt", dt, unit="s", above=0.0)
        self.kinematics = usual_kinematics(task, dt) if kinematics is None else kinematics
        self.alpha = as_number("alpha", alpha, unit="1/s", above=0.0)
        usual = min(_KAPPA, _STEADY / self.dt)
        self.kappa = usual if kappa is None else as_number("kappa", kappa, unit="1/s", above=0.0)
        if dynamics is None:
            dynamics = AdaptiveDynamics(robot, fastest=_QUICK * self.kappa)
        self.dynamics = dynamics
        self._require_parts()
        fast = usual_speeds(task) if speed is None else speed
        self.speed = as_limits("speed", fast, task.m, unit="unit of the task/s")
        self.self_motion = as_number("self_motion", self_motion, unit="1/s", minimum=0.0)
        self._rest = RestConfiguration(task, posture, self.self_motion)
        require("command", command, str, '"torque" or "velocity"')
        if command not in ("torque", "velocity"):
            raise InvalidInputError(
                f'command must be "torque" or "velocity", got {command!r}', given=command
            )
        self.command = command
        limits = Limits.of(robot).for_joints(robot.nv)
        self._fastest = _SHARE * np.asarray(limits.velocity)
        self._commands = None
        if command == "velocity":
            self._commands = VelocityCommand(robot, limits, acceleration, self.dt)
        elif acceleration is not None:
            raise InvalidInputError(
                f'acceleration must be None without command="velocity", got {acceleration!r}',
                given=acceleration,
            )
        room = max(1.0, _ROOM / (self.kappa * self.dt))
        self._added = np.zeros(robot.nv)
        self._n_dynamics = 1  # the lag of a servo
        if self._commands is None:
            self._added = self.dynamics.gain_inertia(room)
            self._n_dynamics = self.dynamics.n_state
        self._end = self._n_dynamics + self.kinematics.n_state
        self.n_state = n_state = self._end + (0 if self._commands is None else robot.nv)
        # of q, v, x, target and state
        self._shapes = (robot.nq,), (robot.nv,), (task.n_x,), (task.n_x,), (n_state,)
        # of metres and radians at once it is usually 0.05, where nothing is singular
        most = _SINGULAR_RATIO if len(set(task.units)) == 1 else law.SINGULAR_RATIO
        self._ratio, self._scale = singular_ratio(task, most), vanishing(task)
        self._continuous = robot.nq != robot.nv
        # as arrays, which NumPy multiplies with in a third of the time of numbers
        self._alpha, self._k = np.array(self.alpha), self.alpha / self.speed

    def _require_parts(self) -> None:
        """Refuse kinematics or dynamics that are none, or of another robot."""
        task = self.task
        require("kinematics", self.kinematics, Kinematics, "AdaptiveKinematics(task) or None")
        wanted = "AdaptiveDynamics(robot), ModelDynamics(robot) or None"
        require("dynamics", self.dynamics, MotionDynamics, wanted)
        told = self.kinematics.task
        if told.robot.joint_names != task.robot.joint_names or told.labels != task.labels:
            raise InvalidInputError(
                f"kinematics must be of the task {task!r}, got {self.kinematics!r}",
                given=self.kinematics,
            )
        if self.dynamics.robot.joint_names != task.robot.joint_names:
            raise InvalidInputError(
                f"dynamics must be of a robot with the joints of {task.robot.name}, got "
                f"{self.dynamics!r}",
                given=self.dynamics,
            )

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step.

        Raises:
            InvalidInputError: A measurement of the wrong shapes, or of mirrored corners.
        """
        if not hasattr(getattr(measurement, "q", None), "arm_of"):  # or it is of symbols
            state, x_d = np.zeros(self.n_state), np.zeros(self.task.n_x)
            q, _, x = require_arrays(state, measurement, x_d, self.task, self.n_state)
            require_as_believed(self.task, q, x)
        _, q, v, *_ = measurement
        state = np.zeros_like(q, shape=self.n_state)
        if self._commands is None:
            state[: self._n_dynamics] = self.dynamics.initial_state()
        else:
            state[self._end :] = np.where(np.isfinite(v), v, 0.0)
        state[self._n_dynamics : self._end] = self.kinematics.initial_state(measurement)
        return state

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return a state before a first step that knows what another state (…) has learnt.

        Such as the last one of a run before, for `simulate(state=...)`; of the same controller.

        Raises:
            InvalidInputError: A state of another controller, or a measurement of the wrong shapes.
        """
        state = require_state(state, self.n_state)
        fresh, (p, end) = self.initial_state(measurement), (self._n_dynamics, self._end)
        fresh[:p] = state[:p]
        fresh[p:end] = self.kinematics.resumed(state[p:end], measurement)
        return fresh

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and a torque (or a velocity) for it.

        The answer's e is that of the measured x, NaN where that is lost; its Ĵ is that of the
        prediction, and its reference q̇_r.

        Raises:
            MeasurementError: q or v not finite, or numbers that overflow.
            InvalidInputError: Wrong shapes or types, a target or state that is not finite, (cos,
                sin) pairs of continuous joints off the unit circle, or another dt than the one that
                this controller is for.
        """
        if hasattr(state, "arm_of"):  # symbols
            return self.evolve(
                state, measurement, target if isinstance(target, Target) else Target(target)
            )
        if dt != self.dt:
            require_dt(dt, self.dt)
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is a named error
            target, measurement = self._checked(state, measurement, target)
            self.kinematics.check(state[self._n_dynamics : self._end], measurement, dt)
            try:
                after, answer = self.evolve(state, measurement, target)
                if math.isfinite(float(after.dot(after) + answer.torque.dot(answer.torque))):
                    return after, answer
            except (ArithmeticError, np.linalg.LinAlgError):  # what has overflowed, Ĵ too
                pass
        raise overflow(measurement)

    def evolve(
        self, state: Array, measurement: Measurement, target: Target
    ) -> tuple[Array, Evaluation]:
        """Return what `step` does of arguments that are checked, or are symbols."""
        _, q, v, x, _ = measurement
        p, end, dt = self._n_dynamics, self._end, self.dt
        known = state[p:end]
        now = self.kinematics.status(known, measurement)
        waits = now is _LOST if isinstance(now, Status) else now == float(_LOST)
        J_hat, v_r, a_r, damped, is_known = self._reference(known, q, v, target, waits)
        after, learns = state.copy(), is_known | waits
        self.kinematics.correct(after[p:end], measurement, dt)
        e = self.task.error(x, target.x)
        is_old = now is _PREDICTED if isinstance(now, Status) else now == float(_PREDICTED)
        status = law.select(is_old | law.complement(law.is_finite(e)), _PREDICTED, _OK)
        status = law.select(damped, _SINGULAR, status)
        status = law.select(waits, _LOST, law.select(is_known, status, _UNPREDICTED))
        if self._commands is not None:
            _, _, w, _, _ = self._reference(known, q, v_r, target, waits)
            lag, sent = self._commands.step(state[:1], q, v, v_r, w, state[end:])
            after[:1], after[end:] = lag, sent
            return after, Evaluation(sent, None, status, e, J_hat, None, reference=v_r)
        a_hat, motion, g = self.dynamics.step(state[:p], q, v, v_r, a_r, learns, dt)
        after[:p] = a_hat
        sigma = v - v_r
        M_sigma = self.dynamics.momentum(q, sigma) + self._added * sigma
        torque = law.tracking_torque(motion, self.kappa, M_sigma)
        return after, Evaluation(torque, None, status, e, J_hat, g, reference=v_r)

    def _reference(
        self, known: Array, q: Array, v: Array, target: Target, waits: Any = False
    ) -> tuple[Array, Array, Array, Any, Any]:
        """Return Ĵ and what `law.reference_step` does."""
        predicted = self.kinematics.predict(known, q, v, target)
        null = self._rest.velocity(q, v)
        return predicted.J, *law.reference_step(
            *predicted, v, *null, waits, self._alpha, self._k, self._fastest,
            self._ratio, self._scale,
        )  # fmt: skip

    def _checked(
        self, state: Array, measurement: Measurement, target: Target | Array
    ) -> tuple[Target, Measurement]:
        """Return a target and a measurement that the law can be evaluated with, or refuse."""
        task = self.task
        target = with_rates(
            target if isinstance(target, Target) else Target(target), task._measured.m
        )
        x_d = target.x
        try:
            _, q, v, x, _ = measurement
            usual = (
                (q.shape, v.shape, x.shape, x_d.shape, state.shape) == self._shapes
                and q.dtype is v.dtype is x.dtype is x_d.dtype is state.dtype is FLOAT64
                and type(q) is type(v) is type(x) is type(x_d) is type(state) is np.ndarray
            )
        except (TypeError, ValueError, AttributeError):
            usual = False
        if not usual:
            q, v, x = require_arrays(state, measurement, x_d, task, self.n_state)
        largest = math.hypot(*q.tolist(), *v.tolist(), *x_d.tolist())
        if not (largest < HUGE and state.dot(state) < HUGE):
            require_finite(q, v, x_d, state, task)
        if not x.dot(x) < HUGE:  # lost, or beyond what can be learnt from
            measurement = measurement._replace(x=np.where(x * x < HUGE, x, math.nan))
        if self._continuous:
            task.robot.configuration(q)
        if not task._subtracts:
            task.target(x_d)
        return target, measurement

    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt, shape (…, p).

        First the parameters of the dynamics, then what the kinematics have learnt.
        """
        known = self.kinematics.learnt(state[..., self._n_dynamics : self._end])
        return np.concatenate([state[..., : self._n_dynamics], known], axis=-1)

    @property
    def gain_values(self) -> dict[str, Any]:
        """α and κ."""
        return {"alpha": self.alpha, "kappa": self.kappa}

    @property
    def parameters(self) -> Mapping[str, str]:  # type: ignore[override]
        """Names and units of what is learnt: of the dynamics or the servo, of the kinematics."""
        lag = self._commands is not None
        of_motion = {"lag of the servo": "s"} if lag else self.dynamics.parameters
        return {**of_motion, **self.kinematics.parameters}

    def learnt_sd(self, state: Array) -> Array:
        """Return the standard deviations of what was learnt, NaN of the dynamics, shape (p,)."""
        known = self.kinematics.sd_of(self._of_kinematics(state))
        return np.concatenate([np.full(self._n_dynamics, np.nan), known])

    def _of_kinematics(self, state: Array) -> Array:
        """Return the kinematics' part of a state, or refuse one of another controller."""
        return require_state(state, self.n_state)[self._n_dynamics : self._end]

    def kinematics_learnt(self, state: Array) -> KinematicReport:
        """Return what a state has learnt of the kinematics.

        Raises:
            InvalidInputError: Kinematics that learn nothing, or a state of another controller.
        """
        return self.kinematics.report(self._of_kinematics(state))

    def learnt_robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and joint origins.

        Masses, friction and the tracker are not in it; a state that is saved has them all.

        Raises:
            InvalidInputError: Kinematics that learn nothing, or a state of another controller.
        """
        return self.kinematics.robot(self._of_kinematics(state))

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, such as that of another believed robot.

        Raises:
            InvalidInputError: Its kinematics or dynamics were given, which are of the task before.
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

    @property
    def resting(self) -> int:
        """Numbers of the state, those of the dynamics, that rest while limits give the proof up."""
        return self._n_dynamics

    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return σ: the joint velocity less the answer's reference q̇_r, as it is given here."""
        return v

    def is_proven(self, answer: Evaluation) -> bool:
        """Return whether V̇₂ is known: always, as the kinematics do not enter."""
        return True

    def resolved_alpha(self, alpha: float | None) -> float:
        """Return α of y, which is in σ."""
        if alpha is not None:
            raise InvalidInputError(
                f"cross_weight must be None for a TrackingController, whose y is σ, got {alpha!r}",
                given=alpha,
            )
        return self.alpha

    def damping_rate(self, inertias: Array) -> float:
        """Return κ [1/s]."""
        return self.kappa

    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        """Return those of the believed robot, with its own gravity."""
        return Dynamics(self.dynamics.robot), True

    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the gravity torque that this law compensates, shape (n_v,) [N m or N]."""
        return self.dynamics.gravity(state[: self._n_dynamics], q)

    def describe(self) -> list[str]:
        """Return the law and what it learns in a line, its task, and where it is drawn to."""
        kinds = [spaced(type(part).__name__) for part in (self.kinematics, self.dynamics)]
        parts = " and ".join(kinds).replace("adaptive", "learnt").replace("model", "known")
        first = f"tracking law T, alpha {self.alpha:.4g}, kappa {self.kappa:.4g}; {parts}"
        drawn = self._rest.words()
        return [first, super().describe()[1], *([drawn] if drawn else [])]

    def __repr__(self) -> str:
        parts = f"{self.task!r}, {self.kinematics!r}, {self.dynamics!r}"
        return f"TrackingController({parts}, alpha={self.alpha:g}, kappa={self.kappa:g})"
