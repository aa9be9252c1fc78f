"""Gains from the believed arm's own inertia and a wanted settling time."""

from __future__ import annotations

import numpy as np

from approxjac.controllers.gains.gains import Diagonals, Gains
from approxjac.controllers.gains.sample_configurations import usual_postures
from approxjac.tasks import Task
from approxjac.tasks.analysis import require_controllable
from approxjac.validation import Array, as_number

SETTLED = 4.0
"""Time constants until 2 % are left."""

_DAMPING_SHARE = 0.03
_NO_TIME = 1e-50  # settling times below it have gains that overflow [s]


def default_gains(task: Task, settling_time: float = 1.0, bandwidth: float = 1000.0) -> Gains:
    """Return gains with which the believed arm settles to 2 % in about `settling_time`.

    With r = 4 / settling_time, Λ the inertia that the arm shows to a force along a task
    coordinate, 1 / (Ĵ M⁻¹ Ĵᵀ)ᵢᵢ, and M its inertia matrix, each the median over configurations
    within the joint limits (seeded, without those that are singular or out of a camera's view):

        K_v = 4 r Λ,   B_c = r Mᵢᵢ + b,   b = 0.03 λ_max[Ĵᵀ K_v Ĵ],   K_p = r (K_v + K_b),

    with K_b = 1 / (Ĵ B_c⁻¹ Ĵᵀ)ᵢᵢ what B_c adds to the damping along a coordinate. So the slow
    pole of Λë + (K_v + K_b) ė + K_p e = 0 is at about −r. Coordinates of one unit get the same
    gain, so the rule has no favourite axis and orientation keeps its potential; those of an
    orientation get K_v ≥ 2 b.

    The added damping lets condition (21) hold: it asks for λ_min[ĴᵀK_vĴ + B] > 0, and along a
    self-motion that is B alone. Its first term makes a self-motion decay like exp(−r t). The
    second keeps the wrist quiet when a tool is longer than believed: Ĵ has no lever there
    and K_v no effect, while the error feels the tool's.

    Damping that acts faster than it is computed turns into its opposite. So K_v (and K_p with it)
    of each unit and B_c of each joint are reduced to where λ_max[M⁻¹ĴᵀK_vĴ] and (M⁻¹)ᵢᵢ B_c, each
    taken alone, are at most half of `bandwidth`.

    Args:
        task: The task of the believed robot.
        settling_time: > 0 [s].
        bandwidth: How fast damping may be > 0 [1/s]: 1/dt where control is sampled with an exact q̇,
            1/(dt + T) with a q̇ that is filtered with the time constant T.

    Raises:
        InvalidInputError: Numbers that are not positive, or a task that is singular in every
            configuration.
    """
    require_controllable(task)
    rate = SETTLED / as_number("settling_time", settling_time, unit="s", above=_NO_TIME)
    fastest = 0.5 * as_number("bandwidth", bandwidth, unit="1/s", above=0.0)
    postures = usual_postures(task)
    J = postures.J_hat
    mobility = J @ postures.M_inv @ np.swapaxes(J, 1, 2)
    inertia = np.median(1.0 / np.diagonal(mobility, axis1=1, axis2=2), axis=0)
    kv = 4.0 * rate * postures.by_unit(inertia)
    largest = np.linalg.norm(J * np.sqrt(kv)[:, None], 2, axis=(1, 2)) ** 2
    quieting = _DAMPING_SHARE * float(np.median(largest))
    angles = np.array(task.units) == "rad"
    kv[angles] = np.maximum(kv[angles], 2.0 * quieting)
    for group in postures.groups:
        # M⁻¹JᵀK_vJ has the eigenvalues of K_v times the mobility
        fastest_mode = np.linalg.norm(mobility[:, group][:, :, group], 2, axis=(1, 2)).max()
        kv[group] = np.minimum(kv[group], fastest / fastest_mode)
    own = np.median(np.diagonal(postures.M, axis1=1, axis2=2), axis=0)
    most = fastest / np.diagonal(postures.M_inv, axis1=1, axis2=2).max(axis=0)
    damping = np.minimum(rate * own + quieting, most)
    return Gains(kp=rate * (kv + postures.felt_damping(damping)), kv=kv, damping=damping)


def position_gains(task: Task, kv: Array, damping: Array, settling_time: float) -> Array:
    """Return K_p of `default_gains` for a K_v (m,) and a B_c (n_v,) of one's own, shape (m,)."""
    return SETTLED / settling_time * (kv + usual_postures(task).felt_damping(damping))


def slow_rate(task: Task, gains: Diagonals) -> float:
    """Return the rate of the slow pole, min k_p / (k_v + K_b), K_b as in `default_gains` [1/s]."""
    felt = usual_postures(task).felt_damping(gains.damping)
    return float((gains.kp / (gains.kv + felt)).min())
