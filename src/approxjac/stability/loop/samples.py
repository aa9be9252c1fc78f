"""`Samples` that the conditions are evaluated on: true robots, configurations and targets."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from approxjac.validation import Array

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """All that the conditions need of N combinations of true robot, configuration and target."""

    truth: Indices  # of the true robot, shape (N,)
    q: Array  # configuration, shape (N, nq)
    x_d: Array  # target, shape (N, n_x)
    M: Array  # inertia matrix of the true robot, shape (N, n_v, n_v)
    dM: Array  # ∂M/∂q_k, shape (N, n_v, n_v, n_v), k first
    J: Array  # true task Jacobian, shape (N, m, n_v)
    J_e: Array  # true ∂e/∂q, which is J where e = x − x_d, shape (N, m, n_v)
    J_hat: Array  # Ĵ, shape (N, m, n_v)
    dJ_hat: Array  # ∂Ĵ/∂q_k, shape (N, n_v, m, n_v), k first
    e: Array  # shape (N, m)
    s: Array  # s(e), shape (N, m)
    slope: Array  # s'(e), shape (N, m)

    def __repr__(self) -> str:
        return f"Samples({len(self)} of {len(set(self.truth.tolist()))} true robots)"

    def __len__(self) -> int:
        return len(self.q)

    def take(self, which: Indices | slice) -> Samples:
        """Return the samples of some indices."""
        return Samples(*(getattr(self, f.name)[which] for f in fields(self)))

    def join(self, *others: Samples) -> Samples:
        """Return these samples and others after them."""
        if not others:
            return self
        each = (self, *others)
        return Samples(*(np.concatenate([getattr(s, f.name) for s in each]) for f in fields(self)))
