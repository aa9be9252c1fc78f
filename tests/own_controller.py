"""Controllers of one's own, for tests to derive from and to judge."""

import numpy as np

import approxjac as aj
from approxjac.robots import Dynamics


class OwnController(aj.Controller):
    """A controller of a task without a state; derive from it to write `evaluate`."""


class TaskSpacePD(aj.Controller):
    """In continuous time: a spring and a damper in task space, with the believed gravity."""

    def __init__(self, task, kp=200.0, kd=40.0, damping=2.0):
        super().__init__(task)
        self.kp, self.kd, self.damping = kp, kd, damping
        self._dynamics = Dynamics(task.robot)

    def evaluate(self, state, measurement, target):
        _, q, v, x, _ = measurement
        e, J_hat = self.task.error(x, target), self.task.jacobian(q, x)
        g = self._dynamics.g(q).copy()
        torque = g - J_hat.T @ (self.kp * e + self.kd * J_hat @ v) - self.damping * v
        return aj.Evaluation(torque, np.zeros(0), aj.Status.OK, e, J_hat, g)

    def lyapunov(self, at):
        return 0.5 * at.v @ at.M @ at.v + 0.5 * self.kp * at.e @ at.e


class WindingUpNot(aj.Controller):
    """In samples: PD with integral action on the task force, whose integral has an end."""

    def __init__(self, task, kp=200.0, ki=300.0, kd=40.0, damping=2.0, most=60.0):
        super().__init__(task)
        self.kp, self.ki, self.kd, self.damping, self.most = kp, ki, kd, damping, most
        self.parameters = {f"force along {label}": "N" for label in task.labels}

    def begin(self, measurement):
        return np.zeros(self.task.m)

    def learnt(self, state):
        return state

    def advance(self, state, measurement, target, dt):
        _, q, v, x, _ = measurement
        e, J_hat = self.task.error(x, target), self.task.jacobian(q, x)
        force = -self.kp * e - self.kd * J_hat @ v + state
        torque = J_hat.T @ force - self.damping * v
        after = np.clip(state - self.ki * dt * np.nan_to_num(e), -self.most, self.most)
        return after, aj.Evaluation(torque, None, aj.Status.OK, e, J_hat)
