"""`Trajectory`: the record of a run; `Scene`: its robots and tasks; `Record`: its recorder."""

from __future__ import annotations

import json
import zipfile
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from approxjac.controllers.controller import Controller, Instant
from approxjac.errors import InvalidInputError, TrajectoryFileError
from approxjac.files import read_arrays, reason, replaced
from approxjac.formatting import joined, rows, shares, wrapped
from approxjac.interface import Condition, Evaluation, LimitStatus, Measurement, Status
from approxjac.robots import Robot
from approxjac.simulation.monitor import Event, Monitor
from approxjac.simulation.plant import Plant
from approxjac.simulation.transmission import Motors
from approxjac.tasks import StackedTask, Task
from approxjac.validation import Array, Saved, require

_NAMED = 3  # events in a text
_TOUCHES = 1e-6  # beyond a position limit; less is rounding [rad or m]
_NUMBERS = (np.dtype(np.float64), np.dtype(np.int64))
_TORQUE = {"rad": "N m", "m": "N"}
_COLUMNS = {  # the axis of each array beside time, "" without one, and its unit, for each joint
    "t": ("", "s"),
    "q": ("nq", "{joint}"),
    "v": ("n_v", "{joint}/s"),
    "twist": ("n_v", "{joint}"),
    "motor_v": ("n_v", "{joint}/s"),
    "x": ("n_x", "{task}"),
    "x_measured": ("n_x", "{task}"),
    "x_d": ("n_x", "{task}"),
    "error": ("m", "{task}"),
    "command": ("n_v", "{command}"),
    "tau": ("n_v", "{torque}"),
    "state": ("n_state", ""),
    "learnt": ("p", ""),
    "status": ("", ""),
    "limit_status": ("", ""),
    "slack": ("", "W"),
    "task_torque": ("n_v", "{torque}"),
    "V": ("", "J"),
    "V_dot": ("", "W"),
}
_DERIVED = ("task_torque", "V")  # of them, and V_dot of V


@dataclass(frozen=True, eq=False)
class Scene:
    """The true and the believed robot of a run, with sensor and task.

    An entry is None if the controller does not know it, or a file cannot hold it.
    """

    truth: Robot
    belief: Robot | None
    sensor: Task | None  # the task that is measured on the true robot
    task: Task | None  # the controller's, of the believed robot
    torque_limits: Array  # of the motors, shape (n_v,) [N m or N]; infinite where unknown
    parameters: Mapping[str, str] = field(default_factory=dict)  # that are learnt: their units
    knows_truth: bool = True  # False on a real arm: `truth` is the believed robot
    walls: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))  # points [m] and normals

    def to_dict(self) -> dict[str, Any]:
        """Return the scene as texts, numbers, lists and dictionaries, to be stored in a file."""
        return {
            "truth": _saved_robot(self.truth),
            "belief": None if self.belief is None else _saved_robot(self.belief),
            "sensor": self.sensor and self.sensor._saved(),
            "task": self.task and self.task._saved(),
            # JSON knows no infinity
            "parameters": dict(self.parameters),
            "knows_truth": self.knows_truth,
            "walls": self.walls.tolist(),
            "torque_limits": [x if np.isfinite(x) else None for x in self.torque_limits.tolist()],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> Scene:
        """Return the scene that `to_dict` described."""
        truth = _restored_robot(kept["truth"])
        belief = None if kept["belief"] is None else _restored_robot(kept["belief"])
        limits = np.array([np.inf if x is None else float(x) for x in kept["torque_limits"]])
        if len(limits) != truth.nv:
            raise ValueError("its robot and torque limits have different numbers of joints")
        sensor, task = _restored_task(kept["sensor"], truth), _restored_task(kept["task"], belief)
        walls = np.array(kept.get("walls", ()), dtype=float).reshape(-1, 2, 3)
        learnt, knows = kept["parameters"], kept["knows_truth"]
        return cls(truth, belief, sensor, task, limits, learnt, knows, walls)


def _saved_robot(robot: Robot) -> dict[str, Any]:
    folder = None if robot.urdf_dir is None else str(robot.urdf_dir)
    kept = {"urdf": robot.urdf, "gravity": robot.gravity.tolist(), "tip": robot.tip}
    return kept | {"urdf_dir": folder, "name": robot.name}


def _restored_robot(kept: Mapping[str, Any]) -> Robot:
    folder = None if kept["urdf_dir"] is None else Path(kept["urdf_dir"])
    return Robot(**{**kept, "urdf_dir": folder}, source="the URDF of a run")


def _restored_task(kept: Mapping[str, Any] | None, robot: Robot | None) -> Task | None:
    """Return the task of a robot that a file keeps, as it was before it was saved, if it does."""
    if kept is None or robot is None:
        return None
    if kept["kind"] == "stacked":
        parts: list[Any] = [_restored_task(part, robot) for part in kept["tasks"]]
        return StackedTask(*parts)
    given = {**kept}
    kind = Saved._kinds[given.pop("kind")]
    if "camera" in given:
        camera = {**given["camera"]}
        given["camera"] = Saved._kinds[camera.pop("kind")](**camera)
    return kind(robot, **given)


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """The record of one run. The first axis of every array is time; `units` lists their units.

    Attributes:
        t: Time, shape (N,) [s].
        q: Configuration, shape (N, nq).
        v: Velocity, shape (N, n_v).
        twist: Angles of motors beyond their links, of elastic joints, else 0, shape (N, n_v).
        motor_v: Velocity of the motors at the joints' side of the gears, shape (N, n_v).
        x: True task value, shape (N, n_x).
        x_measured: Measured task value, NaN where it was lost, shape (N, n_x).
        x_d: Target, shape (N, n_x).
        error: True error of x to the target, shape (N, m).
        command: Command of the controller, torques or joint velocities by `command_kind`, (N, n_v).
        tau: Torque: the command itself, or that of the simulated servo that follows it; NaN for a
            robot that takes velocities, shape (N, n_v).
        state: Controller state, shape (N, n_state).
        learnt: Learnt numbers, in the order of `parameters`, shape (N, p).
        status: `Status` at these instants, shape (N,).
        limit_status: `LimitStatus` at these instants, shape (N,).
        slack: σ, the power that limits add to V̇, NaN where unknown, shape (N,) [W].
        command_kind: "torque" or "velocity", as `Controller.command`.
        robot_name: Name of the true robot.
        joint_names, joint_units: In the order of v and τ; "rad", or "m" for prismatic joints.
        task_labels, task_units: Of the task coordinates, length m.
        scene: Robots and tasks, to draw the run; None if unknown.
        derived: Function of a run, a name and indices of instants, which computes other quantities
            on demand.
        ended: Reason why a run on a robot ended, as text; "" for others.
        fault_name: Name of the `Fault` that ended it; "" without one.
        engine: "machine code" or "Python" for a simulated run, and why; "" for others.
    """

    t: Array
    q: Array
    v: Array
    twist: Array
    motor_v: Array
    x: Array
    x_measured: Array
    x_d: Array
    error: Array
    command: Array
    tau: Array
    state: Array
    learnt: Array
    status: np.ndarray[Any, np.dtype[np.int64]]
    limit_status: np.ndarray[Any, np.dtype[np.int64]]
    slack: Array
    command_kind: str
    robot_name: str
    joint_names: tuple[str, ...]
    joint_units: tuple[str, ...]
    task_labels: tuple[str, ...]
    task_units: tuple[str, ...]
    scene: Scene | None = None
    derived: Callable[[Trajectory, str, Any], Any] = field(kw_only=True)
    ended: str = field(default="", kw_only=True)
    fault_name: str = field(default="", kw_only=True)
    engine: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        for name in _COLUMNS.keys() - {*_DERIVED, "V_dot"}:
            array = getattr(self, name)
            # another float would go through some plots only, and a mask would be lost on the way
            if type(array) is not np.ndarray or array.dtype not in _NUMBERS:
                given = getattr(array, "dtype", type(array).__name__)
                masked = "a masked array of " if isinstance(array, np.ma.MaskedArray) else ""
                raise InvalidInputError(
                    f"{name} of a run must be an array of float64 or int64, got {masked}{given}",
                    given=array,
                )

    @cached_property
    def task_torque(self) -> Array:
        """The part of the law's torque that acts on the task, (N, n_v); NaN where unknown."""
        return np.asarray(self.derived(self, "task_torque", slice(None)))

    @cached_property
    def V(self) -> Array:
        """The controller's Lyapunov function of the true arm, shape (N,) [J]; NaN without one."""
        return np.asarray(self.derived(self, "V", slice(None)))

    def at(self, name: Literal["V", "task_torque"], instants: Any) -> Array:
        """Return `V` [J] or `task_torque` [N m or N] at some instants only, by their indices."""
        known = vars(self).get(name)
        return np.asarray(self.derived(self, name, instants) if known is None else known[instants])

    @cached_property
    def V_dot(self) -> Array:
        """Rate of V between recorded instants, to second order, shape (N,) [W]."""
        if len(self.t) < 3:
            return np.full(len(self.t), np.nan)
        return np.asarray(np.gradient(self.V, self.t, edge_order=2))

    @property
    def parameters(self) -> Mapping[str, str]:
        """Name → unit of the learnt numbers; empty if the scene is not known."""
        return {} if self.scene is None else self.scene.parameters

    def learnt_sd(self, k: int) -> Array:
        """Return the standard deviations of `learnt[k]`, shape (p,); NaN for runs from files."""
        return np.asarray(self.derived(self, "learnt_sd", k)(self.state[k]))

    @cached_property
    def law(self) -> str:
        """The controllers as text, with dt and the version; "" for files without them."""
        return str(self.derived(self, "law", slice(None)))

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Events that a `Monitor` detected; of a simulated run, from the recorded instants."""
        return tuple(self.derived(self, "events", slice(None)))

    def describe_events(self) -> dict[str, str]:
        """Return the events as text, the first few by name."""
        texts = [f"{event}" for event in self.events[:_NAMED]]
        if len(self.events) > _NAMED:
            texts.append(f"and {len(self.events) - _NAMED} more")
        return {"events": "; ".join(texts)} if texts else {}

    @property
    def target(self) -> Array:
        """x_d at the end, shape (n_x,)."""
        return np.array(self.x_d[-1])

    @property
    def task_unit(self) -> str:
        """Unit of x, error and target; different ones joined by "or"."""
        return joined(self.task_units)

    @property
    def units(self) -> Mapping[str, str]:
        """Array name → unit; those of different kinds of joints joined by "or"."""
        kinds = [joint for joint in _TORQUE if joint in self.joint_units]
        return {name: joined(self._unit(name, joint) for joint in kinds) for name in _COLUMNS}

    def _unit(self, name: str, joint: str) -> str:
        torque, task = _TORQUE[joint], self.task_unit
        command = torque if self.command_kind == "torque" else f"{joint}/s"
        return _COLUMNS[name][1].format(task=task, joint=joint, torque=torque, command=command)

    @property
    def has_torque(self) -> bool:
        """True if `tau` is known."""
        return bool(np.isfinite(self.tau).any())

    @property
    def error_norm(self) -> Array:
        """‖e‖ over time, shape (N,)."""
        return np.asarray(np.linalg.norm(self.error, axis=1))

    @cached_property
    def at_stops(self) -> dict[str, float]:
        """Joint name → time beyond a position limit [s], by the recorded instants."""
        if self.scene is None:
            return {}
        share = (self.scene.truth.beyond_limits(self.q) > _TOUCHES).mean(axis=0)
        times = zip(self.joint_names, (share * (self.t[-1] - self.t[0])).tolist(), strict=True)
        return {name: time for name, time in times if time > 0.0}

    def status_counts(self) -> dict[Status, int]:
        """Count the recorded instants with each status."""
        return {Status(s): n for s, n in sorted(Counter(self.status.tolist()).items())}

    def limit_status_counts(self) -> dict[LimitStatus, int]:
        """Count the recorded instants with each status of the limits."""
        return {LimitStatus(s): n for s, n in sorted(Counter(self.limit_status.tolist()).items())}

    def save(self, path: str | Path) -> Path:
        """Write the run to a .npz file that `Trajectory.load` and `numpy.load` read.

        Returns:
            The path written, with the ending .npz.

        Raises:
            TrajectoryFileError: The file cannot be written.
        """
        path = _npz(path)
        kept = {f.name: getattr(self, f.name) for f in fields(self)} | {"law": self.law}
        kept |= {name: getattr(self, name) for name in _DERIVED} | {"events": self.events}
        kept["scene"] = self.scene and self.scene.to_dict()
        del kept["derived"]
        arrays: dict[str, Any] = {
            name: each for name, each in kept.items() if isinstance(each, np.ndarray)
        }
        texts = {name: each for name, each in kept.items() if name not in arrays}
        try:
            # an open file, because numpy would add a second ending to .NPZ
            with replaced(path) as unfinished, unfinished.open("wb") as file:
                np.savez_compressed(file, texts=np.array(json.dumps(texts)), **arrays)
        except OSError as error:
            message = f"path must be a file that can be written, got {path}: {reason(error)}"
            raise TrajectoryFileError(message, given=path) from error
        return path

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a run that `save` wrote.

        Raises:
            TrajectoryFileError: No such file, or not a trajectory.
        """
        path = _npz(path)
        try:
            with path.open("rb") as stream:
                kept = read_arrays(stream)
            for name, text in json.loads(str(kept.pop("texts"))).items():
                kept[name] = tuple(text) if isinstance(text, list) else text
            derived = {name: kept.pop(name) for name in (*_DERIVED, "law")}
            unknown = np.full(kept["learnt"].shape[-1], np.nan)
            others = {"law": derived.pop("law"), "learnt_sd": lambda state: unknown}
            others["events"] = [Event(Condition(kind), *rest) for kind, *rest in kept.pop("events")]
            kept["scene"] = kept["scene"] and Scene.from_dict(kept["scene"])
            own = {f.name: kept[f.name] for f in fields(cls) if f.name in kept}
            own["derived"] = lambda _, name, at: (
                derived[name][at] if name in derived else others[name]
            )
            run = cls(**own)
            run._require_fit(others["law"])
            return run
        except FileNotFoundError as error:
            message = f"trajectory file {path} does not exist"
            raise TrajectoryFileError(message, given=path) from error
        except Exception as error:  # NumPy, zipfile, zlib and json each raise their own
            why = str(error) if zipfile.is_zipfile(path) else "it is no .npz file"
            message = f"{path} is not a trajectory written by Trajectory.save: {why}"
            raise TrajectoryFileError(message, given=path) from error

    def _require_fit(self, law: object) -> None:
        """Raise a ValueError if what a file kept does not fit together."""
        names, units = self.joint_names + self.task_labels, self.joint_units + self.task_units
        texts = (*names, *units, self.robot_name, self.ended, self.fault_name, self.engine, law)
        lengths = {"n_v": len(self.joint_names), "m": len(self.task_labels)}
        bodies = []
        if self.scene is not None:
            bodies = [self.scene.truth, self.scene.belief or self.scene.truth]
            lengths |= {"nq": bodies[0].nq, "p": len(self.scene.parameters)}
        for name, (axis, _) in _COLUMNS.items():
            array, shape = getattr(self, name), self.t.shape
            if axis:
                shape += (lengths.setdefault(axis, np.shape(array)[-1]),)
            if array.shape != shape or array.dtype not in _NUMBERS:
                raise ValueError(f"{name} must be numbers of shape {shape}, got {array.shape}")
        for fits, why in (
            (all(isinstance(text, str) for text in texts), "its names or its law are no texts"),
            (len(self.joint_units) == lengths["n_v"], "its joints and their units differ"),
            (len(self.task_units) == lengths["m"], "its coordinates and their units differ"),
            (self.command_kind in ("torque", "velocity"), "its commands are of no known kind"),
            (set(self.joint_units) <= set(_TORQUE), "joints have other units than rad or m"),
            (all(body.nv == lengths["n_v"] for body in bodies), "its scene has other joints"),
            (set(np.unique(self.status)) <= set(Status), "it has an unknown status"),
            (set(np.unique(self.limit_status)) <= set(LimitStatus), "it has an unknown status"),
            (len(self.t) and np.isfinite(self.t).all(), "it is empty, or has no times"),
            ((np.diff(self.t) > 0.0).all(), "its times do not increase"),
        ):
            if not fits:
                raise ValueError(why)

    def __str__(self) -> str:
        """Return the error first, then the largest command, and what was wrong meanwhile."""
        return "\n".join([*wrapped(self._error_line()), *rows(self._figures(), 2)])

    def _figures(self) -> dict[str, str]:
        """Return names and figures to print below the error."""
        figures = {"run": f"{self.robot_name}, {self.t[-1]:g} s, {len(self.t)} samples"}
        if self.command_kind == "velocity":
            figures["velocity"] = self.describe_largest("command")
        if self.has_torque:
            figures["torque"] = self.describe_largest("tau")
        figures["law's status"] = shares(self.status_counts())
        if (self.limit_status != LimitStatus.UNLIMITED).any():
            figures["limits' status"] = shares(self.limit_status_counts())
        if self.at_stops:
            figures["stops"] = self.describe_stops()
        if self.ended:
            figures["ended"] = self.ended
        if self.engine:
            figures["engine"] = self.engine
        return figures

    def _error_line(self) -> str:
        norm, last = self.error_norm, len(self.t) - 1
        error = f"error {norm[0]:.3g} -> {norm[-1]:.3g} {self.task_unit}"
        above = np.nonzero(norm > 0.01 * norm[0])[0]
        if len(above) and above[-1] < last:
            error += f", below 1 % of the start from {self.t[above[-1] + 1]:.3g} s on"
        return error

    def describe_largest(self, name: Literal["command", "tau"]) -> str:
        """Describe the largest command or torque, with its unit and joint."""
        peaks = np.abs(getattr(self, name)).max(axis=0)
        k = int(peaks.argmax())
        unit = self._unit(name, self.joint_units[k])
        return f"at most {peaks[k]:.3g} {unit} ({self.joint_names[k]})"

    def describe_stops(self) -> str:
        """Describe the joints that were at their stops, and for how long; "" if none was."""
        return ", ".join(f"{name} for {time:.3g} s" for name, time in self.at_stops.items())

    def __repr__(self) -> str:
        norm = self.error_norm
        return (
            f"{type(self).__name__}({self.robot_name!r}, {self.t[-1]:g} s, {len(self.t)} samples; "
            f"|e| {norm[0]:.3g} -> {norm[-1]:.3g} {self.task_unit})"
        )


def _npz(path: str | Path) -> Path:
    """Return a path with the ending .npz."""
    require("path", path, (str, Path), "the name of a file")
    path = Path(path)
    if not path.name or "\0" in path.name:
        raise InvalidInputError(f"path must name a file, got {str(path)!r}", given=path)
    return path if path.suffix.lower() == ".npz" else path.with_name(path.name + ".npz")


_RECORDED = (
    "t", "q", "v", "twist", "motor_v", "x", "x_measured", "x_d", "command", "tau", "state",
    "status", "limit_status", "slack",
)  # fmt: skip  # and then e and Ĵ, of which the rest is derived


class Record:
    """A recorder of at most `capacity` instants of a run, for a `Trajectory`."""

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
        motors: Motors | None = None,
    ) -> None:
        """Record one instant: the truth, the controller's x, state and output, the torque."""
        t, q, v, x, _ = truth
        command, _, status, e, J_hat, _, limit_status, slack, _ = answer
        if J_hat is None:
            J_hat = np.full((len(e), len(v)), np.nan)
        if not self._controllers or self._controllers[-1][1] is not controller:
            self._controllers.append((self._count, controller))
        turned = (np.zeros_like(v), v) if motors is None else (motors.twist, motors.rate)
        row: tuple[Any, ...] = (
            t, q, v, *turned, x, x_measured, target, command, tau, state, status, limit_status,
            slack, e, J_hat,
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
        """Return the record of a whole run of one controller, of arrays with time first."""
        record = cls(plant, len(columns[0]), dt)
        record._columns, record._count = tuple(columns), len(columns[0])
        record._controllers = [(0, controller)]
        return record

    def trajectory(self) -> Trajectory:
        """Return the recorded run."""
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
        each = zip(x, x_d, strict=True)
        return Trajectory(
            **run,
            command_kind=plant.command,
            error=x - x_d if sensor.subtracts else np.array([sensor.error(*pair) for pair in each]),
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
        starts, controllers = zip(*self._controllers, strict=True)
        last = controllers[-1]
        learnt: Array = np.full_like(last.learnt(states[:, : last.size]), np.nan)
        for controller, start, end in zip(controllers, starts, [*starts[1:], None], strict=True):
            if controller.parameters == last.parameters:
                learnt[start:end] = controller.learnt(states[start:end, : controller.size])
        return learnt

    def _events(self, run: Trajectory) -> list[Event]:
        """Return the events, from the controllers' knowledge at the recorded instants."""
        J_hat, dt = self._columns[-1], self._dt or 0.0
        starts, controllers = zip(*self._controllers, strict=True)
        monitor, of = Monitor(controllers[0], self._plant.adds_gravity), 0
        for k, (t, q, v) in enumerate(zip(run.t, run.q, run.v, strict=True)):
            if (number := bisect_right(starts, k) - 1) != of:
                of, monitor = number, monitor.with_controller(controllers[number])
            controller = controllers[of]
            before, reference = max(k - 1, 0), None
            since, torque = t - run.t[before], run.command[before]
            if since > 1.5 * dt:  # not each command is recorded
                torque = 0.5 * (torque + run.command[k])
            way = controller.task.measured.error(run.x_d[k], run.x_d[before])
            if way.any() and np.isfinite(J_hat[k]).all() and J_hat.shape[1] == len(way):
                reference = np.linalg.pinv(J_hat[k]) @ way / since
            measured = Measurement(float(t), q, v, run.x_measured[k])
            monitor.look(measured, torque, reference, run.state[k, : controller.size])
        return monitor.events

    def _derive(self, run: Trajectory, name: str, instants: Any) -> Any:
        """Return a derived quantity of `Trajectory` by its name, by the controllers that ran."""
        if name == "law":
            return self._law()
        if name == "events":
            return self._events(run)
        if name == "learnt_sd":
            last = self._controllers[-1][1]
            return lambda state: last.learnt_sd(state[: last.size])
        e, J_hat = self._columns[len(_RECORDED) :]
        plant, values = self._plant, []
        starts, controllers = zip(*self._controllers, strict=True)
        for k in np.arange(len(run.t))[instants].tolist():
            controller = controllers[bisect_right(starts, k) - 1]
            answer = Evaluation(
                run.command[k], None, Status(run.status[k]), e[k],
                None if np.isnan(J_hat[k]).all() else J_hat[k], None,
                LimitStatus(run.limit_status[k]), run.slack[k],
            )  # fmt: skip
            x, x_d, state = run.x[k], run.x_d[k], run.state[k, : controller.size]
            at = Instant(
                run.q[k], run.v[k], controller.task.error(x, x_d), x_d, state, answer,
                plant.dynamics, plant.adds_gravity,
            )  # fmt: skip
            derive = controller.lyapunov if name == "V" else controller.task_torque
            values.append(derive(at))
        return np.array(values)


def scene_of(plant: Plant, controller: Controller) -> Scene:
    """Return the robots, sensors, tasks and walls of a run."""
    task = controller.task
    limits, learns = plant.motor_limits, controller.parameters
    planes: list[Any] = [each for each in controller.motion_limits if hasattr(each, "normal")]
    walls = np.array([(each.point, each.normal) for each in planes]).reshape(-1, 2, 3)
    return Scene(plant.robot, task.robot, plant.sensor, task, limits, learns, walls=walls)
