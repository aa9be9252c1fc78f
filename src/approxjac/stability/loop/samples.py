"""`Samples` that the conditions are evaluated on: terms at many configurations, traced."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.llvm import LlvmLanes, packed, unpacked
from approxjac.codegen.trace.derivatives import rates
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import Symbols, symbols
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics
from approxjac.robots.robot import all_frame_id, own_joints
from approxjac.simulation import Plant
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.tasks import Task
from approxjac.tasks.analysis import jacobian_gradient
from approxjac.validation import Array, Immutable

_MOST_JOINTS = 12  # traced: code for ∂M/∂q grows with their third power
_SHOWN = 3  # true robots from inside that show which numbers differ, besides the corners
_PORTION = 1024  # configurations at once
_ALIKE = 1e-8  # relative difference of terms, which round-off does not make


Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class Terms:
    """Terms of true robots and of the belief at N configurations, with targets x_d."""

    x: Array  # of the sensor, shape (N, n_x)
    e: Array  # shape (N, m)
    J: Array  # of the sensor, without what a controller is to assume in it, shape (N, m, n_v)
    dJ: Array  # ∂J/∂q_k, shape (N, n_v, m, n_v), k first
    J_hat: Array  # Ĵ, shape (N, m, n_v)
    dJ_hat: Array  # ∂Ĵ/∂q_k, shape (N, n_v, m, n_v), k first; of no task that uses x
    M: Array  # inertia matrix of the true robot, shape (N, n_v, n_v)
    dM: Array  # ∂M/∂q_k, shape (N, n_v, n_v, n_v), k first
    g: Array  # its gravity torque, shape (N, n_v)
    dg: Array  # ∂g/∂q, symmetric, shape (N, n_v, n_v)

    def take(self, which: Any) -> Self:
        """Return the terms of some indices."""
        return type(self)(**{name: each[which] for name, each in vars(self).items()})


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Terms):
    """All that the conditions need of N combinations of true robot, configuration and target."""

    truth: Indices  # of the true robot, shape (N,)
    q: Array  # configuration, shape (N, nq)
    x_d: Array  # target, shape (N, n_x)
    J_e: Array  # true ∂e/∂q, which is J where e = x − x_d, shape (N, m, n_v)
    s: Array  # s(e), shape (N, m)
    slope: Array  # s'(e), shape (N, m)

    def __repr__(self) -> str:
        return f"Samples({len(self)} of {len(set(self.truth.tolist()))} true robots)"

    def __len__(self) -> int:
        return len(self.q)

    def join(self, *others: Samples) -> Samples:
        """Return these samples and others after them."""
        each = [vars(samples) for samples in (self, *others)]
        return Samples(**{name: np.concatenate([own[name] for own in each]) for name in each[0]})


class TracedTerms(Immutable):  # in another process a copy makes machine code of its own
    """Terms as one function for all true robots, which differ in numbers only.

    Args:
        plants: True robots and their sensors, which differ in all that will ever differ.
        task: The believed task.

    Raises:
        InvalidInputError, TypeError, ValueError: What takes no symbols, has loops to be
            differentiated, or sensors that differ in more than numbers of cameras.
    """

    def __init__(self, plants: Sequence[Plant], task: Task) -> None:
        sensor, robot = plants[0].sensor, plants[0].robot
        self._frames = tasks.frames(sensor)
        program = self._program = Program()
        self._arm = Arm(program.given, "truth", robot, self._frames, self._numbers(plants))
        of_sensor = tasks.numbers([plant.sensor for plant in plants])
        self._has_camera = bool(of_sensor)
        own = tasks.with_numbers(sensor, {k: program.given(k, v) for k, v in of_sensor.items()})
        q, x_d = program.kept("q", robot.nq), program.kept("x_d", task.n_x)
        here, believed = self._arm.at(q), Arm.known(task.robot).at(q)
        x = tasks.value(own, here)
        with self._arm.standing_in(program.graph):
            J = symbols(tasks.traced("task", sensor, lambda: own.sensor_jacobian(q)))
        J_hat, M, g = tasks.jacobian(task, believed, x), here.M(), here.gravity()
        ways = []
        for joint in own_joints(robot.model).values():
            first, *second = q[joint.idx_q : joint.idx_q + joint.nq]  # cos and sin of a pair
            ways.append([(first, -second[0]), (second[0], first)] if second else [(first, 1.0)])

        def gradient(of: Symbols) -> Symbols:
            return np.stack([rates(of, way) for way in ways])

        dJ_hat = np.zeros((robot.nv, *J_hat.shape)) if task.uses_x else gradient(J_hat)
        terms = Terms(
            x, tasks.error(own, x, x_d), J, gradient(J), J_hat, dJ_hat, M, gradient(M), g,
            gradient(g),
        )  # fmt: skip
        self._shapes = {name: np.shape(each) for name, each in vars(terms).items()}
        program.step(vars(terms))
        self._lanes = LlvmLanes(program, effort=0)
        drawn = [*task.robot.configurations(len(plants))]
        terms = self.at(
            self.numbers(plants), np.array(drawn), np.tile(task.origin, (len(plants), 1))
        )
        for plant, q, x, J in zip(plants, drawn, terms.x, terms.J, strict=True):
            for one, other in ((x, plant.sensor.value(q)), (J, plant.sensor.sensor_jacobian(q))):
                if not np.allclose(one, other, _ALIKE, _ALIKE, equal_nan=True):
                    raise ValueError(f"{plant.sensor!r} is not like {plants[0].sensor!r}")

    def _numbers(self, plants: Iterable[Plant]) -> ArmNumbers:
        return ArmNumbers.stacked([arm_numbers(plant.robot, self._frames) for plant in plants])

    def numbers(self, plants: Iterable[Plant]) -> Array:
        """Return the numbers of true robots, (k, n); a ValueError if other ones differ, too."""
        plants, of_sensors = list(plants), {}
        if self._has_camera:  # to look for them takes longer than all the rest
            of_sensors = tasks.numbers([plant.sensor for plant in plants])
        return self._filled(self._numbers(plants), of_sensors)

    def numbers_at(self, truth: Uncertainty, values: Array) -> Array:
        """Return `numbers` of the true robots at values (k, d), without cameras."""
        belief, k = truth.belief(), len(values)
        frames = [all_frame_id(belief, frame) for frame in self._frames]
        known = arm_numbers(belief, self._frames)
        return self._filled(known.changed(truth.changes(values), frames, k), {})

    def _filled(self, own: ArmNumbers, of_sensors: dict[str, Array]) -> Array:
        numbers = self._program.filled(self._arm.named(own) | of_sensors)
        return numbers if numbers.size else np.zeros((len(own.gravity), 1))

    def at(self, numbers: Array, q: Array, x_d: Array) -> Terms:
        """Return the terms of robots with some numbers (N, n), each at a q with a target."""
        columns = np.concatenate([q, x_d], axis=1)
        rows = np.zeros((len(q), self._program.n_rows))
        rows[:, : columns.shape[1]] = columns
        for start in range(0, len(q), _PORTION):
            at = slice(start, start + _PORTION)
            kept, parameters = (packed(each[at], self._lanes.width) for each in (rows, numbers))
            self._lanes.run(kept, parameters)
            rows[at] = unpacked(kept, len(rows[at]))
        parts = {}
        for name, shape in self._shapes.items():
            first, size = self._program.rows[name]
            parts[name] = rows[:, first : first + size].reshape(-1, *shape)
        return Terms(**parts)


@functools.lru_cache(maxsize=8)
def traced_terms(truth: Plant | Uncertainty, task: Task) -> TracedTerms | None:
    """Return the terms of true robots as one function; None where they are not to be traced.

    Or without llvmlite: on arrays of NumPy it is no faster than `terms_alone`.
    """
    if task.robot.nv > _MOST_JOINTS or importlib.util.find_spec("llvmlite") is None:
        return None
    plants = [truth] if isinstance(truth, Plant) else []
    if isinstance(truth, Uncertainty):
        if not truth.makes_the_robots:
            return None
        rng = np.random.default_rng(0)
        inside = [truth.sample(rng) for _ in range(_SHOWN)]
        plants = [*map(truth.plant, [*truth.corners(), *inside])]
    try:
        return TracedTerms(plants, task)
    except (InvalidInputError, TypeError, ValueError):
        return None


def terms_alone(plant: Plant, dynamics: Dynamics, task: Task, q: Array, x_d: Array) -> Terms:
    """Return the terms of one true robot at one configuration, each without the axis N."""
    sensor, shape = plant.sensor, (task.robot.nv, task.m, task.robot.nv)
    x = sensor.value(q)
    dJ_hat = np.zeros(shape) if task.uses_x else jacobian_gradient(task, q)
    dJ = np.zeros(shape) if sensor.uses_x else jacobian_gradient(sensor, q)
    return Terms(
        x, sensor.error(x, x_d), sensor.sensor_jacobian(q), dJ, task.jacobian(q, x), dJ_hat,
        dynamics.M(q), dynamics.M_gradient(q), dynamics.g(q), dynamics.g_gradient(q),
    )  # fmt: skip
