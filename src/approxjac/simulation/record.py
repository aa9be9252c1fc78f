"""`Record`: instants of a run while it goes on, and what is derived from them when asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from approxjac.controllers import SetpointController, law_of
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.robots import GravityRegressor, Robot
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array


class Record:
    """Collects instants of a run of a plant, and makes a `Trajectory` of them.

    Args:
        plant: The plant that runs.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        # a list for each column: arrays, unlike tuples of them, cost no garbage collection
        self._columns: tuple[list[Any], ...] = tuple([] for _ in range(14))
        self._controllers: list[tuple[int, Controller]] = []

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
            truth: Measurement of ideal sensors.
            x_measured: Part of x that the controller got, shape (n_x,).
            state: State of the controller, shape (n_state,).
            answer: Answer of the controller.
            target: x_d, shape (n_x,).
            controller: The controller.
        """
        t, q, v, x, _ = truth
        torque, rate, status, e, J_hat, _, limit_status, slack = answer
        if not self._controllers or self._controllers[-1][1] is not controller:
            self._controllers.append((len(self._columns[0]), controller))
        for column, value in zip(
            self._columns,
            (t, q, v, x, x_measured, target, torque, state, status, limit_status, slack,
             e, J_hat, rate),
            strict=True,
        ):  # fmt: skip
            column.append(value)

    def trajectory(self) -> Trajectory:
        """Return all that was kept, as arrays with time as their first axis."""
        plant = self._plant
        robot, sensor = plant.robot, plant.sensor
        t, q, v, x, x_measured, x_d, tau, state = map(np.array, self._columns[:8])
        status, limit_status, slack, e, J_hat, rate = self._columns[8:]
        for k in np.flatnonzero(~np.isfinite(x).all(axis=1)):  # a record has what no sensor sees
            x[k] = sensor.value(q[k])
        if sensor._subtracts:
            error = x - x_d
        else:
            error = np.array([sensor.error(*pair) for pair in zip(x, x_d, strict=True)])
        return Trajectory(
            t=t,
            q=q,
            v=v,
            x=x,
            x_measured=x_measured,
            x_d=x_d,
            error=error,
            tau=tau,
            state=state,
            status=np.array(status, dtype=np.int64),
            limit_status=np.array(limit_status, dtype=np.int64),
            slack=np.array(slack),
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=scene_of(plant, self._controllers[-1][1]),
            derived=_Derivation(plant, self._controllers, e, J_hat, rate),
        )


class _Derivation:
    """Computes V and the like of a run when they are asked for, with the controllers that ran.

    Args:
        plant: The plant.
        controllers: The controllers, each with its first instant.
        e: Task errors that they had, each of shape (m,).
        J_hat: Their estimated Jacobians, None from one that has none.
        rate: Rates of their states.
    """

    def __init__(
        self,
        plant: Plant,
        controllers: Sequence[tuple[int, Controller]],
        e: Sequence[Array],
        J_hat: Sequence[Array | None],
        rate: Sequence[Array | None],
    ) -> None:
        self._plant = plant
        self._parts: list[_Part] = []
        ends = [start for start, _ in controllers[1:]] + [len(e)]
        for (start, controller), end in zip(controllers, ends, strict=True):
            which, law = slice(start, end), law_of(controller)
            if not isinstance(law, SetpointController):
                law = None
            has_jacobian = all(J is not None for J in J_hat[which])
            jacobians = np.array(J_hat[which]) if has_jacobian else None
            differentiates = law is not None and law.velocity is not None
            rates = np.array(rate[which]) if differentiates else np.zeros((end - start, 0))
            self._parts.append(_Part(which, law, np.array(e[which]), jacobians, rates))

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
            if law is not None and J_hat is not None:
                found[which] = law.task_torque(e, run.v[which], J_hat, rate)
        return found

    def V(self, run: Trajectory) -> Array:
        """Return V of the true arm, shape (N,)."""
        found = np.full(len(run.t), np.nan)
        for which, law, _, J_hat, _ in self._parts:
            if law is None or J_hat is None:
                continue
            theta_error: Sequence[Array | None] = [None] * len(J_hat)
            if law.adaptation is not None:
                theta = _true_parameters(law.adaptation.regressor, self._plant.robot)
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
    """Instants with the same controller: the set-point law inside of it, and what it answered."""

    which: slice
    law: SetpointController | None
    e: Array
    J_hat: Array | None
    rate: Array


@lru_cache(maxsize=4)
def _true_parameters(regressor: GravityRegressor, robot: Robot) -> Array:
    """Return the θ of a true robot; kept, as a live view asks for it at each picture."""
    return regressor.fit(robot)[0]


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
