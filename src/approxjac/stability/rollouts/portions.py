"""Runs in portions: to an `Execution` and from it, to files and from them."""

from __future__ import annotations

import copy
import hashlib
import math
import os
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.files import read_arrays, replaced
from approxjac.stability.rollouts.setting import COLUMNS, RolloutSetting
from approxjac.validation import Array, require

_CHUNKS = 64  # that runs are handed to an executor in, at least
_PORTION = 1024  # runs in lanes at once, at most
_VECTOR = 8  # runs that lanes take at once, at least

Engine = Literal["lanes", "python"]
_EXECUTOR: Any = (Executor, NoneType)
_FOLDER: Any = (str, os.PathLike, NoneType)


@dataclass(frozen=True)
class Execution:
    """How and where many runs are carried out. What comes of them does not depend on it.

    Attributes:
        engine: "lanes" traces the closed loop and carries out many runs at once in the machine's
            vectors, some hundred times as fast; "python" runs `simulate`, with anything. By default
            lanes where they cover the loop and llvmlite is there (the extra `fast`);
            `Rollouts.setting` says which, and why. They differ by rounding.
        executor: What carries out portions of the runs, such as a `ThreadPoolExecutor` (for lanes),
            a `ProcessPoolExecutor` or Dask's `client.get_executor()`, the user's to shut down; this
            thread by default. Each portion has its own copies.
        folder: Where portions that are done are kept, a file each. The same call goes on from them.

    Raises:
        InvalidInputError: What is no executor, or no folder.
    """

    engine: Engine | None = None
    executor: Executor | None = None
    folder: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        require("executor", self.executor, _EXECUTOR, "an executor of concurrent.futures or None")
        require("folder", self.folder, _FOLDER, "a folder, or None")


def carried_out(
    settings: Sequence[RolloutSetting],
    runs: int,
    failures: int | None,
    execution: Execution,
    tell: Callable[[float], None],
) -> list[dict[str, Array]]:
    """Return the columns of the runs of some settings.

    What they are does not depend on how they are shared out.

    Args:
        settings: The settings.
        runs: Of each.
        failures: Each ends with its so many-th run that does not converge.
        execution: What carries out portions, and where those that are done are kept.
        tell: Called with the share that is done.
    """
    executor, folder = execution.executor, execution.folder
    shared = max(1, math.ceil(len(settings) * runs / _CHUNKS))
    pieces: list[tuple[int, range]] = []
    for k, setting in enumerate(settings):
        if setting.engine == "lanes":
            whole_ones = executor is None and folder is None and failures is None
            size = _PORTION if whole_ones else min(max(_VECTOR, shared), _PORTION)
        else:
            size = 1 if executor is None and folder is None else min(shared, _PORTION)
        pieces += [(k, range(runs)[at : at + size]) for at in range(0, runs, size)]
    part = partial(_portion, None if folder is None else Path(folder), executor is not None)
    if folder is not None or isinstance(executor, ProcessPoolExecutor):  # others may pickle more
        for setting in settings:
            _require_picklable(setting)
    futures = [executor.submit(part, settings[k], indices) for k, indices in pieces if executor]
    found: list[list[dict[str, Array]]] = [[] for _ in settings]
    left = [math.inf if failures is None else failures] * len(settings)
    try:
        done = 0
        for i, (k, indices) in enumerate(pieces):
            if left[k] > 0:
                columns = futures[i].result() if futures else part(settings[k], indices)
                failed = np.cumsum(np.logical_not(columns["converged"]))
                kept = np.searchsorted(failed, left[k]) + 1  # with the last failure
                found[k].append({name: column[:kept] for name, column in columns.items()})
                left[k] -= failed[-1]
            elif futures:
                futures[i].cancel()
            done += len(indices)
            tell(done / (len(settings) * runs))
    finally:
        for future in futures:
            future.cancel()
    return [{name: np.concatenate([p[name] for p in each]) for name in COLUMNS} for each in found]


def _require_picklable(setting: RolloutSetting) -> None:
    try:
        pickle.dumps(setting)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InvalidInputError(
            "controller, uncertainty and region must be picklable to go to other processes or to "
            "be known again in a folder (functools.partial(PositionTask, axes='xz') is, a lambda "
            f"is not): {error}",
            given=setting,
        ) from error


def _portion(
    folder: Path | None, is_shared: bool, setting: RolloutSetting, indices: range
) -> dict[str, Array]:
    """Return the columns of some runs, from their file if there is one.

    Where others go on meanwhile it is of a copy, as tasks and controllers have scratch memory.
    """
    name = "" if folder is None else hashlib.sha256(pickle.dumps((setting, indices))).hexdigest()
    file = None if folder is None else folder / f"{name[:20]}.npz"
    if file is not None and file.exists():
        try:
            with file.open("rb") as stream:
                return read_arrays(stream)
        except Exception as error:  # NumPy, zipfile and zlib each raise their own
            raise InvalidInputError(
                f"folder must hold whole files only, but {file} cannot be read ({error}); delete "
                "it, and its runs are done again",
                given=folder,
            ) from error
    found = (copy.deepcopy(setting) if is_shared else setting).columns(indices)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replaced(file) as unfinished, unfinished.open("wb") as kept:
            np.savez(kept, **found)  # type: ignore[arg-type]
    return found
