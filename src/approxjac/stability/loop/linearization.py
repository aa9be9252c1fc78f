"""A closed loop near its targets to first order: continuous, and sampled with delays."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from approxjac import law
from approxjac.controllers import Latency, SetpointController
from approxjac.errors import InvalidInputError
from approxjac.simulation import Plant
from approxjac.stability.loop.samples import Indices
from approxjac.validation import Array


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


class Timing(NamedTuple):
    """Times at which things happen in sampled control."""

    dt: float  # sampling time [s]
    x_late: int = 0  # samples from a frame of x to the first torque that uses it
    torque_late: int = 0  # samples from a torque to its effect
    velocity_filter: float | None = None  # of q̇ from differences of q [s]; None is a tachometer
    samples: int = 1  # from one frame of x to the next

    @classmethod
    def of(cls, latency: Latency) -> Timing:
        """Return that of a loop, in whole samples."""
        dt, samples, age, late = latency.in_samples()
        return cls(dt, age, late, latency.velocity_filter or None, samples)

    @property
    def frame(self) -> float:
        """Time from one frame of x to the next [s]."""
        return self.samples * self.dt

    @property
    def dead_time(self) -> float:
        """Longest time from a motion to the end of the first torque that answers it [s]."""
        return (self.samples + self.x_late + self.torque_late) * self.dt


def linear_loop(plant: Plant, controller: SetpointController, q: Array) -> LinearLoop:
    """Return the parts of the loop of a plant and a controller at one configuration (nq,).

    Where Ĵ uses the measured x it is taken at that of the target: its change with x is multiplied
    by e and q̇, which are zero there.
    """
    sensor, dynamics = plant.sensor, plant.dynamics
    terms = (
        q, dynamics.M(q), dynamics.g_gradient(q), sensor._sensor_jacobian(q),
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
    """A of ż = A z with z = (δq, q̇, δθ̂), shape (N, 2 n_v + p, 2 n_v + p)."""
    M, _, J, J_hat, J_hat_pinv, kp, kv, friction, damping, Z, L, alpha = loop
    B = friction + damping
    return law.closed_loop_matrix(M, J, J_hat, kp, kv, B, (Z, L, alpha * J_hat_pinv))


def sampled_matrix(loop: LinearLoop, timing: Timing) -> Array:
    """A of z(k+1) = A z(k) from one frame of x to the next, as `simulate` runs, to first order.

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
        A = law.frame_map(
            parts, dt, timing.samples, timing.x_late, timing.torque_late, timing.velocity_filter,
            loop.friction, loop.G,
        )  # fmt: skip
    if not np.isfinite(A).all():
        raise InvalidInputError(
            f"dt must be a sampling time of control, such as 0.001 [s], got {dt:g}: the motion "
            "within one sample overflows",
            given=dt,
        )
    return A


def equilibria(loop: LinearLoop, unseen: Array, timing: Timing | None = None) -> Array:
    """Directions in which the equilibria with e = 0 continue, as columns of the state z.

    Self-motion, along which the held torque follows gravity, and of the continuous loop changes of
    θ̂ that no joint feels at the target, of which `unseen` is a basis, shape (N, p, p − rank Z).
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


def damping_ratios(values: NDArray[np.complex128], dead_time: float) -> Array:
    """Return the smallest −Re λ/|λ| of λ (…, k), at most 1; shape (…).

    Modes that fall to a tenth within the dead time are not counted: every delay has such modes, as
    many as samples, and nobody sees them.
    """
    sizes = np.abs(values)
    lasting = (values.real * dead_time > -math.log(10.0)) & (sizes != 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = -values.real / sizes
    return np.asarray(np.min(ratios, axis=-1, initial=1.0, where=lasting))


_SINGULAR = 1e-10  # relative smallest singular value that counts as zero
_ZERO = 1e-11  # size of an eigenvalue relative to the largest that counts as zero


class Spectrum(NamedTuple):
    """Eigenvalues of a closed loop at N targets, those of the equilibria left out."""

    values: NDArray[np.complex128]  # λ, (N, k) [1/s]; NaN where a target has fewer than others
    singular: NDArray[np.bool_]  # whether more of them are zero, which decides nothing, (N,)
    unseen: Indices  # p − rank Z, (N,)
    timing: Timing | None

    @property
    def decay_rates(self) -> Array:
        """−max Re λ, shape (N,) [1/s]; 0 where a target is singular."""
        return np.where(self.singular, 0.0, -np.nanmax(self.values.real, axis=1))

    @property
    def damping_ratios(self) -> Array:
        """Those of `LocalTest`, shape (N,)."""
        return damping_ratios(self.values, 0.0 if self.timing is None else self.timing.dead_time)

    @property
    def spectral_radii(self) -> Array:
        """Spectral radii of the maps from frame to frame, shape (N,).

        Below 1 where the sampled loop is stable; at least 1 where a target is singular.
        """
        assert self.timing is not None
        radii = np.exp(self.timing.frame * np.nanmax(self.values.real, axis=1))
        return np.asarray(np.where(self.singular, np.maximum(radii, 1.0), radii))


def spectrum(loop: LinearLoop, gravity: float, timing: Timing | None = None) -> Spectrum:
    """Return the eigenvalues at targets of a loop whose gravity is exact, or learnt.

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
    spectra = []
    for rank in np.unique(ranks):  # those of different ranks have spaces of different sizes
        which = np.flatnonzero(ranks == rank)
        own = loop.take(which)
        A = continuous_matrix(own) if timing is None else sampled_matrix(own, timing)
        still = equilibria(own, rows[which, rank:].mT, timing)
        N, size, count = still.shape
        within = np.broadcast_to(np.eye(size), (N, size, size))
        if timing is not None:  # no learnt torques but those that joints feel
            n = loop.M.shape[-1]
            learnt = np.zeros((N, size, rank))
            learnt[:, 2 * n : 3 * n] = columns[which][..., :rank]
            within = np.concatenate([within[..., : 2 * n], learnt, within[..., 3 * n :]], axis=2)
        basis = within @ np.linalg.qr(within.mT @ still, mode="complete")[0]
        along, across = basis[..., :count], basis[..., count:]
        at_rest = 0.0 if timing is None else 1.0
        residual = np.abs(A @ along - at_rest * along).max(axis=(1, 2), initial=0.0)
        singular[which] |= residual > 1e-9 * np.abs(A).max(axis=(1, 2))
        spectra.append((which, np.linalg.eigvals(across.mT @ A @ across)))
    values = np.full((len(ranks), max(each.shape[1] for _, each in spectra)), np.nan, complex)
    for which, each in spectra:
        values[which, : each.shape[1]] = each
    if timing is not None:  # λ = ln(μ)/t; −∞ for a mode that is over after one frame
        sizes, angles = np.abs(values), np.angle(values)
        with np.errstate(divide="ignore"):
            values.real, values.imag = np.log(sizes) / timing.frame, angles / timing.frame
    sizes, finite = np.abs(values), np.isfinite(values)
    smallest = np.min(sizes, axis=1, initial=np.inf, where=finite)
    singular |= smallest <= _ZERO * np.max(sizes, axis=1, initial=0.0, where=finite)
    return Spectrum(values, singular, loop.Z.shape[-1] - ranks, timing)
