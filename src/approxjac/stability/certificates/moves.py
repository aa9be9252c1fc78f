"""Certified moves: bounds of ‖e‖ and of the joints while the target moves along a line.

The theorem of `docs/theory.md`, "Moves": if its formulas return less than the tube in which their
constants hold, every robot of the box stays in that tube. Constants are the largest of samples.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from approxjac import law
from approxjac.law import moves, sampled_form
from approxjac.stability.certificates.matrix_form import (
    Family,
    FamilyNumbers,
    Hold,
    MatrixForm,
    SampledForm,
    Setting,
    Weights,
)
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.validation import Array

_EPSILON = 0.1  # of (a + ψ)² ≤ (1 + ε)a² + (1 + 1/ε)ψ²
_INSTANTS = 300  # of the integrals
_PEAKS = (1.0, 0.6, 0.3, 0.1, 0.01)  # of slower moves, as shares
_PARTS = 64  # of the length, at which the growth along it is looked at
_TERMS, _LOOKED = 12, 50  # of e^A for a part; errors at which s(e) is looked at


class EasedLine(NamedTuple):
    """A target that is eased along a line."""

    d: Array  # unit direction, shape (m,)
    length: float  # [unit of the task]
    peak: float  # largest speed [unit of the task/s]

    @property
    def duration(self) -> float:
        """Time of the move [s]; of minimum jerk the peak is 15/8 of the mean speed."""
        return 1.875 * self.length / self.peak


class Tube(NamedTuple):
    """The set in which the constants hold."""

    R: Array  # largest distance of each joint from its robot's path, shape (n_v,) [rad or m]
    e: float  # largest |e| [unit of the task]
    nu: float  # largest |ν|_M [√J]

    def holds(self, other: Tube) -> bool:
        """Return True if another tube is strictly inside."""
        return bool((other.R < self.R).all()) and other.e < self.e and other.nu < self.nu


class Along(NamedTuple):
    """Bounds along a move, and integrals over all time: ∫v²dt is `v_v`, and so on.

    n² = |ν|²_D + |w|²_D⁻¹, whose integrals are by the inequality of Cauchy and Schwarz.
    """

    v: Array  # speed times the step of time, at some instants
    Y: Array  # of √(2V), at these
    s: Array  # of |s(e)|
    bent: float  # e/s(e)
    nu: float  # |ν|_M
    energy: float  # ∫n²
    v_v: float
    v_s: float
    a: float  # ∫|v̇|
    v_n: float
    s_n: float
    n: float
    turned: float  # factor by which a norm changes within a hold
    dropped: float  # of |g_k − g| in the norm of D⁻¹


class MovingForm(SampledForm):
    """The sampled form of a loop whose target moves, and the constants of the theorem.

    `most` are the largest constants of these and possibly other samples, by default of these.
    """

    def __init__(
        self,
        samples: Samples,
        setting: Setting,
        friction: Array,
        hold: Hold,
        line: EasedLine,
        nu: float,
        known: MovingForm | None = None,
    ) -> None:
        form, self.line = MatrixForm(samples, setting), line
        turning = None if known is None else known.turning
        super().__init__(form, friction, hold, nu, 0.0, turning)
        self.most: dict[str, Any] = largest(self.sizes()) if known is None else known.most

    @cached_property
    def motion(self) -> moves.MovingTarget:
        """The terms of the moving target."""
        at, setting, friction = self.samples, self.setting, self._friction
        return moves.motion(
            (at.M, at.dM), self._of_samples.D - np.diag(friction), at.J, (at.J_hat, at.dJ_hat),
            self._pinv, self.line.d, (at.s, at.slope), at.dg, (setting.kp, setting.kv), friction,
        )  # fmt: skip

    @property
    def _pinv(self) -> tuple[Array, Array]:
        """Ĵ⁺ of the law's ẋ_d: of least |q̇|, whatever that of learning is."""
        if self.setting.weight is None:
            return self._of_samples.pinv, self._of_samples.dpinv
        return law.cross_weight_pinv(self.samples.J_hat, self.samples.dJ_hat)

    @property
    def _weight(self) -> Array:
        """B of the own path, of which any will do for as many joints as coordinates."""
        return damping_of(self.setting)

    def elsewhere(self, samples: Samples) -> MovingForm:
        return self._at(samples, self)

    def including(self, samples: Samples) -> MovingForm:
        return self._at(self.samples.join(samples), None)

    def _at(self, samples: Samples, known: MovingForm | None) -> MovingForm:
        line, nu = self.line, self.speed
        other = MovingForm(samples, self.setting, self._friction, self.hold, line, nu, known)
        return other.changed(decay=self.decay)

    def take(self, which: Indices | slice) -> Self:
        other = super().take(which)
        vars(other).pop("motion", None)
        return other

    @property
    def _growth(self) -> float:
        fastest = self.speed + self.line.peak * self.most["r"]
        return sampled_form.growth(self.decay[0] + self.turning.damping * fastest, self.hold.span)

    @property
    def _gain(self) -> float:
        return (1.0 + _EPSILON) * (self.hold.gain * self._growth) ** 2

    @property
    def _b(self) -> float:
        slope = self.turning.curvature * self.speed + self.line.peak * self.most["turning"]
        return math.sqrt(self._gain) * slope

    def unknowns(self, family: Family) -> FamilyNumbers:
        """Return the unknowns with any diagonal A₂: damping leaves Q's cross block with it."""
        numbers, m = MatrixForm.unknowns(self, family), len(self.setting.kp)
        zero, none, alpha = np.zeros((m, m)), np.zeros(m), self.setting.alpha
        more = [Weights(zero, alpha * np.diag(row), none) for row in np.eye(m)]
        start, least = np.append(numbers.start, none), np.append(numbers.least, numbers.least[:m])
        return self._with_multipliers(
            FamilyNumbers(numbers.fixed, [*numbers.basis, *more], start, least)
        )

    def _form(self, weights: Weights, Q: Array, G: Array) -> Array:
        F = super()._form(weights, Q, G)
        of, k = self._of_samples, Q.shape[-1]
        dG = of.dpinv @ weights.A1 + of.ddamped @ weights.A2
        F[:, :k, :k] -= self.line.peak * moves.moving_part(self.motion, self.samples.M, G, dG)
        return F

    def sizes(self) -> dict[str, Array]:
        """Return the constants that no weights change, of each sample: (N,), (N, n_v) or more."""
        at, of, setting, on = self.samples, self._of_samples, self.setting, self.motion
        root, kp = of.root, setting.kp
        L, root_M = np.linalg.inv(root), np.linalg.inv(np.linalg.cholesky(at.M))
        own = moves.own_path(
            at.J, at.dJ, at.J_hat, at.dJ_hat, self._pinv, self.line.d, self._weight,
            self._friction,
        )  # fmt: skip
        B_c, c, inverse = setting.B - self._friction, moves.christoffel(at.dM), np.linalg.inv(at.M)
        theta = own.T * B_c @ inverse
        dtheta = (own.dT * B_c - theta[:, None] @ at.dM) @ inverse[:, None]
        turned = inverse @ (on.A - on.C)  # ∂Ĵ⁺[·]d
        coriolis = np.swapaxes(c, -3, -1)  # of Cᵀ: [j, k, a], symmetric in all but its first
        quadratic = np.moveaxis(own.dT @ at.M[:, None], 1, 2) + _first(own.T, coriolis)
        rubbed, still = theta * self._friction, own.T * B_c
        sizes = {
            "r": _length(np.linalg.cholesky(at.M).mT @ on.r[..., None])[..., 0],  # |r|_M
            "turning": _norm(root @ on.turning @ root.mT),
            "stiffness": _norm(root @ at.J_hat.mT * kp),
            "gravity of r": _length(root @ at.dg @ on.r[..., None])[..., 0],
            "gravity": _norm(root @ at.dg @ root.mT),
            "gravity of M": _norm(root @ at.dg @ root_M.mT),
            "H": np.linalg.norm(own.H, axis=-1),
            "dh": np.abs(own.dh),
            "along": np.diagonal(own.dh, axis1=1, axis2=2),
            "T": np.linalg.norm(own.T @ L, axis=-1),
            "theta": np.linalg.norm(theta @ L, axis=-1),
            "momentum of r": np.abs(own.T @ at.M @ on.r[..., None])[..., 0],
            "rubbed of r": np.abs(rubbed @ on.r[..., None])[..., 0],
            "rubbed": np.linalg.norm(rubbed @ root.mT, axis=-1),
            "turned of r": np.abs(still @ turned @ on.r[..., None])[..., 0],
            "turned": np.linalg.norm(still @ turned @ root.mT, axis=-1),
            "still": np.abs(still @ on.r[..., None])[..., 0],
        }
        for k in range(3):
            sizes[f"f{k}"] = _length(root_M @ on.f[k][..., None])[..., 0]
            sizes[f"psi{k}"] = _length(root @ on.psi[k][..., None])[..., 0]
        bilinear = {"T": (own.dT, L), "theta": (dtheta, L), "H": (own.dH, np.eye(len(kp)))}
        for name, (tensor, side) in bilinear.items():  # [k, i, j] of q̇ and of another vector
            along = np.einsum("nkij,nk->nij", tensor, on.r)
            sizes[f"d{name} of r"] = np.linalg.norm(along @ side, axis=-1)
            rows = np.moveaxis(tensor, 1, 2)  # [i, k, j]
            sizes[f"d{name}"] = _norm(
                root[:, None] @ rows @ (side[:, None] if side.ndim == 3 else side)
            )
        for name, rows in {"C": quadratic, "theta C": _first(theta, c)}.items():
            both = 0.5 * (rows + rows.mT)  # of (q̇, q̇)
            one = (both @ on.r[:, None, :, None])[..., 0]
            sizes[f"{name} of r r"] = np.abs((one @ on.r[..., None])[..., 0])
            sizes[f"{name} of r"] = 2.0 * np.linalg.norm(one @ root.mT, axis=-1)
            sizes[name] = _norm(root[:, None] @ both @ root.mT[:, None])
        return sizes

    def weighed(self, weights: Weights) -> dict[str, Array]:
        """Return the constants of a function in each sample; its `margin` is −μ."""
        at, n = self.samples, self.samples.M.shape[-1]
        Q, G = self._decrease(weights)
        P = law.potential_matrix(at.M, G, np.diag(weights.w))
        own = moves.path_rate(at.J, at.J_hat, self.line.d, self._weight, self._friction)[1]
        T = (np.eye(n) - own @ at.J) / self._weight
        still = T * (self.setting.B - self._friction)
        pulls = np.concatenate([-T @ at.M, own], -1), np.concatenate([still, 0.0 * own], -1)
        inner = np.diag(weights.w) - G.mT @ at.M @ G
        F = np.stack([self._form(weights, Q, G), super()._form(weights, Q, G)])
        root, L = self._of_samples.root, np.linalg.inv(self._of_samples.root)
        side = np.zeros((len(at), F.shape[-1], 2 * n))
        side[:, :n, :n], side[:, -n:, n:] = L, root.mT
        margin = np.full(len(at), np.inf)
        good = _are_positive(F).all(axis=0) & _are_positive(P)
        inside = side[good].mT @ np.linalg.solve(F[:, good], side[good])
        margin[good] = np.linalg.eigvalsh(inside)[..., -1].max(axis=0)
        inverse = np.linalg.inv(np.where(good[:, None, None], P, np.eye(P.shape[-1])))
        lambdas = np.linalg.eigvalsh(inner)[:, 0]
        with np.errstate(divide="ignore"):
            flat = np.where(good, 1.0 / np.sqrt(np.where(good, lambdas, 1.0)), np.inf)
        return {
            "margin": margin,  # 1/μ
            "flat": flat,  # |s| ≤ flat · Y
            "sigma": np.sqrt(self._kinetic(weights, G)),
            "delta": np.sqrt((weights.w * self.motion.delta**2).sum(axis=-1)),
            "eta": np.sqrt(((pulls[0] @ inverse) * pulls[0]).sum(axis=-1)),
            "held": np.sqrt(((pulls[1] @ inverse) * pulls[1]).sum(axis=-1)),
        }

    def along(self, weights: Weights, tube: Tube, most: dict[str, Any]) -> Along | None:
        """Return the bounds of V along the move, of the largest constants in a tube.

        None where F or P is not positive.
        """
        line, rho, saturation = self.line, self.decay[0], self.setting.saturation
        if not math.isfinite(most["margin"] + most["flat"]) or most["sigma"] >= 1.0:
            return None
        errors = np.linspace(0.0, tube.e, _LOOKED)[1:, None] * np.ones(len(weights.w))
        bent = float((errors / saturation.s(errors)).max())
        flattest = float(saturation.ds(errors).min())
        tilt = 1.0 / math.sqrt(1.0 - most["sigma"] ** 2)
        r, T = np.linspace(0.0, 1.0, _INSTANTS), line.duration
        dt = T / (_INSTANTS - 1)
        v = 16.0 * line.peak * r**2 * (1.0 - r) ** 2
        a = np.abs(32.0 * line.peak / T * r * (1.0 - r) * (1.0 - 2.0 * r))
        phi, psi = (
            v**2 * most[f"{k}0"] + a * most[f"{k}1"] + v * most[f"{k}2"] for k in ("f", "psi")
        )
        phi = phi + (1.0 + (1.0 - flattest) * most["sigma"] * tilt) * v * most["delta"]
        noise = weights.multiplier * self._gain / _EPSILON * psi**2  # (1 + 1/ε) Γ² of it

        def faded(rate: float, of: Array) -> Array:
            """∫ e^(−rate (t − t')) of a function, from above."""
            total, factor = np.zeros(len(of)), math.exp(-rate * dt)
            step = (1.0 - factor) / rate if rate else dt
            for k in range(1, len(of)):
                total[k] = factor * total[k - 1] + step * max(of[k - 1], of[k])
            return total

        def whole(of: Array) -> float:
            return float(np.trapezoid(of, dx=dt))

        Y = faded(rho, phi) + np.sqrt(2.0 * faded(2.0 * rho, noise))
        energy, left = (
            most["margin"] * float(faded(k, Y * phi + noise)[-1]) for k in (0.0, 2.0 * rho)
        )
        s, nu, root = most["flat"] * Y, float(Y.max()) * tilt, math.sqrt(energy)
        v_v, s_s = whole(v**2), whole(s**2) + s[-1] ** 2 / (2.0 * rho)
        fastest = nu + line.peak * most["r"]
        turned = math.exp(0.5 * self.hold.span * self.turning.damping * fastest)
        dropped = line.peak * most["gravity of r"] + nu * most["gravity of M"]
        return Along(
            dt * v, Y, s, bent, nu, energy, v_v, whole(v * s), whole(a), root * math.sqrt(v_v),
            root * math.sqrt(s_s), root * math.sqrt(T) + math.sqrt(left / (2.0 * rho)), turned,
            self.hold.span * turned * dropped,
        )  # fmt: skip

    def drift(self, on: Along, sizes: dict[str, Any]) -> Array:
        """Return the integral of all that drives a joint off its path, by constants (…, n_v)."""
        h, length = self.hold.span, self.line.length

        def by(name: str) -> Any:
            return np.asarray(sizes[name])[..., None]

        drift = on.bent * (sizes["dH of r"] * on.v_s + sizes["dH"] * on.s_n)
        for name, share in (("C", 1.0), ("theta C", 0.5 * h)):
            own = sizes[f"{name} of r r"] * on.v_v + sizes[f"{name} of r"] * on.v_n
            drift = drift + share * (own + sizes[name] * on.energy)
        for name, first, second in (("dT", 0.5 * h, h), ("dtheta", 0.0, 0.125 * h * h)):
            both, pulled = first + math.sqrt(2.0) * second, second * by("stiffness")
            along = both * on.v_n + pulled * on.v_s + second * on.dropped * length
            across = both * on.energy + pulled * on.s_n + second * on.dropped * on.n
            drift = drift + sizes[f"{name} of r"] * along + sizes[name] * across
        slid = sizes["rubbed of r"] * length + sizes["rubbed"] * on.n
        slid = slid + sizes["turned of r"] * on.v_v + sizes["turned"] * on.v_n
        drift = drift + 0.5 * h * (slid + sizes["still"] * on.a)
        lost = by("gravity of r") * length + by("gravity") * on.n
        drift = drift + (h * sizes["T"] + 0.25 * h * h * sizes["theta"]) * on.turned * lost
        # and η, by which h differs all along
        size = sizes["eta"] + 0.5 * h * math.exp(self.decay[0] * h) * sizes["held"]
        eta = size * (on.v @ on.Y) + (on.bent - 1.0) * sizes["H"] * (on.v @ on.s)
        eta = eta + sizes["momentum of r"] * on.v_v
        return np.asarray(drift + (sizes["dh"] @ eta[..., None])[..., 0])

    def bounds(self, weights: Weights, tube: Tube, weighed: dict[str, Any]) -> Tube | None:
        """Return the bounds by the formulas if the constants hold in a tube.

        They are the largest for the peak and for slower ones, as ∫n may be larger for these.
        `weighed` are the largest of `weighed`. None where F or P is not positive.
        """
        most, found = self.most | weighed, []
        for share in _PEAKS:
            line = self.line._replace(peak=share * self.line.peak)
            each = self.changed(line=line)._bounds_of_peak(weights, tube, most)
            if each is None:
                return None
            found.append(each)
        R, e, nu = zip(*found, strict=True)
        return Tube(np.max(R, axis=0), max(e), max(nu))

    def _bounds_of_peak(self, weights: Weights, tube: Tube, most: dict[str, Any]) -> Tube | None:
        on = self.along(weights, tube, most)
        if on is None:
            return None
        h, length = self.hold.span, self.line.length
        size = most["eta"] + 0.5 * h * math.exp(self.decay[0] * h) * most["held"]
        away = size * on.Y.max() + (on.bent - 1.0) * most["H"] * on.s.max()
        N = most["dh"].copy()
        between = _exponential(N * length / _PARTS)
        np.fill_diagonal(N, most["along"])
        grown, each = np.eye(len(N)), _exponential(N * length / _PARTS)
        reached = grown
        for _ in range(_PARTS):
            grown = each @ grown
            reached = np.maximum(reached, grown)
        away = away + most["momentum of r"] * self.line.peak
        away = away + reached @ between @ self.drift(on, most)
        return Tube(away, on.bent * float(on.s.max()), on.nu)


def damping_of(setting: Setting) -> Array:
    """Return the positive weight B of own paths; any where H does not depend on it."""
    return setting.B if (setting.B > 0.0).all() else np.ones_like(setting.B)


def largest_ratio(saturation: law.Saturation, errors: Array) -> float:
    """Return the largest S(e)/s(e)² of errors up to some, shape (m,): ½ where s(e) = e."""
    e = np.linspace(0.0, 1.0, _LOOKED)[1:, None] * errors
    return float((saturation.S(e) / saturation.s(e) ** 2).max())


def largest(sizes: dict[str, Array]) -> dict[str, Any]:
    """Return the largest of all samples."""
    return {name: each.max(axis=0) for name, each in sizes.items()}


def _length(x: Array) -> Array:
    return np.linalg.norm(x, axis=-2)


def _norm(A: Array) -> Array:
    square = A @ A.mT if A.shape[-2] <= A.shape[-1] else A.mT @ A
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(square)[..., -1], 0.0)))


def _are_positive(A: Array) -> NDArray[np.bool_]:
    """Return True for matrices of a stack that are positive definite, (…)."""
    try:
        np.linalg.cholesky(A)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(A)[..., 0] > 0.0)
    return np.ones(A.shape[:-2], dtype=bool)


def _exponential(A: Array) -> Array:
    """e^A of a small matrix."""
    total, term = np.eye(len(A)), np.eye(len(A))
    for k in range(1, _TERMS):
        term = term @ A / k
        total = total + term
    return total


def _first(A: Array, tensor: Array) -> Array:
    """Σ_j A_ij T_jkl of stacks."""
    shape = tensor.shape
    return np.asarray((A @ tensor.reshape(*shape[:-2], -1)).reshape(shape))
