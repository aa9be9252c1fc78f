"""The closed loop of any controller to first order, by finite differences around rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.controllers import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.simulation import Plant
from approxjac.simulation.plant import rk4
from approxjac.stability.loop.linearization import Timing
from approxjac.validation import Array

_STEP = 1e-4  # of a difference, of coordinates of size one; extrapolated to fourth order
_KINK = 1e-2  # relative, by which slopes to both sides may differ
_AT_REST = 1e-6  # relative, of the torque and of the rate of the state
_NULL = 1e-6  # rate that counts as zero [1/s]: differences round to 1e-8, modes are faster
_ZERO = 1e-9  # relative eigenvalue that counts as zero
_IN_Q = 1e-6  # part of a unit vector that counts as one along q
_ROUNDS = 20  # of Newton's method
_FARTHEST = 0.5  # that a joint may move along the self-motion to where it rests [rad or m]
_MOST_STATES = 400
_SUBSTEPS = 4  # of the plant in a sample, so that its motion counts as exact


class Modes(NamedTuple):
    """Eigenvalues of a linearised loop, without those along its equilibria.

    Attributes:
        eigenvalues: λ [1/s].
        self_motion: Eigenvalues left out along which the arm moves.
        unseen: Eigenvalues left out along which only the state of the controller changes.
        singular: Whether more eigenvalues are zero than equilibria with e = 0 explain.
    """

    eigenvalues: NDArray[np.complex128]
    self_motion: int
    unseen: int
    singular: bool


def numerical_modes(plant: Plant, controller: Controller, q: Array, timing: Timing | None) -> Modes:
    """Linearise the loop of any controller at rest at q (nq,), whose x is its target.

    Args:
        plant: The true robot and its sensor.
        controller: The controller; without timing one in continuous time.
        q: Configuration that attains the target, shape (nq,).
        timing: Of the sampled loop; None is the continuous one.

    Raises:
        InvalidInputError: A controller that does not rest there with any state, whose step depends
            on the time, or that is not smooth there.
    """
    loop = _Loop(plant, controller, q, timing)
    A = _slopes(loop.rate, loop.rest, controller)
    return _modes(A, plant.robot.nv, plant.sensor.m, timing)


class _Loop:
    """A loop at rest, and how fast it leaves from near there.

    Its coordinates are the motion ξ from q, q̇, the state of the controller, the filter of q̇, the
    errors of late x, and late torques, the oldest first. In samples the rate of z is that of its
    mean over one of them, (z(k+1) − z(k))/dt.
    """

    def __init__(
        self, plant: Plant, controller: Controller, q: Array, timing: Timing | None
    ) -> None:
        self._plant, self._controller, self._q, self._timing = plant, controller, q, timing
        self._x_d = plant.sensor.value(q)
        still, n = np.zeros(plant.robot.nv), plant.robot.nv
        state = controller.initial_state(plant.measure(0.0, q, still))
        if len(state) > _MOST_STATES:
            raise InvalidInputError(
                f"controller must have a state of at most {_MOST_STATES} numbers to be linearised "
                f"by differences, got {len(state)} of {controller!r}; rollouts judge any",
                given=controller,
            )
        state = self._resting(state)
        self._sizes = [n, n, len(state)]
        torque, _ = self._answer(self._q, still, self._x_d, state)
        parts = [still, still, state]
        if timing is not None:
            late = timing.x_late * plant.sensor.m
            filtered = n if timing.velocity_filter is not None else 0
            self._sizes += [filtered, late, timing.torque_late * n]
            parts += [np.zeros(filtered), np.zeros(late), np.tile(torque, timing.torque_late)]
        self.rest = np.concatenate(parts)

    def rate(self, z: Array) -> Array:
        """Return the rate of z, shape as z."""
        parts = np.split(z, np.cumsum(self._sizes)[:-1])
        return self._flow(*parts) if self._timing is None else self._sample(z, *parts)

    def _flow(self, moved: Array, v: Array, state: Array) -> Array:
        q = self._at(moved)
        torque, rate = self._answer(q, v, self._plant.measure(0.0, q, v).x, state)
        return np.concatenate([v, self._plant.acceleration(q, v, torque), rate])

    def _sample(
        self, z: Array, moved: Array, v: Array, state: Array, w: Array, old: Array, waiting: Array
    ) -> Array:
        timing, plant, sensor = self._timing, self._plant, self._plant.sensor
        assert timing is not None
        q, dt = self._at(moved), timing.dt
        e = sensor.error(plant.measure(0.0, q, v).x, self._x_d)
        errors = np.concatenate([old, e])
        seen = v
        if timing.velocity_filter is not None:
            share = dt / (timing.velocity_filter + dt)
            seen = share / dt * moved + w
            w = (1.0 - share) * seen - share / dt * moved
        x = sensor.displaced(self._x_d, errors[: sensor.m])
        torque, rate = self._answer(q, seen, x, state)
        torques = np.concatenate([waiting, torque])
        tau = torques[: len(v)]
        for _ in range(_SUBSTEPS):
            q, v = plant.advance(q, v, tau, dt / _SUBSTEPS, rk4)
        moved = np.asarray(pin.difference(plant.robot.model, self._q, q))
        rest = [state + dt * rate, w, errors[sensor.m :], torques[len(v) :]]
        return np.asarray((np.concatenate([moved, v, *rest]) - z) / dt)

    def _at(self, moved: Array) -> Array:
        return np.asarray(pin.integrate(self._plant.robot.model, self._q, moved))

    def _answer(
        self, q: Array, v: Array, x: Array, state: Array, t: float = 0.0
    ) -> tuple[Array, Array]:
        """Return the controller's torque and the rate of its state, in samples its mean rate."""
        measurement = Measurement(t, q, v, x, t)
        if self._timing is None:
            answer = self._controller.evaluate(state, measurement, self._x_d)
            return np.array(answer.torque), np.asarray(answer.state_rate)
        dt = self._timing.dt
        after, answer = self._controller.step(state, measurement, self._x_d, dt)
        return np.array(answer.torque), np.asarray((after - state) / dt)

    def _resting(self, state: Array) -> Array:
        """Return a state with which the arm stays at rest at the target, and go there.

        The nearest by Newton's method, where the self-motion may give way.
        """
        plant, q, x_d = self._plant, self._q, self._x_d
        still = np.zeros(plant.robot.nv)
        now, later = (self._answer(q, still, x_d, state, t) for t in (0.0, 1.0))
        if not all(map(np.array_equal, now, later)):
            raise InvalidInputError(
                f"controller must be one whose step does not depend on the time, to be linearised, "
                f"got {self._controller!r}; rollouts judge any",
                given=self._controller,
            )

        def left(z: Array) -> Array:
            at = self._at(z[:n])
            x = plant.sensor.value(at)
            torque, rate = self._answer(at, still, x, z[n:])
            off = torque - plant.dynamics.g(at)
            return np.concatenate([off, rate, plant.sensor.error(x, x_d)])

        z, n = np.concatenate([still, state]), len(still)
        size = max(1.0, float(np.abs(plant.dynamics.g(q)).max()))
        for _ in range(_ROUNDS):
            residual = left(z)
            if np.abs(residual).max() <= 1e-3 * _AT_REST * size:
                break
            z = z - np.linalg.lstsq(_slopes(left, z, None), residual, rcond=1e-9)[0]
        residual = left(z)
        if not (np.abs(residual).max() <= _AT_REST * size and np.abs(z[:n]).max() <= _FARTHEST):
            best = f" with the best of its states, {z[n:].tolist()}" if len(state) else ""
            raise InvalidInputError(
                f"controller must hold the arm at rest at the target for it to be an equilibrium, "
                f"got {self._controller!r}, whose torque is off by "
                f"{np.abs(left(np.concatenate([still, z[n:]]))[:n]).max():.3g} N m there{best}",
                given=self._controller,
            )
        self._q = self._at(z[:n])
        self._x_d = plant.sensor.value(self._q)
        return np.asarray(z[n:])


def _slopes(function: Callable[[Array], Array], z: Array, smooth: Controller | None) -> Array:
    """Return ∂f/∂z by central differences of fourth order, shape (k, n).

    Raises:
        InvalidInputError: Other slopes to one side than to the other, of a controller that is
            given.
    """
    here, columns = function(z), []
    for i, unit in enumerate(np.eye(len(z))):
        h = _STEP * max(1.0, abs(z[i]))
        more, less, far, near = (function(z + k * h * unit) for k in (1.0, -1.0, 2.0, -2.0))
        columns.append((8.0 * (more - less) - (far - near)) / (12.0 * h))
        kink = np.abs(more - 2.0 * here + less).max() / h
        if smooth is not None and kink > _KINK * max(np.abs(columns[-1]).max(), 1e-6):
            raise InvalidInputError(
                f"controller must be smooth near the target to be linearised, got {smooth!r}, "
                "whose slope jumps there; rollouts judge any",
                given=smooth,
            )
    return np.array(columns).T


def _modes(A: Array, n: int, m: int, timing: Timing | None) -> Modes:
    """Return the modes of ż = A z, or of z(k+1) = (I + dt A) z(k), with n joints and m errors."""
    _, sizes, rows = np.linalg.svd(A)
    at_rest = sizes <= _NULL
    along, across = rows[at_rest].T, rows[~at_rest].T
    moving = int((np.linalg.svd(along[:n], compute_uv=False) > _IN_Q).sum()) if at_rest.any() else 0
    values = np.linalg.eigvals(across.T @ A @ across).astype(np.complex128)
    singular = moving > n - m or np.abs(values).min() <= _ZERO * np.abs(values).max()
    if timing is not None:  # λ = ln(μ)/dt; −∞ for a mode that is over after one sample
        with np.errstate(divide="ignore"):
            values = np.asarray(np.log(1.0 + timing.dt * values) / timing.dt, np.complex128)
    return Modes(values, moving, int(at_rest.sum()) - moving, bool(singular))
