"""Seeded configurations of the believed arm for choosing default gains and learning rates."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.law import SINGULAR_RATIO
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task
from approxjac.tasks.analysis import image_feature, seen_configurations
from approxjac.validation import Array

_CONFIGURATIONS = 100
_SINGULAR = 1e-9  # σ_min/σ_max that counts as no rank
_REGULAR = 0.05  # configurations with σ_min below this share of σ_max are left out
_FEW = 0.1  # as a share of them, which is too few to know what is usual
_NO_DAMPING = 1e-9  # instead of none, which would divide by zero
_LEAST_RATIO = 1e-6  # ratio of singular values
_OF_POINTS = 6  # coordinates of an image, from which on it may show some motions badly
_UNUSUAL = 0.2  # of the usual σ_min/σ_max
_FEWER = 20  # configurations that tell what ratio is usual


@dataclass(frozen=True, eq=False)
class SampleConfigurations:
    """Configurations in which a task is seen and regular, with Ĵ and M̂ of the believed arm."""

    q: Array  # shape (k, nq)
    J_hat: Array  # shape (k, m, n_v)
    M: Array  # inertia matrices, shape (k, n_v, n_v)
    M_inv: Array  # their inverses
    # which coordinates have the same unit, unit by unit, each of shape (m,)
    groups: tuple[np.ndarray[Any, np.dtype[np.bool_]], ...]

    def with_rotors(self, inertia: Array) -> SampleConfigurations:
        """Return them with rotor inertias (n_v,) in M [kg m² or kg]."""
        M = self.M + np.diag(inertia)
        return replace(self, M=M, M_inv=np.asarray(np.linalg.inv(M)))

    @functools.cached_property
    def mobility(self) -> Array:
        """Ĵ M⁻¹ Ĵᵀ at each configuration, shape (k, m, m)."""
        return self.J_hat @ self.M_inv @ self.J_hat.mT

    @functools.cached_property
    def inertia(self) -> Array:
        """Inertia Λ along each task coordinate, 1 / (Ĵ M⁻¹ Ĵᵀ)ᵢᵢ, by unit; shape (m,)."""
        return self.by_unit(np.median(1.0 / np.diagonal(self.mobility, axis1=1, axis2=2), axis=0))

    @functools.cached_property
    def inertia_in_joints(self) -> float:
        """λ_max[Ĵᵀ Λ Ĵ], the median over configurations."""
        root = self.J_hat * np.sqrt(self.inertia)[:, None]
        return float(np.median(np.linalg.norm(root, 2, axis=(1, 2)) ** 2))

    @functools.cached_property
    def largest_mobility(self) -> list[float]:
        """The largest eigenvalue of Ĵ M⁻¹ Ĵᵀ among coordinates of each unit."""
        blocks = (self.mobility[:, group][:, :, group] for group in self.groups)
        return [float(np.linalg.norm(block, 2, axis=(1, 2)).max()) for block in blocks]

    @functools.cached_property
    def joint_inertia(self) -> Array:
        """Mᵢᵢ of each joint, the median over configurations; shape (n_v,)."""
        return np.asarray(np.median(np.diagonal(self.M, axis1=1, axis2=2), axis=0))

    def felt_damping(self, damping: Array) -> Array:
        """Return the damping of B_c (n_v,) along task coordinates, 1 / (Ĵ B_c⁻¹ Ĵᵀ)ᵢᵢ.

        The median over configurations, and the mean over coordinates of one unit; shape (m,).
        """
        mobility = self.J_hat**2 @ (1.0 / np.maximum(damping, _NO_DAMPING))
        return self.by_unit(np.median(1.0 / mobility, axis=0))

    def by_unit(self, values: Array) -> Array:
        """Return values (m,), each replaced by the mean over coordinates of its unit."""
        values = values.copy()
        for group in self.groups:
            values[group] = values[group].mean()
        return values


@functools.lru_cache(maxsize=8)
def sample_configurations(task: Task) -> SampleConfigurations:
    """Return seeded configurations within the joint limits, the same each time.

    Raises an InvalidInputError if the task is singular in all of them.
    """
    seen = np.array(seen_configurations(task, _CONFIGURATIONS))
    jacobians = np.array([task.jacobian(q) for q in seen])
    values = np.linalg.svd(jacobians, compute_uv=False)
    smallest, largest = values[:, -1], values[:, 0]
    ratios = np.divide(smallest, largest, out=np.zeros(len(seen)), where=largest > 0.0)
    least = _REGULAR
    if np.mean(ratios > least) < _FEW:
        # images of several points always show some motions badly: then half the usual value
        least = max(0.5 * float(np.median(ratios)), _SINGULAR)
    regular = ratios > least
    if not regular.any():
        raise InvalidInputError(
            f"task must not be singular everywhere for gains to be chosen, got {task!r}; leave out "
            'coordinates that the arm does not command, such as y by axes="xz"',
            given=task,
        )
    q, J_hat = seen[regular], jacobians[regular]
    M = np.array([*map(Dynamics(task.robot).M, q)])
    units = np.array(task.units)
    groups = tuple(units == unit for unit in dict.fromkeys(task.units))
    return SampleConfigurations(q, J_hat, M, np.linalg.inv(M), groups)


def singular_ratio(task: Task, most: float = SINGULAR_RATIO) -> float:
    """Return the σ_min/σ_max of Ĵ below which it counts as near singular.

    It is `most`; for images of three points or more, in which a tilt makes small differences in
    every configuration, at most a fifth of the usual ratio.
    """
    if task.m < _OF_POINTS or image_feature(task) is None:
        return most
    seen = seen_configurations(task, _FEWER)
    values = [np.linalg.svd(task.jacobian(q, task.value(q)), compute_uv=False) for q in seen]
    usual = float(np.median([each[-1] / each[0] for each in values]))
    return min(most, max(_UNUSUAL * usual, _LEAST_RATIO))


def usual_inertias(robot: Robot) -> Array:
    """Return M(q) at k seeded configurations within the joint limits, shape (k, n_v, n_v)."""
    rng, M = np.random.default_rng(0), Dynamics(robot).M
    return np.array([M(robot.random_configuration(rng)) for _ in range(_CONFIGURATIONS)])


def max_damping_rate(inertias: Array, damping: Array) -> float:
    """Return the largest eigenvalue of M⁻¹D over configurations, D diagonal of shape (n_v,)."""
    root = np.sqrt(damping)
    scaled = root[:, np.newaxis] * np.linalg.inv(inertias) * root
    return float(np.linalg.eigvalsh(scaled)[:, -1].max())
