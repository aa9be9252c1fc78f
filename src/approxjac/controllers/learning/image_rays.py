"""Rays of what a camera sees, through the lens that it is believed to have."""

from __future__ import annotations

import math

import numpy as np

from approxjac.cameras import PinholeCamera
from approxjac.interface import Measurement, Target
from approxjac.validation import Array

_DIFFERENCE = 1e-5  # of rays, either way, from which the lens's curvature is taken


class ImageRays:
    """Pixels as rays: center, distortion and focal length are those that are believed.

    Args:
        camera: The camera as it is believed.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._f, self._c = np.asarray(camera.focal_length), np.asarray(camera.center)
        self._camera = camera
        self._lens = None if camera._lens.is_straight else camera._lens

    def of_measurement(self, measurement: Measurement) -> Measurement:
        """Return a measurement with x from the camera's center, in focal lengths."""
        x = (measurement.x.reshape(-1, 2) - self._c) / self._f
        return measurement._replace(x=x.ravel())

    def at(self, w: Array) -> Array:
        """Return the rays (k, 2) that are seen at w (2k,), in focal lengths; NaN where none is."""
        w, lens = w.reshape(-1, 2), self._lens
        if lens is None:
            return w
        return np.array([lens.ray(each) if np.isfinite(each).all() else each for each in w])

    def of_target(self, target: Target) -> tuple[Array, Array, Array]:
        """Return the rays of a target, and their first and second derivatives, (k, 2) each.

        Of one that moves out of the image they are those at its edge.
        """
        x_d, v_d, a_d = target
        x_d = x_d.reshape(-1, 2)
        if self._lens is not None:
            x_d = np.array([self._camera.nearest(each) for each in x_d])
        y = self.at(((x_d - self._c) / self._f).ravel())
        nothing = np.zeros(y.shape)
        y_dot = nothing if v_d is None else v_d.reshape(-1, 2) / self._f
        y_ddot = nothing if a_d is None else a_d.reshape(-1, 2) / self._f
        if self._lens is None or v_d is None:
            return y, y_dot, y_ddot
        y_ddot = y_ddot.copy()
        for i, ray in enumerate(y):  # w = d(y), so Dy' = w' and Dy″ = w″ − D'y'
            D = self._slopes(ray)
            y_dot[i] = rate = np.linalg.solve(D, y_dot[i])
            h = _DIFFERENCE / max(math.hypot(*rate.tolist()), 1e-12)
            bent = self._slopes(ray + h * rate) - self._slopes(ray - h * rate)
            y_ddot[i] = np.linalg.solve(D, y_ddot[i] - bent.dot(rate) / (2.0 * h))
        return y, y_dot, y_ddot

    def _slopes(self, ray: Array) -> Array:
        assert self._lens is not None
        return np.array(self._lens.slopes(*ray.tolist())).reshape(2, 2)
