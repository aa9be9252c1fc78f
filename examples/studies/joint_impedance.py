"""`JointImpedance`: inverse kinematics of a model, then a spring and a damper at each joint."""

import math

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac.controllers import Controller
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.stability.loop.configurations import inverse_kinematics

FREQUENCY, SHARE = 12.0, 0.5  # 1/s of a double pole; of the speed limits on the way


class JointImpedance(Controller):
    """τ = ĝ(q) + K(q_r − q) − D(q̇ − q̇_r), with K = ω²M̄, D = 2ωM̄ and M̄ the usual M̂_ii.

    q_r goes from the start to the q_d that inverse kinematics of the model find, within the joint
    limits if they can, by half a cosine at no more than half of the speed limits. What the model
    does not know stays as an error: x is not fed back.

    Args:
        built: The scenario, of which the start, the target and the task are taken.
        robot: The arm of the model.
    """

    task = None  # set below: the protocol has a property

    def __init__(self, built, robot):
        self.task = task = built.law.task.on(robot)
        self.start, self.dynamics = built.q0, aj.robots.Dynamics(robot)
        target = built.target
        for within in (True, False):
            goal = inverse_kinematics(task, target, built.q0, within_limits=within)
            if goal is not None:
                break
        self.goal = built.q0 if goal is None else goal
        self.way = pin.difference(robot.model, built.q0, self.goal)
        speed = SHARE * robot.velocity_limits
        self.duration = max(1.0, 0.5 * math.pi * float((np.abs(self.way) / speed).max()))
        self.inertia = sample_configurations(task).joint_inertia

    def evaluate(self, state, measurement, target):
        """Return the torque for one measurement."""
        t, q, v, x, _ = measurement
        e, model = self.task.error(x, target), self.task.robot.model
        phase = math.pi * min(t / self.duration, 1.0)
        wanted = pin.integrate(model, self.start, 0.5 * (1.0 - math.cos(phase)) * self.way)
        rate = 0.5 * math.pi / self.duration * math.sin(phase) * self.way
        away = pin.difference(model, wanted, q)
        spring = FREQUENCY**2 * away + 2.0 * FREQUENCY * (v - rate)
        torque = self.dynamics.g(q) - self.inertia * spring
        return aj.Evaluation(torque, np.zeros(0), aj.Status.OK, e, None)
