"""Runs of studies in portions: to an executor and from it, to files and from them."""

from __future__ import annotations

import copy
import hashlib
import math
import os
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.files import read_arrays, replaced
from approxjac.stability.rollout.rollout_study import COLUMNS, Study
from approxjac.validation import Array

_CHUNKS = 64  # that runs are handed to an executor in, at least
_PORTION = 1024  # runs in lanes at once, at most
_VECTOR = 8  # runs that lanes take at once, at least

Progress = Callable[[int], None] | bool | None


def carried_out(
    studies: Sequence[Study],
    runs: int,
    failures: int | None,
    executor: Executor | None,
    folder: str | os.PathLike[str] | None,
    progress: Progress,
) -> list[dict[str, Array]]:
    """Return the columns of the runs of some studies.

    What they are does not depend on how they are shared out.

    Args:
        studies: The studies.
        runs: Of each.
        failures: Each ends with its so many-th run that does not converge.
        executor: What carries out portions; this thread by default.
        folder: Where portions that are done are kept.
        progress: See `rollouts`.
    """
    shared = max(1, math.ceil(len(studies) * runs / _CHUNKS))
    pieces: list[tuple[int, range]] = []
    for k, study in enumerate(studies):
        if study.engine == "lanes":
            whole_ones = executor is None and folder is None and failures is None
            size = _PORTION if whole_ones else min(max(_VECTOR, shared), _PORTION)
        else:
            size = 1 if executor is None and folder is None else min(shared, _PORTION)
        pieces += [(k, range(runs)[at : at + size]) for at in range(0, runs, size)]
    part = partial(_part, _Copies())
    part = part if folder is None else partial(_kept_part, Path(folder), part)
    if folder is not None or isinstance(executor, ProcessPoolExecutor):  # others may pickle more
        for study in studies:
            _require_picklable(study)
    futures = [executor.submit(part, studies[k], indices) for k, indices in pieces if executor]
    found: list[list[dict[str, Array]]] = [[] for _ in studies]
    left = [math.inf if failures is None else failures] * len(studies)
    try:
        with told(progress, len(studies) * runs) as tell:
            done = 0
            for i, (k, indices) in enumerate(pieces):
                if left[k] > 0:
                    columns = futures[i].result() if futures else part(studies[k], indices)
                    failed = np.cumsum(np.logical_not(columns["converged"]))
                    kept = np.searchsorted(failed, left[k]) + 1  # with the last failure
                    found[k].append({name: column[:kept] for name, column in columns.items()})
                    left[k] -= failed[-1]
                elif futures:
                    futures[i].cancel()
                done += len(indices)
                tell(done)
    finally:
        for future in futures:
            future.cancel()
    return [{name: np.concatenate([p[name] for p in each]) for name in COLUMNS} for each in found]


@contextmanager
def told(progress: Progress, total: int) -> Iterator[Callable[[int], None]]:
    """Return what is called with the number of runs that are done, of a total."""
    if progress is not True:
        yield progress or (lambda done: None)
        return
    from tqdm import tqdm

    with tqdm(total=total, unit=" runs") as bar:

        def tell(done: int) -> None:
            bar.update(done - bar.n)

        yield tell


def _require_picklable(study: Study) -> None:
    try:
        pickle.dumps(study)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InvalidInputError(
            "controller, uncertainty and region must be picklable to go to other processes or to "
            "be known again in a folder (functools.partial(PositionTask, axes='xz') is, a lambda "
            f"is not): {error}",
            given=study,
        ) from error


class _Copies:
    """Copies of studies, as tasks and controllers have scratch memory: one instance a thread."""

    def __init__(self) -> None:
        self._here = threading.local()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()  # other processes have their own

    def of(self, study: Study) -> Study:
        """Return that of this thread, which it keeps until it is asked for another study's."""
        known = vars(self._here).get("known")
        if known is None or known[0] is not study:
            known = self._here.known = study, copy.deepcopy(study)
        return known[1]


def _part(copies: _Copies, study: Study, indices: range) -> dict[str, Array]:
    """Return the columns of some runs."""
    return copies.of(study).columns(indices)


def _kept_part(
    folder: Path, part: Callable[..., dict[str, Array]], study: Study, indices: range
) -> dict[str, Array]:
    """Return the columns of some runs, from their file if there is one."""
    name = hashlib.sha256(pickle.dumps((study, indices))).hexdigest()[:20]
    file = folder / f"{name}.npz"
    if file.exists():
        try:
            with file.open("rb") as stream:
                return read_arrays(stream)
        except Exception as error:  # NumPy, zipfile and zlib each raise their own
            raise InvalidInputError(
                f"folder must hold whole files only, but {file} cannot be read ({error}); delete "
                "it, and its runs are done again",
                given=folder,
            ) from error
    found = part(study, indices)
    folder.mkdir(parents=True, exist_ok=True)
    with replaced(file) as unfinished, unfinished.open("wb") as kept:
        np.savez(kept, **found)  # type: ignore[arg-type]
    return found
