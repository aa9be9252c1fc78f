"""Cameras: how points in space become images."""

from approxjac.cameras.camera import Camera, PinholeCamera, PlanarCamera, tag_corners

__all__ = ["Camera", "PinholeCamera", "PlanarCamera", "tag_corners"]
