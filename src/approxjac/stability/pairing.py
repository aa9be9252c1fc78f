"""A plant and a controller that speak of the same task."""

from __future__ import annotations

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.simulation import Plant


def require_same_task(plant: Plant, controller: SetpointController) -> None:
    """Refuse a controller whose task has other coordinates than the plant's sensor.

    Raises:
        InvalidInputError: Other coordinates, or another number of joints.
    """
    sensor, task = plant.sensor, controller.task
    if sensor.labels != task.labels or plant.robot.nv != task.robot.nv:
        raise InvalidInputError(
            f"the controller's task must have the coordinates of the plant's sensor {sensor!r}, "
            f"got {task!r}",
            given=controller,
        )
