"""Learning of what a measured position is linear in, with forgetting towards the prior."""

from __future__ import annotations

import numpy as np

from approxjac.validation import Array


def forgotten_information(Lambda: Array, Lambda_0: Array, share: float) -> Array:
    """Λ ← (1 − λT)Λ + λTΛ₀: forget a share λT of what was learnt, and never the prior Λ₀.

    Implements Theorem A's forgetting, in samples. Λ and Λ₀ are (P, P); Λ ≥ Λ₀ stays so.
    """
    return np.asanyarray(Lambda + share * (Lambda_0 - Lambda))


def information(Lambda: Array, H: Array, weight: float) -> Array:
    """Λ ← Λ + HᵀR⁻¹H with R⁻¹ = weight I, the information of a frame x = HΘ; shape (P, P).

    Implements Theorem A's update of the information, in samples. H is (m, P).
    """
    return np.asanyarray(Lambda + weight * H.T.dot(H))


def correction(Lambda: Array, H: Array, weight: float, innovation: Array) -> Array:
    """ΔΘ̂ = Λ⁻¹HᵀR⁻¹ε with ε = x − HΘ̂ (m,) and Λ that has the frame already; shape (P,).

    Implements Theorem A's gain, in samples. H is (m, P), R⁻¹ = weight I.
    """
    return np.asanyarray(np.linalg.solve(Lambda, weight * innovation.dot(H)))


def V1(Lambda: Array, Delta: Array) -> float:
    """V₁ = ½ΔᵀΛΔ of the error Δ = Θ − Θ̂ (P,) of what is learnt.

    Implements V₁ of Theorem A.
    """
    return 0.5 * float(Delta.dot(Lambda).dot(Delta))


def V1_fall(Lambda: Array, H: Array, weight: float, innovation: Array) -> float:
    """½εᵀ(R + HΛ⁻¹Hᵀ)⁻¹ε: how much V₁ falls with a frame, exactly, where x = HΘ.

    Implements the fall of V₁ in samples. Λ is (P, P), forgotten but without the frame.
    """
    S = np.eye(len(H)) / weight + H.dot(np.linalg.solve(Lambda, H.T))
    return 0.5 * float(innovation.dot(np.linalg.solve(S, innovation)))
