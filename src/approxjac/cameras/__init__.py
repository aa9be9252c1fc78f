"""Cameras: how points in space become images, and what is known of a camera."""

from approxjac.cameras.camera import Camera, PinholeCamera, PlanarCamera, tag_corners

__all__ = ["Camera", "PinholeCamera", "PlanarCamera", "tag_corners"]
