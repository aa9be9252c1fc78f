"""Cameras: how points in space become images, and what is known of a camera."""

from approxjac.cameras.calibration import tag_corners
from approxjac.cameras.camera import Camera, PlanarCamera
from approxjac.cameras.pinhole import PinholeCamera

__all__ = ["Camera", "PinholeCamera", "PlanarCamera", "tag_corners"]
