"""`OperationalSpace`: the loop that most would write first, with integral action and a posture."""

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac.controllers import Controller

DAMPED = 1e-3  # share of λ_max[ĴM̂⁻¹Ĵᵀ] that is added to it before it is inverted


class OperationalSpace(Controller):
    """Operational-space control with integral action and a posture spring.

    F* = −2ω(Ĵq̇ − ν) − (ω²/T) ∫e dt,   ν = ẋ_d − ½ω e, the latter of at most V,
    τ = ĴᵀΛ̂F* + N̂ᵀM̂(−ω_n²(q − q_p) − 2ω_n q̇) + Ĉ(q, q̇)q̇ + ĝ(q)

    with Λ̂ = (ĴM̂⁻¹Ĵᵀ)⁻¹, N̂ = I − M̂⁻¹ĴᵀΛ̂Ĵ and ω_n = ½ω, after O. Khatib, "A unified approach for
    motion and force control of robot manipulators: the operational space formulation" (IEEE Journal
    on Robotics and Automation 3(1), 1987), whose limit of the wanted velocity is V. All models are
    the believed arm's. The integral rests while that limit acts or a motor is at its limit, the
    usual cure for wind-up, and while x is lost.

    Args:
        task: The task of the believed robot.
        frequency: ω > 0 [1/s]; the pole without integral is double, at −ω.
        integral_time: T > 1/(2ω) [s].
        speed: V > 0 [unit of the task/s].
        posture: q_p, shape (n_q,).
        motors: Torques that the motors deliver, shape (n_v,) [N m or N].
    """

    task = None  # set below: the protocol has a property

    def __init__(self, task, frequency, integral_time, speed, posture, motors):
        self.task, self.posture, self.motors = task, posture, motors
        self.frequency, self.integral_time, self.speed = frequency, integral_time, speed
        self.dynamics = aj.robots.Dynamics(task.robot)

    def begin(self, measurement):
        """Return the integral of e before the first step."""
        return np.zeros(self.task.m)

    def evaluate(self, state, measurement, target):
        """Return the torque for one measurement, and the rate of the integral."""
        _, q, v, x, _ = measurement
        v_d = 0.0
        if isinstance(target, aj.Target):
            target, v_d = target.x, 0.0 if target.v is None else target.v
        e, J = self.task.error(x, target), self.task.jacobian(q, x)
        lost = not np.isfinite(e).all()
        e = np.zeros(self.task.m) if lost else e
        w, M, robot = self.frequency, self.dynamics.M(q), self.task.robot
        reference = -0.5 * w * e
        share = min(1.0, self.speed / max(np.linalg.norm(reference), 1e-12))
        command = -2.0 * w * (J @ v - v_d - share * reference) - w**2 / self.integral_time * state
        mobility = J @ np.linalg.solve(M, J.T)
        floor = DAMPED * np.linalg.norm(mobility, 2) * np.eye(len(e))
        inertia = np.linalg.inv(mobility + floor)
        away = pin.difference(robot.model, self.posture, q)
        pull = -((0.5 * w) ** 2) * away - w * v  # as an acceleration
        # NᵀM̂ pull + ĴᵀΛ̂F*
        force = inertia @ (command - J @ pull)
        torque = M @ pull + J.T @ force + self.dynamics.inverse(q, v, np.zeros(robot.nv))
        rests = lost or share < 1.0 or (np.abs(torque) > self.motors).any()
        rate = np.zeros_like(e) if rests else e
        status = aj.Status.MEASUREMENT_LOST if lost else aj.Status.OK
        return aj.Evaluation(torque, rate, status, e, J)
