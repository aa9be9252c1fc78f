"""`Record`: what is kept of a run while it goes on."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.robots import Robot
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.tasks import Task
from approxjac.validation import Array


class _Instant(NamedTuple):
    truth: Measurement
    x_measured: Array
    state: Array
    answer: Evaluation
    target: Array
    error: Array
    task_torque: Array
    V: float


class Record:
    """Collects instants of a run of a plant, and makes a `Trajectory` of them.

    Args:
        plant: The plant that runs.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._kept: list[_Instant] = []
        self._theta: tuple[Any, Array | None] = (None, None)  # of the law that it is for

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
        error = plant.sensor.error(truth.x, target)
        law: Any = getattr(controller, "law", None)
        task_torque = np.full(plant.robot.nv, np.nan)
        V = math.nan
        if law is not None and answer.J_hat is not None:
            task_torque = law.task_torque(answer, truth.v)
            V = self._lyapunov_value(law, truth, state, answer, target)
        self._kept.append(_Instant(truth, x_measured, state, answer, target, error, task_torque, V))

    def trajectory(self, controller: Controller) -> Trajectory:
        """All that was kept, as arrays with time as their first axis.

        Args:
            controller: The last one.
        """
        plant, kept = self._plant, self._kept
        robot, sensor = plant.robot, plant.sensor
        return Trajectory(
            t=np.array([k.truth.t for k in kept]),
            q=np.array([k.truth.q for k in kept]),
            v=np.array([k.truth.v for k in kept]),
            x=np.array([k.truth.x for k in kept]),
            x_measured=np.array([k.x_measured for k in kept]),
            x_d=np.array([k.target for k in kept]),
            error=np.array([k.error for k in kept]),
            tau=np.array([k.answer.torque for k in kept]),
            task_torque=np.array([k.task_torque for k in kept]),
            V=np.array([k.V for k in kept]),
            state=np.array([k.state for k in kept]),
            status=np.array([int(k.answer.status) for k in kept], dtype=np.int64),
            limit_status=np.array([int(k.answer.limit_status) for k in kept], dtype=np.int64),
            slack=np.array([k.answer.slack for k in kept]),
            sigma_min=np.array([k.answer.sigma_min for k in kept]),
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=scene_of(plant, controller),
        )

    def taken(self, controller: Controller) -> Trajectory:
        """`trajectory`, of which nothing is kept any longer."""
        run = self.trajectory(controller)
        self._kept.clear()
        return run

    def _lyapunov_value(
        self, law: Any, truth: Measurement, state: Array, answer: Evaluation, target: Array
    ) -> float:
        """V of the true arm."""
        if self._theta[0] is not law:
            regressor = None if law.adaptation is None else law.adaptation.regressor
            theta = None if regressor is None else regressor.fit(self._plant.robot)[0]
            self._theta = law, theta
        e = law.task.error(truth.x, target)  # the true one; that of the answer is as measured
        value: float = law.lyapunov_value(
            answer._replace(e=e),
            truth.v,
            self._plant.dynamics.M(truth.q),
            law.alpha,
            state[: law.n_state],
            self._theta[1],
        )
        return value


def scene_of(plant: Plant, controller: Controller) -> Scene:
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
