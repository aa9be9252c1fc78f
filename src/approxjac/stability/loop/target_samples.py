"""`Targets` of a closed loop: the loop linearised at many of them, and its eigenvalues."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from approxjac.controllers.gains.gains import Diagonals
from approxjac.stability.loop.linearization import (
    LinearLoop,
    Timing,
    continuous_matrix,
    equilibria,
    sampled_matrix,
)
from approxjac.stability.loop.samples import Indices
from approxjac.validation import Array

_SINGULAR = 1e-10  # relative smallest singular value that counts as zero
_ZERO = 1e-11  # size of an eigenvalue relative to the largest that counts as zero


class Targets:
    """Targets that a closed loop is linearised at. What no gains change is worked out once.

    Gravity is taken as exact, or learnt.

    Args:
        loop: The parts at N targets.
        gravity: Its acceleration [m/s²].
        timing: Of the loop as it is sampled; None is the continuous loop.
    """

    def __init__(self, loop: LinearLoop, gravity: float, timing: Timing | None = None) -> None:
        self.loop, self.timing = loop, timing
        across = loop.J @ np.linalg.solve(loop.M, loop.J_hat.mT)
        sizes = np.linalg.svd(across, compute_uv=False)
        self._singular = sizes[:, -1] <= _SINGULAR * sizes[:, 0]
        columns, values, rows = np.linalg.svd(loop.Z)
        # the columns of first moments are g times a sine: where all are 1e-16, none counts
        ranks = (values > _SINGULAR * values.max(axis=-1, initial=gravity)[:, None]).sum(axis=-1)
        self.unseen = loop.Z.shape[-1] - ranks
        self._groups: list[_Group] = []
        for rank in np.unique(ranks):  # those of different ranks have spaces of different sizes
            which = np.flatnonzero(ranks == rank)
            still = equilibria(loop.take(which), rows[which, rank:].mT, timing)
            N, size, count = still.shape
            within = np.broadcast_to(np.eye(size), (N, size, size))
            if timing is not None:  # no learnt torques but those that joints feel
                n = loop.M.shape[-1]
                learnt = np.zeros((N, size, rank))
                learnt[:, 2 * n : 3 * n] = columns[which][..., :rank]
                within = np.concatenate(
                    [within[..., : 2 * n], learnt, within[..., 3 * n :]], axis=2
                )
            basis = within @ np.linalg.qr(within.mT @ still, mode="complete")[0]
            self._groups.append(_Group(which, basis[..., :count], basis[..., count:]))

    @property
    def dead_time(self) -> float:
        """Time until the sampled loop has answered a motion [s]; 0 for the continuous loop."""
        return 0.0 if self.timing is None else self.timing.dead_time

    def eigenvalues(self, gains: Diagonals) -> tuple[NDArray[np.complex128], NDArray[np.bool_]]:
        """Return the λ with some gains, and which targets are singular, shape (N,).

        The λ have shape (N, k) [1/s], with NaN where a target has fewer of them than others.
        """
        loop, timing = self.loop._replace(**gains._asdict()), self.timing
        found, singular = [], self._singular.copy()
        for which, along, across in self._groups:
            own = loop.take(which)
            A = continuous_matrix(own) if timing is None else sampled_matrix(own, timing)
            at_rest = 0.0 if timing is None else 1.0
            residual = np.abs(A @ along - at_rest * along).max(axis=(1, 2), initial=0.0)
            singular[which] |= residual > 1e-9 * np.abs(A).max(axis=(1, 2))
            found.append(np.linalg.eigvals(across.mT @ A @ across).astype(np.complex128))
        values = np.full((len(singular), max(each.shape[1] for each in found)), np.nan, complex)
        for (which, _, _), each in zip(self._groups, found, strict=True):
            values[which, : each.shape[1]] = each
        if timing is not None:  # λ = ln(μ)/t; −∞ for a mode that is over after one frame
            sizes, angles = np.abs(values), np.angle(values)
            with np.errstate(divide="ignore"):
                values.real, values.imag = np.log(sizes) / timing.frame, angles / timing.frame
        sizes, finite = np.abs(values), np.isfinite(values)
        smallest = np.min(sizes, axis=1, initial=np.inf, where=finite)
        singular |= smallest <= _ZERO * np.max(sizes, axis=1, initial=0.0, where=finite)
        return values, singular

    def spectral_radii(self, gains: Diagonals) -> Array:
        """Return by what errors are multiplied from frame to frame at most, shape (N,).

        Below 1 where the sampled loop is stable; 1 where a target is singular, and decides nothing.
        """
        values, singular = self.eigenvalues(gains)
        frame = 1.0 if self.timing is None else self.timing.frame
        radii = np.exp(frame * np.nanmax(values.real, axis=1))
        return np.asarray(np.where(singular, np.maximum(radii, 1.0), radii))

    def rates(self, gains: Diagonals) -> tuple[Array, Array]:
        """Return decay rates and damping ratios with some gains, as of `LocalTest`."""
        values, singular = self.eigenvalues(gains)
        decay = np.where(singular, 0.0, -np.nanmax(values.real, axis=1))
        sizes = np.abs(values)
        lasting = (values.real * self.dead_time > -math.log(10.0)) & (sizes != 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = -values.real / sizes
        return decay, np.min(ratios, axis=1, initial=1.0, where=lasting)


class _Group(NamedTuple):
    """Targets whose equilibria have the same dimension."""

    which: Indices
    along: Array  # orthonormal basis of the equilibria
    across: Array  # and of what is orthogonal to them
