"""`StudiedLoop`: a controller and the errors that it may meet, with a report and rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from types import NoneType
from typing import Any

import numpy as np

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.interface import Target, TargetPath
from approxjac.robots import Robot
from approxjac.simulation import Plant, Sensing
from approxjac.simulation.simulate import require_fit, wanted_of
from approxjac.stability.errors.region import Region, uncovered
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop, usual_region
from approxjac.stability.report.other_laws import OtherLawReport, near_targets
from approxjac.stability.report.report import StabilityReport, report_of
from approxjac.stability.rollouts.rollouts import Execution, Rollouts, carried_out
from approxjac.stability.rollouts.setting import RolloutSetting
from approxjac.tasks.analysis import fine_error
from approxjac.validation import Array, as_integer, as_number, require

Progress = Callable[[str, float], None] | bool | None
_PROGRESS: Any = (Callable, bool, NoneType)
_DURATION = 10.0  # of a run [s]


@dataclass(frozen=True, eq=False, repr=False)
class StudiedLoop:
    """A closed loop, the errors that it may meet, and where. Its attributes are those of `Study`.

    Raises:
        InvalidInputError: Numbers out of range, or arguments of the wrong kind.
    """

    controller: Controller
    uncertainty: Uncertainty | Plant | Robot
    region: Region | None = None
    _: KW_ONLY
    target: Sequence[float] | Array | Target | TargetPath | None = None
    latency: Latency | None = None
    sensing: Sensing | None = None
    duration: float | None = None
    accuracy: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        wanted = "a controller, such as SetpointController(task)"
        require("controller", self.controller, Controller, wanted)
        region, latency = (self.region, (Region, NoneType)), (self.latency, (Latency, NoneType))
        require("region", *region, "a Region, such as JointBox(robot), or None")
        require("latency", *latency, "Latency(period=...) or None")
        as_integer("seed", self.seed, 0)
        if self.accuracy is not None:
            as_number("accuracy", self.accuracy, above=0.0)

    def __repr__(self) -> str:
        name = type(self.controller).__name__
        return f"Study({name}, {self.uncertainty!r}, {self.region!r}, seed={self.seed})"

    def report(
        self,
        configurations: int = 2000,
        *,
        runs: int = 0,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> StabilityReport | OtherLawReport:
        """Tell before anything moves whether the loop is stable, and by how much.

        Half of the configurations, 1000 at most, find the worst cases and choose the Lyapunov
        functions, with a closer look around the worst of them; the others check what was chosen.
        With `TorqueLimited` certified are those starts whose motions its efforts never limit.

        A law that no certificate is for, such as one of your own, is linearised at targets of the
        region, and its report says so: an `OtherLawReport`.

        Args:
            configurations: How many to draw, ≥ 20, corners and inside of the errors half each.
            runs: How many rollouts to add; none by default.
            execution: How and where these are carried out.
            progress: Called with what is being done and the share of it; True shows a bar.

        Raises:
            InvalidInputError: A task whose Jacobian uses the measured x, an empty region or one
                that a true camera sees nothing of, a target that no configuration of a true robot
                attains, or numbers out of range.
        """
        controller, timing, seed = self.controller, self.timing, self.seed
        count = as_integer("configurations", configurations, 20)
        tell = telling(progress)
        reason = uncovered(controller)
        loop = None if reason else self.loop()
        many = self.rollouts(runs, execution=execution, progress=tell) if runs else None
        if loop is None:
            setting = self.setting()
            near = near_targets(setting, timing, count, partial(tell, "near targets"))
            return OtherLawReport(setting, timing, reason, *near, many)
        limiter: Any = controller if controller.limited_law is not None else None
        return report_of(loop, timing, count, seed, tell, limiter, many)

    def rollouts(
        self,
        n: int = 100,
        *,
        failures: int | None = None,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> Rollouts:
        """Simulate the sampled closed loop from random starts, with random true robots.

        Run k draws all of its own from `numpy.random.default_rng([seed, k])`. So the result is the
        same whatever carries out the runs, more runs of the same seed begin with the same ones, and
        studies that differ in gains alone are asked the same.

        Args:
            n: How many, ≥ 1.
            failures: ≥ 1: end with so many runs that do not converge; none of them by default. The
                interval holds all the same.
            execution: How and where they are carried out.
            progress: Called with "rollouts" and the share that is done; True shows a bar.

        Raises:
            UnknownNameError: No such engine.
            MissingPackageError: Lanes are asked for, and llvmlite is not there.
            InvalidInputError: Numbers out of range, lanes where they do not cover the loop, another
                task than the sensor's, a region of which a true camera sees nothing, or what cannot
                be sent to the processes of an executor.
        """
        n = as_integer("n", n, 1)
        failures = None if failures is None else as_integer("failures", failures, 1)
        execution = Execution() if execution is None else execution
        setting = self.setting().with_engine(execution.engine, n)
        tell = partial(telling(progress), "rollouts")
        (columns,) = carried_out([setting], n, failures, execution, tell)
        return Rollouts(columns, setting)

    # -- what the tests are made of -------------------------------------------------------------

    @property
    def timing(self) -> Latency:
        """When the loop measures and acts."""
        return self.latency or self.controller.latency or Latency()

    @property
    def errors(self) -> Uncertainty:
        """The uncertainty, which must be one for what draws true robots.

        Raises:
            InvalidInputError: It is one true robot.
        """
        require("uncertainty", self.uncertainty, Uncertainty, "an Uncertainty")
        assert isinstance(self.uncertainty, Uncertainty)
        return self.uncertainty

    def loop(self) -> ClosedLoop:
        """Return the closed loop that certificates are of.

        Raises:
            InvalidInputError: A controller that there are none of, or what it does not fit.
        """
        law: Any = self.controller.limited_law or self.controller
        return ClosedLoop(law, self.uncertainty, self.region, self.target)  # type: ignore[arg-type]

    def setting(self) -> RolloutSetting:
        """Return the setting of all rollouts, in Python.

        Raises:
            InvalidInputError: What rollouts refuse.
        """
        uncertainty, controller = self.errors, self.controller
        timing, sensing = self.timing, self.sensing
        if sensing is None and replace(timing, torque_delay=0.0) != Latency(timing.period):
            sensing = Sensing(
                x_delay=timing.image_age,
                x_rate=1.0 / timing.image_period if timing.image_period else None,
                velocity_filter=timing.velocity_filter or None,
            )
        dt, plant = timing.period, uncertainty.plant(uncertainty.believed)
        require_fit(plant, controller, dt)
        late = Plant(plant.robot, plant.sensor, sensing=sensing, actuator_delay=timing.torque_delay)
        duration = dt * round(_DURATION / dt) if self.duration is None else self.duration
        duration = as_number("duration", duration, unit="s", minimum=dt)
        accuracy = self.accuracy
        if accuracy is None:
            noise = 0.0 if sensing is None else float(np.max(sensing.x_noise))
            accuracy = fine_error(controller.task.units, noise)
        target = self.target
        x_d = None if target is None else wanted_of(uncertainty.believed_task(), target, 0.0)
        region = usual_region(controller.task) if self.region is None else self.region
        return RolloutSetting(
            controller, uncertainty, region, x_d, duration, dt, accuracy, self.seed, late.sensing,
            late.actuator_delay,
        )  # fmt: skip


def telling(progress: Progress) -> Callable[[str, float], None]:
    """Return a function of the name of a part of the work and the share that is done."""
    require("progress", progress, _PROGRESS, "a function of what is done and its share, or True")
    if progress is not True:
        return progress or (lambda what, share: None)
    from tqdm import tqdm

    bar = tqdm(total=1.0, bar_format="{desc}{percentage:3.0f} %|{bar}| {elapsed}")

    def tell(what: str, share: float) -> None:
        bar.set_description(what, refresh=False)
        bar.update(share - bar.n)

    return tell
