"""The local test: eigenvalues of the closed loop linearised at the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.checks import Array, require
from approxjac.controllers import AdaptiveGravity, SetpointController
from approxjac.errors import InvalidInputError
from approxjac.law import closed_loop_matrix
from approxjac.simulation import Plant

_SINGULAR = 1e-10  # relative smallest singular value that counts as zero
_EXACT = 1e-6  # relative error of a gravity compensation that counts as none


@dataclass(frozen=True, eq=False)
class LocalStability:
    """Eigenvalues of the linearised closed loop, the self-motion's zeros left out.

    Attributes:
        eigenvalues: Shape (2 n_v − (n_v − m),), complex [1/s].
        max_real_eigenvalue: Their largest real part, the spectral abscissa [1/s];
            −1/max_real_eigenvalue is the slowest time constant.
        singular: Whether J or Ĵ loses rank at the target. Then there are further eigenvalues of
            zero, and the linearisation decides nothing.
    """

    eigenvalues: NDArray[np.complex128]
    max_real_eigenvalue: float
    singular: bool

    @property
    def stable(self) -> bool:
        """Whether every error near the target dies out."""
        return not self.singular and self.max_real_eigenvalue < 0.0


def local_stability(
    plant: Plant, controller: SetpointController, q_target: Array
) -> LocalStability:
    """Linearise the closed loop of law (6) at rest in a posture that attains the target.

    With s'(0) = 1. For n_v > m the n_v − m eigenvalues nearest to zero belong to the self-motion,
    along which every posture attains the target; they are left out.

    Args:
        plant: The true robot, sensor and friction.
        controller: The controller with its believed robot.
        q_target: Posture that attains the target, shape (nq,).

    Raises:
        InvalidInputError: A controller of law (5) or (28), or with a `Posture`, whose
            linearisation is another; one whose gravity is not exact near `q_target`, which is
            then no equilibrium; another task than the sensor's; a `q_target` of the wrong shape;
            or a plant with Coulomb friction, sensing, actuator delay or torque limits.
    """
    require("plant", plant, Plant, "a Plant")
    require("controller", controller, SetpointController, "a SetpointController")
    plant.require_task(controller.task)
    plant.require_ideal("the local test")
    q = plant.robot.configuration(q_target, "q_target")
    if controller.velocity is not None or isinstance(controller.gravity, AdaptiveGravity):
        raise InvalidInputError(
            "local_stability is for law (6), with the estimated task velocity and known gravity, "
            f"got {controller!r}",
            given=controller,
        )
    if controller.posture is not None:
        raise InvalidInputError(
            "local_stability is for controllers without a posture, whose torque is not linearised, "
            f"got {controller.posture!r}",
            given=controller,
        )
    model = plant.robot.model
    nearby = [q, *(pin.integrate(model, q, 1e-3 * unit) for unit in np.eye(plant.robot.nv))]
    wanted = np.array([plant.dynamics.g(posture) for posture in nearby])
    given = np.array([controller.gravity.torque(posture) for posture in nearby])
    error = float(np.abs(given - wanted).max())
    if error > _EXACT * max(1.0, float(np.abs(wanted).max())):
        raise InvalidInputError(
            "the controller's gravity must be exact near the target for it to be an equilibrium, "
            f"got an error of {error:.3g} N m with {type(controller.gravity).__name__}",
            given=controller,
        )
    M, J, J_hat = plant.dynamics.M(q), plant.sensor.jacobian(q), controller.task.jacobian(q)
    kp, kv, damping = controller.diagonals
    A = closed_loop_matrix(M, J, J_hat, kp, kv, plant.friction + damping)
    eigenvalues = np.linalg.eigvals(A).astype(np.complex128)
    self_motion = plant.robot.nv - plant.sensor.m
    eigenvalues = eigenvalues[np.argsort(np.abs(eigenvalues))][self_motion:]
    values = np.linalg.svd(J @ np.linalg.solve(M, J_hat.T), compute_uv=False)
    singular = bool(values[-1] <= _SINGULAR * values[0])
    return LocalStability(eigenvalues, float(eigenvalues.real.max()), singular)
