"""Packages that only the browser view needs."""

from __future__ import annotations

import importlib
from typing import Any

from approxjac.errors import MissingPackageError


def view_package(name: str) -> Any:
    """Import a package of the extra "view", or raise a MissingPackageError."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"the browser view needs {name.split('.')[0]}, which cannot be imported ({error}): "
            "pip install 'approxjac[view]'",
            given=name,
        ) from error
