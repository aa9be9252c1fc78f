"""Default gains, from the believed arm's own inertia and a wanted settling time."""

from __future__ import annotations

from typing import Any

import numpy as np

from approxjac.controllers.gains import Diagonals, Gains
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, GravityRegressor, Robot
from approxjac.tasks import Task
from approxjac.tasks.analysis import seen_configurations
from approxjac.validation import Array, as_number, require

_CONFIGURATIONS = 100
_SETTLED = 4.0  # time constants until 2 % are left
_SINGULAR = 1e-6  # σ_min/σ_max that counts as no rank
_REGULAR = 0.05  # configurations with σ_min below this share of σ_max are left out
_DAMPING_SHARE = 0.03
_LEARNING_SPEED = 3.0
_FASTEST_LEARNING = 10.0
_NO_DAMPING = 1e-9  # instead of none, which would divide by zero
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
    require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
    rate = _SETTLED / as_number("settling_time", settling_time, unit="s", above=_NO_TIME)
    fastest = 0.5 * as_number("bandwidth", bandwidth, unit="1/s", above=0.0)
    configurations, jacobians = _regular_configurations(task)
    inertias = np.array([*map(Dynamics(task.robot).M, configurations)])
    inverses = np.linalg.inv(inertias)
    mobility = jacobians @ inverses @ np.swapaxes(jacobians, 1, 2)
    inertia = np.median(1.0 / np.diagonal(mobility, axis1=1, axis2=2), axis=0)
    angles, groups = np.array(task.units) == "rad", _groups(task)
    kv = np.empty(task.m)
    for group in groups:
        kv[group] = 4.0 * rate * inertia[group].mean()
    largest = np.linalg.norm(jacobians * np.sqrt(kv)[:, None], 2, axis=(1, 2)) ** 2
    quieting = _DAMPING_SHARE * float(np.median(largest))
    kv[angles] = np.maximum(kv[angles], 2.0 * quieting)
    for group in groups:
        # M⁻¹JᵀK_vJ has the eigenvalues of K_v times the mobility
        fastest_mode = np.linalg.norm(mobility[:, group][:, :, group], 2, axis=(1, 2)).max()
        kv[group] = np.minimum(kv[group], fastest / fastest_mode)
    damping = rate * np.median(np.diagonal(inertias, axis1=1, axis2=2), axis=0) + quieting
    most = fastest / np.diagonal(inverses, axis1=1, axis2=2).max(axis=0)
    damping = np.minimum(damping, most)
    kp = rate * (kv + _felt_damping(task, damping, jacobians))
    return Gains(kp=kp, kv=kv, damping=damping)


def position_gains(task: Task, kv: Array, damping: Array, settling_time: float) -> Array:
    """Return K_p of `default_gains` for a K_v (m,) and a B_c (n_v,) of one's own, shape (m,)."""
    _, jacobians = _regular_configurations(task)
    return _SETTLED / settling_time * (kv + _felt_damping(task, damping, jacobians))


def default_adaptation(
    task: Task, gains: Diagonals, regressor: GravityRegressor, alpha: float | None = None
) -> tuple[Array, float]:
    """Return L and α for learning gravity about as fast as the gains let the task settle.

    α is the rate of the task's slow pole, min k_p / (k_v + K_b) with the K_b of `default_gains`.
    L = k D with D = 1/mean(‖Zᵢ‖²), so that every parameter counts by the torque it makes, and k
    such that near the target, where the position force makes up for what gravity compensation
    lacks, that lack dies out with three times that rate where it does so fastest (the median over
    configurations).

    Learning a parameter and the motion of the joints that it acts on make an oscillator of
    frequency ω² = Lᵢ Zᵢᵀ M⁻¹ Zᵢ. An entry of L is reduced to where ω is at most ten times the rate
    of the slow pole in every configuration, or a light wrist would be shaken by what is learnt.

    Args:
        task: The task of the believed robot.
        gains: Its gains.
        regressor: Gravity regressor of the believed robot.
        alpha: α if it is chosen already [1/s].

    Returns:
        The diagonal of L, shape (p,), and α [1/s].
    """
    configurations, J = _regular_configurations(task)
    slow = slow_rate(task, gains, J)
    alpha = slow if alpha is None else alpha
    inertias = np.array([*map(Dynamics(task.robot).M, configurations)])
    Z = np.array([*map(regressor.Z, configurations)])
    D = 1.0 / np.mean((Z * Z).sum(axis=1), axis=0)
    # e = K_p⁻¹ Ĵ⁺ᵀ Z Δθ at rest, and Δθ̇ = −L Zᵀ α Ĵ⁺ e
    A = np.linalg.solve(J @ np.swapaxes(J, 1, 2), J) @ Z
    learning = alpha * np.swapaxes(A * D, 1, 2) @ (A / gains.kp[:, None])
    rates = np.linalg.eigvals(learning).real.max(axis=1)
    accelerations = (Z * np.linalg.solve(inertias, Z)).sum(axis=1)
    L = _LEARNING_SPEED * slow / float(np.median(rates)) * D
    return np.minimum(L, (_FASTEST_LEARNING * slow) ** 2 / accelerations.max(axis=0)), alpha


def slow_rate(task: Task, gains: Diagonals, jacobians: Array | None = None) -> float:
    """Return the rate of the slow pole, min k_p / (k_v + K_b), K_b as in `default_gains` [1/s]."""
    if jacobians is None:
        _, jacobians = _regular_configurations(task)
    felt = _felt_damping(task, gains.damping, jacobians)
    return float((gains.kp / (gains.kv + felt)).min())


def usual_inertias(robot: Robot) -> Array:
    """Return M(q) at k seeded configurations within the joint limits, shape (k, n_v, n_v)."""
    rng, M = np.random.default_rng(0), Dynamics(robot).M
    return np.array([M(robot.random_configuration(rng)) for _ in range(_CONFIGURATIONS)])


def _felt_damping(task: Task, damping: Array, jacobians: Array) -> Array:
    """Return what B_c adds to the damping along a task coordinate, 1 / (Ĵ B_c⁻¹ Ĵᵀ)ᵢᵢ.

    The median over configurations, and the mean over coordinates of one unit; shape (m,).
    """
    mobility = jacobians**2 @ (1.0 / np.maximum(damping, _NO_DAMPING))
    felt: Array = np.median(1.0 / mobility, axis=0)
    for group in _groups(task):
        felt[group] = felt[group].mean()
    return felt


def _groups(task: Task) -> list[np.ndarray[Any, np.dtype[np.bool_]]]:
    """Return which coordinates have the same unit, unit by unit."""
    units = np.array(task.units)
    return [units == unit for unit in dict.fromkeys(task.units)]


def _regular_configurations(task: Task) -> tuple[Array, Array]:
    """Return seeded configurations where the task is seen and not near singular, with Ĵ at each."""
    seen = np.array(seen_configurations(task, _CONFIGURATIONS))
    jacobians = np.array([task.jacobian(q) for q in seen])
    values = np.linalg.svd(jacobians, compute_uv=False)
    smallest, largest = values[:, -1], values[:, 0]
    ratios = np.divide(smallest, largest, out=np.zeros(len(seen)), where=largest > 0.0)
    least = _REGULAR
    if not (ratios > least).any():
        # images of several points always tell little of some motion: then half of what is usual
        least = max(0.5 * float(np.median(ratios)), _SINGULAR)
    regular = ratios > least
    if not regular.any():
        raise InvalidInputError(
            f"task must not be singular everywhere for gains to be chosen, got {task!r}; leave out "
            'coordinates that the arm does not command, such as y by axes="xz"',
            given=task,
        )
    return seen[regular], jacobians[regular]
