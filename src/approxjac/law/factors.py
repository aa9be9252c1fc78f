"""`Factors`: a small symmetric matrix as LDLᵀ, without a branch, of numbers or symbols."""

from typing import Any

import numpy as np

from approxjac.law.branches import array
from approxjac.validation import Array


class Factors:
    """A = LDLᵀ of a symmetric positive definite A (n, n)."""

    def __init__(self, A: Array) -> None:
        n, self._kind = len(A), type(A)
        self._L: list[list[Any]] = [[0.0] * n for _ in range(n)]
        self._inverse: list[Any] = []  # of D
        self.pivots: list[Any] = []  # D
        scaled: list[list[Any]] = [[0.0] * n for _ in range(n)]  # LD
        for i in range(n):
            for j in range(i):
                total: Any = A[i, j]
                for k in range(j):
                    total = total - scaled[i][k] * self._L[j][k]
                scaled[i][j] = total
                self._L[i][j] = total * self._inverse[j]
            pivot: Any = A[i, i]
            for k in range(i):
                pivot = pivot - scaled[i][k] * self._L[i][k]
            self.pivots.append(pivot)
            self._inverse.append(1.0 / pivot)

    def solve(self, b: Array) -> Array:
        """Return A⁻¹b, b of shape (n,) or (n, k)."""
        if b.ndim == 2:
            return np.stack([self.solve(column) for column in b.T]).T
        n, z = len(b), b.tolist()
        for i in range(n):
            for k in range(i):
                z[i] = z[i] - self._L[i][k] * z[k]
        z = [each * inverse for each, inverse in zip(z, self._inverse, strict=True)]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                z[i] = z[i] - self._L[k][i] * z[k]
        solved: Array = array(z)
        if solved.dtype.hasobject or self._kind is np.ndarray:
            return solved
        return solved.astype(object).view(self._kind)  # constants among symbols
