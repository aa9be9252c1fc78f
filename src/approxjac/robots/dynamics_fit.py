"""`fit_dynamics`: what an arm's joints and its payload take, from a recorded motion."""

from collections.abc import Iterator, Sequence
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
    return _Fit(robot, q[every], v[every], a[every], torques[every]).result()


class _Fit:
    """Normal equations of each joint in blocks, weighted by what is not explained of it."""

    def __init__(self, robot: Robot, q: Array, v: Array, a: Array, tau: Array) -> None:
        regressor = DynamicsRegressor(robot)
        self.n, self.links, self.last = robot.nv, regressor.links, regressor.last_link.start
        motions = zip(q, v, v, a, strict=True)
        Y = np.array([regressor.Y_d(*each)[:, : self.links] for each in motions])
        self.prior = np.concatenate([regressor.a[: self.links], np.zeros(5 * self.n)])
        reach = robot.reach_bound(robot.tip)[1] if robot.tip is not None else np.inf
        length = _LENGTH * (reach if np.isfinite(reach) else 1.0)
        link = robot.mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
        sd = np.tile(_LINK * link, self.links // 10)
        sd[regressor.last_link] = _LAST * link
        most = np.abs(tau).max(axis=0)
        self.sd = np.concatenate([sd, 0.01 * most, most, most, np.ones(self.n), most])
        self.Y, self.v, self.a, self.tau = Y, v, a, tau
        self.moves = np.abs(v) > _SLOW
        self.block = np.arange(len(v)) * _BLOCKS // len(v)

    def columns(self, load: Array) -> Array:
        """Return the columns of rotors, viscous, Coulomb and load-dependent friction, constants."""
        sign = np.tanh(self.v / 0.02)
        each = self.a, self.v, sign, sign * load, np.ones_like(load)
        blocks = [np.einsum("ki,ij->kij", of, np.eye(self.n)) for of in each]
        return np.concatenate([self.Y, *blocks], axis=2)

    def result(self) -> FittedDynamics:
        """Fit twice, as the load of links that are fitted differs from that of the URDF."""
        links, noise = self.prior[: self.links], 0.02 * np.abs(self.tau).max(axis=0) + 1e-3
        for _ in range(2):
            A = self.columns(np.abs(self.Y @ links))
            left = self.tau - A @ self.prior
            parts = list(self._normal(A, left, noise))
            H, b = (sum(each) for each in zip(*parts, strict=True))
            solution = self._solved(H, b)
            rest = np.where(self.moves, left - A @ (solution - self.prior), 0.0)
            noise = np.maximum(np.sqrt((rest**2).sum(axis=0) / self.moves.sum(axis=0)), 1e-6)
            links = solution[: self.links]
        # of what was left out once, and of what the motion does not tell from the URDF
        others = np.array([self._solved(H - each, b - of) for each, of in parts])
        jackknife = (_BLOCKS - 1) / _BLOCKS * ((others - others.mean(axis=0)) ** 2).sum(axis=0)
        inner = np.linalg.inv(H + np.diag(self.sd**-2.0)).diagonal()
        deviation = np.sqrt(jackknife + inner)
        n, joints = self.n, solution[self.links :].reshape(5, self.n)
        friction = Friction(viscous=joints[1], coulomb=joints[2], load=joints[3]).of(n)
        sd = deviation[self.links :].reshape(5, n)[1:4]
        payload = float(solution[self.last] - self.prior[self.last])
        return FittedDynamics(friction, sd, payload, float(deviation[self.last]), noise)

    def _normal(self, A: Array, left: Array, noise: Array) -> Iterator[tuple[Array, Array]]:
        for block in range(_BLOCKS):
            rows = (self.block == block)[:, None] & self.moves
            weighted = (A / noise[:, None])[rows]
            yield weighted.T @ weighted, weighted.T @ (left / noise)[rows]

    def _solved(self, H: Array, b: Array) -> Array:
        """Return the parameters, rotors and friction of which are not negative."""
        from scipy.optimize import lsq_linear

        scale = self.sd
        root = np.linalg.cholesky(scale[:, None] * H * scale + np.eye(len(b))).T
        right = np.linalg.solve(root.T, scale * b)
        low = np.full(len(b), -np.inf)
        low[self.links : self.links + 4 * self.n] = 0.0
        solution = lsq_linear(root, right, bounds=(low, np.inf), method="bvls").x
        return np.asarray(self.prior + scale * solution)
