"""`StudiedLoop`: a controller and the errors that it may meet, with a report and rollouts."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import Target, TargetPath
from approxjac.robots import Robot
from approxjac.simulation import Plant, Sensing
from approxjac.simulation.simulate import require_fit, wanted_of
from approxjac.stability.errors.region import Region, uncovered
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop, usual_region
from approxjac.stability.report.move_bounds import Moves
from approxjac.stability.report.other_laws import OtherLawReport, near_targets
from approxjac.stability.report.report import StabilityReport, report_of
from approxjac.stability.rollouts.rollouts import Execution, Rollouts, carried_out
from approxjac.stability.rollouts.setting import RolloutSetting, with_engine
from approxjac.stability.search.certified_moves import certified_moves
from approxjac.tasks.analysis import fine_error
from approxjac.validation import Array, as_integer, as_number, require

Progress = Callable[[str, float], None] | bool | None
_DURATION = 10.0  # of a run [s]


@dataclass(frozen=True, eq=False, repr=False)
class StudiedLoop:
    """A closed loop with possible errors and a region. Its attributes are those of `Study`.

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
        wanted = "a Region, such as JointBox(robot), or None"
        require("region", self.region, Region | None, wanted)
        require("latency", self.latency, Latency | None, "Latency(period=...) or None")
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
        moves: float = 0.0,
        runs: int = 0,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> StabilityReport | OtherLawReport:
        """Report, before anything moves, whether the loop is stable, and its margins.

        Half of the configurations, 1000 at most, find the worst cases and choose the Lyapunov
        functions, with more samples near the worst; the others check the choice. For
        `TorqueLimited` it certifies starts whose motions never reach the effort limits.

        A law without certificates, such as your own, is linearised at targets of the region, in
        an `OtherLawReport`.

        Args:
            configurations: Number of configurations, ≥ 20, half at corners and half inside of the
                error box.
            moves: Length of moves along each axis of a position, to both sides, whose certified
                speed is sought [m], see `Study.moves`; 0 seeks none.
            runs: Number of rollouts to add; none by default.
            execution: Engine and executor of the rollouts.
            progress: Function called with the current work and the share done; True shows a bar.

        Raises:
            InvalidInputError: A task whose Jacobian uses the measured x, an empty region or one
                that a true camera does not see, a target that no configuration of a true robot
                attains, or numbers out of range.
        """
        controller, timing, seed = self.controller, self.timing, self.seed
        count = as_integer("configurations", configurations, 20)
        moves = as_number("moves", moves, unit="m", minimum=0.0)
        tell = progress_report(progress)
        reason = uncovered(controller)
        loop = None if reason else self.loop()
        many = self.rollouts(runs, execution=execution, progress=tell) if runs else None
        if loop is None:
            setting = self.setting()
            near = near_targets(setting, timing, count, partial(tell, "near targets"))
            return OtherLawReport(setting, timing, reason, *near, many)
        limiter: Any = controller if controller.limited_law is not None else None
        report = report_of(loop, timing, count, seed, tell, limiter, many)
        if moves and set(controller.task.units) == {"m"}:
            tell("moves", 0.0)
            ways = moves * np.eye(controller.task.m)
            try:
                report = replace(report, moves=self.moves([*ways, *-ways]))
            except InvalidInputError as error:  # what the theorem does not cover
                report = replace(report, unmoved=str(error).split(", got ")[0])
        return report

    def moves(
        self,
        displacements: Sequence[Sequence[float]] | Array | None = None,
        *,
        start: Sequence[float] | Array | None = None,
        speed: float | None = None,
    ) -> Moves:
        """Find the largest speeds of the target along lines, with bounds of ‖e‖ and of the joints.

        The target begins at the measured tip of an arm at rest and is eased along each line, as by
        `paths.Line` or by `control`. Every robot of the box then stays within the bounds. The loop
        is sampled with the period of its latency. Torque limits are not looked at.

        Args:
            displacements: Of the target, shape (k, m) or (m,) [unit of the task]; by default 20 cm
                along each axis of a position, to both sides.
            start: Configuration at rest, shape (nq,); the middle of the region by default.
            speed: The largest speed of the target that is asked about [unit of the task/s]; by
                default the largest that is certified, up to that of a move that takes 1.5 s.

        Raises:
            InvalidInputError: A law without certificates, gravity that is learnt or not exact, a
                latency with more than a period, a task that is no vector of positions, joints
                without damping on a redundant arm, or arguments of the wrong shape.
        """
        loop, seed = self.loop(), self.seed
        return certified_moves(loop, self.timing, seed, displacements, start, speed)

    def rollouts(
        self,
        n: int = 100,
        *,
        failures: int | None = None,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> Rollouts:
        """Simulate the sampled closed loop from random starts, with random true robots.

        Run k uses the generator `numpy.random.default_rng([seed, k])`. So results do not depend on
        the executor, more runs of a seed begin with the same ones, and studies that differ only in
        gains have the same starts and true robots.

        Args:
            n: Number of runs, ≥ 1.
            failures: Stop after this number ≥ 1 of runs that do not converge; never by default.
                The interval is valid nevertheless.
            execution: Engine and executor.
            progress: Function called with "rollouts" and the share done; True shows a bar.

        Raises:
            UnknownNameError: No such engine.
            MissingPackageError: Lanes are requested, and llvmlite is not installed.
            InvalidInputError: Numbers out of range, lanes do not cover the loop, another task than
                the sensor's, a region that a true camera does not see, or objects that cannot be
                sent to the processes of an executor.
        """
        n = as_integer("n", n, 1)
        failures = None if failures is None else as_integer("failures", failures, 1)
        execution = Execution() if execution is None else execution
        (setting,) = with_engine([self.setting()], execution.engine, n)
        tell = partial(progress_report(progress), "rollouts")
        (columns,) = carried_out([setting], n, failures, execution, tell)
        return Rollouts(columns, setting)

    # -- what the tests are made of -------------------------------------------------------------

    @property
    def timing(self) -> Latency:
        """Latency of the loop."""
        return self.latency or self.controller.latency or Latency()

    @property
    def errors(self) -> Uncertainty:
        """The uncertainty, for tests that draw true robots.

        Raises:
            InvalidInputError: `uncertainty` is a single true robot.
        """
        return require("uncertainty", self.uncertainty, Uncertainty, "an Uncertainty")

    def loop(self) -> ClosedLoop:
        """Return the closed loop for certificates.

        Raises:
            InvalidInputError: A controller without certificates, or that does not fit the loop.
        """
        law = self.controller.limited_law or self.controller
        return ClosedLoop(law, self.uncertainty, self.region, self.target)  # type: ignore[arg-type]

    def setting(self) -> RolloutSetting:
        """Return the setting of all rollouts, in Python.

        Raises:
            InvalidInputError: The errors of `rollouts`.
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


def progress_report(progress: Progress) -> Callable[[str, float], None]:
    """Return a function that reports the name of the current work and the share done."""
    wanted = "a function of what is done and its share, or True"
    require("progress", progress, Callable | bool | None, wanted)
    if progress is not True:
        return progress or (lambda what, share: None)
    from tqdm import tqdm

    bar = tqdm(total=1.0, bar_format="{desc}{percentage:3.0f} %|{bar}| {elapsed}")

    def tell(what: str, share: float) -> None:
        bar.set_description(what, refresh=False)
        bar.update(share - bar.n)
        if share >= 1.0:  # which comes too soon to be shown by itself
            bar.refresh()

    return tell
