"""`Record`: instants of a run while it goes on, and what is derived from them when asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac.controllers.controller import Controller, Instant
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status
from approxjac.simulation.plant import Plant
from approxjac.simulation.trajectory import Scene, Trajectory
from approxjac.tasks import Task
from approxjac.validation import Array

_RECORDED = (
    "t", "q", "v", "x", "x_measured", "x_d", "tau", "state", "status", "limit_status", "slack",
)  # fmt: skip  # and then e and Ĵ, of which the rest is derived


class Record:
    """Collects instants of a run, `capacity` at most, and makes a `Trajectory` of them."""

    def __init__(self, plant: Plant, capacity: int, dt: float | None = None) -> None:
        self._plant = plant
        self._dt = dt
        self._capacity = capacity
        self._count = 0
        self._columns: tuple[Array, ...] = ()
        self._controllers: list[tuple[int, Controller]] = []

    def add(
        self,
        truth: Measurement,
        x_measured: Array,
        state: Array,
        answer: Evaluation,
        tau: Array,
        target: Array,
        controller: Controller,
    ) -> None:
        """Keep one instant: the truth, the controller's x, state and answer, the torque."""
        t, q, v, x, _ = truth
        _, _, status, e, J_hat, _, limit_status, slack, _ = answer
        if J_hat is None:
            J_hat = np.full((len(e), len(v)), np.nan)
        if not self._controllers or self._controllers[-1][1] is not controller:
            self._controllers.append((self._count, controller))
        row: tuple[Any, ...] = (
            t, q, v, x, x_measured, target, tau, state, status, limit_status, slack, e, J_hat,
        )  # fmt: skip
        if not self._columns:
            self._columns = tuple(np.empty((self._capacity, *np.shape(value))) for value in row)
        for column, value in zip(self._columns, row, strict=True):
            column[self._count] = value
        self._count += 1

    @classmethod
    def of(
        cls, plant: Plant, controller: Controller, columns: Sequence[Array], dt: float
    ) -> Record:
        """Return a whole run of one controller: `_RECORDED`, e and Ĵ."""
        record = cls(plant, len(columns[0]), dt)
        record._columns, record._count = tuple(columns), len(columns[0])
        record._controllers = [(0, controller)]
        return record

    def trajectory(self) -> Trajectory:
        """Return all that was kept, as arrays with time as their first axis."""
        plant = self._plant
        robot, sensor = plant.robot, plant.sensor
        kept = zip(_RECORDED, self._columns, strict=False)
        run: dict[str, Any] = {name: column[: self._count] for name, column in kept}
        q, x, x_d = run["q"], run["x"], run["x_d"]
        run["learnt"] = self._learnt(run["state"])
        for name in ("status", "limit_status"):
            run[name] = run[name].astype(np.int64)
        for k in np.flatnonzero(~np.isfinite(x).all(axis=1)):  # a record has what no sensor sees
            x[k] = sensor.value(q[k])
        return Trajectory(
            **run,
            error=_errors(sensor, x, x_d),
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=scene_of(plant, self._controllers[-1][1]),
            derived=self._derive,
        )

    def _law(self) -> str:
        """Return the controllers that ran in words, with what else repeats a run."""
        import approxjac

        dt = "in continuous time" if self._dt is None else f"dt {self._dt:g} s"
        lines = [f"approxjac {approxjac.__version__}, {dt}"]
        for start, controller in self._controllers:
            lines += [f"from t = {self._columns[0][start]:g} s:"] if start else []
            lines.append(str(controller))
        return "\n".join(lines)

    def _learnt(self, states: Array) -> Array:
        """Return the learnt numbers of the last controller by each state, shape (N, p)."""
        controller = self._controllers[-1][1]
        learnt = np.array(controller.learnt(states))
        learnt[: self._controllers[-1][0]] = np.nan
        for start, end, before in self._spans(len(states)):
            if before.parameters == controller.parameters:
                learnt[start:end] = before.learnt(states[start:end])
        return learnt

    def _spans(self, count: int) -> list[tuple[int, int, Controller]]:
        """Return from where to where which controller ran."""
        starts = [start for start, _ in self._controllers]
        controllers = [controller for _, controller in self._controllers]
        return list(zip(starts, [*starts[1:], count], controllers, strict=True))

    def _derive(self, run: Trajectory, name: str) -> Any:
        """Return a derived quantity of `Trajectory` by its name, by the controllers that ran."""
        if name == "law":
            return self._law()
        if name == "learnt_sd":
            return self._controllers[-1][1].learnt_sd
        e, J_hat = self._columns[len(_RECORDED) :]
        if name == "sigma_min":
            return _sigma_min(J_hat[: len(run.t)])
        plant, found = self._plant, []
        for start, end, controller in self._spans(len(run.t)):
            error = controller.task.error
            derived = controller.lyapunov if name == "V" else controller.task_torque
            for k in range(start, end):
                answer = Evaluation(
                    run.tau[k], None, Status(run.status[k]), e[k],
                    None if np.isnan(J_hat[k]).all() else J_hat[k], None,
                    LimitStatus(run.limit_status[k]), run.slack[k],
                )  # fmt: skip
                x, x_d = run.x[k], run.x_d[k]
                at = Instant(
                    run.q[k], run.v[k], error(x, x_d), x_d, run.state[k], answer, plant.dynamics,
                    plant.adds_gravity,
                )  # fmt: skip
                found.append(derived(at))
        return np.array(found)


def _errors(sensor: Task, x: Array, x_d: Array) -> Array:
    """Return the task errors of values (N, n_x), shape (N, m)."""
    if sensor._subtracts:
        return np.asarray(x - x_d)
    return np.array([sensor.error(*pair) for pair in zip(x, x_d, strict=True)])


def _sigma_min(J_hat: Array) -> Array:
    """Return the smallest singular value of each Ĵ, NaN of one that is not known, shape (N,)."""
    found = np.full(len(J_hat), np.nan)
    known = np.isfinite(J_hat).all(axis=(1, 2))
    found[known] = np.linalg.svd(J_hat[known], compute_uv=False)[:, -1]
    return found


def scene_of(plant: Plant, controller: Controller) -> Scene:
    """Return the robots, sensors and tasks of a run."""
    task = controller.task
    limits, learns = plant.motor_limits, controller.parameters
    return Scene(plant.robot, task.robot, plant.sensor, task, limits, learns)
