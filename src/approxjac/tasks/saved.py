"""`Saved`: a task or camera says itself what a file keeps of it."""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

import numpy as np


class Saved:
    """An object that a file keeps as its kind and the arguments that it was built with.

    Robots are kept elsewhere. A class without a kind of its own is not kept.
    """

    _kind: ClassVar[str]

    def _saved(self) -> dict[str, Any] | None:
        """Return texts, numbers, lists and dictionaries; None of what is not kept."""
        if "_kind" not in vars(type(self)):
            return None
        kept: dict[str, Any] = {"kind": self._kind}
        for name in inspect.signature(type(self)).parameters:
            if name != "robot":
                value = getattr(self, name)
                if isinstance(value, Saved) and (value := value._saved()) is None:
                    return None
                kept[name] = value.tolist() if isinstance(value, np.ndarray) else value
        return kept
