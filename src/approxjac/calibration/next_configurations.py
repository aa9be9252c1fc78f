"""`next_configurations`: where to measure."""

from collections.abc import Sequence

import numpy as np

from approxjac.calibration.calibrate import KINDS, USUAL_SD, Calibration
from approxjac.errors import InvalidInputError
from approxjac.robots import KinematicRegressor, Robot
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.validation import Array, as_integer, require

_CANDIDATES = 1000
_NOISE = 2e-4  # m, sd of a measured coordinate
_ANYWHERE = 1.0  # m, sd of the place that is touched, or of the tracker's origin


def next_configurations(
    arm: Robot,
    calibration: Calibration | None = None,
    count: int = 16,
    candidates: Sequence[Sequence[float]] | Array | None = None,
) -> Array:
    """Return the configurations that tell most about an arm, shape (count, nq) [rad or m].

    One by one that whose measurement brings the most information, log det(1 + HPHᵀ/σ²), with what
    the ones before tell. The place at which the tip is held, or the tracker's origin, is unknown.
    No measurement is needed.

    Args:
        arm: The arm as it is drawn.
        calibration: What is known already of it; by default nothing.
        count: How many.
        candidates: Configurations to choose from, (N, nq): those at which the tip can be held at
            one place, if it is. By default a thousand random ones within the joints' ranges.

    Raises:
        InvalidInputError: Too few candidates, or a calibration of another arm.
    """
    arm = require("arm", arm, Robot, "a Robot")
    count, kinds = (
        as_integer("count", count, 1),
        KINDS if calibration is None else calibration.kinds,
    )
    unknowns = Unknowns(KinematicRegressor(arm, axes="axes" in kinds), kinds, USUAL_SD)
    drawn = [*arm.configurations(_CANDIDATES)] if candidates is None else candidates
    rows = [arm.configuration(q) for q in drawn]
    if len(rows) < count:
        message = f"candidates must be at least {count} configurations, got {len(rows)}"
        raise InvalidInputError(message, given=candidates)
    P, u, n = np.diag(unknowns.sd**2), unknowns.u, len(unknowns.u)
    if calibration is not None:
        if calibration.names != tuple(unknowns.names):
            message = f"calibration must be of {arm.name}, got one of {calibration.robot.name}"
            raise InvalidInputError(message, given=calibration)
        P, u = calibration.covariance, calibration.learnt
    C = np.zeros((n + 3, n + 3))
    C[:n, :n], C[n:, n:] = P, _ANYWHERE**2 * np.eye(3)
    H = np.array([np.hstack([unknowns.at(q, u)[0], np.eye(3)]) for q in rows])
    chosen: list[int] = []
    for _ in range(count):
        S = np.eye(3) + H @ C @ H.transpose(0, 2, 1) / _NOISE**2
        gains = np.linalg.slogdet(S)[1]
        gains[chosen] = -np.inf
        chosen.append(int(gains.argmax()))
        best = H[chosen[-1]]
        CH = C @ best.T
        C = C - CH @ np.linalg.solve(best @ CH + _NOISE**2 * np.eye(3), CH.T)
    return np.array([rows[i] for i in chosen])
