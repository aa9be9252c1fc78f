"""Test 2: the matrix form with free potential, a linear matrix inequality over many samples.

Solved by cutting planes: with a dozen unknowns and thousands of small matrices, an eigenvalue
decomposition of all of them and a linear program of the few directions that matter (HiGHS, through
SciPy) take less than a conic solver takes to read the problem. What is found is the best to within
`_PRECISION`; round-off alone may lead to another one within it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Self

import numpy as np

from approxjac import law
from approxjac.extras import package_of
from approxjac.stability.certificates.families import (
    BOX,
    Family,
    FamilyNumbers,
    Setting,
    Weights,
    family_numbers,
)
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.validation import Array

_ACTIVE = 60  # samples to begin with
_MORE = 40  # and how many of the worst are added at a time
_FIRST = 5  # looked at first: one of so many samples
_CUTS = 10  # a round, from the samples that violate most
_KEPT = 150  # of all rounds, those that bind or come nearest to it
_ROUNDS = 150
_STEP = 0.4
_PRECISION = 5e-3  # of the margin
_SIGN = 1e-5  # and while it is negative, as weights of other sizes may still make it positive


class Best(NamedTuple):
    """The Lyapunov function of a family with the largest least margin."""

    weights: Weights
    margins: Array  # in every sample, shape (N,)
    active: Indices  # of the samples that decided it
    unknowns: Array  # the scaled ones of `weights`, to start from again
    cuts: Array  # that are known, see `_cutting_planes`


class MatrixForm:
    """Matrices that have to be positive for V to be a Lyapunov function, at many samples.

    Attributes:
        fills: Whether `metric` differs from Y.
    """

    fills = False

    def __init__(self, samples: Samples, setting: Setting) -> None:
        self.samples, self.setting = samples, setting
        J_hat, dJ_hat, kv = samples.J_hat, samples.dJ_hat, setting.kv
        D = law.dissipation(J_hat, kv, setting.B)
        pinv = law.cross_weight_pinv(J_hat, dJ_hat, setting.weight)
        damped = law.cross_weight_damped(D, J_hat, dJ_hat, kv)
        self._of_samples = _OfSamples(D, np.linalg.inv(np.linalg.cholesky(D)), *pinv, *damped)

    def take(self, which: Indices | slice) -> Self:
        """Return the matrices of some of the samples."""
        return self._with(self.samples.take(which), lambda values: values[which])

    def join(self, other: MatrixForm) -> Self:
        """Return the matrices of these samples and of others after them."""
        each = iter(other._of_samples)
        joined = self.samples.join(other.samples)
        return self._with(joined, lambda values: np.concatenate([values, next(each)]))

    def _with(self, samples: Samples, changed: Callable[[Array], Array]) -> Self:
        other = copy.copy(self)
        other.samples = samples
        other._of_samples = _OfSamples(*map(changed, self._of_samples))
        return other

    def pencils(self, weights: Weights) -> tuple[Array, Array]:
        """Return X and Y with the margin as the largest μ for which X − μY ≥ 0.

        X holds Q of V̇ = −zᵀQz and P of V ≥ ½zᵀPz, one after the other, Y the same without their
        cross blocks and inertia; both of shape (2, N, n_v + m, n_v + m) and affine in the weights.
        """
        D, M = self._of_samples.D, self.samples.M
        Q, G = self._decrease(weights)
        P = law.potential_matrix(M, G, weights.block(self.setting.c_bar))
        X = np.stack([Q, P])
        Y = np.zeros_like(X)
        n = D.shape[-1]
        Y[0, :, :n, :n] = D
        Y[1, :, :n, :n] = M
        Y[:, :, n:, n:] = X[:, :, n:, n:]
        if self.setting.large_gains:  # V is all potential
            X[1] = Y[1]
        return X, Y

    def unknowns(self, family: Family) -> FamilyNumbers:
        """Return what is sought in a family."""
        return family_numbers(family, self.setting)

    def metric(self, Y: Array) -> Array:
        """Return what eigenvectors are sought in: Y, filled up where it is zero."""
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
        if self.setting.large_gains:  # V is all potential
            return np.asarray(np.minimum(margins, 1.0))
        # of P the margin is 1 less the largest singular value of the whitened cross block
        return np.asarray(np.minimum(margins, 1.0 - np.sqrt(self._kinetic(weights, G))))

    def _is_bounded(self, weights: Weights) -> bool:
        """Return whether V at rest is positive: 2c̄W + Ω is."""
        return bool(np.linalg.eigvalsh(weights.block(self.setting.c_bar))[0] > 0.0)

    def _kinetic(self, weights: Weights, G: Array) -> Array:
        """σ² of each sample, shape (N,): V ≥ ½(1 − σ²)|q̇|²_M, of V that `_is_bounded`."""
        root = np.linalg.inv(np.linalg.cholesky(weights.block(self.setting.c_bar)))
        square = root @ (G.mT @ self.samples.M @ G) @ root.T
        return np.asarray(np.maximum(np.linalg.eigvalsh(square)[:, -1], 0.0))

    def violations(self, weights: Weights) -> int:
        """Return in how many samples the margin is not positive."""
        with suppress(np.linalg.LinAlgError):  # faster than eigenvalues where there are none
            block = weights.block(self.setting.c_bar)
            np.linalg.cholesky(block)
            Q, G = self._decrease(weights)
            np.linalg.cholesky(Q)
            if not self.setting.large_gains:
                np.linalg.cholesky(law.potential_matrix(self.samples.M, G, block))
            return 0
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
        N = np.zeros_like(at.M)
        if not setting.large_gains:
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


def best_weights(form: MatrixForm, family: Family, known: Best | None = None) -> Best:
    """Choose the Lyapunov function of a family whose least margin is largest.

    The worst samples are gathered until no other one is worse. `known` is what was found without
    the last ones of the samples, to go on from.
    """
    return best_of(form, form.unknowns(family), known)


def best_of(form: MatrixForm, unknowns: FamilyNumbers, known: Best | None = None) -> Best:
    """Choose the unknowns whose least margin is largest, as `best_weights`."""
    N = len(form.samples)
    y, cuts = unknowns.start, np.empty((2, 0, 1 + len(unknowns.start)))
    active = np.unique(np.linspace(0, N - 1, _ACTIVE).astype(int))
    if known is not None:
        active = np.union1d(known.active, np.arange(len(known.margins), N))
        y, cuts = known.unknowns, known.cuts
    if not unknowns.basis:
        weights = unknowns.fixed
        return Best(weights, form.margins(weights), active, y, cuts)
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


def on_more(form: MatrixForm, family: Family, known: Best) -> Best:
    """Return the best of a family on more samples: another one only where a new one is worse."""
    before = len(known.margins)
    if before == len(form.samples):
        return known
    more = form.take(slice(before, None)).margins(known.weights)
    least = known.margins.min()
    if more.min() < least - _PRECISION or more.min() <= 0.0 < least:
        return best_weights(form, family, known)
    return known._replace(margins=np.append(known.margins, more))


class _Look(NamedTuple):
    """Whitened matrices X of some unknowns, shape (2, N, n_v + m, n_v + m)."""

    margin: float  # the least; −∞ where Y is not positive
    metric: Array  # L⁻¹ of Y = LLᵀ, or that of other unknowns where Y is not positive
    whitened: Array  # L⁻¹XL⁻ᵀ, or L⁻¹(X − μY)L⁻ᵀ there
    values: Array  # its least eigenvalues, shape (2, N)


def _cutting_planes(
    form: MatrixForm, unknowns: FamilyNumbers, start: Array, cuts: Array
) -> tuple[Array, float, Array]:
    """Maximise the least margin: μ is raised to that of the best point until no point beats it.

    X − μY is affine in the unknowns; its eigenvectors v bound its least eigenvalue by vᵀ(X − μY)v.
    These bounds, the cuts, hold of the same samples among others, too.

    Args:
        form: Of the samples.
        unknowns: The unknowns.
        start: Those to begin with, shape (d,).
        cuts: vᵀXv and vᵀYv that are known, as affine functions, shape (2, c, 1 + d).

    Returns:
        The best unknowns, their least margin, and the cuts that matter near them.
    """
    linprog = package_of("study", "scipy.optimize").linprog
    d = len(start)
    X0, Y0 = form.pencils(unknowns.fixed)
    parts = [form.pencils(unknowns.fixed.plus(1.0, part)) for part in unknowns.basis]
    X1, Y1 = np.stack([X - X0 for X, _ in parts]), np.stack([Y - Y0 for _, Y in parts])

    def look(y: Array, mu: float = 0.0, metric: Array | None = None) -> _Look | None:
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
        if form.fills:  # Y does not tell the margin
            return _Look(float(form.margins(weights).min()), metric, whitened, values)
        return _Look(float(values.min()) if is_positive else -np.inf, metric, whitened, values)

    best, here = start, look(start)
    if here is None:  # found where some of these samples were not known yet
        best, here = unknowns.start, look(unknowns.start)
    assert here is not None
    best_margin, mu = here.margin, max(here.margin, -1.0)
    for _ in range(_ROUNDS):
        worst = np.argsort(here.values, axis=None)[:_CUTS]
        which = np.unravel_index(worst, here.values.shape)
        vectors = here.metric.mT[which] @ np.linalg.eigh(here.whitened[which])[1][..., :2]
        for v in np.moveaxis(vectors, -1, 0):
            more = np.stack([_along(v, X0, X1, which), _along(v, Y0, Y1, which)])
            cuts = np.concatenate([cuts, more], axis=1)
        bound = cuts[0] - mu * cuts[1]
        answer = linprog(
            np.append(np.zeros(d), -1.0),
            A_ub=np.column_stack([-bound[:, 1:], cuts[1] @ np.append(1.0, best)]),
            b_ub=bound[:, 0],
            bounds=[*((least, BOX) for least in unknowns.least), (None, 10.0)],
            method="highs-ds",
            options={"presolve": False},
        )
        if answer.status != 0 or answer.x[-1] < (_PRECISION if best_margin > 0.0 else _SIGN):
            break
        cuts = cuts[:, np.sort(np.argsort(answer.slack)[:_KEPT])]
        # part of the way only, as the bounds far from the best point are still poor
        y = best + _STEP * (answer.x[:-1] - best)
        here = look(y, mu, here.metric)
        assert here is not None
        if here.margin > best_margin:
            best, best_margin, mu = y, here.margin, max(mu, here.margin)
    return best, best_margin, cuts


def _along(v: Array, A0: Array, A1: Array, which: tuple[Indices, ...]) -> Array:
    """Return the affine functions vᵀA(y)v, constants first; shape (number of v, 1 + d)."""
    constant: Array = np.einsum("ci,cij,cj->c", v, A0[which], v)
    slopes: Array = np.einsum("ci,kcij,cj->ck", v, A1[:, which[0], which[1]], v)
    return np.column_stack([constant, slopes])
