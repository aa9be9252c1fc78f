"""`Record`: instants of a run while it goes on, and what is derived from them when asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from approxjac.controllers import SetpointController, law_of
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.robots import GravityRegressor, Robot
from approxjac.simulation.plant import Plant
from approxjac.simulation.scene import Scene
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array

_NO_RATE = np.zeros(0)
_RECORDED = (
    "t", "q", "v", "x", "x_measured", "x_d", "tau", "state", "status", "limit_status", "slack",
)  # fmt: skip


class Record:
    """Collects instants of a run of a plant, and makes a `Trajectory` of them.

    Args:
        plant: The plant that runs.
        capacity: Number of instants that there will be at most, ≥ 1.
    """

    def __init__(self, plant: Plant, capacity: int) -> None:
        self._plant = plant
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
        target: Array,
        controller: Controller,
    ) -> None:
        """Keep one instant: the truth, the x that the controller got, its state and answer."""
        t, q, v, x, _ = truth
        torque, rate, status, e, J_hat, _, limit_status, slack = answer
        if J_hat is None:
            J_hat = np.full((len(e), len(v)), np.nan)
        if not self._controllers or self._controllers[-1][1] is not controller:
            self._controllers.append((self._count, controller))
            law = law_of(controller)
            self._differentiates = isinstance(law, SetpointController) and law.velocity is not None
        row: tuple[Any, ...] = (
            t, q, v, x, x_measured, target, torque, state, status, limit_status, slack, e, J_hat,
            rate if self._differentiates else _NO_RATE,
        )  # fmt: skip
        if not self._columns:
            self._columns = tuple(np.empty((self._capacity, *np.shape(value))) for value in row)
        for column, value in zip(self._columns, row, strict=True):
            column[self._count] = value
        self._count += 1

    def trajectory(self) -> Trajectory:
        """Return all that was kept, as arrays with time as their first axis."""
        plant = self._plant
        robot, sensor = plant.robot, plant.sensor
        kept = [column[: self._count] for column in self._columns]
        run: dict[str, Any] = dict(zip(_RECORDED, kept, strict=False))
        q, x, x_d = run["q"], run["x"], run["x_d"]
        for name in ("status", "limit_status"):
            run[name] = run[name].astype(np.int64)
        for k in np.flatnonzero(~np.isfinite(x).all(axis=1)):  # a record has what no sensor sees
            x[k] = sensor.value(q[k])
        if sensor._subtracts:
            error = x - x_d
        else:
            error = np.array([sensor.error(*pair) for pair in zip(x, x_d, strict=True)])
        return Trajectory(
            **run,
            error=error,
            robot_name=robot.name,
            joint_names=robot.joint_names,
            joint_units=robot.joint_units,
            task_labels=sensor.labels,
            task_units=sensor.units,
            scene=scene_of(plant, self._controllers[-1][1]),
            derived=_Derivation(plant, self._controllers, *kept[len(_RECORDED) :]),
        )


class _Derivation:
    """Computes V and the like of a run when they are asked for, with the controllers that ran.

    It takes these with their first instants, the errors e (N, m) that they had, their estimated
    Jacobians (N, m, n_v), NaN of one that has none, and the rates of their states (N, n_state).
    """

    def __init__(
        self,
        plant: Plant,
        controllers: Sequence[tuple[int, Controller]],
        e: Array,
        J_hat: Array,
        rate: Array,
    ) -> None:
        self._plant = plant
        self._e, self._J_hat, self._rate = e, J_hat, rate
        self._laws: list[tuple[slice, SetpointController]] = []
        ends = [start for start, _ in controllers[1:]] + [len(e)]
        for (start, controller), end in zip(controllers, ends, strict=True):
            law = law_of(controller)
            if isinstance(law, SetpointController):
                self._laws.append((slice(start, end), law))

    def __call__(self, run: Trajectory, name: str) -> Array:
        """Return "task_torque", "V" or "sigma_min" of the run."""
        found: Array = getattr(self, name)(run)
        return found

    def sigma_min(self, run: Trajectory) -> Array:
        """Return the smallest singular value of Ĵ, NaN without one, shape (N,)."""
        found = np.full(len(run.t), np.nan)
        known = np.isfinite(self._J_hat).all(axis=(1, 2))
        found[known] = np.linalg.svd(self._J_hat[known], compute_uv=False)[:, -1]
        return found

    def task_torque(self, run: Trajectory) -> Array:
        """Return the part of the law's torque that acts on the task, shape (N, n_v)."""
        found = np.full(run.v.shape, np.nan)
        for which, law in self._laws:
            parts = self._e[which], run.v[which], self._J_hat[which], self._rate[which]
            found[which] = law.task_torque(*parts)
        return found

    def V(self, run: Trajectory) -> Array:
        """Return V of the true arm, shape (N,)."""
        found = np.full(len(run.t), np.nan)
        for which, law in self._laws:
            theta_error: Sequence[Array | None] = [None] * len(run.t[which])
            if law.adaptation is not None:
                theta = _true_parameters(law.adaptation.regressor, self._plant.robot)
                theta_error = list(theta - law.learnt(run.state[which]))
            each = zip(
                run.x[which], run.x_d[which], run.q[which], run.v[which], self._J_hat[which],
                theta_error, strict=True,
            )  # fmt: skip
            found[which] = [
                law.lyapunov_value(
                    law.task.error(x, x_d), v, J, self._plant.dynamics.M(q), law.alpha, off
                )
                for x, x_d, q, v, J, off in each
            ]
        return found


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
