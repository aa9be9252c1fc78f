"""The closed loops that are analysed: one controller on one or several true robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation import Plant
from approxjac.stability.matrix_form import Setting
from approxjac.stability.region import JointBox, Region, RegularPart
from approxjac.stability.uncertainty import Uncertainty
from approxjac.tasks.analysis import vanishing
from approxjac.validation import Array, require

EXACT_GRAVITY = 1e-5
"""Gravity torque that counts as none [N m or N]."""
_REGULAR = 0.5  # times a tenth of the typical σ_max, below which postures are left out


def require_law(controller: SetpointController) -> None:
    """Refuse controllers whose closed loop is neither eq. (9) nor that of (28), (29)."""
    if controller.velocity is not None or controller.posture is not None:
        raise InvalidInputError(
            "the conditions are those of the laws (6) and (28) without a posture torque, got "
            f"{controller!r} with velocity = {controller.velocity!r} and "
            f"posture = {controller.posture!r}",
            given=controller,
        )


def require_gravity(
    controller: SetpointController, uncertainty: Uncertainty, region: Region
) -> None:
    """Refuse gravity that is neither exact nor can be learnt on the true robots of a set."""
    _, plants = true_plants(controller, uncertainty)
    error = gravity_error(controller, plants, region.sample(5, np.random.default_rng(0)))
    if error > EXACT_GRAVITY:
        raise InvalidInputError(
            f"gravity must be compensated exactly or be learnt, got an error of {error:.3g} N m; "
            "AdaptiveGravity learns it, and robots with_gravity((0, 0, 0)) take it as compensated",
            given=controller,
        )


def true_plants(
    controller: SetpointController, truth: Plant | Robot | Uncertainty
) -> tuple[Array, list[Plant]]:
    """The corners (k, d) of a set of true robots and their plants; of a single one, that."""
    if isinstance(truth, Uncertainty):
        corners = truth.corners()
        plants = [truth.plant(values) for values in corners]
        for plant in plants:
            plant.require_task(controller.task)
        return corners, plants
    if isinstance(truth, Robot):
        truth = Plant(truth, controller.task.on(truth))
    require("truth", truth, Plant, "a Plant, a Robot or an Uncertainty")
    return np.zeros((1, 0)), [truth]


def default_region(controller: SetpointController) -> Region:
    """The joint limits of the believed robot, without postures where Ĵ is near singular."""
    task = controller.task
    return RegularPart(JointBox(task.robot), task, _REGULAR * vanishing(task))


def setting_of(controller: SetpointController, plant: Plant) -> Setting:
    """Gains and damping of a closed loop."""
    kp, kv, damping = controller.diagonals
    alpha = None if controller.adaptation is None else controller.adaptation.alpha
    return Setting(kp, kv, damping + plant.friction, controller.saturation.c_bar, alpha)


def gravity_error(
    controller: SetpointController, plants: Sequence[Plant], postures: Array
) -> float:
    """Largest gravity torque that the controller does not compensate, nor learn to [N m or N]."""
    if controller.adaptation is not None:
        regressor = controller.adaptation.regressor
        worst = 0.0
        for plant in plants:
            residual = regressor.fit(plant.robot)[1]
            worst = max(
                worst, residual * max(float(np.abs(plant.dynamics.g(q)).max()) for q in postures)
            )
        return worst
    gravity = controller.gravity
    return max(
        float(np.abs(gravity.torque(q) - plant.dynamics.g(q)).max())  # type: ignore[union-attr]
        for plant in plants
        for q in postures
    )
