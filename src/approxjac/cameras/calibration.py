"""Calibrations of OpenCV and ROS, the files that they keep them in, and tags."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.files import read_text, reason
from approxjac.validation import Array, as_array, as_number

_LONGEST = 500_000  # file [bytes]
_MODELS = {  # of ROS: is it a fisheye lens?
    "plumb_bob": False, "rational_polynomial": False, "equidistant": True, "fisheye": True,
}  # fmt: skip
_FILES = "as a calibration of OpenCV's or a camera_info of ROS's has"
_NO_SIZE = "or the size be given, size=(width, height) [px]"


def opencv_parameters(
    K: Any, distortion: Any, rvec: Any, tvec: Any, camera_pose: Any
) -> dict[str, Any]:
    """Return arguments of a `PinholeCamera` from those of `PinholeCamera.from_opencv`."""
    k = as_array("K", K, (3, 3), "px")
    if np.abs(k - [[k[0, 0], 0.0, k[0, 2]], [0.0, k[1, 1], k[1, 2]], [0.0, 0.0, 1.0]]).any():
        raise InvalidInputError(
            f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}", given=K
        )
    coefficients = () if distortion is None else np.ravel(distortion)
    if len(coefficients) == 3:  # of which a camera of this library would take the last for k₃
        raise InvalidInputError(
            "distortion must be OpenCV's 4, 5, 8, 12 or 14 coefficients, or none, got 3: "
            f"{list(coefficients)}",
            given=distortion,
        )
    place: dict[str, Any] = {"focal_length": (k[0, 0], k[1, 1]), "center": (k[0, 2], k[1, 2])}
    place["distortion"] = coefficients
    places = {"rvec": rvec, "tvec": tvec, "camera_pose": camera_pose}
    given = [name for name, each in places.items() if each is not None]
    if given == ["rvec", "tvec"]:
        R = pin.exp3(np.array(as_array("rvec", np.ravel(rvec), (3,), "rad")))
        t = as_array("tvec", np.ravel(tvec), (3,), "m")
        place.update(position=-R.T @ t, rotation=R.T)
    elif given == ["camera_pose"]:
        R, position = as_pose("camera_pose", camera_pose)
        place.update(position=position, rotation=R)
    elif given:
        raise InvalidInputError(
            f"where a camera stands must be given by rvec and tvec, or by camera_pose, got "
            f"{' and '.join(given)}",
            given=given,
        )
    return place


def read_calibration(
    path: str | Path, size: Sequence[int] | None, fisheye: bool | None
) -> dict[str, Any]:
    """Return arguments of `PinholeCamera.from_opencv` of a file; ours fill in what it lacks."""
    content = {str(name).lower(): value for name, value in _read(Path(path)).items()}

    def numbers(*names: str, count: int | None = None, otherwise: str = _FILES) -> Array:
        """Return the numbers that a file has under one of these names."""
        name = next((each for each in names if each in content), None)
        if name is None:
            raise InvalidInputError(
                f"{path} must have {' or '.join(names)}, {otherwise}, got "
                f"{', '.join(list(content)[:20]) or 'nothing'}",
                given=path,
            )
        value: Any = content[name]
        data: Any = value.get("data") if isinstance(value, dict) else value
        rows: list[Any] = data if isinstance(data, list) else [data]
        try:
            each = [float(x) for row in rows for x in (row if isinstance(row, list) else [row])]
        except (TypeError, ValueError):
            each = [math.nan]
        if not all(map(math.isfinite, each)) or count not in (None, len(each)):
            wanted = "finite numbers" if count is None else f"finite numbers, {count} of them"
            raise InvalidInputError(f"{name} of {path} must be {wanted}", given=path)
        return np.array(each)

    says = None
    if "distortion_model" in content:
        model = str(content["distortion_model"]).lower()
        if model not in _MODELS:
            raise InvalidInputError(
                f"distortion_model of {path} must be one of {', '.join(_MODELS)}, got "
                f"{model[:40]!r}",
                given=model,
            )
        says = _MODELS[model]
    elif "fisheye_model" in content:
        says = bool(numbers("fisheye_model", count=1)[0])
    if None not in (fisheye, says) and fisheye != says:
        raise InvalidInputError(
            f"fisheye must be {says} or left out, as {path} says so, got {fisheye!r}",
            given=fisheye,
        )
    K = numbers("camera_matrix", "k", count=9)
    distortion = numbers("distortion_coefficients", "dist_coeffs", "d")
    if size is None:
        width, height = (
            numbers(f"image_{side}", side, count=1, otherwise=_NO_SIZE)[0]
            for side in ("width", "height")
        )
        size = (width, height)
    return {
        "K": K.reshape(3, 3),
        "distortion": distortion,
        "size": size,
        "fisheye": bool(fisheye if says is None else says),
    }


def _read(path: Path) -> dict[Any, Any]:
    """Return the mapping that a YAML file holds; all numbers in it are still texts."""
    import yaml  # where it is used

    try:
        # OpenCV begins its files with %YAML:1.0, which is no YAML
        text = re.sub(r"\A\ufeff?%YAML[^\n]*\n", "", read_text(path, _LONGEST))
        # texts only, whatever their tags are, such as !!opencv-matrix: nothing is executed, and no
        # number or alias can be made to take long
        content = yaml.load(text, Loader=yaml.BaseLoader)
        if isinstance(content, dict):
            return content
        problem, at = "no camera_matrix and distortion_coefficients", ""
    except OSError as error:
        raise InvalidInputError(
            f"{path} must be a calibration file that can be read, got {reason(error)}", given=path
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        at = "" if mark is None else f" at line {mark.line + 2}"
        problem = getattr(error, "problem", None) or type(error).__name__
    raise InvalidInputError(
        f"{path} must be YAML of OpenCV's FileStorage or of ROS, got {problem}{at}", given=path
    )


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


def view_axes(position: object, looking_at: object, up: object) -> Array:
    """Return the axes of a camera whose optical axis goes through a point; see `standing_at`."""
    p = as_array("position", position, (3,), "m")
    view = as_array("target", looking_at, (3,), "m") - p
    right = np.cross(view, as_array("up", up, (3,)))
    if not np.linalg.norm(right) > 1e-9 * max(1.0, float(np.linalg.norm(view))):
        raise InvalidInputError(
            f"target must be away from position, and not along up, which has no place in the "
            f"image then, got target {looking_at!r} from {position!r} with up {up!r}",
            given=looking_at,
        )
    z: Array = view / np.linalg.norm(view)
    x: Array = right / np.linalg.norm(right)
    return np.column_stack([x, np.cross(z, x), z])


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
