"""`Feature`: a part of what a task follows, to draw it."""

from __future__ import annotations

from typing import NamedTuple

from approxjac.tasks.camera import Camera
from approxjac.validation import Array


class Feature(NamedTuple):
    """The origin of a frame that an elementary task follows, or points that a camera sees.

    Attributes:
        entries: Where its values are in x.
        frame: Frame that is followed, or that the points are fixed to; None is the world.
        axes: World axes of the position that x gives, such as "xyz"; none of an image.
        camera: What sees it, if anything does.
        points: Points of the frame, shape (k, 3) [m].
    """

    entries: slice
    frame: str | None
    axes: str
    camera: Camera | None
    points: Array
