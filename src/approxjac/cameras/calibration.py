"""Where cameras and tags are: rotations, poses and views."""

from __future__ import annotations

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.validation import Array, as_array, as_number

_AXES = "the camera's axes (right, down, forward)"
_ORTHONORMAL = 1e-6  # how far from it a rotation may be, to be made so


def as_rotation(value: object, name: str = "rotation", axes: str = _AXES) -> Array:
    """Return axes as the columns of a matrix (3, 3), if they are orthonormal."""
    R = as_array(name, value, (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise InvalidInputError(
            f"{name} must have {axes} as orthonormal columns of a right-handed frame, got "
            f"{R.tolist()}",
            given=value,
        )
    U, _, V = np.linalg.svd(R)  # the nearest one, so that products of many stay rotations
    return np.asarray(U @ V)


def as_pose(name: str, value: object) -> tuple[Array, Array]:
    """Return rotation (3, 3) and position (3,) of a homogeneous matrix (4, 4) [m]."""
    pose = as_array(name, value, (4, 4), "m")
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > _ORTHONORMAL:
        raise InvalidInputError(
            f"{name} must have the last row (0, 0, 0, 1), got {pose[3].tolist()}", given=value
        )
    return as_rotation(pose[:3, :3], name, "axes"), np.array(pose[:3, 3])


def tag_corners(size: float, tag_pose: object = None) -> Array:
    """Return the corners of a square tag, as points of an `ImageTask`, shape (4, 3) [m].

    In the order of `cv2.aruco`: upper left, upper right, lower right, lower left of the upright
    tag. (pupil-apriltags begins at the lower left and goes the other way round: take
    `corners[::-1]`.) `CombinedTask.balanced` makes six coordinates of the eight.

    Args:
        size: Length of its black square's side, > 0 [m].
        tag_pose: From the tag to the frame that it is fixed to, shape (4, 4) [m]; the tag's x axis
            points right, y up, and z out of it. By default it is in that frame's origin and axes.

    Raises:
        InvalidInputError: A size that is not positive, or a pose that is none.
    """
    half = 0.5 * as_number("size", size, unit="m", above=0.0)
    corners = half * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    if tag_pose is None:
        return corners
    R, p = as_pose("tag_pose", tag_pose)
    return np.asarray(corners @ R.T + p)
