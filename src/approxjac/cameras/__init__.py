"""Cameras: how points in space become images."""

from approxjac.cameras.camera import Camera as Camera
from approxjac.cameras.camera import PinholeCamera as PinholeCamera
from approxjac.cameras.camera import PlanarCamera as PlanarCamera
from approxjac.cameras.camera import tag_corners as tag_corners
