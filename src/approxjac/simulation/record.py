"""`Record`: what is kept of a run while it goes on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from approxjac.checks import Array
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.robots import Robot
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.tasks import Task


class Record:
    """Collects instants of a run of a plant, and makes a `Trajectory` of them.

    Args:
        plant: The plant that runs.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._truths: list[Measurement] = []
        self._seen: list[Array] = []
        self._states: list[Array] = []
        self._answers: list[Evaluation] = []
        self._targets: list[Array] = []
        self._errors: list[Array] = []
        self._task_torques: list[Array] = []
        self._V: list[float] = []
        self._theta: dict[int, Array | None] = {}

    def add(
        self,
        truth: Measurement,
        x_measured: Array,
        state: Array,
        answer: Evaluation,
        target: Array,
        controller: Controller,
    ) -> None:
        """Keep one instant.

        Args:
            truth: What ideal sensors measure.
            x_measured: What the controller got of x, shape (n_x,).
            state: State of the controller, shape (n_state,).
            answer: What it answered.
            target: x_d, shape (n_x,).
            controller: Which one it was.
        """
        plant = self._plant
        if not np.isfinite(truth.x).all():  # the record has what no sensor sees too
            truth = truth._replace(x=plant.sensor.value(truth.q))
        # to keep it: a controller may use one buffer for all its torques
        answer = answer._replace(torque=answer.torque.copy())
        self._truths.append(truth)
        self._seen.append(x_measured)
        self._states.append(state)
        self._answers.append(answer)
        self._targets.append(target)
        self._errors.append(plant.sensor.error(truth.x, target))
        chain = _chain(controller)
        law: Any = chain[-1]
        unknown = np.full(plant.robot.nv, np.nan)
        acts = hasattr(law, "task_torque") and answer.J_hat is not None
        self._task_torques.append(law.task_torque(answer, truth.v) if acts else unknown)
        self._V.append(self._lyapunov_value(chain, truth, state, answer, target))

    def trajectory(self, controller: Controller) -> Trajectory:
        """All that was kept, as arrays with time as their first axis.

        Args:
            controller: The last one.
        """
        plant, answers = self._plant, self._answers
        robot, sensor = plant.robot, plant.sensor
        return Trajectory(
            t=np.array([truth.t for truth in self._truths]),
            q=np.array([truth.q for truth in self._truths]),
            v=np.array([truth.v for truth in self._truths]),
            x=np.array([truth.x for truth in self._truths]),
            x_measured=np.array(self._seen),
            x_d=np.array(self._targets),
            error=np.array(self._errors),
            tau=np.array([answer.torque for answer in answers]),
            task_torque=np.array(self._task_torques),
            V=np.array(self._V),
            state=np.array(self._states),
            status=np.array([int(answer.status) for answer in answers], dtype=np.int64),
            limit_status=np.array([int(answer.limit_status) for answer in answers], dtype=np.int64),
            slack=np.array([answer.slack for answer in answers]),
            sigma_min=np.array([answer.sigma_min for answer in answers]),
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=_scene(plant, controller),
        )

    def _lyapunov_value(
        self,
        chain: list[Controller],
        truth: Measurement,
        state: Array,
        answer: Evaluation,
        target: Array,
    ) -> float:
        """V of the true arm; NaN for laws that have none."""
        law: Any = chain[-1]
        if not hasattr(law, "lyapunov_value") or answer.J_hat is None:
            return math.nan
        alpha = next(c.alpha for c in chain if hasattr(c, "alpha"))  # a limiter may have its own
        if id(law) not in self._theta:
            regressor = None if law.adaptation is None else law.adaptation.regressor
            self._theta[id(law)] = (
                None if regressor is None else regressor.fit(self._plant.robot)[0]
            )
        e = law.task.error(truth.x, target)  # the true one; that of the answer is as measured
        value: float = law.lyapunov_value(
            answer._replace(e=e),
            truth.v,
            self._plant.dynamics.M(truth.q),
            alpha,
            state[: law.n_state],
            self._theta[id(law)],
        )
        return value


def _scene(plant: Plant, controller: Controller) -> Scene:
    """Who takes part in a run."""
    task = getattr(controller, "task", None)
    task = task if isinstance(task, Task) else None
    limits = plant.torque_limits
    belief: Robot | None = None if task is None else task.robot
    return Scene(
        plant.robot,
        belief,
        plant.sensor,
        task,
        plant.robot.effort_limits if limits is None else np.asarray(limits),
    )


def _chain(controller: Any) -> list[Any]:
    """A controller, the one that it limits or holds measurements for, and so on to the law."""
    chain = [controller]
    while hasattr(chain[-1], "controller"):
        chain.append(chain[-1].controller)
    return chain
