"""Cameras: how points in space become images, and what is known of a camera."""

from approxjac.cameras.calibration import tag_corners
from approxjac.cameras.camera import Camera, PinholeCamera, PlanarCamera

__all__ = ["Camera", "PinholeCamera", "PlanarCamera", "tag_corners"]
