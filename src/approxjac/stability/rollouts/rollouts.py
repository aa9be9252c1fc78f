"""`Rollouts`: many simulated runs, in portions, with an exact confidence interval."""

import copy
import math
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from approxjac.errors import InvalidInputError, package_of
from approxjac.formatting import joined, percent
from approxjac.simulation import Trajectory
from approxjac.stability.rollouts.setting import COLUMNS, Rollout, RolloutSetting
from approxjac.stability.rows import Row, as_lines
from approxjac.validation import Array, as_integer, require

_BEYOND = 1.0 + 1e-6  # of a limit
_CHUNKS = 64  # that runs are handed to an executor in, at least
_PORTION = 1024  # runs in lanes at once, at most
_VECTOR = 8  # runs that lanes take at once, at least
_SHARED = 256  # starts that settings share, whose robots are kept meanwhile

Engine = Literal["lanes", "python"]


@dataclass(frozen=True, eq=False, repr=False)
class Rollouts:
    """Outcome of all runs, printed as a sentence.

    Attributes:
        columns: Field of `Rollout` → its values in all runs, shape (N, …), in the order of the
            index. `numpy.savez(file, **columns)` saves them.
        setting: Setting of all runs: `setting.uncertainty`, `setting.accuracy`, `setting.engine` …
    """

    columns: dict[str, Array]
    setting: RolloutSetting

    @cached_property
    def runs(self) -> tuple[Rollout, ...]:
        """The runs, in the order of their index."""
        each = (self.columns[name] for name in COLUMNS)
        return tuple(
            Rollout(*(value.item() if value.ndim == 0 else value for value in row))
            for row in zip(*each, strict=True)
        )

    def replay(self, index: int) -> Trajectory:
        """Simulate a run again, in Python, and return its full record.

        Raises:
            InvalidInputError: No such run.
            SimulationError: It diverges.
        """
        if not 0 <= as_integer("index", index, 0) < self.n:
            message = f"index must be one of the {self.n} runs, 0 to {self.n - 1}, got {index}"
            raise InvalidInputError(message, given=index)
        return self.setting.simulated(self.setting.start(int(self.columns["index"][index])))

    @property
    def n(self) -> int:
        """Number of runs."""
        return len(self.columns["index"])

    @property
    def n_converged(self) -> int:
        """Number of runs that converged."""
        return int(self.columns["converged"].sum())

    @property
    def n_diverged(self) -> int:
        """Number of runs that could not be simulated to their end."""
        return int(self.columns["diverged"].sum())

    @property
    def n_left(self) -> int:
        """Number of runs that left the region and did not diverge."""
        return int((~np.logical_or(self.columns["stayed"], self.columns["diverged"])).sum())

    @property
    def share(self) -> float:
        """Share of the runs that converged."""
        return self.n_converged / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval for the probability to converge, after Clopper and Pearson (1934)."""
        return clopper_pearson(self.n_converged, self.n)

    @property
    def worst(self) -> Rollout:
        """The run with the largest final error, a diverged one if any did."""
        return self.runs[int(self.columns["final_error"].argmax())]

    def __repr__(self) -> str:
        return f"Rollouts({self.n_converged} of {self.n} converged)"

    @cached_property
    def rows(self) -> list[Row]:
        """The findings: outcome of the runs, verdict and figures."""
        (low, high), worst, setting, n = self.interval, self.worst, self.setting, self.n
        unit = joined(setting.controller.task.units)
        converged = {
            "runs": n, "converged": self.n_converged, "low": low, "high": high, "unit": unit,
            "accuracy": setting.accuracy, "duration": setting.duration,
        }  # fmt: skip
        text = (
            f"within {setting.accuracy:g} {unit} throughout the last tenth of "
            f"{setting.duration:g} s; {percent(low)} to {percent(high)} % of all do (95 % "
            "confidence)"
        )
        diverged, left = {"diverged": self.n_diverged}, {"left": self.n_left}
        rows = [
            Row("rollouts", "converged", f"{self.n_converged} of {n}", converged, text),
            Row("rollouts", "diverged", f"{self.n_diverged} of {n}", diverged),
            Row("rollouts", "left the region", f"{self.n_left} of {n}", left, "without diverging"),
        ]
        # a torque at its limit, and round-off, is not beyond
        if beyond := int((self.columns["peak_torque"] > _BEYOND).sum()):
            most = float(np.nanmax(self.columns["peak_torque"]))
            peaks = {"beyond": beyond, "most": most, "unknown": self.n_diverged}
            count = f"{'at least ' if self.n_diverged else ''}{beyond} of {n}"
            text = f"beyond motors, which are not limited here: up to {most:.3g} times their limits"
            rows.append(Row("rollouts", "torques", count, peaks, text))
        values = setting.uncertainty.describe(worst.values)
        ended = "diverged" if worst.diverged else f"ended {worst.final_error:.3g} {unit} off"
        figures = {
            "diverged": worst.diverged, "error": worst.final_error, "unit": unit, "values": values,
        }  # fmt: skip
        text = f"{ended}, with {values}"
        return [*rows, Row("rollouts", "worst", f"run {worst.index}", figures, text)]

    def __str__(self) -> str:
        rows, reason = self.rows, self.setting.reason
        if reason:  # slow, and nobody asked for it
            rows = [*rows, Row("rollouts", "engine", "in Python", {}, f"as {reason}")]
        return "\n".join([f"converged: {rows[0].verdict} runs", *as_lines(rows)])


def clopper_pearson(successes: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact confidence interval of a probability, after Clopper and Pearson (1934).

    Whatever the probability is, the interval holds it in at least the share `confidence` of all
    samples; each end is missed in at most half of the rest.
    """
    betaincinv = package_of("study", "scipy.special").betaincinv
    tail, failures = 0.5 * (1.0 - confidence), runs - successes
    low = 0.0 if successes == 0 else float(betaincinv(successes, failures + 1, tail))
    return low, 1.0 if failures == 0 else float(betaincinv(successes + 1, failures, 1.0 - tail))


# -- how they are carried out ----------------------------------------------------------------------


@dataclass(frozen=True)
class Execution:
    """Engine and executor of many runs. Results do not depend on it, except for rounding.

    Attributes:
        engine: "lanes" traces the closed loop and carries out many runs at once in SIMD vectors,
            some hundred times as fast; "python" runs `simulate`, which can run everything. By
            default lanes if they cover the loop and llvmlite is installed (the extra `fast`);
            `Rollouts.setting` has the engine and the reason. They differ by rounding.
        executor: Executor of portions of the runs, such as a `ThreadPoolExecutor` (for lanes), a
            `ProcessPoolExecutor` or Dask's `client.get_executor()`, which the user shuts down; this
            thread by default. Each portion has its own copies.

    Raises:
        InvalidInputError: `executor` is no executor.
    """

    engine: Engine | None = None
    executor: Executor | None = None

    def __post_init__(self) -> None:
        wanted = "an executor of concurrent.futures or None"
        require("executor", self.executor, Executor | None, wanted)


def carried_out(
    settings: Sequence[RolloutSetting],
    runs: int,
    failures: int | None,
    execution: Execution,
    tell: Callable[[float], None],
) -> list[dict[str, Array]]:
    """Return the columns of the runs of some settings, which differ in gains or scale at most.

    Each setting stops after `failures` runs that do not converge, if that is given.
    """
    executor = execution.executor
    shared = max(1, math.ceil(len(settings) * runs / _CHUNKS))
    pieces: list[tuple[int, range]] = []
    for k, setting in enumerate(settings):
        if setting.engine == "lanes":
            whole_ones = executor is None and failures is None
            most = _PORTION if len(settings) == 1 else _SHARED
            size = most if whole_ones else min(max(_VECTOR, shared), most)
        else:
            size = 1 if executor is None else min(shared, _PORTION)
        pieces += [(k, range(runs)[at : at + size]) for at in range(0, runs, size)]
    pieces.sort(key=lambda piece: piece[1].start)
    drawn: tuple[Any, ...] = (None, None, None)
    if isinstance(executor, ProcessPoolExecutor):  # others may pickle more
        try:
            pickle.dumps(settings)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InvalidInputError(
                "controller, uncertainty and region must be picklable to go to other processes "
                f"(functools.partial(PositionTask, axes='xz') is, a lambda is not): {error}",
                given=settings[0],
            ) from error
    futures = [executor.submit(_copied, settings[k], indices) for k, indices in pieces if executor]
    parts: list[list[dict[str, Array]]] = [[] for _ in settings]
    left = [math.inf if failures is None else failures] * len(settings)
    try:
        done = 0
        for i, (k, indices) in enumerate(pieces):
            if left[k] > 0:
                if not futures and len(settings) > 1:
                    of = settings[k].uncertainty
                    if drawn[:2] != (of, indices):
                        drawn = of, indices, [*map(settings[k].start, indices)]
                columns = futures[i].result() if futures else settings[k].columns(indices, drawn[2])
                failed = np.cumsum(np.logical_not(columns["converged"]))
                kept = np.searchsorted(failed, left[k]) + 1  # with the last failure
                parts[k].append({name: column[:kept] for name, column in columns.items()})
                left[k] -= failed[-1]
            elif futures:
                futures[i].cancel()
            done += len(indices)
            tell(done / (len(settings) * runs))
    finally:
        for future in futures:
            future.cancel()
    return [{name: np.concatenate([p[name] for p in each]) for name in COLUMNS} for each in parts]


def _copied(setting: RolloutSetting, indices: range) -> dict[str, Array]:
    """Columns of some runs of a copy, as tasks and controllers have scratch memory."""
    return copy.deepcopy(setting).columns(indices)
