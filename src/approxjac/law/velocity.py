"""Image-based visual servoing at velocity level, to compare the paper's laws with."""

from __future__ import annotations

import numpy as np

from approxjac.law.products import dot
from approxjac.law.pseudoinverse import damped_gram_solve
from approxjac.validation import Array


def velocity_reference(
    J_hat: Array, s: Array, rate: float, scale: float = 0.0
) -> tuple[Array, float]:
    """q̇_ref = −λ Ĵ⁺s(e), with which e would decay like exp(−λt) if Ĵ were right.

    No equation of the paper: the law of image-based visual servoing after F. Chaumette and
    S. Hutchinson, "Visual servo control, Part I: Basic approaches", IEEE Robotics & Automation
    Magazine 13(4), 2006, with the image Jacobian taken on to the joints; for positions and poses
    it is D. E. Whitney's resolved motion rate control (1969). Of all q̇ with Ĵq̇ = −λs it is the
    shortest. Departure: Ĵ⁺ is damped near singular poses, see `damped_gram_solve`.

    Args:
        J_hat: Estimated task Jacobian Ĵ, shape (m, n_v), m ≤ n_v.
        s: Saturated error s(e), shape (m,).
        rate: λ [1/s].
        scale: A σ_max below which it counts as this large [unit of Ĵ].

    Returns:
        q̇_ref, shape (n_v,), and the damping of Ĵ⁺ (0 where it is exact).
    """
    w, damping = damped_gram_solve(dot(J_hat, J_hat.T), s, scale=scale)
    reference: Array = -rate * dot(w, J_hat)
    return reference, damping


def within_speeds(reference: Array, fastest: Array) -> Array:
    """c q̇_ref with the largest c ≤ 1 for which no joint is faster than it may be.

    It is scaled as a whole, so that the task goes the same way more slowly.

    Args:
        reference: q̇_ref, shape (n_v,).
        fastest: Speed limits > 0, infinite where there is none, shape (n_v,).

    Returns:
        Shape (n_v,).
    """
    share = np.abs(reference / fastest).max()
    return reference / share if share > 1.0 else reference
