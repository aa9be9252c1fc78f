"""Corners of a square tag, such as an ArUco marker or an AprilTag."""

from __future__ import annotations

import numpy as np

from approxjac.cameras.calibration import as_pose
from approxjac.validation import Array, as_number


def tag_corners(size: float, tag_pose: object = None) -> Array:
    """Return the corners of a square tag, as points of an `ImageTask`, shape (4, 3) [m].

    In the order in which `cv2.aruco` detects them: upper left, upper right, lower right, lower left
    of the upright tag. (pupil-apriltags begins at the lower left and goes the other way round:
    take `corners[::-1]`.) Their images are the x of the task, `corners.ravel()`, eight numbers:
    `CombinedTask.balanced` makes the six of them that a controller takes::

        points = aj.cameras.tag_corners(0.08, tag_pose)
        image = aj.ImageTask(belief, camera, points=points)
        law = aj.SetpointController(aj.tasks.CombinedTask.balanced(image, x_d))

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
