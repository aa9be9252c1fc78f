"""Images of points: their rays, and the turn from one image to another.

Not in the paper. y = e^λ (X/Z, Y/Z) is the ray of a point c = (X, Y, Z) in the camera's axes, for a
focal length with the error factor e^λ. Shapes: c is (k, 3), y and ρ are (k, 2).
"""

import numpy as np

from approxjac.validation import Array


def ray_basis(rho: Array) -> Array:
    """Return N(ρ) = [I, −ρ], shape (k, 2, 3): N(ρ)c is the offset of c from the ray ρ."""
    N = np.zeros((len(rho), 2, 3))
    N[:, 0, 0] = N[:, 1, 1] = 1.0
    N[:, :, 2] = -rho
    return N


def rays(c: Array, stretch: float) -> Array:
    """Return y = e^λ (X/Z, Y/Z) with e^λ = stretch, shape (k, 2)."""
    return np.asarray(stretch * c[:, :2] / c[:, 2:])


def ray_jacobian(c: Array, stretch: float) -> Array:
    """Return ∂y/∂c = e^λ/Z N(X/Z, Y/Z), shape (k, 2, 3)."""
    Z = c[:, 2:]
    return np.asarray(ray_basis(c[:, :2] / Z) * (stretch / Z)[:, :, np.newaxis])


def image_turn(shown: Array, seen: Array, weights: Array) -> tuple[Array, Array]:
    """Return the rotation of the image that best fits `shown` to `seen`, and the residual.

    The planar Kabsch problem, in closed form: of rays about their means, with any size.

    Predicted rays `shown` are (…, k, 2), measured rays `seen` (k, 2), weights of the points (k,).
    Returned are the angle [rad], and the mean square residual with the best scale, shape (…).
    """
    w = weights / weights.sum()
    a, b = shown - (w @ shown)[..., np.newaxis, :], seen - w.dot(seen)
    along = (a * b).sum(axis=-1) @ w
    across = (a[..., 0] * b[:, 1] - a[..., 1] * b[:, 0]) @ w
    spread = np.maximum((a * a).sum(axis=-1) @ w, np.finfo(float).tiny)
    left = (b * b).sum(axis=-1) @ w - (along**2 + across**2) / spread
    return np.arctan2(across, along), np.asarray(left)
