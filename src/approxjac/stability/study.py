"""`Study`: a controller with the errors that it may meet, and all that is asked of its loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, replace
from types import NoneType
from typing import Any

import numpy as np

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import Target, TargetPath
from approxjac.robots import Robot
from approxjac.simulation import Plant, Sensing
from approxjac.simulation.loop import require_fit, wanted_of
from approxjac.stability.errors.region import Region, uncovered
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop, usual_region
from approxjac.stability.report.other_laws import OtherLawReport, near_targets
from approxjac.stability.report.report import StabilityReport, report_of
from approxjac.stability.rollouts.portions import Execution, carried_out
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.stability.rollouts.setting import RolloutSetting
from approxjac.stability.search.map import StabilityMap, map_of
from approxjac.stability.search.suggested_gains import Suggestion, suggested_gains
from approxjac.stability.search.tolerance import TESTS, Test, Tolerance, tolerances
from approxjac.tasks.analysis import fine_error
from approxjac.validation import Array, as_integer, as_number, require

Progress = Callable[[str, float], None] | bool | None
_PROGRESS: Any = (Callable, bool, NoneType)
_DURATION = 10.0  # of a run [s]


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """A closed loop, the errors that it may meet, and where: what its tests have in common.

    Attributes:
        controller: The controller with its believed robot: rollouts take anything with the
            interface of `Controller`; the other tests take law (6) or (28), and a report
            `TorqueLimited` around it.
        uncertainty: How the true robot may differ. A report takes one true robot besides, as a
            `Plant`, or as a `Robot` on which the controller's own task is measured.
        region: Where starts, at rest, and targets are, as far as the true robot's sensor sees; the
            joint limits without near-singular configurations by default.
        target: x_d of all, shape (n_x,) [unit of the task]; by default the values of other
            configurations of the region, so that answers are of all targets within it. Rollouts
            take what moves besides, as `simulate` does.
        latency: When the loop measures and acts; by default that of the controller, or 1 kHz with
            ideal sensors.
        sensing: How measurements of rollouts differ from the truth; by default as late as
            `latency` says, and exact.
        duration: Of a rollout, a whole number of periods [s]; about 10 by default.
        accuracy: > 0; a rollout converged if ‖e‖ is below it at every recorded instant of the last
            tenth [unit of the task]; by default 1 mm, 1 mrad or 0.5 px, or three times the sensor's
            noise if that is more.
        seed: Of all drawing, ≥ 0.

    Raises:
        InvalidInputError: Numbers out of range, or arguments of the wrong kind.

    Example:
        >>> arm = load_robot("two_link")
        >>> errors = Uncertainty(arm, object_length=(0.0, 0.2), object_axis="x")
        >>> law = SetpointController(errors.believed_task())
        >>> study = Study(law, errors, JointBox.around(arm, [0.5, 1.2], 0.4), duration=1.0)
        >>> study.rollouts(3).n
        3
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
        if runs and not isinstance(self.uncertainty, Uncertainty):
            raise InvalidInputError(
                "runs needs an Uncertainty, from which rollouts draw true robots, "
                f"got {self.uncertainty!r}",
                given=self.uncertainty,
            )
        if reason := uncovered(self.controller):
            return self._of_other_law(reason, configurations, runs, execution, progress)
        limiter: Any = self.controller if self.controller.limited_law is not None else None
        with telling(progress) as tell:
            loop = self.loop()
            many = self.rollouts(runs, execution=execution, progress=tell) if runs else None
            return report_of(loop, self.timing, configurations, self.seed, tell, limiter, many)

    def rollouts(
        self,
        n: int = 100,
        *,
        failures: int | None = None,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> Rollouts:
        """Simulate the sampled closed loop from random starts, with random true robots.

        Run k draws from a generator of its own, `numpy.random.default_rng([seed, k])`: the true
        values, the start, the configuration that attains the target, and the seed of its noise and
        dropouts. So the result is the same whatever carries out the runs, more runs of the same
        seed begin with the same ones, and studies that differ in gains alone are asked the same.

        Args:
            n: How many, ≥ 1.
            failures: ≥ 1: end with the so many-th run that does not converge, which with 1 is the
                first one; all runs are carried out by default. The interval holds all the same.
            execution: How and where they are carried out.
            progress: Called with "rollouts" and the share that is done; True shows a bar.

        Raises:
            UnknownNameError: No such engine.
            MissingPackageError: Lanes are asked for, and llvmlite is not there.
            InvalidInputError: Numbers out of range, lanes asked for where they do not cover the
                loop, a controller of another task than the sensor's, a region of which a true
                camera sees nothing, or something that cannot be sent to the processes of an
                executor.
        """
        n = as_integer("n", n, 1)
        failures = None if failures is None else as_integer("failures", failures, 1)
        execution = Execution() if execution is None else execution
        setting = self.setting().with_engine(execution.engine, n)
        with telling(progress) as tell:
            (columns,) = carried_out(
                [setting], n, failures, execution, lambda share: tell("rollouts", share)
            )
        return Rollouts(columns, setting)

    def tolerance(
        self,
        tests: Sequence[Test] = TESTS,
        *,
        largest: float = 10.0,
        precision: float = 0.02,
        draws: int | None = None,
        progress: Progress = None,
    ) -> dict[Test, Tolerance]:
        """Find the largest scaling of the errors for which each test still passes.

        Theorem 1 and the matrix form are about motions that stay in the region, in continuous time.
        The configurations that choose the Lyapunov function are the only ones it is tried in: this
        finds how large errors may be about, and a report, which checks it in others, may find none
        a little below. The local test speaks of what begins near its target only, and rollouts
        prove nothing.

        A region with a configuration where Ĵ loses rank passes neither of the first two tests, at
        any scale.

        By bisection, with the same configurations at every scale. Sets grow with their scale, so
        for the first two tests whatever passes at one scale passes at all smaller ones (as far as
        corners and configurations tell). The local test looks at corners and might pass again
        beyond a gap, and so might rollouts, which pass where all of them converge.

        Args:
            tests: "theorem1", "matrix", "local" or "rollouts". The first two are not for a task
                whose Jacobian uses the measured x.
            largest: Scale at most > 0; less where robots beyond it cannot exist.
            precision: Of the scale, relative, > 0.
            draws: How many configurations to draw, 400 by default, or rollouts at each scale, 100
                by default, which end with the first that does not converge.
            progress: Called with "tolerance" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Numbers out of range, or what a report refuses.
            UnknownNameError: No such test.
        """
        with telling(progress) as tell:
            told = lambda share: tell("tolerance", share)  # noqa: E731
            return tolerances(self, tests, largest, precision, draws, told)

    def map(
        self,
        over: Mapping[str, Sequence[float] | Array],
        n: int = 100,
        *,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> StabilityMap:
        """Carry out rollouts over a grid of one or two parameters, or of what they draw.

        Over parameters ("error", "a", "kv" and "damping", see `PARAMETERS`) each point has the same
        n runs, which differ by what was changed and not by what was drawn. Over the errors
        (`uncertainty.names`) and the place of the believed tip at the start ("x", "y", "z" [m])
        there are n runs a point in all, drawn from the whole set and the whole region: each counts
        at the point that it is nearest to.

        Args:
            over: Name → values: numbers that grow, > 0 of gains, ≥ 0 of "error".
            n: Runs at each point, or on average.
            execution: How and where they are carried out.
            progress: Called with "map" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Values that are no growing numbers, one of gains and one of what is
                drawn, or what rollouts refuse.
            UnknownNameError: No such parameter.
        """
        n, execution = as_integer("n", n, 1), Execution() if execution is None else execution
        with telling(progress) as tell:
            return map_of(self, over, n, execution, lambda share: tell("map", share))

    def gains(
        self,
        settling_time: float = 1.0,
        *,
        test: Test = "matrix",
        torque_limits: float | Sequence[float] | Array | None = None,
        configurations: int = 200,
        progress: Progress = None,
    ) -> Suggestion:
        """Find gains of law (6) that pass a test, with gravity that is known exactly.

        Three demands: the test passes for every corner of the errors and every configuration drawn,
        and so does the loop sampled, with delays; the torque of a start at rest, gravity
        compensated, is within the limits; and a small error settles to 2 % in the wanted time with
        every true robot, linearised near the target: a far reach takes longer.
        Tried are the default gains and multiples of them, from gentle to strong, K_p along with K_v
        and the damping so that the believed arm settles in time. The controller's own gains do not
        count.

        Sampled means of "theorem1" and "matrix" that a whole report is passed, and of "local" that
        the exact linearisation of the sampled, late loop is stable at each target drawn.

        Args:
            settling_time: Wanted > 0 [s].
            test: The test to pass: "theorem1", "matrix" or "local".
            torque_limits: A number or shape (n_v,), infinite where there is none [N m or N]; the
                arm's effort limits by default.
            configurations: How many to draw.
            progress: Called with "gains" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Numbers out of range, or an empty region.
            UnknownNameError: No such test.
        """
        with telling(progress) as tell:
            return suggested_gains(
                self, settling_time, test, torque_limits, configurations,
                lambda share: tell("gains", share),
            )  # fmt: skip

    def _of_other_law(
        self,
        reason: str,
        configurations: int,
        runs: int,
        execution: Execution | None,
        progress: Progress,
    ) -> OtherLawReport:
        """Return the report of a law that no certificate is for."""
        count = as_integer("configurations", configurations, 20)
        setting = self.setting()
        with telling(progress) as tell:
            told = lambda share: tell("near targets", share)  # noqa: E731
            local = near_targets(setting, self.timing, count, told)
            many = self.rollouts(runs, execution=execution, progress=tell) if runs else None
        return OtherLawReport(
            self.controller, setting.uncertainty, self.timing, reason, local, many, self.seed
        )

    # -- what the tests are made of -------------------------------------------------------------

    @property
    def timing(self) -> Latency:
        """When the loop measures and acts."""
        return self.latency or self.controller.latency or Latency()

    def loop(self) -> ClosedLoop:
        """Return the closed loop that certificates are of.

        Raises:
            InvalidInputError: A controller that there are none of, or what it does not fit.
        """
        law: Any = self.controller.limited_law or self.controller
        return ClosedLoop(law, self.uncertainty, self.region, self.target)  # type: ignore[arg-type]

    def setting(self) -> RolloutSetting:
        """Return what all rollouts share, in Python.

        Raises:
            InvalidInputError: What rollouts refuse.
        """
        require("uncertainty", self.uncertainty, Uncertainty, "an Uncertainty")
        uncertainty, controller = self.uncertainty, self.controller
        assert isinstance(uncertainty, Uncertainty)
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
        if sensing is not None and sensing.x_delay >= duration:
            raise InvalidInputError(
                f"x_delay must be shorter than the duration, {duration:g} [s], or nothing arrives "
                f"that is measured in a run, got {sensing.x_delay:g}",
                given=sensing,
            )
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


@contextmanager
def telling(progress: Progress) -> Iterator[Callable[[str, float], None]]:
    """Return what is called with the name of a part of the work and the share that is done."""
    require("progress", progress, _PROGRESS, "a function of what is done and its share, or True")
    if progress is not True:
        yield progress or (lambda what, share: None)
        return
    from tqdm import tqdm

    with tqdm(total=1.0, bar_format="{desc}{percentage:3.0f} %|{bar}| {elapsed}") as bar:

        def tell(what: str, share: float) -> None:
            bar.set_description(what)
            bar.n = share
            bar.refresh()

        yield tell
