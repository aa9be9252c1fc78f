"""Sampled closed loop: rollouts over starts and errors, with an exact confidence interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from functools import cached_property
from os import PathLike
from types import NoneType
from typing import Any, Literal

import numpy as np

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined, percent, rows
from approxjac.interface import Target, TargetPath
from approxjac.simulation import Plant, Sensing, Trajectory
from approxjac.simulation.targets import require_fit, wanted_of
from approxjac.stability.errors.region import Region
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.rollout.rollout_portions import Progress, carried_out
from approxjac.stability.rollout.rollout_study import Study
from approxjac.tasks.analysis import fine_error
from approxjac.validation import Array, as_integer, as_number, require

_EXECUTOR: Any = (Executor, NoneType)
_FOLDER: Any = (str, PathLike, NoneType)
_DURATION = 10.0  # [s]
_BEYOND = 1.0 + 1e-6  # of a limit: a torque at it, and round-off, is not beyond
_PROGRESS: Any = (Callable, bool, NoneType)

Engine = Literal["lanes", "python"]


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """One run.

    Attributes:
        index: k, from 0. Seed and index decide all that is drawn.
        values: True values of the uncertain coordinates, shape (d,).
        q0: Start, at rest, shape (nq,).
        target: x_d at the beginning, shape (n_x,).
        final_error: ‖e‖ at the end [unit of the task]; infinite if the run diverged, or ended
            behind the camera, where there is no image.
        settling_time: First recorded time from which on ‖e‖ is below the tolerance at every
            recorded instant [s]; NaN if it is not at the end.
        peak_torque: Largest torque asked for at a recorded instant, as a share of its motor's
            limit; NaN if the run diverged.
        peak_speed: Largest speed of a joint there, as a share of its limit; NaN if it diverged.
        converged: Whether it is at every recorded instant of the last tenth.
        diverged: Whether the simulation could not be carried to its end.
        stayed: Whether all recorded configurations are in the region; False if the run diverged.
    """

    index: int
    values: Array
    q0: Array
    target: Array
    final_error: float
    settling_time: float
    peak_torque: float
    peak_speed: float
    converged: bool
    diverged: bool
    stayed: bool

    def __repr__(self) -> str:
        became = "diverged" if self.diverged else f"ended {self.final_error:.3g} off"
        settled = f", converged after {self.settling_time:.3g} s" if self.converged else ""
        return f"Rollout({self.index}: {became}{settled})"


@dataclass(frozen=True, eq=False, repr=False)
class Rollouts:
    """Outcome of all runs. Its text is a sentence that says so.

    Attributes:
        columns: Field of `Rollout` → its values in all runs, shape (N, …), in the order of the
            index. `numpy.savez(file, **columns)` keeps them.
        study: What all runs share: `study.uncertainty`, `study.tolerance`, `study.duration` …
    """

    columns: dict[str, Array]
    study: Study

    @cached_property
    def runs(self) -> tuple[Rollout, ...]:
        """The runs, in the order of their index."""
        each = (self.columns[field.name] for field in fields(Rollout))
        return tuple(
            Rollout(*(value.item() if value.ndim == 0 else value for value in row))
            for row in zip(*each, strict=True)
        )

    @property
    def table(self) -> dict[str, Array]:
        """The columns with a number each, as `pandas.DataFrame` takes them."""
        robot = self.study.controller.task.robot
        labels = {
            "values": [f"true {name}" for name in self.study.uncertainty.names],
            "q0": [f"q0[{i}]" for i in range(robot.nq)],
            "target": [f"target[{i}]" for i in range(self.study.controller.task.n_x)],
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
        return self.study.simulated(self.study.start(int(self.columns["index"][index])))

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
    def beyond_torque(self) -> tuple[str, str]:
        """Return how many runs go beyond the limit of a motor, and how far, in words."""
        most = f"up to {np.nanmax(self.columns['peak_torque']):.3g} times their limits"
        count = f"{'at least ' if self.n_diverged else ''}{self.n_beyond_torque} of {self.n}"
        return count, f"beyond motors, which are not limited here: {most}"

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
        worst, study = self.worst, self.study
        unit = joined(study.controller.task.units)
        ended = "diverged" if worst.diverged else f"ended {worst.final_error:.3g} {unit} off"
        told = {
            "share": f"{percent(self.share)} %, with 95 % confidence {percent(low)} to "
            f"{percent(high)} %",
            "converged": f"within {study.tolerance:g} {unit} throughout the last tenth of "
            f"{study.duration:g} s",
            "others": f"{self.n_diverged} diverged, {self.n_left} more left the region",
            "worst": f"run {worst.index} {ended}, with {study.uncertainty.describe(worst.values)}",
        }
        if self.n_beyond_torque:
            told["torques"] = " runs ".join(self.beyond_torque)
        if study.reason:  # slow, and nobody asked for it
            told["engine"] = f"in Python, as {study.reason}"
        return "\n".join([f"converged: {self.n_converged} of {self.n} runs", *rows(told, 2)])


def rollouts(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    *,
    target: Sequence[float] | Array | Target | TargetPath | None = None,
    runs: int = 100,
    duration: float = _DURATION,
    dt: float = 1e-3,
    tolerance: float | None = None,
    seed: int = 0,
    sensing: Sensing | None = None,
    actuator_delay: float = 0.0,
    engine: Engine | None = None,
    failures: int | None = None,
    executor: Executor | None = None,
    folder: str | PathLike[str] | None = None,
    progress: Progress = None,
) -> Rollouts:
    """Simulate the sampled closed loop from random starts, with random true robots.

    Starts and targets are those that the true robot's sensor sees. Run k draws from a generator
    of its own, `numpy.random.default_rng([seed, k])`: the true values, the start, the
    configuration that attains the target, and the seed of its noise and dropouts. So the result is
    the same whatever carries out the runs, and more runs of the same seed begin with the same ones.

    Args:
        controller: The controller with its believed robot: anything with the interface of
            `Controller`.
        uncertainty: How the true robot may differ.
        region: Where starts, at rest, and targets are drawn.
        target: x_d of all runs, shape (n_x,) [unit of the task], or what moves, as of `simulate`;
            by default, what the sensor of the true robot measures in another configuration of the
            region.
        runs: ≥ 1.
        duration: Of a run, a whole number of dt [s].
        dt: Sampling time [s].
        tolerance: > 0; a run converged if ‖e‖ is below it at every recorded instant of the last
            tenth [unit of the task]; by default 1 mm, 1 mrad or 0.5 px, or three times the sensor's
            noise if that is more.
        seed: ≥ 0.
        sensing: How measurements differ from the truth, as of `Plant`; not at all by default.
        actuator_delay: Time from a torque to its effect [s], as of `Plant`.
        engine: "lanes" traces the closed loop and carries out many runs at once in the machine's
            vectors, some hundred times as fast; "python" runs `simulate`, with anything. By default
            lanes where they cover the loop and llvmlite is there (the extra `fast`); the study of
            the answer says which, and why. They differ by rounding.
        failures: ≥ 1: end with the so many-th run that does not converge, which with 1 is the first
            one; all runs are carried out by default. The interval holds all the same.
        executor: What carries out portions of the runs, such as a `ThreadPoolExecutor` (for lanes),
            a `ProcessPoolExecutor` or Dask's `client.get_executor()`, the user's to shut down; this
            thread by default. Each portion has its own copies.
        folder: Where portions that are done are kept, a file each. The same call goes on from them.
        progress: Called with the number of runs that are done, in the calling process; True shows
            a bar.

    Raises:
        UnknownNameError: No such engine.
        MissingPackageError: Lanes are asked for, and llvmlite is not there.
        InvalidInputError: Numbers out of range, lanes asked for where they do not cover the loop, a
            controller of another task than the sensor's, a
            region of which a true camera sees nothing, or something that cannot be sent to the
            processes of an executor.
    """
    study = as_study(
        controller, uncertainty, region, target=target, duration=duration, dt=dt,
        tolerance=tolerance, seed=seed, sensing=sensing, actuator_delay=actuator_delay,
        engine=engine, runs=runs,
    )  # fmt: skip
    runs, failures = checked(runs, failures, executor, folder, progress)
    (columns,) = carried_out([study], runs, failures, executor, folder, progress)
    return Rollouts(columns, study)


def as_study(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    *,
    target: Sequence[float] | Array | Target | TargetPath | None = None,
    runs: int = 100,
    duration: float = _DURATION,
    dt: float = 1e-3,
    tolerance: float | None = None,
    seed: int = 0,
    sensing: Sensing | None = None,
    actuator_delay: float = 0.0,
    engine: Engine | None = None,
) -> Study:
    """Return what all runs share; the arguments are those of `rollouts`, checked."""
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    dt = as_number("dt", dt, unit="s", above=0.0)
    plant = uncertainty.plant(uncertainty.believed)
    require_fit(plant, controller, dt)
    late = Plant(plant.robot, plant.sensor, sensing=sensing, actuator_delay=actuator_delay)
    require("region", region, Region, "a Region, such as JointBox(robot)")
    runs, seed = as_integer("runs", runs, 1), as_integer("seed", seed, 0)
    duration = as_number("duration", duration, unit="s", minimum=dt)
    if sensing is not None and sensing.x_delay >= duration:
        raise InvalidInputError(
            f"x_delay must be shorter than the duration, {duration:g} [s], or nothing arrives that "
            f"is measured in a run, got {sensing.x_delay:g}",
            given=sensing,
        )
    if tolerance is None:
        noise = 0.0 if sensing is None else float(np.max(sensing.x_noise))
        tolerance = fine_error(controller.task.units, noise)
    tolerance = as_number("tolerance", tolerance, above=0.0)
    x_d = None if target is None else wanted_of(uncertainty.believed_task(), target, 0.0)
    study = Study(
        controller, uncertainty, region, x_d, duration, dt, tolerance, seed, late.sensing,
        late.actuator_delay,
    )  # fmt: skip
    return study.with_engine(engine, runs)


def as_late(latency: Latency) -> dict[str, Any]:
    """Return options of rollouts of the usual duration that are sampled and late like a loop."""
    return {
        "dt": latency.period,
        "duration": latency.period * round(_DURATION / latency.period),
        "actuator_delay": latency.torque_delay,
        "sensing": Sensing(
            x_delay=latency.image_age,
            x_rate=1.0 / latency.image_period if latency.image_period else None,
            velocity_filter=latency.velocity_filter or None,
        ),
    }


def checked(
    runs: int,
    failures: int | None,
    executor: Executor | None,
    folder: str | PathLike[str] | None,
    progress: Progress,
) -> tuple[int, int | None]:
    """Return the numbers of runs and of failures, or refuse them or what carries them out."""
    require("executor", executor, _EXECUTOR, "an executor of concurrent.futures or None")
    require("progress", progress, _PROGRESS, "a function of the number of runs done, or True")
    require("folder", folder, _FOLDER, "a folder, or None")
    failures = None if failures is None else as_integer("failures", failures, 1)
    return as_integer("runs", runs, 1), failures


def clopper_pearson(successes: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact confidence interval for a probability, after Clopper and Pearson (1934).

    Whatever the probability is, the interval holds it in at least the share `confidence` of all
    samples; each end is missed in at most half of the rest.
    """
    from scipy.special import betaincinv

    tail, failures = 0.5 * (1.0 - confidence), runs - successes
    low = 0.0 if successes == 0 else float(betaincinv(successes, failures + 1, tail))
    high = 1.0 if failures == 0 else float(betaincinv(successes + 1, failures, 1.0 - tail))
    return low, high
