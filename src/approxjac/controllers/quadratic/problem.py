"""A quadratic program, what can come of it, and what solves it."""

from __future__ import annotations

import enum
from typing import NamedTuple, Protocol

from approxjac.validation import Array


class QuadraticProgram(NamedTuple):
    """min ½ zᵀHz + fᵀz subject to lower ≤ z ≤ upper and row_lower ≤ A z ≤ row_upper.

    Attributes:
        H: Symmetric positive definite, shape (n, n).
        f: Shape (n,).
        lower: Lower bounds, shape (n,), −inf where there is none.
        upper: Upper bounds, shape (n,), inf where there is none.
        A: Rows, shape (k, n); k may be 0.
        row_lower: Lower bounds of the rows, shape (k,), −inf where there is none.
        row_upper: Upper bounds of the rows, shape (k,), inf where there is none.
    """

    H: Array
    f: Array
    lower: Array
    upper: Array
    A: Array
    row_lower: Array
    row_upper: Array


class Verdict(enum.Enum):
    """What came of a problem."""

    SOLVED = "solved"
    INFEASIBLE = "no z holds all bounds and rows"
    FAILED = "the problem is malformed or the solver found no valid answer in time"


class Solver(Protocol):
    """Solves quadratic programs; holds scratch memory, so one instance a thread."""

    name: str

    def solve(self, problem: QuadraticProgram) -> tuple[Array | None, Verdict]:
        """Return z, shape (n,), and SOLVED, or None and why not. Never raises.

        z holds the bounds exactly, and each row to 1e-6 of the size of its terms |A||z|, at
        least 1e-6. It does not depend on what was solved before.
        """
        ...
