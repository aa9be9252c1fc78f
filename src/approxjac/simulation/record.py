"""`Record`: instants of a run while it goes on, and what is derived from them when asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from approxjac.controllers import (
    ControllerWrapper,
    PredictedMeasurement,
    SetpointController,
    TrackingController,
)
from approxjac.controllers.controller import Controller
from approxjac.controllers.run_terms import lyapunov_value, task_torque
from approxjac.interface import Evaluation, Measurement
from approxjac.robots import GravityRegressor, Robot
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.tasks import Task
from approxjac.validation import Array

_NO_RATE = np.zeros(0)
_RECORDED = (
    "t", "q", "v", "x", "x_measured", "x_d", "tau", "state", "status", "limit_status", "slack",
)  # fmt: skip  # and then e, Ĵ and the rate of the state, of which the rest is derived


class Record:
    """Collects instants of a run, `capacity` at most, and makes a `Trajectory` of them."""

    def __init__(self, plant: Plant, capacity: int, dt: float | None = None) -> None:
        self._plant = plant
        self._dt = dt
        self._capacity = capacity
        self._count = 0
        self._columns: tuple[Array, ...] = ()
        self._controllers: list[tuple[int, Controller]] = []
        self._differentiates = False

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
        _, rate, status, e, J_hat, _, limit_status, slack, _ = answer
        if J_hat is None:
            J_hat = np.full((len(e), len(v)), np.nan)
        if not self._controllers or self._controllers[-1][1] is not controller:
            self._controllers.append((self._count, controller))
            law = controller.law
            self._differentiates = isinstance(law, SetpointController) and law.velocity is not None
        row: tuple[Any, ...] = (
            t, q, v, x, x_measured, target, tau, state, status, limit_status, slack, e, J_hat,
            rate if self._differentiates else _NO_RATE,
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
        """Return a whole run of one controller: `_RECORDED`, e, Ĵ and the rate of the state."""
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
            scene=scene_of(plant, self._controllers[-1][1], run["state"].shape[1]),
            derived=self._derive,
        )

    def _law(self) -> str:
        """Return the controllers that ran in words, with what else repeats a run."""
        import approxjac

        dt = "in continuous time" if self._dt is None else f"dt {self._dt:g} s"
        told = [f"approxjac {approxjac.__version__}, {dt}"]
        for start, controller in self._controllers:
            told += [f"from t = {self._columns[0][start]:g} s:"] if start else []
            told.append(str(controller))
        return "\n".join(told)

    def _derive(self, run: Trajectory, name: str) -> Any:
        """Return "task_torque", "V", "sigma_min" or "law", by the controllers that ran."""
        if name == "law":
            return self._law()
        e, J_hat, rate = self._columns[len(_RECORDED) :]
        if name == "sigma_min":
            return _sigma_min(J_hat[: len(run.t)])
        found = np.full(run.v.shape if name == "task_torque" else len(run.t), np.nan)
        ends = [start for start, _ in self._controllers[1:]] + [len(run.t)]
        for (start, controller), end in zip(self._controllers, ends, strict=True):
            law, which = controller.law, slice(start, end)
            if _learning(controller) is not None:  # its V is of what it predicts
                continue
            if isinstance(law, SetpointController) and name == "V":
                found[which] = self._V(law, run, which, J_hat[which])
            elif isinstance(law, SetpointController):
                found[which] = task_torque(law, e[which], run.v[which], J_hat[which], rate[which])
        return found

    def _V(
        self, law: SetpointController, run: Trajectory, which: slice, J_hat: Array
    ) -> list[float]:
        """Return V of the true arm while a law ran, with its estimated Jacobians."""
        theta_error: Sequence[Array | None] = [None] * len(J_hat)
        if law.adaptation is not None:
            theta_hat = law.learnt(run.state[which])
            theta = _true_parameters(law.adaptation.regressor, self._plant.robot)
            if self._plant.adds_gravity is not None:  # the rest is what there is to learn
                theta = theta - _true_parameters(law.adaptation.regressor, self._plant.adds_gravity)
            theta_error = list(law.adaptation.whole(theta) - theta_hat)
        columns = run.x[which], run.x_d[which], run.q[which], run.v[which], J_hat, theta_error
        return [
            lyapunov_value(
                law, law.task.error(x, x_d), v, J, self._plant.dynamics.M(q), law.alpha, off
            )
            for x, x_d, q, v, J, off in zip(*columns, strict=True)
        ]


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


@lru_cache(maxsize=4)
def _true_parameters(regressor: GravityRegressor, robot: Robot) -> Array:
    """Return the θ of a true robot; kept, as a live view asks for it at each picture."""
    return regressor.fit(robot)[0]


def scene_of(plant: Plant, controller: Controller, n_state: int) -> Scene:
    """Return who takes part in a run of a controller with a state of that length."""
    task, learning = controller.task, _learning(controller)
    names = () if learning is None else learning.kinematics.names
    where = controller.learnt(np.arange(n_state, dtype=float))
    learnt = dict(zip(names, where[len(where) - len(names) :].astype(int).tolist(), strict=True))
    return Scene(plant.robot, task.robot, plant.sensor, task, plant.motor_limits, learnt)


def _learning(controller: Controller) -> TrackingController | PredictedMeasurement | None:
    """Return the controller, or the one inside of it, that learns kinematics."""
    while isinstance(controller, ControllerWrapper):
        if isinstance(controller, PredictedMeasurement):
            return controller
        controller = controller.controller
    return controller if isinstance(controller, TrackingController) else None
