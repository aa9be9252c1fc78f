"""`Trajectory`: the record of one run."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.checks import Array
from approxjac.errors import TrajectoryFileError
from approxjac.interface import Status


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """What happened in one run. The first axis of every array but `target` is time.

    Attributes:
        t: Time, shape (N,) [s].
        q: Configuration, shape (N, nq).
        v: Velocity, shape (N, n_v).
        x: Measured task value, shape (N, m).
        error: e = x − x_d, shape (N, m).
        tau: Torque, shape (N, n_v).
        state: Controller state (θ̂ where gravity is learnt), shape (N, n_state).
        status: `Status` of each evaluation, shape (N,).
        sigma_min: Smallest singular value of Ĵ where the law uses Ĵ⁺, else NaN, shape (N,).
        target: x_d, shape (m,).
        robot_name: Name of the true robot.
        joint_names: In the order of v and τ.
        task_labels: Names of the task coordinates.
        task_unit: Unit of x, error and target.
    """

    t: Array
    q: Array
    v: Array
    x: Array
    error: Array
    tau: Array
    state: Array
    status: np.ndarray[Any, np.dtype[np.int64]]
    sigma_min: Array
    target: Array
    robot_name: str
    joint_names: tuple[str, ...]
    task_labels: tuple[str, ...]
    task_unit: str

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each array; a prismatic joint has m, m/s and N for rad, rad/s and N m."""
        task = self.task_unit
        return {
            "t": "s",
            "q": "rad",
            "v": "rad/s",
            "x": task,
            "error": task,
            "tau": "N m",
            "sigma_min": f"{task}/rad",
            "target": task,
        }

    @property
    def error_norm(self) -> Array:
        """‖e‖ over time, shape (N,)."""
        return np.asarray(np.linalg.norm(self.error, axis=1))

    def error_ratio(self, t: float) -> float:
        """‖e(t)‖ / ‖e(0)‖ at the recorded instant nearest to t [s]."""
        norm = self.error_norm
        return float(norm[np.abs(self.t - t).argmin()] / norm[0])

    def status_counts(self) -> dict[Status, int]:
        """How often each status occurred."""
        values, counts = np.unique(self.status, return_counts=True)
        return {Status(int(s)): int(n) for s, n in zip(values, counts, strict=True)}

    def save(self, path: str | Path) -> Path:
        """Write the run to a .npz file that `Trajectory.load` and `numpy.load` read.

        Returns:
            The path written, with the ending .npz.
        """
        path = Path(path)
        if path.suffix != ".npz":
            path = path.with_name(path.name + ".npz")
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _TEXTS}
        texts = {name: getattr(self, name) for name in _TEXTS}
        np.savez_compressed(path, allow_pickle=False, texts=np.array(json.dumps(texts)), **arrays)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read a run that `save` wrote.

        Raises:
            TrajectoryFileError: No such file, or not a trajectory.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                texts = json.loads(str(file["texts"]))
                arrays = {name: file[name] for name in file.files if name != "texts"}
            texts["joint_names"] = tuple(texts["joint_names"])
            texts["task_labels"] = tuple(texts["task_labels"])
            return cls(**arrays, **texts)
        except FileNotFoundError as error:
            raise TrajectoryFileError(
                f"trajectory file {path} does not exist", given=path
            ) from error
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise TrajectoryFileError(
                f"{path} is not a trajectory written by Trajectory.save: {error}", given=path
            ) from error

    def __repr__(self) -> str:
        norm = self.error_norm
        counts = ", ".join(f"{s.name} {n}" for s, n in self.status_counts().items())
        return (
            f"Trajectory({self.robot_name!r}, {self.t[-1]:g} s, {len(self.t)} samples; "
            f"|e| {norm[0]:.3g} -> {norm[-1]:.3g} {self.task_unit}; {counts})"
        )


_TEXTS = ("robot_name", "joint_names", "task_labels", "task_unit")
