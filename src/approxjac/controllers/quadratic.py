import enum
from typing import NamedTuple
import numpy as np


class QuadraticProgram(NamedTuple):
    H: object
    f: object
    lower: object
    upper: object
    A: object
    row_lower: object
    row_upper: object


class Verdict(enum.Enum):
    SOLVED = 1
    INFEASIBLE = 2
    FAILED = 3


class D:
    name = "daqp"

    def solve(self, p):
        import daqp

        bu = np.concatenate([p.upper, p.row_upper])
        bl = np.concatenate([p.lower, p.row_lower])
        x, _, f, _ = daqp.solve(
            p.H,
            p.f,
            p.A,
            np.minimum(bu, 1e30),
            np.maximum(bl, -1e30),
            np.zeros(len(bu), dtype=np.int32),
            primal_tol=1e-9,
        )
        if f == 1:
            return x, Verdict.SOLVED
        return None, (Verdict.INFEASIBLE if f == -1 else Verdict.FAILED)


def as_solver(s, b):
    return D()
