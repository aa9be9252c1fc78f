"""`Posture`: a preferred posture of a redundant arm, in the null space of its task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from approxjac.formatting import short_fields
from approxjac.validation import Array, as_array, as_diagonal, is_scalar, shape_of


@dataclass(frozen=True, eq=False, repr=False)
class Posture:
    """The torque N τ₀ with τ₀ = −k (q ⊖ q_posture) and N = I − Ĵ⁺Ĵ.

    N leaves of τ₀ what Ĵᵀ cannot produce; near a singular Ĵ it is faded out, to 0 at the singular
    posture. At rest −Ĵᵀ K_p s(e) + N τ₀ = 0 splits into its two parts, which are orthogonal, so
    e = 0 stays the only equilibrium of the task however wrong Ĵ is, as long as it has full row
    rank. The proof pays: V̇ = −W + q̇ᵀN τ₀ (the part along αĴ⁺s(e) vanishes), so V may rise while
    the arm moves towards the posture. The self-motion is damped by B_c only.

    Attributes:
        q: Posture, shape (nq,) [rad or m].
        stiffness: k > 0, a number or shape (n_v,) [N m/rad or N/m].

    Raises:
        InvalidInputError: Not finite, or a stiffness that is not positive.
    """

    q: Sequence[float] | Array
    stiffness: float | Sequence[float] | Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", as_array("q of the posture", self.q, shape_of(self.q), "rad"))
        size = math.prod(shape_of(self.stiffness))
        diagonal = as_diagonal("stiffness", self.stiffness, size, unit="N m/rad")
        scalar = is_scalar(self.stiffness)
        object.__setattr__(self, "stiffness", float(diagonal[0]) if scalar else diagonal)

    def __repr__(self) -> str:
        return short_fields(self)
