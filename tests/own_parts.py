"""Parts of a user's own: a saturation, gravity, a posture and laws, and controllers with them."""

import numpy as np

import approxjac as aj
from approxjac.controllers import Posture
from approxjac.tasks import FrameKinematics


def learning(robot):
    return aj.AdaptiveGravity(robot, L=0.5, alpha=1.0, torque_limits=np.inf)


class Cubic:
    """s(e) = e / (1 + (e/γ)²)^½: a saturation of one's own."""

    c_bar, gamma = 0.5, 0.1

    def s(self, e):
        return e / np.sqrt(1.0 + (e / self.gamma) ** 2)

    def S(self, e):
        return self.gamma**2 * (np.sqrt(1.0 + (e / self.gamma) ** 2) - 1.0)

    def ds(self, e):
        return (1.0 + (e / self.gamma) ** 2) ** -1.5


class Weighed(aj.controllers.ModelGravity):
    """Gravity of the model and of a load on the wrist, from its Jacobian."""

    def __init__(self, robot, mass=1.0):
        super().__init__(robot)
        self.mass, self._wrist = mass, FrameKinematics(robot, "panda_link7")

    def torque(self, q):
        return super().torque(q) + self._wrist.jacobian(q)[2] * (9.81 * self.mass)


class Leaning(Posture):
    """A posture that is drawn to less where the first joint is turned."""

    def torque(self, task, gains, rate):
        usual = super().torque(task, gains, rate)
        return lambda q: usual(q) * np.cos(q[0])


class Firmer(aj.SetpointController):
    """A law that pushes twice as hard."""

    def evaluate(self, state, measurement, target):
        answer = super().evaluate(state, measurement, target)
        return answer._replace(torque=2.0 * answer.torque)


class Springs(aj.Controller):
    """A law of one's own in samples: the force on the task before last is kept."""

    def begin(self, measurement):
        return np.zeros(3)

    def advance(self, state, measurement, target, dt):
        _, q, v, x, _ = measurement
        e = self.task.error(x, target)
        force = 0.5 * (state - 300.0 * e)
        torque = np.dot(force, self.task.jacobian(q)) - 5.0 * v * (1.0 + np.tanh(measurement.t))
        return force + dt * e, aj.Evaluation(torque, None, aj.Status.OK, e)


def of_ones_own(panda):
    task = aj.PositionTask(panda)
    return (
        aj.SetpointController(task, aj.Gains(300.0, 60.0, 2.0), saturation=Cubic()),
        aj.SetpointController(task, saturation=Cubic(), gravity=learning(panda)),
        aj.SetpointController(task, gravity=Weighed(panda)),
        aj.SetpointController(task, posture=Leaning(panda.neutral() + 0.1, 5.0)),
        aj.HeldMeasurement(aj.SetpointController(task), 0.05),
        aj.HeldMeasurement(
            aj.TorqueLimited(
                aj.SetpointController(task, gravity=learning(panda)),
                aj.Limits(effort=panda.effort_limits),
            ),
            0.05,
        ),
        Firmer(task),
        Springs(task),
    )
