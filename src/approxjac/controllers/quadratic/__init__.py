"""Small dense quadratic programs, solved once a control step.

Whatever the solver, a problem is checked before and the answer after, so that what comes out
holds the bounds or is no answer at all.
"""

from approxjac.controllers.quadratic.choice import as_solver
from approxjac.controllers.quadratic.problem import QuadraticProgram, Solver, Verdict

__all__ = ["QuadraticProgram", "Solver", "Verdict", "as_solver"]
