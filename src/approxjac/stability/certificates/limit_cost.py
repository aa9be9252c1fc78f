"""`LimitCost`: where effort limits act on a loop, and what is proven then."""

from dataclasses import dataclass

import numpy as np

from approxjac import law
from approxjac.controllers import TorqueLimited
from approxjac.stability.certificates.certificate import SampledTest
from approxjac.stability.certificates.matrix_form import Weights
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Samples

_FAR = 1e9  # an error at which a saturation that is bounded has its bound


@dataclass(frozen=True, eq=False)
class LimitCost:
    """Cost of effort limits: where they act in a region, and what is proven there."""

    clipped: float  # share of the samples, taken as at rest, whose torque is beyond the limits
    # unit of the task → error at rest, in any direction, up to which no sample's torque is beyond
    # the limits, with no error in other units [units of the task]. Infinite if none ever is, 0 if
    # motors cannot hold the arm
    free: dict[str, float]
    # certified motions that begin with V ≤ this never exceed the limits [J]; 0 if nothing is
    # certified
    level: float
    holds: bool  # True if motors can hold the arm at all samples
    protects: bool  # True if the limiter keeps the report's own V falling
    proof: bool  # True if the limiter keeps any V falling

    @property
    def verdict(self) -> str:
        """Short text on the proof where torques are limited."""
        if not self.holds:
            return "cannot hold"
        if not self.proof:
            return "no proof"
        return "V falls" if self.protects else "another V"


def limit_cost(
    loop: ClosedLoop,
    limiter: TorqueLimited,
    samples: Samples,
    sampled: SampledTest | None,
    known: Weights | None,
) -> LimitCost:
    """Return the cost of a limiter's limits of effort.

    With σ² of `SampledForm.level` and U = 2c̄W + Ω, V ≥ ½(1 − σ²)|q̇|²_M and V ≥ ½(1 − σ²)sᵀUs, each
    by completing the square of the other. So V ≤ c bounds each torque, also of a held or late one,
    |τᵢ − gᵢ| ≤ (|dᵢ|_{M⁻¹} + |kᵢ|_{U⁻¹}) √(2c/(1 − σ²)), dᵢ and kᵢ the rows of ĴᵀK_vĴ + B_c and
    of ĴᵀK_p.

    `known` is the V that certifies the loop without limits; None if none does.
    """
    controller, effort = loop.controller, np.asarray(limiter.limits.effort)
    kp, kv, damping = loop.diagonals
    protects = limiter.proof and known is not None and not known.A2.any()
    if protects and known is not None:
        protects = np.allclose(known.A1, limiter.alpha * np.eye(len(kp)), rtol=1e-9)
    g = samples.g
    if controller.adaptation is None:  # what the law adds
        g = np.array([controller.gravity.torque(q) for q in samples.q])  # type: ignore[union-attr]
    room = effort - np.abs(g)
    pull = samples.J_hat.mT * kp
    asked = np.abs(g - (pull @ samples.s[..., np.newaxis])[..., 0])
    holds = bool((room > 0.0).all())
    most = controller.saturation.s(np.full(len(kp), _FAR))
    free = {}
    units = np.array(controller.task.units)
    for unit in dict.fromkeys(controller.task.units):
        group = units == unit
        part = pull[:, :, group]
        if (np.abs(part) @ most[group] <= room).all():
            free[unit] = np.inf
            continue
        with np.errstate(divide="ignore", invalid="ignore"):  # |s(e)| ≤ |e|
            sizes = np.where(room > 0.0, room / np.linalg.norm(part, axis=2), 0.0)
        free[unit] = float(np.nanmin(sizes))
    level = 0.0
    if sampled is not None and sampled.certified and holds:
        D_c = law.dissipation(samples.J_hat, kv, damping)
        M_inv = np.linalg.inv(samples.M)
        along = np.sqrt(np.einsum("nij,njk,nik->ni", D_c, M_inv, D_c))
        if sampled.latency.velocity_filter:  # q̇ of other configurations is in it, too
            lightest = np.linalg.eigvalsh(M_inv)[:, -1].max()
            along = np.sqrt(lightest) * np.linalg.norm(D_c, axis=2)
        potential = np.linalg.inv(sampled.weights.block(loop.setting.saturation.c_bar))
        along = along + np.sqrt(np.einsum("nij,jk,nik->ni", pull, potential, pull))
        # ½(1 − σ²) is level/v̄²
        level = sampled.level * min(1.0, float((room / along).min() / sampled.speed)) ** 2
    clipped = float((asked > effort).any(axis=1).mean())
    return LimitCost(clipped, free, level, holds, protects, limiter.proof)
