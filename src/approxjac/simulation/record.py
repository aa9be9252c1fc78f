"""`Record`: instants of a run while it goes on, and what is derived from them when asked for."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from approxjac.controllers import SetpointController, law_of
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array


class Instant(NamedTuple):
    """One instant of a run.

    Attributes:
        truth: Measurement of ideal sensors.
        x_measured: Part of x that the controller got, shape (n_x,).
        state: State of the controller, shape (n_state,).
        answer: Answer of the controller.
        target: x_d, shape (n_x,).
        controller: The controller.
    """

    truth: Measurement
    x_measured: Array
    state: Array
    answer: Evaluation
    target: Array
    controller: Controller


class Record:
    """Collects instants of a run of a plant, and makes a `Trajectory` of them.

    Args:
        plant: The plant that runs.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._kept: list[Instant] = []
        self.add = self._kept.append

    def trajectory(self, controller: Controller) -> Trajectory:
        """Return all that was kept, as arrays with time as their first axis.

        Args:
            controller: The last one.
        """
        plant, kept = self._plant, self._kept
        robot, sensor = plant.robot, plant.sensor
        truths, _, states, answers, _, controllers = zip(*kept, strict=True)
        times, q, v, x, _ = map(np.array, zip(*truths, strict=True))
        torques, _, statuses, _, _, _, limit_statuses, slacks = zip(*answers, strict=True)
        x_d = np.array([each.target for each in kept])
        for k in np.flatnonzero(~np.isfinite(x).all(axis=1)):  # a record has what no sensor sees
            x[k] = sensor.value(q[k])
        error = (
            x - x_d
            if sensor._subtracts
            else np.array([sensor.error(*pair) for pair in zip(x, x_d, strict=True)])
        )
        return Trajectory(
            t=times,
            q=q,
            v=v,
            x=x,
            x_measured=np.array([each.x_measured for each in kept]),
            x_d=x_d,
            error=error,
            tau=np.array(torques),
            state=np.array(states),
            status=np.array(statuses, dtype=np.int64),
            limit_status=np.array(limit_statuses, dtype=np.int64),
            slack=np.array(slacks),
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=scene_of(plant, controller),
            derived=_Derivation(plant, controllers, answers),
        )

    def taken(self, controller: Controller) -> Trajectory:
        """Return `trajectory`, and keep nothing of it any longer."""
        run = self.trajectory(controller)
        self._kept.clear()
        return run


class _Derivation:
    """Computes V and the like of a run when they are asked for, with the controllers that ran.

    Args:
        plant: The plant.
        controllers: The controller at each instant.
        answers: Their answers.
    """

    def __init__(
        self, plant: Plant, controllers: Sequence[Controller], answers: Sequence[Evaluation]
    ) -> None:
        self._plant = plant
        changes = [k for k in range(1, len(answers)) if controllers[k] is not controllers[k - 1]]
        self._parts: list[_Part] = []
        for start, end in itertools.pairwise([0, *changes, len(answers)]):
            law, said = law_of(controllers[start]), answers[start:end]
            J_hat = rate = None
            if all(answer.J_hat is not None for answer in said):
                J_hat = np.array([answer.J_hat for answer in said])
            if isinstance(law, SetpointController) and law.velocity is not None:
                rate = np.array([answer.state_rate for answer in said])
            e = np.array([answer.e for answer in said])
            self._parts.append(_Part(slice(start, end), law, e, J_hat, rate))

    def sigma_min(self, run: Trajectory) -> Array:
        """Return the smallest singular value of Ĵ, NaN without one, shape (N,)."""
        found = np.full(len(run.t), np.nan)
        for which, _, _, J_hat, _ in self._parts:
            if J_hat is not None:
                found[which] = np.linalg.svd(J_hat, compute_uv=False)[:, -1]
        return found

    def task_torque(self, run: Trajectory) -> Array:
        """Return the part of the law's torque that acts on the task, shape (N, n_v)."""
        found = np.full(run.v.shape, np.nan)
        for which, law, e, J_hat, rate in self._parts:
            if isinstance(law, SetpointController) and J_hat is not None:
                rate = np.zeros((len(e), 0)) if rate is None else rate
                found[which] = law.task_torque(e, run.v[which], J_hat, rate)
        return found

    def V(self, run: Trajectory) -> Array:
        """Return V of the true arm, shape (N,)."""
        found = np.full(len(run.t), np.nan)
        for which, law, _, J_hat, _ in self._parts:
            if not isinstance(law, SetpointController) or J_hat is None:
                continue
            theta_error: Sequence[Array | None] = [None] * len(J_hat)
            if law.adaptation is not None:
                theta = law.adaptation.regressor.fit(self._plant.robot)[0]
                theta_error = list(theta - law.learnt(run.state[which]))
            each = zip(
                run.x[which], run.x_d[which], run.q[which], run.v[which], J_hat, theta_error,
                strict=True,
            )  # fmt: skip
            found[which] = [
                law.lyapunov_value(
                    law.task.error(x, x_d), v, J, self._plant.dynamics.M(q), law.alpha, off
                )
                for x, x_d, q, v, J, off in each
            ]
        return found


class _Part(NamedTuple):
    """Instants with the same controller: the law inside of it, and what it answered."""

    which: slice
    law: Controller
    e: Array
    J_hat: Array | None
    rate: Array | None


def scene_of(plant: Plant, controller: Controller) -> Scene:
    """Return who takes part in a run."""
    limits = plant.torque_limits
    return Scene(
        plant.robot,
        controller.task.robot,
        plant.sensor,
        controller.task,
        plant.robot.effort_limits if limits is None else np.asarray(limits),
    )
