"""Calibrations of OpenCV and ROS, the files that they keep them in, and tags."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.files import read_text, reason
from approxjac.validation import Array, as_array, as_number

_LONGEST = 500_000  # file [bytes]
_MODELS = {  # of ROS
    "plumb_bob": False, "rational_polynomial": False, "equidistant": True, "fisheye": True,
}  # fmt: skip
_NAMES = {  # in small letters
    "K": ("camera_matrix", "k"),
    "distortion": ("distortion_coefficients", "dist_coeffs", "d"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "model": ("distortion_model",),
    "fisheye": ("fisheye_model",),
}


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
    if (rvec is None) != (tvec is None) or not (rvec is None or camera_pose is None):
        places = {"rvec": rvec, "tvec": tvec, "camera_pose": camera_pose}
        given = [name for name, each in places.items() if each is not None]
        raise InvalidInputError(
            f"where a camera stands must be given by rvec and tvec, or by camera_pose, got "
            f"{' and '.join(given)}",
            given=given,
        )
    if rvec is not None:
        R = pin.exp3(np.array(as_array("rvec", np.ravel(rvec), (3,), "rad")))
        t = as_array("tvec", np.ravel(tvec), (3,), "m")
        place.update(position=-R.T @ t, rotation=R.T)
    if camera_pose is not None:
        R, position = as_pose("camera_pose", camera_pose)
        place.update(position=position, rotation=R)
    return place


def read_calibration(
    path: str | Path, size: Sequence[int] | None, fisheye: bool | None
) -> dict[str, Any]:
    """Return arguments of `PinholeCamera.from_opencv` of a file; ours fill in what it lacks."""
    keys = {str(name).lower(): value for name, value in _read(Path(path)).items()}
    values = {
        name: next((keys[each] for each in names if each in keys), None)
        for name, names in _NAMES.items()
    }
    for name in ("K", "distortion"):
        if values[name] is None:
            raise InvalidInputError(
                f"{path} must have {' or '.join(_NAMES[name])}, as a calibration of OpenCV's or a "
                f"camera_info of ROS's has, got {', '.join(list(keys)[:20]) or 'nothing'}",
                given=path,
            )
    K = _numbers(path, "camera_matrix", values["K"])
    if K.size != 9:
        raise InvalidInputError(
            f"camera_matrix of {path} must be 9 numbers, got {K.size}", given=path
        )
    if size is None:
        if values["width"] is None or values["height"] is None:
            raise InvalidInputError(
                f"{path} must have image_width and image_height, or give them as "
                "size=(width, height) [px]",
                given=path,
            )
        size = [round(_number(path, name, values[name])) for name in ("width", "height")]
    distortion = _numbers(path, "distortion_coefficients", values["distortion"])
    fisheye = _is_fisheye(path, values, fisheye)
    return {"K": K.reshape(3, 3), "distortion": distortion, "size": size, "fisheye": fisheye}


def _is_fisheye(path: str | Path, values: Mapping[str, Any], fisheye: bool | None) -> bool:
    """Return True for a fisheye lens, by the argument and by the file."""
    says = None
    if values["model"] is not None:
        model = str(values["model"]).lower()
        if model not in _MODELS:
            raise InvalidInputError(
                f"distortion_model of {path} must be one of {', '.join(_MODELS)}, got "
                f"{model[:40]!r}",
                given=values["model"],
            )
        says = _MODELS[model]
    elif values["fisheye"] is not None:
        says = _number(path, "fisheye_model", values["fisheye"]) != 0.0
    if fisheye is not None and says is not None and fisheye != says:
        raise InvalidInputError(
            f"fisheye must be {says} or left out, as {path} says so, got {fisheye!r}",
            given=fisheye,
        )
    return bool(fisheye if says is None else says)


def _read(path: Path) -> dict[Any, Any]:
    """Return the mapping that a YAML file holds; all numbers in it are still texts."""
    import yaml  # where it is used

    try:
        # OpenCV begins its files with %YAML:1.0, which is no YAML
        text = re.sub(r"\A\ufeff?%YAML[^\n]*\n", "", read_text(path, _LONGEST))
        # texts only, whatever their tags are, such as !!opencv-matrix: nothing is executed, and no
        # number or alias can be made to take long
        content = yaml.load(text, Loader=yaml.BaseLoader)
    except OSError as error:
        raise InvalidInputError(
            f"{path} must be a calibration file that can be read, got {reason(error)}", given=path
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        line = getattr(error, "problem_mark", None)
        at = "" if line is None else f" at line {line.line + 2}"
        problem = getattr(error, "problem", None) or type(error).__name__
        raise InvalidInputError(
            f"{path} must be YAML of OpenCV's FileStorage or of ROS, got {problem}{at}", given=path
        ) from error
    if not isinstance(content, dict):
        raise InvalidInputError(
            f"{path} must be YAML with camera_matrix and distortion_coefficients, got a "
            f"{'list' if isinstance(content, list) else 'text'}",
            given=path,
        )
    return content


def _numbers(
    path: str | Path,
    name: str,
    value: Any,
    wanted: str = "a matrix of finite numbers, with data: [...]",
) -> Array:
    """Return the numbers of a matrix as a file holds it: a mapping with data, or a list."""
    data = value.get("data") if isinstance(value, dict) else value
    rows = data if isinstance(data, list) else [data]
    entries = [each for row in rows for each in (row if isinstance(row, list) else [row])]
    try:
        numbers = np.array([float(each) if isinstance(each, str) else math.nan for each in entries])
    except (TypeError, ValueError):
        numbers = np.array([math.nan])
    if not np.isfinite(numbers).all():
        raise InvalidInputError(f"{name} of {path} must be {wanted}", given=path)
    if isinstance(value, dict) and "rows" in value and "cols" in value:
        shape = [_number(path, f"{each} of {name}", value[each]) for each in ("rows", "cols")]
        if shape[0] * shape[1] != len(numbers):
            raise InvalidInputError(
                f"{name} of {path} must have rows x cols = {shape[0]:g} x {shape[1]:g} numbers, "
                f"got {len(numbers)}",
                given=path,
            )
    return numbers


def _number(path: str | Path, name: str, value: object) -> float:
    """Return a number >= 0 as a file holds it."""
    (number,) = _numbers(path, name, [value], "a number")
    return as_number(name, float(number), minimum=0.0)


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
    `corners[::-1]`.) The x of the task is `corners.ravel()`, eight numbers, of which
    `CombinedTask.balanced` makes the six that a controller takes.

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
