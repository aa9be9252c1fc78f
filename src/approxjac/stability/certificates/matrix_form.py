"""Test 2: the matrix form with free potential, a linear matrix inequality over many samples.

It is solved by cutting planes: with a dozen unknowns and thousands of small matrices, eigenvalue
decompositions and a linear program of the few relevant directions (HiGHS, through SciPy) are faster
than a conic solver. The result is optimal to within `_PRECISION`; round-off may change it by that.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.errors import package_of
from approxjac.law import sampled_form
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.validation import Array

Family = Literal["free", "full"]
"""The Lyapunov functions that are tried.

"free" is the paper's G = αĴ⁺ with any w, "full" is G = Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂ with any m × m matrices A₁
and A₂, any w, and any coupling Ω. (For m > 3 A₁ and A₂ are diagonal: full ones have so many entries
that finding them takes minutes.)
"""
FAMILIES: tuple[Family, ...] = ("free", "full")

_FULL = 3  # task coordinates up to which the matrices of "full" are full
_BOX = 30.0  # unknowns are sought within so many times their natural size
_ACTIVE = 60  # samples to begin with
_MORE = 40  # and how many of the worst are added at a time
_FIRST = 5  # looked at first: one of so many samples
_CUTS = 10  # a round, from the samples that violate most
_KEPT = 150  # of all rounds, those that bind or come nearest to it
_ROUNDS = 150
_STEP = 0.4
_PRECISION = 5e-3  # of the margin
_SIGN = 1e-5  # and while it is negative, as weights of other sizes may still make it positive
_HALF = 0.5  # λ where nothing but one damped mass is held, as long as it may be
_PORTION = 1000  # samples
_MULTIPLE = 1e-6  # frames of so nearly whole numbers of periods fall on samples


class Weights(NamedTuple):
    """A Lyapunov function V = ½q̇ᵀMq̇ + q̇ᵀM(Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂)s + Σ wᵢSᵢ(eᵢ) + ½sᵀΩs."""

    A1: Array  # shape (m, m) [1/s]; αI in the paper
    A2: Array  # shape (m, m) [1/s]; zero in the paper
    w: Array  # shape (m,) [N per unit of the task]; k_p + αk_v in the paper
    multiplier: float = 0.0  # λ of `law.sampled_form`
    X: Array | float = 0.0  # its X, shape (m,)
    coupling: Array | float = 0.0  # Ω, symmetric with a diagonal of zeros, shape (m, m)

    def plus(self, share: float, other: Weights) -> Weights:
        """Return these weights plus a share of others."""
        return Weights(*(mine + share * its for mine, its in zip(self, other, strict=True)))  # type: ignore[arg-type]

    def at_rest(self, e: Array, saturation: law.Saturation) -> Array:
        """Return V at rest [J] with errors e, any leading axes."""
        coupling = self.coupling + np.zeros_like(self.A1)
        return law.potential(saturation.S(e), saturation.s(e), self.w, coupling)

    def block(self, c_bar: float) -> Array:
        """Return 2c̄ W + Ω, shape (m, m)."""
        return law.potential_block(self.w, self.coupling + np.zeros_like(self.A1), c_bar)


@dataclass(frozen=True, eq=False)
class Setting:
    """The closed loop's part of the conditions, the same in every sample."""

    kp: Array  # diagonal of K_p, shape (m,)
    kv: Array  # diagonal of K_v, shape (m,)
    B: Array  # diagonal of all viscous damping, shape (n_v,)
    saturation: law.Saturation
    fixed_alpha: float | None = None  # α where gravity is learnt with it by (29) [1/s]
    weight: Array | None = None  # of `law.cross_weight_pinv`, shape (n_v,)

    @property
    def alpha(self) -> float:
        """α, or if it is free its typical size, half the mean rate k_p/k_v [1/s]."""
        if self.fixed_alpha is not None:
            return self.fixed_alpha
        return 0.5 * float(np.mean(self.kp / self.kv))

    @property
    def families(self) -> tuple[Family, ...]:
        """Families that apply: with learnt gravity G has to match αĴ⁺ of (29)."""
        return FAMILIES if self.fixed_alpha is None else ("free",)


class FamilyNumbers(NamedTuple):
    """The unknowns y of a family, scaled to be of the order of one: `fixed` + Σ yₖ `basis`ₖ."""

    fixed: Weights
    basis: list[Weights]
    start: Array  # y to begin with, shape (d,)
    least: Array  # lower bounds of y, shape (d,)

    def weights(self, y: Array) -> Weights:
        """Return the Lyapunov function of some unknowns."""
        total = self.fixed
        for k, part in zip(y, self.basis, strict=True):
            total = total.plus(k, part)
        return total


class Best(NamedTuple):
    """The Lyapunov function of a family with the largest least margin."""

    weights: Weights
    margins: Array  # in every sample, shape (N,)
    active: Indices  # indices of the samples that decided it
    unknowns: Array  # scaled unknowns of `weights`, to start from again, shape (d,)
    cuts: Array  # known bounds, see `_cutting_planes`


class MatrixForm:
    """Matrices that have to be positive for V to be a Lyapunov function, at many samples."""

    fills = False  # True if `metric` differs from Y

    def __init__(self, samples: Samples, setting: Setting) -> None:
        self.samples, self.setting = samples, setting
        J_hat, dJ_hat, kv = samples.J_hat, samples.dJ_hat, setting.kv
        D = law.dissipation(J_hat, kv, setting.B)
        pinv = law.cross_weight_pinv(J_hat, dJ_hat, setting.weight)
        damped = law.cross_weight_damped(D, J_hat, dJ_hat, kv)
        self._of_samples = _OfSamples(D, np.linalg.inv(np.linalg.cholesky(D)), *pinv, *damped)

    def take(self, which: Indices | slice) -> Self:
        """Return the matrices of some of the samples."""
        other = copy.copy(self)
        other.samples = self.samples.take(which)
        other._of_samples = _OfSamples(*(values[which] for values in self._of_samples))
        return other

    def elsewhere(self, samples: Samples) -> MatrixForm:
        """Return this form at other samples of the same region."""
        return MatrixForm(samples, self.setting)

    def widened(self, samples: Samples) -> MatrixForm:
        """Return this form at other samples, whose largest constants count, too."""
        return self.elsewhere(samples)

    def including(self, samples: Samples) -> MatrixForm:
        """Return this form with more samples."""
        return MatrixForm(self.samples.join(samples), self.setting)

    def pencils(self, weights: Weights) -> tuple[Array, Array]:
        """Return X and Y with the margin as the largest μ for which X − μY ≥ 0.

        X holds Q of V̇ = −zᵀQz and P of V ≥ ½zᵀPz, one after the other, Y the same without their
        cross blocks and inertia; both of shape (2, N, k, k) and affine in the weights. Here k is
        n_v + m; if larger, P is filled up with a block that is always positive.
        """
        D, M = self._of_samples.D, self.samples.M
        Q, G = self._decrease(weights)
        P = law.potential_matrix(M, G, weights.block(self.setting.saturation.c_bar))
        F = self._form(weights, Q, G)
        n, k, whole = D.shape[-1], P.shape[-1], F.shape[-1]
        X, Y = np.zeros((2, *F.shape)), np.zeros((2, *F.shape))
        Y[0, :, :n, :n], Y[1, :, :n, :n] = D, M
        Y[0, :, n:k, n:k], Y[1, :, n:k, n:k] = Q[:, n:, n:], P[:, n:, n:]
        X[0], X[1, :, :k, :k] = F, P
        X[1, :, range(k, whole), range(k, whole)] = 1.0
        return X, Y

    def _form(self, weights: Weights, Q: Array, G: Array) -> Array:
        """Return the form that has to be positive along motions: Q, or a larger one."""
        return Q

    def unknowns(self, family: Family) -> FamilyNumbers:
        """Return the unknowns of a family."""
        setting, m = self.setting, len(self.setting.kp)
        one, zero, none = np.eye(m), np.zeros((m, m)), np.zeros(m)
        alpha, kp, kv = setting.alpha, setting.kp, setting.kv
        potentials = [Weights(zero, zero, row) for row in np.diag(kp + alpha * kv)]
        fixed, start = Weights(zero, zero, none), [1.0]
        cross, couplings = [Weights(alpha * one, zero, none)], []
        if family == "full":  # any A₁ and A₂, from αĴ⁺ on
            entries = [(i, j) for i in range(m) for j in range(m) if i == j or m <= _FULL]
            units = [alpha * np.outer(one[i], one[j]) for i, j in entries]
            cross = [Weights(unit, zero, none) for unit in units]
            cross += [Weights(zero, unit, none) for unit in units]
            start = [float(i == j) for i, j in entries] + [0.0] * len(units)
            sizes = np.sqrt(kp + alpha * kv)  # of the potentials that Ω couples
            for i, j in itertools.combinations(range(m), 2):
                pair = np.outer(one[i], one[j]) * sizes[i] * sizes[j]
                couplings.append(Weights(zero, zero, none, coupling=pair + pair.T))
        if setting.fixed_alpha is not None:
            fixed, cross, start = fixed.plus(1.0, cross[0]), [], []
        begun = np.array([*start, *np.ones(len(potentials)), *np.zeros(len(couplings))])
        return FamilyNumbers(
            fixed, [*cross, *potentials, *couplings], begun, np.full(len(begun), -_BOX)
        )

    def metric(self, Y: Array) -> Array:
        """Return Y, filled up where it is zero, for eigenvectors to be sought in."""
        return Y

    def margins(self, weights: Weights) -> Array:
        """Return the margin of each sample, at most 1, positive where V proves stability; (N,).

        V̇ ≤ −μ(q̇ᵀDq̇ + sᵀsym(K_pĴG)s) and V ≥ μ(½q̇ᵀMq̇ + ½sᵀ(2c̄W + Ω)s) hold there. −∞ where
        sym(K_pĴG) or 2c̄W + Ω is not positive.
        """
        margins = np.full(len(self.samples), -np.inf)
        if not self._is_bounded(weights):
            return margins
        Q, G = self._decrease(weights)
        n = Q.shape[-1] - len(weights.w)
        positive = np.linalg.eigvalsh(Q[:, n:, n:])[:, 0] > 0.0
        Q = Q[positive]
        root = np.zeros_like(Q)
        root[:, :n, :n] = self._of_samples.root[positive]
        root[:, n:, n:] = np.linalg.inv(np.linalg.cholesky(Q[:, n:, n:]))
        margins[positive] = np.linalg.eigvalsh(root @ Q @ root.mT)[:, 0]
        # of P the margin is 1 less the largest singular value of the whitened cross block
        return np.asarray(np.minimum(margins, 1.0 - np.sqrt(self._kinetic(weights, G))))

    def _is_bounded(self, weights: Weights) -> bool:
        return bool(np.linalg.eigvalsh(weights.block(self.setting.saturation.c_bar))[0] > 0.0)

    def _kinetic(self, weights: Weights, G: Array) -> Array:
        """σ² of each sample, shape (N,): V ≥ ½(1 − σ²)|q̇|²_M, of V that `_is_bounded`."""
        root = np.linalg.inv(np.linalg.cholesky(weights.block(self.setting.saturation.c_bar)))
        square = root @ (G.mT @ self.samples.M @ G) @ root.T
        return np.asarray(np.maximum(np.linalg.eigvalsh(square)[:, -1], 0.0))

    def violations(self, weights: Weights) -> int:
        """Return the number of samples whose margin is not positive."""
        return int((self.margins(weights) <= 0.0).sum())

    def cross_weight(self, weights: Weights) -> Array:
        """Return G, shape (N, n_v, m)."""
        of = self._of_samples
        return np.asarray(of.pinv @ weights.A1 + of.damped @ weights.A2)

    def _decrease(self, weights: Weights) -> tuple[Array, Array]:
        """Q of V̇ = −zᵀQz, (N, n_v + m, n_v + m), and the cross weight G, (N, n_v, m)."""
        at, of, setting = self.samples, self._of_samples, self.setting
        G, dG = of.pinv @ weights.A1, of.dpinv @ weights.A1
        if weights.A2.any():
            G, dG = G + of.damped @ weights.A2, dG + of.ddamped @ weights.A2
        N = law.inertial_block(at.M, at.dM, at.J_e, G, dG, at.s, at.slope)
        coupling = np.asarray(weights.coupling) if np.any(weights.coupling) else None
        Q = law.decrease_matrix(
            of.D, N, at.J_e, at.J_hat, G, setting.kp, weights.w, coupling, at.slope
        )
        return Q, G


class _OfSamples(NamedTuple):
    """Terms of each sample that no weights change: D, L⁻¹ of D = LLᵀ, both G of `law` with ∂G."""

    D: Array
    root: Array
    pinv: Array
    dpinv: Array
    damped: Array
    ddamped: Array


def best_weights(
    form: MatrixForm, family: Family | FamilyNumbers, known: Best | None = None
) -> Best:
    """Choose the Lyapunov function of a family whose least margin is largest.

    The worst samples are collected until no other one is worse. `known` is the best for the first
    samples, to start from.
    """
    unknowns = form.unknowns(family) if isinstance(family, str) else family
    N = len(form.samples)
    y, cuts = unknowns.start, np.empty((2, 0, 1 + len(unknowns.start)))
    active = np.unique(np.linspace(0, N - 1, _ACTIVE).astype(int))
    if known is not None:
        active = np.union1d(known.active, np.arange(len(known.margins), N))
        y, cuts = known.unknowns, known.cuts
    y, inner, cuts = _cutting_planes(form.take(active), unknowns, y, cuts)
    for every in (_FIRST, 1):  # most of the samples that decide it are found among a few
        some = form.take(slice(None, None, every))
        while True:
            margins = some.margins(unknowns.weights(y))
            others = np.setdiff1d(every * np.argsort(margins)[:_MORE], active)
            if margins.min() >= inner - _PRECISION or len(others) == 0:
                break
            active = np.concatenate([active, others])
            y, inner, cuts = _cutting_planes(form.take(active), unknowns, y, cuts)
    return Best(unknowns.weights(y), margins, active, y, cuts)


def _cutting_planes(
    form: MatrixForm, unknowns: FamilyNumbers, start: Array, cuts: Array
) -> tuple[Array, float, Array]:
    """Maximise the least margin: μ is raised to that of the best point until no point beats it.

    X − μY is affine in the unknowns; its eigenvectors v bound its least eigenvalue by vᵀ(X − μY)v.
    These bounds, the cuts, hold of the same samples among others, too.

    They are vᵀXv and vᵀYv as affine functions, shape (2, c, 1 + d). Returned are the best unknowns,
    their least margin, and the cuts that matter near them.
    """
    linprog = package_of("study", "scipy.optimize").linprog
    d = len(start)
    X0, Y0 = form.pencils(unknowns.fixed)
    parts = [form.pencils(unknowns.fixed.plus(1.0, part)) for part in unknowns.basis]
    X1, Y1 = np.stack([X - X0 for X, _ in parts]), np.stack([Y - Y0 for _, Y in parts])

    def look(
        y: Array, mu: float = 0.0, metric: Array | None = None
    ) -> tuple[float, Array, Array, Array] | None:
        """Return the least margin, −∞ where Y is not positive; L⁻¹ of Y = LLᵀ, or the one given.

        And the matrices X, or X − μY, whitened with that, and their least eigenvalues, (2, N).
        """
        weights = unknowns.weights(y)
        (X, Y), is_positive = form.pencils(weights), True
        try:
            metric = np.linalg.inv(np.linalg.cholesky(form.metric(Y)))
        except np.linalg.LinAlgError:
            if metric is None:
                return None
            is_positive = False
        if form.fills or not is_positive:
            X = X - mu * Y
        whitened: Array = metric @ X @ metric.mT
        values = np.asarray(np.linalg.eigvalsh(whitened)[..., 0], dtype=np.float64)
        margin = float(values.min()) if is_positive else -np.inf
        if form.fills:  # Y does not tell the margin
            margin = float(form.margins(weights).min())
        return margin, metric, whitened, values

    best, here = start, look(start)
    if here is None:  # the start is of fewer samples
        best, here = unknowns.start, look(unknowns.start)
    assert here is not None
    best_margin, metric, whitened, values = here
    mu = max(best_margin, -1.0)
    for _ in range(_ROUNDS):
        worst = np.argsort(values, axis=None)[:_CUTS]
        which = np.unravel_index(worst, values.shape)
        vectors = metric.mT[which] @ np.linalg.eigh(whitened[which])[1][..., :2]
        for v in np.moveaxis(vectors, -1, 0):
            more = np.stack([_along(v, X0, X1, which), _along(v, Y0, Y1, which)])
            cuts = np.concatenate([cuts, more], axis=1)
        bound = cuts[0] - mu * cuts[1]
        answer = linprog(
            np.append(np.zeros(d), -1.0),
            A_ub=np.column_stack([-bound[:, 1:], cuts[1] @ np.append(1.0, best)]),
            b_ub=bound[:, 0],
            bounds=[*((least, _BOX) for least in unknowns.least), (None, 10.0)],
            method="highs-ds",
            options={"presolve": False},
        )
        if answer.status != 0 or answer.x[-1] < (_PRECISION if best_margin > 0.0 else _SIGN):
            break
        cuts = cuts[:, np.sort(np.argsort(answer.slack)[:_KEPT])]
        # part of the way only, as the bounds far from the best point are still poor
        y = best + _STEP * (answer.x[:-1] - best)
        here = look(y, mu, metric)
        assert here is not None
        margin, metric, whitened, values = here
        if margin > best_margin:
            best, best_margin, mu = y, margin, max(mu, margin)
    return best, best_margin, cuts


def _along(v: Array, A0: Array, A1: Array, which: tuple[Indices, ...]) -> Array:
    """Return the affine functions vᵀA(y)v, constants first; shape (number of v, 1 + d)."""
    constant: Array = np.einsum("ci,cij,cj->c", v, A0[which], v)
    return np.column_stack([constant, np.einsum("ci,kcij,cj->ck", v, A1[:, which[0], which[1]], v)])


# -- the loop that is sampled, held and late -------------------------------------------------------


class Hold(NamedTuple):
    """Bounds on the effect of holds and delays."""

    gain: float  # γ of the torque, or of its part with D_c if x comes in frames [s]
    span: float  # longest age of an acting torque [s]
    lag: float  # mean age of a filtered q̇ [s]
    frames: float | None = None  # γ_x of x in frames [s]; None if x is read at each sample
    age: float = 0.0  # longest age of x [s]
    turned: float = 0.0  # γ of the torque's change with q alone while q̇ is that old [s]

    @classmethod
    def of(cls, latency: Latency) -> Hold:
        """Return the bounds for the delays of a loop.

        A filter of differences of q is late by its time constant and half a period in the mean.
        Frames that do not fall on samples wait for the next one; counted back by the longest wait,
        they follow each other without a gap, so that `hold_gain` remains.
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
        return cls(gain, span, lag, sampled_form.hold_gain(held, late + d), held + late + d, turned)


class Turning(NamedTuple):
    """Largest rates of change of the samples' matrices, see `law.sampled_form`."""

    fastest: float  # of L⁻¹UL, D = LLᵀ: the rate at which the torque's error answers itself [1/s]
    curvature: float = 0.0  # κ
    damping: float = 0.0  # k_R
    stiffness: float = 0.0  # ē
    filtered: float = 0.0  # k_f, where q̇ is filtered
    # largest |∂g q̇| in the norm of D⁻¹ over |q̇|_D, where q̇ is filtered [1/s]
    gravity: float = 0.0


class SampledForm(MatrixForm):
    """The matrix form of a loop with a latency, for motions with |q̇|_M ≤ v̄.

    Its weights have a multiplier and, where x comes in frames or q̇ through a filter, X.
    """

    fills = True

    def __init__(
        self,
        form: MatrixForm,  # the form in continuous time, at the same samples
        friction: Array,  # diagonal of the arm's own part of B, shape (n_v,)
        hold: Hold,  # `Hold` of the loop
        speed: float,  # v̄ [√J]
        most_s: float,  # s̄, a bound of |s(e)| along these motions, used if x comes in frames
        # `Turning` of these and possibly other samples; by default of these
        turning: Turning | None = None,
    ) -> None:
        self.samples, self.setting, self._of_samples = form.samples, form.setting, form._of_samples
        self.hold, self.speed, self.most_s = hold, speed, most_s
        self._friction = friction
        # ρ, for which F − ρP replaces F and gains are those of e^(ρt)(z, w), so that V e^(2ρt)
        # never rises, and the largest S(e)/s(e)² [1/s, –]
        self.decay = 0.0, 0.5
        at, D, kp = self.samples, self._of_samples.D, self.setting.kp
        D_c = D - np.diag(friction)
        if self.hold.frames is None:
            self._rate = sampled_form.torque_rate(
                at.M, D, D_c, at.J_hat, at.dJ_hat, at.J_e, at.s, at.slope, kp, at.dg
            )
        else:
            self._rate = sampled_form.damping_rate_of_torque(at.M, D, D_c, at.J_hat, kp, at.dg)
        if turning is None:  # a portion after the other, as caches are small
            parts = [slice(k, k + _PORTION) for k in range(0, len(D), _PORTION)]
            turning = Turning(**{
                name: max(float(self.take(rows).constant(name).max()) for rows in parts)
                for name in self.constants
            })  # fmt: skip
        self.turning = turning

    @property
    def constants(self) -> list[str]:
        """Names of the constants of `Turning` that the loop uses."""
        frames, names = self.hold.frames is not None, ["fastest"]
        names += ["curvature", "damping"] if self.speed else []
        names += ["stiffness"] if self.speed and frames else []
        names += ["gravity"] if self.hold.lag else []
        return [*names, "filtered"] if self.speed and self.hold.lag else names

    def constant(self, name: str) -> Array:
        """Return the value of a constant of `Turning`, or "energy" at rest, in each sample (N,)."""
        at, (D, root, *_), setting = self.samples, self._of_samples, self.setting
        kp, kv = setting.kp, setting.kv
        if name == "energy":
            return np.asarray(setting.saturation.S(at.e) @ (kp + setting.alpha * kv))
        if name == "fastest":
            turned = root @ self._rate.U @ np.linalg.inv(root)
            return np.asarray(np.linalg.svd(turned, compute_uv=False)[:, 0])
        if name == "gravity":
            return np.asarray(np.linalg.norm(root @ at.dg @ root.mT, 2, axis=(-2, -1)))
        if name == "stiffness":
            return sampled_form.stiffness_turn(D, at.dJ_hat, kp)
        if name == "curvature":
            D_c = D - np.diag(self._friction)
            return sampled_form.torque_curvature(at.M, at.dM, D, D_c, at.J_hat, at.dJ_hat, kv)
        is_filtered = name == "filtered"
        return sampled_form.damping_turn(at.M, D, at.J_hat, at.dJ_hat, kv, is_filtered)

    @property
    def _growth(self) -> float:
        rate = self.decay[0] + self.turning.damping * self.speed
        return sampled_form.growth(rate, self.hold.span, self.hold.lag)

    @property
    def _gain(self) -> float:
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
        """Return this form at other samples of the same region."""
        form, friction = MatrixForm(samples, self.setting), self._friction
        return SampledForm(form, friction, self.hold, self.speed, self.most_s, self.turning)

    def widened(self, samples: Samples) -> SampledForm:
        form, friction = MatrixForm(samples, self.setting), self._friction
        other = SampledForm(form, friction, self.hold, self.speed, self.most_s)
        return other.changed(turning=Turning(*np.maximum(self.turning, other.turning).tolist()))

    def including(self, samples: Samples) -> SampledForm:
        form, friction = super().including(samples), self._friction
        return SampledForm(form, friction, self.hold, self.speed, self.most_s)

    def changed(self, **values: Any) -> Self:
        """Return this with another `hold`, `speed`, `most_s` or `decay`."""
        other = copy.copy(self)
        for name, value in values.items():
            setattr(other, name, value)
        return other

    def with_speed(self, speed: float) -> Self:
        """Return this with another v̄ > 0, and s̄ in proportion."""
        return self.changed(speed=speed, most_s=self.most_s * speed / self.speed)

    def take(self, which: Indices | slice) -> Self:
        other = super().take(which)
        parts = (None if each is None else each[which] for each in self._rate)
        other._rate = sampled_form.TorqueRate(*parts)  # type: ignore[arg-type]
        return other

    def is_possible(self) -> bool:
        """True if some multiplier may exist: the hold is not too long for this form."""
        return self._gain * (1.0 + self._b) * self.turning.fastest**2 < 1.0

    @property
    def _size(self) -> float:
        return _HALF / min(1.0, math.sqrt(self._gain) * self.turning.fastest)

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

    def unknowns(self, family: Family) -> FamilyNumbers:
        """Return the unknowns of a family, with the multiplier and X."""
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
        """Return the largest |s(e)| of motions with V(0) ≤ `level`; infinite without a bound.

        V ≥ ½ (1 − σ²) sᵀ(2c̄W + Ω)s.
        """
        least = float(np.linalg.eigvalsh(weights.block(self.setting.saturation.c_bar))[0])
        return self.speed / math.sqrt(least) if least > 0.0 else math.inf

    def level(self, weights: Weights) -> float:
        """Return c [J]: with V(0) ≤ c, |q̇|_M stays below v̄."""
        share = float(self._kinetic(weights, self.cross_weight(weights)).max())  # σ² < 1
        return 0.5 * (1.0 - share) * self.speed**2
