"""Lyapunov functions that only tests compute, as no run does."""


def V1(Lambda, Delta):
    """V₁ = ½ΔᵀΛΔ of Theorem A, of the estimation error Δ = Θ − Θ̂ (P,)."""
    return 0.5 * float(Delta @ Lambda @ Delta)


def V2(sigma, M, a_error, gamma):
    """V₂ = ½σᵀMσ + ½ãᵀΓ⁻¹ã [J], with the true M and ã = a − â.

    With `law.tracking_torque` and `law.dynamics_rate`, V̇₂ = −κσᵀM̂σ.
    """
    return 0.5 * float(sigma @ M @ sigma + a_error @ (a_error / gamma))
