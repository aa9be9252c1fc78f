"""Sampled closed loop: rollouts over starts and errors, with an exact confidence interval."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from types import NoneType
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError, SimulationError
from approxjac.formatting import joined
from approxjac.interface import Controller
from approxjac.simulation import simulate
from approxjac.simulation.sampled_loop import require_fit
from approxjac.stability.region import Region
from approxjac.stability.uncertainty import Uncertainty
from approxjac.stability.visibility import UnattainedError, VisiblePart
from approxjac.validation import Array, as_integer, as_number, require

_RECORDS = 500  # of a run: 50 in its last tenth
_CHUNKS = 64  # that runs are handed to an executor in, at most
_EXECUTOR: Any = (Executor, NoneType)
_FUNCTION: Any = (Callable, NoneType)


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """One run.

    Attributes:
        index: k, from 0. Seed and index decide all that is drawn.
        values: True values of the uncertain coordinates, shape (d,).
        q0: Start, at rest, shape (nq,).
        target: x_d, shape (n_x,).
        final_error: ‖e‖ at the end [unit of the task]; infinite if the run diverged, or ended
            behind the camera, where there is no image.
        settling_time: First recorded time from which on ‖e‖ is below the tolerance at every
            recorded instant [s]; NaN if it is not at the end.
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
        runs: The runs, in the order of their index.
        uncertainty: What the true robots were drawn from.
        tolerance: Error below which a task counts as done [unit of the task].
        duration: Of each run [s].
    """

    runs: tuple[Rollout, ...]
    uncertainty: Uncertainty
    tolerance: float
    duration: float

    @property
    def n(self) -> int:
        """Number of runs."""
        return len(self.runs)

    @property
    def n_converged(self) -> int:
        """Number of runs that converged."""
        return sum(run.converged for run in self.runs)

    @property
    def n_diverged(self) -> int:
        """Number of runs that could not be simulated to their end."""
        return sum(run.diverged for run in self.runs)

    @property
    def n_left(self) -> int:
        """Number of runs that left the region and did not diverge."""
        return sum(not (run.stayed or run.diverged) for run in self.runs)

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
        return max(self.runs, key=lambda run: run.final_error)

    def __repr__(self) -> str:
        low, high = self.interval
        worst, unit = self.worst, joined(self.uncertainty.believed_task().units)
        ended = "diverged" if worst.diverged else f"ended {worst.final_error:.3g} {unit} off"
        return (
            f"{self.n_converged} of {self.n} runs converged to within {self.tolerance:g} {unit} "
            f"throughout the last tenth of their {self.duration:g} s: "
            f"{100 * self.share:.1f} %, with 95 % confidence "
            f"{100 * low:.1f} to {100 * high:.1f} %; {self.n_diverged} diverged, {self.n_left} "
            f"went outside the region without diverging; the worst, run {worst.index}, {ended} "
            f"with {self.uncertainty.describe(worst.values)}"
        )


def rollouts(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    *,
    target: Sequence[float] | Array | None = None,
    runs: int = 100,
    duration: float = 10.0,
    dt: float = 1e-3,
    tolerance: float = 1e-3,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[int], None] | None = None,
) -> Rollouts:
    """Simulate the sampled closed loop from random starts, with random true robots.

    Starts and targets are those that the true robot's sensor sees. Run k draws from a generator
    of its own, `numpy.random.default_rng([seed, k])`: the true values, the start, and the
    configuration that attains the target. So the result is the same whatever carries out the runs,
    and more runs of the same seed begin with the same ones.

    Args:
        controller: The controller with its believed robot: anything with the interface of
            `Controller`.
        uncertainty: How the true robot may differ.
        region: Where starts, at rest, and targets are drawn.
        target: x_d of all runs, shape (n_x,) [unit of the task]; by default, what the sensor of
            the true robot measures in another configuration of the region.
        runs: ≥ 1.
        duration: Of a run, a whole number of dt [s].
        dt: Sampling time [s].
        tolerance: > 0; a run converged if ‖e‖ is below it at every recorded instant of the last
            tenth [unit of the task].
        seed: ≥ 0.
        executor: What carries out the runs, such as a `ProcessPoolExecutor` (the user's to shut
            down); one after the other here by default. Each portion of runs has its own copies.
            Threads are no faster than none: a run is mostly Python.
        progress: Called with the number of runs that are done, in the calling process.

    Raises:
        InvalidInputError: Numbers out of range, a controller of another task than the sensor's, a
            region of which a true camera sees nothing, or something that cannot be sent to the
            processes of an executor.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    dt = as_number("dt", dt, unit="s", above=0.0)
    require_fit(uncertainty.plant(uncertainty.believed), controller, dt)
    require("region", region, Region, "a Region, such as JointBox(robot)")
    require("executor", executor, _EXECUTOR, "an executor of concurrent.futures or None")
    require("progress", progress, _FUNCTION, "a function of the number of runs done")
    runs, seed = as_integer("runs", runs, 1), as_integer("seed", seed, 0)
    duration = as_number("duration", duration, unit="s", minimum=dt)
    tolerance = as_number("tolerance", tolerance, above=0.0)
    x_d = None if target is None else uncertainty.believed_task().target(target)
    run = partial(_run, controller, uncertainty, region, x_d, duration, dt, tolerance, seed)
    done: list[Rollout] = []
    here = ([run(index)] for index in range(runs))
    for portion in here if executor is None else _elsewhere(run, runs, executor):
        done += portion
        if progress is not None:
            progress(len(done))
    return Rollouts(tuple(done), uncertainty, tolerance, duration)


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


def _run(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    target: Array | None,
    duration: float,
    dt: float,
    tolerance: float,
    seed: int,
    index: int,
) -> Rollout:
    """Carry out one run."""
    rng = np.random.default_rng([seed, index])
    values = uncertainty.sample(rng)
    plant = uncertainty.plant(values)
    seen = VisiblePart(region, plant.sensor)
    try:
        q0 = plant.robot.configuration(region.sample(1, rng)[0], "q0")
        q0 = seen.replace_unseen(q0[None], rng)[0]
        if target is None:
            target = plant.sensor.value(seen.sample(1, rng)[0])
    except UnattainedError as error:
        raise UnattainedError(
            f"{error}, with {uncertainty.describe(values)}", given=values, truth=index
        ) from error
    every = max(1, round(duration / dt / _RECORDS)) * dt
    try:
        record = simulate(
            plant, controller, target, q0, duration, dt=dt, record_every=every,
            integrator="semi_implicit_euler",
        )  # fmt: skip
    except SimulationError:
        return Rollout(index, values, q0, target, math.inf, math.nan, False, True, False)
    settling, converged = _judged(record.t, record.error_norm, tolerance)
    final = float(record.error_norm[-1])
    final = math.inf if math.isnan(final) else final
    stayed = all(bool(region.contains(q)) for q in record.q)
    return Rollout(index, values, q0, target, final, settling, converged, False, stayed)


def _judged(t: Array, error: Array, tolerance: float) -> tuple[float, bool]:
    """Settling time, and whether the error was below the tolerance in all of the last tenth."""
    below = error < tolerance
    last_tenth = t >= (0.9 - 1e-9) * t[-1]
    first = int(np.flatnonzero(~below).max(initial=-1)) + 1
    settling = float(t[first]) if first < len(t) else math.nan
    return settling, bool(below[last_tenth].all())


def _elsewhere(
    run: Callable[[int], Rollout], runs: int, executor: Executor
) -> Iterator[list[Rollout]]:
    """Portions of runs as an executor is done with them."""
    if isinstance(executor, ProcessPoolExecutor):  # others may pickle more
        try:
            pickle.dumps(run)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InvalidInputError(
                "controller, uncertainty and region must be picklable to go to other processes "
                f"(functools.partial(PositionTask, axes='xz') is, a lambda is not): {error}",
                given=executor,
            ) from error
    indices, size = range(runs), math.ceil(runs / _CHUNKS)
    portions = [indices[start : start + size] for start in indices[::size]]
    return executor.map(partial(_portion, run), portions)  # cancels the others where one fails


def _portion(run: Callable[[int], Rollout], indices: range) -> list[Rollout]:
    own = copy.deepcopy(run)  # tasks and controllers have scratch memory: one instance a thread
    return [own(index) for index in indices]
