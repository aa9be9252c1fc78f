"""A closed loop near its targets to first order: continuous, and sampled with delays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac import law
from approxjac.controllers import Controller, SetpointController
from approxjac.controllers.gains.gains import Timing
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import LimitStatus, Measurement
from approxjac.simulation import Plant, Sensing
from approxjac.simulation.plant import rk4
from approxjac.simulation.simulate import require_fit
from approxjac.stability.errors.region import require_law, require_seen
from approxjac.stability.loop.samples import Indices
from approxjac.validation import Array, as_number, require


class LinearLoop(NamedTuple):
    """Parts of the linearised laws (6) and (28), (29), as of `law.closed_loop_matrix`.

    They are of N targets, with that axis in front of all that targets do not have in common.
    """

    M: Array
    G: Array  # ∂g/∂q at the target, of the robot and of its exact compensation, (n_v, n_v)
    J: Array
    J_hat: Array
    J_hat_pinv: Array
    kp: Array
    kv: Array
    friction: Array  # diagonal of the natural B, (n_v,)
    damping: Array  # diagonal of the added B_c, (n_v,)
    Z: Array  # of all that is learnt, Y of `Adaptation`, (n_v, p); p = 0 where gravity is known
    L: Array
    alpha: float

    def take(self, which: Indices) -> LinearLoop:
        """Return the parts of some of the targets."""
        own = ("M", "G", "J", "J_hat", "J_hat_pinv", "Z")
        return self._replace(**{name: getattr(self, name)[which] for name in own})


def linear_loop(plant: Plant, controller: SetpointController, q: Array) -> LinearLoop:
    """Return the parts of the loop of a plant and a controller at one configuration (nq,).

    Ĵ that uses x is taken at that of the target: its change is multiplied by e and q̇, both zero.
    """
    sensor, dynamics = plant.sensor, plant.dynamics
    terms = (
        q, dynamics.M(q), dynamics.g_gradient(q), sensor.sensor_jacobian(q),
        controller.task.jacobian(q, sensor.value(q)),
    )  # fmt: skip
    return linear_loops(controller, plant.friction, *(np.array([each]) for each in terms))


def linear_loops(
    controller: SetpointController,
    friction: Array,
    q: Array,
    M: Array,
    G: Array,
    J: Array,
    J_hat: Array,
) -> LinearLoop:
    """Return the parts of `linear_loop` at N configurations."""
    (N, m, n), learning = J.shape, controller.adaptation
    Z, L, alpha, J_hat_pinv = np.zeros((N, n, 0)), np.zeros(0), 0.0, np.zeros((N, n, m))
    if learning is not None:
        Z, L, alpha = np.array(list(map(learning.Y, q, J_hat))), learning.L, learning.alpha
        J_hat_pinv = np.array(list(map(controller.pinv.matrix, J_hat)))
    kp, kv, damping = controller.diagonals
    return LinearLoop(M, G, J, J_hat, J_hat_pinv, kp, kv, friction, damping, Z, L, alpha)


def continuous_matrix(loop: LinearLoop) -> Array:
    """Return A of ż = A z with z = (δq, q̇, δθ̂), shape (N, 2 n_v + p, 2 n_v + p)."""
    M, _, J, J_hat, J_hat_pinv, kp, kv, friction, damping, Z, L, alpha = loop
    B = friction + damping
    return law.closed_loop_matrix(M, J, J_hat, kp, kv, B, (Z, L, alpha * J_hat_pinv))


def sampled_matrix(loop: LinearLoop, timing: Timing) -> Array:
    """Return A of z(k+1) = A z(k), the loop of `simulate` from frame to frame, to first order.

    z is that of `law.frame_map`, and A of shape (N, k, k).
    """
    dt, kv, learnt = timing.dt, loop.kv, loop.Z @ law.learning_gain(loop.L, loop.Z)
    parts = law.LinearLaw(
        np.asarray(np.linalg.inv(loop.M)),
        loop.J,
        loop.J_hat.mT * loop.kp,
        law.dissipation(loop.J_hat, kv, loop.damping),
        learnt,
        loop.alpha * loop.J_hat_pinv,
    )
    with np.errstate(over="ignore", invalid="ignore"):
        A = law.frame_map(parts, *timing, loop.friction, loop.G)
    if not np.isfinite(A).all():
        raise InvalidInputError(
            f"dt must be a sampling time of control, such as 0.001 [s], got {dt:g}: the motion "
            "within one sample overflows",
            given=dt,
        )
    return A


def equilibria(loop: LinearLoop, unseen: Array, timing: Timing | None = None) -> Array:
    """Return the directions of the manifold of equilibria with e = 0, as columns of the state z.

    They are the self-motion, along which the held torque follows gravity, and for the continuous
    loop changes of θ̂ without torque at the target, with basis `unseen` (N, p, p − rank Z).
    """
    (N, m, n), p = loop.J.shape, loop.Z.shape[-1]
    self_motion = np.linalg.svd(loop.J)[2][:, m:].mT
    if timing is None:
        free = np.zeros((N, 2 * n + p, n - m + unseen.shape[-1]))
        free[:, :n, : n - m], free[:, 2 * n :, n - m :] = self_motion, unseen
        return free
    moved = [self_motion, np.zeros((N, 2 * n, n - m))]
    if timing.velocity_filter is not None:  # standing still, (a/dt) δq + w = 0
        moved.append(-self_motion / (timing.velocity_filter + timing.dt))
    moved += [loop.G @ self_motion] * timing.torque_late
    frames = -(-timing.x_late // timing.samples)
    return np.concatenate([*moved, np.zeros((N, frames * m, n - m))], axis=1)


# -- one target, or the findings at many ----------------------------------------------------------

_SINGULAR = 1e-10  # relative smallest singular value that counts as zero
_NONE = 1e-11  # size of an eigenvalue relative to the largest that counts as zero
_EXACT = 1e-6  # relative error of a gravity compensation that counts as none
_NEAR = 1e-2  # how far from the target gravity is compared [rad or m]
_MOST_STATES = 1000  # eigenvalues of more take many seconds


@dataclass(frozen=True, eq=False, repr=False)
class LocalStability:
    """Eigenvalues of the linearised closed loop, those of the equilibria themselves left out.

    With dt a mode is multiplied by μ from one sample to the next, and its eigenvalue is
    λ = ln(μ)/dt, so that all numbers mean the same with and without dt.

    Attributes:
        eigenvalues: Complex λ [1/s], the slowest first; −∞ is a mode that is over after one sample.
        self_motion: Number n_v − m of eigenvalues left out because every configuration of the
            self-motion attains the target.
        unseen_parameters: Number p − rank Z of eigenvalues left out because so many combinations
            of the learnt parameters exert no torque at the target.
        singular: True if further eigenvalues are zero, as if J or Ĵ loses rank at the target. Then
            the linearisation decides nothing.
        dt: Sampling time [s], or None for the continuous loop.
        dead_time: Longest time from a motion to the end of the torque that responds to it, with
            hold and delays [s]; 0 for the continuous loop.
    """

    eigenvalues: NDArray[np.complex128]
    self_motion: int
    unseen_parameters: int
    singular: bool
    dt: float | None = None
    dead_time: float = 0.0

    @property
    def max_real_eigenvalue(self) -> float:
        """Largest real part of the eigenvalues, the spectral abscissa [1/s]."""
        return float(self.eigenvalues.real.max())

    @property
    def decay_rate(self) -> float:
        """Decay rate of the slowest error [1/s]; negative if one grows."""
        return -self.max_real_eigenvalue

    @property
    def damping_ratio(self) -> float:
        """Smallest −Re λ by the size of λ (1 does not oscillate, 0 does for ever, below 0 grows).

        Of the sampled loop, modes that fall to a tenth within the dead time are not counted: every
        delay has such modes, as many as samples.
        """
        values = self.eigenvalues[self.eigenvalues != 0.0]
        lasting = values[values.real * self.dead_time > -math.log(10.0)]
        return float((-lasting.real / np.abs(lasting)).min(initial=1.0))

    @property
    def stable(self) -> bool:
        """True if every error near the target decays."""
        return not self.singular and self.max_real_eigenvalue < 0.0

    def __repr__(self) -> str:
        loop = "continuous loop" if self.dt is None else f"sampled every {self.dt:g} s"
        unseen = "learnt parameters without effect at the target"
        numbers = {"self-motion": self.self_motion, unseen: self.unseen_parameters}
        left_out = [f"{number} of {what}" for what, number in numbers.items() if number]
        ending = f"; left out are {' and '.join(left_out)}" if left_out else ""
        rate, worst = self.decay_rate, self.eigenvalues[self.eigenvalues.real.argmax()]
        if self.singular:
            verdict = "undecided: J or Ĵ loses rank at the target; choose another one or its task"
        elif self.stable:
            verdict = (
                f"stable: errors near the target die out at {rate:.3g} 1/s or faster (to 1 % in "
                f"{math.log(100.0) / rate:.3g} s), damping ratio {self.damping_ratio:.2g}"
            )
        else:
            verdict = f"unstable: errors near the target grow at {-rate:.3g} 1/s"
            if worst.imag:
                verdict += f", oscillating at {abs(worst.imag) / (2.0 * math.pi):.3g} Hz"
        return f"{verdict} ({loop}){ending}"


def local_stability(
    plant: Plant, controller: Controller, q_target: Array, dt: float | None = None
) -> LocalStability:
    """Linearise the closed loop at rest where it attains the target.

    Law (6) or (28), (29) by its equations, with s'(0) = 1; any other controller by finite
    differences, with the state nearest to its initial one that holds the arm there.

    The equilibria with e = 0 form a manifold: the self-motion, and for learnt gravity every θ̂ with
    the right torque. Its eigenvalues, of zero, are left out. Gravity that is learnt is linearised
    at a θ̂ that gives the true gravity around the target, and not only at it.

    Args:
        plant: The true robot, sensor and friction.
        controller: The controller with its believed robot.
        q_target: Configuration that attains the target, shape (nq,).
        dt: Sampling time [s] for the loop as `simulate` runs it with dt, its delays in whole
            samples. None is the continuous loop.

    Raises:
        InvalidInputError: Gravity is not exact near `q_target` and cannot be learnt, or adaptation
            is paused there; another controller does not rest there, is not smooth, depends on time
            or has no rate without dt; another task than the sensor's; a `q_target` that the sensor
            does not see; a plant with Coulomb friction, frames, noise, rounding, dropouts or torque
            limits; delays or a filter of q̇ without dt, or of very many samples.
    """
    require("plant", plant, Plant, "a Plant")
    require_fit(plant, controller, controller.dt if dt is None else dt)
    plant.require_task(controller.task)
    timing = _timing(plant, dt)
    q = plant.robot.configuration(q_target, "q_target")
    require_seen("q_target", q, plant.sensor)
    try:
        law = require_law(controller)
    except InvalidInputError:
        return _by_differences(plant, controller, q, timing)
    _require_gravity(plant, law, q)
    gravity = float(np.linalg.norm(plant.robot.gravity))
    return stabilities(linear_loop(plant, law, q), gravity, timing)[0]


def stabilities(
    loop: LinearLoop, gravity: float, timing: Timing | None = None
) -> list[LocalStability]:
    """Return the eigenvalues at each target of a loop whose gravity is exact, or learnt.

    Args:
        loop: The parts at N targets.
        gravity: Its acceleration [m/s²].
        timing: Of the loop as it is sampled; None is the continuous loop.
    """
    sizes = np.linalg.svd(loop.J @ np.linalg.solve(loop.M, loop.J_hat.mT), compute_uv=False)
    singular = sizes[:, -1] <= _SINGULAR * sizes[:, 0]
    columns, values, rows = np.linalg.svd(loop.Z)
    # the columns of first moments are g times a sine: where all are 1e-16, none counts
    ranks = (values > _SINGULAR * values.max(axis=-1, initial=gravity)[:, None]).sum(axis=-1)
    found: list[Any] = [None] * len(ranks)
    for rank in np.unique(ranks):  # those of different ranks have spaces of different sizes
        which = np.flatnonzero(ranks == rank)
        own = loop.take(which)
        A = continuous_matrix(own) if timing is None else sampled_matrix(own, timing)
        still = equilibria(own, rows[which, rank:].mT, timing)
        N, size, count = still.shape
        n, m = loop.M.shape[-1], loop.J.shape[-2]
        within = np.broadcast_to(np.eye(size), (N, size, size))
        if timing is not None:  # no learnt torques but those that joints feel
            learnt = np.zeros((N, size, rank))
            learnt[:, 2 * n : 3 * n] = columns[which][..., :rank]
            within = np.concatenate([within[..., : 2 * n], learnt, within[..., 3 * n :]], axis=2)
        basis = within @ np.linalg.qr(within.mT @ still, mode="complete")[0]
        along, across = basis[..., :count], basis[..., count:]
        at_rest = 0.0 if timing is None else 1.0
        residual = np.abs(A @ along - at_rest * along).max(axis=(1, 2), initial=0.0)
        singular[which] |= residual > 1e-9 * np.abs(A).max(axis=(1, 2))
        unseen = loop.Z.shape[-1] - int(rank)
        for k, own_values in zip(which, np.linalg.eigvals(across.mT @ A @ across), strict=True):
            found[k] = _stability(own_values, n - m, unseen, singular[k], timing)
    return found


def _stability(
    values: NDArray[np.complex128],  # λ, or with a timing μ, of the rest of the state
    self_motion: int,
    unseen: int,
    singular: bool,
    timing: Timing | None,
) -> LocalStability:
    values, dt, dead_time = values.astype(np.complex128), None, 0.0
    if timing is not None:  # λ = ln(μ)/t; −∞ for a mode that is over after one frame
        dt, dead_time, sizes, angles = timing.dt, timing.dead_time, np.abs(values), np.angle(values)
        with np.errstate(divide="ignore"):
            values.real, values.imag = np.log(sizes) / timing.frame, angles / timing.frame
    sizes = np.abs(values[np.isfinite(values)])
    singular = bool(singular or sizes.min(initial=np.inf) <= _NONE * sizes.max(initial=0.0))
    values = values[np.argsort(-values.real)]
    return LocalStability(values, self_motion, unseen, singular, dt, dead_time)


def _by_differences(
    plant: Plant, controller: Controller, q: Array, timing: Timing | None
) -> LocalStability:
    """Return `local_stability` of a controller of any kind.

    A wrapper that limits the torques or holds the measurements of a law has no effect near a target
    where the torque is within the limits: there the law is linearised.
    """
    law, dt = controller.law, None if timing is None else timing.dt
    if law is not controller and law.task is controller.task:
        here = plant.measure(0.0, q, np.zeros(plant.robot.nv))
        state, step = controller.begin(here), controller.dt or dt or 1e-3
        _, answer = controller.advance(state, here, plant.sensor.value(q), step)
        if answer.limit_status in (LimitStatus.UNLIMITED, LimitStatus.FREE):
            return local_stability(plant, law, q, dt)
        raise InvalidInputError(
            f"controller must hold the arm at the target with a torque within its limits, got "
            f"{controller!r}, which says {answer.limit_status}",
            given=controller,
        )
    if timing is None and not controller.is_continuous:
        raise InvalidInputError(
            f"dt must be given for a controller that runs in samples, got None for {controller!r}",
            given=None,
        )
    return numerical_stability(plant, controller, q, timing)


@dataclass(frozen=True, eq=False, repr=False)
class LocalTest:
    """Verdict of the exact linearisation with each configuration taken as a target.

    Attributes:
        decay_rates: −max Re λ without the self-motion's zeros, shape (N,) [1/s]; 0 where J or Ĵ is
            singular, which decides nothing.
        damping_ratios: Smallest −Re λ/‖λ‖, shape (N,).
        q: The configurations, shape (N, nq).
        truth: Index of the true robot, shape (N,).
    """

    decay_rates: Array
    damping_ratios: Array
    q: Array
    truth: Indices

    @classmethod
    def of(cls, found: Sequence[LocalStability], q: Array, truth: Indices) -> LocalTest:
        """Return the verdict of what was found at configurations (N, nq)."""
        rates = [0.0 if each.singular else each.decay_rate for each in found]
        return cls(np.array(rates), np.array([each.damping_ratio for each in found]), q, truth)

    def __repr__(self) -> str:
        stable = f"stable at {100 * self.share:.4g} % of {len(self.q)} configurations"
        return f"LocalTest({stable}, slowest decay {self.decay_rates.min(initial=np.inf):.3g}/s)"

    @property
    def share(self) -> float:
        """Share of the configurations that are stable; 0 if there are none."""
        return float((self.decay_rates > 0.0).sum()) / max(len(self.q), 1)

    @property
    def worst(self) -> int:
        """Index of the configuration with the slowest decay."""
        return int(self.decay_rates.argmin())

    @property
    def stable(self) -> bool:
        """True if all configurations are stable, and there are some."""
        return self.share == 1.0


def _timing(plant: Plant, dt: float | None) -> Timing | None:
    """Timing of the loop in whole samples, as `simulate` has it; None without dt."""
    if dt is None:
        plant.require_ideal("the local test")
        return None
    dt = as_number("dt", dt, unit="s", above=0.0)
    plant.require_ideal("the local test with dt", late=True)
    sensing = plant.sensing or Sensing()
    x_delay = sensing.x_delay
    late = plant.sensor.m * x_delay / dt + plant.robot.nv * plant.actuator_delay / dt
    if late > _MOST_STATES:
        raise InvalidInputError(
            f"the delays must be at most some {_MOST_STATES // plant.robot.nv} samples in all, got "
            f"x_delay = {x_delay:g} s and actuator_delay = {plant.actuator_delay:g} s with "
            f"dt = {dt:g} s; take a larger dt",
            given=dt,
        )
    late_by = round(x_delay / dt), round(plant.actuator_delay / dt)
    return Timing(dt, 1, *late_by, sensing.velocity_filter)


def _require_gravity(plant: Plant, controller: SetpointController, q: Array) -> None:
    """Refuse gravity that is not exact around the target, or cannot be learnt to be so."""
    model, learning = plant.robot.model, controller.adaptation
    nearby = [q, *(pin.integrate(model, q, _NEAR * unit) for unit in np.eye(plant.robot.nv))]
    wanted = np.array([[plant.dynamics.g(at) for at in nearby]])
    error = gravity_error(controller, [plant], nearby, wanted)
    if error > _EXACT * max(1.0, float(np.abs(wanted).max())):
        raise InvalidInputError(
            f"the controller's gravity must be {'exact' if learning is None else 'learnable'} near "
            f"the target for it to be an equilibrium, got an error of {error:.3g} "
            f"{joined(plant.robot.force_units)} with "
            f"{type(controller.gravity).__name__}",
            given=controller,
        )
    if learning is None:
        return
    theta, limits = learning.regressor.fit(plant.robot)[0], learning.torque_limits
    held = [("torque_limits", wanted[0, 0], -limits, limits)]
    if learning.bounds is not None:
        lower, upper = learning.bounds
        held.append(("bounds", theta, lower[: len(theta)], upper[: len(theta)]))
    for name, value, low, high in held:
        if not ((low < value) & (value < high)).all():
            raise InvalidInputError(
                f"{name} of AdaptiveGravity must hold {value.tolist()} of the true gravity at the "
                f"target, or θ̂ stands still, got {low.tolist()} to {high.tolist()}",
                given=learning,
            )


def gravity_error(
    law: SetpointController, plants: Sequence[Plant], q: Sequence[Array] | Array, g: Array
) -> float:
    """Return the largest part of true g (k, N, n_v) at q (N, nq) not compensated or learnt."""
    if law.adaptation is None:
        torque = law.gravity.torque  # type: ignore[union-attr]
        return float(np.abs(g - np.array([np.array(torque(at)) for at in q])).max())
    left = [law.adaptation.regressor.fit(plant.robot)[1] for plant in plants]
    return float((np.array(left)[:, None, None] * np.abs(g)).max())


# -- any controller, by finite differences ---------------------------------------------------------

_STEP = 1e-4  # of a difference, of coordinates of size one; extrapolated to fourth order
_KINK = 1e-2  # relative, by which slopes to both sides may differ
_AT_REST = 1e-6  # relative, of the torque and of the rate of the state
_NULL = 1e-6  # rate that counts as zero [1/s]: differences round to 1e-8, modes are faster
_ZERO = 1e-9  # relative eigenvalue that counts as zero
_IN_Q = 1e-6  # part of a unit vector that counts as one along q
_ROUNDS = 20  # of Newton's method
_FARTHEST = 0.5  # that a joint may move along the self-motion to where it rests [rad or m]
_MOST_NUMBERS = 400  # of a state
_SUBSTEPS = 4  # of the plant in a sample, so that its motion counts as exact


def numerical_stability(
    plant: Plant, controller: Controller, q: Array, timing: Timing | None
) -> LocalStability:
    """Linearise the loop of any controller at rest at q (nq,), whose x is its target.

    The coordinates z are the motion from q, q̇, the state of the controller, the filter of q̇, the
    errors of late x, and late torques, the oldest first. In samples the rate of z is that of its
    mean over one of them, (z(k+1) − z(k))/dt.
    """
    model, sensor, n = plant.robot.model, plant.sensor, plant.robot.nv
    still = np.zeros(n)
    state = controller.begin(plant.measure(0.0, q, still))
    if len(state) > _MOST_NUMBERS:
        raise InvalidInputError(
            f"controller must have a state of at most {_MOST_NUMBERS} numbers to be linearised "
            f"by differences, got {len(state)} of {controller!r}; rollouts judge any",
            given=controller,
        )
    dt = None if timing is None else timing.dt

    def answer(
        x_d: Array, q: Array, v: Array, x: Array, state: Array, t: float = 0.0
    ) -> tuple[Array, Array]:
        measurement = Measurement(t, q, v, x, t)
        if dt is None:
            given = controller.evaluate(state, measurement, x_d)
            return np.array(given.torque), np.asarray(given.state_rate)
        after, given = controller.advance(state, measurement, x_d, dt)
        return np.array(given.torque), np.asarray((after - state) / dt)

    q, state = _resting(plant, controller, answer, q, state)
    x_d = sensor.value(q)
    torque, _ = answer(x_d, q, still, x_d, state)
    parts = [still, still, state]
    if timing is not None:
        filtered = n if timing.velocity_filter is not None else 0
        parts += [np.zeros(filtered), np.zeros(timing.x_late * sensor.m)]
        parts.append(np.tile(torque, timing.torque_late))
    ends = np.cumsum(list(map(len, parts)))[:-1]

    def rate(z: Array) -> Array:
        moved, v, state, *late = np.split(z, ends)
        at = np.asarray(pin.integrate(model, q, moved))
        x = plant.measure(0.0, at, v).x
        if timing is None or dt is None:
            torque, state_rate = answer(x_d, at, v, x, state)
            return np.concatenate([v, plant.acceleration(at, v, torque), state_rate])
        (w, old, waiting), seen = late, v
        errors = np.concatenate([old, sensor.error(x, x_d)])
        if timing.velocity_filter is not None:
            share = dt / (timing.velocity_filter + dt)
            seen = share / dt * moved + w
            w = (1.0 - share) * seen - share / dt * moved
        x = sensor.displaced(x_d, errors[: sensor.m])
        torque, state_rate = answer(x_d, at, seen, x, state)
        torques = np.concatenate([waiting, torque])
        for _ in range(_SUBSTEPS):
            at, v, _ = plant.advance(at, v, torques[:n], dt / _SUBSTEPS, rk4)
        moved = np.asarray(pin.difference(model, q, at))
        rest = [state + dt * state_rate, w, errors[sensor.m :], torques[n:]]
        return np.asarray((np.concatenate([moved, v, *rest]) - z) / dt)

    A = _slopes(rate, np.concatenate(parts), controller)
    # ż = A z, or z(k+1) = (I + dt A) z(k)
    _, sizes, rows = np.linalg.svd(A)
    at_rest = sizes <= _NULL
    along, across = rows[at_rest].T, rows[~at_rest].T
    moving = int((np.linalg.svd(along[:n], compute_uv=False) > _IN_Q).sum()) if at_rest.any() else 0
    values = np.linalg.eigvals(across.T @ A @ across).astype(np.complex128)
    singular = moving > n - sensor.m or np.abs(values).min() <= _ZERO * np.abs(values).max()
    if timing is not None:
        values = 1.0 + timing.dt * values
    return _stability(values, moving, int(at_rest.sum()) - moving, bool(singular), timing)


def _resting(
    plant: Plant, controller: Controller, answer: Callable[..., Any], q: Array, state: Array
) -> tuple[Array, Array]:
    """Return q and the state at which the arm rests at its target, by Newton's method."""
    x_d, n, still = plant.sensor.value(q), plant.robot.nv, np.zeros(plant.robot.nv)
    now, later = (answer(x_d, q, still, x_d, state, t) for t in (0.0, 1.0))
    if not all(map(np.array_equal, now, later)):
        raise InvalidInputError(
            f"controller must be one whose step does not depend on the time, to be linearised, "
            f"got {controller!r}; rollouts judge any",
            given=controller,
        )

    def left(z: Array) -> Array:
        at = np.asarray(pin.integrate(plant.robot.model, q, z[:n]))
        x = plant.sensor.value(at)
        torque, rate = answer(x_d, at, still, x, z[n:])
        return np.concatenate([torque - plant.dynamics.g(at), rate, plant.sensor.error(x, x_d)])

    z = np.concatenate([still, state])
    size = max(1.0, float(np.abs(plant.dynamics.g(q)).max()))
    for _ in range(_ROUNDS):
        residual = left(z)
        if np.abs(residual).max() <= 1e-3 * _AT_REST * size:
            break
        z = z - np.linalg.lstsq(_slopes(left, z, None), residual, rcond=1e-9)[0]
    residual = left(z)
    if not (np.abs(residual).max() <= _AT_REST * size and np.abs(z[:n]).max() <= _FARTHEST):
        best = f" with the best of its states, {z[n:].tolist()}" if len(state) else ""
        off = np.abs(left(np.concatenate([still, z[n:]]))[:n]).max()
        raise InvalidInputError(
            "controller must hold the arm at rest at the target for it to be an equilibrium, "
            f"got {controller!r}, whose torque is off by {off:.3g} "
            f"{joined(plant.robot.force_units)} there{best}",
            given=controller,
        )
    return np.asarray(pin.integrate(plant.robot.model, q, z[:n])), np.asarray(z[n:])


def _slopes(function: Callable[[Array], Array], z: Array, smooth: Controller | None) -> Array:
    """Return ∂f/∂z by central differences of fourth order, (k, n), of what has to be smooth."""
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
