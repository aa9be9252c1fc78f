"""`VisiblePart` of a region: elsewhere no law acts, and no condition says anything."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.stability.errors.region import Region
from approxjac.tasks import Task
from approxjac.tasks.analysis import sees
from approxjac.validation import Array

_TRIES = 1000  # for each configuration that is seen
_NEARBY = 20  # tries
_HALVINGS = 30  # of the way out of the view


class UnattainedError(InvalidInputError):
    """A target that a true robot does not attain in the region, or a region that it cannot see."""

    def __init__(self, message: str, *, given: object, truth: int) -> None:
        super().__init__(message, given=given)
        self.truth = truth  # index of the true robot, or of the run


class VisiblePart:
    """The configurations of a region that a sensor sees: all of them, but for cameras.

    The sensor is a task of the true robot, whose index `truth` is told in errors.
    """

    def __init__(self, region: Region, sensor: Task, truth: int = 0) -> None:
        self.region, self.sensor, self.truth = region, sensor, truth

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n configurations that are seen, shape (n, nq)."""
        return self.replace_unseen(self.region.sample(n, rng), rng)

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

    def contains(self, q: Array) -> bool:
        """Return whether a configuration (nq,) belongs to the region and is seen."""
        return self.region.contains(q) and sees(self.sensor, q)

    def near(self, q: Array, size: float, rng: np.random.Generator) -> Array:
        """Return a visible configuration about `size` spreads of the region away from such a q."""
        for _ in range(_NEARBY):
            moved = self.region.near(q, size, rng)
            if sees(self.sensor, moved):
                return moved
        return q

    def between(self, seen: Array, other: Array, share: float) -> Array:
        """Return a share of the way from a visible configuration, halved until it is visible."""
        for _ in range(_HALVINGS):
            q = np.array(pin.interpolate(self.sensor.robot.model, seen, other, share))
            if sees(self.sensor, q):
                return q
            share *= 0.5
        return np.array(seen)
