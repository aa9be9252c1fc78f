"""Packages that only some parts of the library need, each of an extra."""

from __future__ import annotations

import importlib
from typing import Any

from approxjac.errors import MissingPackageError

_NEEDED_BY = {
    "fast": "compiled code",
    "franka": "FrankaDriver",
    "mujoco": "MujocoPlant",
    "qp": "a QP solver other than DAQP",
    "study": "drawing, judging stability or integrating in continuous time",
    "view": "showing robots or reading their meshes",
    "vision": "the search for tags in images",
}


def package_of(extra: str, name: str) -> Any:
    """Import a package of an extra, or raise a MissingPackageError."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"{_NEEDED_BY[extra]} needs {name.split('.')[0]}, which cannot be imported ({error}): "
            f"pip install 'approxjac[{extra}]'",
            given=name,
        ) from error
