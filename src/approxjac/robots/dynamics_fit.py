"""`fit_dynamics`: what an arm's joints and its payload take, from a recorded motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.robots.drives import Friction
from approxjac.robots.dynamics import DynamicsRegressor
from approxjac.robots.robot import Robot
from approxjac.validation import Array, as_array, as_number, require

_BLOCKS = 8  # of the recording, one of which at a time is left out
_ROWS = 1500  # of the recording that are looked at, at most
_SLOW = 0.03  # [rad/s or m/s] below which a joint may stick
_LEAST = 0.05  # share of a joint's time that it has to move in each direction
_LINK, _LAST = 0.01, 1.0  # share of the arm's mass that the mass of a link may be wrong by
_LENGTH = 0.2  # share of the reach: how far from its place that is


@dataclass(frozen=True)
class FittedDynamics:
    """Friction and payload identified from a recorded motion; see `fit_dynamics`.

    Attributes:
        friction: Viscous, Coulomb and load-dependent friction of each joint.
        friction_sd: Standard deviations of the three, shape (3, n_v).
        payload: Mass that the last link has beside what the robot's URDF says [kg].
        payload_sd: Its standard deviation, from parts of the recording and from what the motion
            excites [kg].
        residual: Rms of what is not explained of each joint's torque, shape (n_v,) [N m or N].
    """

    friction: Friction
    friction_sd: Array
    payload: float
    payload_sd: float
    residual: Array

    def __str__(self) -> str:
        lines = [f"payload {self.payload:.3g} ± {self.payload_sd:.1g} kg"]
        for name, sds in zip(("viscous", "Coulomb", "load"), self.friction_sd, strict=True):
            pairs = zip(getattr(self.friction, name.lower()), sds, strict=True)
            lines.append(f"{name}: " + ", ".join(f"{a:.3g} ± {sd:.1g}" for a, sd in pairs))
        unexplained = ", ".join(f"{each:.2g}" for each in self.residual)
        return "\n".join([*lines, f"not explained: {unexplained} N m rms"])


def fit_dynamics(
    robot: Robot,
    q: Sequence[Sequence[float]] | Array,
    tau: Sequence[Sequence[float]] | Array,
    dt: float,
    *,
    smoothing: float = 0.05,
) -> FittedDynamics:
    """Fit friction and payload to a recorded motion, such as `run.q` and `run.tau`.

    Least squares in the ten parameters of each link and in each joint's rotor inertia, viscous,
    Coulomb and load-dependent friction and constant torque, of which the load is that of links
    fitted before. Links are held to the URDF, the last to a payload of any mass. Joints that are
    slower than 0.03 rad/s are left out, as they may stick. Let the arm move each joint to and fro,
    and its load up and down.

    Args:
        robot: The arm as its URDF has it.
        q: Joint positions, shape (k, nq), at equal times.
        tau: Torques of the motors, shape (k, n_v) [N m or N].
        dt: Time from one row to the next [s].
        smoothing: Length of the window in which q and τ are smoothed by cubics [s].

    Raises:
        InvalidInputError: Wrong shapes, less than 200 rows, or a joint that hardly moved in one
            of its directions.
    """
    from scipy.signal import savgol_filter

    require("robot", robot, Robot, "a Robot")
    dt = as_number("dt", dt, unit="s", above=0.0)
    q = as_array("q", q, ("k", robot.nq))
    rows = len(q)
    torques = as_array("tau", tau, (rows, robot.nv))
    window = 2 * round(as_number("smoothing", smoothing, unit="s", above=0.0) / dt / 2.0) + 1
    window = max(window, 5)
    if rows < (least := max(200, 2 * window)):
        raise InvalidInputError(f"q must have at least {least} rows, got {rows}", given=rows)
    positions = q
    if robot.nq != robot.nv:  # without the jumps of joints that turn for ever
        positions = np.unwrap([robot.angles(each) for each in q], axis=0)
    v, a, torques = (
        savgol_filter(each, window, 3, deriv=order, delta=dt, axis=0)
        for each, order in ((positions, 1), (positions, 2), (torques, 0))
    )
    for name, each in zip(robot.joint_names, v.T, strict=True):
        least = min(np.mean(each > _SLOW), np.mean(each < -_SLOW))
        if least < _LEAST:
            raise InvalidInputError(
                f"joint {name} must move to and fro: it goes faster than {_SLOW} rad/s or m/s in "
                f"one direction for {100 * least:.2g} % of the time, at least 5 % are needed",
                given=name,
            )
    every = slice(window, rows - window, max(1, rows // _ROWS))
    return _fitted(robot, q[every], v[every], a[every], torques[every])


def _fitted(robot: Robot, q: Array, v: Array, a: Array, tau: Array) -> FittedDynamics:
    """Fit by normal equations in blocks, weighted by what is not explained of each joint.

    Twice, as the load of links that are fitted differs from that of the URDF.
    """
    from scipy.optimize import lsq_linear

    regressor, n = DynamicsRegressor(robot), robot.nv
    count, last = regressor.links, regressor.last_link
    Y = np.array([regressor.Y_d(*each)[:, :count] for each in zip(q, v, v, a, strict=True)])
    links = regressor.a[:count]
    prior = np.concatenate([links, np.zeros(5 * n)])
    reach = robot.reach_bound(robot.tip)[1] if robot.tip is not None else np.inf
    length = _LENGTH * (reach if np.isfinite(reach) else 1.0)
    link = robot.mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    of_links, most = np.tile(_LINK * link, count // 10), np.abs(tau).max(axis=0)
    of_links[last] = _LAST * link
    sd = np.concatenate([of_links, 0.01 * most, most, most, np.ones(n), most])
    low = np.full(len(sd), -np.inf)
    low[count : count + 4 * n] = 0.0  # rotors and friction
    moves, block = np.abs(v) > _SLOW, np.arange(len(v)) * _BLOCKS // len(v)

    def solved(H: Array, b: Array) -> Array:
        root = np.linalg.cholesky(sd[:, None] * H * sd + np.eye(len(b))).T
        right = np.linalg.solve(root.T, sd * b)
        solution = lsq_linear(root, right, bounds=(low, np.inf), method="bvls").x
        return np.asarray(prior + sd * solution)

    noise, sign = 0.02 * most + 1e-3, np.tanh(v / 0.02)
    for _ in range(2):
        load = np.abs(Y @ links)
        # of rotors, viscous, Coulomb and load-dependent friction, constants
        each = a, v, sign, sign * load, np.ones_like(load)
        A = np.concatenate([Y, *(np.einsum("ki,ij->kij", of, np.eye(n)) for of in each)], axis=2)
        left, parts = tau - A @ prior, []
        for k in range(_BLOCKS):
            rows = (block == k)[:, None] & moves
            weighted = (A / noise[:, None])[rows]
            parts.append((weighted.T @ weighted, weighted.T @ (left / noise)[rows]))
        H, b = (sum(each) for each in zip(*parts, strict=True))
        solution = solved(H, b)
        rest = np.where(moves, left - A @ (solution - prior), 0.0)
        noise = np.maximum(np.sqrt((rest**2).sum(axis=0) / moves.sum(axis=0)), 1e-6)
        links = solution[:count]
    # of what was left out once, and of what the motion does not tell from the URDF
    others = np.array([solved(H - each, b - of) for each, of in parts])
    jackknife = (_BLOCKS - 1) / _BLOCKS * ((others - others.mean(axis=0)) ** 2).sum(axis=0)
    inner = np.linalg.inv(H + np.diag(sd**-2.0)).diagonal()
    deviation = np.sqrt(jackknife + inner)
    (_, viscous, coulomb, load, _), sds = (of[count:].reshape(5, n) for of in (solution, deviation))
    friction = Friction(viscous=viscous, coulomb=coulomb, load=load).of(n)
    payload = float(solution[last.start] - prior[last.start])
    return FittedDynamics(friction, sds[1:4], payload, float(deviation[last.start]), noise)
