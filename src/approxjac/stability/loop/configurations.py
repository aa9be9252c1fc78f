"""Configurations of a region: those that are seen, that attain a target, or are singular."""

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.stability.errors.region import Region
from approxjac.stability.loop.samples import Samples
from approxjac.tasks import Task
from approxjac.tasks.analysis import jacobian_gradient, sees
from approxjac.validation import Array

_STEPS = 200
_EXACT = 1e-10  # error that counts as none, relative to the size of the Jacobian
_LONGEST = 0.3  # step [rad or m]


def inverse_kinematics(
    sensor: Task, x_d: Array, q0: Array, *, within_limits: bool = False
) -> Array | None:
    """Return a configuration that a sensor sees with the value x_d, or None if none is found.

    Damped Gauss–Newton steps from a visible start q0 (nq,), which also end at rest where the target
    is out of reach, and where a camera loses its image.

    With `within_limits` a joint that gets to its position limit stays there while the others go on,
    as an arm does on its straight way to a target: None may mean that this way is barred.
    """
    model, neutral = sensor.robot.model, sensor.robot.neutral()
    motion = pin.difference(model, neutral, q0)
    low, high = sensor.robot.position_limits if within_limits else (-math.inf, math.inf)
    for _ in range(_STEPS):
        q = np.array(pin.integrate(model, neutral, motion))
        e, J = sensor.error(sensor.value(q), x_d), sensor.sensor_jacobian(q)
        size = float(np.linalg.norm(J, 2))
        error = float(np.linalg.norm(e))
        if error <= _EXACT * size:
            return q if sees(sensor, q) else None
        if size == 0.0 or math.isnan(error):  # no way to move the task; behind the camera
            return None
        damping = (1e-3 * size) ** 2 * min(1.0, error / size)
        for _ in motion:
            step = -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(e)), e)
            barred = ((motion <= low) & (step < 0.0)) | ((motion >= high) & (step > 0.0))
            if not barred.any():
                break
            J = np.where(barred, 0.0, J)
        shorter = max(1.0, float(np.abs(step).max()) / _LONGEST)
        motion = np.clip(motion + step / shorter, low, high)
    return None


_TRIES = 1000  # for each configuration that is seen
_HALVINGS = 30  # of the way out of the view


class UnattainedError(InvalidInputError):
    """A target that a true robot does not attain in the region, or a region that it cannot see."""

    def __init__(self, message: str, *, given: object, truth: int) -> None:
        super().__init__(message, given=given)
        self.truth = truth  # index of the true robot, or of the run


class VisiblePart(Region):
    """The configurations of a region that the sensor of a true robot sees: all, but for cameras."""

    def __init__(self, region: Region, sensor: Task, truth: int = 0) -> None:
        self.region, self.sensor, self.truth = region, sensor, truth

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        return self.replace_unseen(self.region.sample(n, rng), rng)

    def contains(self, q: Array) -> bool:
        return self.region.contains(q) and sees(self.sensor, q)

    def replace_unseen(self, drawn: Array, rng: np.random.Generator) -> Array:
        """Return configurations (n, nq) of the region, with others for those that are not seen.

        Raises:
            UnattainedError: Hardly any is seen, as far as drawing can tell.
        """
        missing = [k for k, q in enumerate(drawn) if not sees(self.sensor, q)]
        kept, tried = np.array(drawn), len(drawn)
        while missing:
            batch = self.region.sample(max(len(missing), 20), rng)
            tried += len(batch)
            for q in batch:
                if missing and sees(self.sensor, q):
                    kept[missing.pop()] = q
            if missing and tried > _TRIES * (1 + len(drawn) - len(missing)):
                raise UnattainedError(
                    f"the region must hold configurations that the true sensor sees: of {tried} of "
                    f"{self.region!r} it sees {len(drawn) - len(missing)}, got {self.sensor!r}",
                    given=self.sensor,
                    truth=self.truth,
                )
        return kept

    def between(self, seen: Array, other: Array, share: float) -> Array:
        """Return a share of the way from a visible configuration, halved until it is visible."""
        for _ in range(_HALVINGS):
            q = np.array(pin.interpolate(self.sensor.robot.model, seen, other, share))
            if sees(self.sensor, q):
                return q
            share *= 0.5
        return np.array(seen)


_FROM, _NEWTON, _SHORTER = 5, 20, 8


def least_regular(task: Task, parts: Sequence[VisiblePart], samples: Samples) -> Array:
    """Return the configuration (nq,) with the least σ_min(Ĵ) that a search finds.

    Newton steps towards σ_min(Ĵ) = 0 from the least regular samples, halved until they stay in
    the region, of which a true robot's sensor sees some parts, and lead nearer.
    """
    sizes, candidates = np.linalg.svd(samples.J_hat, compute_uv=False)[:, -1], []
    for k in np.argsort(sizes)[:_FROM]:
        part = parts[int(samples.truth[k])]
        q: Array = samples.q[k]
        size, gradient = _sigma_min(task, q)
        for _ in range(_NEWTON):
            step = -size * gradient / max(float(gradient @ gradient), 1e-300)
            for halving in range(_SHORTER):
                moved = np.array(pin.integrate(task.robot.model, q, 0.5**halving * step))
                if part.contains(moved):
                    nearer, its_gradient = _sigma_min(task, moved)
                    if nearer < size:
                        break
            else:
                break
            q, size, gradient = moved, nearer, its_gradient
        candidates.append((size, q))
    return min(candidates, key=lambda each: each[0])[1]


def _sigma_min(task: Task, q: Array) -> tuple[float, Array]:
    """Return σ_min(Ĵ) and ∂σ_min/∂q = uᵀ(∂Ĵ/∂q_k)v, shape (n_v,)."""
    U, values, rows = np.linalg.svd(task.jacobian(q))
    u, v = U[:, -1], rows[len(values) - 1]
    return float(values[-1]), np.asarray(u @ jacobian_gradient(task, q) @ v)
