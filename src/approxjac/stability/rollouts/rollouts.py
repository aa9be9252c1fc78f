"""`Rollouts`: outcome of many simulated runs, with an exact confidence interval."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.extras import package_of
from approxjac.formatting import joined, percent, rows
from approxjac.simulation import Trajectory
from approxjac.stability.rollouts.setting import COLUMNS, Rollout, RolloutSetting
from approxjac.validation import Array, as_integer

_BEYOND = 1.0 + 1e-6  # of a limit: a torque at it, and round-off, is not beyond


@dataclass(frozen=True, eq=False, repr=False)
class Rollouts:
    """Outcome of all runs. Its text is a sentence that says so.

    Attributes:
        columns: Field of `Rollout` → its values in all runs, shape (N, …), in the order of the
            index. `numpy.savez(file, **columns)` keeps them.
        setting: What all runs share: `setting.uncertainty`, `setting.accuracy`, `setting.engine` …
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

    @property
    def table(self) -> dict[str, Array]:
        """The columns with a number each, as `pandas.DataFrame` takes them."""
        robot = self.setting.controller.task.robot
        labels = {
            "values": [f"true {name}" for name in self.setting.uncertainty.names],
            "q0": [f"q0[{i}]" for i in range(robot.nq)],
            "target": [f"target[{i}]" for i in range(self.setting.controller.task.n_x)],
        }
        found = {}
        for name, column in self.columns.items():
            if name not in labels:
                found[name] = column
                continue
            found |= {label: column[:, i] for i, label in enumerate(labels[name])}
        return found

    def replay(self, index: int) -> Trajectory:
        """Simulate a run again, in Python, with all that it records.

        Raises:
            InvalidInputError: No such run.
            SimulationError: It diverges.
        """
        if not 0 <= as_integer("index", index, 0) < self.n:
            raise InvalidInputError(
                f"index must be one of the {self.n} runs, 0 to {self.n - 1}, got {index}",
                given=index,
            )
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
    def n_beyond_torque(self) -> int:
        """Number of runs that asked a motor for more than its limit, which is not kept here.

        Runs that diverged do not count: their peaks are not known.
        """
        return int((self.columns["peak_torque"] > _BEYOND).sum())

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
        """The run with the largest final error, which is one that diverged if any did."""
        return self.runs[int(self.columns["final_error"].argmax())]

    def __repr__(self) -> str:
        return f"Rollouts({self.n_converged} of {self.n} converged)"

    def __str__(self) -> str:
        low, high = self.interval
        worst, setting = self.worst, self.setting
        unit = joined(setting.controller.task.units)
        ended = "diverged" if worst.diverged else f"ended {worst.final_error:.3g} {unit} off"
        told = {
            "share": f"{percent(self.share)} %, with 95 % confidence {percent(low)} to "
            f"{percent(high)} %",
            "converged": f"within {setting.accuracy:g} {unit} throughout the last tenth of "
            f"{setting.duration:g} s",
            "others": f"{self.n_diverged} diverged, {self.n_left} more left the region",
            "worst": f"run {worst.index} {ended}, with "
            f"{setting.uncertainty.describe(worst.values)}",
        }
        if self.n_beyond_torque:
            told["torques"] = (
                f"{'at least ' if self.n_diverged else ''}{self.n_beyond_torque} of {self.n} runs "
                "beyond motors, which are not limited here: up to "
                f"{np.nanmax(self.columns['peak_torque']):.3g} times their limits"
            )
        if setting.reason:  # slow, and nobody asked for it
            told["engine"] = f"in Python, as {setting.reason}"
        return "\n".join([f"converged: {self.n_converged} of {self.n} runs", *rows(told, 2)])


def clopper_pearson(successes: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact confidence interval for a probability, after Clopper and Pearson (1934).

    Whatever the probability is, the interval holds it in at least the share `confidence` of all
    samples; each end is missed in at most half of the rest.
    """
    betaincinv = package_of("study", "scipy.special").betaincinv
    tail, failures = 0.5 * (1.0 - confidence), runs - successes
    low = 0.0 if successes == 0 else float(betaincinv(successes, failures + 1, tail))
    high = 1.0 if failures == 0 else float(betaincinv(successes + 1, failures, 1.0 - tail))
    return low, high
