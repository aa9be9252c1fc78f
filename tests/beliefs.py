"""Made-up calibrations, whose numbers depend on each other as those of real ones do."""

import numpy as np

from approxjac.robots import KinematicBelief, KinematicRegressor


def belief_of(drawing, off=1.0, seed=0, kinds=("tool", "origins", "axes")):
    """Return a belief about an arm that is `off` usual errors from its drawing, and its robot."""
    rng, regressor = np.random.default_rng(seed), KinematicRegressor(drawing, axes="axes" in kinds)
    usual = {"m": 0.5e-3, "rad": 3e-3}
    sd = np.array([usual[unit] for unit in regressor.units])
    mixed = rng.normal(size=(regressor.p, regressor.p)) / np.sqrt(regressor.p)
    C = mixed @ mixed.T + 1e-2 * np.eye(regressor.p)
    theta = regressor.theta + off * sd * rng.normal(size=regressor.p)
    is_tool = np.array([name.startswith("tool.") for name in regressor.names])
    is_length = np.array([unit == "m" for unit in regressor.units]) & ~is_tool
    held = is_tool & ("tool" in kinds) | is_length & ("origins" in kinds)
    held |= ~is_tool & ~is_length
    theta[~held] = regressor.theta[~held]
    robot = regressor.robot_with(theta)
    at = np.flatnonzero(held)
    return KinematicBelief(
        tuple(regressor.names[i] for i in at),
        tuple(regressor.units[i] for i in at),
        regressor.theta[at],
        theta[at],
        (sd[:, None] * C * sd)[np.ix_(at, at)],
        regressor.rotations,
        (regressor.frames[0], robot.tip or regressor.frames[0]),
        kinds,
    ), robot
