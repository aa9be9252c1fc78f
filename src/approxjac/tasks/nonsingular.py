"""A Jacobian designed to keep its rank where that of the robot loses it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from approxjac import law
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import Robot
from approxjac.robots.traced import moved
from approxjac.tasks.analysis import vanishing
from approxjac.tasks.task import Task, WrappedTask
from approxjac.validation import Array, as_number, require

_TINY = 1e-300


class NonsingularTask(WrappedTask):
    """A task whose Ĵ is designed to stay of full rank at the robot's singular configurations.

    The paper (section 6) remarks that Ĵ may be chosen so that the arm does not stall there. Here

        Ĵ_d(q) = Ĵ(q) + P(q) (Ĵ(q ⊕ bend) − Ĵ(q)),   P = Σ wᵢ uᵢuᵢᵀ,   wᵢ = max(0, 1 − (σᵢ/ε)²)

    with σᵢ, uᵢ the singular values and left singular vectors of Ĵ(q) and ε = `ratio` · σ_max (or of
    a tenth of the σ_max that Ĵ typically has, where even σ_max is smaller): task directions that
    are being lost get the rows of a configuration that is bent a little. `bend` also decides to
    which side the arm folds: of a square Jacobian the singular configurations are moved to the
    other side of the fold, as its determinant has to change its sign somewhere.

    For controllers; a sensor is a plain task of the true robot.

    Args:
        task: The task of the believed robot.
        bend: Joint name → how far the bent one is away [rad or m], such as {"joint4": 0.3}.
        ratio: Share of the largest singular value below which Ĵ is changed, > 0 and < 1.

    Raises:
        UnknownNameError: No such joint.
        InvalidInputError: No joint bent, a displacement that is zero or not finite, or a ratio
            out of range.
    """

    def __init__(self, task: Task, bend: Mapping[str, float], ratio: float = 0.1) -> None:
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        require("bend", bend, Mapping, "a mapping from joint names to displacements")
        super().__init__(task)
        self._ratio = as_number("ratio", ratio, above=0.0)
        if self._ratio >= 1.0:
            raise InvalidInputError(f"ratio must be < 1, got {ratio!r}", given=ratio)
        robot = task.robot
        offset = np.zeros(robot.nv)
        for joint, displacement in bend.items():
            if joint not in robot.joint_names:
                raise UnknownNameError("moving joint", joint, robot.name, robot.joint_names)
            name = f"bend of {joint}"
            i = robot.joint_names.index(joint)
            offset[i] = as_number(name, displacement, unit=robot.joint_units[i])
            if abs(offset[i]) > 2.0 * np.pi and robot.joint_units[i] == "rad":
                raise InvalidInputError(
                    f"{name} must be less than a turn [rad], got {displacement!r}", given=bend
                )
        if not offset.any():
            raise InvalidInputError(
                f"bend must displace at least one joint of {robot.name}, got {dict(bend)}",
                given=bend,
            )
        self._bend = offset
        self._scale = vanishing(task)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        J = law.array(self.task.jacobian(q, x))
        G = J @ J.T

        def designed() -> tuple[Array]:
            squares, U = np.linalg.eigh(G)
            weights = self._weights(squares)
            if type(weights) is np.ndarray and not weights.any():
                return (J,)
            bent = self.task.jacobian(moved(self.robot, q, self._bend), x)
            return (J + (U * weights) @ U.T @ (bent - J),)

        may_be = law.may_be_singular(G, self._ratio, self._scale)
        return np.asanyarray(law.choose(may_be, designed, lambda: (J,))[0])

    def design_error(self, q: Array) -> float:
        """Return ‖Ĵ_d − Ĵ‖, what the design adds to (7)'s p; 0 away from singular."""
        return float(np.linalg.norm(self.jacobian(q) - self.task.jacobian(q), 2))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        J = self.task.jacobian(q)
        changed = self._weights(np.asarray(np.linalg.eigvalsh(J @ J.T))).any()
        return super().jacobian_dot(q, v) if changed else self.task.jacobian_dot(q, v)

    def _weights(self, squares: Array) -> Array:
        """Return the weight of each left singular vector, 1 where its singular value is 0."""
        threshold = self._ratio**2 * np.maximum(squares.max(), max(self._scale**2, _TINY))
        weights: Array = np.maximum(0.0, 1.0 - np.maximum(squares, 0.0) / threshold)
        return weights

    def on(self, robot: Robot) -> Task:
        """Return the task that was designed around, of another robot."""
        return self.task.on(robot)

    def __repr__(self) -> str:
        bent = zip(self.robot.joint_names, self._bend.tolist(), strict=True)
        shown = {joint: displacement for joint, displacement in bent if displacement}
        return f"NonsingularTask({self.task!r}, bend={shown})"
