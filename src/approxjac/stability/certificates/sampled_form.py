"""`SampledForm`: the matrix form of the loop that is sampled, held and late, over many samples."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple, Self

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.law import sampled_form
from approxjac.stability.certificates.matrix_form import (
    Best,
    Family,
    FamilyNumbers,
    MatrixForm,
    Weights,
    best_of,
)
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.validation import Array

_HALF = 0.5  # λ where nothing but one damped mass is held, as long as it may be
_PORTION = 1000  # samples
_MULTIPLE = 1e-6  # frames of so nearly whole numbers of periods fall on samples


class Hold(NamedTuple):
    """Bounds on what holds and delays amount to.

    Attributes:
        gain: γ of the torque, or of its part with D_c where x comes in frames [s].
        span: Longest time that a torque is out of date [s].
        lag: Mean age of q̇ that a filter makes of it [s].
        frames: γ_x of x that comes in frames [s]; None where x is read with the rest.
        age: Longest time that x is out of date [s].
        turned: γ of what q alone makes of the torque while q̇ is that old [s].
    """

    gain: float
    span: float
    lag: float
    frames: float | None = None
    age: float = 0.0
    turned: float = 0.0

    @classmethod
    def of(cls, latency: Latency) -> Hold:
        """Return that of a loop.

        A filter of differences of q, with its time constant τ, has the means of q̇ over earlier
        periods, with falling weights: it is late by τ and half a period in the mean. Frames that
        do not fall on samples wait for the next one, each for another time; counted back by the
        longest, the times that they are used for follow each other without a gap, each with an
        error that is zero where its frame was taken, so that `hold_gain` remains.
        """
        h, d = latency.period, latency.torque_delay
        lag = latency.velocity_filter + 0.5 * h if latency.velocity_filter > 0.0 else 0.0
        turned = lag + 0.5 * h if lag else 0.0
        gain, span = sampled_form.hold_gain(h, d) + lag, h + d
        if not (lag or latency.image_period or latency.image_age):
            return cls(gain, span, lag)
        held, late = max(latency.image_period, h), h * math.ceil(latency.image_age / h - _MULTIPLE)
        frames = latency.image_period / h
        if abs(frames - round(frames)) > _MULTIPLE:
            late += min(latency.image_period, h)
        x = sampled_form.hold_gain(held, late + d)
        return cls(gain, span, lag, x, held + late + d, turned)


class Turning(NamedTuple):
    """Largest rates at which samples turn: of `law.sampled_form`.

    Attributes:
        curvature: κ.
        damping: k_R.
        stiffness: ē.
        filtered: k_f, where q̇ is filtered.
        gravity: Largest |∂g q̇| in the norm of D⁻¹ over |q̇|_D, where q̇ is filtered [1/s].
    """

    curvature: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    filtered: float = 0.0
    gravity: float = 0.0


class SampledForm(MatrixForm):
    """The form of a loop that runs with a latency, for motions with |q̇|_M ≤ v̄.

    Its weights have a multiplier and, where x comes in frames or q̇ through a filter, X.

    Args:
        form: That of continuous time, where it is evaluated.
        friction: Diagonal of the arm's own part of B, shape (n_v,).
        hold: That of the loop.
        speed: v̄ [√J].
        most_s: s̄, at least |s(e)| along these motions; it counts where x comes in frames.
        turning: Of these samples and of others; of these by default.

    Attributes:
        decay: ρ, with which F − ρP is in place of F and gains are those of e^(ρt)(z, w), so that
            V e^(2ρt) never rises, and the largest S(e)/s(e)² [1/s, –].
    """

    fills = True

    def __init__(
        self,
        form: MatrixForm,
        friction: Array,
        hold: Hold,
        speed: float,
        most_s: float = 0.0,
        turning: Turning | None = None,
    ) -> None:
        self.samples, self.setting, self._of_samples = form.samples, form.setting, form._of_samples
        self.hold, self.speed, self.most_s = hold, speed, most_s
        self.decay, self._friction = (0.0, 0.5), friction
        at, D, kp = self.samples, self._of_samples.D, self.setting.kp
        D_c = D - np.diag(friction)
        if self.hold.frames is None:
            self._rate = sampled_form.torque_rate(
                at.M, D, D_c, at.J_hat, at.dJ_hat, at.J_e, at.s, at.slope, kp, at.dg
            )
        else:
            self._rate = sampled_form.damping_rate_of_torque(at.M, D, D_c, at.J_hat, kp, at.dg)
        self.turning = self._turning(D_c) if turning is None else turning
        # of L⁻¹UL, D = LLᵀ: the rate at which the torque's error answers itself [1/s]
        turned = self._of_samples.root @ self._rate.U @ np.linalg.inv(self._of_samples.root)
        self._fastest = float(np.linalg.svd(turned, compute_uv=False)[:, 0].max())

    @property
    def _growth(self) -> float:
        rate = self.decay[0] + self.turning.damping * self.speed
        return sampled_form.growth(rate, self.hold.span, self.hold.lag)

    @property
    def _gain(self) -> float:
        """Γ² [s²]."""
        return (self.hold.gain * self._growth) ** 2

    @property
    def _b(self) -> float:
        hold, turning, v_bar = self.hold, self.turning, self.speed
        b = hold.gain * turning.curvature * v_bar
        b += hold.turned * (turning.filtered * v_bar + turning.gravity)
        if hold.frames is not None:
            b += hold.span * turning.stiffness * self.most_s
        return self._growth * b

    @property
    def _frames(self) -> float | None:
        """γ_x, grown with the rate [s]."""
        x = self.hold.frames
        return None if x is None else x * sampled_form.growth(self.decay[0], self.hold.age)

    def elsewhere(self, samples: Samples) -> SampledForm:
        """Return this at other samples of the same region."""
        form, friction = MatrixForm(samples, self.setting), self._friction
        return SampledForm(form, friction, self.hold, self.speed, self.most_s, self.turning)

    def changed(self, **values: Any) -> Self:
        """Return this with another `hold`, `speed`, `most_s` or `decay`."""
        other = copy.copy(self)
        for name, value in values.items():
            setattr(other, name, value)
        return other

    def with_speed(self, speed: float) -> Self:
        """Return this with another v̄ > 0, and s̄ in proportion."""
        return self.changed(speed=speed, most_s=self.most_s * speed / self.speed)

    def _turning(self, D_c: Array) -> Turning:
        """The largest of all samples, a portion after the other, as caches are small."""
        turning, of, (kp, kv) = Turning(), self._of_samples, (self.setting.kp, self.setting.kv)
        for k in range(0, len(D_c), _PORTION):
            rows = slice(k, k + _PORTION)
            at, D, root, each = self.samples.take(rows), of.D[rows], of.root[rows], {}
            if self.hold.lag:
                each["gravity"] = np.linalg.norm(root @ at.dg @ root.mT, 2, axis=(-2, -1))
            if self.speed:
                turned = at.M, D, at.J_hat, at.dJ_hat, kv
                each["damping"] = sampled_form.damping_turn(*turned)
                each["curvature"] = sampled_form.torque_curvature(
                    at.M, at.dM, D, D_c[rows], at.J_hat, at.dJ_hat, kv
                )
                if self.hold.lag:
                    each["filtered"] = sampled_form.damping_turn_along(*turned)
                if self.hold.frames is not None:
                    each["stiffness"] = sampled_form.stiffness_turn(D, at.dJ_hat, kp)
            most = {name: float(values.max()) for name, values in each.items()}
            turning = Turning(*map(max, turning, Turning(**most)))
        return turning

    def take(self, which: Indices | slice) -> Self:
        """Return the matrices of some of the samples."""
        other = super().take(which)
        other._rate = self._rate.changed(lambda values: values[which])
        return other

    def is_possible(self) -> bool:
        """True if some multiplier may do: the hold is not beyond what this can certify."""
        return self._gain * (1.0 + self._b) * self._fastest**2 < 1.0

    @property
    def _size(self) -> float:
        """Natural size of λ: ½ at the largest γ that may do, and as 1/γ below it."""
        return _HALF / min(1.0, math.sqrt(self._gain) * self._fastest)

    @property
    def _sizes(self) -> Array:
        """Natural sizes of X: as many as coordinates of x where it comes in frames, or none."""
        frames = self.hold.frames
        return np.zeros(0) if frames is None else _HALF * self.setting.kp / frames

    def _with_multipliers(self, numbers: FamilyNumbers) -> FamilyNumbers:
        m = len(self.setting.kp)
        zero, none = np.zeros((m, m)), np.zeros(m)
        more = [Weights(zero, zero, none, self._size)]
        more += [Weights(zero, zero, none, 0.0, row) for row in np.diag(self._sizes)]
        start = np.append(numbers.start, np.ones(len(more)))
        least = np.append(numbers.least, np.zeros(len(more)))  # none of these is negative
        return FamilyNumbers(numbers.fixed, [*numbers.basis, *more], start, least)

    def best_multiplier(self, weights: Weights) -> Best:
        """Choose the multiplier, and X, of a function that is known."""
        fixed, none = weights._replace(multiplier=0.0, X=0.0), np.zeros(0)
        return best_of(self, self._with_multipliers(FamilyNumbers(fixed, [], none, none)))

    def unknowns(self, family: Family) -> FamilyNumbers:
        """Return those of the family, with the multiplier and X."""
        return self._with_multipliers(super().unknowns(family))

    def _form(self, weights: Weights, Q: Array, G: Array) -> Array:
        of, at, frames = self._of_samples, self.samples, None
        if self._frames is not None:
            X = np.zeros(len(weights.w)) + weights.X
            frames = X, at.slope[..., np.newaxis] * at.J_e, self._frames**2
        F = sampled_form.held_form(
            Q, G, of.D, at.J_hat, self.setting.kp, self._rate, weights.multiplier, self._gain,
            self._b, frames,
        )  # fmt: skip
        rate, largest = self.decay
        if rate:
            P = law.potential_matrix(at.M, G, weights.block(largest))
            k = P.shape[-1]
            F[:, :k, :k] -= rate * P
        return F

    def metric(self, Y: Array) -> Array:
        """Return Y, filled up where it is zero."""
        (m, n), whole = self.samples.J_e.shape[-2:], Y.shape[-1]
        k, filled = n + m, Y.copy()
        filled[0, :, k : k + n, k : k + n] = self._size * np.linalg.inv(self._of_samples.D)
        frames = range(k + n, whole)
        filled[0, :, frames, frames] = self._sizes[:, np.newaxis]
        rest = range(k, whole)
        filled[1, :, rest, rest] = 1.0
        return filled

    def margins(self, weights: Weights) -> Array:
        """Return the margin of each sample with F in place of Q, shape (N,)."""
        usable = self._is_bounded(weights) and weights.multiplier > 0.0
        if not usable or not math.isfinite(self._gain):
            return np.full(len(self.samples), -np.inf)
        Q, G = self._decrease(weights)
        at, F = self.samples, self._form(weights, Q, G)
        held = sampled_form.held_margin(F, self._of_samples.D, at.J_hat, G, self.setting.kp)
        return np.minimum(held, 1.0 - np.sqrt(self._kinetic(weights, G)))

    def decrease(self, weights: Weights) -> Array:
        """Return F, shape (N, k, k), of (z, w) and what else there is."""
        return self._form(weights, *self._decrease(weights))

    def largest_s(self, weights: Weights) -> float:
        """Largest |s(e)| of motions that begin with V ≤ `level`; infinite where V bounds none.

        V ≥ ½ (1 − σ²) sᵀ(2c̄W + Ω)s.
        """
        least = float(np.linalg.eigvalsh(weights.block(self.setting.c_bar))[0])
        return self.speed / math.sqrt(least) if least > 0.0 else math.inf

    def level(self, weights: Weights) -> float:
        """c [J]: from V ≤ c on, |q̇|_M stays below v̄."""
        share = float(self._kinetic(weights, self.cross_weight(weights)).max())  # σ² < 1
        return 0.5 * (1.0 - share) * self.speed**2
