"""The local test: eigenvalues of the closed loop linearised at the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from approxjac.checks import Array
from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.law import closed_loop_matrix
from approxjac.simulation import Plant


@dataclass(frozen=True, eq=False)
class LocalStability:
    """Eigenvalues of the linearised closed loop, the self-motion's zeros left out.

    Attributes:
        eigenvalues: Shape (2 n_v − (n_v − m),), complex [1/s].
        max_real: Their largest real part [1/s]; −1/max_real is the slowest time constant.
    """

    eigenvalues: NDArray[np.complex128]
    max_real: float

    @property
    def stable(self) -> bool:
        """Whether every error near the target dies out."""
        return self.max_real < 0.0


def local_stability(
    plant: Plant, controller: SetpointController, q_target: Array
) -> LocalStability:
    """Linearise the closed loop of law (6) at rest in a posture that attains the target.

    Gravity is taken as compensated exactly, and s'(0) = 1. For n_v > m the n_v − m eigenvalues
    nearest to zero belong to the self-motion, along which every posture attains the target; they
    are left out.

    Args:
        plant: The true robot, sensor and friction.
        controller: The controller with its believed robot.
        q_target: Posture that attains the target, shape (nq,).

    Raises:
        InvalidInputError: A controller of law (5), whose linearisation is another.
    """
    if controller.velocity is not None:
        raise InvalidInputError(
            f"local_stability is for law (6) with the estimated task velocity, got {controller!r}",
            given=controller,
        )
    kp, kv, damping = controller.diagonals
    A = closed_loop_matrix(
        plant.dynamics.M(q_target),
        plant.sensor.jacobian(q_target),
        controller.task.jacobian(q_target),
        kp,
        kv,
        plant.friction + damping,
    )
    eigenvalues = np.linalg.eigvals(A).astype(np.complex128)
    self_motion = plant.robot.nv - plant.sensor.m
    eigenvalues = eigenvalues[np.argsort(np.abs(eigenvalues))][self_motion:]
    return LocalStability(eigenvalues, float(eigenvalues.real.max()))
